//! The remembered peers of a node, and their use.

use std::time::Duration;

use sinew_model::facts::{LinkFact, LossReason};
use sinew_runtime::tid::Incarnation;

use super::world::{PERIOD, Spec, World, ms, node, place, udp};
use crate::core::{Input, Output, REMEMBERED_MAX, RememberedPeer, Source, UNANSWERED_MAX};

/// A node without any source of other nodes.
fn alone(address: u32, incarnation: u64) -> Spec {
    Spec { multicast: false, incarnation, ..Spec::of(address) }
}

fn knowing(address: u32, incarnation: u64, seed: u16) -> Spec {
    Spec { seeds: vec![udp(seed)], ..alone(address, incarnation) }
}

fn sources(world: &World, index: u16) -> Vec<Source> {
    let members = world.at(index).core.members(world.now);
    members.iter().flat_map(|member| member.sources.keys().copied()).collect()
}

fn remembered(world: &World, index: u16) -> Vec<RememberedPeer> {
    world.at(index).core.remembered()
}

/// An address without a node.
fn unused_address() -> RememberedPeer {
    RememberedPeer { address: udp(9), node: node(9), unanswered: 0 }
}

// spec: NDL-2.5
#[test]
fn node_finds_peers_of_its_previous_incarnation() {
    // given: they met, and only the memory of one of them is left
    let mut world = World::new();
    world.start(1, &knowing(1, 1, 2));
    world.start(2, &alone(2, 1));
    world.run_until(ms(1), |world| world.has_member(1, 2) && world.has_member(2, 1));
    let kept = remembered(&world, 1);
    assert_eq!(kept, [RememberedPeer { address: udp(2), node: node(2), unanswered: 0 }]);
    world.start(1, &alone(1, 2));
    world.start(2, &alone(2, 2));
    world.run(PERIOD * 20);
    assert!(!world.has_member(1, 2) && !world.has_member(2, 1));
    // when
    world.input(1, Input::PeersRemembered(kept));
    // then
    world.run_until(ms(1), |world| world.has_member(1, 2) && world.has_member(2, 1));
    // A queried node sends a query of its own.
    assert_eq!(sources(&world, 1), [Source::Query, Source::Remembered]);
    assert_eq!(sources(&world, 2), [Source::Query]);
}

// spec: NDL-2.5
#[test]
fn restarted_layer_queries_nodes_that_had_left_too() {
    let mut world = World::new();
    world.start(1, &knowing(1, 1, 2));
    world.start(2, &alone(2, 1));
    world.run_until(ms(1), |world| world.has_member(1, 2) && world.has_member(2, 1));
    let now = world.now;
    world.process(1).core.use_seeds(now, Vec::new());
    world.input(2, Input::Stopping);
    world.run_until(ms(1), |world| world.losses(1) == [(2, LossReason::Left)]);
    world.start(2, &alone(2, 2));
    world.run(PERIOD * 40);
    assert!(!world.has_member(1, 2), "a node that left is not queried");
    world.restart_shell(1);
    world.run_until(ms(1), |world| world.has_member(1, 2) && world.has_member(2, 1));
    assert!(sources(&world, 1).contains(&Source::Remembered));
}

// spec: NDL-2.5
#[test]
fn node_that_leaves_after_a_restart_is_not_queried() {
    let mut world = World::new();
    world.start(1, &alone(1, 1));
    world.start(2, &knowing(2, 1, 1));
    world.run_until(ms(1), |world| world.has_member(1, 2) && world.has_member(2, 1));
    world.restart_shell(1);
    world.run(PERIOD * 2);
    assert!(world.has_member(1, 2));
    world.input(2, Input::Stopping);
    world.run_until(ms(1), |world| world.losses(1) == [(2, LossReason::Left)]);
    world.forget_the_past();
    world.run(PERIOD * 40);
    assert_eq!(world.at(1).datagrams_sent, 0);
}

