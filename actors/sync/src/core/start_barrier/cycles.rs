//! Cycles of requirements: no application in a cycle could ever start.

use std::collections::{BTreeMap, BTreeSet};

use sinew_runtime::app::{Requirement, is_pattern};

/// Maximum number of names and requirements that a search visits. The search ignores the rest; the deadline
/// of an application that waits there still reports it.
const SEARCH_MAX: usize = 65_536;

/// The applications that a search has found. Several applications may have one name, on several nodes.
#[derive(Debug, Default)]
pub(super) struct Graph {
    applications: Vec<Application>,
    /// The applications of each name; empty if no application has the name yet.
    names: BTreeMap<String, Vec<usize>>,
}

#[derive(Debug)]
struct Application {
    name: String,
    requires: Vec<Requirement>,
}

/// The result of a search for an order in which all applications can start.
struct Impossible {
    /// The applications that cannot become ready in any order.
    applications: BTreeSet<usize>,
    /// For each application and each of its requirements, how many more applications it needs.
    lacks: Vec<Vec<usize>>,
}

/// Returns a cycle among these applications, closed with its first name, if there is one. spec: SYNC-7
pub fn cycle_of(applications: &BTreeMap<&str, Vec<Requirement>>) -> Option<Vec<String>> {
    let starts = applications.values().flatten().cloned().collect();
    let providers = |name: &str| applications.get(name).cloned().into_iter().collect();
    let cycle = Graph::reach(starts, providers).cycles().pop_first()?;
    Some(cycle.iter().chain(cycle.first()).cloned().collect())
}

impl Graph {
    /// Returns the graph of requirements reachable from `starts`. `providers` returns the requirements of
    /// each application of a name.
    pub(super) fn reach(starts: Vec<Requirement>, providers: impl Fn(&str) -> Vec<Vec<Requirement>>) -> Self {
        let mut graph = Self::default();
        let mut open: Vec<String> = starts.iter().flat_map(names_of).map(str::to_owned).collect();
        let mut visited = 0;
        while let Some(name) = open.pop() {
            if visited >= SEARCH_MAX {
                break;
            }
            if graph.names.contains_key(&name) {
                continue;
            }
            let found = providers(&name);
            visited +=
                1 + found.iter().flatten().map(|requirement| requirement.alternatives().len()).sum::<usize>();
            let first = graph.applications.len();
            for requires in found {
                open.extend(requires.iter().flat_map(names_of).map(str::to_owned));
                graph.applications.push(Application { name: name.clone(), requires });
            }
            graph.names.insert(name, (first..graph.applications.len()).collect());
        }
        graph
    }

    /// Returns the cycles of names that can never become ready. Each begins with its smallest name and is not
    /// closed.
    pub(super) fn cycles(&self) -> BTreeSet<Vec<String>> {
        let impossible = self.impossible();
        let mut walked = BTreeSet::new();
        let starts = impossible.applications.iter();
        starts.filter_map(|start| self.walk(*start, &impossible, &mut walked)).collect()
    }

    /// Returns how many other known applications a requirement of the application `of` needs. Returns 0 if an
    /// unknown application may still meet it, or if the requirement has a wait limit. spec: SYNC-7
    fn takes(&self, of: &str, requirement: &Requirement) -> usize {
        let known = |name: &String| self.names.get(name).map_or(0, Vec::len);
        let each: Vec<usize> = requirement.alternatives().iter().map(known).collect();
        let is_open = requirement.wait_max().is_some()
            || requirement.alternatives().iter().any(|name| is_pattern(name))
            || each.contains(&0)
            || each.iter().sum::<usize>() < requirement.count();
        // An application does not wait for itself.
        let own = usize::from(requirement.alternatives().iter().any(|name| name == of));
        if is_open { 0 } else { requirement.count() - own }
    }

