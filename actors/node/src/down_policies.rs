//! The ends and restarts of this node's applications, handled as soon as their supervisor reports them.

use std::{cell::RefCell, collections::BTreeMap, rc::Rc, sync::Arc};

use sinew_runtime::{
    app::DownState,
    supervision::{ChildId, Command, SupervisorFact},
};
use sinew_sync::{monitors, wills};

use crate::NodeState;

/// The state of each application while it is down. Clones share it.
#[derive(Clone)]
pub(super) struct DownPolicies {
    apps: Rc<RefCell<BTreeMap<ChildId, DownState>>>,
    state: Arc<NodeState>,
}

impl DownPolicies {
    /// Returns an empty table.
    pub(super) fn new(state: Arc<NodeState>) -> Self {
        Self { apps: Rc::default(), state }
    }

    /// Adds the supervised application `id`.
    pub(super) fn insert(&self, id: ChildId, down_state: DownState) {
        self.apps.borrow_mut().insert(id, down_state);
    }

    /// Removes an application that is not supervised any more, or never was.
    pub(super) fn remove(&self, id: ChildId) {
        self.apps.borrow_mut().remove(&id);
    }

    /// Handles a supervisor's event. The supervisor itself calls this, before any other action on the child.
    pub(super) fn handle(&self, fact: &SupervisorFact) {
        match fact {
            SupervisorFact::Ready(id) => {
                if let Some(down_state) = self.get(*id) {
                    down_state.on_ready();
                    let (app, wills) = (down_state.tid().app, down_state.wills());
                    wills::feed(&self.state.sync, wills::Input::Ready { app, wills });
                }
            }
            SupervisorFact::Failed(id, reason) | SupervisorFact::Gone(id, reason) => {
                if let Some(down_state) = self.get(*id) {
                    down_state.on_end(reason);
                    let is_gone = matches!(fact, SupervisorFact::Gone(..));
                    let app = down_state.tid().app;
                    let ended = monitors::Input::Ended { app, cause: reason.into(), is_gone };
                    monitors::feed(&self.state.sync, ended);
                    wills::feed(&self.state.sync, wills::Input::Ended { app });
                }
            }
            SupervisorFact::Deleted(id) | SupervisorFact::Refused(Command::Add, id, _) => self.remove(*id),
            SupervisorFact::Starting(id, _) => {
                // A removed application may be started again by a command; for any other application this
                // changes nothing.
                if let Some(down_state) = self.get(*id) {
                    monitors::feed(&self.state.sync, monitors::Input::Started { app: down_state.tid().app });
                }
            }
            SupervisorFact::AllReady
            | SupervisorFact::Done(..)
            | SupervisorFact::Refused(..)
            | SupervisorFact::Ended(_) => {}
        }
    }

    /// Returns a copy, so that nothing is borrowed while its messages are sent.
    fn get(&self, id: ChildId) -> Option<DownState> {
        self.apps.borrow().get(&id).cloned()
    }
}

#[cfg(test)]
mod tests {
    use sinew_runtime::{
        app::{AppSpec, AppWiring, DynApp},
        mailbox::Mailbox,
        pending::Pending,
        sender::Sender,
        supervision::{ChildCommandError, ChildIds, Reason},
        tid::{AppAddress, Incarnation, Tid},
    };

    use super::*;
    use crate::directory::NodeDirectory;
    use sinew_model::config::NodeConfig;

    #[derive(serde::Serialize, serde::Deserialize)]
    struct Stop;

    impl sinew_runtime::wire::Payload for Stop {
        const NAME: &'static str = "test.stop";
    }

    struct Nothing;

    impl actix::Actor for Nothing {
        type Context = sinew_runtime::app::AppContext<Self>;
    }

    fn wiring(state: &Arc<NodeState>) -> AppWiring {
        let tid = Tid::new(state.ctx.node, AppAddress::fixed(1).expect("a fixed one"));
        let directory = Arc::new(NodeDirectory(state.clone()));
        let sender = Sender::new(tid, state.ctx.router.clone(), directory, Pending::new(1), 1_024);
        AppWiring { sender, mailbox: Mailbox::new(1) }
    }

    #[test]
    fn wills_are_sent_at_end_not_at_failed_start() {
        // Given: a will that no application accepts, so that the router counts it
        let state = NodeState::for_test(NodeConfig::new("test"), Incarnation(1));
        let (policies, id) = (DownPolicies::new(state.clone()), ChildIds::default().next());
        let nobody = Tid::new(state.ctx.node, AppAddress::fixed(2).expect("a fixed one"));
        let app = DynApp::from(AppSpec::new("gait", || Nothing).last_will(nobody, &Stop));
        policies.insert(id, app.down_state(wiring(&state)));
        let fails = |reason| policies.handle(&SupervisorFact::Failed(id, reason));
        // When, then
        fails(Reason::StartFailed("no encoder".to_owned()));
        assert_eq!(state.ctx.router.refused(), 0, "it has never been ready");
        policies.handle(&SupervisorFact::Ready(id));
        fails(Reason::StartFailed("the encoder was unplugged".to_owned()));
        assert_eq!(state.ctx.router.refused(), 1, "this ended a life that was ready");
        fails(Reason::StartFailed("no encoder".to_owned()));
        assert_eq!(state.ctx.router.refused(), 1, "its will was sent before");
        fails(Reason::Panic("a fault".to_owned()));
        assert_eq!(state.ctx.router.refused(), 2, "a panic is a death, ready or not");
    }

    #[test]
    fn rejected_application_leaves_no_state() {
        let state = NodeState::for_test(NodeConfig::new("test"), Incarnation(1));
        let (policies, id) = (DownPolicies::new(state.clone()), ChildIds::default().next());
        policies.insert(id, DynApp::from(AppSpec::new("late", || Nothing)).down_state(wiring(&state)));
        policies.handle(&SupervisorFact::Refused(Command::Add, id, ChildCommandError::Ending));
        assert!(policies.get(id).is_none());
    }
}
