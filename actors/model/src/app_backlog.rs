//! The backlog of facts on this node's applications for the sync manager and for NDL.
//!
//! If the event queue of a layer is full, its facts wait here, until the layer has read some events. For each
//! application the backlog keeps the end of the incarnation that the layer knows, and the current state. So the backlog
//! is bounded by the number of applications, and a layer that stalls ends with the registry's state.

use std::sync::Mutex;

use sinew_runtime::{lock, tid::AppAddress};

use crate::{
    event_backlog::{CoalescingRules, EventBacklog, Role},
    events::{EventQueues, NdlEvent, SyncEvent},
    facts::AppFact,
};

/// Maximum number of pending facts per application: the end of the former incarnation, the start of the
/// present one, its kinds, the structures of its types, and its last failure and readiness.
const PER_APP_MAX: usize = 6;

/// The backlogs of both layers. They outlive the layers.
#[derive(Debug)]
pub struct AppBacklogs {
    sync: Mutex<EventBacklog<Reader>>,
    ndl: Mutex<EventBacklog<Reader>>,
}

/// The layer that reads a backlog.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Reader {
    Sync,
    Ndl,
}

impl CoalescingRules for Reader {
    type Event = AppFact;
    /// `None` for facts that concern no application.
    type Subject = Option<AppAddress>;
    /// The facts do not tell incarnations of an application apart.
    type Incarnation = ();

    const KEEPS_UNKNOWN_ENDS: bool = false;

    fn subject(&self, fact: &AppFact) -> Option<AppAddress> {
        match fact {
            AppFact::Registered { app, .. }
            | AppFact::Handles { app, .. }
            | AppFact::Types { app, .. }
            | AppFact::Ready { app }
            | AppFact::Down { app }
            | AppFact::Stopped { app }
            | AppFact::Unregistered { app } => Some(*app),
            AppFact::GroupsChanged => None,
        }
    }

    fn role(&self, fact: &AppFact) -> Role<()> {
        match (self, fact) {
            (Self::Sync, AppFact::Registered { .. }) | (Self::Ndl, AppFact::Ready { .. }) => Role::Begins(()),
            (_, AppFact::Unregistered { .. })
            | (Self::Ndl, AppFact::Down { .. } | AppFact::Stopped { .. }) => Role::Ends(()),
            (Self::Sync, AppFact::Ready { .. } | AppFact::Down { .. } | AppFact::Stopped { .. })
            | (_, AppFact::Handles { .. } | AppFact::Types { .. })
            | (Self::Ndl, AppFact::Registered { .. }) => Role::Changes,
            (_, AppFact::GroupsChanged) => Role::Standalone,
        }
    }

    fn supersedes(&self, later: &AppFact, former: &AppFact) -> bool {
        if matches!(self.role(later), Role::Begins(()) | Role::Ends(())) {
            return !matches!(self.role(former), Role::Ends(()));
        }
        match later {
            AppFact::Down { .. } | AppFact::Stopped { .. } => {
                matches!(former, AppFact::Ready { .. } | AppFact::Down { .. } | AppFact::Stopped { .. })
            }
            AppFact::Ready { .. } => matches!(former, AppFact::Ready { .. }),
            AppFact::Handles { .. } => matches!(former, AppFact::Handles { .. }),
            AppFact::Types { .. } => matches!(former, AppFact::Types { .. }),
            AppFact::GroupsChanged => matches!(former, AppFact::GroupsChanged),
            AppFact::Registered { .. } | AppFact::Unregistered { .. } => false,
        }
    }
}

impl AppBacklogs {
    /// Creates empty backlogs, for at most `apps_max` applications.
    #[must_use]
    pub fn new(apps_max: usize) -> Self {
        // One more for the groups.
        let capacity = apps_max.saturating_mul(PER_APP_MAX).saturating_add(1);
        Self {
            sync: Mutex::new(EventBacklog::new(Reader::Sync, capacity)),
            ndl: Mutex::new(EventBacklog::new(Reader::Ndl, capacity)),
        }
    }

    /// Queues a fact for the sync manager behind its backlog. Returns whether the event queue took all of it. The
    /// caller holds the registry's lock, so that facts are queued in the order in which they occur.
    pub fn queue_for_sync(&self, event_queues: &EventQueues, fact: AppFact) -> bool {
        let mut backlog = lock(&self.sync);
        backlog.push(fact);
        offer_to_sync(&mut backlog, event_queues)
    }

    /// Same as [`Self::queue_for_sync`], for NDL.
    pub fn queue_for_ndl(&self, event_queues: &EventQueues, fact: AppFact) -> bool {
        let mut backlog = lock(&self.ndl);
        backlog.push(fact);
        offer_to_ndl(&mut backlog, event_queues)
    }

    /// Moves as much of the backlog into the sync manager's event queue as fits. The sync manager calls it after each
    /// event. No fact is missed: a producer that finds the queue full stores its fact under the same lock, before the
    /// next read.
    pub fn offer_to_sync(&self, event_queues: &EventQueues) -> bool {
        offer_to_sync(&mut lock(&self.sync), event_queues)
    }

    /// Same as [`Self::offer_to_sync`], for NDL.
    pub fn offer_to_ndl(&self, event_queues: &EventQueues) -> bool {
        offer_to_ndl(&mut lock(&self.ndl), event_queues)
    }

    /// Returns the length of the longer backlog.
    pub fn most(&self) -> usize {
        [&self.sync, &self.ndl].map(|backlog| lock(backlog).len()).into_iter().max().unwrap_or(0)
    }
}

fn offer_to_sync(backlog: &mut EventBacklog<Reader>, event_queues: &EventQueues) -> bool {
    backlog.offer(|fact| event_queues.sync.post(SyncEvent::App(fact.clone())).is_ok())
}

fn offer_to_ndl(backlog: &mut EventBacklog<Reader>, event_queues: &EventQueues) -> bool {
    backlog.offer(|fact| event_queues.ndl.post(NdlEvent::App(fact.clone())).is_ok())
}

#[cfg(test)]
mod tests;
