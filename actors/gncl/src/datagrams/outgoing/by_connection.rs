//! Values that go over the connection: in place of a newer datagram, or because datagrams do not get through.

use std::time::Duration;

use sinew_runtime::time::Time;

use super::{Flow, Offered, Outgoing, State};

/// Period of offers to a connection that had no room.
const OFFER_PERIOD: Duration = Duration::from_millis(10);

impl<K: Ord + Copy, V> Outgoing<K, V> {
    /// Returns the number for a value that is being submitted to the connection. The flow's datagram value is
    /// kept until that one [is taken](Self::accepted_by_connection): if it is not, the older value is the last one.
    pub fn start_on_connection(&mut self, key: K) -> u64 {
        if let Some(flow) = self.flows.get_mut(&key) {
            flow.in_submission += 1;
        }
        self.number()
    }

    /// Records that the connection has accepted the value with this number: an older value is superseded.
    pub fn accepted_by_connection(&mut self, key: K, number: u64) {
        self.rejected_by_connection(key);
        let Some(flow) = self.flows.get_mut(&key).filter(|flow| flow.number < number) else { return };
        self.counts.superseded += u64::from(flow.state.was_never_sent());
        if flow.state == State::Waiting {
            self.waiting.retain(|waits| *waits != key);
        }
        (flow.value, flow.state) = (None, State::Idle);
    }

    /// Records that the connection has not accepted the value.
    pub fn rejected_by_connection(&mut self, key: K) {
        if let Some(flow) = self.flows.get_mut(&key) {
            flow.in_submission = flow.in_submission.saturating_sub(1);
        }
    }

    /// Assigns unacknowledged values that need a datagram longer than this to the connection: the caller
    /// calls [`offer_to_connection`](Self::offer_to_connection) next. spec: DATAGRAM-7
    pub(in crate::datagrams) fn assign_long_to_connection(&mut self, longest: usize) {
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

    /// Assigns all unacknowledged values to the connection: the caller calls
    /// [`offer_to_connection`](Self::offer_to_connection) next.
    pub(in crate::datagrams) fn assign_to_connection(&mut self) {
        for flow in self.flows.values_mut() {
            flow.state = flow.state.for_connection();
        }
        self.clear();
        self.offer_at = Time::ZERO;
    }

    /// Offers values to the connection, if that is due: oldest first, with their numbers. Values without room
    /// are kept, and offered again.
    pub fn offer_to_connection(&mut self, now: Time, mut offer: impl FnMut(u64, V) -> Offered<V>) {
        if now < self.offer_at {
            return;
        }
        self.offer_at = Time::MAX;
        for key in self.for_connection() {
            let Some(flow) = self.flows.get_mut(&key) else { continue };
            if flow.in_submission > 0 {
                // Behind the newer value, this one would supersede it there.
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

    /// Returns the flows with a value for the connection, in the order of their numbers.
    fn for_connection(&self) -> Vec<K> {
        let is_for_it = |flow: &Flow<V>| matches!(flow.state, State::ForConnection { .. });
        let flows = self.flows.iter().filter(|(_, flow)| is_for_it(flow));
        let mut flows: Vec<_> = flows.map(|(key, flow)| (flow.number, *key)).collect();
        flows.sort_unstable();
        flows.into_iter().map(|(_, key)| key).collect()
    }

    /// Returns when values must be offered to the connection.
    pub(in crate::datagrams) fn offer_at(&self) -> Option<Time> {
        Some(self.offer_at).filter(|at| *at != Time::MAX)
    }
}
