//! Tells a client of its messages that nobody has taken.

use std::{cell::RefCell, sync::Arc};

use sinew_runtime::{outcome::Rejection, router::Outlet, tid::Tid, time::Time, wire::Kind};

use super::{
    super::{payload, undelivered::Ledger},
    ClientOutlet,
};

/// What one client is told. It lives on LNCL's thread.
pub(in crate::lncl) struct Notices {
    tid: Tid,
    outlet: Arc<ClientOutlet>,
    ledger: RefCell<Ledger>,
}

impl Notices {
    /// For a client whose longest payload has so many bytes.
    pub(super) fn new(tid: Tid, outlet: Arc<ClientOutlet>, payload_max: usize) -> Self {
        Self { tid, outlet, ledger: RefCell::new(Ledger::new(payload_max)) }
    }

    /// An unconfirmed message to `destination` was refused at `now`.
    pub(super) fn count(&self, destination: Tid, why: Rejection, now: Time) {
        self.ledger.borrow_mut().count(destination, why, now);
        self.tell(now);
    }

    /// Tells what is to be told at `now`. A client that takes nothing is told later.
    pub(in crate::lncl) fn tell(&self, now: Time) {
        // spec: LNCL-14
        let Some(undelivered) = self.ledger.borrow_mut().take(now) else { return };
        let frame =
            payload::frame(Kind::LNCL_UNDELIVERED, payload::lncl_of(self.tid.node), self.tid, &undelivered);
        if self.outlet.submit(frame).is_err() {
            self.ledger.borrow_mut().put_back(undelivered);
        }
    }
}
