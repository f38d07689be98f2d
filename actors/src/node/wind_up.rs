//! What is left to do when the root itself has failed: its node ends in order, and says why.

use std::{
    cell::RefCell,
    rc::Rc,
    sync::{Arc, atomic::Ordering, mpsc::SyncSender},
    time::Duration,
};

use futures_util::StreamExt;
use sinew_runtime::{
    post::PostStream,
    supervision::{Input, Reason, Roster, Supervisor, SupervisorFact, overseen},
};

use super::{
    NodeEnd,
    root::{Root, RootEvent},
};
use crate::{last_words::LastWords, stores::Stores};

/// Time that the applications, and then the layers, have to end when the root has failed, beyond what each was declared with.
const WIND_UP_WITHIN: Duration = Duration::from_secs(5);

/// The supervisors of a node, for who has to end it without its root.
#[derive(Clone, Default)]
pub(super) struct Heirs(Rc<RefCell<Vec<(Branch, Roster)>>>);

/// Which of the root's two supervisors.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Branch {
    Layers,
    Apps,
}

impl Heirs {
    /// Runs a supervisor of the root's. If it fails itself, `event` says to the root that all of them have ended: when they
    /// have, and all that follows from their ends is done while the node can still speak.
    pub(super) fn run(
        &self,
        branch: Branch,
        supervisor: Supervisor,
        stores: &Arc<Stores>,
        event: fn(SupervisorFact) -> RootEvent,
    ) -> Roster {
        let (roster, root) = (supervisor.roster(), stores.posts.root.clone());
        self.0.borrow_mut().push((branch, roster.clone()));
        let ended = supervisor.oversee();
        actix_rt::spawn(async move {
            let reason = ended.await;
            if reason.is_failure() {
                let why = format!("their supervisor {reason}");
                crate::log::error!(?branch, why, "all that it supervised have ended");
                if root.post(event(SupervisorFact::Ended(Reason::GaveUp(why)))).is_err() {
                    crate::log::error!("the root's post is full");
                }
            }
        });
        roster
    }

    /// Time that the children of this branch have to stop, if there is one.
    fn stop_within(&self, wanted: Branch) -> Option<Duration> {
        let branches = self.0.borrow();
        branches.iter().find(|(branch, _)| *branch == wanted).map(|(_, roster)| roster.stop_within())
    }

    fn stop(&self, wanted: Branch) {
        for (_, roster) in self.0.borrow().iter().filter(|(branch, _)| *branch == wanted) {
            // One that ended before reads no more orders.
            let _ = roster.tell(Input::StopOrdered);
        }
    }
}

/// Runs the root, to its end and beyond if it fails.
pub(super) async fn oversee(root: Root, heirs: Heirs, stores: Arc<Stores>, ended: SyncSender<NodeEnd>) {
    let reason = overseen("root", root).await;
    if !reason.is_failure() {
        return;
    }
    crate::log::error!(%reason, "the root failed: the node ends in order");
    let mut events = stores.posts.root.attach();
    heirs.stop(Branch::Apps);
    wait(&mut events, Branch::Apps, &heirs).await;
    let why = format!("the root {reason}");
    let _ = stores.gave_up.set(LastWords::of(&why));
    stores.stopping.store(true, Ordering::Relaxed);
    heirs.stop(Branch::Layers);
    wait(&mut events, Branch::Layers, &heirs).await;
    stores.close();
    // The owner may be gone: then nobody wants to know.
    let _ = ended.try_send(NodeEnd::GaveUp(why));
}

/// Waits until this branch has ended, if there is one, and not for ever: its supervisor keeps the time of each child.
async fn wait(events: &mut PostStream<RootEvent>, wanted: Branch, heirs: &Heirs) {
    let Some(within) = heirs.stop_within(wanted) else { return };
    let end = async {
        while let Some(event) = events.next().await {
            let is_end = match wanted {
                Branch::Apps => matches!(event, RootEvent::Apps(SupervisorFact::Ended(_))),
                Branch::Layers => matches!(event, RootEvent::Layers(SupervisorFact::Ended(_))),
            };
            // Nobody is left to decide on anything else.
            if is_end {
                return;
            }
        }
    };
    if tokio::time::timeout(within.saturating_add(WIND_UP_WITHIN), end).await.is_err() {
        crate::log::error!(?wanted, "they did not end in their time; the process has to end them");
    }
}
