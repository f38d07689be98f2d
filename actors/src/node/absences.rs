//! The ends and returns of this node's applications, acted on the moment that their supervisor says so.

use std::{cell::RefCell, collections::BTreeMap, rc::Rc, sync::Arc};

use sinew_runtime::{
    app::Absence,
    supervision::{ChildId, SupervisorFact},
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
            SupervisorFact::Deleted(id) => _ = self.apps.borrow_mut().remove(id),
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
