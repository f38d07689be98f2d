//! The applications of this node, and their life cycle: registered, ready, ended, unregistered.

use std::{
    collections::{BTreeMap, BTreeSet},
    time::Duration,
};

use sinew_model::facts::{AppFact, DeclaredTypes, User};
use sinew_runtime::{app::Requirement, tid::AppAddress, time::Time, wire::Kind};

use super::{Reason, grace_period::Moment, outputs::Outputs};
use crate::list::{Ended, Entry, KINDS_MAX, Name, PHASES_MAX, REQUIRES_MAX};

/// The applications of this node.
#[derive(Debug)]
pub(super) struct Apps {
    apps: BTreeMap<AppAddress, App>,
    names: BTreeMap<Name, AppAddress>,
    /// The time after which a wait at the start-up barrier is reported.
    deadline: Duration,
}

/// One application of this node.
#[derive(Debug)]
pub(super) struct App {
    pub(super) name: Option<Name>,
    /// The user that the application runs as.
    pub(super) user: User,
    pub(super) requires: Vec<Requirement>,
    /// The phases that the application has reached in its current life.
    pub(super) phases: Vec<Name>,
    /// The payloads that the application handles, as far as it reports them.
    pub(super) kinds: Vec<Kind>,
    /// The structures of its types, as far as they are known.
    pub(super) types: DeclaredTypes,
    pub(super) state: State,
    /// How the previous life ended, while this one is not ready yet.
    pub(super) ended: Option<Ended>,
    /// The requirements that were reported as lost. While the application waits, these are the reports to its
    /// previous life.
    pub(super) lost: BTreeSet<String>,
    /// The requirements that the current life lacks without a report, but that were reported as lost to an
    /// earlier life.
    pub(super) inherited_losses: BTreeSet<String>,
    /// The requirements that are not met, and since when.
    pub(super) absent: BTreeMap<String, Time>,
    /// The requirements that are unreachable, and the time until which their loss is not reported.
    pub(super) unreachable: BTreeMap<String, Time>,
    /// The time at which the next wait limit of an optional requirement expires.
    pub(super) next_limit: Option<Time>,
}

/// The registration data of an application.
#[derive(Debug)]
struct Registration {
    name: Option<String>,
    /// The user that the application runs as.
    user: User,
    requires: Vec<Requirement>,
}

/// The effect of a fact about an application.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum AppChange {
    /// Nothing has changed.
    Nothing,
    /// The entry in the list has changed.
    Entry,
    /// A life has ended before its application was released. Its wait continues.
    EndedWaiting(AppAddress),
    /// A life has ended. Its application waits again.
    Ended(AppAddress),
    /// The application was registered anew, with this name.
    Registered(AppAddress, Option<String>),
    /// The application is unknown now.
    Unregistered(AppAddress),
}

/// The state of an application in its current life.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum State {
    /// The application waits at the start-up barrier.
    Waiting(Wait),
    /// The application may start; this wait is over.
    Released(Wait),
    /// The application has started and accepts messages.
    Ready,
}

/// A wait at the start-up barrier.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Wait {
    pub(super) since: Time,
    /// The time of the next overdue report.
    pub(super) overdue: Time,
}

impl Wait {
    /// Returns a wait that starts now and is reported after `deadline`.
    pub(super) fn starting(now: Time, deadline: Duration) -> Self {
        Self { since: now, overdue: now + deadline }
    }
}

impl App {
    pub(super) const fn wait(&self) -> Option<&Wait> {
        match &self.state {
            State::Waiting(wait) => Some(wait),
            State::Released(_) | State::Ready => None,
        }
    }

    /// Returns why the application is not ready, or has not reached a phase. Returns `None` if it is, or has.
    pub(super) fn why_not(&self, phase: Option<&str>) -> Option<Reason> {
        if let Some(phase) = phase {
            let has_reached = self.phases.iter().any(|reached| &**reached == phase);
            return (!has_reached).then(|| self.ended.map_or(Reason::NotReached, Reason::from));
        }
        match self.state {
            State::Waiting(_) | State::Released(_) => Some(self.ended.map_or(Reason::NotReady, Reason::from)),
            State::Ready => None,
        }
    }

