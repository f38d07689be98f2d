//! The ends and returns of this node's applications, acted on the moment that their supervisor says so.

use std::{cell::RefCell, collections::BTreeMap, rc::Rc};

use sinew_runtime::{
    app::Absence,
    supervision::{ChildId, SupervisorFact},
};

/// What is kept of each application for the time that it is away. Clones share it.
#[derive(Clone, Default)]
pub(super) struct Absences(Rc<RefCell<BTreeMap<ChildId, Absence>>>);

impl Absences {
    /// The application `id` is supervised from now on.
    pub(super) fn keep(&self, id: ChildId, absence: Absence) {
        self.0.borrow_mut().insert(id, absence);
    }

    /// Called by the supervisor itself, before it does anything else about the child.
    pub(super) fn hear(&self, fact: &SupervisorFact) {
        match fact {
            SupervisorFact::Ready(id) => {
                if let Some(absence) = self.of(*id) {
                    absence.ends();
                }
            }
            SupervisorFact::Failed(id, reason) | SupervisorFact::Gone(id, reason) => {
                if let Some(absence) = self.of(*id) {
                    absence.begins(reason);
                }
            }
            SupervisorFact::Deleted(id) => _ = self.0.borrow_mut().remove(id),
            SupervisorFact::Starting(..)
            | SupervisorFact::AllReady
            | SupervisorFact::Done(..)
            | SupervisorFact::Refused(..)
            | SupervisorFact::Ended(_) => {}
        }
    }

    /// A copy, so that nothing is borrowed while its messages are sent.
    fn of(&self, id: ChildId) -> Option<Absence> {
        self.0.borrow().get(&id).cloned()
    }
}
