//! The links of each client. They serve to notify its peers of an end that a link does not show: a child of
//! the ended process may hold the link's end. spec: LNCL-17

use std::{
    collections::BTreeMap,
    sync::{Arc, Mutex, PoisonError},
    time::Duration,
};

use sinew_protocol::payload::{self, Gone};
use sinew_runtime::{
    tid::{AppAddress, Tid},
    wire::Kind,
};

use super::{LinkBroker, LinkPeer};
use crate::process_watch::ProcessWatch;

/// Maximum number of links per client, equal to the maximum number of clients. Further links get no notification; their
/// own end shows it.
const LINKS_MAX: usize = 4_096;

/// Time in which a process must end after its connection closes, if its end was the cause. It takes a fraction of a
/// millisecond: an ending process closes its descriptors, and has ended then.
const EXIT_GRACE: Duration = Duration::from_millis(10);

/// The effect of a client's end on the peers of its links.
pub(crate) enum Departure {
    /// Its connection has ended. Links outlive it, and show their end themselves.
    LinksRemain,
    /// It has closed its connection. If the cause is its end, the process ends within [`EXIT_GRACE`].
    HungUp(ProcessWatch),
    /// Its process has ended.
    ProcessEnded,
}

/// The latest link with each peer. Any thread adds to them.
#[derive(Default)]
pub(super) struct EstablishedLinks(Mutex<BTreeMap<AppAddress, u64>>);

impl EstablishedLinks {
    pub(super) fn add(&self, other: &LinkPeer, number: u64) {
        let mut links = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if links.len() < LINKS_MAX || links.contains_key(&other.tid.app) {
            links.insert(other.tid.app, number);
        }
    }

    pub(super) fn forget(&self, other: AppAddress) {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).remove(&other);
    }

    fn take(&self) -> BTreeMap<AppAddress, u64> {
        std::mem::take(&mut *self.0.lock().unwrap_or_else(PoisonError::into_inner))
    }
}

impl LinkBroker {
    /// Removes `tid` from the link broker. If it has ended, or ends within [`EXIT_GRACE`], its link peers are
    /// notified.
    pub(crate) fn remove(&self, tid: Tid, departure: Departure) {
        self.pending.on_client_end(tid);
        let app = tid.app;
        let Some(ended) = self.peers.borrow_mut().remove(&app) else { return };
        let mut survivors = Vec::new();
        for (other, number) in ended.links.take() {
            let other = self.peers.borrow().get(&other).cloned();
            let Some(other) = other else { continue };
            other.links.forget(app);
            survivors.push((other, number));
        }
        match departure {
            Departure::LinksRemain => {}
            Departure::ProcessEnded => notify_all(&survivors, &ended),
            Departure::HungUp(process) => {
                // The client is removed before the wait, since its name and its slot are already free.
                if !survivors.is_empty() {
                    actix_rt::spawn(async move {
                        if tokio::time::timeout(EXIT_GRACE, process.ended()).await.is_ok() {
                            notify_all(&survivors, &ended);
                        }
                    });
                }
            }
        }
    }
}

fn notify_all(survivors: &[(Arc<LinkPeer>, u64)], ended: &LinkPeer) {
    survivors.iter().for_each(|(other, number)| notify(other, ended, *number));
}

/// Sends one frame for each link, without a bound: a missing one would leave its reader waiting for an ended
/// peer.
fn notify(to: &Arc<LinkPeer>, ended: &LinkPeer, number: u64) {
    let gone = Gone { peer: ended.tid.bits(), number };
    let frame = payload::frame(Kind::LNCL_GONE, payload::lncl_of(to.tid.node), to.tid, &gone);
    // An error means that the receiver is gone, too.
    let _ = to.outlet.submit_mark(frame);
}
