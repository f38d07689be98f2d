//! Several ways to one member: which of them are believed, which is used, and when none is left. One core, answered by hand.

use std::{net::SocketAddr, time::Duration};

use sinew_runtime::{tid::Incarnation, time::Time};

use super::{
    scenarios::stranger,
    world::{PERIOD, Spec, ms, node},
};
use crate::{
    gncl::LinkFact,
    ndl::{
        LossReason, MembershipFact,
        core::{Core, Input, Output, Place, Query, Way},
        datagram::{Announcement, Answer, Claim},
    },
};

/// The networks that both nodes are in; a third one is of whoever means no good.
const NETWORKS: [u8; 2] = [0, 1];

/// An address of this node, and one of the member, in one network.
fn way(network: u8) -> Place {
    Place { here: at(network, 1), there: at(network, 2) }
}

/// Somebody else in the first network.
fn elsewhere() -> Place {
    Place { there: at(0, 66), ..way(0) }
}

fn at(network: u8, host: u8) -> SocketAddr {
    ([10, network, 0, host], 7_400).into()
}

/// A node with an address in each network, and what it has said.
struct Bench {
    core: Core,
    now: Time,
    facts: Vec<MembershipFact>,
    asked: Vec<Place>,
    collisions: usize,
    moves: Vec<Vec<SocketAddr>>,
}

impl Bench {
    fn new() -> Self {
        let core = Spec { multicast: false, seeds: vec![way(0).there], ..Spec::of(1) }.core(9);
        let now = Time::from_nanos(1_000_000_000);
        let mut bench =
            Self { core, now, facts: Vec::new(), asked: Vec::new(), collisions: 0, moves: Vec::new() };
        bench.core.start(now, &NETWORKS.map(|network| at(network, 1)));
        bench.drain();
        bench
    }

    /// One that knows the member on both ways.
    fn of_two_ways() -> Self {
        let mut bench = Self::new();
        bench.answer(way(0), member());
        bench.answer(way(1), member());
        assert_eq!(bench.routes(), [way(0), way(1)]);
        bench.facts.clear();
        bench
    }

    fn drain(&mut self) {
        while let Some(output) = self.core.poll() {
            match output {
                Output::SendQuery { to, .. } => self.asked.push(to),
                Output::Fact(fact) => self.facts.push(fact),
                Output::Collision { .. } => self.collisions += 1,
                Output::Moved { gncl, .. } => self.moves.push(gncl),
                Output::SendMulticastQuery { .. }
                | Output::Forgotten { .. }
                | Output::SendAnswer { .. }
                | Output::SendLeave { .. }
                | Output::Probe { .. }
                | Output::AskForSign { .. }
                | Output::Event { .. }
                | Output::ClockMeasured { .. }
                | Output::AddressTaken { .. }
                | Output::Stalled { .. } => {}
            }
        }
    }

    /// The last question that was asked there is answered so; whether there was one.
    fn answer(&mut self, from: Place, announcement: Announcement) -> bool {
        let question = self.core.contacts.get(&from).and_then(|contact| contact.questions.newest());
        let Some(question) = question else { return false };
        let answer = Answer {
            announcement,
            query_sent_ns: question.asked.as_nanos(),
            query_received_ns: 0,
            progress: Default::default(),
        };
        let (correlation, sent) = (question.correlation, Time::ZERO);
        self.core.handle(self.now, Input::AnswerReceived { from, correlation, sent, answer });
        self.drain();
        true
    }

