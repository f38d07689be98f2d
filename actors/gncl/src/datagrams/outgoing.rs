//! The sending half: numbers, the newest value of each flow until it is known to have arrived, and the bound
//! of data in flight.
//!
//! ```text
//!  Idle ── submitted ──► Waiting ── sent ──► InFlight ── acknowledged ──► Idle
//!             ▲ newer value takes its place │    ▲ └── time-out: again ─┘
//!  Waiting, InFlight ── datagrams do not get through ──► ForConnection ── the connection has taken it ──► Idle
//! ```

mod by_connection;
mod position;

use std::{
    collections::{BTreeMap, VecDeque},
    ops::Bound,
    time::Duration,
};

use sinew_runtime::time::Time;

use super::{packet::Acknowledgement, round_trip::RoundTrip};
use position::Counts;
pub use position::Position;

/// Bounds of the unacknowledged data in flight to a peer.
#[derive(Clone, Copy, Debug)]
pub struct Limits {
    /// Maximum number of datagrams.
    pub(super) datagrams: usize,
    /// Maximum bytes of datagrams; one datagram is always allowed.
    pub(super) bytes: usize,
    /// Maximum number of known flows.
    pub(super) flows: usize,
}

/// A time-out of a superseded value means that the value or its acknowledgement was lost; neither shrinks the
/// window. On a slow network, the window bounds the data in its queues: 32 KiB are 26 ms at 10 Mbit/s. spec:
/// DATAGRAM-6
pub const LIMITS: Limits = Limits { datagrams: 256, bytes: 32 << 10, flows: 1_024 };

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum State {
    /// All sent values have arrived, or were sent over the connection.
    Idle,
    /// The newest value has not been sent.
    Waiting,
    /// The newest value has been sent.
    InFlight,
    /// The value is for the connection, which has not accepted it yet.
    ForConnection { was_sent: bool },
}

/// The connection's answer to an offered value.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Offered<V> {
    Taken,
    /// The connection has no room now.
    Full(V),
    /// The connection will never accept this value.
    Refused,
}

/// Maximum number of flows checked for one that can be removed, per new flow. If none can be removed, the new
/// one is sent over the connection.
const CHECKS_MAX: usize = 32;
/// Maximum number of lengths of lost datagrams kept between two checks: more add no information.
const LOST_MAX: usize = 16;

/// The values of one source to one destination of one kind.
#[derive(Clone, Debug)]
struct Flow<V> {
    /// Number of the newest value.
    number: u64,
    /// The value, while it is not known to have arrived.
    value: Option<V>,
    bytes: usize,
    expiry: Time,
    state: State,
    /// Number of newer values in submission to the connection at this moment. The older value is kept here
    /// until they are accepted.
    in_submission: u32,
}

/// A datagram in flight.
#[derive(Clone, Debug)]
struct Flight<K> {
    number: u64,
    key: K,
    /// Bytes without an acknowledgement in the same datagram.
    bytes: usize,
    /// Length of the datagram sent last.
    length: usize,
    repeats: u32,
    /// Time at which it counts as lost.
    due: Time,
}

/// The send state for a peer.
#[derive(Clone, Debug)]
pub struct Outgoing<K, V> {
    limits: Limits,
    /// Number of the next value.
    next: u64,
    flows: BTreeMap<K, Flow<V>>,
    /// Flows with a waiting value, in their order.
    waiting: VecDeque<K>,
    flight: Vec<Flight<K>>,
    flight_bytes: usize,
    /// No datagram in flight is due before this.
    next_due: Time,
    /// Time of the next offer to the connection.
    offer_at: Time,
    round_trip: RoundTrip,
    counts: Counts,
    /// Values received by the peer according to its last report, and those received before it lost its state.
    taken: u64,
    taken_before: u64,
    /// The flow that was last checked for removal.
    last_checked: Option<K>,
    /// Lengths of lost datagrams that [`next_lost`](Self::next_lost) has not returned yet.
    lost: Vec<usize>,
    #[cfg(feature = "testing")]
    pub(super) planted: Option<super::Fault>,
}

impl<K: Ord + Copy, V> Outgoing<K, V> {
    /// Creates a state in which nothing was sent. `first` is above all numbers ever used between the same two
    /// incarnations of nodes.
    pub fn new(first: u64, limits: Limits) -> Self {
        Self {
            limits,
            next: first.max(1),
            flows: BTreeMap::new(),
            waiting: VecDeque::with_capacity(16),
            flight: Vec::with_capacity(16),
            flight_bytes: 0,
            next_due: Time::MAX,
            offer_at: Time::MAX,
            round_trip: RoundTrip::default(),
            counts: Counts::default(),
            taken: 0,
            taken_before: 0,
            last_checked: None,
            lost: Vec::with_capacity(LOST_MAX),
            #[cfg(feature = "testing")]
            planted: None,
        }
    }

