//! The names and structures for the readers of a journal.

use std::{collections::BTreeSet, path::Path};

use sinew_lncl::undelivered::kind_name;
use sinew_model::{
    barrier::{ArriveAtBarrier, BarrierAnswer, LeaveBarrier},
    directory::DirectoryEntry,
    ping::Ping,
};
use sinew_record::{Channel, RecordReport, RecordedApp, RecordedType};
use sinew_runtime::{
    lock, own_types,
    tid::Tid,
    time::Time,
    wire::{Kind, PayloadType, known_types},
};
use sinew_shm::journal::{JournalReader, Start};

use super::{facts::clocks, wall_offset};
use crate::NodeState;

/// Maximum number of payload types with a structure beside a journal. A reader without a node cannot ask for more.
const READER_SCHEMAS_MAX: usize = 256;
/// Maximum bytes of these structures: the names have room in the same file, of 4 MiB.
const READER_SCHEMA_BYTES_MAX: usize = 1 << 20;

/// Records the payload types of Sinew that messages of applications have. A node that only receives them would not know
/// their names.
pub(super) fn remember_own_types() {
    own_types::remember_own_types();
    // A full table shows their IDs.
    let _ = PayloadType::of::<Ping>();
    let _ = (PayloadType::of::<ArriveAtBarrier>(), PayloadType::of::<LeaveBarrier>());
    let _ = PayloadType::of::<BarrierAnswer>();
}

/// Returns the names and structures for a reader of the journal at this path, which may have no node to ask.
pub(super) fn names_for_reader(state: &NodeState, path: &Path) -> RecordReport {
    let kinds = journal_kinds(path);
    for_reader(report(state, path, &kinds, &kinds[..kinds.len().min(READER_SCHEMAS_MAX)]))
}

/// Leaves out all for which a reader has no room.
fn for_reader(mut report: RecordReport) -> RecordReport {
    bound_schemas(&mut report.types, READER_SCHEMA_BYTES_MAX);
    // A reader accepts no longer lists.
    report.bounded()
}

/// Leaves out each structure that has no room behind those before it.
fn bound_schemas(types: &mut [RecordedType], bytes_max: usize) {
    let mut left = bytes_max;
    for RecordedType { schema, .. } in types {
        match left.checked_sub(schema.as_ref().map_or(0, Vec::len)) {
            Some(rest) => left = rest,
            None => *schema = None,
        }
    }
}

/// Returns the names for a reader of the journal at this path, and the structures of these types.
pub(crate) fn report(state: &NodeState, path: &Path, journal: &[Kind], schemas: &[Kind]) -> RecordReport {
    let directory = directory(state);
    let handled = directory.iter().flat_map(|entry| entry.kinds.iter().copied());
    let others = handled.chain(journal.iter().copied()).chain(known_types().map(|(kind, _)| kind));
    let (mut listed, mut types) = (BTreeSet::new(), Vec::new());
    // Entries that do not fit are left out from the end: the structures stand first.
    let asked = schemas.iter().map(|kind| (*kind, true));
    for (kind, is_asked) in asked.chain(others.map(|kind| (kind, false))) {
        if listed.insert(kind)
            && let Some(name) = kind_name(&state.lncl, kind)
        {
            types.push(RecordedType {
                kind,
                name,
                schema: is_asked.then(|| state.types.schema_of(kind)).flatten(),
            });
        }
    }
    let now = Time::now();
    RecordReport {
        path: Some(path.display().to_string()),
        node: Some(state.ctx.node),
        name: state.ctx.config.name.clone(),
        incarnation: Some(state.ctx.incarnation),
        wall_offset_ns: wall_offset(),
        apps: named_apps(state, directory).map(|(name, tid)| RecordedApp { tid, name }).collect(),
        types,
        clocks: clocks(state, now),
        ..RecordReport::default()
    }
}

/// Returns the named applications of all nodes.
pub(super) fn directory(state: &NodeState) -> Vec<DirectoryEntry> {
    state.ctx.ports.names().map(|names| names.directory()).unwrap_or_default()
}

/// Returns the named applications of this node and those of other nodes in the directory. The directory learns of a new
/// application of this node a moment later than LNCL, and the application may have sent a message by then.
pub(super) fn named_apps(
    state: &NodeState,
    directory: Vec<DirectoryEntry>,
) -> impl Iterator<Item = (String, Tid)> + use<> {
    let node = state.ctx.node;
    let own: Vec<_> = lock(&state.lncl.registry)
        .named()
        .map(|(name, app)| (name.to_owned(), Tid::new(node, app)))
        .collect();
    let others = directory.into_iter().filter(move |entry| entry.tid.node != node);
    own.into_iter().chain(others.map(|entry| (entry.name, entry.tid)))
}

/// Returns the types of the channels in a journal, among them those that their receivers do not declare.
pub(crate) fn journal_kinds(path: &Path) -> Vec<Kind> {
    let channels = JournalReader::open(path, Start::Newest).and_then(|reader| reader.channels());
    let kinds =
        channels.unwrap_or_default().into_iter().filter_map(|channel| Some(Channel::of(channel.key?)?.kind));
    kinds.collect::<BTreeSet<_>>().into_iter().collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use sinew_record::{FrozenFacts, RECORDED_MAX};
    use sinew_runtime::wire;

    #[test]
    fn facts_of_many_applications_can_be_read() {
        let app = |number: usize| RecordedApp {
            tid: Tid::from_bits(number as u64),
            name: format!("finger-{number}"),
        };
        let report = RecordReport { apps: (0..=RECORDED_MAX).map(app).collect(), ..RecordReport::default() };
        let read = |report| wire::decode::<FrozenFacts>(&wire::encode(&FrozenFacts { span: None, report }));
        assert!(read(report.clone()).is_err(), "a reader refuses a longer list");
        let facts = read(for_reader(report)).unwrap();
        assert_eq!((facts.report.apps.len(), facts.report.apps_left_out), (RECORDED_MAX, 1));
    }

    #[test]
    fn structures_beside_a_journal_are_bounded_in_bytes() {
        let one = |bytes: Option<usize>| RecordedType {
            kind: Kind::from_bits(7),
            name: "test.angle".to_owned(),
            schema: bytes.map(|bytes| vec![7; bytes]),
        };
        let mut types = [Some(60), None, Some(50), Some(40)].map(one);
        bound_schemas(&mut types, 100);
        let lengths = types.map(|one| one.schema.map(|schema| schema.len()));
        assert_eq!(lengths, [Some(60), None, None, Some(40)]);
    }
}
