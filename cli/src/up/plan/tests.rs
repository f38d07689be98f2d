//! Properties of plans: carried out on paper, they lead to the wanted nodes, in the wanted order.

use proptest::prelude::*;

use super::*;
use crate::up::order::tests::order;

const NAMES: [&str; 5] = ["ankle", "central", "hip", "knee", "plant"];
const HOSTS: [&str; 3] = ["here", "left", "right"];

/// A robot: for each node its host, its version, and the nodes that come before, all of which have earlier names.
fn robots() -> impl Strategy<Value = BTreeMap<String, Wanted>> {
    let node = (0..HOSTS.len(), 0..3_u8, prop::collection::vec(any::<bool>(), NAMES.len()), any::<bool>());
    prop::collection::vec(node, NAMES.len()).prop_map(|nodes| {
        let there: Vec<_> = nodes.iter().map(|(_, _, _, is_there)| *is_there).collect();
        let wanted = nodes.into_iter().enumerate().filter(|(_, (.., is_there))| *is_there);
        let of = |(at, (host, version, before, _)): (usize, (usize, u8, Vec<bool>, bool))| {
            let after = (0..at).filter(|other| before[*other] && there[*other]);
            let after = after.map(|other| NAMES[other].to_owned()).collect();
            let wanted = Wanted { host: HOSTS[host].to_owned(), order: order(NAMES[at], version), after };
            (NAMES[at].to_owned(), wanted)
        };
        wanted.map(of).collect()
    })
}

/// Nodes with files on hosts, at most one of each name and host.
fn observations() -> impl Strategy<Value = Vec<Observed>> {
    let seen = (0..NAMES.len(), 0..HOSTS.len(), 0..3_u8, any::<bool>());
    prop::collection::vec(seen, 0..8).prop_map(|all| {
        let of = |(name, host, version, is_running): (usize, usize, u8, bool)| {
            let seen =
                Observed { host: HOSTS[host].to_owned(), order: order(NAMES[name], version), is_running };
            ((name, host), seen)
        };
        all.into_iter().map(of).collect::<BTreeMap<_, _>>().into_values().collect()
    })
}

/// Carries out a plan on paper. Each node is ready as soon as it runs.
fn carried_out(plan: &Plan, wanted: &BTreeMap<String, Wanted>, observed: &[Observed]) -> Vec<Observed> {
    let key = |seen: &Observed| (seen.order.name.clone(), seen.host.clone());
    let mut hosts: BTreeMap<_, _> = observed.iter().map(|seen| (key(seen), seen.clone())).collect();
    for step in &plan.steps {
        match step {
            Step::Stop { host, node } => {
                let seen = hosts.get_mut(&(node.clone(), host.clone())).expect("it has files there");
                assert!(seen.is_running, "{node} is stopped and does not run");
                seen.is_running = false;
            }
            Step::Remove { host, node } => {
                let seen = hosts.remove(&(node.clone(), host.clone())).expect("it has files there");
                assert!(!seen.is_running, "the files of {node} are removed while it runs");
            }
            Step::Start { host, node } => {
                let runs = hosts.values().any(|seen| seen.order.name == *node && seen.is_running);
                assert!(!runs, "{node} is started and runs already");
                for before in &wanted[node].after {
                    let is_ready = |seen: &Observed| seen.order.name == *before && seen.is_running;
                    assert!(hosts.values().any(is_ready), "{node} is started before {before}");
                }
                let order = wanted[node].order.clone();
                let seen = Observed { host: host.clone(), order, is_running: true };
                hosts.insert(key(&seen), seen);
            }
            Step::Wait { nodes } => {
                for node in nodes {
                    let is_ready = |seen: &Observed| seen.order.name == *node && seen.is_running;
                    assert!(hosts.values().any(is_ready), "nothing will make {node} ready");
                }
            }
        }
    }
    hosts.into_values().collect()
}

proptest! {
    #[test]
    fn plan_leads_to_the_wanted_nodes(wanted in robots(), observed in observations()) {
        let reached = carried_out(&plan(&wanted, &observed), &wanted, &observed);
        prop_assert_eq!(reached.len(), wanted.len());
        for seen in &reached {
            let wanted = &wanted[&seen.order.name];
            prop_assert!(seen.is_running && seen.host == wanted.host && seen.order == wanted.order, "{:?}", seen);
        }
    }

    #[test]
    fn second_plan_has_nothing_to_do(wanted in robots(), observed in observations()) {
        let reached = carried_out(&plan(&wanted, &observed), &wanted, &observed);
        let again = plan(&wanted, &reached);
        prop_assert!(again.is_done(), "{:?}", again);
        prop_assert_eq!(again.steps, [Step::Wait { nodes: wanted.keys().cloned().collect() }]);
    }

    #[test]
    fn unchanged_running_node_is_left_alone(wanted in robots(), observed in observations()) {
        for step in &plan(&wanted, &observed).steps {
            let (Step::Stop { host, node } | Step::Start { host, node } | Step::Remove { host, node }) = step else {
                continue;
            };
            let seen = observed.iter().find(|seen| seen.host == *host && seen.order.name == *node);
            let is_same = |seen: &&Observed| {
                let wanted = wanted.get(node).filter(|wanted| wanted.host == *host);
                seen.is_running && wanted.is_some_and(|wanted| wanted.order == seen.order)
            };
            prop_assert!(!seen.is_some_and(|seen| is_same(&seen)), "{:?}", step);
        }
    }

    #[test]
    fn started_node_waits_for_all_before(wanted in robots(), observed in observations()) {
        let plan = plan(&wanted, &observed);
        for (at, step) in plan.steps.iter().enumerate() {
            let Step::Start { node, .. } = step else { continue };
            for before in &wanted[node].after {
                let waits = plan.steps[..at].iter().any(|step| {
                    matches!(step, Step::Wait { nodes } if nodes.contains(before))
                });
                prop_assert!(waits, "{} does not wait for {}: {:?}", node, before, plan.steps);
            }
        }
    }
}

#[test]
fn reasons_name_the_changed_parts() {
    let node = |version| Wanted { host: "here".to_owned(), order: order("knee", version), after: Vec::new() };
    let wanted = BTreeMap::from([("knee".to_owned(), node(2))]);
    let seen =
        |host: &str, is_running| Observed { host: host.to_owned(), order: order("knee", 1), is_running };
    let rows = |observed: &[Observed]| {
        let rows = plan(&wanted, observed).rows;
        rows.into_iter()
            .map(|row| format!("{} {}: {}", row.host, row.action.word(), row.why))
            .collect::<Vec<_>>()
    };
    assert_eq!(rows(&[]), ["here start: it does not run"]);
    assert_eq!(rows(&[seen("here", false)]), ["here start: it has ended"]);
    assert_eq!(rows(&[seen("here", true)]), ["here restart: its program changed"]);
    let moved = ["here start: it does not run", "left remove: it belongs to host here"];
    assert_eq!(rows(&[seen("left", true)]), moved);
}
