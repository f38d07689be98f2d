//! The channels that the messages of a system will have, as far as the nodes know them before a message is read: each
//! type that an application has sent, or has declared that it sends, with its structure.

use std::{collections::BTreeMap, time::Duration};

use sinew::{
    AppAddress, NodeAddress, Tid, Time,
    inspect::{AppsReport, AskApps, AskSchemas, NodeReport, SchemasReport, Selection, TypeUser},
    message::Kind,
    schema::Schema,
};
use sinew_bag::{ChannelInfo, Class, Direction, Party, ViewWriter};
use sinew_recorder::ViewChannel;

use super::Origin;
use crate::system::{System, present};

/// Types that are asked for at one look. The next look begins after them.
const KINDS_MAX: usize = 256;
/// Time for the questions about types at one look: meanwhile no message is read.
const ASKED_WITHIN: Duration = Duration::from_secs(1);
/// The first part of the names of Sinew's own types.
const OWN_TYPES: &str = "sinew.";
/// The metadata that is known before the first message.
const KNOWN: [&str; 9] = [
    "sinew.source",
    "sinew.source_tid",
    "sinew.source_name",
    "sinew.source_node",
    "sinew.type",
    "sinew.kind",
    "sinew.schema",
    "sinew.role",
    "sinew.raw",
];

/// A channel, and the origin of its messages.
pub(super) struct Expected {
    pub(super) channel: ViewChannel,
    pub(super) origin: Origin,
}

/// Asks the nodes for the types that applications handle, and the entry node for the senders of each: those after the
/// type `last`, and sets it. A node without an answer has no channels until the next look.
pub(super) fn find(
    system: &mut System,
    here: &NodeReport,
    shown: &Selection,
    last: &mut Option<Kind>,
) -> Vec<Expected> {
    let until = Time::now() + ASKED_WITHIN;
    let answers = system.ask_these::<AskApps, AppsReport>(present(here));
    let apps = answers.into_iter().filter_map(|answer| answer.result.ok()).flat_map(|report| report.apps);
    let named = apps.flat_map(|app| app.kinds).filter_map(|kind| Some((kind.kind, kind.name?)));
    let kinds: BTreeMap<_, _> = named.filter(|(_, name)| !name.starts_with(OWN_TYPES)).collect();
    let mut all = Vec::new();
    for kind in next_kinds(&kinds, *last) {
        if Time::now() >= until {
            break;
        }
        *last = Some(kind);
        let Some(mut report) = ask(system, here.node, kind, until) else { continue };
        for one in report.schemas.iter_mut().filter(|one| one.schema.is_none()) {
            // The node of a sender has its structure.
            let Some(user) = one.sent_by.first() else { continue };
            let Some(other) = ask(system, user.tid.node, kind, until) else { continue };
            one.schema =
                other.schemas.into_iter().find(|found| found.hash == one.hash).and_then(|found| found.schema);
        }
        all.extend(channels(&report, kind, &kinds[&kind], shown));
    }
    all
}

/// Returns the types of a look: those after the last one of the look before, and then from the first one on.
fn next_kinds(kinds: &BTreeMap<Kind, String>, last: Option<Kind>) -> Vec<Kind> {
    let (before, after): (Vec<_>, Vec<_>) = kinds.keys().copied().partition(|kind| Some(*kind) <= last);
    after.into_iter().chain(before).take(KINDS_MAX).collect()
}

/// Asks a node for the structures of a type, if there is time left.
fn ask(system: &mut System, node: NodeAddress, kind: Kind, until: Time) -> Option<SchemasReport> {
    let within = until.since(Time::now()).min(system.within);
    if within.is_zero() {
        return None;
    }
    let inspection = Tid::new(node, AppAddress::INSPECT);
    system.endpoint.message(inspection, &AskSchemas { kind }).ask(within).ok()
}

/// Returns the channels of a type: one for each application that sends it, if it or a receiver is shown. A structure
/// that is not known yet has none until the next look.
fn channels(report: &SchemasReport, kind: Kind, type_name: &str, shown: &Selection) -> Vec<Expected> {
    let mut all = Vec::new();
    for one in &report.schemas {
        let Some(schema) = one.schema.as_ref().and_then(|bytes| Schema::parse(bytes).ok()) else { continue };
        let is_received = one.handled_by.iter().any(|user| shown.has_app(&user.name));
        for user in one.sent_by.iter().filter(|user| is_received || shown.has_app(&user.name)) {
            all.push(channel(user, (kind, type_name), &schema));
        }
    }
    all
}

