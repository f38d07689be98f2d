//! The missing requirements of an application, found with bounded effort, for a thread that carries messages.

use std::collections::BTreeSet;

use sinew_runtime::{
    app::{Requirement, is_pattern, matches},
    tid::{AppAddress, Tid},
};

use super::{NAMED_MAX, Readiness, Reason, Unmet};

/// Maximum effort of one query. A unit takes about 25 ns, so a query takes 50 us.
const EFFORT_MAX: usize = 2_000;
/// Effort to compare a name with a pattern.
const COMPARE: usize = 1;
/// Additional effort for each `*` of the pattern.
const STAR: usize = 2;
/// Effort to check an application.
const APPLICATION: usize = 6;
/// Maximum number of parts in a result.
const PARTS_MAX: usize = 16;
/// Maximum number of names in cycles that are searched for each part.
const CYCLE_NAMES_MAX: usize = 32;
/// The reason for the first requirement that is not fully checked.
const TOO_MUCH: &str = "not checked: too many patterns and names are required";

/// The remaining effort of a query.
struct Effort(usize);

/// The applications found for one requirement.
#[derive(Default)]
struct Found {
    ready: BTreeSet<Tid>,
    unready: Vec<(String, Reason)>,
    nearest: Option<Reason>,
}

impl Effort {
    /// Subtracts `cost`. Returns `None` if the remaining effort is too small.
    fn spend(&mut self, cost: usize) -> Option<()> {
        self.0 = self.0.checked_sub(cost)?;
        Some(())
    }
}

impl Found {
    fn add_unready(&mut self, name: &str, why: Reason) {
        self.nearest = Some(self.nearest.map_or(why, |nearest| nearest.min(why)));
        if self.unready.len() < NAMED_MAX && !self.unready.iter().any(|(known, _)| known == name) {
            self.unready.push((name.to_owned(), why));
        }
    }
}

impl Readiness<'_> {
    /// Returns the missing requirements of the application at `address`, as far as `EFFORT_MAX` permits: at
    /// most `PARTS_MAX` parts. Returns nothing if the application does not wait at the start-up barrier, or
    /// is not known.
    pub(in crate::core) fn missing_in_brief(self, address: AppAddress) -> Vec<(String, &'static str)> {
        let waits = self.directory.apps.get(address).filter(|app| app.wait().is_some());
        let mut effort = Effort(EFFORT_MAX);
        let mut parts = Vec::new();
        for requirement in waits.into_iter().flat_map(|app| &app.requires) {
            let Some(found) = self.find(address, requirement, &mut effort) else {
                parts.push((requirement.to_string(), TOO_MUCH));
                break;
            };
            if found.ready.len() < requirement.count() {
                let nearest = found.nearest.unwrap_or(Reason::NotThere);
                let unmet = Unmet { ready: found.ready.len(), unready: &found.unready, nearest };
                parts.extend(self.parts(requirement, unmet, CYCLE_NAMES_MAX));
            }
            if parts.len() >= PARTS_MAX {
                break;
            }
        }
        parts.truncate(PARTS_MAX);
        parts
    }

    /// Finds the applications that count for a requirement, until enough of them are ready. Returns `None` if
    /// the effort is exhausted.
    fn find(self, of: AppAddress, requirement: &Requirement, effort: &mut Effort) -> Option<Found> {
        let mut found = Found::default();
        for alternative in requirement.alternatives() {
            let mut is_registered = false;
            if is_pattern(alternative) {
                let compare = COMPARE + STAR * alternative.matches('*').count();
                for name in self.directory.all_names() {
                    effort.spend(compare)?;
                    if matches(alternative, name) {
                        is_registered |= self.check((of, requirement.phase()), name, &mut found, effort)?;
                    }
                    if found.ready.len() >= requirement.count() {
                        return Some(found);
                    }
                }
            } else {
                effort.spend(COMPARE)?;
                is_registered = self.check((of, requirement.phase()), alternative, &mut found, effort)?;
            }
            if !is_registered {
                found.add_unready(alternative, self.why_absent(alternative));
            }
        }
        Some(found)
    }

    /// Checks the applications called `name`. The application at `of` always counts as ready. Returns whether
    /// any application has the name.
    fn check(
        self,
        (of, phase): (AppAddress, Option<&str>),
        name: &str,
        found: &mut Found,
        effort: &mut Effort,
    ) -> Option<bool> {
        let own = Tid::new(self.directory.peers.here(), of);
        let mut is_registered = false;
        for (tid, why_not) in self.directory.states(name, phase) {
            effort.spend(APPLICATION)?;
            is_registered = true;
            match why_not {
                _ if tid == own => drop(found.ready.insert(tid)),
                None => drop(found.ready.insert(tid)),
                Some(reason) => found.add_unready(name, reason),
            }
        }
        Some(is_registered)
    }
}
