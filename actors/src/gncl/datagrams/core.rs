//! Values that go to a peer by datagram, and those that come from it: what is sent when, and what is handed on.
//!
//! **After each call, drain [`Core::poll`] until it is `None`, then sleep until [`Core::next_wake`].** No clock, no socket.

use sinew_runtime::time::Time;

use super::{
    incoming::{self, Incoming},
    lengths::{Lengths, Report},
    outgoing::{LIMITS, Outgoing, Position},
    packet::Acknowledgement,
    path::{Path, Step},
};

/// What is to be sent.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Order<'a, V> {
    /// A probe with this number, which makes a datagram of this length.
    Probe(u64, usize),
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
    pub(super) lengths: Lengths,
    /// Since when datagrams go where they do: what answers an earlier one says nothing of the way there.
    there_since: Time,
}

impl<K: Ord + Copy, V> Core<K, V> {
    /// Nothing has gone and nothing has come. `first` is above each number that went between the same two lives of nodes.
    pub(super) fn new(first: u64) -> Self {
        Self {
            outgoing: Outgoing::new(first, LIMITS),
            incoming: Incoming::new(incoming::FLOWS_MAX),
            path: Path::new(),
            lengths: Lengths::new(),
            there_since: Time::ZERO,
        }
    }

    /// The peer reads datagrams somewhere else than was known. What is under way goes by the connection:
    /// [`hand_over`](Outgoing::hand_over) follows.
    pub(super) fn announced(&mut self, now: Time) {
        self.path.announced(now);
        self.lengths.reset();
        self.there_since = now;
        self.outgoing.turn_to_connection();
    }

    /// There is a new connection, and the peer reads datagrams where it did.
    pub(super) const fn reconnected(&mut self, now: Time) {
        self.path.reconnected(now);
        self.lengths.reconnected(now);
    }

    /// The peer has forgotten what came from here. [`announced`](Self::announced) follows.
    pub(super) fn begin_anew(&mut self) {
        self.outgoing.begin_anew();
        self.incoming.begin_anew();
    }

    /// No datagrams are sent any more. What is under way goes by the connection: [`hand_over`](Outgoing::hand_over) follows.
    pub(super) fn retire(&mut self) {
        self.path.over();
        self.lengths.reset();
        self.outgoing.turn_to_connection();
    }

    /// The peer is gone, with all that was for it.
    pub(super) fn end(&mut self) {
        self.path.over();
        self.lengths.reset();
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
        // spec: DATAGRAM-7
        let may = self.path.is_open() && bytes <= self.lengths.limit();
        if may { self.outgoing.submit(key, value, bytes, expiry) } else { Err(value) }
    }

    /// A probe has come.
    pub(super) fn asked(&mut self, now: Time, stamp: u32, number: u64) {
        self.incoming.asked(now, stamp, number);
    }

    /// The peer says what has come. Returns whether values go by datagram from now on, and did not before.
    pub(super) fn acknowledged(&mut self, now: Time, said: &Acknowledgement) -> bool {
        let value = self.outgoing.acknowledged(said, stamp(now));
        let longest = value.max(self.lengths.answered(said.ranges()));
        let age_us = stamp(now).wrapping_sub(said.echo);
        // spec: DATAGRAM-5
        let is_from_there = u128::from(age_us) <= now.since(self.there_since).as_micros();
        let is_news = is_from_there && self.path.answered();
        if longest > 0 && self.path.is_open() {
            self.judge_lengths(|lengths| lengths.arrived(now, longest));
        }
        is_news
    }

    /// Time has passed; [`hand_over`](Outgoing::hand_over) follows. `heard` is when the peer spoke on a connection last. Returns whether
    /// it is to be said that the peer lives and datagrams do not get through.
    pub(super) fn tick(&mut self, now: Time, heard: Time) -> bool {
        let is_blocked = self.path.is_to_warn(now, heard);
        match self.path.tick(now) {
            Step::Nothing => {}
            Step::Probe => self.lengths.probe_both(),
            Step::GoBack => {
                self.lengths.reset();
                if self.path.tick(now) == Step::Probe {
                    self.lengths.probe_both();
                }
                self.outgoing.turn_to_connection();
            }
        }
        if self.path.is_open() {
            self.lengths.tick(now, self.outgoing.time_out());
        }
        is_blocked
    }

    /// What is longer than what arrives from now on goes by the connection: [`hand_over`](Outgoing::hand_over) follows.
    fn judge_lengths(&mut self, happens: impl FnOnce(&mut Lengths)) {
        let before = self.lengths.limit();
        happens(&mut self.lengths);
        if self.lengths.limit() < before {
            self.outgoing.turn_long_to_connection(self.lengths.limit());
        }
    }

    /// What of the lengths that arrive is to be logged, once.
    pub(super) const fn report(&mut self) -> Option<Report> {
        self.lengths.report()
    }

    /// The next thing to send.
    pub(super) fn poll(&mut self, now: Time) -> Option<Order<'_, V>> {
        if let Some(length) = self.lengths.order() {
            let number = self.outgoing.number();
            self.lengths.probed(number, length);
            self.path.sent(now);
            return Some(Order::Probe(number, length));
        }
        if self.path.is_open() {
            let sent = self.outgoing.transmit(now);
            while let Some(length) = self.outgoing.next_lost() {
                self.judge_lengths(|lengths| lengths.lost(now, length));
            }
            if let Some((key, number)) = sent {
                self.path.sent(now);
                return self.outgoing.value(&key).map(|value| Order::Value(number, value));
            }
        }
        self.incoming.is_due(now).then_some(Order::Acknowledgement)
    }

    /// When to call [`tick`](Self::tick) and [`poll`](Self::poll), if nothing else happens before.
    pub(super) fn next_wake(&self) -> Option<Time> {
        let lengths = self.lengths.next_wake();
        [self.path.next_wake(), self.outgoing.next_wake(), self.incoming.due(), lengths]
            .into_iter()
            .flatten()
            .min()
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
