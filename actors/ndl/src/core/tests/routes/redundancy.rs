//! Networks that fail one by one, moments without any answer, and nodes that exploit them.

use sinew_model::config::WatchGroup;

use super::*;
use crate::core::contact::Role;

/// The path from our address in one network to the member's in another.
fn cross(here: u8, there: u8) -> Place {
    Place { here: at(here, 1), there: at(there, 2) }
}

/// A member with an address in each of three networks.
fn in_three() -> Announcement {
    let ndl = [0, 1, 2].map(|network| (u32::from_be_bytes([10, network, 0, 2]), 7_400)).to_vec();
    Announcement { ndl, ..member() }
}

fn bench(networks: &[u8], seeds: Vec<SocketAddr>, watch: Vec<WatchGroup>) -> Bench {
    let core = Spec { multicast: false, seeds, watch, ..Spec::of(1) }.core(9);
    let now = Time::from_nanos(1_000_000_000);
    let mut bench =
        Bench { core, now, facts: Vec::new(), queried: Vec::new(), collisions: 0, moves: Vec::new() };
    let ours: Vec<_> = networks.iter().map(|network| at(*network, 1)).collect();
    bench.core.start(now, &ours);
    bench.drain();
    bench
}

fn watched(missed_max: u32) -> Vec<WatchGroup> {
    vec![WatchGroup { nodes: vec![stranger(2).name], period: ms(10), missed_max }]
}

/// Three networks joined by a host: each address reaches each other one, on nine paths, of which eight are queried.
fn of_three(watch: Vec<WatchGroup>) -> Bench {
    let mut bench = bench(&[0, 1, 2], vec![path(0).there], watch);
    bench.answer(path(0), in_three());
    for (here, there) in (0..3).flat_map(|there| (0..3).map(move |here| (here, there))) {
        if (here, there) != (2, 2) {
            bench.answer(cross(here, there), in_three());
        }
    }
    bench.answer(cross(2, 2), in_three());
    bench.facts.clear();
    bench
}

// spec: NDL-4.1
#[test]
fn last_of_three_networks_keeps_a_watched_member() {
    let mut bench = of_three(watched(3));
    for _ in 0..100 {
        bench.pass(ms(10));
        for (here, there) in (0..3).flat_map(|there| (0..3).map(move |here| (here, there))) {
            bench.answer(cross(here, there), in_three());
        }
    }
    assert_eq!(bench.facts, []);
    for _ in 0..100 {
        bench.pass(ms(10));
        bench.answer(cross(2, 2), in_three());
    }
    assert_eq!(bench.facts, [], "the third network delivers");
}

#[test]
fn place_that_becomes_no_route_is_removed_everywhere() {
    let mut bench = of_three(Vec::new());
    for _ in 0..20 {
        bench.pass(PERIOD);
        bench.answer(cross(2, 2), in_three());
    }
    bench.pass(PERIOD * 30);
    let role = bench.core.contacts.get(&cross(2, 2)).map(|contact| contact.role);
    let is_orphan = bench.incarnation().is_none() && matches!(role, Some(Role::Member(_)));
    assert!(!is_orphan, "it would not be queried any more: {role:?}");
}

// spec: NDL-5.3
#[test]
fn route_taken_without_answers_replaces_no_living_member() {
    let mut bench = Bench::of_two_paths();
    bench.pass(PERIOD * 2);
    bench.speak(elsewhere(), member());
    bench.live(3, &[path(0), path(1)]);
    let others = Announcement { ndl: vec![(0x0a00_0042, 7_400)], ..member() };
    bench.speak(elsewhere(), others);
    bench.speak(elsewhere(), later_incarnation());
    bench.answer(path(0), member());
    bench.pass(ms(200));
    assert_eq!(bench.facts, [], "the member answers at its announced address");
    assert_eq!(bench.incarnation(), Some(Incarnation(5)));
}

// spec: NDL-3.3
#[test]
fn route_taken_without_answers_hides_no_loss() {
    let mut bench = Bench::of_two_paths();
    bench.pass(PERIOD * 2);
    bench.speak(elsewhere(), member());
    bench.live(100, &[path(0), path(1), elsewhere()]);
    bench.live(100, &[elsewhere()]);
    assert!(bench.incarnation().is_none(), "it is lost at its announced address");
}

#[test]
fn single_address_member_is_queried_when_our_path_returns() {
    let mut bench = bench(&[0], Vec::new(), Vec::new());
    let single = Announcement { ndl: vec![], ..member() };
    bench.speak(path(0), single.clone());
    assert!(bench.incarnation().is_some());
    bench.facts.clear();
    bench.core.use_paths(bench.now, &[]);
    bench.pass(ms(100));
    bench.core.use_paths(bench.now, &[at(0, 1)]);
    bench.drain();
    for _ in 0..10 {
        bench.pass(PERIOD);
        bench.answer(path(0), single.clone());
    }
    assert_eq!(bench.facts, [], "it answers each query");
}

// spec: NDL-4.1
#[test]
fn dead_network_alone_loses_no_watched_member() {
    let mut bench = bench(&[0, 1], vec![path(0).there], watched(2));
    bench.answer(path(0), member());
    bench.answer(path(1), member());
    bench.facts.clear();
    for _ in 0..100 {
        bench.pass(ms(10));
        bench.answer(path(0), member());
        bench.answer(path(1), member());
    }
    for round in 0..10 {
        bench.pass(ms(10));
        if round != 1 {
            bench.answer(path(1), member());
        }
    }
    assert_eq!(bench.facts, []);
}
