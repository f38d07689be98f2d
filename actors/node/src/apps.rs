//! The root's table of the node's applications.
//!
//! A supervisor reports events at once and in order. An application's mailbox is open again before its next
//! incarnation starts, and closed as soon as it is known that none follows.

use std::{cell::RefCell, collections::BTreeMap, rc::Rc, sync::Arc};

use sinew_runtime::{
    app::{DynApp, RequirementPolicy},
    mailbox::Mailbox,
    parameters::Parameters,
    supervision::{ChildId, Place, Reason, SupervisorFact},
    tid::{AppAddress, Tid},
};

use super::{StartError, thread_placement};
use crate::NodeState;

/// The children of the applications' supervisors. Clones share one table.
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
    /// Its parameters, if they are in this process.
    parameters: Option<Arc<dyn Parameters>>,
    on_lost: RequirementPolicy,
    progress: Progress,
}

/// The state of an application.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Progress {
    /// The application waits for its requirements, or starts.
    Starting,
    Running,
    /// The application has ended and is not restarted automatically.
    Ended,
}

impl App {
    fn report_end(&self, state: &NodeState, reason: &Reason) {
        if reason.is_failure() {
            sinew_lncl::app_down(&state.lncl, self.tid.app);
        } else {
            sinew_lncl::app_stopped(&state.lncl, self.tid.app);
        }
    }
}

impl Apps {
    /// Adds an application that has its address and its mailbox and is not started yet.
    pub(super) fn add(&self, id: ChildId, app: &DynApp, tid: Tid, mailbox: Arc<Mailbox>) {
        let mut table = self.0.borrow_mut();
        table.by_address.insert(tid.app, id);
        table.names.insert(app.name().to_owned(), id);
        let (name, place) = (app.name().to_owned(), app.place().clone());
        let (parameters, on_lost) = (parameters_here(app).cloned(), app.requirement_policy());
        let progress = Progress::Starting;
        table.apps.insert(id, App { name, tid, mailbox, place, parameters, on_lost, progress });
    }

    /// Adds a supervisor of applications.
    pub(super) fn add_supervisor(&self, id: ChildId, name: &str) {
        self.0.borrow_mut().names.insert(name.to_owned(), id);
    }

    /// Returns the child with this name.
    pub(super) fn named(&self, name: &str) -> Option<ChildId> {
        self.0.borrow().names.get(name).copied()
    }

    /// Returns the child with this address.
    pub(super) fn with_address(&self, address: AppAddress) -> Option<ChildId> {
        self.0.borrow().by_address.get(&address).copied()
    }

    /// Returns whether this child is an application.
    pub(super) fn contains(&self, id: ChildId) -> bool {
        self.0.borrow().apps.contains_key(&id)
    }

    /// Returns the application's mailbox, and whether it has a process of its own.
    pub(super) fn mailbox(&self, id: ChildId) -> Option<(Arc<Mailbox>, bool)> {
        self.0.borrow().apps.get(&id).map(|app| (app.mailbox.clone(), app.place.own_process))
    }

    /// Returns whether the application pauses when it loses a requirement.
    pub(super) fn pauses(&self, id: ChildId) -> bool {
        self.0.borrow().apps.get(&id).is_some_and(|app| app.on_lost == RequirementPolicy::Pause)
    }

    /// Checks the thread placement of an application against those of the existing ones.
    pub(super) fn check_place(&self, app: &DynApp) -> Result<(), StartError> {
        let table = self.0.borrow();
        let places = table.apps.values().map(|other| (&*other.name, &other.place));
        thread_placement::check(app.name(), app.place(), places)
    }

    /// Checks that the parameters of an application are not those of an existing one.
    pub(super) fn check_parameters(&self, app: &DynApp) -> Result<(), StartError> {
        let table = self.0.borrow();
        let others = table.apps.values().filter_map(|other| Some((&*other.name, other.parameters.as_ref()?)));
        check_parameters(app, others)
    }

    /// Returns whether every application runs that has not ended for good.
    pub(super) fn all_run(&self) -> bool {
        self.0.borrow().apps.values().all(|app| app.progress != Progress::Starting)
    }

