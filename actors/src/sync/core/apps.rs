//! The applications of this node, and how far each has come.

use std::{
    collections::{BTreeMap, BTreeSet},
    time::Duration,
};

use sinew_runtime::{
    app::{Requirement, matches},
    tid::AppAddress,
    time::Time,
    wire::Kind,
};

use super::reason::Reason;
use crate::{
    lncl::User,
    sync::list::{Ended, Entry, Name, REQUIRES_MAX},
};

/// The applications of this node.
#[derive(Debug, Default)]
pub(super) struct Apps {
    apps: BTreeMap<AppAddress, App>,
    names: BTreeMap<Name, AppAddress>,
}

/// One application of this node.
#[derive(Debug)]
pub(super) struct App {
    pub(super) name: Option<Name>,
    /// Whose it is.
    pub(super) user: User,
    pub(super) requires: Vec<Requirement>,
    /// The phases that it has reached in its present life.
    pub(super) phases: Vec<Name>,
    /// The payloads that it handles, as far as it tells.
    pub(super) kinds: Vec<Kind>,
    pub(super) state: State,
    /// How its former life ended, while this one is not ready yet.
    pub(super) ended: Option<Ended>,
    /// Of what it requires, what it was told is lost: while it waits, what its former life was told.
    pub(super) lost: BTreeSet<String>,
    /// Of what its present life lacks and was not told yet, what a former one was told.
    pub(super) owed: BTreeSet<String>,
    /// Of what it requires, what is not met, and since when.
    pub(super) absent: BTreeMap<String, Time>,
    /// Of what it requires and is absent while it waits, when it is next reported that nobody has such a name.
    pub(super) misspelt: BTreeMap<String, Time>,
    /// Of what it requires, what nobody can hear of, and until when that is not told.
    pub(super) silent: BTreeMap<String, Time>,
    /// When the next time ends for which it waits for what it can do without.
    pub(super) patience: Option<Time>,
}

/// What a node is told of an application that registers.
#[derive(Debug)]
pub(super) struct Newcomer {
    pub(super) name: Option<String>,
    /// Whose it is.
    pub(super) user: User,
    pub(super) requires: Vec<Requirement>,
}

/// How far an application has come in its present life.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum State {
    /// It waits at the barrier.
    Waiting(Wait),
    /// It may start: this wait is over.
    Released(Wait),
    /// It has started and takes messages.
    Ready,
}

/// A wait at the barrier.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Wait {
    pub(super) since: Time,
    /// When it is reported next.
    pub(super) overdue: Time,
}

impl Wait {
    /// A wait that begins now and is reported after `deadline`.
    pub(super) fn begun(now: Time, deadline: Duration) -> Self {
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

    /// Why it is not ready, or has not reached a phase; `None`: it is, it has.
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

    /// A life may start: it has been told nothing of what it requires. Returns what the life before was told is lost and what is met now:
    /// an event may still be on its way, and this life has to hear the end of it.
    pub(super) fn begin_life(&mut self, unmet: &[(String, Reason)]) -> Vec<String> {
        let is_unmet = |name: &String| unmet.iter().any(|(other, _)| other == name);
        let (unmet, met): (BTreeSet<_>, BTreeSet<_>) =
            std::mem::take(&mut self.lost).into_iter().partition(is_unmet);
        // It may be met before it is told: then the life has to hear that all the same.
        self.owed = unmet;
        met.into_iter().collect()
    }

    /// The root was not told that it may start, and meanwhile it may not: it waits on, and its next release begins its life.
    pub(super) fn put_back(&mut self) {
        if let State::Released(wait) = self.state {
            self.state = State::Waiting(wait);
            self.lost.append(&mut self.owed);
        }
    }

    /// Keeps since when each requirement is not met.
    pub(super) fn note_absent(&mut self, now: Time, unmet: &[(String, Reason)]) {
        self.absent.retain(|text, _| unmet.iter().any(|(other, _)| other == text));
        for (text, _) in unmet {
            if !self.absent.contains_key(text) {
                self.absent.insert(text.clone(), now);
            }
        }
    }

    /// The application's name, or its address where it has none.
    pub(super) fn title(&self, app: AppAddress) -> String {
        self.name.as_ref().map_or_else(|| app.to_string(), |name| name.to_string())
    }
}

impl Apps {
    /// Whether `app` is registered just so already.
    pub(super) fn knows(
        &self,
        app: AppAddress,
        name: Option<&str>,
        requires: &[String],
        whose: User,
    ) -> bool {
        self.apps.get(&app).is_some_and(|app| {
            let is_called_so = app.name.as_deref() == name;
            is_called_so && app.user == whose && app.requires.iter().map(Requirement::as_str).eq(requires)
        })
    }

    /// A life of `app` begins; one that waits already goes on waiting. Returns the name, if it cannot be had.
    pub(super) fn register(&mut self, app: AppAddress, newcomer: Newcomer, wait: Wait) -> Option<String> {
        let Newcomer { name, user, mut requires } = newcomer;
        let mut seen = BTreeSet::new();
        requires.retain(|requirement| seen.insert(requirement.to_string()));
        let former = self.remove(app);
        let wait = former.as_ref().and_then(App::wait).copied().unwrap_or(wait);
        let (name, refused) = self.claim(app, name);
        let state = State::Waiting(wait);
        let (phases, kinds, silent, misspelt) = (Vec::new(), Vec::new(), BTreeMap::new(), BTreeMap::new());
        let (lost, owed) = (BTreeSet::new(), BTreeSet::new());
        let (ended, patience) = (None, None);
        // One that waits already has waited for that, too.
        let absent = former.map(|former| former.absent).unwrap_or_default();
        let life = App {
            name,
            user,
            requires,
            phases,
            kinds,
            state,
            ended,
            lost,
            owed,
            absent,
            misspelt,
            silent,
            patience,
        };
        self.apps.insert(app, life);
        refused
    }

    /// Gives the name to `app` if it is legal and free, or hands it back.
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

    pub(super) fn remove(&mut self, app: AppAddress) -> Option<App> {
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

    /// The applications that wait, and since when.
    pub(super) fn waiting(&self) -> impl Iterator<Item = (AppAddress, &App, &Wait)> {
        self.iter().filter_map(|(address, app)| Some((address, app, app.wait()?)))
    }

    /// All names.
    pub(super) fn names(&self) -> impl Iterator<Item = &Name> {
        self.names.keys()
    }

    /// The applications whose names match `pattern`.
    pub(super) fn matching(&self, pattern: &str) -> impl Iterator<Item = (&Name, AppAddress, &App)> {
        let names = self.names.iter().filter(|(name, _)| matches(pattern, name));
        names.filter_map(|(name, address)| Some((name, *address, self.apps.get(address)?)))
    }

    /// What the node's list says about them: guests last, as what has no room in it is left out from the end.
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
            })
            .collect()
    }
}
