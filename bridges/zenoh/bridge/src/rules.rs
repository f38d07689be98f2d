//! The allow-list of both directions. Nothing passes without a rule.

use std::{
    collections::{BTreeMap, BTreeSet},
    time::Duration,
};

use sinew::{
    message::{Class, Kind},
    protection::Protection,
};

use crate::{Address, Refusal, Target, key};

/// The form of payloads in Zenoh. In Sinew they are MessagePack, or bytes of a program of C.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Encoding {
    /// MessagePack, as in Sinew.
    #[default]
    MessagePack,
    /// JSON.
    Json,
    /// Bytes that are not looked at: payloads that are no MessagePack in Sinew either.
    Raw,
}

/// The meaning of a `get`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Get {
    /// A request: the reply of the application is the reply.
    Ask,
    /// A confirmed message: its outcome is the reply.
    Confirm,
}

/// Messages of one type from Zenoh to one destination.
#[derive(Clone, Debug, PartialEq)]
pub struct InRoute {
    /// The destination, and the type.
    pub address: Address,
    /// The number of the type.
    pub kind: Kind,
    /// The form of payloads and of replies.
    pub encoding: Encoding,
    /// The class of the messages; requests are Control.
    pub class: Class,
    /// Whether a `put` is sent, without a confirmation.
    pub allows_put: bool,
    /// The meaning of a `get`; `None`: it is refused.
    pub get: Option<Get>,
    /// Time limit for outcomes and replies.
    pub within: Duration,
    /// Time after which a message expires where it waits.
    pub expires_after: Option<Duration>,
    /// Maximum age of a message by its timestamp of Zenoh.
    pub age_max: Option<Duration>,
    /// The limits of the type, if it is protected: the bridge is its protected sender.
    pub protection: Option<Protection>,
}

/// The origin of messages for Zenoh.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Origin {
    /// Messages to a name that the bridge has for a Zenoh program.
    Name(String),
    /// Messages to a group that the bridge joins.
    Group(String),
    /// Messages to all applications.
    All,
}

/// Messages of one type from Sinew to Zenoh.
#[derive(Clone, Debug, PartialEq)]
pub struct OutRoute {
    /// The type, and the destination that the messages had in Sinew. Their key is made of it.
    pub address: Address,
    /// The number of the type.
    pub kind: Kind,
    /// The form of payloads.
    pub encoding: Encoding,
    /// The name and the number of the type of replies; `None`: requests are refused.
    pub reply: Option<(String, Kind)>,
    /// Time limit for replies.
    pub within: Duration,
}

/// A name that the bridge has at the node for a Zenoh program.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Program {
    /// The name.
    pub name: String,
    /// Whether the name exists only while the program has its liveliness token.
    pub needs_token: bool,
}

/// A put or a query as it arrives from Zenoh.
#[derive(Clone, Copy, Debug)]
pub struct Arrival<'a> {
    /// Its key expression.
    pub key: &'a str,
    /// The act.
    pub act: Act,
    /// Bytes of its payload.
    pub length: usize,
    /// Its age by its timestamp; `None`: it has none.
    pub age: Option<Duration>,
    /// Whether a bridge has sent it.
    pub is_from_bridge: bool,
}

/// The act of a Zenoh program.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Act {
    /// A `put`.
    Put,
    /// A `delete`.
    Delete,
    /// A `get`.
    Get,
}

/// The rules of both directions, and the project that the keys name.
#[derive(Clone, Debug, Default)]
pub struct Rules {
    project: String,
    inward: Vec<InRoute>,
    outward: Vec<OutRoute>,
    by_address: BTreeMap<Address, usize>,
    by_origin: BTreeMap<(Origin, Kind), usize>,
    programs: BTreeMap<String, Program>,
    /// Patterns of the applications with a liveliness token.
    shown: Vec<String>,
    shows_nodes: bool,
}

impl Rules {
    /// Creates rules that let nothing pass.
    #[must_use]
    pub fn new(project: &str) -> Self {
        Self { project: project.to_owned(), ..Self::default() }
    }

    /// Adds a route into Sinew. Returns whether there was none for its address.
    pub fn add_in(&mut self, route: InRoute) -> bool {
        let is_new = self.by_address.insert(route.address.clone(), self.inward.len()).is_none();
        self.inward.push(route);
        is_new
    }

    /// Adds a route out of Sinew. Returns whether there was none for its origin.
    pub fn add_out(&mut self, route: OutRoute) -> bool {
        let Some(origin) = Origin::of(&route.address.target) else { return false };
        let is_new = self.by_origin.insert((origin, route.kind), self.outward.len()).is_none();
        self.outward.push(route);
        is_new
    }

    /// Adds a name for a Zenoh program. It needs no token if one of its rules does not.
    pub fn add_program(&mut self, program: Program) {
        let known = self.programs.entry(program.name.clone()).or_insert_with(|| program.clone());
        known.needs_token &= program.needs_token;
    }