/// A node that remembers another one at two addresses. The other announces both and answers at one.
fn beside_one_of_two_addresses(has_keys: bool) -> World {
    let mut world = World::new();
    world.start(1, &Spec { has_keys, ..alone(1, 1) });
    world.start(2, &alone(2, 1));
    world.with(udp(2), |core, now| {
        core.start(now, &[udp(2), udp(3)]);
    });
    let at = |index| RememberedPeer { address: udp(index), node: node(2), unanswered: 0 };
    world.input(1, Input::PeersRemembered(vec![at(2), at(3)]));
    world.run_until(ms(1), |world| world.has_member(1, 2));
    world
}

// spec: NDL-2.5, NDL-4.4
#[test]
fn leaving_node_is_queried_at_none_of_its_addresses() {
    let (node, incarnation) = (node(2), Incarnation(1));
    let says_so = |world: &mut World| world.input(2, Input::Stopping);
    let says_so_on_its_connection = |world: &mut World| {
        world.kill(2);
        world.run(ms(1));
        world.link(1, LinkFact::PeerLeft { node, incarnation, gave_up: None });
    };
    for has_keys in [false, true] {
        for leave in [&says_so as &dyn Fn(&mut World), &says_so_on_its_connection] {
            // given
            let mut world = beside_one_of_two_addresses(has_keys);
            world.link(1, LinkFact::LinkUp { node, incarnation });
            world.run(PERIOD * 2);
            // when
            leave(&mut world);
            world.run_until(ms(1), |world| world.losses(1) == [(2, LossReason::Left)]);
            world.forget_the_past();
            // then
            world.run(PERIOD * 40);
            assert_eq!(world.at(1).datagrams_sent, 0);
        }
    }
    // But the leave of an unauthenticated node does not count for its addresses.
    let mut world = beside_one_of_two_addresses(true);
    world.run_until(PERIOD, |world| world.has_member(2, 1));
    says_so(&mut world);
    world.run_until(ms(1), |world| !world.has_member(1, 2));
    world.run(PERIOD * 2);
    assert!([udp(2), udp(3)].iter().all(|at| world.at(1).core.contacts.contains_key(&place(1, *at))));
}

// spec: NDL-2.5
#[test]
fn unauthenticated_members_address_is_queried_as_announced() {
    let mut world = beside_one_of_two_addresses(true);
    for _ in 0..40 {
        world.run(PERIOD);
        let contact = world.at(1).core.contacts.get(&place(1, udp(3)));
        assert!(contact.is_none_or(|contact| !contact.is_former_of(node(2))));
    }
}

// spec: NDL-2.5, NDL-3.3
#[test]
fn unauthenticated_members_address_is_announced_on_new_paths_too() {
    let comes = |world: &mut World| world.with(udp(1), |core, now| core.use_paths(now, &[udp(1), udp(7)]));
    let comes_with_a_restart = |world: &mut World| {
        world.with(udp(1), |core, now| {
            core.start(now, &[udp(1), udp(7)]);
        });
    };
    for come in [&comes as &dyn Fn(&mut World), &comes_with_a_restart] {
        let mut world = beside_one_of_two_addresses(true);
        // when
        come(&mut world);
        // then
        for _ in 0..40 {
            let contact = world.at(1).core.contacts.get(&place(7, udp(3)));
            assert!(contact.is_none_or(|contact| !contact.is_former_of(node(2))));
            world.run(PERIOD);
        }
        assert!(world.has_member(1, 2));
    }
}

// spec: NDL-2.5
#[test]
fn unanswered_address_is_queried_ever_less_and_never_dropped() {
    let mut world = World::new();
    world.start(1, &alone(1, 1));
    world.input(1, Input::PeersRemembered(vec![unused_address()]));
    world.run(PERIOD * 100);
    let queried = world.at(1).datagrams_sent;
    assert!((8..=12).contains(&queried), "{queried} of 100 periods");
    world.start(9, &alone(9, 1));
    world.run_until(PERIOD * 18, |world| world.has_member(1, 9) && world.has_member(9, 1));
}

