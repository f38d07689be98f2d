//! Nodes that are gone, and addresses of ours that come meanwhile.

use super::*;

/// From our address in the second network to the member's in the first.
fn across() -> Place {
    Place { here: way(1).here, there: way(0).there }
}

/// The member with an address in the first network alone.
fn single() -> Announcement {
    Announcement { ndl: Vec::new(), ..member() }
}

/// A node in the first network that no source tells of others, and that has room for one node that is gone.
fn alone() -> Bench {
    let core = Spec { multicast: false, nodes_max: 1, ..Spec::of(1) }.core(9);
    let now = Time::from_nanos(1_000_000_000);
    let (facts, asked, moves) = (Vec::new(), Vec::new(), Vec::new());
    let mut bench = Bench { core, now, facts, asked, collisions: 0, moves };
    bench.core.start(now, &[way(0).here]);
    bench.drain();
    bench
}

impl Bench {
    /// The node gets an address in the second network, too.
    fn joins_the_second_network(&mut self) {
        self.core.use_paths(self.now, &NETWORKS.map(|network| at(network, 1)));
        self.asked.clear();
        self.drain();
    }

    /// How often it was asked there in twenty periods in which the member answers in the first network.
    fn asks(&mut self, place: Place, member: &Announcement) -> usize {
        self.asked.clear();
        for _ in 0..20 {
            self.pass(PERIOD);
            self.answer(way(0), member.clone());
        }
        self.asked.iter().filter(|asked| **asked == place).count()
    }
}

/// One that has lost this member to silence, and has got its address in the second network since.
fn without(member: &Announcement) -> Bench {
    let mut bench = alone();
    bench.speak(way(0), member.clone());
    bench.pass(PERIOD * 5);
    assert!(bench.life().is_none(), "it was silent");
    bench.joins_the_second_network();
    assert!(bench.asked.contains(&across()), "it may be in reach from there");
    bench
}

// spec: NDL-2.1
#[test]
fn who_is_back_is_asked_from_an_address_that_came_meanwhile_where_it_says_that_it_is_and_nowhere_else() {
    let mut bench = without(&single());
    assert!(bench.answer(way(0), single()) && bench.life().is_some());
    assert_eq!(bench.asks(across(), &single()), 0, "it does not say that it is there");
    // Where it does, it is asked as any member is that has several.
    let mut bench = without(&member());
    assert!(bench.answer(way(0), member()) && bench.life().is_some());
    let asked = bench.asks(across(), &member());
    assert!(asked >= 12, "ever more seldom would be 5 times at most, not {asked}");
}

// spec: NDL-2.1
#[test]
fn who_has_left_is_asked_from_no_address_that_comes_later() {
    let mut bench = alone();
    bench.speak(way(0), single());
    bench.core.handle(bench.now, Input::LeaveReceived { from: way(0), leave: single().into() });
    assert!(bench.life().is_none(), "it said goodbye");
    bench.joins_the_second_network();
    assert!(bench.asked.is_empty() && bench.core.contacts.is_empty(), "{:?}", bench.asked);
}

// spec: NDL-2.1
#[test]
fn who_says_goodbye_when_it_is_lost_already_is_asked_from_no_address_that_comes_later() {
    let mut bench = alone();
    bench.speak(way(0), single());
    bench.pass(PERIOD * 5);
    bench.core.handle(bench.now, Input::LeaveReceived { from: way(0), leave: single().into() });
    bench.joins_the_second_network();
    assert!(!bench.asked.contains(&across()), "{:?}", bench.asked);
}

// spec: NDL-2.5
#[test]
fn who_has_left_is_asked_again_when_it_can_know_none_of_our_addresses_any_more() {
    let mut bench = alone();
    bench.speak(way(0), single());
    bench.core.handle(bench.now, Input::LeaveReceived { from: way(0), leave: single().into() });
    bench.pass(PERIOD * 5);
    bench.asked.clear();
    bench.core.use_paths(bench.now, &[]);
    bench.core.use_paths(bench.now, &[way(1).here]);
    bench.drain();
    assert!(bench.asked.contains(&across()), "{:?}", bench.asked);
    assert!(bench.answer(across(), single()) && bench.life().is_some());
}

// spec: NDL-2.1
#[test]
fn whose_life_nothing_is_kept_of_is_forgotten_where_it_was() {
    let mut bench = alone();
    bench.speak(way(0), single());
    let announcement = Announcement { claim: Claim::Yielded, ..single() };
    bench.core.handle(bench.now, Input::LeaveReceived { from: way(0), leave: announcement.into() });
    assert!(bench.life().is_none() && bench.core.gone.is_empty(), "it gave its address up");
    bench.pass(PERIOD * 6);
    assert!(bench.core.contacts.is_empty(), "{:?}", bench.core.contacts);
}

// spec: NDL-7.1
#[test]
fn who_was_gone_longest_and_makes_room_is_asked_from_no_address_any_more() {
    let mut bench = without(&member());
    let other = Announcement { ndl: Vec::new(), ..stranger(3) };
    bench.speak(elsewhere(), other);
    bench.pass(PERIOD * 5);
    assert!(!bench.core.members.contains_key(&node(3)) && !bench.core.gone.contains_key(&node(2)));
    assert!(bench.core.contacts.values().all(|contact| !contact.is_former_of(node(2))));
}
