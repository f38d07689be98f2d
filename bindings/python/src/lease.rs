//! An endpoint that one operation has.

use std::{
    ops::{Deref, DerefMut},
    sync::{Arc, Mutex, PoisonError},
};

use sinew_client::{AsyncEndpoint, Transport};
use tokio::sync::OwnedMutexGuard;

use crate::parameters::Registered;

/// The properties of an endpoint, as of the end of its last operation.
pub(crate) struct Facts {
    pub(crate) tid: u64,
    pub(crate) registrations: u64,
    pub(crate) node_name: String,
    pub(crate) payload_max: usize,
    pub(crate) is_ring: bool,
}

impl Facts {
    pub(crate) fn of(endpoint: &AsyncEndpoint) -> Self {
        Self {
            tid: endpoint.tid().bits(),
            registrations: endpoint.registrations(),
            node_name: endpoint.node_name().to_owned(),
            payload_max: endpoint.payload_max(),
            is_ring: endpoint.transport() == Transport::Ring,
        }
    }
}

/// The endpoint, for one operation.
pub(crate) struct Lease {
    pub(crate) endpoint: OwnedMutexGuard<Option<Registered>>,
    pub(crate) facts: Arc<Mutex<Facts>>,
}

impl Deref for Lease {
    type Target = Option<Registered>;

    fn deref(&self) -> &Option<Registered> {
        &self.endpoint
    }
}

impl DerefMut for Lease {
    fn deref_mut(&mut self) -> &mut Option<Registered> {
        &mut self.endpoint
    }
}

impl Drop for Lease {
    fn drop(&mut self) {
        if let Some(Registered { endpoint, .. }) = &*self.endpoint {
            let mut facts = self.facts.lock().unwrap_or_else(PoisonError::into_inner);
            // All others change with a registration alone.
            if facts.registrations != endpoint.registrations() {
                *facts = Facts::of(endpoint);
            }
        }
    }
}