fn channel(user: &TypeUser, (kind, type_name): (Kind, &str), schema: &Schema) -> Expected {
    let TypeUser { tid, name } = user;
    let source = Party {
        tid: tid.bits(),
        text: tid.to_string(),
        name: Some(name.clone()),
        node: Some(tid.node.to_string()),
    };
    let mut channel = ViewWriter::expected(&ChannelInfo {
        source: &source,
        destination: &Party::default(),
        type_name,
        kind: kind.bits(),
        class: Class::default(),
        direction: Direction::default(),
        is_protected: false,
        schema: Some(schema),
        refused: None,
        seen_before: 0,
    });
    channel.metadata.retain(|key, _| KNOWN.contains(&key.as_str()));
    let is_named = kind == Kind::named(type_name);
    let origin = Origin { source: name.clone(), type_name: type_name.to_owned(), is_named, node: tid.node };
    Expected { channel, origin }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use sinew::{
        inspect::SchemaReport,
        schema::{Field, Shape},
    };

    use super::*;

    fn user(app: u32, name: &str) -> TypeUser {
        TypeUser { tid: Tid::new(NodeAddress::new(2), AppAddress::new(app)), name: name.to_owned() }
    }

    fn report() -> SchemasReport {
        let field = Field { name: "x".to_owned(), shape: Shape::F64, optional: false };
        let schema = Schema { root: Shape::Struct(vec![field]), types: BTreeMap::new() };
        let one = SchemaReport {
            hash: schema.hash(),
            schema: Some(schema.encode()),
            handled_by: vec![user(3, "knee")],
            sent_by: vec![user(1, "hip"), user(2, "ankle")],
        };
        SchemasReport { schemas: vec![one], ..SchemasReport::default() }
    }

    fn topics(shown: &[&str]) -> Vec<String> {
        let shown =
            Selection { apps: shown.iter().map(|name| (*name).to_owned()).collect(), ..Selection::default() };
        let all = channels(&report(), Kind::named("exo.angle"), "exo.angle", &shown);
        all.into_iter().map(|one| one.channel.topic).collect()
    }

    #[test]
    fn senders_of_a_type_have_topics_of_recordings() {
        assert_eq!(topics(&[]), ["/hip/exo.angle/view", "/ankle/exo.angle/view"]);
        assert_eq!(topics(&["hip"]), ["/hip/exo.angle/view"]);
        assert_eq!(topics(&["knee"]).len(), 2, "it receives from both");
        assert!(topics(&["arm"]).is_empty());
    }

    #[test]
    fn looks_ask_for_all_types_in_turn() {
        let count = KINDS_MAX as u32 + 2;
        let kinds: BTreeMap<_, _> = (0..count).map(|bits| (Kind::from_bits(bits), String::new())).collect();
        let first = next_kinds(&kinds, None);
        assert_eq!((first.len(), first[0]), (KINDS_MAX, Kind::from_bits(0)));
        let second = next_kinds(&kinds, first.last().copied());
        assert_eq!(second[..3], [count - 2, count - 1, 0].map(Kind::from_bits));
        assert_eq!(second.len(), KINDS_MAX);
        // And: few types are all asked for at each look
        let few: BTreeMap<_, _> = (0..3).map(|bits| (Kind::from_bits(bits), String::new())).collect();
        assert_eq!(next_kinds(&few, Some(Kind::from_bits(2))), [0, 1, 2].map(Kind::from_bits));
    }

    #[test]
    fn type_without_a_known_structure_is_not_offered() {
        let mut unknown = report();
        unknown.schemas[0].schema = None;
        assert!(channels(&unknown, Kind::named("exo.angle"), "exo.angle", &Selection::default()).is_empty());
    }

    #[test]
    fn expected_channel_has_no_metadata_of_its_messages() {
        let all = channels(&report(), Kind::named("exo.angle"), "exo.angle", &Selection::default());
        let Expected { channel, origin } = &all[0];
        assert_eq!((channel.encoding, channel.schema_name.as_str()), ("protobuf", "sinew.exo.Angle"));
        assert!(!channel.metadata.contains_key("sinew.class"), "{:?}", channel.metadata);
        assert_eq!(channel.metadata["sinew.source_name"], "hip");
        assert!(origin.is_named && origin.node == NodeAddress::new(2));
    }
}