// spec: NDL-2.5
#[test]
fn address_named_before_being_remembered_is_kept() {
    let mut world = World::new();
    world.start(1, &alone(1, 1));
    world.input(1, Input::AddressNamed { source: Source::Mdns, address: udp(9) });
    world.input(1, Input::PeersRemembered(vec![unused_address()]));
    world.run(PERIOD * 100);
    world.start(9, &alone(9, 1));
    world.run_until(PERIOD * 18, |world| world.has_member(1, 9) && world.has_member(9, 1));
}

// spec: NDL-2.5
#[test]
fn impostor_that_leaves_does_not_hide_other_addresses() {
    let remembered_at = |index| RememberedPeer { address: udp(index), node: node(2), unanswered: 0 };
    let leave = |world: &mut World| world.input(2, Input::Stopping);
    let crash = |world: &mut World| world.kill(2);
    for go in [&leave as &dyn Fn(&mut World), &crash] {
        // given: another machine has one of its addresses, and its node address
        let mut world = World::new();
        world.start(1, &alone(1, 1));
        world.start(2, &alone(2, 1));
        world.input(1, Input::PeersRemembered(vec![remembered_at(2), remembered_at(3)]));
        world.run_until(ms(1), |world| world.has_member(1, 2));
        assert!(world.at(1).core.contacts.keys().all(|place| place.there != udp(3)), "it is found");
        // when
        go(&mut world);
        world.run_until(PERIOD * 6, |world| !world.has_member(1, 2));
        world.start(3, &alone(2, 2));
        // then
        world.run_until(PERIOD * 18, |world| world.has_member(1, 2) && world.has_member(3, 1));
    }
}

// spec: NDL-2.5, NDL-5.8
#[test]
fn unauthenticated_impostor_does_not_hide_other_addresses() {
    // given: a process without a key answers in the name of node 2, at an address of it
    let remembered_at = |index| RememberedPeer { address: udp(index), node: node(2), unanswered: 0 };
    let asks_there = |world: &World| world.at(1).core.contacts.keys().any(|place| place.there == udp(3));
    let with_a_stranger = || {
        let mut world = World::new();
        world.start(1, &Spec { has_keys: true, ..alone(1, 1) });
        world.start(2, &alone(2, 1));
        world.input(1, Input::PeersRemembered(vec![remembered_at(2), remembered_at(3)]));
        world.run_until(ms(1), |world| world.has_member(1, 2));
        world.run(PERIOD * 20);
        assert!(asks_there(&world));
        world
    };
    // when, then: the node itself is found at its other address, and the collision with it
    let mut world = with_a_stranger();
    world.start(3, &alone(2, 2));
    let is_collision = |other: &Output| matches!(other, Output::Collision { .. });
    world.run_until(PERIOD * 18, |world| world.at(1).others.iter().any(is_collision));
    // when, then: it was node 2 itself
    let mut world = with_a_stranger();
    world.link(1, LinkFact::LinkUp { node: node(2), incarnation: Incarnation(1) });
    assert!(!asks_there(&world));
    world.run(PERIOD * 20);
    assert!(!asks_there(&world), "it announces its address itself");
}

