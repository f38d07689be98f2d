//! The sending end: a counter and the newest echo of each flow of protected messages.

use std::{
    collections::BTreeMap,
    sync::{Mutex, PoisonError},
};

use bytes::Bytes;

use super::{
    Echo,
    envelope::{Codename, Stamp, seal},
};
use crate::{
    tid::Tid,
    time::Time,
    wire::{Kind, Payload, encode},
};

/// Flows of protected messages that one life of an application can have.
pub(crate) const FLOWS_MAX: usize = 1_024;

/// The flows of protected messages of one life of an application.
#[derive(Debug)]
pub(crate) struct Flows {
    incarnation: u64,
    flows: Mutex<BTreeMap<(Tid, Kind), Flow>>,
}

#[derive(Debug, Default)]
struct Flow {
    counter: u64,
    echo: Time,
}

impl Flows {
    /// Those of a life that began at `now`: no two lives at a TID begin at the same time.
    pub(crate) const fn new(now: Time) -> Self {
        Self { incarnation: now.as_nanos(), flows: Mutex::new(BTreeMap::new()) }
    }

    /// `value` in the next envelope of its flow; `None` if there are too many flows.
    pub(crate) fn seal<P: Payload>(&self, source: Tid, destination: Tid, value: &P) -> Option<Bytes> {
        let stamp = {
            let mut flows = self.flows.lock().unwrap_or_else(PoisonError::into_inner);
            let key = (destination, P::KIND);
            if flows.len() >= FLOWS_MAX && !flows.contains_key(&key) {
                return None;
            }
            let flow = flows.entry(key).or_default();
            flow.counter += 1;
            Stamp { counter: flow.counter, incarnation: self.incarnation, echo: flow.echo }
        };
        Some(seal(&Codename::of::<P>(source, destination), stamp, &encode(value)))
    }

    /// Whether there are flows to `receiver`.
    pub(crate) fn are_to(&self, receiver: Tid) -> bool {
        let flows = self.flows.lock().unwrap_or_else(PoisonError::into_inner);
        flows.keys().any(|(destination, _)| *destination == receiver)
    }

    /// `from` is to find these times in the next messages that are sent to it.
    pub(crate) fn heard(&self, from: Tid, echo: Echo) {
        let mut flows = self.flows.lock().unwrap_or_else(PoisonError::into_inner);
        let echoes = std::iter::once((echo.kind, echo.at_ns)).chain(echo.others);
        // It comes from outside.
        for (kind, at_ns) in echoes.take(FLOWS_MAX) {
            if let Some(flow) = flows.get_mut(&(from, kind)) {
                flow.echo = Time::from_nanos(at_ns);
            }
        }
    }
}
