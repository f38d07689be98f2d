//! How a requirement stands: who counts for it, how many of them are ready, and why the others are not.

use std::{collections::BTreeSet, time::Duration};

use sinew_runtime::{
    app::{Requirement, is_pattern},
    tid::{AppAddress, Tid},
    time::Time,
};

use super::{Core, Reason, misspelt::FIRST_AFTER};
use crate::sync::facts::Absence;

/// Of those that a requirement with a pattern or a choice lacks, so many are named at most.
pub(super) const NAMED_MAX: usize = 8;

/// How one requirement of one application stands.
#[derive(Debug, Default)]
pub(super) struct Standing {
    /// Applications that count for it and are ready.
    pub(super) ready: BTreeSet<Tid>,
    /// Names that count for it, and the last that is known of each; patterns that nobody matches.
    pub(super) unready: Vec<(String, Reason)>,
    /// Those of its names and patterns that somebody has, ready or not.
    pub(super) had: Vec<String>,
}

/// Why one is not met.
pub(super) struct Lack<'found> {
    /// How many are ready: too few.
    pub(super) ready: usize,
    /// As in [`Standing`].
    pub(super) unready: &'found [(String, Reason)],
    /// The nearest to readiness of the reasons.
    pub(super) nearest: Reason,
}

impl Standing {
    /// Why `requirement` is not met, the nearest to it of several reasons; `None`: it is.
    pub(super) fn why_not(&self, requirement: &Requirement) -> Option<Reason> {
        if self.ready.len() >= requirement.count() {
            return None;
        }
        // Every application that counts is ready, and they are too few: of the others nobody has been seen.
        Some(self.unready.iter().map(|(_, reason)| *reason).min().unwrap_or(Reason::NotThere))
    }
}

impl Core {
    /// Why no application called `name` is ready; `None`: one is.
    pub(super) fn why_not(&self, name: &str) -> Option<Reason> {
        let requirement = Requirement::name(name);
        self.standing(AppAddress::NONE, &requirement).why_not(&requirement)
    }

    /// How a requirement of the application at `of` stands. It counts for its own: it does not wait for itself.
    pub(super) fn standing(&self, of: AppAddress, requirement: &Requirement) -> Standing {
        let mut standing = Standing::default();
        for alternative in requirement.alternatives() {
            let names: BTreeSet<&str> = if is_pattern(alternative) {
                let here = self.apps.matching(alternative).map(|(name, ..)| &**name);
                here.chain(self.peers.names_like(alternative).map(|name| &**name)).collect()
            } else {
                BTreeSet::from([alternative.as_str()])
            };
            let before = standing.had.len();
            for name in names {
                self.count((of, requirement.phase()), name, alternative, &mut standing);
            }
            if standing.had.len() == before {
                let is_known = self.seen.contains(alternative);
                let reason = if is_known { Reason::Unregistered } else { Reason::NotThere };
                standing.unready.push((alternative.clone(), reason));
            }
        }
        standing
    }

    /// Counts those that have `name`, the application at `of` in any case.
    fn count(
        &self,
        (of, phase): (AppAddress, Option<&str>),
        name: &str,
        alternative: &str,
        standing: &mut Standing,
    ) {
        let here = self.apps.called(name);
        let here = here.map(|(address, app)| (Tid::new(self.node, address), app.why_not(phase)));
        let mut reasons = Vec::new();
        for (tid, why_not) in here.into_iter().chain(self.peers.standing(name, phase)) {
            match why_not {
                _ if tid == Tid::new(self.node, of) => drop(standing.ready.insert(tid)),
                None => drop(standing.ready.insert(tid)),
                Some(reason) => reasons.push(reason),
            }
            standing.had.push(alternative.to_owned());
        }
        // A name of which one application is ready still lacks the others, where more are needed.
        if let Some(nearest) = reasons.into_iter().min()
            && !standing.unready.iter().any(|(known, _)| known == name)
        {
            standing.unready.push((name.to_owned(), nearest));
        }
    }

    /// What `requirement` of the application at `of` lacks, part by part, with the last that is known of each; nothing: it is met.
    pub(super) fn missing_parts(
        &self,
        of: AppAddress,
        requirement: &Requirement,
    ) -> Vec<(String, &'static str)> {
        let standing = self.standing(of, requirement);
        let Some(nearest) = standing.why_not(requirement) else { return Vec::new() };
        let lack = Lack { ready: standing.ready.len(), unready: &standing.unready, nearest };
        self.parts(requirement, lack, usize::MAX)
    }

    /// The same with since when it lacks them.
    pub(super) fn absences(&self, now: Time, of: AppAddress, requirement: &Requirement) -> Vec<Absence> {
        let absent = self.apps.get(of).and_then(|app| app.absent.get(requirement.as_str()));
        let since = absent.map_or(Duration::ZERO, |absent| now.since(*absent));
        let parts = self.missing_parts(of, requirement).into_iter();
        let own = self.apps.get(of).and_then(|app| app.name.as_deref());
        let is_one = requirement.one_name().is_some() && requirement.phase().is_none();
        let similar = |name: &str, why: &'static str| {
            let is_unknown = is_one && why == Reason::NotThere.words() && since >= FIRST_AFTER;
            if is_unknown { self.nearest(name, own) } else { Vec::new() }
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

    /// The parts of a requirement that is not met. That a name is part of a circle is seen within the first
    /// `cycle_names_max` names of circles.
    pub(super) fn parts(
        &self,
        requirement: &Requirement,
        lack: Lack<'_>,
        cycle_names_max: usize,
    ) -> Vec<(String, &'static str)> {
        let Lack { ready, unready, nearest } = lack;
        let in_cycle =
            |name: &str| self.cycles.iter().flatten().take(cycle_names_max).any(|other| other == name);
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
}