    /// Starts a life without reports about requirements. Returns the requirements that were reported as lost
    /// to the previous life and are met now. An event for that life may still be in flight, so the new life
    /// must receive the `Met` event.
    pub(super) fn begin_life(&mut self, unmet: &[(String, Reason)]) -> Vec<String> {
        let is_unmet = |name: &String| unmet.iter().any(|(other, _)| other == name);
        let (unmet, met): (BTreeSet<_>, BTreeSet<_>) =
            std::mem::take(&mut self.lost).into_iter().partition(is_unmet);
        // The requirement may be met before its loss is reported. The new life must receive that event, too.
        self.inherited_losses = unmet;
        met.into_iter().collect()
    }

    /// Returns the application to its wait because its release was rejected and it may not start any more.
    /// Its next release starts its life.
    pub(super) fn withdraw_release(&mut self) {
        if let State::Released(wait) = self.state {
            self.state = State::Waiting(wait);
            self.lost.append(&mut self.inherited_losses);
        }
    }

    /// Records since when each requirement is not met.
    pub(super) fn record_absent(&mut self, now: Time, unmet: &[(String, Reason)]) {
        self.absent.retain(|text, _| unmet.iter().any(|(other, _)| other == text));
        for (text, _) in unmet {
            if !self.absent.contains_key(text) {
                self.absent.insert(text.clone(), now);
            }
        }
    }

    /// Returns the application's name, or its address if it has none.
    pub(super) fn title(&self, app: AppAddress) -> String {
        self.name.as_ref().map_or_else(|| app.to_string(), |name| name.to_string())
    }
}

impl Apps {
    /// Returns an empty table. Waits at the start-up barrier are reported after `deadline`.
    pub(super) const fn new(deadline: Duration) -> Self {
        Self { apps: BTreeMap::new(), names: BTreeMap::new(), deadline }
    }

    /// Handles a fact about an application.
    pub(super) fn handle(&mut self, now: Time, fact: AppFact, outputs: &mut Outputs) -> AppChange {
        match fact {
            // The fact is a repetition, as after a restart of LNCL: nothing has changed.
            AppFact::Registered { app, name, requires, user }
                if self.is_registered_as(app, name.as_deref(), &requires, user) =>
            {
                AppChange::Nothing
            }
            AppFact::Registered { app, name, requires, user } => {
                let requires = read_requirements(app, requires, outputs);
                let wait = Wait::starting(now, self.deadline);
                let registration = Registration { name: name.clone(), user, requires };
                if let Some(name) = self.register(app, registration, wait) {
                    let detail = format!("{app} cannot be called {name:?}: not 1 to 63 bytes, or in use");
                    outputs.refuse("name", detail);
                }
                AppChange::Registered(app, name)
            }
            AppFact::Handles { app, kinds } => self.handles(app, kinds),
            AppFact::Types { app, types } => self.types_known(app, types),
            AppFact::Ready { app } => self.ready(app),
            AppFact::Down { app } => self.ended(now, app, Ended::Failed),
            AppFact::Stopped { app } => self.ended(now, app, Ended::Stopped),
            AppFact::Unregistered { app } => {
                self.remove(app);
                AppChange::Unregistered(app)
            }
            // The shell reads the groups and passes them as `Input::GroupsChanged`.
            AppFact::GroupsChanged => AppChange::Nothing,
        }
    }

    fn handles(&mut self, app: AppAddress, mut kinds: Vec<Kind>) -> AppChange {
        kinds.truncate(KINDS_MAX);
        match self.apps.get_mut(&app) {
            Some(app) if app.kinds != kinds => {
                app.kinds = kinds;
                AppChange::Entry
            }
            Some(_) | None => AppChange::Nothing,
        }
    }

