//! Requirements that run in a circle: nobody in it could ever start.

use std::collections::{BTreeMap, BTreeSet};

use sinew_runtime::app::{Requirement, is_pattern};

/// Names and requirements that a search looks at, at most. What lies behind is not searched; the deadline of whoever
/// waits there still reports it.
const SEARCH_MAX: usize = 65_536;

/// The applications that a search has found, several of one name where several nodes have one.
#[derive(Debug, Default)]
pub(super) struct Graph {
    applications: Vec<Application>,
    /// Which applications have a name; none where nobody has it yet.
    names: BTreeMap<String, Vec<usize>>,
}

#[derive(Debug)]
struct Application {
    name: String,
    requires: Vec<Requirement>,
}

/// What is left of a search for an order in which all can start.
struct Impossible {
    /// The applications that cannot become ready in any order.
    applications: BTreeSet<usize>,
    /// Of each application and each of its requirements, how many more it would take.
    lacks: Vec<Vec<usize>>,
}

/// A circle among these applications, the first name again at the end, if there is one. spec: SYNC-7
pub(crate) fn circle_of(applications: &BTreeMap<&str, Vec<Requirement>>) -> Option<Vec<String>> {
    let starts = applications.values().flatten().cloned().collect();
    let providers = |name: &str| applications.get(name).cloned().into_iter().collect();
    let circle = Graph::reach(starts, providers).cycles().pop_first()?;
    Some(circle.iter().chain(circle.first()).cloned().collect())
}

impl Graph {
    /// The part of the requirements that can be reached from `starts`. `providers` gives the requirements of each
    /// application of a name.
    pub(super) fn reach(starts: Vec<Requirement>, providers: impl Fn(&str) -> Vec<Vec<Requirement>>) -> Self {
        let mut graph = Self::default();
        let mut open: Vec<String> = starts.iter().flat_map(names_of).map(str::to_owned).collect();
        let mut looked_at = 0;
        while let Some(name) = open.pop() {
            if looked_at >= SEARCH_MAX {
                break;
            }
            if graph.names.contains_key(&name) {
                continue;
            }
            let found = providers(&name);
            looked_at +=
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

    /// Cycles of names that can never become ready: each spelled from its smallest name on, without closing it.
    pub(super) fn cycles(&self) -> BTreeSet<Vec<String>> {
        let impossible = self.impossible();
        let mut walked = BTreeSet::new();
        let starts = impossible.applications.iter();
        starts.filter_map(|start| self.walk(*start, &impossible, &mut walked)).collect()
    }

    /// How many other applications a requirement of one called `of` takes of those that are known; none if somebody who is not known
    /// yet may come and meet it, or if it is done without in the end. spec: SYNC-7
    fn takes(&self, of: &str, requirement: &Requirement) -> usize {
        let known = |name: &String| self.names.get(name).map_or(0, Vec::len);
        let each: Vec<usize> = requirement.alternatives().iter().map(known).collect();
        let is_open = requirement.wait_max().is_some()
            || requirement.alternatives().iter().any(|name| is_pattern(name))
            || each.contains(&0)
            || each.iter().sum::<usize>() < requirement.count();
        // It does not wait for itself.
        let own = usize::from(requirement.alternatives().iter().any(|name| name == of));
        if is_open { 0 } else { requirement.count() - own }
    }

    /// Starts in thought whoever can be started, until nobody is left who can.
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

    /// Follows impossible requirements from `start` until they close, or run into what was `walked` before.
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

    /// Another impossible application behind the first requirement that an impossible one lacks. There is one: those that are known
    /// would be enough if all of them could start.
    fn next(&self, at: usize, impossible: &Impossible) -> Option<usize> {
        let lacked = impossible.lacks[at].iter().position(|lack| *lack > 0)?;
        let names = names_of(&self.applications[at].requires[lacked]);
        let mut behind = names.filter_map(|name| self.names.get(name)).flatten();
        behind.find(|other| **other != at && impossible.applications.contains(other)).copied()
    }
}

/// The names that a requirement spells out.
fn names_of(requirement: &Requirement) -> impl Iterator<Item = &str> {
    requirement.alternatives().iter().map(String::as_str).filter(|name| !is_pattern(name))
}

/// The cycle turned so that its smallest name comes first: equal cycles look alike.
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
    fn a_circle_is_spelled_from_its_smallest_name() {
        assert_eq!(cycles(&["c: a", "b: c", "a: b"]), ["a b c"]);
        assert_eq!(cycles(&["a: b", "b: a", "x: y", "y: x"]), ["a b", "x y"]);
    }

    #[test]
    fn who_only_waits_for_a_circle_is_not_part_of_it() {
        assert_eq!(cycles(&["before: a", "a: b", "b: a, after", "after:"]), ["a b"]);
    }

    #[test]
    fn who_requires_itself_is_in_no_circle_by_that() {
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
    fn unknown_names_and_a_second_application_of_the_name_are_ways_out() {
        assert_eq!(cycles(&["a: b", "b: unknown"]), [""; 0]);
        assert_eq!(cycles(&["a: b", "b: a", "b:"]), [""; 0]);
    }

    #[test]
    fn a_chain_without_end_is_searched_within_the_bound() {
        let next =
            |name: &str| vec![vec![Requirement::name(format!("{}", name.parse::<u64>().unwrap() + 1))]];
        assert!(Graph::reach(vec![Requirement::name("0")], next).cycles().is_empty());
    }

    #[test]
    fn a_choice_is_a_circle_only_if_every_way_runs_back() {
        assert_eq!(cycles(&["a: b | c", "b: a", "c: a"]), ["a b"]);
        assert_eq!(cycles(&["a: b | c", "b: a", "c:"]), [""; 0]);
        assert_eq!(cycles(&["a: b | unknown", "b: a"]), [""; 0]);
    }

    #[test]
    fn a_count_is_a_circle_if_too_few_can_start_without_it() {
        assert_eq!(cycles(&["a: 2 of b | c | d", "b: a", "c: a", "d:"]), ["a b"]);
        assert_eq!(cycles(&["a: 2 of b | c | d", "b: a", "c:", "d:"]), [""; 0]);
        assert_eq!(cycles(&["a: 2 of b", "b: a", "b:"]), ["a b"], "of one name, one cannot");
        assert_eq!(cycles(&["a: 2 of b", "b:"]), [""; 0], "another node may come with a second one");
    }

    #[test]
    fn patterns_and_what_is_done_without_are_ways_out() {
        assert_eq!(cycles(&["a: *.b", "x.b: a"]), [""; 0]);
        assert_eq!(cycles(&["a: b ?1s", "b: a"]), [""; 0]);
    }

    /// Whether somebody can start who has not, by trying.
    fn who_starts(applications: &[(&str, Vec<Requirement>)]) -> BTreeSet<usize> {
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
        /// Where every name is known and every count could be had, somebody is in a circle or behind one if and only if
        /// trying all starts leaves somebody out.
        #[test]
        fn a_circle_is_found_where_no_order_of_start_works(
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
            let started = who_starts(&applications);
            prop_assert_eq!(cycles.is_empty(), started.len() == names.len());
            for name in cycles.iter().flatten() {
                let at = names.iter().position(|other| other == name).unwrap();
                prop_assert!(!started.contains(&at), "{} can start", name);
            }
        }
    }
}
