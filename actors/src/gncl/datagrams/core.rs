//! Values that go to a peer by datagram, and those that come from it: what is sent when, and what is handed on.
//!
//! **After each call, drain [`Core::poll`] until it is `None`, then sleep until [`Core::next_wake`].** No clock, no socket.

use sinew_runtime::time::Time;

use super::{
    incoming::{self, Incoming},
    outgoing::{LIMITS, Outgoing, Position},
    packet::Acknowledgement,
    path::{Path, Step},
};

/// What is to be sent.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Order<'a, V> {
    /// A datagram that is to be answered.
    Probe,
    /// This value, with its number.
    Value(u64, &'a V),
    /// What has come.
    Acknowledgement,
}

/// Both directions between this node and a peer.
#[derive(Clone, Debug)]
pub(super) struct Core<K, V> {
    pub(super) outgoing: Outgoing<K, V>,
    pub(super) incoming: Incoming<K>,
    path: Path,
    /// Since when datagrams go where they do: what answers an earlier one says nothing of the way there.
    there_since: Time,
    is_to_probe: bool,
}

impl<K: Ord + Copy, V> Core<K, V> {
    /// Nothing has gone and nothing has come. `first` is above each number that went between the same two lives of nodes.
    pub(super) fn new(first: u64) -> Self {
        Self {
            outgoing: Outgoing::new(first, LIMITS),
            incoming: Incoming::new(incoming::FLOWS_MAX),
            path: Path::new(),
            there_since: Time::ZERO,
            is_to_probe: false,
        }
    }

    /// The peer reads datagrams somewhere else than was known. What is under way goes by the connection:
    /// [`hand_over`](Outgoing::hand_over) follows.
    pub(super) fn announced(&mut self, now: Time) {
        self.path.announced(now);
        self.there_since = now;
        self.outgoing.turn_to_connection();
    }

    /// There is a new connection, and the peer reads datagrams where it did.
    pub(super) const fn reconnected(&mut self, now: Time) {
        self.path.reconnected(now);
    }

    /// The peer has forgotten what came from here. [`announced`](Self::announced) follows.
    pub(super) fn begin_anew(&mut self) {
        self.outgoing.begin_anew();
        self.incoming.begin_anew();
    }

    /// No datagrams are sent any more. What is under way goes by the connection: [`hand_over`](Outgoing::hand_over) follows.
    pub(super) fn retire(&mut self) {
        self.path.over();
        self.is_to_probe = false;
        self.outgoing.turn_to_connection();
    }

    /// The peer is gone, with all that was for it.
    pub(super) fn end(&mut self) {
        self.path.over();
        self.is_to_probe = false;
        self.outgoing.end();
    }

    /// Whether values go by datagram now.
    #[cfg(test)]
    pub(super) const fn is_open(&self) -> bool {
        self.path.is_open()
    }

    /// Takes the newest value of a flow, which has `bytes` in a datagram.
    ///
    /// # Errors
    /// The value: it goes by the connection.
    pub(super) fn submit(&mut self, key: K, value: V, bytes: usize, expiry: Time) -> Result<(), V> {
        if self.path.is_open() { self.outgoing.submit(key, value, bytes, expiry) } else { Err(value) }
    }

    /// A datagram has come that is to be answered.
    pub(super) const fn asked(&mut self, now: Time, stamp: u32) {
        self.incoming.asked(now, stamp);
    }

    /// The peer says what has come. Returns whether values go by datagram from now on, and did not before.
    pub(super) fn acknowledged(&mut self, now: Time, said: &Acknowledgement) -> bool {
        self.outgoing.acknowledged(said, stamp(now));
        let age_us = stamp(now).wrapping_sub(said.echo);
        // spec: DATAGRAM-5
        let is_from_there = u128::from(age_us) <= now.since(self.there_since).as_micros();
        is_from_there && self.path.answered()
    }

    /// Time has passed; [`hand_over`](Outgoing::hand_over) follows. `heard` is when the peer spoke on a connection last. Returns whether
    /// it is to be said that the peer lives and datagrams do not get through.
    pub(super) fn tick(&mut self, now: Time, heard: Time) -> bool {
        let is_blocked = self.path.is_to_warn(now, heard);
        match self.path.tick(now) {
            Step::Nothing => {}
            Step::Probe => self.is_to_probe = true,
            Step::GoBack => {
                self.is_to_probe = self.path.tick(now) == Step::Probe;
                self.outgoing.turn_to_connection();
            }
        }
        is_blocked
    }

    /// The next thing to send.
    pub(super) fn poll(&mut self, now: Time) -> Option<Order<'_, V>> {
        if std::mem::take(&mut self.is_to_probe) {
            return Some(Order::Probe);
        }
        if self.path.is_open()
            && let Some((key, number)) = self.outgoing.transmit(now)
        {
            self.path.sent(now);
            return self.outgoing.value(&key).map(|value| Order::Value(number, value));
        }
        self.incoming.is_due(now).then_some(Order::Acknowledgement)
    }

    /// When to call [`tick`](Self::tick) and [`poll`](Self::poll), if nothing else happens before.
    pub(super) fn next_wake(&self) -> Option<Time> {
        [self.path.next_wake(), self.outgoing.next_wake(), self.incoming.due()].into_iter().flatten().min()
    }

    /// Where each value is that was taken.
    pub(super) fn position(&self) -> Position {
        self.outgoing.position()
    }
}

/// What a datagram that is sent at `now` says of its time: microseconds, lower 32 bits.
pub(super) const fn stamp(now: Time) -> u32 {
    (now.as_nanos() / 1_000) as u32
}
