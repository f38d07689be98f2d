//! Clients with rings in creation, and link requests to them. The requests are handled when the rings exist.

use std::{cell::RefCell, collections::BTreeMap, sync::Arc};

use sinew_runtime::{outcome::Rejection, tid::Tid, time::Time};

use super::{
    LinkBroker, LinkPeer, LinkRequest, notify_rejected,
    unanswered::{Processes, Unanswered},
};

/// A link request to a client that cannot have links yet.
pub(super) struct PendingRequest {
    pub(super) requester: Arc<LinkPeer>,
    pub(super) to: Tid,
    pub(super) request: LinkRequest,
}

/// All such clients and requests.
#[derive(Default)]
pub(super) struct PendingRings {
    /// The process of each, as the kernel reports it.
    expected: RefCell<BTreeMap<Tid, u32>>,
    /// Bounded like the requests that wait for an answer, although these cost no descriptors.
    asked: RefCell<Unanswered<PendingRequest>>,
}

impl LinkBroker {
    /// Announces that `tid`, of the process `pid`, will be able to have links soon. Requests to it wait until then.
    pub(crate) fn expect(&self, tid: Tid, pid: u32) {
        self.pending.expected.borrow_mut().insert(tid, pid);
    }

    /// Announces that `tid` will have no links.
    pub(crate) fn expect_no_more(&self, tid: Tid) {
        self.pending.remove(tid);
    }
}

impl PendingRings {
    pub(super) fn is_expected(&self, tid: Tid) -> bool {
        self.expected.borrow().contains_key(&tid)
    }

    /// Stores a request until its target can have links.
    ///
    /// # Errors
    /// [`Rejection::QueueFull`]: too many requests wait in all, or of one process.
    pub(super) fn wait(&self, asked: PendingRequest, now: Time) -> Result<(), Rejection> {
        let peer = self.expected.borrow().get(&asked.to).copied().unwrap_or_default();
        let of = Processes { requester: asked.requester.pid, peer };
        let mut waiting = self.asked.borrow_mut();
        if !waiting.has_room_for(of) {
            return Err(Rejection::QueueFull);
        }
        waiting.insert(asked.request.number, of, asked, now);
        Ok(())
    }

    /// Returns the requests to `tid`, which can have links now, and the time of each.
    pub(super) fn arrived(&self, tid: Tid) -> Vec<(PendingRequest, Time)> {
        self.expected.borrow_mut().remove(&tid);
        self.asked.borrow_mut().remove_if(|asked| asked.to == tid)
    }

    /// Rejects the requests to `tid`, which will have no links.
    fn remove(&self, tid: Tid) {
        for (PendingRequest { requester, to, request }, _) in self.arrived(tid) {
            notify_rejected(&requester, to, request, Rejection::Unsupported);
        }
    }

    /// Drops the requests of `tid`, which is gone, and rejects the requests to it.
    pub(super) fn on_client_end(&self, tid: Tid) {
        drop(self.asked.borrow_mut().remove_if(|asked| asked.requester.tid == tid));
        self.remove(tid);
    }

    /// Rejects the requests that have waited too long at `now`. Returns whether requests are left.
    pub(super) fn expire(&self, now: Time) -> bool {
        let late = self.asked.borrow_mut().expire(now);
        for PendingRequest { requester, to, request } in late {
            notify_rejected(&requester, to, request, Rejection::QueueFull);
        }
        !self.asked.borrow().is_empty()
    }
}