    /// Submits the newest value of a flow, which needs `bytes` in a datagram.
    ///
    /// # Errors
    /// Returns the value if too many flows have values in flight.
    pub(super) fn submit(&mut self, key: K, value: V, bytes: usize, expiry: Time) -> Result<(), V> {
        if !self.flows.contains_key(&key) && self.flows.len() >= self.limits.flows && !self.evict_idle_flow()
        {
            return Err(value);
        }
        let number = self.number();
        let former = self.flows.get(&key).map(|flow| (flow.state, flow.in_submission));
        let (former, in_submission) = former.unwrap_or((State::Idle, 0));
        let fresh = Flow { number, value: Some(value), bytes, expiry, state: State::Waiting, in_submission };
        self.flows.insert(key, fresh);
        self.counts.superseded += u64::from(former.was_never_sent());
        if former != State::Waiting {
            self.waiting.push_back(key);
        }
        Ok(())
    }

    /// Returns the number of a new value or probe.
    pub(super) const fn number(&mut self) -> u64 {
        let number = self.next;
        self.next += 1;
        number
    }

    /// Removes one flow to make room. A flow without a value in flight, by datagram or by connection, has no
    /// state but its key.
    fn evict_idle_flow(&mut self) -> bool {
        let is_idle = |flow: &Flow<V>| flow.state == State::Idle && flow.in_submission == 0;
        // The search starts behind the flows checked before, and continues with the first one.
        let from = self.last_checked.map_or(Bound::Unbounded, Bound::Excluded);
        let behind = self.flows.range((from, Bound::Unbounded));
        let last_checked = behind.chain(&self.flows).take(CHECKS_MAX.min(self.flows.len()));
        let (mut last, mut idle) = (self.last_checked, None);
        for (key, flow) in last_checked {
            last = Some(*key);
            if is_idle(flow) {
                idle = last;
                break;
            }
        }
        self.last_checked = last;
        idle.is_some_and(|key| self.flows.remove(&key).is_some())
    }

    /// Returns the flow and the number of the next [value](Self::value) to send now.
    pub(super) fn transmit(&mut self, now: Time) -> Option<(K, u64)> {
        self.repeat(now).or_else(|| self.begin(now))
    }

    /// Returns the newest value of a flow, while it is not known to have arrived.
    pub(super) fn value(&self, key: &K) -> Option<&V> {
        self.flows.get(key)?.value.as_ref()
    }

    /// Returns a sent value that counts as lost and is the newest of its flow. spec: DATAGRAM-4
    fn repeat(&mut self, now: Time) -> Option<(K, u64)> {
        if now < self.next_due {
            return None;
        }
        self.give_up(now);
        #[cfg(feature = "testing")]
        if self.planted == Some(super::Fault::NotRepeated) {
            return None;
        }
        let lost = &mut self.lost;
        let again = self.flight.iter_mut().find(|flight| flight.due <= now);
        let sent = again.map(|flight| {
            note_lost(lost, flight.length);
            flight.repeats += 1;
            flight.due = now + self.round_trip.time_out(flight.repeats);
            (flight.key, flight.number)
        });
        self.next_due = self.flight.iter().map(|flight| flight.due).min().unwrap_or(Time::MAX);
        sent
    }

    /// Removes lost datagrams from flight if their value is superseded or expired.
    fn give_up(&mut self, now: Time) {
        let Self { flight, flows, counts, flight_bytes, lost, .. } = self;
        flight.retain(|flight| {
            if flight.due > now {
                return true;
            }
            let newest = flows.get_mut(&flight.key).filter(|flow| flow.number == flight.number);
            let keeps = match newest {
                Some(flow) if flow.value.is_some() && flow.expiry >= now => true,
                Some(flow) if flow.value.is_some() => {
                    counts.expired_late += 1;
                    (flow.value, flow.state) = (None, State::Idle);
                    false
                }
                Some(_) | None => false,
            };
            if !keeps {
                *flight_bytes -= flight.bytes;
                note_lost(lost, flight.length);
            }
            keeps
        });
    }

    /// Returns a value to send for the first time.
    fn begin(&mut self, now: Time) -> Option<(K, u64)> {
        loop {
            let key = *self.waiting.front()?;
            let Some(flow) = self.flows.get_mut(&key).filter(|flow| flow.state == State::Waiting) else {
                self.waiting.pop_front();
                continue;
            };
            if flow.expiry < now {
                (flow.value, flow.state) = (None, State::Idle);
                self.counts.expired += 1;
                self.waiting.pop_front();
                continue;
            }
            let has_room = self.flight.len() < self.limits.datagrams
                && self.flight_bytes + flow.bytes <= self.limits.bytes;
            if !self.flight.is_empty() && !has_room {
                return None;
            }
            flow.state = State::InFlight;
            let (number, bytes) = (flow.number, flow.bytes);
            self.waiting.pop_front();
            self.counts.sent += 1;
            let due = now + self.round_trip.time_out(0);
            self.flight.push(Flight { number, key, bytes, length: bytes, repeats: 0, due });
            self.flight_bytes += bytes;
            self.next_due = self.next_due.min(due);
            return Some((key, number));
        }
    }

    /// Records the length of the datagram in which this number was just sent.
    pub(super) fn record_length(&mut self, number: u64, length: usize) {
        // The number is usually the last one.
        if let Some(flight) = self.flight.iter_mut().rev().find(|flight| flight.number == number) {
            flight.length = length;
        }
    }