    /// Returns whether any application has ever been ready in this incarnation of the node.
    pub(super) fn any_ran(&self) -> bool {
        self.0.borrow().any_ran
    }

    /// Closes all mailboxes.
    pub(super) fn close(&self) {
        self.0.borrow().apps.values().for_each(|app| app.mailbox.close());
    }

    /// Handles an event of a supervisor, in the order of the events.
    pub(super) fn handle(&self, state: &NodeState, fact: &SupervisorFact) {
        match fact {
            SupervisorFact::Starting(id, _) => self.change(*id, |app| {
                if app.progress == Progress::Ended {
                    app.mailbox.reopen();
                }
                app.progress = Progress::Starting;
            }),
            SupervisorFact::Ready(id) => {
                self.0.borrow_mut().any_ran = true;
                self.change(*id, |app| {
                    app.progress = Progress::Running;
                    sinew_lncl::app_ready(&state.lncl, app.tid.app);
                });
            }
            SupervisorFact::Failed(id, reason) => self.change(*id, |app| {
                app.progress = Progress::Starting;
                app.report_end(state, reason);
            }),
            SupervisorFact::Gone(id, reason) => self.change(*id, |app| {
                app.progress = Progress::Ended;
                app.mailbox.close();
                app.report_end(state, reason);
            }),
            SupervisorFact::Deleted(id) => self.remove(state, *id),
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

    /// Removes the name, address and mailbox of an application.
    pub(super) fn remove(&self, state: &NodeState, id: ChildId) {
        let mut table = self.0.borrow_mut();
        table.names.retain(|_, named| *named != id);
        if let Some(app) = table.apps.remove(&id) {
            table.by_address.remove(&app.tid.app);
            app.mailbox.close();
            state.lncl.book.remove_mailbox(app.tid.app);
            state.contracts.remove(app.tid.app);
            sinew_lncl::unregister_local(&state.lncl, app.tid.app);
        }
    }
}

/// Returns the parameters of an application. In a process of its own they are another copy.
fn parameters_here(app: &DynApp) -> Option<&Arc<dyn Parameters>> {
    app.parameters().filter(|_| !app.place().own_process)
}

/// Refuses parameters that one of `others` has, too. Two applications would write them, each at its own ticks.
fn check_parameters<'a>(
    app: &DynApp,
    others: impl IntoIterator<Item = (&'a str, &'a Arc<dyn Parameters>)>,
) -> Result<(), StartError> {
    let Some(own) = parameters_here(app) else { return Ok(()) };
    let is_own = |theirs: &Arc<dyn Parameters>| std::ptr::addr_eq(Arc::as_ptr(own), Arc::as_ptr(theirs));
    let Some((other, _)) = others.into_iter().find(|(_, theirs)| is_own(theirs)) else { return Ok(()) };
    let why = format!(
        "its parameters are those of '{other}', too, which sets them at its own ticks; give each application a struct of its own, by `new`"
    );
    Err(StartError::Application { name: app.name().to_owned(), why })
}

#[cfg(test)]
mod tests {
    use sinew_runtime::app::{AppContext, AppSpec};

    use super::*;

    sinew::params! {
        struct Gains {
            /// A gain.
            gain: f64 = 0.5, unit "1", range 0.0..=1.0;
        }
    }

    struct Idle;

    impl actix::Actor for Idle {
        type Context = AppContext<Self>;
    }

    fn app(name: &str, gains: &Arc<Gains>, place: Place) -> DynApp {
        AppSpec::new(name, || Idle).params(gains).place(place).into()
    }

    #[test]
    fn parameters_belong_to_one_application() {
        let (gains, other_gains) = (Gains::new(), Gains::new());
        let shared: Arc<dyn Parameters> = gains.clone();
        let check = |app: &DynApp| check_parameters(app, [("knee", &shared)]);
        let words = check(&app("hip", &gains, Place::io())).expect_err("it is the knee's").to_string();
        assert!(words.contains("'hip'") && words.contains("those of 'knee'"), "{words}");
        assert!(check(&app("hip", &other_gains, Place::io())).is_ok());
        assert!(check(&app("hip", &gains, Place::process())).is_ok(), "it has another copy");
    }
}
