//! The shutdown after a failure of the root itself: the node ends in order, and reports why.

use std::{
    cell::RefCell,
    rc::Rc,
    sync::{Arc, atomic::Ordering, mpsc::SyncSender},
    time::Duration,
};

use futures_util::StreamExt;
use sinew_model::leave_reason::LeaveReason;
use sinew_runtime::{
    event_queue::EventStream,
    supervision::{Input, Reason, Supervisor, SupervisorFact, SupervisorHandle, overseen},
};

use super::{
    NodeEnd,
    root::{Root, RootEvent},
};
use crate::NodeState;

/// Time limit for the end of the applications, and then of the layers, after the root has failed, in addition
/// to their declared limits.
const SHUTDOWN_TIMEOUT: Duration = Duration::from_secs(5);

/// Handles of a node's supervisors, for a shutdown without the root.
#[derive(Clone, Default)]
pub(super) struct SupervisorHandles(Rc<RefCell<Vec<(Branch, SupervisorHandle)>>>);

/// One of the root's two supervisors.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Branch {
    Layers,
    Apps,
}

impl SupervisorHandles {
    /// Runs a supervisor of the root. If it fails itself, `event` reports to the root that all its children
    /// have ended, once they have. All actions that follow from these ends are done while the node can still
    /// send.
    pub(super) fn run(
        &self,
        branch: Branch,
        supervisor: Supervisor,
        state: &Arc<NodeState>,
        event: fn(SupervisorFact) -> RootEvent,
    ) -> SupervisorHandle {
        let (handle, root) = (supervisor.new_handle(), state.root.clone());
        self.0.borrow_mut().push((branch, handle.clone()));
        let ended = supervisor.oversee();
        actix_rt::spawn(async move {
            let reason = ended.await;
            if reason.is_failure() {
                let why = format!("their supervisor {reason}");
                sinew_runtime::log::error!(?branch, why, "all that it supervised have ended");
                if root.post(event(SupervisorFact::Ended(Reason::GaveUp(why)))).is_err() {
                    sinew_runtime::log::error!("the root's event queue is full");
                }
            }
        });
        handle
    }

    /// Returns the time limit for the stop of this branch's children, if the branch exists.
    fn stop_within(&self, wanted: Branch) -> Option<Duration> {
        let branches = self.0.borrow();
        branches.iter().find(|(branch, _)| *branch == wanted).map(|(_, handle)| handle.stop_within())
    }

    fn stop(&self, wanted: Branch) {
        for (_, handle) in self.0.borrow().iter().filter(|(branch, _)| *branch == wanted) {
            // A supervisor that has ended reads no more orders.
            let _ = handle.send(Input::StopOrdered);
        }
    }
}

/// Runs the root to its end, and shuts the node down if the root fails.
pub(super) async fn oversee(
    root: Root,
    supervisors: SupervisorHandles,
    state: Arc<NodeState>,
    ended: SyncSender<NodeEnd>,
) {
    let reason = overseen("root", root).await;
    if !reason.is_failure() {
        return;
    }
    sinew_runtime::log::error!(%reason, "the root failed: the node ends in order");
    state.recording.stop_ordered();
    let mut events = state.root.attach();
    supervisors.stop(Branch::Apps);
    wait(&mut events, Branch::Apps, &supervisors).await;
    let why = format!("the root {reason}");
    let _ = state.ctx.gave_up.set(LeaveReason::of(&why));
    state.ctx.stopping.store(true, Ordering::Relaxed);
    supervisors.stop(Branch::Layers);
    wait(&mut events, Branch::Layers, &supervisors).await;
    state.close();
    // The owner may have been dropped.
    let _ = ended.try_send(NodeEnd::GaveUp(why));
}

/// Waits until this branch has ended, if it exists, up to a limit: its supervisor enforces the limit of each child.
async fn wait(events: &mut EventStream<RootEvent>, wanted: Branch, supervisors: &SupervisorHandles) {
    let Some(within) = supervisors.stop_within(wanted) else { return };
    let end = async {
        while let Some(event) = events.next().await {
            let is_end = match wanted {
                Branch::Apps => matches!(event, RootEvent::Apps(SupervisorFact::Ended(_))),
                Branch::Layers => matches!(event, RootEvent::Layers(SupervisorFact::Ended(_))),
            };
            // No actor is left that could decide on other events.
            if is_end {
                return;
            }
        }
    };
    if tokio::time::timeout(within.saturating_add(SHUTDOWN_TIMEOUT), end).await.is_err() {
        sinew_runtime::log::error!(?wanted, "they did not end in their time; the process has to end them");
    }
}
