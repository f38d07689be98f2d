//! The triggers of recordings between nodes: payload of `Kind::SYNC_FREEZE`, a MessagePack map; `docs/protocol/sync.md`
//! lists its fields.

use std::{
    sync::{Arc, Weak},
    time::Duration,
};

use serde::{Deserialize, Serialize};
use sinew_model::leave_reason::LeaveReason;
use sinew_runtime::{
    lock,
    tid::{AppAddress, Incarnation, NodeAddress, Tid},
    time::Time,
    wire::{self, Header, Kind, Message},
};
use sinew_sync::FrameHandler;

use super::plan::{Trigger, TriggerId};
use crate::NodeState;

/// Maximum bytes of a frame: its numbers, and a cause of 200 bytes.
const BYTES_MAX: usize = 1_024;

/// Time to live of a frame. A node that has no connection for longer has lost the records, or is lost.
const LIVES: Duration = Duration::from_secs(30);

/// A trigger, with its time on the clock of the node that sends it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
struct Frame {
    /// The node that made the trigger.
    node: NodeAddress,
    incarnation: Incarnation,
    number: u32,
    /// The incarnation of the node that sends this.
    sender: Incarnation,
    at_ns: u64,
    bound_ns: u64,
    keep_ms: u32,
    after_ms: u32,
    cause: LeaveReason,
}

impl Frame {
    fn new(sender: Incarnation, trigger: &Trigger) -> Self {
        let Trigger { id: TriggerId { node, incarnation, number }, at_ns, bound_ns, .. } = *trigger;
        let millis = |time: Duration| u32::try_from(time.as_millis()).unwrap_or(u32::MAX);
        Self {
            node,
            incarnation,
            number,
            sender,
            at_ns,
            bound_ns,
            keep_ms: millis(trigger.keep),
            after_ms: millis(trigger.after),
            cause: trigger.cause.clone(),
        }
    }

    /// Returns the trigger with this time of this node's clock, and with its error.
    fn trigger(self, at: Time, bound: Option<Duration>) -> Trigger {
        let Self { node, incarnation, number, bound_ns, keep_ms, after_ms, cause, .. } = self;
        let further = bound.map_or(u64::MAX, |bound| u64::try_from(bound.as_nanos()).unwrap_or(u64::MAX));
        Trigger {
            id: TriggerId { node, incarnation, number },
            at_ns: at.as_nanos(),
            bound_ns: bound_ns.saturating_add(further),
            keep: Duration::from_millis(keep_ms.into()),
            after: Duration::from_millis(after_ms.into()),
            cause,
        }
    }
}

/// Sends a trigger to all present nodes but its own. One that cannot be sent is lost for that node, unless a third node
/// forwards it.
pub(super) fn forward(state: &NodeState, trigger: &Trigger) {
    let members = state.ctx.ports.members().map(|members| members.present()).unwrap_or_default();
    let payload = wire::encode(&Frame::new(state.ctx.incarnation, trigger));
    for member in members {
        if member.node == state.ctx.node || member.node == trigger.id.node {
            continue;
        }
        let source = Tid::new(state.ctx.node, AppAddress::SYNC);
        let mut header = Header::new(Kind::SYNC_FREEZE, source, Tid::new(member.node, AppAddress::SYNC));
        header.sequence = lock(&state.sync.core).next_sequence();
        header.sent = Time::now();
        // The frame has no outcome.
        let _ = header.set_time_to_live(LIVES);
        let _ = state.ctx.router.send(Message::new(header, payload.clone()));
    }
}

/// Receives the triggers of other nodes.
pub(crate) struct Triggers(pub(crate) Weak<NodeState>);

impl FrameHandler for Triggers {
    fn receive(&self, from: NodeAddress, message: &Message) -> Result<(), String> {
        let Some(state) = self.0.upgrade() else { return Ok(()) };
        receive(&state, from, message)
    }
}

