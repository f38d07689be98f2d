//! The sending half: numbers, the newest value of each flow until it is known to have arrived, and how much may be on its way.
//!
//! ```text
//!  Idle ── submitted ──► Waiting ── sent ──► OnTheWay ── acknowledged ──► Idle
//!             ▲ newer value takes its place │    ▲ └── time-out: again ─┘
//!  Waiting, OnTheWay ── datagrams do not get through ──► ForConnection ── the connection has taken it ──► Idle
//! ```

use std::{
    collections::{BTreeMap, VecDeque},
    ops::Bound,
    time::Duration,
};

use sinew_runtime::time::Time;

use super::{packet::Acknowledgement, round_trip::RoundTrip};

/// What may be on its way to a peer without an acknowledgement.
#[derive(Clone, Copy, Debug)]
pub(super) struct Limits {
    /// Datagrams.
    pub(super) datagrams: usize,
    /// Bytes of them; one datagram always may.
    pub(super) bytes: usize,
    /// Flows that are known.
    pub(super) flows: usize,
}

/// A time-out of a value that was superseded says that it was lost or that its acknowledgement was: neither makes the window smaller. On a
/// network that is slow, the window is what waits in its queues: 32 KiB are 26 ms of 10 Mbit/s. spec: DATAGRAM-6
pub(super) const LIMITS: Limits = Limits { datagrams: 256, bytes: 32 << 10, flows: 1_024 };

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum State {
    /// All that was sent has arrived, or went elsewhere.
    Idle,
    /// Its newest value has not been sent.
    Waiting,
    /// It has.
    OnTheWay,
    /// It goes by the connection, which has not taken it yet.
    ForConnection { was_sent: bool },
}

/// What the connection says of a value that it is offered.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Offered<V> {
    Taken,
    /// It has no room now.
    Full(V),
    /// It never takes this one.
    Refused,
}

/// Flows that are looked at for one that may be forgotten, of each that is new. Where none of these may, that one goes by the connection.
const LOOKS_MAX: usize = 32;
/// Lengths of lost datagrams that are kept between two looks, at most: more say nothing more.
const LOST_MAX: usize = 16;
/// How often the connection is offered what it had no room for.
const OFFER_PERIOD: Duration = Duration::from_millis(10);

/// What one source sends to one destination of one kind.
#[derive(Clone, Debug)]
struct Flow<V> {
    /// Number of the newest value.
    number: u64,
    /// As long as it is not known to have arrived.
    value: Option<V>,
    bytes: usize,
    expiry: Time,
    state: State,
    /// Newer values of it that the connection is being given at this moment: what is older stays here until they are taken.
    elsewhere: u32,
}

/// A datagram on its way.
#[derive(Clone, Debug)]
struct Flight<K> {
    number: u64,
    key: K,
    /// Without an acknowledgement that goes with it.
    bytes: usize,
    /// Of the datagram that was sent last.
    length: usize,
    repeats: u32,
    /// When it counts as lost.
    due: Time,
}

/// What became of the values that were taken.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(in crate::gncl) struct Counts {
    /// Sent at least once.
    pub(in crate::gncl) sent: u64,
    /// A newer value took their place before they were sent.
    pub(in crate::gncl) superseded: u64,
    /// Too old before they were sent.
    pub(in crate::gncl) expired: u64,
    /// Waited when all was over.
    pub(in crate::gncl) lost: u64,
    /// Sent, and given up because they were too old.
    pub(in crate::gncl) expired_late: u64,
    /// Sent, and nobody can say any more whether they arrived.
    pub(in crate::gncl) unknown: u64,
}

/// Where each value is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(in crate::gncl) struct Position {
    pub(in crate::gncl) counts: Counts,
    /// Not sent yet.
    pub(in crate::gncl) waiting: u64,
    /// Sent, and neither acknowledged nor given up as lost.
    pub(in crate::gncl) unacknowledged: u64,
    /// Taken by the peer.
    pub(in crate::gncl) arrived: u64,
}

/// What goes to a peer.
#[derive(Clone, Debug)]
pub(super) struct Outgoing<K, V> {
    limits: Limits,
    /// Number of the next value.
    next: u64,
    flows: BTreeMap<K, Flow<V>>,
    /// Flows whose value waits, in their turn.
    waiting: VecDeque<K>,
    flight: Vec<Flight<K>>,
    flight_bytes: usize,
    /// Nothing on its way is due before this.
    next_due: Time,
    /// When the connection is offered what is for it.
    offer_at: Time,
    round_trip: RoundTrip,
    counts: Counts,
    /// Taken by the peer, as it said last, and by it before it forgot us.
    taken: u64,
    taken_before: u64,
    /// The flow that was looked at last for one that may be forgotten.
    looked_at: Option<K>,
    /// Lengths of datagrams that count as lost, until [`next_lost`](Self::next_lost) has said so.
    lost: Vec<usize>,
    #[cfg(test)]
    pub(super) planted: super::simulation::Planted,
}

