//! The rules of the file: `[[in]]` and `[[out]]`.

use std::time::Duration;

use serde::Deserialize;
use sinew::{
    Tid,
    message::{Class, Kind},
    name::check_name,
    protection::Protection,
};

use super::faults::Faults;
use crate::{Address, Encoding, Get, InRoute, OutRoute, Rules, Target, rules::Program};

/// Maximum number of rules of one direction, and of types of one rule.
const RULES_MAX: usize = 256;
const TYPES_MAX: usize = 64;
/// Types of Sinew itself that may pass: parameters, for which the access list has roles, and signs of life.
const OWN_TYPES: [&str; 3] = ["sinew.param.ask", "sinew.param.set", "sinew.ping"];
/// Largest time limit in ms: an hour.
const WITHIN_MAX_MS: u64 = 3_600_000;
/// Longest period of a protected type in ms.
const PERIOD_MAX_MS: u64 = 60_000;

/// A rule into Sinew.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct InFile {
    to: Option<String>,
    tid: Option<String>,
    group: Option<String>,
    #[serde(default)]
    broadcast: bool,
    types: Vec<String>,
    #[serde(default)]
    encoding: EncodingWord,
    class: Option<ClassWord>,
    put: Option<bool>,
    get: Option<GetWord>,
    #[serde(default = "within_ms")]
    within_ms: u64,
    expires_after_ms: Option<u64>,
    age_max_ms: Option<u64>,
    protected: Option<ProtectedFile>,
}

/// The period of a protected type.
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct ProtectedFile {
    period_ms: u64,
}

/// A rule out of Sinew.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct OutFile {
    name: Option<String>,
    group: Option<String>,
    #[serde(default)]
    broadcast: bool,
    types: Vec<String>,
    #[serde(default)]
    encoding: EncodingWord,
    token: Option<bool>,
    reply: Option<String>,
    #[serde(default = "within_ms")]
    within_ms: u64,
}

#[derive(Clone, Copy, Debug, Default, Deserialize)]
#[serde(rename_all = "lowercase")]
enum EncodingWord {
    #[default]
    MsgPack,
    Json,
    Raw,
}

#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(rename_all = "lowercase")]
enum ClassWord {
    Control,
    Stream,
    Bulk,
}

#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(rename_all = "lowercase")]
enum GetWord {
    Ask,
    Confirm,
}

const fn within_ms() -> u64 {
    1_000
}

impl From<EncodingWord> for Encoding {
    fn from(word: EncodingWord) -> Self {
        match word {
            EncodingWord::MsgPack => Self::MessagePack,
            EncodingWord::Json => Self::Json,
            EncodingWord::Raw => Self::Raw,
        }
    }
}

impl From<ClassWord> for Class {
    fn from(word: ClassWord) -> Self {
        match word {
            ClassWord::Control => Self::Control,
            ClassWord::Stream => Self::Stream,
            ClassWord::Bulk => Self::Bulk,
        }
    }
}

impl From<GetWord> for Get {
    fn from(word: GetWord) -> Self {
        match word {
            GetWord::Ask => Self::Ask,
            GetWord::Confirm => Self::Confirm,
        }
    }
}

/// Adds the rules of the file.
pub(super) fn apply(inward: &[InFile], outward: &[OutFile], rules: &mut Rules, faults: &mut Faults) {
    for (part, count) in [("[[in]]", inward.len()), ("[[out]]", outward.len())] {
        faults.check(count <= RULES_MAX, part, "at most 256 rules; a rule may have 64 types");
    }
    for (index, rule) in inward.iter().take(RULES_MAX).enumerate() {
        rule.apply(&format!("[[in]] {}", index + 1), rules, faults);
    }
    for (index, rule) in outward.iter().take(RULES_MAX).enumerate() {
        rule.apply(&format!("[[out]] {}", index + 1), rules, faults);
    }
}

impl InFile {
    fn apply(&self, place: &str, rules: &mut Rules, faults: &mut Faults) {
        check_types(&self.types, place, faults);
        check_within(self.within_ms, place, faults);
        let Some(target) = self.target(place, faults) else { return };
        let allows_put = self.put.unwrap_or(true);
        faults.check(allows_put || self.get.is_some(), place, "it allows nothing: set `put` or `get`");
        if let Some(ProtectedFile { period_ms }) = self.protected {
            faults.check(target.is_single(), place, "a protected type is for one application: `to` or `tid`");
            faults.check(self.get.is_none() && allows_put, place, "a protected command is put: remove `get`");
            let is_period = (1..=PERIOD_MAX_MS).contains(&period_ms);
            faults.check(is_period, place, "protected.period_ms: 1 to 60000, that of the type");
        }
        if let Some(Get::Ask) = self.get.map(Get::from) {
            faults.check(target.is_single(), place, "one application is asked: `to` or `tid`");
        }
        let class = self.class.map_or(Class::Control, Class::from);
        let is_confirmed = self.get.map(Get::from) == Some(Get::Confirm);
        faults.check(
            !is_confirmed || class != Class::Stream,
            place,
            "a stream is not confirmed: remove `get`",
        );
        let millis = |time: Option<u64>| time.map(Duration::from_millis);
        for payload_type in self.types.iter().take(TYPES_MAX) {
            let address = Address { target: target.clone(), payload_type: payload_type.clone() };
            let is_new = rules.add_in(InRoute {
                kind: address.kind(),
                address,
                encoding: self.encoding.into(),
                class,
                allows_put,
                get: self.get.map(Get::from),
                within: Duration::from_millis(self.within_ms),
                expires_after: millis(self.expires_after_ms),
                age_max: millis(self.age_max_ms),
                protection: self
                    .protected
                    .map(|of| Protection::of_period(Duration::from_millis(of.period_ms))),
            });
            if !is_new {
                faults
                    .add(place, format_args!("a rule before it has {target} and {payload_type}; remove one"));
            }
        }
    }

