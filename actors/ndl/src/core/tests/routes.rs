//! Several routes to one member: the believed ones, the used one, and the loss of all. One core, answered by hand.

use std::{net::SocketAddr, time::Duration};

use sinew_model::facts::{LinkFact, LossReason, MembershipFact};
use sinew_runtime::{tid::Incarnation, time::Time};

use super::{
    scenarios::stranger,
    world::{PERIOD, Spec, ms, node},
};
use crate::{
    core::{Cast, Core, Input, Output, Place, Query},
    datagram::{Announcement, Answer, Claim},
};

/// The networks that both nodes are in; a third one belongs to an attacker.
const NETWORKS: [u8; 2] = [0, 1];

/// Returns the path from this node's address to the member's, in one network.
fn path(network: u8) -> Place {
    Place { here: at(network, 1), there: at(network, 2) }
}

/// Returns the address of another host in the first network.
fn elsewhere() -> Place {
    Place { there: at(0, 66), ..path(0) }
}

fn at(network: u8, host: u8) -> SocketAddr {
    ([10, network, 0, host], 7_400).into()
}

/// A node with an address in each network, and its outputs.
struct Bench {
    core: Core,
    now: Time,
    facts: Vec<MembershipFact>,
    queried: Vec<Place>,
    collisions: usize,
    moves: Vec<Vec<SocketAddr>>,
}

impl Bench {
    fn new() -> Self {
        let core = Spec { multicast: false, seeds: vec![path(0).there], ..Spec::of(1) }.core(9);
        let now = Time::from_nanos(1_000_000_000);
        let mut bench =
            Self { core, now, facts: Vec::new(), queried: Vec::new(), collisions: 0, moves: Vec::new() };
        bench.core.start(now, &NETWORKS.map(|network| at(network, 1)));
        bench.drain();
        bench
    }

    /// Creates a bench that knows the member on both routes.
    fn of_two_paths() -> Self {
        let mut bench = Self::new();
        bench.answer(path(0), member());
        bench.answer(path(1), member());
        assert_eq!(bench.routes(), [path(0), path(1)]);
        bench.facts.clear();
        bench
    }

    fn drain(&mut self) {
        while let Some(output) = self.core.poll() {
            match output {
                Output::SendQuery { to, .. } => self.queried.push(to),
                Output::Fact(fact) => self.facts.push(fact),
                Output::Collision { .. } => self.collisions += 1,
                Output::Moved { gncl, .. } => self.moves.push(gncl),
                Output::SendMulticastQuery { .. }
                | Output::Forgotten { .. }
                | Output::SendAnswer { .. }
                | Output::SendLeave { .. }
                | Output::Probe { .. }
                | Output::RequestLiveness { .. }
                | Output::Event { .. }
                | Output::ClockMeasured { .. }
                | Output::AddressTaken { .. }
                | Output::Stalled { .. } => {}
            }
        }
    }

    /// Answers the last query that was sent there. Returns whether there was one.
    fn answer(&mut self, from: Place, announcement: Announcement) -> bool {
        let question = self.core.contacts.get(&from).and_then(|contact| contact.queries.newest());
        let Some(question) = question else { return false };
        let answer = Answer {
            announcement,
            query_sent_ns: question.sent.as_nanos(),
            query_received_ns: 0,
            progress: Default::default(),
        };
        let (correlation, sent) = (question.correlation, Time::ZERO);
        self.core.handle(self.now, Input::AnswerReceived { from, correlation, sent, answer });
        self.drain();
        true
    }

    /// Receives a query from `from`, so that it is queried, and answers.
    fn speak(&mut self, from: Place, announcement: Announcement) {
        let query = Query {
            from,
            cast: Cast::Unicast,
            correlation: 1,
            sent: Time::ZERO,
            announcement: announcement.clone(),
        };
        self.now = self.now + ms(11);
        self.core.handle(self.now, Input::QueryReceived(query));
        self.drain();
        assert!(self.answer(from, announcement), "a received address is queried");
    }

    fn pass(&mut self, time: Duration) {
        let end = self.now + time;
        while let Some(wake) = self.core.next_wake().filter(|wake| *wake <= end) {
            self.now = wake;
            self.core.handle(wake, Input::TimePassed);
            self.drain();
        }
        self.now = end;
    }

    /// Answers on these routes for this many periods.
    fn live(&mut self, periods: u32, paths: &[Place]) {
        for _ in 0..periods {
            self.pass(PERIOD);
            for path in paths {
                self.answer(*path, member());
            }
        }
    }

    fn routes(&self) -> Vec<Place> {
        self.core.members[&node(2)].routes.places().collect()
    }

    /// Returns the addresses at which its host would be tried.
    fn probed(&self) -> Vec<SocketAddr> {
        self.core.members[&node(2)].probed_addresses(&self.core.local_addresses)
    }

    fn incarnation(&self) -> Option<Incarnation> {
        self.core.members.get(&node(2)).map(|member| member.announcement.incarnation)
    }
}

