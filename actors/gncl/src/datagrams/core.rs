//! The values sent to a peer by datagram, and those received from it: when to send, and which to forward.
//!
//! **After each call, drain [`Core::poll`] until it is `None`, then sleep until [`Core::next_wake`].** No
//! clock, no socket.

use sinew_runtime::time::Time;

use super::{
    incoming::{self, Incoming},
    lengths::{Lengths, Report},
    outgoing::{LIMITS, Outgoing, Position},
    packet::Acknowledgement,
    path::{Path, Step},
};

/// A datagram to send.
#[derive(Debug, PartialEq, Eq)]
pub enum Order<'a, V> {
    /// A probe with this number, padded to a datagram of this length.
    Probe(u64, usize),
    /// This value, with its number.
    Value(u64, &'a V),
    /// An acknowledgement of received datagrams.
    Acknowledgement,
}

/// Both directions between this node and a peer.
#[derive(Clone, Debug)]
pub struct Core<K, V> {
    pub outgoing: Outgoing<K, V>,
    pub incoming: Incoming<K>,
    path: Path,
    pub(super) lengths: Lengths,
    /// Time since which datagrams are sent to the present address. An answer to an earlier datagram proves
    /// nothing about the present path.
    there_since: Time,
}

impl<K: Ord + Copy, V> Core<K, V> {
    /// Creates a core without history. `first` is above all numbers used between the same two incarnations of nodes.
    pub fn new(first: u64) -> Self {
        Self {
            outgoing: Outgoing::new(first, LIMITS),
            incoming: Incoming::new(incoming::FLOWS_MAX),
            path: Path::new(),
            lengths: Lengths::new(),
            there_since: Time::ZERO,
        }
    }

    /// Records a new datagram address of the peer. Pending values are sent over the connection: the caller
    /// calls [`offer_to_connection`](Outgoing::offer_to_connection) next.
    pub fn announced(&mut self, now: Time) {
        self.path.announced(now);
        self.lengths.reset();
        self.there_since = now;
        self.outgoing.assign_to_connection();
    }

    /// Records a new connection to a peer with the same datagram address.
    pub const fn reconnected(&mut self, now: Time) {
        self.path.reconnected(now);
        self.lengths.reconnected(now);
    }

    /// Records that the peer has lost its receive state. The caller calls [`announced`](Self::announced) next.
    pub fn begin_anew(&mut self) {
        self.outgoing.begin_anew();
        self.incoming.begin_anew();
    }

    /// Stops sending datagrams. Pending values are sent over the connection: the caller calls
    /// [`offer_to_connection`](Outgoing::offer_to_connection) next.
    pub(super) fn retire(&mut self) {
        self.path.over();
        self.lengths.reset();
        self.outgoing.assign_to_connection();
    }

    /// Ends both directions after the removal of the peer, and drops all pending values.
    pub(super) fn end(&mut self) {
        self.path.over();
        self.lengths.reset();
        self.outgoing.end();
    }

    /// Returns whether values are sent by datagram now.
    pub const fn is_open(&self) -> bool {
        self.path.is_open()
    }

    /// Submits the newest value of a flow, which needs `bytes` in a datagram.
    ///
    /// # Errors
    /// Returns the value if it must be sent over the connection.
    pub fn submit(&mut self, key: K, value: V, bytes: usize, expiry: Time) -> Result<(), V> {
        // spec: DATAGRAM-7
        let may = self.path.is_open() && bytes <= self.lengths.limit();
        if may { self.outgoing.submit(key, value, bytes, expiry) } else { Err(value) }
    }

    /// Processes a received probe.
    pub fn on_probe(&mut self, now: Time, stamp: u32, number: u64) {
        self.incoming.on_probe(now, stamp, number);
    }

    /// Processes a received acknowledgement. Returns whether this enables datagrams, which were disabled before.
    pub fn acknowledged(&mut self, now: Time, ack: &Acknowledgement) -> bool {
        let value = self.outgoing.acknowledged(ack, stamp(now));
        let longest = value.max(self.lengths.answered(ack.ranges()));
        let age_us = stamp(now).wrapping_sub(ack.echo);
        // spec: DATAGRAM-5
        let is_from_there = u128::from(age_us) <= now.since(self.there_since).as_micros();
        let is_news = is_from_there && self.path.answered();
        if longest > 0 && self.path.is_open() {
            self.judge_lengths(|lengths| lengths.arrived(now, longest));
        }
        is_news
    }

    /// Handles the passing of time; the caller calls [`offer_to_connection`](Outgoing::offer_to_connection)
    /// next. `received_at` is the time of the peer's last frame on a connection. Returns whether to warn that
    /// the peer is alive but datagrams do not get through.
    pub fn tick(&mut self, now: Time, received_at: Time) -> bool {
        let is_blocked = self.path.is_to_warn(now, received_at);
        match self.path.tick(now) {
            Step::Nothing => {}
            Step::Probe => self.lengths.probe_both(),
            Step::FallBack => {
                self.lengths.reset();
                if self.path.tick(now) == Step::Probe {
                    self.lengths.probe_both();
                }
                self.outgoing.assign_to_connection();
            }
        }
        if self.path.is_open() {
            self.lengths.tick(now, self.outgoing.time_out());
        }
        is_blocked
    }

    /// Updates the usable lengths. Values longer than the new limit are sent over the connection: the caller
    /// calls [`offer_to_connection`](Outgoing::offer_to_connection) next.
    fn judge_lengths(&mut self, happens: impl FnOnce(&mut Lengths)) {
        let before = self.lengths.limit();
        happens(&mut self.lengths);
        if self.lengths.limit() < before {
            self.outgoing.assign_long_to_connection(self.lengths.limit());
        }
    }

    /// Returns the change of usable lengths to log, once.
    pub const fn report(&mut self) -> Option<Report> {
        self.lengths.report()
    }

    /// Returns the next datagram to send.
    pub fn poll(&mut self, now: Time) -> Option<Order<'_, V>> {
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

    /// Returns when to call [`tick`](Self::tick) and [`poll`](Self::poll), if nothing else happens before.
    pub(super) fn next_wake(&self) -> Option<Time> {
        let lengths = self.lengths.next_wake();
        [self.path.next_wake(), self.outgoing.next_wake(), self.incoming.due(), lengths]
            .into_iter()
            .flatten()
            .min()
    }

    /// Returns where each submitted value is.
    pub fn position(&self) -> Position {
        self.outgoing.position()
    }
}

/// Returns the stamp of a datagram sent at `now`: microseconds, lower 32 bits.
pub const fn stamp(now: Time) -> u32 {
    (now.as_nanos() / 1_000) as u32
}
