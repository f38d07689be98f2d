//! The sending end: a counter and the newest echo of each flow of protected messages.

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

/// Flows of protected messages that one life of an application can have at once.
pub(crate) const FLOWS_MAX: usize = 1_024;

/// The flows of protected messages of one life of an application.
#[derive(Debug)]
pub(crate) struct Flows {
    incarnation: u64,
    table: Mutex<Table>,
}

#[derive(Debug, Default)]
struct Table {
    flows: BTreeMap<(Tid, Kind), Flow>,
    /// The greatest counter of a flow that was forgotten. New ones begin above it: one that comes back says no number twice.
    forgotten: u64,
}

#[derive(Debug)]
struct Flow {
    counter: u64,
    echo: Time,
    /// When something was sent last.
    used: Time,
    /// Time without a message after which the receiver's output is safe, however long the last one was under way.
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
    /// Whether there is room for one more: the one that is over and was used longest ago is forgotten for it. One that goes on is not, as
    /// more receivers than there are flows would all lose theirs by turns.
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
    /// Those of a life that began at `now`: no two lives at a TID begin at the same time.
    pub(crate) const fn new(now: Time) -> Self {
        let table = Table { flows: BTreeMap::new(), forgotten: 0 };
        Self { incarnation: now.as_nanos(), table: Mutex::new(table) }
    }

    fn lock(&self) -> MutexGuard<'_, Table> {
        self.table.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// `value` in the next envelope of its flow; `None` if there are too many flows that go on, or if its type is not protected.
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

    /// The same for who knows the type at run time alone: `payload` is a value of it.
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

    /// Whether nothing was ever sealed here.
    pub(crate) fn are_none(&self) -> bool {
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

    /// Whether there are flows to `receiver`.
    pub(crate) fn are_to(&self, receiver: Tid) -> bool {
        self.lock().flows.keys().any(|(destination, _)| *destination == receiver)
    }

    /// `from` is to find these times in the next messages that are sent to it.
    pub(crate) fn heard(&self, from: Tid, echo: Echo) {
        let mut table = self.lock();
        let echoes = std::iter::once((echo.kind, echo.at_ns)).chain(echo.others);
        // It comes from outside.
        for (kind, at_ns) in echoes.take(FLOWS_MAX) {
            if let Some(flow) = table.flows.get_mut(&(from, kind)) {
                flow.echo = Time::from_nanos(at_ns);
            }
        }
    }
}
