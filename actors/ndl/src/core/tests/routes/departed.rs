//! Nodes that are gone, and own addresses that are added meanwhile.

use super::*;

/// The path from our address in the second network to the member's in the first.
fn across() -> Place {
    Place { here: path(1).here, there: path(0).there }
}

/// The member with an address in the first network alone.
fn single() -> Announcement {
    Announcement { ndl: Vec::new(), ..member() }
}

/// A node in the first network without any source of others, and with room for one node that is gone.
fn alone() -> Bench {
    let core = Spec { multicast: false, nodes_max: 1, ..Spec::of(1) }.core(9);
    let now = Time::from_nanos(1_000_000_000);
    let (facts, queried, moves) = (Vec::new(), Vec::new(), Vec::new());
    let mut bench = Bench { core, now, facts, queried, collisions: 0, moves };
    bench.core.start(now, &[path(0).here]);
    bench.drain();
    bench
}

impl Bench {
    /// Adds an address of the node in the second network.
    fn joins_the_second_network(&mut self) {
        self.core.use_paths(self.now, &NETWORKS.map(|network| at(network, 1)));
        self.queried.clear();
        self.drain();
    }

    /// Returns the number of queries there in twenty periods in which the member answers in the first network.
    fn queries_to(&mut self, place: Place, member: &Announcement) -> usize {
        self.queried.clear();
        for _ in 0..20 {
            self.pass(PERIOD);
            self.answer(path(0), member.clone());
        }
        self.queried.iter().filter(|queried| **queried == place).count()
    }
}

/// A node that has lost this member to silence, and has got its address in the second network since.
fn without(member: &Announcement) -> Bench {
    let mut bench = alone();
    bench.speak(path(0), member.clone());
    bench.pass(PERIOD * 5);
    assert!(bench.incarnation().is_none(), "it was silent");
    bench.joins_the_second_network();
    assert!(bench.queried.contains(&across()), "it may be in reach from there");
    bench
}

// spec: NDL-2.1
#[test]
fn returned_node_is_queried_from_new_paths_where_announced() {
    let mut bench = without(&single());
    assert!(bench.answer(path(0), single()) && bench.incarnation().is_some());
    assert_eq!(bench.queries_to(across(), &single()), 0, "it does not announce that address");
    // At an address that it announces, it is queried like any member with several addresses.
    let mut bench = without(&member());
    assert!(bench.answer(path(0), member()) && bench.incarnation().is_some());
    let queried = bench.queries_to(across(), &member());
    assert!(queried >= 12, "increasing intervals would be 5 times at most, not {queried}");
}

// spec: NDL-2.1
#[test]
fn left_node_is_queried_from_no_later_path() {
    let mut bench = alone();
    bench.speak(path(0), single());
    bench.core.handle(bench.now, Input::LeaveReceived { from: path(0), leave: single().into() });
    assert!(bench.incarnation().is_none(), "it has left");
    bench.joins_the_second_network();
    assert!(bench.queried.is_empty() && bench.core.contacts.is_empty(), "{:?}", bench.queried);
}

// spec: NDL-2.1
#[test]
fn leave_of_a_lost_node_stops_queries() {
    let mut bench = alone();
    bench.speak(path(0), single());
    bench.pass(PERIOD * 5);
    bench.core.handle(bench.now, Input::LeaveReceived { from: path(0), leave: single().into() });
    bench.joins_the_second_network();
    assert!(!bench.queried.contains(&across()), "{:?}", bench.queried);
}

// spec: NDL-2.5
#[test]
fn left_node_is_queried_when_all_paths_are_new() {
    let mut bench = alone();
    bench.speak(path(0), single());
    bench.core.handle(bench.now, Input::LeaveReceived { from: path(0), leave: single().into() });
    bench.pass(PERIOD * 5);
    bench.queried.clear();
    bench.core.use_paths(bench.now, &[]);
    bench.core.use_paths(bench.now, &[path(1).here]);
    bench.drain();
    assert!(bench.queried.contains(&across()), "{:?}", bench.queried);
    assert!(bench.answer(across(), single()) && bench.incarnation().is_some());
}

// spec: NDL-2.1
#[test]
fn forgotten_incarnations_address_is_forgotten_too() {
    let mut bench = alone();
    bench.speak(path(0), single());
    let announcement = Announcement { claim: Claim::Yielded, ..single() };
    bench.core.handle(bench.now, Input::LeaveReceived { from: path(0), leave: announcement.into() });
    assert!(bench.incarnation().is_none() && bench.core.departed.is_empty(), "it gave its address up");
    bench.pass(PERIOD * 6);
    assert!(bench.core.contacts.is_empty(), "{:?}", bench.core.contacts);
}

// spec: NDL-7.1
#[test]
fn evicted_departed_node_is_queried_from_no_path() {
    let mut bench = without(&member());
    let other = Announcement { ndl: Vec::new(), ..stranger(3) };
    bench.speak(elsewhere(), other);
    bench.pass(PERIOD * 5);
    assert!(!bench.core.members.contains_key(&node(3)) && !bench.core.departed.contains_key(&node(2)));
    assert!(bench.core.contacts.values().all(|contact| !contact.is_former_of(node(2))));
}
