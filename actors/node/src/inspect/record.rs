//! Starts, renews and ends the recording of a program, and names what is in the journal. spec: INSPECT-9

use std::{collections::BTreeSet, path::Path, sync::Arc};

use sinew_lncl::undelivered::kind_name;
use sinew_record::Channel;
use sinew_runtime::{
    outcome::Rejection,
    time::Time,
    wire::{Kind, Message, known_types},
};
use sinew_shm::journal::{JournalReader, Start};

use super::{
    access,
    reports::{AskRecord, RecordReport, RecordedApp, RecordedType, bounded},
};
use crate::{NodeState, recording};

/// Maximum number of payload types with a structure beside a journal. A reader without a node cannot ask for more.
const READER_SCHEMAS_MAX: usize = 256;
/// Maximum bytes of these structures: the names have room in the same file, of 4 MiB.
const READER_SCHEMA_BYTES_MAX: usize = 1 << 20;

/// Answers the question of a program that records.
pub(crate) fn recorded(state: &Arc<NodeState>, question: &Message) -> Result<RecordReport, Rejection> {
    let AskRecord { selection, ends, schemas } = question.decode().map_err(|_| Rejection::Malformed)?;
    let program = question.header.source;
    if program.node != state.ctx.node || !access::is_of_the_nodes_user(state, program.app) {
        let why = "a node records for programs of its own host and user, and of root, only: run `sinew record` there";
        return Ok(refused(why.to_owned()));
    }
    if ends {
        state.recording.leave(state, program);
        return Ok(RecordReport::default());
    }
    if let Err(why) = selection.check() {
        return Ok(refused(why.to_string()));
    }
    match state.recording.ask(state, program, selection, Time::now()) {
        Ok(path) => Ok(report(state, &path, &journal_kinds(&path), &schemas)),
        Err(why) => Ok(refused(why.to_string())),
    }
}

fn refused(why: String) -> RecordReport {
    RecordReport { refused: Some(why), ..RecordReport::default() }
}

/// Returns the names and structures for a reader of the journal at this path, which may have no node to ask.
pub(crate) fn names_for_reader(state: &NodeState, path: &Path) -> RecordReport {
    let kinds = journal_kinds(path);
    let mut report = report(state, path, &kinds, &kinds[..kinds.len().min(READER_SCHEMAS_MAX)]);
    bound_schemas(&mut report.types, READER_SCHEMA_BYTES_MAX);
    report
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

fn report(state: &NodeState, path: &Path, journal: &[Kind], schemas: &[Kind]) -> RecordReport {
    let directory = state.ctx.ports.names().map(|names| names.directory()).unwrap_or_default();
    let handled = directory.iter().flat_map(|entry| entry.kinds.iter().copied());
    let others = handled.chain(journal.iter().copied()).chain(known_types().map(|(kind, _)| kind));
    let (mut listed, mut types) = (BTreeSet::new(), Vec::new());
    // Entries that do not fit are left out from the end: the structures stand first.
    let asked = schemas.iter().map(|kind| (*kind, true));
    for (kind, is_asked) in asked.chain(others.map(|kind| (kind, false))) {
        if listed.insert(kind)
            && let Some(name) = kind_name(&state.lncl, kind)
        {
            types.push(RecordedType { kind, name, schema: is_asked.then(|| schema(kind)).flatten() });
        }
    }
    let now = Time::now();
    bounded(RecordReport {
        path: Some(path.display().to_string()),
        node: Some(state.ctx.node),
        name: state.ctx.config.name.clone(),
        incarnation: Some(state.ctx.incarnation),
        wall_offset_ns: recording::wall_offset(),
        apps: directory.into_iter().map(|entry| RecordedApp { tid: entry.tid, name: entry.name }).collect(),
        types,
        clocks: recording::clocks(state, now),
        ..RecordReport::default()
    })
}

/// Returns the types of the channels in a journal, among them those that their receivers do not declare.
fn journal_kinds(path: &Path) -> Vec<Kind> {
    let channels = JournalReader::open(path, Start::Newest).and_then(|reader| reader.channels());
    let kinds =
        channels.unwrap_or_default().into_iter().filter_map(|channel| Some(Channel::of(channel.key?)?.kind));
    kinds.collect::<BTreeSet<_>>().into_iter().collect()
}

/// Returns the structure of a type that this process sends or handles. The first call for a type takes up to some
/// milliseconds.
fn schema(kind: Kind) -> Option<Vec<u8>> {
    let traced = kind.schema()?.ok()?;
    Some(traced.schema().encode())
}

#[cfg(test)]
mod tests {
    use super::*;

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
