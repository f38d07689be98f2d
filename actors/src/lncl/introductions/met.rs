//! Who has a link with whom, so that they are told of a death that the link does not show: a child of the dead process may hold its
//! end. spec: LNCL-17

use std::{
    collections::BTreeMap,
    sync::{Arc, Mutex, PoisonError},
    time::Duration,
};

use sinew_runtime::{
    tid::{AppAddress, Tid},
    wire::Kind,
};

use super::{Introductions, Party};
use crate::lncl::{
    client::life::Life,
    payload::{self, Gone},
};

/// Those of one client at most: as many as there may be clients. Of one more nothing is told here; the link's own end is seen.
const MET_MAX: usize = 4_096;

/// Time that a process whose connection was closed has to end, if that was why. It takes a fraction of a millisecond: a process that ends closes
/// what it has, and is dead then.
const DYING: Duration = Duration::from_millis(10);

/// How a client leaves those to whom it was introduced.
pub(in crate::lncl) enum Leaves {
    /// Its connection has ended; links outlive that, and show their end by themselves.
    WithItsLinks,
    /// It has closed its connection; if it did so because it ends, its life shows that in a moment.
    HungUp(Life),
    /// Its process has ended.
    Dead,
}

/// The last link with each. Any thread adds to them.
#[derive(Default)]
pub(super) struct Met(Mutex<BTreeMap<AppAddress, u64>>);

impl Met {
    pub(super) fn add(&self, other: &Party, number: u64) {
        let mut met = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if met.len() < MET_MAX || met.contains_key(&other.tid.app) {
            met.insert(other.tid.app, number);
        }
    }

    pub(super) fn forget(&self, other: AppAddress) {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).remove(&other);
    }

    fn take(&self) -> BTreeMap<AppAddress, u64> {
        std::mem::take(&mut *self.0.lock().unwrap_or_else(PoisonError::into_inner))
    }
}

impl Introductions {
    /// `tid` cannot be met any more. If it is dead, or is so in a moment, those who have a link with it are told.
    pub(in crate::lncl) fn remove(&self, tid: Tid, leaves: Leaves) {
        self.coming.gone(tid);
        let app = tid.app;
        let Some(party) = self.parties.borrow_mut().remove(&app) else { return };
        let mut survivors = Vec::new();
        for (other, number) in party.met.take() {
            let other = self.parties.borrow().get(&other).cloned();
            let Some(other) = other else { continue };
            other.met.forget(app);
            survivors.push((other, number));
        }
        match leaves {
            Leaves::WithItsLinks => {}
            Leaves::Dead => tell_all(&survivors, &party),
            Leaves::HungUp(life) => {
                // Not where it can be met: its name and its place are free already.
                if !survivors.is_empty() {
                    actix_rt::spawn(async move {
                        if tokio::time::timeout(DYING, life.ended()).await.is_ok() {
                            tell_all(&survivors, &party);
                        }
                    });
                }
            }
        }
    }
}

fn tell_all(survivors: &[(Arc<Party>, u64)], dead: &Party) {
    survivors.iter().for_each(|(other, number)| tell(other, dead, *number));
}

/// One frame for each link, whatever the bounds: else its reader would wait for the dead.
fn tell(to: &Arc<Party>, dead: &Party, number: u64) {
    let gone = Gone { peer: dead.tid.bits(), number };
    let frame = payload::frame(Kind::LNCL_GONE, payload::lncl_of(to.tid.node), to.tid, &gone);
    // Not taken: it has gone, too.
    let _ = to.outlet.submit_mark(frame);
}
