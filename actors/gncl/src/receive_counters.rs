//! Dispositions of the messages that a peer's session delivered: each is counted once, and ends once, even if
//! a handler panics.

/// The final disposition of a message from a peer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Disposition {
    /// A void, in place of a message that was not needed any more.
    Void,
    /// A mailbox or a client's queue of this node has the message, and counts it from here on.
    Forwarded,
    /// The message was consumed here: by a layer, by a group after its members got copies, or by a waiter for an
    /// outcome or a reply.
    Consumed,
    Expired,
    /// No receiver accepted it, or it was not allowed.
    Refused,
    /// Its handler panicked.
    Failed,
    /// A newer value had arrived before it, by datagram.
    Superseded,
}

/// Counters of one session.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct ReceiveCounters {
    received: u64,
    /// Messages that have neither ended nor wait in a queue.
    in_process: u64,
    dispositions: [u64; 7],
}

impl ReceiveCounters {
    /// Counts a new message, which is in process.
    pub(super) const fn start(&mut self) {
        self.received += 1;
        self.in_process += 1;
    }

    /// Uncounts a message that had arrived before.
    pub(super) const fn cancel_duplicate(&mut self) {
        self.received = self.received.saturating_sub(1);
        self.suspend();
    }

    /// Counts a message that waited for its application as in process again.
    pub(super) const fn resume(&mut self) {
        self.in_process += 1;
    }

    /// Counts a message in process as waiting for its application.
    pub(super) const fn suspend(&mut self) {
        self.in_process = self.in_process.saturating_sub(1);
    }

    /// Counts a message in process as ended.
    pub(super) const fn finish(&mut self, disposition: Disposition) {
        self.suspend();
        self.dispositions[disposition as usize] += 1;
    }

    /// Returns the number of received messages, without voids.
    pub(super) const fn received(&self) -> u64 {
        self.received.saturating_sub(self.count(Disposition::Void))
    }

    /// Returns the number of messages with this disposition.
    pub(super) const fn count(&self, disposition: Disposition) -> u64 {
        self.dispositions[disposition as usize]
    }

    /// Returns the number of messages in process.
    pub(super) const fn in_process(&self) -> u64 {
        self.in_process
    }
}