/// Returns the announcement of the member.
fn member() -> Announcement {
    let ndl = NETWORKS.map(|network| ([10, network, 0, 2], 7_400));
    let ndl = ndl.map(|(ip, port)| (u32::from_be_bytes(ip), port)).to_vec();
    Announcement { ndl, incarnation: Incarnation(5), ..stranger(2) }
}

/// Returns the address of its GNCL in one network.
fn gncl(network: u8) -> SocketAddr {
    ([10, network, 0, 2], 5_002).into()
}

// spec: NDL-4.6
#[test]
fn silent_members_host_is_tried_at_few_addresses() {
    let mut bench = Bench::new();
    let gncl_further: Vec<_> = (11..17).map(|host| (u32::from_be_bytes([10, 9, 0, host]), 5_002)).collect();
    let ndl6 = (1..=4).map(|host| (0xfd00 << 48, host, 7_400)).collect();
    let paths = vec![(u32::from_be_bytes([10, 0, 0, 2]), 7_400)];
    let gncl_ip = u32::from_be_bytes([10, 9, 0, 10]);
    let announcement = Announcement {
        gncl_ip,
        gncl_port: 5_002,
        gncl_further: gncl_further.clone(),
        ndl: paths,
        ndl6,
        gncl_port6: 5_002,
        ..member()
    };
    bench.answer(path(0), announcement.clone());
    let probed = bench.probed();
    assert_eq!(probed.len(), 8, "{probed:?}");
    let of_ipv6 = probed.iter().filter(|at| at.is_ipv6()).count();
    assert!((3..=4).contains(&of_ipv6), "both families: {probed:?}");
    // It listens at the address of its last answer.
    let mut bench = Bench::new();
    let last = (u32::from_be_bytes([10, 0, 0, 2]), 5_002);
    let gncl_further = gncl_further.into_iter().chain([last]).collect();
    bench.answer(path(0), Announcement { gncl_further, ..announcement });
    assert_eq!(bench.probed(), [gncl(0)]);
}

fn later_incarnation() -> Announcement {
    Announcement { incarnation: Incarnation(6), boot_nonce: 0x600d, claim: Claim::Settling, ..member() }
}

// spec: NDL-3.3
#[test]
fn announced_addresses_are_queried_from_each_path_at_once() {
    let mut bench = Bench::new();
    bench.queried.clear();
    bench.answer(path(0), member());
    assert!(bench.queried.contains(&path(1)), "{:?}", bench.queried);
    assert_eq!(bench.routes(), [path(0)], "an announcement makes no route");
    bench.answer(path(1), member());
    assert_eq!(bench.routes(), [path(0), path(1)]);
    // Both are queried in each round.
    bench.queried.clear();
    bench.live(1, &[path(0), path(1)]);
    assert!([path(0), path(1)].iter().all(|path| bench.queried.contains(path)), "{:?}", bench.queried);
}

// spec: NDL-4.1
#[test]
fn member_stays_while_one_route_answers() {
    for dies in [0, 1] {
        let mut bench = Bench::of_two_paths();
        let answering = path(1 - dies);
        bench.live(20, &[answering]);
        assert_eq!(bench.facts, [], "path {dies} is cut");
        assert_eq!(bench.routes()[0], answering, "it is the one that is used");
        bench.pass(PERIOD * 4);
        let [MembershipFact::NodeLost { why: LossReason::LinkDown, .. }] = bench.facts[..] else {
            panic!("lost once: {:?}", bench.facts)
        };
    }
}

// spec: NDL-4.1
#[test]
fn alternately_answering_routes_keep_the_member() {
    let mut bench = Bench::of_two_paths();
    for round in 0..30 {
        bench.live(1, &[path(round % 2)]);
    }
    assert_eq!(bench.facts, []);
    bench.live(2, &[path(0), path(1)]);
    assert_eq!(bench.routes().len(), 2);
}

// spec: NDL-3.3
#[test]
fn answer_from_an_unannounced_address_makes_no_route() {
    let mut bench = Bench::of_two_paths();
    // An impostor repeats the member's announcement from its own address, and then with that address added.
    bench.speak(elsewhere(), member());
    let with_another = Announcement { ndl: vec![(0x0a00_0042, 7_400)], ..member() };
    bench.speak(elsewhere(), with_another.clone());
    bench.speak(elsewhere(), with_another);
    assert_eq!(bench.routes(), [path(0), path(1)]);
    // The same holds while only one of the routes answers.
    bench.live(2, &[path(0)]);
    bench.speak(elsewhere(), member());
    assert_eq!(bench.routes().len(), 2);
}

// spec: NDL-3.3
#[test]
fn moved_member_is_believed_when_no_other_route_answers() {
    let mut bench = Bench::of_two_paths();
    bench.pass(PERIOD * 2);
    bench.speak(elsewhere(), member());
    assert_eq!(bench.routes()[0], elsewhere());
    assert!(
        [path(0), path(1)].iter().all(|path| bench.routes().contains(path)),
        "it is queried there further"
    );
    bench.live(10, &[elsewhere()]);
    assert_eq!(bench.facts, []);
}