impl<K: Ord + Copy, V> Outgoing<K, V> {
    /// Nothing was sent yet. `first` is above each number that ever went between the same two lives of nodes.
    pub(super) fn new(first: u64, limits: Limits) -> Self {
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
            looked_at: None,
            lost: Vec::with_capacity(LOST_MAX),
            #[cfg(test)]
            planted: super::simulation::Planted::Nothing,
        }
    }

    /// Takes the newest value of a flow, which has `bytes` in a datagram.
    ///
    /// # Errors
    /// The value: too many flows have something under way.
    pub(super) fn submit(&mut self, key: K, value: V, bytes: usize, expiry: Time) -> Result<(), V> {
        if !self.flows.contains_key(&key) && self.flows.len() >= self.limits.flows && !self.forget_one() {
            return Err(value);
        }
        let number = self.number();
        let former = self.flows.get(&key).map(|flow| (flow.state, flow.elsewhere));
        let (former, elsewhere) = former.unwrap_or((State::Idle, 0));
        let fresh = Flow { number, value: Some(value), bytes, expiry, state: State::Waiting, elsewhere };
        self.flows.insert(key, fresh);
        self.counts.superseded += u64::from(former.was_never_sent());
        if former != State::Waiting {
            self.waiting.push_back(key);
        }
        Ok(())
    }

    /// The number of a value that the connection is given now. What goes by datagram of its flow stays until that one
    /// [is taken](Self::taken_elsewhere): it is the last one if it is not.
    pub(super) fn given_elsewhere(&mut self, key: K) -> u64 {
        if let Some(flow) = self.flows.get_mut(&key) {
            flow.elsewhere += 1;
        }
        self.number()
    }

    /// The connection has taken the value with this number: an older one is superseded.
    pub(super) fn taken_elsewhere(&mut self, key: K, number: u64) {
        self.refused_elsewhere(key);
        let Some(flow) = self.flows.get_mut(&key).filter(|flow| flow.number < number) else { return };
        self.counts.superseded += u64::from(flow.state.was_never_sent());
        if flow.state == State::Waiting {
            self.waiting.retain(|waits| *waits != key);
        }
        (flow.value, flow.state) = (None, State::Idle);
    }

    /// The connection has not taken it.
    pub(super) fn refused_elsewhere(&mut self, key: K) {
        if let Some(flow) = self.flows.get_mut(&key) {
            flow.elsewhere = flow.elsewhere.saturating_sub(1);
        }
    }

    /// The number of a value, or of a probe.
    pub(super) const fn number(&mut self) -> u64 {
        let number = self.next;
        self.next += 1;
        number
    }

    /// Makes room for one more flow: one that has nothing under way, either way, is known by nothing but its key.
    fn forget_one(&mut self) -> bool {
        let is_idle = |flow: &Flow<V>| flow.state == State::Idle && flow.elsewhere == 0;
        // Behind those that were looked at before, and then from the first one on.
        let from = self.looked_at.map_or(Bound::Unbounded, Bound::Excluded);
        let behind = self.flows.range((from, Bound::Unbounded));
        let looked_at = behind.chain(&self.flows).take(LOOKS_MAX.min(self.flows.len()));
        let (mut last, mut idle) = (self.looked_at, None);
        for (key, flow) in looked_at {
            last = Some(*key);
            if is_idle(flow) {
                idle = last;
                break;
            }
        }
        self.looked_at = last;
        idle.is_some_and(|key| self.flows.remove(&key).is_some())
    }

    /// The next [value](Self::value) to be sent now: of which flow, and its number.
    pub(super) fn transmit(&mut self, now: Time) -> Option<(K, u64)> {
        self.repeat(now).or_else(|| self.begin(now))
    }

    /// The newest value of a flow, as long as it is not known to have arrived.
    pub(super) fn value(&self, key: &K) -> Option<&V> {
        self.flows.get(key)?.value.as_ref()
    }

    /// A value that was sent, is the newest of its flow, and counts as lost. spec: DATAGRAM-4
    fn repeat(&mut self, now: Time) -> Option<(K, u64)> {
        if now < self.next_due {
            return None;
        }
        self.give_up(now);
        #[cfg(test)]
        if self.planted == super::simulation::Planted::NotRepeated {
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

    /// What counts as lost and has been superseded, or has expired, is on its way no more.
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

    /// A value that is sent for the first time.
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
            flow.state = State::OnTheWay;
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

    /// The value with this number has just gone in a datagram of this length.
    pub(super) fn went(&mut self, number: u64, length: usize) {
        // Most are the last one.
        if let Some(flight) = self.flight.iter_mut().rev().find(|flight| flight.number == number) {
            flight.length = length;
        }
    }

    /// The length of a datagram that counts as lost, each once.
    pub(super) fn next_lost(&mut self) -> Option<usize> {
        self.lost.pop()
    }

    /// How long to wait for the acknowledgement of what is sent now.
    pub(super) fn time_out(&self) -> Duration {
        self.round_trip.time_out(0)
    }

    /// The peer says what has come. `now_stamp` is the stamp of a datagram that would be sent now. Returns the longest datagram that it took
    /// a value in, as far as that is certain; 0: none.
    pub(super) fn acknowledged(&mut self, said: &Acknowledgement, now_stamp: u32) -> usize {
        self.taken = self.taken.max(said.taken);
        let took_us = now_stamp.wrapping_sub(said.echo).saturating_sub(said.held_us);
        // A stamp that was never sent would look as old as the clock's turn.
        if took_us < u32::MAX / 2 {
            self.round_trip.measured(Duration::from_micros(took_us.into()));
        }
        let mut longest = 0;
        let Self { flight, flows, flight_bytes, .. } = self;
        flight.retain(|flight| {
            if !said.ranges().iter().any(|range| range.has(flight.number)) {
                return true;
            }
            if let Some(flow) = flows.get_mut(&flight.key).filter(|flow| flow.number == flight.number) {
                (flow.value, flow.state) = (None, State::Idle);
            }
            *flight_bytes -= flight.bytes;
            // It may have gone several times, with an acknowledgement or without.
            longest = longest.max(flight.bytes);
            false
        });
        if flight.is_empty() {
            self.next_due = Time::MAX;
        }
        longest
    }

    /// What is not known to have arrived, and makes a longer datagram than this, goes by the connection: [`hand_over`](Self::hand_over)
    /// follows. spec: DATAGRAM-7
    pub(super) fn turn_long_to_connection(&mut self, longest: usize) {
        for flow in self.flows.values_mut().filter(|flow| flow.bytes > longest) {
            flow.state = flow.state.for_connection();
        }
        let Self { flight, flows, flight_bytes, .. } = self;
        self.waiting.retain(|key| flows.get(key).is_some_and(|flow| flow.state == State::Waiting));
        flight.retain(|flight| {
            let stays = flight.bytes <= longest;
            *flight_bytes -= if stays { 0 } else { flight.bytes };
            stays
        });
        self.offer_at = Time::ZERO;
    }

    /// What is not known to have arrived goes by the connection: [`hand_over`](Self::hand_over) follows.
    pub(super) fn turn_to_connection(&mut self) {
        for flow in self.flows.values_mut() {
            flow.state = flow.state.for_connection();
        }
        self.clear();
        self.offer_at = Time::ZERO;
    }

    /// Offers the connection what is for it, if that is due: oldest first, with the numbers. What finds no room is kept, and offered again.
    pub(super) fn hand_over(&mut self, now: Time, mut offer: impl FnMut(u64, V) -> Offered<V>) {
        if now < self.offer_at {
            return;
        }
        self.offer_at = Time::MAX;
        for key in self.for_connection() {
            let Some(flow) = self.flows.get_mut(&key) else { continue };
            if flow.elsewhere > 0 {
                // Behind the newer one it would take its place there.
                self.offer_at = now + OFFER_PERIOD;
                continue;
            }
            let Some(value) = flow.value.take() else { continue };
            match offer(flow.number, value) {
                Offered::Taken => flow.state = State::Idle,
                Offered::Refused => {
                    let was_never_sent = flow.state.was_never_sent();
                    self.counts.lost += u64::from(was_never_sent);
                    self.counts.unknown += u64::from(!was_never_sent);
                    flow.state = State::Idle;
                }
                Offered::Full(value) => {
                    flow.value = Some(value);
                    self.offer_at = now + OFFER_PERIOD;
                    return;
                }
            }
        }
    }

    /// Flows whose value is for the connection, in the order of their numbers.
    fn for_connection(&self) -> Vec<K> {
        let is_for_it = |flow: &Flow<V>| matches!(flow.state, State::ForConnection { .. });
        let flows = self.flows.iter().filter(|(_, flow)| is_for_it(flow));
        let mut flows: Vec<_> = flows.map(|(key, flow)| (flow.number, *key)).collect();
        flows.sort_unstable();
        flows.into_iter().map(|(_, key)| key).collect()
    }

    /// When the connection is to be offered what is for it.
    pub(super) fn offer_at(&self) -> Option<Time> {
        Some(self.offer_at).filter(|at| *at != Time::MAX)
    }

    /// Nothing that is under way is of use any more.
    pub(super) fn end(&mut self) {
        for flow in self.flows.values_mut() {
            match flow.state {
                State::Idle => {}
                State::Waiting | State::ForConnection { was_sent: false } => self.counts.lost += 1,
                State::OnTheWay | State::ForConnection { was_sent: true } => self.counts.unknown += 1,
            }
            (flow.value, flow.state) = (None, State::Idle);
        }
        self.clear();
        self.offer_at = Time::MAX;
    }

    /// The peer has forgotten us and counts anew. What was sent by datagram it may have taken before or never: that is not known, and
    /// the newest value of each flow goes by the connection, as it may be the last one.
    pub(super) fn begin_anew(&mut self) {
        let on_the_way = self.flows.values().filter(|flow| flow.state == State::OnTheWay);
        self.counts.unknown += on_the_way.count() as u64;
        self.turn_to_connection();
        self.taken_before = self.taken_before.saturating_add(std::mem::take(&mut self.taken));
        self.round_trip = RoundTrip::default();
    }

    fn clear(&mut self) {
        self.waiting.clear();
        self.flight.clear();
        self.flight_bytes = 0;
        self.next_due = Time::MAX;
    }

    /// When something is due, if nothing happens before.
    pub(super) fn next_wake(&self) -> Option<Time> {
        Some(self.next_due.min(self.offer_at)).filter(|due| *due != Time::MAX)
    }

    /// Values that are not known to have arrived.
    pub(super) fn left(&self) -> usize {
        self.flows.values().filter(|flow| flow.state != State::Idle).count()
    }

    /// Where each value is.
    pub(super) fn position(&self) -> Position {
        let waiting = self.flows.values().filter(|flow| flow.state.was_never_sent()).count() as u64;
        // Of one that was superseded on its way it is not known yet whether it has arrived.
        let unacknowledged = self.flight.len() as u64;
        // What the peer says is believed as far as it can be so.
        let arrived = self.taken_before.saturating_add(self.taken);
        let arrived = arrived.min(self.counts.sent.saturating_sub(unacknowledged));
        Position { counts: self.counts, waiting, unacknowledged, arrived }
    }

    #[cfg(test)]
    pub(super) const fn counts(&self) -> Counts {
        self.counts
    }

    #[cfg(test)]
    pub(super) const fn on_the_way(&self) -> (usize, usize) {
        (self.flight.len(), self.flight_bytes)
    }

    #[cfg(test)]
    pub(super) const fn next_number(&self) -> u64 {
        self.next
    }
}

/// What finds no room says nothing new.
fn note_lost(lost: &mut Vec<usize>, length: usize) {
    if lost.len() < LOST_MAX {
        lost.push(length);
    }
}

impl State {
    /// The same where the value goes by the connection.
    const fn for_connection(self) -> Self {
        match self {
            Self::Waiting => Self::ForConnection { was_sent: false },
            Self::OnTheWay => Self::ForConnection { was_sent: true },
            stays @ (Self::Idle | Self::ForConnection { .. }) => stays,
        }
    }

    /// Whether there is a value that has gone out neither way.
    const fn was_never_sent(self) -> bool {
        matches!(self, Self::Waiting | Self::ForConnection { was_sent: false })
    }
}

impl Position {
    /// Values that were sent, superseded then, and have not arrived; with those that were never sent.
    pub(in crate::gncl) fn superseded(&self) -> u64 {
        self.counts.superseded + self.ended().0
    }

    /// Values that were too old, as far as they have not arrived after all.
    pub(in crate::gncl) fn expired(&self) -> u64 {
        self.counts.expired + self.ended().1
    }

    /// Of those that were sent and nobody can say whether they arrived.
    pub(in crate::gncl) fn unknown(&self) -> u64 {
        self.ended().2
    }

    /// All that were taken.
    pub(in crate::gncl) const fn taken(&self) -> u64 {
        let Counts { sent, superseded, expired, lost, .. } = self.counts;
        sent + superseded + expired + lost + self.waiting
    }

    /// What was sent and has neither arrived nor is under way: superseded, expired, unknown. Where an acknowledgement was lost, fewer have
    /// ended so than were counted when they did.
    fn ended(&self) -> (u64, u64, u64) {
        let rest = self.counts.sent - self.unacknowledged - self.arrived;
        let expired = self.counts.expired_late.min(rest);
        let unknown = self.counts.unknown.min(rest - expired);
        (rest - expired - unknown, expired, unknown)
    }
}
