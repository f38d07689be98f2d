//! Freezes a span for a program, and hands out frozen spans. spec: INSPECT-10

use std::{path::Path, sync::Arc};

use sinew_runtime::{outcome::Rejection, time::Time, wire::Message};

use super::{
    access,
    reports::{AskFreeze, AskFrozen, FROZEN_BUSY, FROZEN_BYTES_MAX, FreezeReport, FrozenReport},
};
use crate::NodeState;

/// The reason of a refusal for a node without the recording from its start.
const NOT_RECORDED: &str =
    "this node keeps no recording: set record.folder in its configuration, as in \"/dev/shm\"";

/// Freezes the messages around this moment, on all nodes.
pub(super) fn triggered(state: &Arc<NodeState>, question: &Message) -> Result<FreezeReport, Rejection> {
    let AskFreeze { reason } = question.decode().map_err(|_| Rejection::Malformed)?;
    let refused = |why: &str| Ok(FreezeReport { refused: Some(why.to_owned()), ..FreezeReport::default() });
    let program = question.header.source;
    if program.node != state.ctx.node || !access::is_of_the_nodes_user(state, program.app) {
        return refused("a node freezes for programs of its own host and user, and of root, only");
    }
    let Some(flight) = state.recording.flight() else { return refused(NOT_RECORDED) };
    let reason = if reason.trim().is_empty() { "it was asked for" } else { &reason };
    let Some(id) = flight.happened(Time::now(), reason) else {
        return refused("too many triggers are known: try again in some seconds");
    };
    let after_ms = u64::try_from(state.ctx.config.record.after.as_millis()).unwrap_or(u64::MAX);
    Ok(FreezeReport { id: Some(id.to_string()), after_ms, refused: None })
}

/// Lists the frozen spans, or returns bytes of one.
pub(super) fn fetched(state: &Arc<NodeState>, question: &Message) -> Result<FrozenReport, Rejection> {
    let AskFrozen { id, part, offset, is_fetched } = question.decode().map_err(|_| Rejection::Malformed)?;
    let own = FrozenReport {
        node: Some(state.ctx.node),
        name: state.ctx.config.name.clone(),
        ..FrozenReport::default()
    };
    let program = question.header.source;
    // A program of another node is no guest there: that node would not have sent its question.
    if program.node == state.ctx.node && !access::is_of_the_nodes_user(state, program.app) {
        let why = "frozen spans are handed to programs of their node's own user and of root only".to_owned();
        return Ok(FrozenReport { refused: Some(why), ..own });
    }
    let Some(flight) = state.recording.flight() else {
        return Ok(FrozenReport { refused: Some(NOT_RECORDED.to_owned()), ..own });
    };
    let text = |folder: &Path| Some(folder.display().to_string());
    let frozen_folder = state.ctx.config.record.frozen_folder.as_deref().unwrap_or_else(|| flight.folder());
    let own = FrozenReport { folder: text(flight.folder()), frozen_folder: text(frozen_folder), ..own };
    // A disk may be slow, and this thread answers other questions.
    let Some(mut store) = flight.try_store() else {
        return Ok(FrozenReport { refused: Some(FROZEN_BUSY.to_owned()), ..own });
    };
    let Some(id) = id else { return Ok(FrozenReport { spans: store.spans(), ..own }) };
    let answer = if is_fetched {
        store.set_fetched(&id).map(|()| (Vec::new(), 0))
    } else {
        let bytes_max = FROZEN_BYTES_MAX.min(state.ctx.config.payload_max / 2);
        store.read(&id, part, offset, bytes_max)
    };
    Ok(match answer {
        Ok((bytes, length)) => FrozenReport { bytes, length, ..own },
        Err(why) => FrozenReport { refused: Some(why.to_string()), ..own },
    })
}

#[cfg(test)]
mod tests {
    use sinew_model::{config::NodeConfig, guest_quotas::OF_OWN_USERS};
    use sinew_runtime::{
        tid::{Incarnation, NodeAddress, Tid},
        wire::Payload,
    };

    use super::*;

    fn state(edit: impl FnOnce(&mut NodeConfig)) -> Arc<NodeState> {
        let mut config = NodeConfig::new("knee");
        config.project = format!("frozen {}", std::process::id());
        config.record.keep_bytes = 64 * 1024;
        edit(&mut config);
        NodeState::for_test(config, Incarnation(1))
    }

    // spec: INSPECT-10
    #[test]
    fn questions_about_spans_are_not_sent_for_guests() {
        assert!(OF_OWN_USERS.contains(&AskFrozen::KIND) && OF_OWN_USERS.contains(&AskFreeze::KIND));
    }

    // spec: INSPECT-10
    #[test]
    fn only_programs_of_the_host_freeze() {
        let state = state(|_| {});
        let elsewhere = Tid::new(NodeAddress::new(9), sinew_runtime::tid::AppAddress::new(0x1001));
        let question = Message::typed(elsewhere, Tid::NONE, &AskFreeze::default());
        let refused = triggered(&state, &question).expect("it is a question").refused.expect("it is refused");
        assert!(refused.contains("own host"), "{refused}");
        // A program of another node may read, and this node has nothing.
        let question = Message::typed(elsewhere, Tid::NONE, &AskFrozen::default());
        let refused = fetched(&state, &question).expect("it is a question").refused.expect("it is refused");
        assert!(refused.contains("record.folder"), "{refused}");
    }
}
