//! The state of the stop between nodes: payload of `STOP_STATE`, a MessagePack map; `docs/protocol/stop.md` lists
//! its fields.

use serde::{Deserialize, Serialize};
use sinew_runtime::{
    stop::StopState,
    tid::{Incarnation, NodeAddress, Tid},
    wire::{Message, decode},
};

/// Maximum number of origins in a frame: those that a node keeps, and its own.
pub(super) const ENTRIES_MAX: usize = 128;
/// Maximum number of nodes of senders in a frame; of a node with more, no bound is known.
pub(super) const SOURCES_MAX: usize = 64;
/// Maximum bytes of a reason.
const REASON_BYTES_MAX: usize = 200;
/// Highest number of a press. Far above what a node counts in its life, and far below the end of the type: a wrong
/// number of another node leaves room for later presses of its origin.
const PRESSED_MAX: u32 = u32::MAX / 2;
/// Maximum bytes of a frame: each origin with its numbers and a reason of 200 bytes.
const BYTES_MAX: usize = 64 * 1024;

/// The presses of one incarnation of a node. spec: STOP-1
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub(super) struct Origin {
    pub(super) node: NodeAddress,
    pub(super) incarnation: Incarnation,
}

/// The presses and releases of one origin, as a node knows them.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Entry {
    pub(super) origin: Origin,
    /// The highest number that was pressed.
    pub(super) pressed: u32,
    /// The application that pressed it.
    pub(super) by: Tid,
    /// At most 200 bytes.
    pub(super) reason: String,
    /// The highest number that was released; 0 for none.
    pub(super) released: u32,
    /// The application that released it; of no meaning without a release.
    pub(super) released_by: Tid,
}

impl Entry {
    /// Returns whether a press is not released.
    pub(super) const fn is_open(&self) -> bool {
        self.pressed > self.released
    }

    /// Returns whether a node can have written it.
    pub(super) fn is_legal(&self) -> bool {
        (1..=PRESSED_MAX).contains(&self.pressed)
            && self.released <= self.pressed
            && self.reason.len() <= REASON_BYTES_MAX
    }
}

/// The state of one node.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Frame {
    /// The incarnation that sends it.
    pub(super) sender: Incarnation,
    pub(super) state: StopState,
    pub(super) entries: Vec<Entry>,
    /// Whether its outputs are safe by this stop. spec: STOP-5
    pub(super) is_safe: bool,
    /// Time from its knowledge of the newest press until its outputs were safe, in microseconds.
    pub(super) safe_us: u64,
    /// Number of outputs in its process.
    pub(super) outputs: u32,
    /// Time after which they are safe without commands, in microseconds.
    pub(super) watchdog_us: u64,
    /// The nodes of the senders of their commands.
    pub(super) sources: Vec<NodeAddress>,
    /// Time within which it presses by itself after it has lost a node, in microseconds; `None`: it does not.
    pub(super) on_lost_us: Option<u64>,
    /// Whether the sender waits for a state of the reader.
    pub(super) wants_state: bool,
}

impl Frame {
    /// Reads a frame.
    ///
    /// # Errors
    /// Returns a description of the fault: bytes, numbers or lists beyond their limits.
    pub(super) fn of(message: &Message) -> Result<Self, String> {
        let bytes = message.payload.len();
        if bytes > BYTES_MAX {
            return Err(format!("a state of the stop of {bytes} bytes; {BYTES_MAX} are read at most"));
        }
        let frame: Self =
            decode(&message.payload).map_err(|error| format!("a state of the stop: {error}"))?;
        // One more than is kept: that of the sender itself.
        if frame.entries.len() > ENTRIES_MAX + 1 || frame.sources.len() > SOURCES_MAX {
            return Err("a state of the stop with too many entries".to_owned());
        }
        if !frame.entries.iter().all(Entry::is_legal) {
            return Err(
                "a state of the stop with a long reason, a number beyond its limit, or that releases more than was pressed"
                    .to_owned(),
            );
        }
        Ok(frame)
    }
}

#[cfg(test)]
mod tests {
    use sinew_runtime::wire::{Header, Kind, encode};

    use super::*;

    fn entry(pressed: u32, released: u32) -> Entry {
        let origin = Origin { node: NodeAddress::new(7), incarnation: Incarnation(u64::MAX) };
        let reason = "x".repeat(REASON_BYTES_MAX);
        Entry { origin, pressed, by: Tid::NONE, reason, released, released_by: Tid::NONE }
    }

    fn message(entries: Vec<Entry>) -> Message {
        let frame = Frame {
            sender: Incarnation(u64::MAX),
            state: StopState::Stopped,
            entries,
            is_safe: true,
            safe_us: u64::MAX,
            outputs: u32::MAX,
            watchdog_us: u64::MAX,
            sources: vec![NodeAddress::new(7); SOURCES_MAX],
            on_lost_us: Some(u64::MAX),
            wants_state: true,
        };
        Message::new(Header::new(Kind::STOP_STATE, Tid::NONE, Tid::NONE), encode(&frame))
    }

    #[test]
    fn longest_frame_is_read() {
        let message = message(vec![entry(PRESSED_MAX, PRESSED_MAX); ENTRIES_MAX + 1]);
        assert!(message.payload.len() <= BYTES_MAX, "{}", message.payload.len());
        assert_eq!(Frame::of(&message).expect("it is legal").entries.len(), ENTRIES_MAX + 1);
    }

    #[test]
    fn illegal_frames_are_refused() {
        let illegal = [entry(1, 2), entry(0, 0), entry(PRESSED_MAX + 1, 0)].map(|entry| vec![entry]);
        for entries in illegal.into_iter().chain([vec![entry(1, 0); ENTRIES_MAX + 2]]) {
            assert!(Frame::of(&message(entries)).is_err());
        }
        let header = Header::new(Kind::STOP_STATE, Tid::NONE, Tid::NONE);
        assert!(Frame::of(&Message::new(header, vec![0xc1; 9].into())).is_err());
        assert!(Frame::of(&Message::new(header, vec![0x80; BYTES_MAX + 1].into())).is_err());
    }
}