// spec: NDL-2.5
#[test]
fn address_is_forgotten_after_enough_unanswered_long_starts() {
    // given: a start for each of these incarnations of 1, beside 2 or alone, and of this duration
    let start = |kept: Vec<RememberedPeer>, of: (u64, bool), lasts: Duration| {
        let (incarnation, is_beside_another) = of;
        let mut world = World::new();
        if is_beside_another {
            world.start(2, &alone(2, 1));
        }
        world.start(1, &knowing(1, incarnation, 2));
        world.input(1, Input::PeersRemembered(kept));
        world.run(lasts);
        world
    };
    let unanswered = |world: &World| {
        remembered(world, 1).iter().find(|peer| peer.node == node(9)).map(|peer| peer.unanswered)
    };
    let minutes = Duration::from_secs(121);
    let kept = || vec![unused_address()];
    // then: neither a short start counts nor one in which no node answers at all
    assert_eq!(unanswered(&start(kept(), (1, true), Duration::from_secs(59))), Some(0));
    assert_eq!(unanswered(&start(kept(), (1, false), minutes)), Some(0));
    // and: one start counts once
    let mut world = start(kept(), (1, true), minutes);
    for incarnation in 2..u64::from(UNANSWERED_MAX) {
        assert_eq!(u64::from(unanswered(&world).expect("it is remembered")), incarnation - 1);
        let changes = world.at(1).core.remembered_changes();
        assert!(changes > 0, "it is to be kept");
        world = start(remembered(&world, 1), (incarnation, true), minutes);
    }
    world = start(remembered(&world, 1), (9, true), Duration::from_secs(59));
    assert_eq!(unanswered(&world), Some(UNANSWERED_MAX - 1));
    world.run(minutes);
    assert_eq!(unanswered(&world), None);
    assert_eq!(remembered(&world, 1).len(), 1, "a node that answers is remembered");
    assert!(
        world.at(1).core.contacts.keys().all(|place| place.there != udp(9)),
        "it is not queried any more"
    );
}

// spec: NDL-2.5
#[test]
fn answer_clears_the_count_of_unanswered_starts() {
    let mut world = World::new();
    world.start(1, &alone(1, 1));
    world.start(2, &alone(2, 1));
    let kept = RememberedPeer { address: udp(2), node: node(2), unanswered: UNANSWERED_MAX - 1 };
    world.input(1, Input::PeersRemembered(vec![kept]));
    world.run(Duration::from_secs(121));
    assert_eq!(remembered(&world, 1), [RememberedPeer { unanswered: 0, ..kept }]);
}

// spec: NDL-2.5
#[test]
fn members_keep_their_slots() {
    // given: more members than slots, one after the other
    let mut world = World::new();
    world.start(1, &Spec { nodes_max: 128, ..Spec::of(1) });
    let meet = |world: &mut World, index: u16| {
        world.start(index, &alone(index.into(), 1));
        world.run_until(PERIOD * 2, |world| world.has_member(1, index.into()));
    };
    let last = u16::try_from(REMEMBERED_MAX).expect("a few") + 1;
    (2..=last + 1).for_each(|index| meet(&mut world, index));
    // then
    let nodes = |world: &World| remembered(world, 1).iter().map(|peer| peer.node.bits()).collect::<Vec<_>>();
    assert_eq!(nodes(&world), (2..=u32::from(last)).collect::<Vec<_>>());
    // when: one leaves, then: a node met while there was no slot gets one
    let leave = |world: &mut World, left: u16| {
        world.input(left, Input::Stopping);
        world.run_until(ms(1), |world| !world.has_member(1, left.into()));
    };
    leave(&mut world, 4);
    assert!(!nodes(&world).contains(&4) && nodes(&world).contains(&u32::from(last + 1)));
    // when: two more leave, the first one last
    leave(&mut world, 3);
    leave(&mut world, 2);
    meet(&mut world, last + 2);
    // then: the kept list begins with the node that is no member
    assert_eq!(nodes(&world)[0], 2);
    assert!(!nodes(&world).contains(&3) && nodes(&world).contains(&u32::from(last + 2)));
}