    /// Sets the liveliness tokens: of applications with a name of one of these patterns, and of nodes.
    pub fn show(&mut self, patterns: Vec<String>, nodes: bool) {
        (self.shown, self.shows_nodes) = (patterns, nodes);
    }

    /// Returns the project.
    #[must_use]
    pub fn project(&self) -> &str {
        &self.project
    }

    /// Returns the routes into Sinew.
    #[must_use]
    pub fn inward(&self) -> &[InRoute] {
        &self.inward
    }

    /// Returns the routes out of Sinew.
    #[must_use]
    pub fn outward(&self) -> &[OutRoute] {
        &self.outward
    }

    /// Returns the names for Zenoh programs.
    pub fn programs(&self) -> impl Iterator<Item = &Program> {
        self.programs.values()
    }

    /// Returns the groups that the bridge joins.
    #[must_use]
    pub fn groups(&self) -> BTreeSet<&str> {
        self.outward.iter().filter_map(|route| group_of(&route.address.target)).collect()
    }

    /// Returns the index of the route of a put or a query; `None`: another bridge has sent it for Zenoh programs.
    ///
    /// # Errors
    /// It is refused, with the cause.
    pub fn admit(&self, arrival: &Arrival<'_>, payload_max: usize) -> Result<Option<usize>, Refusal> {
        let found = Address::parse(arrival.key, &self.project).ok_or(Refusal::ForeignKey);
        let found = found.and_then(|address| self.by_address.get(&address).copied().ok_or(Refusal::NoRule));
        let index = match (found, arrival.is_from_bridge) {
            (Ok(index), false) => index,
            (Ok(_), true) => return Err(Refusal::FromBridge),
            (Err(_), true) => return Ok(None),
            (Err(why), false) => return Err(why),
        };
        let route = &self.inward[index];
        let is_allowed = match arrival.act {
            Act::Put => route.allows_put,
            Act::Get => route.get.is_some(),
            Act::Delete => false,
        };
        if !is_allowed {
            return Err(Refusal::NotThisAct);
        }
        // JSON is longer than MessagePack, but by no more than this.
        let longest =
            if route.encoding == Encoding::Json { payload_max.saturating_mul(8) } else { payload_max };
        if arrival.length > longest {
            return Err(Refusal::TooLong);
        }
        if route.age_max.is_some_and(|max| arrival.age.is_none_or(|age| age > max)) {
            return Err(Refusal::TooOld);
        }
        Ok(Some(index))
    }

    /// Returns the route of a message of Sinew, or `None` if no rule lets it pass.
    #[must_use]
    pub fn outward_of(&self, origin: &Origin, kind: Kind) -> Option<&OutRoute> {
        self.by_origin.get(&(origin.clone(), kind)).map(|index| &self.outward[*index])
    }

    /// Returns the key of the liveliness token of an application, if it is shown.
    #[must_use]
    pub fn app_token(&self, tid: sinew::Tid, name: &str) -> Option<String> {
        let is_shown = self.shown.iter().any(|pattern| matches(pattern, name));
        is_shown.then(|| key::app_token(&self.project, tid, name))
    }

    /// Returns the key of the liveliness token of a node, if nodes are shown.
    #[must_use]
    pub fn node_token(&self, node: sinew::NodeAddress) -> Option<String> {
        self.shows_nodes.then(|| key::node_token(&self.project, node))
    }

    /// Returns whether there are any liveliness tokens.
    #[must_use]
    pub fn shows_any(&self) -> bool {
        self.shows_nodes || !self.shown.is_empty()
    }

    /// Returns the names of the types of a route of these destinations, for the registration of a client.
    #[must_use]
    pub fn types_of(&self, origin: Option<&str>) -> Vec<String> {
        let of_program = |route: &&OutRoute| match (&route.address.target, origin) {
            (Target::Name(name), Some(origin)) => name == origin,
            (Target::Name(_), None) | (_, Some(_)) => false,
            (_, None) => true,
        };
        let outward = self.outward.iter().filter(of_program).map(|route| route.address.payload_type.clone());
        let inward = self.inward.iter().filter(|_| origin.is_none());
        let types: BTreeSet<_> =
            outward.chain(inward.map(|route| route.address.payload_type.clone())).collect();
        types.into_iter().collect()
    }
}

fn group_of(target: &Target) -> Option<&str> {
    match target {
        Target::Group(name) => Some(name),
        Target::Name(_) | Target::Tid(_) | Target::All => None,
    }
}

impl Origin {
    /// Returns the origin of messages to a target; `None`: the bridge receives none of them.
    #[must_use]
    pub fn of(target: &Target) -> Option<Self> {
        match target {
            Target::Name(name) => Some(Self::Name(name.clone())),
            Target::Group(name) => Some(Self::Group(name.clone())),
            Target::All => Some(Self::All),
            Target::Tid(_) => None,
        }
    }
}

