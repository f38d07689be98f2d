//! The rules of NDL, one scenario per rule.

use std::net::SocketAddr;

use sinew_model::facts::{AppFact, LossReason, MembershipFact, NodeEvent};
use sinew_runtime::{
    tid::{AppAddress, Incarnation, NodeAddress},
    time::Time,
};

use super::world::{PERIOD, Spec, World, ms, node, place, udp};
use crate::{
    core::{Host, Input, Output, OwnStalls, Source},
    datagram::{Announcement, Answer, Body, Claim, Datagram, encode},
};

pub(super) fn bytes(correlation: u64, body: Body) -> Vec<u8> {
    encode(&Datagram { correlation, sent: Time::ZERO, body }, NodeAddress::ALL).to_vec()
}

pub(super) fn stranger(address: u32) -> Announcement {
    Announcement {
        project: "p".to_owned(),
        node: node(address),
        name: "stranger".to_owned(),
        incarnation: Incarnation(1),
        boot_nonce: 0xbad,
        gncl_ip: 0x0a00_0001,
        gncl_port: 1,
        period_us: 500_000,
        gncl_further: Vec::new(),
        ndl: Vec::new(),
        ndl6: Vec::new(),
        gncl_port6: 0,
        claim: Claim::Held,
    }
}

#[test]
fn started_node_is_known_within_a_millisecond() {
    // given: a node in the middle of its period
    let mut world = World::new();
    world.start(1, &Spec::of(1));
    world.run(ms(730));
    // when
    world.start(2, &Spec::of(2));
    // then: five datagram times at most, of 100 us each
    world.run_until(ms(1), |world| world.has_member(1, 2) && world.has_member(2, 1));
    let found =
        NodeEvent::NodeFound { node: node(2), name: "node-2".to_owned(), incarnation: Incarnation(1) };
    assert_eq!(world.at(1).events, [found]);
    let gncl = vec![SocketAddr::from(([10, 0, 0, 1], 5_002))];
    let fact = MembershipFact::NodeFound { node: node(2), incarnation: Incarnation(1), gncl };
    assert_eq!(world.at(1).facts, [fact]);
}

// spec: NDL-2.1
#[test]
fn seed_on_one_side_is_enough_for_both() {
    let mut world = World::new();
    world.start(1, &Spec { multicast: false, ..Spec::of(1) });
    world.start(2, &Spec { multicast: false, seeds: vec![udp(1), udp(2)], ..Spec::of(2) });
    world.run_until(ms(1), |world| world.has_member(1, 2) && world.has_member(2, 1));
    let now = world.now;
    let sources = |index| world.at(index).core.members(now)[0].sources.keys().copied().collect::<Vec<_>>();
    assert!(sources(2).contains(&Source::Seed));
    assert_eq!(sources(1), [Source::Query], "a node without a source was found by the other one");
}

#[test]
fn seed_that_starts_late_is_found_when_it_starts() {
    let mut world = World::new();
    world.start(1, &Spec { multicast: false, seeds: vec![udp(2)], ..Spec::of(1) });
    world.run(PERIOD * 100);
    world.start(2, &Spec { multicast: false, ..Spec::of(2) });
    let took = world.run_until(PERIOD * 2, |world| world.has_member(1, 2) && world.has_member(2, 1));
    assert!(took <= PERIOD + ms(1), "{took:?}");
}

#[test]
fn known_since_is_the_time_of_the_found_incarnation() {
    // given: a seed without a node for long
    let mut world = World::new();
    let second = |incarnation| Spec { incarnation, multicast: false, ..Spec::of(2) };
    world.start(1, &Spec { multicast: false, seeds: vec![udp(2)], ..Spec::of(1) });
    world.run(PERIOD * 100);
    for incarnation in [1, 2] {
        // when
        let started = world.now;
        world.start(2, &second(incarnation));
        let known = |world: &World| {
            let members = world.at(1).core.members(world.now);
            members.into_iter().find(|known| known.incarnation == Incarnation(incarnation))
        };
        world.run_until(PERIOD * 2, |world| known(world).is_some());
        // then
        let known = known(&world).expect("it was found just now");
        assert!(known.sources[&Source::Seed] < started, "incarnation {incarnation}: {known:?}");
        assert!((started..=world.now).contains(&known.since), "incarnation {incarnation}: {known:?}");
        world.kill(2);
        world.run(ms(20));
    }
}

// spec: NDL-2.3
#[test]
fn address_from_mdns_is_queried_at_once() {
    let mut world = World::new();
    world.start(1, &Spec { multicast: false, ..Spec::of(1) });
    world.start(2, &Spec { multicast: false, ..Spec::of(2) });
    world.input(1, Input::AddressNamed { source: Source::Mdns, address: udp(2) });
    world.run_until(ms(1), |world| world.has_member(1, 2) && world.has_member(2, 1));
    assert!(world.at(1).core.members(world.now)[0].sources.contains_key(&Source::Mdns));
}