// spec: NDL-2.5
#[test]
fn evicted_address_is_no_longer_queried() {
    // given: all slots are taken by nodes that are absent
    let mut world = World::new();
    world.start(1, &knowing(1, 1, 2));
    let absent = |index: u16| RememberedPeer { address: udp(index), node: node(index.into()), unanswered: 0 };
    let most = u16::try_from(REMEMBERED_MAX).expect("a few");
    world.input(1, Input::PeersRemembered((100..100 + most).map(absent).collect()));
    let queried = |world: &World| {
        let there = world.at(1).core.contacts.keys().map(|place| place.there);
        there.filter(|there| *there >= udp(100)).collect::<Vec<_>>()
    };
    assert_eq!(queried(&world).len(), REMEMBERED_MAX);
    // when: another node takes the slot of the one met longest ago
    world.start(2, &alone(2, 1));
    world.run_until(PERIOD * 2, |world| world.has_member(1, 2));
    // then
    assert_eq!(queried(&world), (101..100 + most).map(udp).collect::<Vec<_>>());
    world.run(PERIOD * 20);
    assert_eq!(queried(&world).len(), REMEMBERED_MAX - 1);
}

// spec: NDL-2.5
#[test]
fn address_of_another_node_is_not_queried() {
    let mut world = World::new();
    world.start(1, &alone(1, 1));
    world.with(udp(1), |core, now| core.use_paths(now, &[udp(1), udp(7)]));
    world.input(1, Input::PeersRemembered(vec![unused_address()]));
    world.start(9, &alone(3, 1));
    world.run_until(PERIOD * 4, |world| world.has_member(1, 3));
    assert!(world.at(1).core.contacts.values().all(|contact| !contact.is_former_of(node(9))));
}

// spec: NDL-2.5, NDL-4.3
#[test]
fn lost_node_is_queried_even_after_its_eviction() {
    // given: a node that was found at its remembered address, was lost, and is queried again
    let mut world = World::new();
    world.start(1, &Spec { nodes_max: 128, ..alone(1, 1) });
    world.start(9, &alone(9, 1));
    world.input(1, Input::PeersRemembered(vec![unused_address()]));
    world.run_until(ms(1), |world| world.has_member(1, 9));
    world.kill(9);
    world.run_until(PERIOD * 5, |world| !world.has_member(1, 9));
    // It never sent a query itself.
    world.process(1).core.contacts.get_mut(&place(1, udp(9))).unwrap().sources.remove(&Source::Query);
    world.restart_shell(1);
    // when: so many others come that there is no slot for it
    let most = u16::try_from(REMEMBERED_MAX).expect("a few");
    for index in 100..100 + most {
        world.start(index, &knowing(index.into(), 1, 1));
    }
    world.run_until(PERIOD * 2, |world| world.at(1).core.members.len() == REMEMBERED_MAX);
    assert!(remembered(&world, 1).iter().all(|peer| peer.node != node(9)));
    // then
    world.start(9, &alone(9, 1));
    world.run_until(PERIOD * 18, |world| world.has_member(1, 9));
}

// spec: NDL-2.5, NDL-3.2
#[test]
fn remembered_address_is_only_a_hint() {
    let mut world = World::new();
    world.start(1, &alone(1, 1));
    world.start(2, &alone(3, 1));
    world.input(
        1,
        Input::PeersRemembered(vec![
            RememberedPeer { address: udp(2), node: node(2), unanswered: 0 },
            // Our own address was once that of another node.
            RememberedPeer { address: udp(1), node: node(4), unanswered: 0 },
        ]),
    );
    world.run(PERIOD * 4);
    assert!(world.has_member(1, 3) && !world.has_member(1, 2));
    assert_eq!(world.at(1).core.members.len(), 1);
    assert!(remembered(&world, 1).contains(&RememberedPeer {
        address: udp(2),
        node: node(3),
        unanswered: 0
    }));
}

// spec: NDL-2.5
#[test]
fn with_keys_only_authenticated_nodes_are_remembered() {
    let mut world = World::new();
    world.start(1, &Spec { has_keys: true, ..knowing(1, 1, 2) });
    world.start(2, &alone(2, 1));
    world.run_until(ms(1), |world| world.has_member(1, 2));
    assert_eq!(remembered(&world, 1), []);
    world.link(1, LinkFact::LinkUp { node: node(2), incarnation: Incarnation(1) });
    assert_eq!(remembered(&world, 1).iter().map(|peer| peer.address).collect::<Vec<_>>(), [udp(2)]);
}
