//! Starts, renews and ends the recording of a program, and names what is in the journal. spec: INSPECT-9

use std::sync::Arc;

use sinew_runtime::{outcome::Rejection, time::Time, wire::Message};

use super::{
    access,
    reports::{AskRecord, RecordReport},
};
use crate::{NodeState, recording};

/// Answers the question of a program that records.
pub(crate) fn recorded(state: &Arc<NodeState>, question: &Message) -> Result<RecordReport, Rejection> {
    let AskRecord { selection, ends, schemas, counts } =
        question.decode().map_err(|_| Rejection::Malformed)?;
    let program = question.header.source;
    if program.node != state.ctx.node || !access::is_of_the_nodes_user(state, program.app) {
        let why = "a node records for programs of its own host and user, and of root, only: run `sinew record` there";
        return Ok(refused(why.to_owned()));
    }
    if let Some(counts) = counts {
        state.recording.note_counts(program, counts);
    }
    if ends {
        state.recording.leave(state, program);
        return Ok(RecordReport::default());
    }
    if let Err(why) = selection.check() {
        return Ok(refused(why.to_string()));
    }
    match state.recording.ask(state, program, selection, Time::now()) {
        Ok(path) => {
            let journal = recording::journal_kinds(&path);
            Ok(recording::report(state, &path, &journal, &schemas).bounded())
        }
        Err(why) => Ok(refused(why.to_string())),
    }
}

fn refused(why: String) -> RecordReport {
    RecordReport { refused: Some(why), ..RecordReport::default() }
}
