//! The ends and returns of this node's applications, acted on the moment that their supervisor says so.

use std::{cell::RefCell, collections::BTreeMap, rc::Rc, sync::Arc};

use sinew_runtime::{
    app::Absence,
    supervision::{ChildId, Command, SupervisorFact},
};

use crate::{monitors, stores::Stores, wills};

/// What is kept of each application for the time that it is away. Clones share it.
#[derive(Clone)]
pub(super) struct Absences {
    apps: Rc<RefCell<BTreeMap<ChildId, Absence>>>,
    stores: Arc<Stores>,
}

impl Absences {
    /// Nobody's yet.
    pub(super) fn new(stores: Arc<Stores>) -> Self {
        Self { apps: Rc::default(), stores }
    }

    /// The application `id` is supervised from now on.
    pub(super) fn keep(&self, id: ChildId, absence: Absence) {
        self.apps.borrow_mut().insert(id, absence);
    }

    /// It is not supervised any more, or has never been.
    pub(super) fn forget(&self, id: ChildId) {
        self.apps.borrow_mut().remove(&id);
    }

    /// Called by the supervisor itself, before it does anything else about the child.
    pub(super) fn hear(&self, fact: &SupervisorFact) {
        match fact {
            SupervisorFact::Ready(id) => {
                if let Some(absence) = self.of(*id) {
                    absence.ends();
                    let (app, wills) = (absence.tid().app, absence.wills());
                    wills::feed(&self.stores, wills::Input::Lives { app, wills });
                }
            }
            SupervisorFact::Failed(id, reason) | SupervisorFact::Gone(id, reason) => {
                if let Some(absence) = self.of(*id) {
                    absence.begins(reason);
                    let is_gone = matches!(fact, SupervisorFact::Gone(..));
                    let app = absence.tid().app;
                    let ended = monitors::Input::Ended { app, cause: reason.into(), is_gone };
                    monitors::feed(&self.stores, ended);
                    wills::feed(&self.stores, wills::Input::Ended { app });
                }
            }
            SupervisorFact::Deleted(id) | SupervisorFact::Refused(Command::Add, id, _) => self.forget(*id),
            SupervisorFact::Starting(id, _) => {
                // One that was gone may be started again by a command; of any other this says nothing new.
                if let Some(absence) = self.of(*id) {
                    monitors::feed(&self.stores, monitors::Input::Began { app: absence.tid().app });
                }
            }
            SupervisorFact::AllReady
            | SupervisorFact::Done(..)
            | SupervisorFact::Refused(..)
            | SupervisorFact::Ended(_) => {}
        }
    }

    /// A copy, so that nothing is borrowed while its messages are sent.
    fn of(&self, id: ChildId) -> Option<Absence> {
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
        supervision::{ChildIds, Refusal},
        tid::{AppAddress, Incarnation, Tid},
    };

    use super::*;
    use crate::{config::NodeConfig, node::directory::NodeDirectory};

    struct Nothing;

    impl actix::Actor for Nothing {
        type Context = sinew_runtime::app::AppContext<Self>;
    }

    #[test]
    fn nothing_is_kept_of_an_application_that_was_not_taken_in() {
        let stores = Stores::for_test(NodeConfig::new("test"), Incarnation(1));
        let (absences, id) = (Absences::new(stores.clone()), ChildIds::default().next());
        let tid = Tid::new(stores.node, AppAddress::fixed(1).expect("a fixed one"));
        let directory = Arc::new(NodeDirectory(stores.clone()));
        let sender = Sender::new(tid, stores.router.clone(), directory, Pending::new(1), 1_024);
        let wiring = AppWiring { sender, mailbox: Mailbox::new(1) };
        absences.keep(id, DynApp::from(AppSpec::new("late", || Nothing)).absence(wiring));
        absences.hear(&SupervisorFact::Refused(Command::Add, id, Refusal::Ending));
        assert!(absences.of(id).is_none());
    }
}