#[test]
fn each_source_of_a_node_is_counted() {
    let mut world = World::new();
    world.start(1, &Spec { multicast: false, seeds: vec![udp(9)], ..Spec::of(1) });
    world.start(2, &Spec { multicast: false, ..Spec::of(2) });
    world.input(1, Input::AddressNamed { source: Source::Mdns, address: udp(2) });
    world.run(ms(10));
    let counts = world.at(1).core.source_counts();
    let of = |source| counts.get(&source).map(|counts| (counts.places, counts.members));
    // A node found by mDNS sends a query of its own.
    assert_eq!(Source::ALL.map(of), [(1, 0), (0, 0), (1, 1), (1, 1), (0, 0)].map(Some));
}

// spec: NDL-4.1
#[test]
fn node_is_lost_after_exactly_three_missed_answers() {
    // given
    let mut world = World::of_members(2);
    // when: it dies right after it answered
    world.run(PERIOD - ms(90));
    world.kill(2);
    let missed = |world: &World| world.at(1).core.members.get(&node(2)).map(|member| member.missed);
    for expected in 0..3 {
        assert_eq!(missed(&world), Some(expected));
        world.run_until(PERIOD * 2, |world| missed(world) != Some(expected));
    }
    // then
    assert_eq!(world.losses(1), [(2, LossReason::LinkDown)]);
    let [NodeEvent::NodeLost { silent_us, .. }] = world.at(1).events[..] else { panic!("one loss") };
    assert!((3 * 500_000..=4 * 500_000).contains(&silent_us), "{silent_us} us: within three to four periods");
}

// spec: NDL-4.6
#[test]
fn silent_node_gets_the_class_of_its_hosts_response() {
    for (responses, why) in [
        (&[Host::Accepts][..], LossReason::Hung),
        (&[Host::Refuses], LossReason::Crashed),
        (&[Host::IsSilent], LossReason::LinkDown),
        (&[], LossReason::LinkDown),
        (&[Host::Accepts, Host::IsSilent], LossReason::LinkDown),
    ] {
        // given: no host responds to an attempt
        let mut world = World::of_members(2);
        world.run(PERIOD * 3);
        assert_eq!(world.at(1).probes, []);
        // when
        world.kill(2);
        world.run_until(PERIOD * 3, |world| !world.at(1).probes.is_empty());
        assert!(world.has_member(1, 2), "it is tried while it is suspected");
        let (node, incarnation) = world.at(1).probes[0];
        for host in responses {
            let requested = world.now;
            world.input(1, Input::Probed { node, incarnation, host: *host, requested });
        }
        let requested = world.now;
        world.input(1, Input::Probed { node, incarnation: Incarnation(9), host: Host::Refuses, requested });
        let took = world.run_until(PERIOD * 4, |world| !world.has_member(1, 2));
        // then
        assert_eq!(world.losses(1), [(2, why)]);
        assert!(took <= PERIOD * 2, "{took:?} after the first missed answer");
    }
}

// spec: NDL-4.6
#[test]
fn host_response_to_an_earlier_silence_does_not_count() {
    let mut world = World::of_members(2);
    world.cut(2, 1);
    world.run_until(PERIOD * 3, |world| !world.at(1).probes.is_empty());
    let (node, incarnation) = world.at(1).probes[0];
    let requested = world.now;
    world.input(1, Input::Probed { node, incarnation, host: Host::Accepts, requested });
    world.mend();
    world.run(PERIOD * 2);
    let requested = world.now;
    world.input(1, Input::Probed { node, incarnation, host: Host::Accepts, requested });
    world.kill(2);
    world.run(PERIOD * 5);
    assert_eq!(world.losses(1), [(2, LossReason::LinkDown)]);
}

#[test]
fn two_missed_answers_are_forgiven_by_the_third() {
    let mut world = World::of_members(2);
    world.cut(2, 1);
    world.run_until(PERIOD * 4, |world| world.at(1).core.members[&node(2)].missed == 2);
    world.mend();
    world.run(PERIOD * 4);
    assert_eq!(world.losses(1), []);
    assert_eq!(world.at(1).core.members[&node(2)].missed, 0);
}

