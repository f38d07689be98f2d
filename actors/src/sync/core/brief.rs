//! What an application waits for, found with bounded effort: for a thread that carries everybody's messages.

use std::collections::BTreeSet;

use sinew_runtime::{
    app::{Requirement, is_pattern, matches},
    tid::{AppAddress, Tid},
};

use super::{
    Core, Reason,
    requirements::{Lack, NAMED_MAX},
};

/// What one look may cost. A unit is some 25 ns, so that a look takes 50 us.
const EFFORT_MAX: usize = 2_000;
/// A name is compared with a pattern.
const COMPARE: usize = 1;
/// What each `*` of the pattern adds.
const STAR: usize = 2;
/// An application is looked at.
const APPLICATION: usize = 6;
/// Parts that are named at most.
const PARTS_MAX: usize = 16;
/// Names in circles that are looked through for each part.
const CYCLE_NAMES_MAX: usize = 32;
/// Said of the first requirement that is not looked at to its end.
const TOO_MUCH: &str = "not looked at: too much is required, by patterns, of too many names";

/// What is left of a look's effort.
struct Effort(usize);

/// What was found of one requirement.
#[derive(Default)]
struct Found {
    ready: BTreeSet<Tid>,
    unready: Vec<(String, Reason)>,
    nearest: Option<Reason>,
}

impl Effort {
    /// `None`: there is not so much left.
    fn spend(&mut self, cost: usize) -> Option<()> {
        self.0 = self.0.checked_sub(cost)?;
        Some(())
    }
}

impl Found {
    fn lacks(&mut self, name: &str, why: Reason) {
        self.nearest = Some(self.nearest.map_or(why, |nearest| nearest.min(why)));
        if self.unready.len() < NAMED_MAX && !self.unready.iter().any(|(known, _)| known == name) {
            self.unready.push((name.to_owned(), why));
        }
    }
}

impl Core {
    /// What the application at `address` lacks at the barrier, as far as that is found with `EFFORT_MAX`: `PARTS_MAX` parts at
    /// most. Nothing: it does not wait there, or is not known.
    pub(crate) fn missing_in_brief(&self, address: AppAddress) -> Vec<(String, &'static str)> {
        let waits = self.apps.get(address).filter(|app| app.wait().is_some());
        let mut effort = Effort(EFFORT_MAX);
        let mut parts = Vec::new();
        for requirement in waits.into_iter().flat_map(|app| &app.requires) {
            let Some(found) = self.find(address, requirement, &mut effort) else {
                parts.push((requirement.to_string(), TOO_MUCH));
                break;
            };
            if found.ready.len() < requirement.count() {
                let nearest = found.nearest.unwrap_or(Reason::NotThere);
                let lack = Lack { ready: found.ready.len(), unready: &found.unready, nearest };
                parts.extend(self.parts(requirement, lack, CYCLE_NAMES_MAX));
            }
            if parts.len() >= PARTS_MAX {
                break;
            }
        }
        parts.truncate(PARTS_MAX);
        parts
    }

    /// Who counts for a requirement, until enough of them are ready; `None`: that is too much.
    fn find(&self, of: AppAddress, requirement: &Requirement, effort: &mut Effort) -> Option<Found> {
        let mut found = Found::default();
        for alternative in requirement.alternatives() {
            let mut is_had = false;
            if is_pattern(alternative) {
                let compare = COMPARE + STAR * alternative.matches('*').count();
                for name in self.apps.names().chain(self.peers.names()) {
                    effort.spend(compare)?;
                    if matches(alternative, name) {
                        is_had |= self.look_at((of, requirement.phase()), name, &mut found, effort)?;
                    }
                    if found.ready.len() >= requirement.count() {
                        return Some(found);
                    }
                }
            } else {
                effort.spend(COMPARE)?;
                is_had = self.look_at((of, requirement.phase()), alternative, &mut found, effort)?;
            }
            if !is_had {
                let is_known = self.seen.contains(alternative);
                found.lacks(alternative, if is_known { Reason::Unregistered } else { Reason::NotThere });
            }
        }
        Some(found)
    }

    /// Looks at those that have `name`; the application at `of` counts in any case. Returns whether anybody has it.
    fn look_at(
        &self,
        (of, phase): (AppAddress, Option<&str>),
        name: &str,
        found: &mut Found,
        effort: &mut Effort,
    ) -> Option<bool> {
        let here = self.apps.called(name);
        let here = here.map(|(address, app)| (Tid::new(self.node, address), app.why_not(phase)));
        let mut is_had = false;
        for (tid, why_not) in here.into_iter().chain(self.peers.standing(name, phase)) {
            effort.spend(APPLICATION)?;
            is_had = true;
            match why_not {
                _ if tid == Tid::new(self.node, of) => drop(found.ready.insert(tid)),
                None => drop(found.ready.insert(tid)),
                Some(reason) => found.lacks(name, reason),
            }
        }
        Some(is_had)
    }
}