    /// Simulates the start of all applications that can start, until none is left that can.
    fn impossible(&self) -> Impossible {
        let mut lacks: Vec<Vec<usize>> = Vec::new();
        let mut dependants: BTreeMap<&str, Vec<(usize, usize)>> = BTreeMap::new();
        for (at, application) in self.applications.iter().enumerate() {
            let takes = |requirement| self.takes(&application.name, requirement);
            lacks.push(application.requires.iter().map(takes).collect());
            for (place, requirement) in application.requires.iter().enumerate() {
                for name in names_of(requirement) {
                    dependants.entry(name).or_default().push((at, place));
                }
            }
        }
        let mut applications: BTreeSet<usize> = (0..self.applications.len()).collect();
        let is_free = |lacks: &Vec<usize>| lacks.iter().all(|left| *left == 0);
        let mut possible: Vec<usize> =
            applications.iter().copied().filter(|at| is_free(&lacks[*at])).collect();
        while let Some(at) = possible.pop() {
            if !applications.remove(&at) {
                continue;
            }
            for (dependant, place) in
                dependants.get(self.applications[at].name.as_str()).into_iter().flatten()
            {
                let lack = &mut lacks[*dependant][*place];
                if *lack > 0 {
                    *lack -= 1;
                    if *lack == 0 && is_free(&lacks[*dependant]) {
                        possible.push(*dependant);
                    }
                }
            }
        }
        Impossible { applications, lacks }
    }

    /// Follows impossible requirements from `start` until they form a cycle, or reach an application in
    /// `walked`.
    fn walk(
        &self,
        start: usize,
        impossible: &Impossible,
        walked: &mut BTreeSet<usize>,
    ) -> Option<Vec<String>> {
        let mut path: Vec<&str> = Vec::new();
        let mut places = BTreeMap::new();
        let mut at = start;
        loop {
            if let Some(place) = places.get(self.name(at)) {
                return Some(from_smallest(&path[*place..]));
            }
            if !walked.insert(at) {
                return None;
            }
            places.insert(self.name(at), path.len());
            path.push(self.name(at));
            at = self.next(at, impossible)?;
        }
    }

    fn name(&self, at: usize) -> &str {
        &self.applications[at].name
    }

    /// Returns another impossible application that the first lacking requirement of `at` names. There is one:
    /// the known applications would suffice if all of them could start.
    fn next(&self, at: usize, impossible: &Impossible) -> Option<usize> {
        let lacked = impossible.lacks[at].iter().position(|lack| *lack > 0)?;
        let names = names_of(&self.applications[at].requires[lacked]);
        let mut behind = names.filter_map(|name| self.names.get(name)).flatten();
        behind.find(|other| **other != at && impossible.applications.contains(other)).copied()
    }
}

/// Returns the names in a requirement, without its patterns.
fn names_of(requirement: &Requirement) -> impl Iterator<Item = &str> {
    requirement.alternatives().iter().map(String::as_str).filter(|name| !is_pattern(name))
}

