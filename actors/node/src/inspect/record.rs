//! Starts, renews and ends the recording of a program, and names what is in the journal. spec: INSPECT-9

use std::{collections::BTreeMap, path::Path, sync::Arc};

use sinew_lncl::undelivered::kind_name;
use sinew_record::Channel;
use sinew_runtime::{outcome::Rejection, time::Time, wire::Message};
use sinew_shm::journal::{JournalReader, Start};

use super::{
    access,
    reports::{AskRecord, RecordReport, RecordedApp, RecordedType},
};
use crate::{NodeState, recording};

/// Answers the question of a program that records.
pub(crate) fn recorded(state: &Arc<NodeState>, question: &Message) -> Result<RecordReport, Rejection> {
    let AskRecord { selection, ends } = question.decode().map_err(|_| Rejection::Malformed)?;
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
        Ok(path) => Ok(report(state, &path)),
        Err(why) => Ok(refused(why.to_string())),
    }
}

fn refused(why: String) -> RecordReport {
    RecordReport { refused: Some(why), ..RecordReport::default() }
}

/// Returns the names for the reader of the journal at this path.
pub(crate) fn report(state: &NodeState, path: &Path) -> RecordReport {
    let directory = state.ctx.ports.names().map(|names| names.directory()).unwrap_or_default();
    let mut kinds: BTreeMap<_, _> = BTreeMap::new();
    let handled = directory.iter().flat_map(|entry| entry.kinds.iter().copied());
    // The table of the journal has the types that were sent to applications that do not declare them.
    let channels = JournalReader::open(path, Start::Newest).and_then(|reader| reader.channels());
    let channels = channels.unwrap_or_default().into_iter().filter_map(|channel| Channel::of(channel.key?));
    for kind in handled.chain(channels.map(|channel| channel.kind)) {
        kinds.entry(kind).or_insert_with(|| kind_name(&state.lncl, kind));
    }
    let named = |(kind, name): (_, Option<String>)| Some(RecordedType { kind, name: name? });
    let now = Time::now();
    RecordReport {
        path: Some(path.display().to_string()),
        node: Some(state.ctx.node),
        name: state.ctx.config.name.clone(),
        incarnation: Some(state.ctx.incarnation),
        wall_offset_ns: recording::wall_offset(),
        apps: directory.into_iter().map(|entry| RecordedApp { tid: entry.tid, name: entry.name }).collect(),
        types: kinds.into_iter().filter_map(named).collect(),
        clocks: recording::clocks(state, now),
        ..RecordReport::default()
    }
    .bounded()
}
