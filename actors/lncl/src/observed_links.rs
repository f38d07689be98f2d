//! Observation of direct links: their messages bypass the node, so the watched client reports them. spec: LNCL-20

use std::{
    collections::BTreeMap,
    sync::{Mutex, MutexGuard, PoisonError},
};

use sinew_protocol::payload::{self, Observe};
use sinew_runtime::{router::Router, tid::Tid, wire::Kind};

/// The clients that can have direct links.
#[derive(Debug, Default)]
pub struct ObservedLinks(Mutex<BTreeMap<Tid, Observation>>);

/// Whether a client's links are observed, and what the client was told last.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Observation {
    is_wanted: bool,
    is_told: bool,
}

impl ObservedLinks {
    /// Adds a client. Returns whether [`retry`](Self::retry) must tell it later.
    pub(super) fn add(&self, router: &Router, client: Tid) -> bool {
        let mut clients = self.lock();
        let observation = clients.entry(client).or_default();
        *observation = Observation { is_wanted: router.is_observed(client), is_told: false };
        !observation.tell(router, client)
    }

    pub(super) fn remove(&self, client: Tid) {
        self.lock().remove(&client);
    }

    /// Observes the links of the applications that a tap watches, and of no others. Returns whether a client must be
    /// told later.
    pub fn observe(&self, router: &Router) -> bool {
        let mut is_left = false;
        for (client, observation) in self.lock().iter_mut() {
            observation.is_wanted = router.is_observed(*client);
            is_left |= !observation.tell(router, *client);
        }
        is_left
    }

    /// Notifies the clients that had no room in their queues. Returns whether some still have none.
    pub(super) fn retry(&self, router: &Router) -> bool {
        let mut is_left = false;
        for (client, observation) in self.lock().iter_mut() {
            is_left |= !observation.tell(router, *client);
        }
        is_left
    }

    fn lock(&self) -> MutexGuard<'_, BTreeMap<Tid, Observation>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Observation {
    /// Tells the client, unless it knows. Returns whether it knows; without room in its queue it is told later.
    fn tell(&mut self, router: &Router, client: Tid) -> bool {
        if self.is_wanted == self.is_told {
            return true;
        }
        let observe = Observe { on: self.is_wanted };
        let frame = payload::frame(Kind::LNCL_OBSERVE, payload::lncl_of(client.node), client, &observe);
        if router.notify_app(client.app, frame).is_ok() {
            self.is_told = self.is_wanted;
        }
        self.is_told == self.is_wanted
    }
}
