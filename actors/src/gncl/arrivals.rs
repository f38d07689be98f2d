//! What became of the messages that a peer's session brought: each is counted in, and ends once, whatever panics.

/// How a message ended that had come from a peer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum End {
    /// It stood for one that had lost its use.
    Void,
    /// A mailbox or a client's queue of this node has it, and counts it from here on.
    HandedOn,
    /// It was for whoever is told here: a layer, a group whose members have copies, one who waited for an outcome or a reply.
    Told,
    Expired,
    /// Nobody took it, or it was not what may come.
    Refused,
    /// What handled it panicked.
    Failed,
    /// A newer value had come before it, by datagram.
    Superseded,
}

/// Counters of one session.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Arrivals {
    taken: u64,
    /// Neither ended nor in a line.
    in_hand: u64,
    ends: [u64; 7],
}

impl Arrivals {
    /// One more has come, and is in hand.
    pub(super) const fn take(&mut self) {
        self.taken += 1;
        self.in_hand += 1;
    }

    /// What was counted as one more had come before.
    pub(super) const fn take_none(&mut self) {
        self.taken = self.taken.saturating_sub(1);
        self.put_away();
    }

    /// One that has waited for its application is in hand again.
    pub(super) const fn take_again(&mut self) {
        self.in_hand += 1;
    }

    /// What was in hand waits for its application.
    pub(super) const fn put_away(&mut self) {
        self.in_hand = self.in_hand.saturating_sub(1);
    }

    /// What was in hand has ended so.
    pub(super) const fn end(&mut self, end: End) {
        self.put_away();
        self.ends[end as usize] += 1;
    }

    /// Messages that have come, and not those that had lost their use.
    pub(super) const fn taken(&self) -> u64 {
        self.taken.saturating_sub(self.ended(End::Void))
    }

    /// Messages that have ended so.
    pub(super) const fn ended(&self, end: End) -> u64 {
        self.ends[end as usize]
    }

    /// Messages that a thread handles now.
    pub(super) const fn in_hand(&self) -> u64 {
        self.in_hand
    }
}
