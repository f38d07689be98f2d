//! One child of a supervisor, as its shell holds it.

use super::{Burials, ChildSpec, ChildState, tenant::Tenant, watchdog::Reprieve};
use crate::time::Time;

/// A child's declaration, and what holds its present life.
pub(super) struct Child {
    pub(super) spec: ChildSpec,
    pub(super) tenant: Option<Tenant>,
    /// What it was given of the time that it has to start or to stop.
    pub(super) reprieve: Option<Reprieve>,
    /// Nobody was told yet that this life has ended.
    pub(super) is_owed: bool,
    /// Why it could not start, as was logged; it has not started since.
    pub(super) cannot_start: Option<String>,
}

impl Child {
    pub(super) const fn new(spec: ChildSpec) -> Self {
        Self { spec, tenant: None, reprieve: None, is_owed: false, cannot_start: None }
    }

    /// Nobody makes it again: what makes it is the user's, and is not dropped here. Returns what is left of its life.
    pub(super) fn bury(self, burials: &Burials) -> Option<Tenant> {
        burials.bury(self.spec.name, self.spec.launch);
        self.tenant
    }

    /// Until when it has more time, if this is over.
    pub(super) fn reprieved(&mut self, state: ChildState, now: Time) -> Option<Time> {
        let vitals = self.tenant.as_ref()?.vitals();
        let (deadline, is_done) = match state {
            ChildState::Starting(deadline) => (deadline, vitals.is_ready() || vitals.is_leaving()),
            ChildState::Stopping(deadline) => (deadline, vitals.is_leaving()),
            ChildState::Down | ChildState::BackingOff(_) | ChildState::Ready => return None,
        };
        let is_over = deadline <= now;
        self.reprieve.as_mut().filter(|_| is_over)?.until(deadline, now, is_done)
    }
}
