//! The sending end: a counter and the newest echo for each flow of protected messages.

use std::{
    collections::BTreeMap,
    sync::{Mutex, MutexGuard, PoisonError},
    time::Duration,
};

use bytes::Bytes;

use super::{
    Echo, Protection,
    envelope::{DataId, Stamp, seal},
    raw::Protected,
};
use crate::{
    tid::Tid,
    time::Time,
    wire::{Kind, Payload, encode},
};

/// Maximum number of concurrent flows of protected messages in one incarnation of an application.
pub(crate) const FLOWS_MAX: usize = 1_024;

/// The flows of protected messages of one incarnation of an application.
#[derive(Debug)]
pub(crate) struct Flows {
    incarnation: u64,
    table: Mutex<Table>,
}

#[derive(Debug, Default)]
struct Table {
    flows: BTreeMap<(Tid, Kind), Flow>,
    /// The greatest counter of a removed flow. New flows start above it, so a flow that is opened again never
    /// repeats a counter.
    forgotten: u64,
}

#[derive(Debug)]
struct Flow {
    counter: u64,
    echo: Time,
    /// When the last message of the flow was sent.
    used: Time,
    /// Time without a message after which the receiver's output is safe, at any message latency.
    lasts: Duration,
}

impl Flow {
    fn new(counter: u64, protection: Protection) -> Self {
        let lasts = protection.within.saturating_add(protection.age_max);
        Self { counter, echo: Time::ZERO, used: Time::ZERO, lasts }
    }

    fn is_over(&self, now: Time) -> bool {
        now.since(self.used) > self.lasts
    }
}

impl Table {
    /// Returns whether the table has room for one more flow, and removes an idle flow if it is full: the one
    /// that was used longest ago. A flow that is in use is never removed. Otherwise a sender with more
    /// receivers than flows would lose each of them in turn.
    fn makes_room(&mut self, now: Time) -> bool {
        if self.flows.len() < FLOWS_MAX {
            return true;
        }
        let over = self.flows.iter().filter(|(_, flow)| flow.is_over(now));
        let Some(key) = over.min_by_key(|(_, flow)| flow.used).map(|(key, _)| *key) else { return false };
        let counter = self.flows.remove(&key).map_or(0, |flow| flow.counter);
        self.forgotten = self.forgotten.max(counter);
        true
    }
}

impl Flows {
    /// Creates the flows of an incarnation that began at `now`: no two incarnations at a TID begin at the same time.
    pub(crate) const fn new(now: Time) -> Self {
        let table = Table { flows: BTreeMap::new(), forgotten: 0 };
        Self { incarnation: now.as_nanos(), table: Mutex::new(table) }
    }

    fn lock(&self) -> MutexGuard<'_, Table> {
        self.table.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Seals `value` in the next envelope of its flow. Returns `None` if too many flows are in use, or if the
    /// type is not protected.
    pub(crate) fn seal<P: Payload>(
        &self,
        source: Tid,
        destination: Tid,
        value: &P,
        now: Time,
    ) -> Option<Bytes> {
        let stamp = self.stamp((destination, P::KIND), P::PROTECTION?, now)?;
        Some(seal(&DataId::of::<P>(source, destination), stamp, &encode(value)))
    }

    /// Same as [`seal`](Self::seal), for a type that is known at run time only: `payload` is an encoded value of it.
    pub(crate) fn seal_payload(
        &self,
        (source, destination): (Tid, Tid),
        protected: &Protected,
        payload: &[u8],
        now: Time,
    ) -> Option<Bytes> {
        let stamp = self.stamp((destination, protected.kind), protected.protection, now)?;
        Some(seal(&DataId { source, destination, name: protected.name }, stamp, payload))
    }

    /// Returns whether no message was ever sealed.
    pub(crate) fn is_empty(&self) -> bool {
        self.lock().flows.is_empty()
    }

    fn stamp(&self, key: (Tid, Kind), protection: Protection, now: Time) -> Option<Stamp> {
        let mut table = self.lock();
        if !table.flows.contains_key(&key) && !table.makes_room(now) {
            return None;
        }
        let forgotten = table.forgotten;
        let flow = table.flows.entry(key).or_insert_with(|| Flow::new(forgotten, protection));
        flow.counter += 1;
        flow.used = now;
        Some(Stamp { counter: flow.counter, incarnation: self.incarnation, echo: flow.echo })
    }

    /// Returns whether there are flows to `receiver`.
    pub(crate) fn has_flow_to(&self, receiver: Tid) -> bool {
        self.lock().flows.keys().any(|(destination, _)| *destination == receiver)
    }

    /// Stores the echoed times of `from`, to be quoted in the next messages to it.
    pub(crate) fn record_echo(&self, from: Tid, echo: Echo) {
        let mut table = self.lock();
        let echoes = std::iter::once((echo.kind, echo.at_ns)).chain(echo.others);
        // The list is untrusted input, so its length is limited.
        for (kind, at_ns) in echoes.take(FLOWS_MAX) {
            if let Some(flow) = table.flows.get_mut(&(from, kind)) {
                flow.echo = Time::from_nanos(at_ns);
            }
        }
    }
}
