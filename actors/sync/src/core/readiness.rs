//! Which requirements are met, and why the others are not.

mod brief;

use std::{collections::BTreeSet, time::Duration};

use sinew_model::directory::{Absence, Waiting};
use sinew_runtime::{
    app::{Requirement, is_pattern},
    tid::{AppAddress, Tid},
    time::Time,
};

use super::{Reason, apps::App, directory::Directory};

/// Maximum number of names that are listed for a requirement with a pattern or alternatives.
const NAMED_MAX: usize = 8;
/// Time until a required name without an application is logged. At a normal start of a robot its nodes have
/// found each other by then.
pub(super) const FIRST_AFTER: Duration = Duration::from_secs(2);

/// The results of the start-up barrier's last evaluation.
#[derive(Debug, Default)]
pub(super) struct Findings {
    /// The names and patterns required here that an application has had at some time.
    pub(super) former_names: BTreeSet<String>,
    /// The existing cycles, each without its closing name.
    pub(super) cycles: BTreeSet<Vec<String>>,
}

/// A view of the readiness of all known applications.
#[derive(Clone, Copy, Debug)]
pub(super) struct Readiness<'core> {
    pub(super) directory: Directory<'core>,
    pub(super) findings: &'core Findings,
}

/// The state of one requirement of one application.
#[derive(Debug, Default)]
pub(super) struct RequirementState {
    /// The applications that count for the requirement and are ready.
    pub(super) ready: BTreeSet<Tid>,
    /// The names that count for the requirement and are not ready, with the last known state of each, and
    /// patterns without a match.
    pub(super) unready: Vec<(String, Reason)>,
    /// The names and patterns of the requirement that an application has, ready or not.
    pub(super) registered: Vec<String>,
}

/// The reason why a requirement is not met.
struct Unmet<'found> {
    /// The number of ready applications, which is too low.
    ready: usize,
    /// The names that are not ready, as in [`RequirementState`].
    unready: &'found [(String, Reason)],
    /// The reason that is nearest to readiness.
    nearest: Reason,
}

impl RequirementState {
    /// Returns why `requirement` is not met, of several reasons the one nearest to readiness. Returns `None`
    /// if it is met.
    pub(super) fn why_not(&self, requirement: &Requirement) -> Option<Reason> {
        if self.ready.len() >= requirement.count() {
            return None;
        }
        // Every application that counts is ready, but there are too few. The others have never been seen.
        Some(self.unready.iter().map(|(_, reason)| *reason).min().unwrap_or(Reason::NotThere))
    }
}

