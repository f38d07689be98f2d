//! Ways of IPv6: a link-local address on two links, addresses of other kinds beside it, and where GNCL is dialled.

use super::*;
use crate::ndl::datagram::{Body, Datagram, encode};

fn socket(text: &str) -> SocketAddr {
    text.parse().expect("an address")
}

/// From our link-local address on one of two links to the member's there: it has the same one on both.
fn link(number: u32) -> Place {
    Place {
        here: socket(&format!("[fe80::1%{number}]:7400")),
        there: socket(&format!("[fe80::2%{number}]:7400")),
    }
}

/// The one between addresses of a site.
fn site() -> Place {
    Place { here: socket("[fd00::1]:7400"), there: socket("[fd00::2]:7400") }
}

/// The member at these addresses of its, without any of IPv4.
fn at_ipv6(addresses: &[&str]) -> Announcement {
    let mut announcement =
        Announcement { gncl_ip: 0, gncl_port: 0, gncl_port6: 5_000, gncl_further: Vec::new(), ..member() };
    announcement.announce_ndl(&addresses.iter().map(|address| socket(address)).collect::<Vec<_>>());
    announcement
}

fn bench(ours: &[SocketAddr], seeds: &[&str]) -> Bench {
    let core = Spec { multicast: false, ..Spec::of(1) }.core(9);
    let now = Time::from_nanos(1_000_000_000);
    let mut bench =
        Bench { core, now, facts: Vec::new(), asked: Vec::new(), collisions: 0, moves: Vec::new() };
    bench.core.use_seeds(now, seeds.iter().map(|seed| socket(seed)).collect());
    bench.core.start(now, ours);
    bench.drain();
    bench
}

fn gncl_of(fact: &MembershipFact) -> &[SocketAddr] {
    match fact {
        MembershipFact::NodeFound { gncl, .. } => gncl,
        MembershipFact::NodeLost { .. } => panic!("{fact:?}"),
    }
}

// spec: NDL-3.5
#[test]
fn a_link_local_address_is_asked_on_each_link_and_dialled_only_where_it_has_answered() {
    let mut bench = bench(&[link(3).here, link(4).here], &["[fe80::2%3]:7400"]);
    assert_eq!(bench.asked, [link(3)], "the seed is on one link");
    assert!(bench.answer(link(3), at_ipv6(&["[fe80::2]:7400"])));
    assert_eq!(gncl_of(&bench.facts[0]), [socket("[fe80::2%3]:5000")]);
    assert_eq!(bench.asked[1..], [link(4)], "it may be on the other one, too");
    assert!(bench.answer(link(4), at_ipv6(&["[fe80::2]:7400"])));
    assert_eq!(bench.routes(), [link(3), link(4)]);
    for _ in 0..20 {
        bench.pass(PERIOD);
        for way in [link(3), link(4)] {
            bench.answer(way, at_ipv6(&["[fe80::2]:7400"]));
        }
    }
    assert_eq!(bench.moves, [[socket("[fe80::2%3]:5000"), socket("[fe80::2%4]:5000")]]);
    // The interface of the first link is gone.
    bench.core.use_paths(bench.now, &[link(4).here]);
    bench.drain();
    assert_eq!(bench.routes(), [link(4)]);
}

#[test]
fn between_an_address_of_a_link_and_one_of_a_site_nothing_is_asked() {
    let ours = [link(3).here, site().here];
    let mut bench = bench(&ours, &["[fe80::2]:7400"]);
    let both = || at_ipv6(&["[fe80::2]:7400", "[fd00::2]:7400"]);
    assert_eq!(bench.asked, [link(3)], "a seed without a link is asked on each");
    bench.answer(link(3), both());
    bench.answer(site(), both());
    bench.pass(3 * PERIOD);
    bench.asked.sort_unstable();
    bench.asked.dedup();
    let mut ways = [link(3), site()];
    ways.sort_unstable();
    assert_eq!(bench.asked, ways);
}

#[test]
fn a_seed_is_asked_when_its_link_is_there_and_not_any_more_when_it_is_none() {
    let mut bench = bench(&[link(3).here], &[]);
    assert_eq!(bench.asked, []);
    bench.core.use_seeds(bench.now, vec![link(3).there]);
    bench.pass(PERIOD);
    assert_eq!(bench.asked, [link(3)]);
    bench.core.use_seeds(bench.now, Vec::new());
    bench.pass(10 * PERIOD);
    let asked = bench.asked.len();
    bench.pass(10 * PERIOD);
    assert_eq!(bench.asked.len(), asked, "it is forgotten like anybody who does not answer");
}

#[test]
fn a_seed_of_ipv6_that_nothing_led_to_is_asked_from_where_something_does() {
    let mut bench = bench(&[at(0, 1)], &["[fd00::2]:7400"]);
    assert_eq!(bench.asked, [Place { here: at(0, 1), ..site() }], "so that the system says that it cannot");
    bench.core.use_paths(bench.now, &[at(0, 1), site().here]);
    bench.drain();
    bench.asked.clear();
    bench.pass(2 * PERIOD);
    assert!(!bench.asked.is_empty() && bench.asked.iter().all(|asked| *asked == site()), "{:?}", bench.asked);
}

#[test]
fn what_a_link_local_address_says_to_a_group_concerns_the_link_local_one_of_ours_alone() {
    let mut bench = bench(&[link(3).here, site().here], &[]);
    let said = |announcement| {
        let datagram = Datagram { correlation: 1, sent: Time::ZERO, body: Body::Query(announcement) };
        encode(&datagram, sinew_runtime::tid::NodeAddress::ALL)
    };
    let bytes = said(at_ipv6(&["[fe80::2]:7400", "[fd00::2]:7400"]));
    for here in [site().here, link(3).here] {
        bench.core.receive(bench.now, Place { here, ..link(3) }, Way::Multicast, &bytes);
    }
    bench.drain();
    assert_eq!(bench.asked, [link(3)]);
    assert_eq!(bench.core.refusals().total(), 0);
}

#[test]
fn of_too_many_ways_those_between_networks_go_whatever_their_family_is() {
    let kinship = |here: &str, there: &str| Place { here: socket(here), there: socket(there) }.kinship();
    let near = [
        kinship("10.77.0.1:1", "10.77.0.2:1"),
        kinship("[fe80::1%3]:1", "[fe80::2%3]:1"),
        kinship("[fd00:77::1]:1", "[fd00:77::2]:1"),
    ];
    let far = [kinship("10.77.0.1:1", "10.78.0.2:1"), kinship("[fd00:0:0:2::1]:1", "[fd00:0:0:3::2]:1")];
    assert!(near.iter().min() > far.iter().max(), "{near:?} {far:?}");
}