// spec: NDL-4.2
#[test]
fn starved_node_reports_no_loss() {
    for late_ms in [1, 250, 251, 400, 800, 1_600, 60_000] {
        // given: it is starved just before a cycle
        let mut world = World::of_members(3);
        let due = world.at(1).core.next_wake().unwrap();
        world.run(due.since(world.now) - ms(1));
        // when
        world.stall(1, ms(late_ms + 1));
        world.run(ms(late_ms) + PERIOD * 4);
        // then
        assert_eq!(world.losses(1), [], "after {late_ms} ms");
        let reported = world.at(1).others.clone();
        assert_eq!(
            reported,
            if late_ms > 250 { vec![Output::Stalled { late: ms(late_ms) }] } else { vec![] }
        );
        let OwnStalls { count, longest, last } = world.at(1).core.own_stalls();
        let counted = if late_ms > 250 { (1, ms(late_ms), true) } else { (0, ms(0), false) };
        assert_eq!((count, longest, last.is_some()), counted, "after {late_ms} ms");
    }
}

/// Found by the simulation.
#[test]
fn answer_in_our_own_socket_is_no_silence() {
    // given: two answers are lost
    let mut world = World::of_members(2);
    world.run(PERIOD - ms(200));
    world.cut(2, 1);
    world.run(PERIOD * 2);
    world.mend();
    // when: the third comes while the node gets no CPU time, and then its timer is handled before its socket
    world.run(ms(100));
    world.stall(1, PERIOD + ms(100));
    world.run(PERIOD * 2);
    // then
    assert_eq!(world.losses(1), []);
}

#[test]
fn restarted_shell_keeps_the_members_and_reports_no_loss() {
    // given: a shell that was down for three periods, with its datagrams lost
    let mut world = World::of_members(2);
    world.cut(2, 1);
    world.stall(1, PERIOD * 3);
    world.run(PERIOD * 3 - ms(1));
    world.mend();
    // when
    world.restart_shell(1);
    world.run(PERIOD * 8);
    // then
    assert_eq!(world.losses(1), []);
    assert!(world.has_member(1, 2));
}

#[test]
fn partitioned_nodes_find_each_other_again_without_sources() {
    // given: found through mDNS, which does not repeat itself
    let mut world = World::new();
    world.start(1, &Spec { multicast: false, ..Spec::of(1) });
    world.start(2, &Spec { multicast: false, ..Spec::of(2) });
    world.input(1, Input::AddressNamed { source: Source::Mdns, address: udp(2) });
    world.run(ms(1));
    world.cut(1, 2);
    world.cut(2, 1);
    world.run(PERIOD * 100);
    assert!(!world.has_member(1, 2) && !world.has_member(2, 1));
    // when
    world.mend();
    // then: within the longest interval, which is 16 periods
    world.run_until(PERIOD * 18, |world| world.has_member(1, 2) && world.has_member(2, 1));
    let found =
        NodeEvent::NodeFound { node: node(2), name: "node-2".to_owned(), incarnation: Incarnation(1) };
    assert_eq!(world.at(1).events.last(), Some(&found), "the same incarnation is found, not restarted");
}

// spec: NDL-3.2
#[test]
fn query_with_a_forged_source_makes_no_member() {
    let mut world = World::of_members(1);
    world.forge(udp(9), 1, &bytes(1, Body::Query(stranger(9))));
    world.run(PERIOD * 10);
    assert_eq!(world.at(1).facts, []);
    assert!(world.at(1).core.contacts.is_empty(), "no contact is asked forever");
}

// spec: NDL-3.1
#[test]
fn answer_counts_once_and_only_from_the_queried_address() {
    // given: the address of a stranger has been queried
    let mut world = World::of_members(1);
    world.forge(udp(9), 1, &bytes(1, Body::Query(stranger(9))));
    let question = world.at(1).core.contacts[&place(1, udp(9))].queries.newest().unwrap();
    let answer = |correlation| {
        let announcement = stranger(9);
        let answer =
            Answer { announcement, query_sent_ns: 0, query_received_ns: 0, progress: Default::default() };
        bytes(correlation, Body::Answer(answer))
    };
    // when: a guessed correlation, from another address
    world.forge(udp(9), 1, &answer(question.correlation ^ 1));
    world.forge(udp(8), 1, &answer(question.correlation));
    // then
    assert!(!world.has_member(1, 9));
    // when: the right one, twice
    world.forge(udp(9), 1, &answer(question.correlation));
    world.forge(udp(9), 1, &answer(question.correlation));
    // then
    assert!(world.has_member(1, 9));
    let refusals = world.at(1).core.refusals();
    assert_eq!(refusals.of("NDL answer without a question"), 3);
    assert_eq!(refusals.of("NDL answer with false times"), 1, "its times make no clock");
    assert!(!world.at(1).clocks.contains_key(&node(9)));
}

// spec: NDL-8
#[test]
fn late_subscriber_receives_all_members_then_changes() {
    let mut world = World::of_members(3);
    let before = world.at(1).events.len();
    let late = AppAddress::fixed(7).unwrap();
    world.with(udp(1), |core, now| core.handle(now, Input::AppChanged(AppFact::Ready { app: late })));
    let found: Vec<_> = world.at(1).events[before..].to_vec();
    assert!(
        matches!(&found[..], [NodeEvent::NodeFound { node: a, .. }, NodeEvent::NodeFound { node: b, .. }]
        if *a == node(2) && *b == node(3))
    );
}