impl Readiness<'_> {
    /// Returns why no application called `name` is ready. Returns `None` if one is.
    pub(super) fn why_not(self, name: &str) -> Option<Reason> {
        let requirement = Requirement::name(name);
        self.state_of(AppAddress::NONE, &requirement).why_not(&requirement)
    }

    /// Returns the state of a requirement of the application at `of`. That application counts as ready for
    /// it, because it does not wait for itself.
    pub(super) fn state_of(self, of: AppAddress, requirement: &Requirement) -> RequirementState {
        let mut state = RequirementState::default();
        for alternative in requirement.alternatives() {
            let names: BTreeSet<&str> = if is_pattern(alternative) {
                self.directory.names_like(alternative).map(|name| &**name).collect()
            } else {
                BTreeSet::from([alternative.as_str()])
            };
            let before = state.registered.len();
            for name in names {
                self.count((of, requirement.phase()), name, alternative, &mut state);
            }
            if state.registered.len() == before {
                let reason = self.why_absent(alternative);
                state.unready.push((alternative.clone(), reason));
            }
        }
        state
    }

    /// Returns why no application has a name that matches `alternative`.
    fn why_absent(self, alternative: &str) -> Reason {
        let is_known = self.findings.former_names.contains(alternative);
        if is_known { Reason::Unregistered } else { Reason::NotThere }
    }

    /// Counts the applications called `name`. The application at `of` always counts as ready.
    fn count(
        self,
        (of, phase): (AppAddress, Option<&str>),
        name: &str,
        alternative: &str,
        state: &mut RequirementState,
    ) {
        let own = Tid::new(self.directory.peers.here(), of);
        let mut reasons = Vec::new();
        for (tid, why_not) in self.directory.states(name, phase) {
            match why_not {
                _ if tid == own => drop(state.ready.insert(tid)),
                None => drop(state.ready.insert(tid)),
                Some(reason) => reasons.push(reason),
            }
            state.registered.push(alternative.to_owned());
        }
        // A name with one ready application still lacks the others, if more are needed.
        if let Some(nearest) = reasons.into_iter().min()
            && !state.unready.iter().any(|(known, _)| known == name)
        {
            state.unready.push((name.to_owned(), nearest));
        }
    }

    /// Returns the missing parts of `requirement` of the application at `of`, with the last known state of
    /// each. Returns nothing if it is met.
    pub(super) fn missing_parts(
        self,
        of: AppAddress,
        requirement: &Requirement,
    ) -> Vec<(String, &'static str)> {
        let state = self.state_of(of, requirement);
        let Some(nearest) = state.why_not(requirement) else { return Vec::new() };
        let unmet = Unmet { ready: state.ready.len(), unready: &state.unready, nearest };
        self.parts(requirement, unmet, usize::MAX)
    }

    /// Returns the same parts, with the time since when each is missing.
    pub(super) fn absences(self, now: Time, of: AppAddress, requirement: &Requirement) -> Vec<Absence> {
        let app = self.directory.apps.get(of);
        let absent = app.and_then(|app| app.absent.get(requirement.as_str()));
        let since = absent.map_or(Duration::ZERO, |absent| now.since(*absent));
        let parts = self.missing_parts(of, requirement).into_iter();
        let own = app.and_then(|app| app.name.as_deref());
        let is_one = requirement.one_name().is_some() && requirement.phase().is_none();
        let similar = |name: &str, why: &'static str| {
            let is_unknown = is_one && why == Reason::NotThere.words() && since >= FIRST_AFTER;
            if is_unknown { self.directory.nearest(name, own) } else { Vec::new() }
        };
        parts
            .map(|(name, why)| {
                let nearest = similar(&name, why);
                let why = if nearest.is_empty() {
                    why.into()
                } else {
                    format!("{why}; nearest: {}", nearest.join(", ")).into()
                };
                Absence { name, why, since }
            })
            .collect()
    }

    /// Returns the parts of a requirement that is not met. The search for a name in cycles covers the first
    /// `cycle_names_max` names.
    fn parts(
        self,
        requirement: &Requirement,
        unmet: Unmet<'_>,
        cycle_names_max: usize,
    ) -> Vec<(String, &'static str)> {
        let Unmet { ready, unready, nearest } = unmet;
        let cycles = self.findings.cycles.iter().flatten();
        let in_cycle = |name: &str| cycles.clone().take(cycle_names_max).any(|other| other == name);
        let words = |name: &str, reason: Reason| {
            if in_cycle(name) { Reason::Cycle.words() } else { reason.words() }
        };
        if let Some(name) = requirement.one_name().filter(|_| requirement.wait_max().is_none()) {
            let what = requirement.phase().map_or_else(|| name.to_owned(), |_| requirement.to_string());
            return vec![(what, words(name, nearest))];
        }
        let there = if requirement.phase().is_some() { "there" } else { "ready" };
        if unready.is_empty() {
            return vec![(format!("{requirement} ({ready} {there})"), nearest.words())];
        }
        let named = unready.iter().take(NAMED_MAX);
        named
            .map(|(name, reason)| (format!("{requirement} ({ready} {there}): {name}"), words(name, *reason)))
            .collect()
    }

    /// Returns the missing requirements of an application that waits at the start-up barrier, since when and
    /// why.
    pub(super) fn wait_of(self, now: Time, address: AppAddress) -> Option<Waiting> {
        let app = self.directory.apps.get(address)?;
        let since = app.wait()?.since;
        let missing = app.requires.iter().flat_map(|requirement| {
            let absences = self.absences(now, address, requirement);
            if absences.is_empty() {
                self.held_by_cycle(now.since(since), app, requirement)
            } else {
                absences
            }
        });
        Some(Waiting { application: app.title(address), missing: missing.collect(), since: now.since(since) })
    }

    /// Returns why `app` is held although `requirement` is met: a name in it shares a cycle with `app`.
    /// spec: SYNC-7
    fn held_by_cycle(self, since: Duration, app: &App, requirement: &Requirement) -> Vec<Absence> {
        let Some(own) = app.name.as_deref() else { return Vec::new() };
        let has = |cycle: &Vec<String>, name: &str| cycle.iter().any(|other| other == name);
        let names = requirement
            .alternatives()
            .iter()
            .filter(|name| self.findings.cycles.iter().any(|cycle| has(cycle, own) && has(cycle, name)));
        names.map(|name| Absence { name: name.clone(), why: Reason::Cycle.words().into(), since }).collect()
    }

    /// Returns the requirements that a running application was notified of as lost.
    pub(super) fn losses_of(self, now: Time, address: AppAddress) -> Vec<Absence> {
        let Some(app) = self.directory.apps.get(address) else { return Vec::new() };
        let lost = app.requires.iter().filter(|requirement| app.lost.contains(requirement.as_str()));
        lost.flat_map(|requirement| self.absences(now, address, requirement)).collect()
    }
}