    fn types_known(&mut self, app: AppAddress, mut types: DeclaredTypes) -> AppChange {
        types.handles.truncate(KINDS_MAX);
        types.sends.truncate(KINDS_MAX);
        match self.apps.get_mut(&app) {
            Some(app) if app.types != types => {
                app.types = types;
                AppChange::Entry
            }
            Some(_) | None => AppChange::Nothing,
        }
    }

    fn ready(&mut self, app: AppAddress) -> AppChange {
        let Some(app) = self.apps.get_mut(&app).filter(|app| app.state != State::Ready) else {
            return AppChange::Nothing;
        };
        if app.wait().is_some() {
            // The root received the release after all. The application has received no requirement event since.
            app.inherited_losses.append(&mut app.lost);
        }
        (app.state, app.ended) = (State::Ready, None);
        AppChange::Entry
    }

    /// Returns an application to the start-up barrier. An application that still waits was not started, and
    /// keeps its wait.
    fn ended(&mut self, now: Time, app: AppAddress, how: Ended) -> AppChange {
        let wait = Wait::starting(now, self.deadline);
        let Some(record) = self.apps.get_mut(&app).filter(|app| app.wait().is_none()) else {
            return AppChange::EndedWaiting(app);
        };
        // The reported losses stay until the next life starts, which must receive the `Met` events.
        (record.state, record.ended) = (State::Waiting(wait), Some(how));
        record.unreachable.clear();
        record.phases.clear();
        record.lost.append(&mut record.inherited_losses);
        AppChange::Ended(app)
    }

    /// Records that an application has reached a phase. Returns whether that is new.
    ///
    /// # Errors
    /// Returns a description if the application is unknown, or has reached too many phases.
    pub(super) fn reach(&mut self, app: AppAddress, phase: &Name) -> Result<bool, String> {
        let app = self.apps.get_mut(&app).ok_or("only an application of this node can wait here")?;
        if app.phases.contains(phase) {
            return Ok(false);
        }
        if app.phases.len() >= PHASES_MAX {
            return Err(format!("it has reached {PHASES_MAX} phases in this life, which is the limit"));
        }
        app.phases.push(phase.clone());
        Ok(true)
    }

    /// Returns the applications with a wait beyond the deadline. Each is returned again after each further
    /// deadline. spec: SYNC-9
    pub(super) fn take_overdue(&mut self, Moment { now, judged }: Moment) -> Vec<AppAddress> {
        let mut overdue = Vec::new();
        for (address, app) in &mut self.apps {
            if let State::Waiting(wait) = &mut app.state
                && wait.overdue <= judged
            {
                wait.overdue = now + self.deadline;
                overdue.push(*address);
            }
        }
        overdue
    }

    /// Returns the time of the next deadline of a wait, an unreachable requirement or an optional one.
    pub(super) fn next_deadline(&self) -> Option<Time> {
        let overdue = self.waiting().map(|(_, _, wait)| wait.overdue);
        let unreachable =
            self.apps.values().flat_map(|app| app.unreachable.values().chain(&app.next_limit).copied());
        overdue.chain(unreachable).min()
    }

    /// Returns whether `app` is already registered with the same data.
    fn is_registered_as(&self, app: AppAddress, name: Option<&str>, requires: &[String], user: User) -> bool {
        self.apps.get(&app).is_some_and(|app| {
            let is_called_so = app.name.as_deref() == name;
            is_called_so && app.user == user && app.requires.iter().map(Requirement::as_str).eq(requires)
        })
    }

    /// Registers a life of `app`. An application that already waits keeps its wait. Returns the name if it
    /// cannot be assigned.
    fn register(&mut self, app: AppAddress, registration: Registration, wait: Wait) -> Option<String> {
        let Registration { name, user, mut requires } = registration;
        let mut seen = BTreeSet::new();
        requires.retain(|requirement| seen.insert(requirement.to_string()));
        let former = self.remove(app);
        let wait = former.as_ref().and_then(App::wait).copied().unwrap_or(wait);
        let (name, refused) = self.claim(app, name);
        let record = App {
            name,
            user,
            requires,
            phases: Vec::new(),
            kinds: Vec::new(),
            types: DeclaredTypes::default(),
            state: State::Waiting(wait),
            ended: None,
            lost: BTreeSet::new(),
            inherited_losses: BTreeSet::new(),
            // The absence times of an application that already waits stay valid.
            absent: former.map(|former| former.absent).unwrap_or_default(),
            unreachable: BTreeMap::new(),
            next_limit: None,
        };
        self.apps.insert(app, record);
        refused
    }