fn receive(state: &Arc<NodeState>, from: NodeAddress, message: &Message) -> Result<(), String> {
    let bytes = message.payload.len();
    if bytes > BYTES_MAX {
        return Err(format!("from {from}, a trigger of {bytes} bytes; {BYTES_MAX} are read at most"));
    }
    let frame: Frame =
        wire::decode(&message.payload).map_err(|error| format!("from {from}, a trigger: {error}"))?;
    // A node without the recording from its start has nothing to freeze.
    let Some(flight) = state.recording.flight() else { return Ok(()) };
    let now = Time::now();
    let offset = state.ctx.clocks.get(from, frame.sender);
    let ours = offset.and_then(|offset| offset.in_our_clock(now, Time::from_nanos(frame.at_ns)));
    let trigger = match ours {
        Some((at, bound)) => frame.trigger(at, Some(bound)),
        // The clock of that node was not measured yet: it is at least the moment at which this node knows it.
        None => frame.trigger(now, None),
    };
    if flight.received(now, trigger) {
        Ok(())
    } else {
        Err(format!("from {from}, a trigger with wrong times, or behind too many others"))
    }
}

#[cfg(test)]
mod tests {
    use sinew_model::{
        clocks::{ClockDrift, ClockOffset},
        config::NodeConfig,
    };

    use super::*;

    const PEER: NodeAddress = NodeAddress::new(7);

    fn state(name: &str) -> Arc<NodeState> {
        let mut config = NodeConfig::new("knee");
        config.project = format!("triggers {name} {}", std::process::id());
        config.record.keep_bytes = 64 * 1024;
        let folder = std::env::temp_dir().join(format!("sinew-triggers-{name}-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        std::fs::set_permissions(&folder, std::os::unix::fs::PermissionsExt::from_mode(0o700)).unwrap();
        config.record.folder = Some(folder);
        NodeState::for_test(config, Incarnation(1))
    }

    fn message(frame: &Frame) -> Message {
        let header = Header::new(Kind::SYNC_FREEZE, Tid::NONE, Tid::NONE);
        Message::new(header, wire::encode(frame))
    }

    fn frame(at_ns: u64) -> Frame {
        Frame {
            node: PEER,
            incarnation: Incarnation(3),
            number: 1,
            sender: Incarnation(3),
            at_ns,
            bound_ns: 5,
            keep_ms: 30_000,
            after_ms: 1_000,
            cause: LeaveReason::of("the knee slips"),
        }
    }

    #[test]
    fn time_of_a_trigger_is_converted_with_its_error() {
        let state = state("converted");
        state.recording.begin_configured(&state).expect("it records");
        let now = Time::now();
        let (offset, bound) = (1_000_000_000_000, Duration::from_micros(40));
        let drift = ClockDrift { ppb: 0, bound_ppb: 0 };
        let measured = ClockOffset { theirs_minus_ours_ns: offset, bound, at: now, drift };
        state.ctx.clocks.set(PEER, Incarnation(3), measured);
        let theirs = now.as_nanos() + 1_000_000_000_000 - 500_000_000;
        receive(&state, PEER, &message(&frame(theirs))).expect("it is a trigger");
        let known = state.recording.flight().expect("it records").known();
        // Incidents of other tests of this process make triggers, too.
        let trigger = known.iter().find(|trigger| trigger.id.node == PEER).expect("it is known");
        assert!(trigger.at_ns.abs_diff(now.as_nanos() - 500_000_000) < 1_000_000, "{trigger:?}");
        assert!((40_000..10_000_000).contains(&trigger.bound_ns), "{trigger:?}");
        let folder = state.ctx.config.record.folder.clone().expect("it was set");
        state.recording.close(&state);
        std::fs::remove_dir_all(folder).unwrap();
    }

    #[test]
    fn longest_frame_is_short_and_wrong_ones_are_refused() {
        let state = state("wrong");
        let cause = LeaveReason::of(&"x".repeat(300));
        let longest = Frame { at_ns: u64::MAX, bound_ns: u64::MAX, cause, ..frame(0) };
        let bytes = wire::encode(&longest);
        assert!(bytes.len() <= BYTES_MAX && wire::decode::<Frame>(&bytes).unwrap() == longest);
        receive(&state, PEER, &message(&longest)).expect("a node that does not record ignores it");
        let wrong = Message::new(message(&longest).header, vec![0xc1; 10].into());
        assert!(receive(&state, PEER, &wrong).is_err());
        let long = Message::new(wrong.header, vec![0x80; BYTES_MAX + 1].into());
        assert!(receive(&state, PEER, &long).unwrap_err().contains("1024"));
        std::fs::remove_dir_all(state.ctx.config.record.folder.clone().expect("it was set")).unwrap();
    }
}