// spec: NDL-1.2
#[test]
fn other_projects_are_invisible() {
    let mut world = World::new();
    world.start(1, &Spec::of(1));
    world.start(2, &Spec { project: "q", seeds: vec![udp(1)], ..Spec::of(2) });
    world.run(PERIOD * 3);
    assert!(!world.has_member(1, 2) && !world.has_member(2, 1));
    assert_eq!(world.at(1).core.refusals().total(), 0);
}

// spec: NDL-7.2
#[test]
fn flood_costs_bounded_datagrams_and_no_member() {
    // given
    let mut world = World::of_members(2);
    let query = bytes(1, Body::Query(stranger(9)));
    // when: for four periods, one address sends 50,000 queries a second, half of them with a member's address
    for tick in 0..2_000_u64 {
        for burst in 0..50 {
            let from = if burst % 2 == 0 { udp(9) } else { udp(2) };
            world.forge(from, 1, &query);
        }
        world.run(ms(1));
        assert!(world.has_member(1, 2), "after {tick} ms");
    }
    // then: answers to 50 and 500 a second, and one query per 10 ms at most
    assert_eq!(world.losses(1), []);
    assert!(world.at(1).datagrams_sent < 100 + 500 + 2 * (550 + 200) + 50, "{}", world.at(1).datagrams_sent);
}

// spec: NDL-7.1
#[test]
fn forged_addresses_keep_no_newcomer_out() {
    let mut world = World::new();
    world.start(1, &Spec::of(1));
    for host in 0..5_000_u32 {
        let from = SocketAddr::from((std::net::Ipv4Addr::from(0x0b00_0000 + host), 7));
        world.forge(from, 1, &bytes(1, Body::Query(stranger(9))));
        world.run(ms(1));
        assert!(world.at(1).core.contacts.len() <= 64);
    }
    world.start(2, &Spec::of(2));
    world.run_until(PERIOD * 2, |world| world.has_member(1, 2));
}

#[test]
fn members_are_bounded_by_the_configuration() {
    let mut world = World::new();
    world.start(1, &Spec { nodes_max: 3, ..Spec::of(1) });
    (2..10).for_each(|index| world.start(index, &Spec::of(index.into())));
    world.run(PERIOD * 3);
    assert_eq!(world.at(1).core.members.len(), 3);
    assert!(world.at(1).core.refusals().of("more nodes than `ndl.nodes_max`") > 0);
}

// spec: NDL-6
#[test]
fn clocks_are_known_within_half_a_round_trip() {
    let mut world = World::new();
    world.start(1, &Spec::of(1));
    world.start(2, &Spec { clock_ns: -987_654_321_000, ..Spec::of(2) });
    world.run(ms(10));
    let offset = world.at(1).clocks[&node(2)];
    assert_eq!(offset.theirs_minus_ours_ns, -987_654_321_000);
    assert!(offset.bound <= ms(1), "{offset:?}");
    assert_eq!(world.at(2).clocks[&node(1)].theirs_minus_ours_ns, 987_654_321_000);
    let view = &world.at(1).core.members(world.now)[0];
    assert_eq!(view.round_trip, Some(std::time::Duration::from_micros(200)));
}

#[test]
fn thirty_nodes_are_quiet_when_all_know_each_other() {
    let mut world = World::of_members(30);
    world.run(PERIOD * 4);
    for index in 1..=30 {
        assert_eq!(world.at(index).facts, []);
        // Each period: a query to and an answer for each of 29, and one to the group of 30.
        assert!(world.at(index).datagrams_sent <= 5 * (29 * 2 + 30), "{}", world.at(index).datagrams_sent);
    }
}

// spec: NDL-8
#[test]
fn full_subscriber_later_receives_the_final_state() {
    let mut world = World::of_members(3);
    world.process(1).is_busy = true;
    world.kill(2);
    world.kill(3);
    world.run(PERIOD * 5);
    world.start(3, &Spec { incarnation: 2, ..Spec::of(3) });
    world.run(PERIOD);
    assert_eq!(world.at(1).events, []);
    assert_eq!(world.losses(1).len(), 2, "layers were notified");
    // when
    world.application_has_room(1);
    // then
    let [NodeEvent::NodeLost { node: lost, .. }, NodeEvent::NodeRestarted { node: restarted, .. }] =
        &world.at(1).events[..]
    else {
        panic!("{:?}", world.at(1).events)
    };
    assert_eq!([*lost, *restarted], [node(2), node(3)]);
    world.run(PERIOD * 3);
    assert_eq!(world.at(1).events.len(), 2, "each once");
}