/// Rotates the cycle so that its smallest name is first: equal cycles are then equal lists.
fn from_smallest(cycle: &[&str]) -> Vec<String> {
    let smallest = (0..cycle.len()).min_by_key(|at| cycle[*at]).unwrap_or(0);
    let turned = cycle[smallest..].iter().chain(&cycle[..smallest]);
    turned.map(|name| (*name).to_owned()).collect()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// `a: b, c` is an application called a that requires b and c.
    fn cycles(applications: &[&str]) -> Vec<String> {
        let parsed: Vec<(&str, Vec<Requirement>)> = applications
            .iter()
            .map(|line| line.split_once(':').unwrap())
            .map(|(name, requires)| {
                (name, requires.split(',').filter_map(|text| text.trim().parse().ok()).collect())
            })
            .collect();
        let starts = parsed.iter().map(|(name, _)| Requirement::name(*name)).collect();
        let providers = |name: &str| {
            parsed.iter().filter(|(other, _)| *other == name).map(|(_, requires)| requires.clone()).collect()
        };
        Graph::reach(starts, providers).cycles().iter().map(|cycle| cycle.join(" ")).collect()
    }

    #[test]
    fn cycle_is_spelled_from_its_smallest_name() {
        assert_eq!(cycles(&["c: a", "b: c", "a: b"]), ["a b c"]);
        assert_eq!(cycles(&["a: b", "b: a", "x: y", "y: x"]), ["a b", "x y"]);
    }

    #[test]
    fn waiting_for_a_cycle_is_not_membership() {
        assert_eq!(cycles(&["before: a", "a: b", "b: a, after", "after:"]), ["a b"]);
    }

    #[test]
    fn self_requirement_alone_is_no_cycle() {
        assert_eq!(cycles(&["a: a"]), [""; 0]);
        assert_eq!(cycles(&["a: 2 of a | b", "b:"]), [""; 0]);
        assert_eq!(
            cycles(&["a: 2 of a", "a:"]),
            [""; 0],
            "one on each of two nodes: one does not wait for itself"
        );
        assert_eq!(cycles(&["a: 2 of a | b", "b: a"]), ["a b"], "but for the other one");
    }

    #[test]
    fn unknown_and_second_names_break_a_cycle() {
        assert_eq!(cycles(&["a: b", "b: unknown"]), [""; 0]);
        assert_eq!(cycles(&["a: b", "b: a", "b:"]), [""; 0]);
    }

    #[test]
    fn endless_chain_is_searched_within_the_bound() {
        let next =
            |name: &str| vec![vec![Requirement::name(format!("{}", name.parse::<u64>().unwrap() + 1))]];
        assert!(Graph::reach(vec![Requirement::name("0")], next).cycles().is_empty());
    }

    #[test]
    fn choice_is_a_cycle_only_if_every_alternative_is() {
        assert_eq!(cycles(&["a: b | c", "b: a", "c: a"]), ["a b"]);
        assert_eq!(cycles(&["a: b | c", "b: a", "c:"]), [""; 0]);
        assert_eq!(cycles(&["a: b | unknown", "b: a"]), [""; 0]);
    }

    #[test]
    fn count_is_a_cycle_if_too_few_can_start() {
        assert_eq!(cycles(&["a: 2 of b | c | d", "b: a", "c: a", "d:"]), ["a b"]);
        assert_eq!(cycles(&["a: 2 of b | c | d", "b: a", "c:", "d:"]), [""; 0]);
        assert_eq!(cycles(&["a: 2 of b", "b: a", "b:"]), ["a b"], "of one name, one cannot");
        assert_eq!(cycles(&["a: 2 of b", "b:"]), [""; 0], "another node may come with a second one");
    }

    #[test]
    fn patterns_and_optional_requirements_break_a_cycle() {
        assert_eq!(cycles(&["a: *.b", "x.b: a"]), [""; 0]);
        assert_eq!(cycles(&["a: b ?1s", "b: a"]), [""; 0]);
    }

    /// Returns the applications that can start, found by trying every order.
    fn startable(applications: &[(&str, Vec<Requirement>)]) -> BTreeSet<usize> {
        let mut started: BTreeSet<usize> = BTreeSet::new();
        loop {
            let before = started.len();
            for (at, (_, requires)) in applications.iter().enumerate() {
                let counting = |requirement: &Requirement| {
                    let is_there = |other: &usize| *other == at || started.contains(other);
                    let there = (0..applications.len()).filter(is_there);
                    there.filter(|other| requirement.counts(applications[*other].0)).count()
                        >= requirement.count()
                };
                if requires.iter().all(counting) {
                    started.insert(at);
                }
            }
            if started.len() == before {
                return started;
            }
        }
    }

    proptest! {
        /// With every name known and every count possible, an application is in a cycle or waits for one if and only if
        /// no start order includes it.
        #[test]
        fn cycle_is_found_where_no_start_order_works(
            wanted in proptest::collection::vec(
                proptest::collection::vec((1usize..3, proptest::collection::btree_set(0usize..5, 2..4)), 0..3), 5)
        ) {
            let names = ["a", "b", "c", "d", "e"];
            let applications: Vec<(&str, Vec<Requirement>)> = names.iter().zip(&wanted).map(|(name, requires)| {
                let requirement = |(count, of): &(usize, BTreeSet<usize>)| {
                    Requirement::at_least(*count, of.iter().map(|at| names[*at]))
                };
                (*name, requires.iter().map(requirement).collect())
            }).collect();
            let starts = names.iter().map(|name| Requirement::name(*name)).collect();
            let providers = |name: &str| {
                applications.iter().filter(|(other, _)| *other == name).map(|(_, requires)| requires.clone()).collect()
            };
            let cycles = Graph::reach(starts, providers).cycles();
            let started = startable(&applications);
            prop_assert_eq!(cycles.is_empty(), started.len() == names.len());
            for name in cycles.iter().flatten() {
                let at = names.iter().position(|other| other == name).unwrap();
                prop_assert!(!started.contains(&at), "{} can start", name);
            }
        }
    }
}