    /// Assigns the name to `app` if it is legal and free. Otherwise returns it as the second value.
    fn claim(&mut self, app: AppAddress, name: Option<String>) -> (Option<Name>, Option<String>) {
        let Some(text) = name else { return (None, None) };
        match Name::try_from(text.clone()) {
            Ok(name) if !self.names.contains_key(&name) => {
                self.names.insert(name.clone(), app);
                (Some(name), None)
            }
            Ok(_) | Err(_) => (None, Some(text)),
        }
    }

    fn remove(&mut self, app: AppAddress) -> Option<App> {
        let removed = self.apps.remove(&app)?;
        if let Some(name) = &removed.name {
            self.names.remove(name);
        }
        Some(removed)
    }

    pub(super) fn get(&self, app: AppAddress) -> Option<&App> {
        self.apps.get(&app)
    }

    pub(super) fn get_mut(&mut self, app: AppAddress) -> Option<&mut App> {
        self.apps.get_mut(&app)
    }

    pub(super) fn called(&self, name: &str) -> Option<(AppAddress, &App)> {
        let app = *self.names.get(name)?;
        Some((app, self.apps.get(&app)?))
    }

    pub(super) fn iter(&self) -> impl Iterator<Item = (AppAddress, &App)> {
        self.apps.iter().map(|(address, app)| (*address, app))
    }

    pub(super) fn iter_mut(&mut self) -> impl Iterator<Item = (AppAddress, &mut App)> {
        self.apps.iter_mut().map(|(address, app)| (*address, app))
    }

    /// Returns the application's name, or its address if it has none.
    pub(super) fn title(&self, app: AppAddress) -> String {
        self.get(app).map_or_else(|| app.to_string(), |known| known.title(app))
    }

    /// Returns the waiting applications with their waits.
    pub(super) fn waiting(&self) -> impl Iterator<Item = (AppAddress, &App, &Wait)> {
        self.iter().filter_map(|(address, app)| Some((address, app, app.wait()?)))
    }

    /// Returns all names.
    pub(super) fn names(&self) -> impl Iterator<Item = &Name> {
        self.names.keys()
    }

    /// Returns the entries of the node's list. Guests come last, because entries without room are left out
    /// from the end.
    pub(super) fn entries(&self) -> Vec<Entry> {
        let named = self.names.iter().filter_map(|(name, app)| Some((name, *app, self.apps.get(app)?)));
        let (own, guests): (Vec<_>, Vec<_>) = named.partition(|(_, _, app)| app.user == User::Own);
        own.into_iter()
            .chain(guests)
            .map(|(name, address, app)| Entry {
                name: name.clone(),
                app: address,
                ready: app.state == State::Ready,
                ended: app.ended,
                phases: app.phases.clone(),
                requires: app.requires.iter().take(REQUIRES_MAX).cloned().collect(),
                kinds: app.kinds.clone(),
                handles: app.types.handles.clone(),
                sends: app.types.sends.clone(),
            })
            .collect()
    }
}

/// Parses requirements that LNCL has already checked. An invalid text becomes a name that no application
/// has, so that the application does not start.
fn read_requirements(app: AppAddress, texts: Vec<String>, outputs: &mut Outputs) -> Vec<Requirement> {
    let read = |text: String| {
        text.parse().unwrap_or_else(|fault| {
            outputs.refuse("requirement", format!("of {app}: {fault}"));
            Requirement::name(text)
        })
    };
    texts.into_iter().map(read).collect()
}