    /// Returns the length of a lost datagram, each once.
    pub(super) fn next_lost(&mut self) -> Option<usize> {
        self.lost.pop()
    }

    /// Returns how long to wait for the acknowledgement of a datagram sent now.
    pub(super) fn time_out(&self) -> Duration {
        self.round_trip.time_out(0)
    }

    /// Processes an acknowledgement. `now_stamp` is the stamp of a datagram sent now. Returns the longest
    /// datagram in which the peer certainly received a value; 0: none.
    pub(super) fn acknowledged(&mut self, ack: &Acknowledgement, now_stamp: u32) -> usize {
        self.taken = self.taken.max(ack.taken);
        let took_us = now_stamp.wrapping_sub(ack.echo).saturating_sub(ack.held_us);
        // A stamp that was never sent would look as old as the period of the clock.
        if took_us < u32::MAX / 2 {
            self.round_trip.measured(Duration::from_micros(took_us.into()));
        }
        let mut longest = 0;
        let Self { flight, flows, flight_bytes, .. } = self;
        flight.retain(|flight| {
            if !ack.ranges().iter().any(|range| range.has(flight.number)) {
                return true;
            }
            if let Some(flow) = flows.get_mut(&flight.key).filter(|flow| flow.number == flight.number) {
                (flow.value, flow.state) = (None, State::Idle);
            }
            *flight_bytes -= flight.bytes;
            // A value that was sent several times may have come in a datagram without an acknowledgement.
            let length = if flight.repeats == 0 { flight.length } else { flight.bytes };
            longest = longest.max(length);
            false
        });
        // An alarm for a value that has arrived would find nothing to do.
        self.next_due = flight.iter().map(|flight| flight.due).min().unwrap_or(Time::MAX);
        longest
    }

    /// Drops all pending values.
    pub fn end(&mut self) {
        for flow in self.flows.values_mut() {
            match flow.state {
                State::Idle => {}
                State::Waiting | State::ForConnection { was_sent: false } => self.counts.lost += 1,
                State::InFlight | State::ForConnection { was_sent: true } => self.counts.unknown += 1,
            }
            (flow.value, flow.state) = (None, State::Idle);
        }
        self.clear();
        self.offer_at = Time::MAX;
    }

    /// Handles a peer that has lost its state and counts from 0. It is unknown whether it received the values
    /// in flight. The newest value of each flow is sent over the connection, because it may be the last one.
    pub(super) fn begin_anew(&mut self) {
        let in_flight = self.flows.values().filter(|flow| flow.state == State::InFlight);
        self.counts.unknown += in_flight.count() as u64;
        self.assign_to_connection();
        self.taken_before = self.taken_before.saturating_add(std::mem::take(&mut self.taken));
        self.round_trip = RoundTrip::default();
    }

    fn clear(&mut self) {
        self.waiting.clear();
        self.flight.clear();
        self.flight_bytes = 0;
        self.next_due = Time::MAX;
    }

    /// Returns when the next action is due, if nothing happens before.
    pub(super) fn next_wake(&self) -> Option<Time> {
        Some(self.next_due.min(self.offer_at)).filter(|due| *due != Time::MAX)
    }

    /// Returns the number of values that are not known to have arrived.
    pub(super) fn left(&self) -> usize {
        self.flows.values().filter(|flow| flow.state != State::Idle).count()
    }

    /// Returns where each value is.
    pub(super) fn position(&self) -> Position {
        let waiting = self.flows.values().filter(|flow| flow.state.was_never_sent()).count() as u64;
        // A value superseded in flight may still arrive.
        let unacknowledged = self.flight.len() as u64;
        // The peer's count is limited to the possible maximum.
        let arrived = self.taken_before.saturating_add(self.taken);
        let arrived = arrived.min(self.counts.sent.saturating_sub(unacknowledged));
        Position { counts: self.counts, waiting, unacknowledged, arrived }
    }

    #[cfg(test)]
    pub(super) const fn counts(&self) -> Counts {
        self.counts
    }

    #[cfg(test)]
    pub(super) const fn in_flight(&self) -> (usize, usize) {
        (self.flight.len(), self.flight_bytes)
    }

    #[cfg(test)]
    pub(super) const fn next_number(&self) -> u64 {
        self.next
    }
}

/// Records the length of a lost datagram. If there is no room, it adds no information.
fn note_lost(lost: &mut Vec<usize>, length: usize) {
    if lost.len() < LOST_MAX {
        lost.push(length);
    }
}

impl State {
    /// Returns the state after the value is assigned to the connection.
    const fn for_connection(self) -> Self {
        match self {
            Self::Waiting => Self::ForConnection { was_sent: false },
            Self::InFlight => Self::ForConnection { was_sent: true },
            stays @ (Self::Idle | Self::ForConnection { .. }) => stays,
        }
    }

    /// Whether a value exists that was sent neither by datagram nor by connection.
    const fn was_never_sent(self) -> bool {
        matches!(self, Self::Waiting | Self::ForConnection { was_sent: false })
    }
}