// spec: NDL-5.3
#[test]
fn later_incarnation_elsewhere_waits_for_all_routes() {
    let mut bench = Bench::of_two_paths();
    bench.speak(elsewhere(), later_incarnation());
    assert_eq!(bench.incarnation(), Some(Incarnation(5)), "it is contested");
    bench.now = bench.now + ms(11);
    assert!(bench.answer(path(1), member()), "each path is queried");
    bench.pass(ms(200));
    assert_eq!((bench.incarnation(), bench.collisions), (Some(Incarnation(5)), 1));
    assert_eq!(bench.facts, []);
    // It does replace the member at the former incarnation's own address, or when that one answers nowhere any more.
    for place in [path(1), elsewhere()] {
        let mut bench = Bench::of_two_paths();
        bench.speak(place, later_incarnation());
        bench.pass(ms(100));
        bench.answer(place, later_incarnation());
        // A liveness hint of the member may be in flight.
        bench.pass(ms(34));
        assert_eq!(bench.incarnation(), Some(Incarnation(6)), "{place:?}");
    }
}

// spec: NDL-5.3
#[test]
fn later_incarnation_is_contested_at_a_temporary_route_too() {
    let mut bench = Bench::of_two_paths();
    bench.pass(PERIOD * 2);
    bench.speak(elsewhere(), member());
    bench.speak(elsewhere(), later_incarnation());
    assert_eq!(bench.incarnation(), Some(Incarnation(5)));
    bench.answer(path(0), member());
    bench.pass(ms(200));
    assert_eq!(bench.incarnation(), Some(Incarnation(5)), "it answers at its announced address");
}

#[test]
fn removed_address_drops_its_queries_but_not_the_member() {
    let mut bench = Bench::of_two_paths();
    bench.pass(PERIOD);
    // when: one address is removed
    bench.core.use_paths(bench.now, &[path(1).here]);
    assert!(!bench.answer(path(0), member()), "no query is pending");
    assert_eq!(bench.routes(), [path(1)]);
    // when: the other one is removed too
    bench.core.use_paths(bench.now, &[]);
    assert_eq!(bench.routes(), []);
    assert_eq!(bench.core.members(bench.now)[0].udp, path(1).there, "where it was last");
    bench.pass(PERIOD);
    assert_eq!(bench.facts, []);
    // then: it is back in time, and is queried at once
    bench.queried.clear();
    bench.core.use_paths(bench.now, &NETWORKS.map(|network| at(network, 1)));
    bench.drain();
    assert!(NETWORKS.iter().all(|network| bench.queried.contains(&path(*network))), "{:?}", bench.queried);
    bench.answer(path(1), member());
    assert_eq!(bench.routes(), [path(1)]);
    // and: it is lost if not
    bench.core.use_paths(bench.now, &[]);
    bench.pass(PERIOD * 4);
    assert!(matches!(bench.facts[..], [MembershipFact::NodeLost { .. }]), "{:?}", bench.facts);
    // and: it is found when there is a path again
    bench.core.use_paths(bench.now, &[path(1).here]);
    bench.drain();
    assert!(bench.answer(path(1), member()), "a lost node is queried at once");
    assert!(bench.incarnation().is_some());
}

// spec: NDL-3.3
#[test]
fn listener_changes_are_reported_once_a_second() {
    let mut bench = Bench::of_two_paths();
    let listens_at = |port| Announcement { gncl_port: port, ..member() };
    bench.speak(elsewhere(), listens_at(66));
    for round in 0..20_u16 {
        bench.pass(PERIOD);
        assert!(bench.answer(path(1), listens_at(1_000 + round)));
    }
    let ports: Vec<_> = bench.moves.iter().map(|gncl| gncl[0].port()).collect();
    assert!((5..=10).contains(&ports.len()) && !ports.contains(&66), "in 10 s: {ports:?}");
    bench.live(4, &[path(0)]);
    assert_eq!(
        bench.moves.last().map(|gncl| gncl[0].port()),
        Some(member().gncl_port),
        "the last state is reported"
    );
}

#[test]
fn routes_of_a_member_are_bounded_by_the_paths() {
    let mut bench = Bench::new();
    let all = |host: u32| Announcement {
        ndl: (0..8).map(|n| (0x0a00_0100 + host + n, 7_400)).chain(member().ndl).take(8).collect(),
        ..member()
    };
    bench.answer(path(0), all(0));
    for round in 0..10_u32 {
        let places: Vec<_> = bench.core.contacts.keys().copied().collect();
        for place in places {
            bench.answer(place, all(round * 8));
        }
        bench.pass(PERIOD);
        assert!(bench.routes().len() <= 8, "{:?}", bench.routes());
        assert!(bench.core.contacts.len() <= 8 + 64 + 2, "{}", bench.core.contacts.len());
    }
}

mod departed;
mod ipv6;
mod redundancy;
mod shared;