/// Returns whether a name matches a pattern, in which `*` is any text.
#[must_use]
pub fn matches(pattern: &str, name: &str) -> bool {
    let mut parts = pattern.split('*');
    let first = parts.next().unwrap_or_default();
    let Some(mut rest) = name.strip_prefix(first) else { return false };
    let mut parts: Vec<_> = parts.collect();
    let Some(last) = parts.pop() else { return rest.is_empty() };
    for part in parts {
        let Some(place) = rest.find(part) else { return false };
        rest = &rest[place + part.len()..];
    }
    rest.ends_with(last)
}

#[cfg(test)]
pub(crate) mod tests {
    use proptest::prelude::*;

    use super::*;

    pub(crate) fn route(target: Target) -> InRoute {
        let address = Address { target, payload_type: "leg.move".to_owned() };
        InRoute {
            kind: address.kind(),
            address,
            encoding: Encoding::MessagePack,
            class: Class::Control,
            allows_put: true,
            get: None,
            within: Duration::from_secs(1),
            expires_after: None,
            age_max: None,
            protection: None,
        }
    }

    fn rules() -> Rules {
        let mut rules = Rules::new("leg");
        let second = Some(Duration::from_secs(1));
        assert!(rules.add_in(route(Target::Name("knee".to_owned()))));
        assert!(rules.add_in(InRoute { age_max: second, ..route(Target::Name("ankle".to_owned())) }));
        let get = Some(Get::Ask);
        assert!(rules.add_in(InRoute { get, allows_put: false, ..route(Target::Name("hip".to_owned())) }));
        rules
    }

    const fn put(key: &str) -> Arrival<'_> {
        Arrival { key, act: Act::Put, length: 10, age: None, is_from_bridge: false }
    }

    #[test]
    fn message_without_a_rule_is_refused_with_its_cause() {
        let rules = rules();
        let knee = put("sinew/leg/n/knee/leg.move");
        let cases = [
            (knee, Ok(Some(0))),
            (Arrival { length: 1_001, ..knee }, Err(Refusal::TooLong)),
            (Arrival { is_from_bridge: true, ..knee }, Err(Refusal::FromBridge)),
            (Arrival { act: Act::Delete, ..knee }, Err(Refusal::NotThisAct)),
            (Arrival { act: Act::Get, ..knee }, Err(Refusal::NotThisAct)),
            (Arrival { is_from_bridge: true, ..put("sinew/leg/g/telemetry/leg.angle") }, Ok(None)),
            (put("sinew/leg/n/knee/leg.stop"), Err(Refusal::NoRule)),
            (put("sinew/leg/g/knee/leg.move"), Err(Refusal::NoRule)),
            (put("sinew/leg/n/*/leg.move"), Err(Refusal::ForeignKey)),
            (put("sinew/leg/n/hip/leg.move"), Err(Refusal::NotThisAct)),
            (Arrival { act: Act::Get, ..put("sinew/leg/n/hip/leg.move") }, Ok(Some(2))),
            (put("sinew/leg/n/ankle/leg.move"), Err(Refusal::TooOld)),
            (Arrival { age: Some(Duration::ZERO), ..put("sinew/leg/n/ankle/leg.move") }, Ok(Some(1))),
        ];
        for (arrival, result) in cases {
            assert_eq!(rules.admit(&arrival, 1_000), result, "{arrival:?}");
        }
    }

    #[test]
    fn second_rule_for_one_address_is_noticed() {
        let mut rules = rules();
        assert!(!rules.add_in(route(Target::Name("knee".to_owned()))));
        assert!(rules.add_in(route(Target::Group("knee".to_owned()))), "a group is another destination");
    }

    #[test]
    fn liveliness_is_shown_by_pattern() {
        let mut rules = rules();
        let tid = sinew::Tid::from_bits(7);
        assert_eq!((rules.app_token(tid, "knee"), rules.node_token(tid.node)), (None, None));
        rules.show(vec!["knee*".to_owned()], true);
        assert!(rules.app_token(tid, "knee.drive").is_some() && rules.node_token(tid.node).is_some());
        assert_eq!(rules.app_token(tid, "hip.drive"), None);
    }

    #[test]
    fn star_of_a_pattern_is_any_text() {
        for (pattern, name) in
            [("*", ""), ("leg.*", "leg.knee"), ("*.drive", "knee.drive"), ("a*b*c", "axbbxc")]
        {
            assert!(matches(pattern, name), "{pattern} {name}");
        }
        for (pattern, name) in
            [("leg.*", "leg"), ("knee", "knee.drive"), ("", "knee"), ("a*b", "ba"), ("ab*ba", "aba")]
        {
            assert!(!matches(pattern, name), "{pattern} {name}");
        }
    }

    proptest! {
        #[test]
        fn only_keys_of_rules_are_admitted(key in "sinew/leg/[ng]/[a-z*%]{0,6}/(leg.move|[a-z.]{0,8})") {
            let admitted = rules().admit(&put(&key), 1_000);
            prop_assert_eq!(admitted.is_ok(), key == "sinew/leg/n/knee/leg.move");
        }
    }
}
