//! The receiving half: takes each number once, in order, from the latest connection.

use super::{Ack, Came, FIRST, Window};

/// Messages after which the sender is told, so that it need not keep them.
const ACK_EVERY: usize = 32;
/// Bytes of frames after which it is told.
const ACK_EVERY_BYTES: usize = 64 << 10;

/// What is to be done with a numbered frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Arrival {
    /// It is the next one, and counted: hand it on. If `ack_is_due`, tell the sender now.
    Take { ack_is_due: bool },
    /// It came on a connection that another one has followed: drop it, it comes again there.
    Fenced,
    /// It is not the next one: the peer is at fault, and the connection must end.
    OutOfStep { expected: u64 },
}

/// What one node has taken of another's messages.
#[derive(Clone, Debug, Default, PartialEq, Eq, Hash)]
pub(crate) struct Receiving {
    /// No other memory of the same peer, before or after, has this number.
    memory: u64,
    /// The latest connection.
    link: u64,
    /// Whether the peer has said on it in which epoch it counts.
    knows_epoch: bool,
    /// Epoch of the peer; 0 before the first.
    epoch: u64,
    next: u64,
    /// Taken, and not acknowledged.
    unsaid: usize,
    unsaid_bytes: usize,
    /// The room that the sender was told last, if it was.
    room: Option<Window>,
}

impl Receiving {
    /// Nothing has come yet. `memory` is a number that no other one had for the same two lives of nodes.
    pub(crate) fn new(memory: u64) -> Self {
        Self { memory, next: FIRST, ..Self::default() }
    }

    /// Messages come on the connection `link` from now on, and on no other.
    pub(crate) const fn attach(&mut self, link: u64) {
        self.link = link;
        self.knows_epoch = false;
    }

    /// The latest connection; 0 before the first.
    pub(crate) const fn link(&self) -> u64 {
        self.link
    }

    /// Whether this is the latest connection.
    pub(crate) const fn is_present(&self, link: u64) -> bool {
        link == self.link
    }

    /// The peer counts in `epoch`. Returns whether this came on the latest connection, and so counts.
    pub(crate) const fn heard(&mut self, link: u64, epoch: u64) -> bool {
        if link != self.link || epoch < self.epoch {
            return false;
        }
        if epoch > self.epoch {
            self.epoch = epoch;
            self.next = FIRST;
        }
        self.knows_epoch = true;
        true
    }

    /// A frame of `bytes` came on `link` with the lower 16 bits of its number. spec: SESSION-4
    pub(crate) fn arrive(&mut self, link: u64, number: u16, bytes: usize) -> Arrival {
        if link != self.link {
            return Arrival::Fenced;
        }
        if !self.knows_epoch || number != self.next as u16 {
            return Arrival::OutOfStep { expected: self.next };
        }
        self.next += 1;
        self.unsaid += 1;
        self.unsaid_bytes += bytes;
        // Whoever has little room must not wait for the rest of it.
        let (messages, bytes) = self.room.map_or((ACK_EVERY, ACK_EVERY_BYTES), |room| {
            (ACK_EVERY.min(room.messages / 2), ACK_EVERY_BYTES.min(room.bytes / 2))
        });
        Arrival::Take { ack_is_due: self.unsaid >= messages || self.unsaid_bytes >= bytes }
    }

    /// Whether the sender is to be told at once that there is `room`: twice what it knows of, where that is less than all. spec: CREDIT-5
    pub(crate) fn owes_room(&self, room: Window) -> bool {
        let has_grown = |told: usize, now: usize| now > told && now >= told.saturating_mul(2);
        self.room
            .is_some_and(|told| has_grown(told.messages, room.messages) || has_grown(told.bytes, room.bytes))
    }

    /// Whether something was taken that the sender has not been told.
    pub(crate) const fn owes_ack(&self) -> bool {
        self.unsaid > 0
    }

    /// What was taken, for an audit.
    pub(crate) const fn position(&self) -> Came {
        Came { memory: self.memory, epoch: self.epoch, next: self.next }
    }

    /// What the sender is told now; `epoch` is that of what goes the other way. `None`: as much as it likes.
    pub(crate) fn ack(&mut self, epoch: u64, room: Option<Window>) -> Ack {
        self.unsaid = 0;
        self.unsaid_bytes = 0;
        self.room = room;
        let room = room.map(|room| (room.messages as u64, room.bytes as u64));
        let held = Vec::new();
        Ack { memory: self.memory, epoch, of: self.epoch, next: self.next, change: 0, held, room }
    }
}