    fn target(&self, place: &str, faults: &mut Faults) -> Option<Target> {
        let tid = self.tid.as_ref().map(|text| match text.parse::<Tid>() {
            Ok(tid) if tid.is_single() && tid.node.is_single() && !tid.app.is_layer() => {
                Some(Target::Tid(tid))
            }
            Ok(_) => {
                faults
                    .add(place, format_args!("tid {text:?} is not one application of a node: 10.0.0.3/1001"));
                None
            }
            Err(why) => {
                faults.add(place, format_args!("tid: {why}"));
                None
            }
        });
        let targets = [
            self.to.clone().map(Target::Name),
            tid.flatten(),
            self.group.clone().map(Target::Group),
            self.broadcast.then_some(Target::All),
        ];
        let keys = [self.to.is_some(), self.tid.is_some(), self.group.is_some(), self.broadcast];
        one_of(targets, keys, "to, tid, group or broadcast", (place, faults))
    }
}

impl OutFile {
    fn apply(&self, place: &str, rules: &mut Rules, faults: &mut Faults) {
        check_types(&self.types, place, faults);
        check_within(self.within_ms, place, faults);
        let targets = [
            self.name.clone().map(Target::Name),
            self.group.clone().map(Target::Group),
            self.broadcast.then_some(Target::All),
        ];
        let keys = [self.name.is_some(), self.group.is_some(), self.broadcast];
        let target = one_of(targets, keys, "name, group or broadcast", (place, &mut *faults));
        let Some(target) = target else { return };
        let is_name = self.name.is_some();
        faults.check(is_name || self.token.is_none(), place, "`token` belongs to a `name`");
        faults.check(is_name || self.reply.is_none(), place, "requests reach a `name` alone: remove `reply`");
        if let Some(Err(why)) = self.reply.as_deref().map(check_name) {
            faults.add(place, format_args!("reply: {why}"));
        }
        if let Some(name) = &self.name {
            rules.add_program(Program { name: name.clone(), needs_token: self.token.unwrap_or(true) });
        }
        for payload_type in self.types.iter().take(TYPES_MAX) {
            let address = Address { target: target.clone(), payload_type: payload_type.clone() };
            let is_new = rules.add_out(OutRoute {
                kind: address.kind(),
                address,
                encoding: self.encoding.into(),
                reply: self.reply.clone().map(|name| (name.clone(), Kind::named(&name))),
                within: Duration::from_millis(self.within_ms),
            });
            if !is_new {
                faults
                    .add(place, format_args!("a rule before it has {target} and {payload_type}; remove one"));
            }
        }
    }
}

/// Returns the one destination of a rule.
fn one_of<const COUNT: usize>(
    targets: [Option<Target>; COUNT],
    keys: [bool; COUNT],
    words: &str,
    (place, faults): (&str, &mut Faults),
) -> Option<Target> {
    if keys.iter().filter(|is_set| **is_set).count() != 1 {
        faults.add(place, format_args!("it needs exactly one of {words}"));
        return None;
    }
    let target = targets.into_iter().flatten().next()?;
    if let Target::Name(name) | Target::Group(name) = &target
        && let Err(why) = check_name(name)
    {
        faults.add(place, format_args!("{name:?}: {why}"));
        return None;
    }
    Some(target)
}

fn check_types(types: &[String], place: &str, faults: &mut Faults) {
    let is_listed = (1..=TYPES_MAX).contains(&types.len());
    faults.check(is_listed, place, "types: 1 to 64 names of payload types, such as [\"leg.angle\"]");
    for name in types.iter().take(TYPES_MAX) {
        if let Err(why) = check_name(name) {
            faults.add(place, format_args!("type {name:?}: {why}"));
        } else if name.starts_with("sinew.") && !OWN_TYPES.contains(&&name[..]) {
            faults.add(
                place,
                format_args!("type {name:?} belongs to Sinew's nodes, and does not pass; remove it"),
            );
        }
    }
}

fn check_within(within_ms: u64, place: &str, faults: &mut Faults) {
    faults.check((1..=WITHIN_MAX_MS).contains(&within_ms), place, "within_ms: 1 to 3600000");
}
