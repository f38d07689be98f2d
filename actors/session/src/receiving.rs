//! The receiving half: accepts each number once, in order, from the latest connection.

use super::{Ack, FIRST, ReceivePosition, Window};

/// Received messages after which an ACK is sent, so that the sender need not keep them.
const ACK_EVERY: usize = 32;
/// Received bytes of frames after which an ACK is sent.
const ACK_EVERY_BYTES: usize = 64 << 10;

/// Unacknowledged messages at which an ACK is sent even while more frames have arrived.
const ACK_LATEST: usize = 128;
/// Bytes of unacknowledged frames at which it is sent then.
const ACK_LATEST_BYTES: usize = 256 << 10;
/// Divisor of the announced room that gives lower such bounds if the room is small. The sender has the rest of the room
/// while the ACK is on its way.
const LATEST_PART: usize = 8;

/// How to handle a numbered frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Arrival {
    /// The frame has the next number, and is counted. The caller forwards it. If `ack_is_due`, the caller
    /// sends an ACK now.
    Take {
        /// Whether an ACK is due now.
        ack_is_due: bool,
    },
    /// The frame arrived on a connection that has been replaced. The caller drops it; the peer sends it again
    /// on the newer connection.
    Fenced,
    /// The frame does not have the next number. The peer violates the protocol, and the connection must end.
    OutOfStep {
        /// The number that was due.
        expected: u64,
    },
}

/// The receive state of one node for the messages of another.
#[derive(Clone, Debug, Default, PartialEq, Eq, Hash)]
pub struct Receiving {
    /// The identity of this state, unique among all states for the same peer.
    receiver_id: u64,
    /// The latest connection.
    link: u64,
    /// Whether the peer has announced its epoch on this connection.
    has_epoch: bool,
    /// The peer's epoch; 0 before the first.
    epoch: u64,
    next: u64,
    /// Messages received and not acknowledged.
    unacknowledged: usize,
    unacknowledged_bytes: usize,
    /// The room last announced to the sender, if any.
    room: Option<Window>,
}

impl Receiving {
    /// Creates a state in which nothing was received. `receiver_id` is unique for the same two incarnations
    /// of nodes.
    pub fn new(receiver_id: u64) -> Self {
        Self { receiver_id, next: FIRST, ..Self::default() }
    }

    /// Accepts messages from the connection `link` from now on, and from no other.
    pub const fn attach(&mut self, link: u64) {
        self.link = link;
        self.has_epoch = false;
    }

    /// Returns the latest connection; 0 before the first.
    pub const fn link(&self) -> u64 {
        self.link
    }

    /// Returns whether this is the latest connection.
    pub const fn is_present(&self, link: u64) -> bool {
        link == self.link
    }

    /// Sets the peer's epoch. Returns whether the announcement is valid: received on the latest connection,
    /// and not of an older epoch.
    pub const fn on_epoch(&mut self, link: u64, epoch: u64) -> bool {
        if link != self.link || epoch < self.epoch {
            return false;
        }
        if epoch > self.epoch {
            self.epoch = epoch;
            self.next = FIRST;
        }
        self.has_epoch = true;
        true
    }

    /// Processes a frame of `bytes` received on `link`, with the lower 16 bits of its number. spec: SESSION-4
    #[inline]
    pub fn arrive(&mut self, link: u64, number: u16, bytes: usize) -> Arrival {
        if link != self.link {
            return Arrival::Fenced;
        }
        if !self.has_epoch || number != self.next as u16 {
            return Arrival::OutOfStep { expected: self.next };
        }
        self.next += 1;
        self.unacknowledged += 1;
        self.unacknowledged_bytes += bytes;
        Arrival::Take { ack_is_due: self.reaches(self.due()) }
    }

    /// Returns the unacknowledged messages after which an ACK is due.
    fn due(&self) -> Window {
        let every = Window { messages: ACK_EVERY, bytes: ACK_EVERY_BYTES };
        // A sender with little room must get an ACK before it has used all of it.
        self.room.map_or(every, |Window { messages, bytes }| Window {
            messages: every.messages.min(messages / 2),
            bytes: every.bytes.min(bytes / 2),
        })
    }

    /// Whether a due ACK must be sent even while more messages have arrived already. Until then it can wait for
    /// them. A sender that has no room left sends nothing more: the reader then finds no more bytes, and sends it.
    pub fn is_ack_overdue(&self) -> bool {
        let (due, room) = (self.due(), self.room.unwrap_or_default());
        self.reaches(Window {
            messages: due.messages.max(ACK_LATEST.min(room.messages / LATEST_PART)),
            bytes: due.bytes.max(ACK_LATEST_BYTES.min(room.bytes / LATEST_PART)),
        })
    }

    const fn reaches(&self, Window { messages, bytes }: Window) -> bool {
        self.unacknowledged >= messages || self.unacknowledged_bytes >= bytes
    }

    /// Whether the sender must be notified of `room` at once. It must be at least twice the room announced
    /// before, in messages or in bytes. spec: CREDIT-5
    pub fn must_announce_room(&self, room: Window) -> bool {
        let has_grown = |announced: usize, now: usize| now > announced && now >= announced.saturating_mul(2);
        self.room.is_some_and(|announced| {
            has_grown(announced.messages, room.messages) || has_grown(announced.bytes, room.bytes)
        })
    }

    /// Whether received messages are not acknowledged yet.
    pub const fn has_unacknowledged(&self) -> bool {
        self.unacknowledged > 0
    }

    /// Returns the position for an audit.
    pub const fn position(&self) -> ReceivePosition {
        ReceivePosition { receiver_id: self.receiver_id, epoch: self.epoch, next: self.next }
    }

    /// Creates the ACK to send now. `epoch` is that of the opposite direction. A `room` of `None` sets no
    /// limit.
    pub fn ack(&mut self, epoch: u64, room: Option<Window>) -> Ack {
        self.unacknowledged = 0;
        self.unacknowledged_bytes = 0;
        self.room = room;
        let room = room.map(|room| (room.messages as u64, room.bytes as u64));
        let held = Vec::new();
        Ack {
            receiver_id: self.receiver_id,
            epoch,
            peer_epoch: self.epoch,
            next: self.next,
            change: 0,
            held,
            room,
        }
    }
}
