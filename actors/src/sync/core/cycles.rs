//! Requirements that run in a circle: nobody in it could ever start.

use std::collections::{BTreeMap, BTreeSet};

/// Names and requirements that a search looks at, at most. What lies behind is not searched; the deadline of whoever
/// waits there still reports it.
const SEARCH_MAX: usize = 65_536;

/// The requirements of each application that has a name; several where several nodes have one of that name.
#[derive(Debug, Default)]
pub(super) struct Graph(BTreeMap<String, Vec<Vec<String>>>);

impl Graph {
    /// The part of the requirements that can be reached from `starts`. `providers` gives the requirements of each
    /// application of a name.
    pub(super) fn reach(starts: Vec<String>, providers: impl Fn(&str) -> Vec<Vec<String>>) -> Self {
        let mut graph = Self::default();
        let mut open = starts;
        let mut looked_at = 0;
        while let Some(name) = open.pop() {
            if looked_at >= SEARCH_MAX {
                break;
            }
            if graph.0.contains_key(&name) {
                continue;
            }
            let found = providers(&name);
            looked_at += 1 + found.iter().map(Vec::len).sum::<usize>();
            open.extend(found.iter().flatten().cloned());
            // A name that nobody has yet may come with no requirements: it is never part of a cycle.
            if !found.is_empty() {
                graph.0.insert(name, found);
            }
        }
        graph
    }

    /// Cycles of names that can never become ready: each spelled from its smallest name on, without closing it.
    pub(super) fn cycles(&self) -> BTreeSet<Vec<String>> {
        let impossible = self.impossible();
        let mut walked = BTreeSet::new();
        impossible.iter().filter_map(|start| self.walk(start, &impossible, &mut walked)).collect()
    }

    /// The names that cannot become ready in any order of start: for each of their applications a requirement is
    /// impossible too.
    fn impossible(&self) -> BTreeSet<&str> {
        let mut applications: Vec<(&str, usize)> = Vec::new();
        let mut dependants: BTreeMap<&str, Vec<usize>> = BTreeMap::new();
        for (name, providers) in &self.0 {
            for requires in providers {
                let known: BTreeSet<&str> =
                    requires.iter().map(String::as_str).filter(|name| self.0.contains_key(*name)).collect();
                for required in &known {
                    dependants.entry(required).or_default().push(applications.len());
                }
                applications.push((name, known.len()));
            }
        }
        let mut impossible: BTreeSet<&str> = self.0.keys().map(String::as_str).collect();
        let mut possible: Vec<&str> =
            applications.iter().filter(|(_, left)| *left == 0).map(|(name, _)| *name).collect();
        while let Some(name) = possible.pop() {
            if !impossible.remove(name) {
                continue;
            }
            for dependant in dependants.get(name).into_iter().flatten() {
                let (name, left) = &mut applications[*dependant];
                *left -= 1;
                if *left == 0 {
                    possible.push(name);
                }
            }
        }
        impossible
    }

    /// Follows impossible requirements from `start` until they close, or run into what was `walked` before.
    fn walk<'a>(
        &'a self,
        start: &'a str,
        impossible: &BTreeSet<&'a str>,
        walked: &mut BTreeSet<&'a str>,
    ) -> Option<Vec<String>> {
        let mut path = Vec::new();
        let mut places = BTreeMap::new();
        let mut at = start;
        loop {
            if let Some(place) = places.get(at) {
                return Some(from_smallest(&path[*place..]));
            }
            if !walked.insert(at) {
                return None;
            }
            places.insert(at, path.len());
            path.push(at);
            // An impossible name's first application has an impossible requirement, or the name were possible.
            at = self.0.get(at)?.first()?.iter().find(|name| impossible.contains(name.as_str()))?;
        }
    }
}

/// The cycle turned so that its smallest name comes first: equal cycles look alike.
fn from_smallest(cycle: &[&str]) -> Vec<String> {
    let smallest = (0..cycle.len()).min_by_key(|at| cycle[*at]).unwrap_or(0);
    let turned = cycle[smallest..].iter().chain(&cycle[..smallest]);
    turned.map(|name| (*name).to_owned()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// `a: b c` is an application called a that requires b and c.
    fn cycles(applications: &[&str]) -> Vec<String> {
        let parsed: Vec<(&str, Vec<String>)> = applications
            .iter()
            .map(|line| line.split_once(':').unwrap())
            .map(|(name, requires)| (name, requires.split_whitespace().map(str::to_owned).collect()))
            .collect();
        let starts = parsed.iter().map(|(name, _)| (*name).to_owned()).collect();
        let providers = |name: &str| {
            parsed.iter().filter(|(other, _)| *other == name).map(|(_, requires)| requires.clone()).collect()
        };
        Graph::reach(starts, providers).cycles().iter().map(|cycle| cycle.join(" ")).collect()
    }

    #[test]
    fn a_circle_is_spelled_from_its_smallest_name() {
        assert_eq!(cycles(&["c: a", "b: c", "a: b"]), ["a b c"]);
        assert_eq!(cycles(&["a: a"]), ["a"]);
        assert_eq!(cycles(&["a: b", "b: a", "x: y", "y: x"]), ["a b", "x y"]);
    }

    #[test]
    fn who_only_waits_for_a_circle_is_not_part_of_it() {
        assert_eq!(cycles(&["before: a", "a: b", "b: a after", "after:"]), ["a b"]);
    }

    #[test]
    fn unknown_names_and_a_second_application_of_the_name_are_ways_out() {
        assert_eq!(cycles(&["a: b", "b: unknown"]), [""; 0]);
        assert_eq!(cycles(&["a: b", "b: a", "b:"]), [""; 0]);
    }

    #[test]
    fn a_chain_without_end_is_searched_within_the_bound() {
        let next = |name: &str| vec![vec![format!("{}", name.parse::<u64>().unwrap() + 1)]];
        assert!(Graph::reach(vec!["0".to_owned()], next).cycles().is_empty());
    }
}