    /// Has `from` asked, as if somebody had spoken there, and answered so.
    fn speak(&mut self, from: Place, announcement: Announcement) {
        let query = Query {
            from,
            way: Way::Unicast,
            correlation: 1,
            sent: Time::ZERO,
            announcement: announcement.clone(),
        };
        self.now = self.now + ms(11);
        self.core.handle(self.now, Input::QueryReceived(query));
        self.drain();
        assert!(self.answer(from, announcement), "who is heard is asked");
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

    /// The member answers on these ways for so many periods.
    fn live(&mut self, periods: u32, ways: &[Place]) {
        for _ in 0..periods {
            self.pass(PERIOD);
            for way in ways {
                self.answer(*way, member());
            }
        }
    }

    fn routes(&self) -> Vec<Place> {
        self.core.members[&node(2)].routes.places().collect()
    }

    /// Where its host would be tried.
    fn probed(&self) -> Vec<SocketAddr> {
        self.core.members[&node(2)].probed_addresses(&self.core.own)
    }

    fn life(&self) -> Option<Incarnation> {
        self.core.members.get(&node(2)).map(|member| member.announcement.incarnation)
    }
}

/// What the member says of itself.
fn member() -> Announcement {
    let ndl = NETWORKS.map(|network| ([10, network, 0, 2], 7_400));
    let ndl = ndl.map(|(ip, port)| (u32::from_be_bytes(ip), port)).to_vec();
    Announcement { ndl, incarnation: Incarnation(5), ..stranger(2) }
}

/// Where its GNCL listens in one network.
fn gncl(network: u8) -> SocketAddr {
    ([10, network, 0, 2], 5_002).into()
}

// spec: NDL-4.6
#[test]
fn the_host_of_a_silent_member_is_tried_where_it_was_heard_last_or_at_a_few_of_its_addresses() {
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
    bench.answer(way(0), announcement.clone());
    let probed = bench.probed();
    assert_eq!(probed.len(), 8, "{probed:?}");
    let of_ipv6 = probed.iter().filter(|at| at.is_ipv6()).count();
    assert!((3..=4).contains(&of_ipv6), "both families: {probed:?}");
    // It listens where it was heard.
    let mut bench = Bench::new();
    let last = (u32::from_be_bytes([10, 0, 0, 2]), 5_002);
    let gncl_further = gncl_further.into_iter().chain([last]).collect();
    bench.answer(way(0), Announcement { gncl_further, ..announcement });
    assert_eq!(bench.probed(), [gncl(0)]);
}

fn later_life() -> Announcement {
    Announcement { incarnation: Incarnation(6), boot_nonce: 0x600d, claim: Claim::Settling, ..member() }
}

// spec: NDL-3.3
#[test]
fn who_says_where_it_is_is_asked_there_from_each_address_at_once() {
    let mut bench = Bench::new();
    bench.asked.clear();
    bench.answer(way(0), member());
    assert!(bench.asked.contains(&way(1)), "{:?}", bench.asked);
    assert_eq!(bench.routes(), [way(0)], "what it says makes no route");
    bench.answer(way(1), member());
    assert_eq!(bench.routes(), [way(0), way(1)]);
    // In each round both are asked.
    bench.asked.clear();
    bench.live(1, &[way(0), way(1)]);
    assert!([way(0), way(1)].iter().all(|way| bench.asked.contains(way)), "{:?}", bench.asked);
}

// spec: NDL-4.1
#[test]
fn a_member_is_there_while_one_way_answers_and_lost_in_time_when_none_does() {
    for dies in [0, 1] {
        let mut bench = Bench::of_two_ways();
        let lives = way(1 - dies);
        bench.live(20, &[lives]);
        assert_eq!(bench.facts, [], "way {dies} is cut");
        assert_eq!(bench.routes()[0], lives, "it is the one that is used");
        bench.pass(PERIOD * 4);
        let [MembershipFact::NodeLost { why: LossReason::LinkDown, .. }] = bench.facts[..] else {
            panic!("lost once: {:?}", bench.facts)
        };
    }
}

// spec: NDL-4.1
#[test]
fn ways_that_answer_by_turns_keep_the_member() {
    let mut bench = Bench::of_two_ways();
    for round in 0..30 {
        bench.live(1, &[way(round % 2)]);
    }
    assert_eq!(bench.facts, []);
    bench.live(2, &[way(0), way(1)]);
    assert_eq!(bench.routes().len(), 2);
}

// spec: NDL-3.3
#[test]
fn a_life_that_answers_where_the_member_does_not_say_that_it_is_has_no_route_there() {
    let mut bench = Bench::of_two_ways();
    // Who repeats what the member says, from an address of his own, also with that address in it.
    bench.speak(elsewhere(), member());
    let with_his = Announcement { ndl: vec![(0x0a00_0042, 7_400)], ..member() };
    bench.speak(elsewhere(), with_his.clone());
    bench.speak(elsewhere(), with_his);
    assert_eq!(bench.routes(), [way(0), way(1)]);
    // Nor while one of the ways alone answers.
    bench.live(2, &[way(0)]);
    bench.speak(elsewhere(), member());
    assert_eq!(bench.routes().len(), 2);
}

// spec: NDL-3.3
#[test]
fn a_member_that_has_moved_is_believed_when_it_answers_nowhere_else() {
    let mut bench = Bench::of_two_ways();
    bench.pass(PERIOD * 2);
    bench.speak(elsewhere(), member());
    assert_eq!(bench.routes()[0], elsewhere());
    assert!([way(0), way(1)].iter().all(|way| bench.routes().contains(way)), "it is asked there further");
    bench.live(10, &[elsewhere()]);
    assert_eq!(bench.facts, []);
}

// spec: NDL-5.3
#[test]
fn a_later_life_elsewhere_is_no_successor_while_the_member_answers_anywhere() {
    let mut bench = Bench::of_two_ways();
    bench.speak(elsewhere(), later_life());
    assert_eq!(bench.life(), Some(Incarnation(5)), "it is contested");
    bench.now = bench.now + ms(11);
    assert!(bench.answer(way(1), member()), "each way is asked");
    bench.pass(ms(200));
    assert_eq!((bench.life(), bench.collisions), (Some(Incarnation(5)), 1));
    assert_eq!(bench.facts, []);
    // It does follow where the former life itself was, or when that answers nowhere any more.
    for place in [way(1), elsewhere()] {
        let mut bench = Bench::of_two_ways();
        bench.speak(place, later_life());
        bench.pass(ms(100));
        bench.answer(place, later_life());
        // A sign of the member may be under way.
        bench.pass(ms(34));
        assert_eq!(bench.life(), Some(Incarnation(6)), "{place:?}");
    }
}

// spec: NDL-5.3
#[test]
fn a_later_life_is_contested_also_at_a_place_that_was_taken_for_the_members_while_it_was_silent() {
    let mut bench = Bench::of_two_ways();
    bench.pass(PERIOD * 2);
    bench.speak(elsewhere(), member());
    bench.speak(elsewhere(), later_life());
    assert_eq!(bench.life(), Some(Incarnation(5)));
    bench.answer(way(0), member());
    bench.pass(ms(200));
    assert_eq!(bench.life(), Some(Incarnation(5)), "it answers where it says that it is");
}

#[test]
fn what_was_asked_from_an_address_that_is_gone_is_forgotten_and_the_member_is_not() {
    let mut bench = Bench::of_two_ways();
    bench.pass(PERIOD);
    // when: one address goes
    bench.core.use_paths(bench.now, &[way(1).here]);
    assert!(!bench.answer(way(0), member()), "no question is left");
    assert_eq!(bench.routes(), [way(1)]);
    // when: the other one goes too
    bench.core.use_paths(bench.now, &[]);
    assert_eq!(bench.routes(), []);
    assert_eq!(bench.core.members(bench.now)[0].udp, way(1).there, "where it was last");
    bench.pass(PERIOD);
    assert_eq!(bench.facts, []);
    // then: it is back in time, and is asked at once
    bench.asked.clear();
    bench.core.use_paths(bench.now, &NETWORKS.map(|network| at(network, 1)));
    bench.drain();
    assert!(NETWORKS.iter().all(|network| bench.asked.contains(&way(*network))), "{:?}", bench.asked);
    bench.answer(way(1), member());
    assert_eq!(bench.routes(), [way(1)]);
    // and lost if not
    bench.core.use_paths(bench.now, &[]);
    bench.pass(PERIOD * 4);
    assert!(matches!(bench.facts[..], [MembershipFact::NodeLost { .. }]), "{:?}", bench.facts);
    // and found when there is a way again
    bench.core.use_paths(bench.now, &[way(1).here]);
    bench.drain();
    assert!(bench.answer(way(1), member()), "who was lost is asked at once");
    assert!(bench.life().is_some());
}

// spec: NDL-3.3
#[test]
fn where_a_member_listens_now_is_told_once_a_second_at_most_and_only_what_it_says_on_a_route() {
    let mut bench = Bench::of_two_ways();
    let listens_at = |port| Announcement { gncl_port: port, ..member() };
    bench.speak(elsewhere(), listens_at(66));
    for round in 0..20_u16 {
        bench.pass(PERIOD);
        assert!(bench.answer(way(1), listens_at(1_000 + round)));
    }
    let ports: Vec<_> = bench.moves.iter().map(|gncl| gncl[0].port()).collect();
    assert!((5..=10).contains(&ports.len()) && !ports.contains(&66), "in 10 s: {ports:?}");
    bench.live(4, &[way(0)]);
    assert_eq!(
        bench.moves.last().map(|gncl| gncl[0].port()),
        Some(member().gncl_port),
        "the last word is told"
    );
}

#[test]
fn a_member_has_no_more_routes_than_there_are_paths_however_much_it_says() {
    let mut bench = Bench::new();
    let all = |host: u32| Announcement {
        ndl: (0..8).map(|n| (0x0a00_0100 + host + n, 7_400)).chain(member().ndl).take(8).collect(),
        ..member()
    };
    bench.answer(way(0), all(0));
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

mod gone;
mod ipv6;
mod redundancy;
mod shared;
