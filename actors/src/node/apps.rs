//! The applications of a node, as its root knows them.
//!
//! A supervisor tells what happens at once and in order: an application's mailbox is open again before its next life begins,
//! and closed as soon as it is known that none follows.

use std::{cell::RefCell, collections::BTreeMap, rc::Rc, sync::Arc};

use sinew_runtime::{
    app::{DynApp, RequirementPolicy},
    mailbox::Mailbox,
    supervision::{ChildId, Place, Reason, SupervisorFact},
    tid::{AppAddress, Tid},
};

use super::{StartError, places};
use crate::{lncl, stores::Stores};

/// Who the children of the applications' supervisors are. Clones are the same table.
#[derive(Clone, Default)]
pub(super) struct Apps(Rc<RefCell<Table>>);

#[derive(Default)]
struct Table {
    apps: BTreeMap<ChildId, App>,
    by_address: BTreeMap<AppAddress, ChildId>,
    /// Names of applications and of supervisors.
    names: BTreeMap<String, ChildId>,
    /// Whether any of them has ever been ready.
    any_ran: bool,
}

struct App {
    name: String,
    tid: Tid,
    mailbox: Arc<Mailbox>,
    place: Place,
    on_lost: RequirementPolicy,
    progress: Progress,
}

/// How far an application is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Progress {
    /// Waits for what it requires, or starts.
    Coming,
    Running,
    /// Has ended, and does not come back by itself.
    Gone,
}

impl App {
    fn tell_end(&self, stores: &Stores, reason: &Reason) {
        if reason.is_failure() {
            lncl::app_down(stores, self.tid.app);
        } else {
            lncl::app_stopped(stores, self.tid.app);
        }
    }
}

impl Apps {
    /// An application that has its address and its mailbox and is not started yet.
    pub(super) fn add(&self, id: ChildId, app: &DynApp, tid: Tid, mailbox: Arc<Mailbox>) {
        let mut table = self.0.borrow_mut();
        table.by_address.insert(tid.app, id);
        table.names.insert(app.name().to_owned(), id);
        let (name, place) = (app.name().to_owned(), app.place().clone());
        let (on_lost, progress) = (app.requirement_policy(), Progress::Coming);
        table.apps.insert(id, App { name, tid, mailbox, place, on_lost, progress });
    }

    /// A supervisor of applications.
    pub(super) fn add_supervisor(&self, id: ChildId, name: &str) {
        self.0.borrow_mut().names.insert(name.to_owned(), id);
    }

    /// Who has this name.
    pub(super) fn named(&self, name: &str) -> Option<ChildId> {
        self.0.borrow().names.get(name).copied()
    }

    /// Who has this address.
    pub(super) fn with_address(&self, address: AppAddress) -> Option<ChildId> {
        self.0.borrow().by_address.get(&address).copied()
    }

    /// Whether this is an application.
    pub(super) fn contains(&self, id: ChildId) -> bool {
        self.0.borrow().apps.contains_key(&id)
    }

    /// Its mailbox, and whether it has a process of its own.
    pub(super) fn mailbox(&self, id: ChildId) -> Option<(Arc<Mailbox>, bool)> {
        self.0.borrow().apps.get(&id).map(|app| (app.mailbox.clone(), app.place.own_process))
    }

    /// Whether it pauses when it loses what it requires.
    pub(super) fn pauses(&self, id: ChildId) -> bool {
        self.0.borrow().apps.get(&id).is_some_and(|app| app.on_lost == RequirementPolicy::Pause)
    }

    /// Refuses one that wants a thread to be what it cannot be for those that are there.
    pub(super) fn check_place(&self, app: &DynApp) -> Result<(), StartError> {
        let table = self.0.borrow();
        let places = table.apps.values().map(|other| (&*other.name, &other.place));
        places::check(app.name(), app.place(), places)
    }

    /// Whether every application runs that has not ended for good.
    pub(super) fn all_run(&self) -> bool {
        self.0.borrow().apps.values().all(|app| app.progress != Progress::Coming)
    }

    /// Whether any of them has ever been ready in this life of the node.
    pub(super) fn any_ran(&self) -> bool {
        self.0.borrow().any_ran
    }

    /// Nobody takes messages any more.
    pub(super) fn close(&self) {
        self.0.borrow().apps.values().for_each(|app| app.mailbox.close());
    }

    /// What a supervisor says, as it says it.
    pub(super) fn hear(&self, stores: &Stores, fact: &SupervisorFact) {
        match fact {
            SupervisorFact::Starting(id, _) => self.change(*id, |app| {
                if app.progress == Progress::Gone {
                    app.mailbox.reopen();
                }
                app.progress = Progress::Coming;
            }),
            SupervisorFact::Ready(id) => {
                self.0.borrow_mut().any_ran = true;
                self.change(*id, |app| {
                    app.progress = Progress::Running;
                    lncl::app_ready(stores, app.tid.app);
                });
            }
            SupervisorFact::Failed(id, reason) => self.change(*id, |app| {
                app.progress = Progress::Coming;
                app.tell_end(stores, reason);
            }),
            SupervisorFact::Gone(id, reason) => self.change(*id, |app| {
                app.progress = Progress::Gone;
                app.mailbox.close();
                app.tell_end(stores, reason);
            }),
            SupervisorFact::Deleted(id) => self.remove(stores, *id),
            SupervisorFact::AllReady
            | SupervisorFact::Done(..)
            | SupervisorFact::Refused(..)
            | SupervisorFact::Ended(_) => {}
        }
    }

    fn change(&self, id: ChildId, change: impl FnOnce(&mut App)) {
        if let Some(app) = self.0.borrow_mut().apps.get_mut(&id) {
            change(app);
        }
    }

    /// Takes name, address and mailbox back.
    pub(super) fn remove(&self, stores: &Stores, id: ChildId) {
        let mut table = self.0.borrow_mut();
        table.names.retain(|_, named| *named != id);
        if let Some(app) = table.apps.remove(&id) {
            table.by_address.remove(&app.tid.app);
            app.mailbox.close();
            stores.book.remove_mailbox(app.tid.app);
            lncl::unregister_local(stores, app.tid.app);
        }
    }
}
