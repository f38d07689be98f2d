//! Routes over IPv6: a link-local address on two links, other kinds of addresses beside it, and the dialled addresses
//! of GNCL.

use super::*;
use crate::datagram::{Body, Datagram, encode};

fn socket(text: &str) -> SocketAddr {
    text.parse().expect("an address")
}

/// The path from our link-local address on one of two links to the member's there: it has the same one on both.
fn link(number: u32) -> Place {
    Place {
        here: socket(&format!("[fe80::1%{number}]:7400")),
        there: socket(&format!("[fe80::2%{number}]:7400")),
    }
}

/// The path between site addresses.
fn site() -> Place {
    Place { here: socket("[fd00::1]:7400"), there: socket("[fd00::2]:7400") }
}

/// The member at these addresses, without any of IPv4.
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
        Bench { core, now, facts: Vec::new(), queried: Vec::new(), collisions: 0, moves: Vec::new() };
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
fn link_local_address_is_dialled_only_where_it_answered() {
    let mut bench = bench(&[link(3).here, link(4).here], &["[fe80::2%3]:7400"]);
    assert_eq!(bench.queried, [link(3)], "the seed is on one link");
    assert!(bench.answer(link(3), at_ipv6(&["[fe80::2]:7400"])));
    assert_eq!(gncl_of(&bench.facts[0]), [socket("[fe80::2%3]:5000")]);
    assert_eq!(bench.queried[1..], [link(4)], "it may be on the other one, too");
    assert!(bench.answer(link(4), at_ipv6(&["[fe80::2]:7400"])));
    assert_eq!(bench.routes(), [link(3), link(4)]);
    for _ in 0..20 {
        bench.pass(PERIOD);
        for path in [link(3), link(4)] {
            bench.answer(path, at_ipv6(&["[fe80::2]:7400"]));
        }
    }
    assert_eq!(bench.moves, [[socket("[fe80::2%3]:5000"), socket("[fe80::2%4]:5000")]]);
    // The interface of the first link is removed.
    bench.core.use_paths(bench.now, &[link(4).here]);
    bench.drain();
    assert_eq!(bench.routes(), [link(4)]);
}

#[test]
fn link_and_site_addresses_are_never_paired() {
    let ours = [link(3).here, site().here];
    let mut bench = bench(&ours, &["[fe80::2]:7400"]);
    let both = || at_ipv6(&["[fe80::2]:7400", "[fd00::2]:7400"]);
    assert_eq!(bench.queried, [link(3)], "a seed without a link is queried on each");
    bench.answer(link(3), both());
    bench.answer(site(), both());
    bench.pass(3 * PERIOD);
    bench.queried.sort_unstable();
    bench.queried.dedup();
    let mut paths = [link(3), site()];
    paths.sort_unstable();
    assert_eq!(bench.queried, paths);
}

#[test]
fn configured_link_local_seed_is_queried_on_its_link() {
    let mut bench = bench(&[link(3).here], &[]);
    assert_eq!(bench.queried, []);
    bench.core.use_seeds(bench.now, vec![link(3).there]);
    bench.pass(PERIOD);
    assert_eq!(bench.queried, [link(3)]);
    bench.core.use_seeds(bench.now, Vec::new());
    bench.pass(10 * PERIOD);
    let queried = bench.queried.len();
    bench.pass(10 * PERIOD);
    assert_eq!(bench.queried.len(), queried, "it is forgotten like any address without an answer");
}

#[test]
fn unreachable_ipv6_seed_is_queried_from_a_matching_path() {
    let mut bench = bench(&[at(0, 1)], &["[fd00::2]:7400"]);
    assert_eq!(bench.queried, [Place { here: at(0, 1), ..site() }], "so that the system reports the error");
    bench.core.use_paths(bench.now, &[at(0, 1), site().here]);
    bench.drain();
    bench.queried.clear();
    bench.pass(2 * PERIOD);
    assert!(
        !bench.queried.is_empty() && bench.queried.iter().all(|queried| *queried == site()),
        "{:?}",
        bench.queried
    );
}

#[test]
fn link_local_group_query_concerns_its_link_only() {
    let mut bench = bench(&[link(3).here, site().here], &[]);
    let encoded = |announcement| {
        let datagram = Datagram { correlation: 1, sent: Time::ZERO, body: Body::Query(announcement) };
        encode(&datagram, sinew_runtime::tid::NodeAddress::ALL)
    };
    let bytes = encoded(at_ipv6(&["[fe80::2]:7400", "[fd00::2]:7400"]));
    for here in [site().here, link(3).here] {
        bench.core.receive(bench.now, Place { here, ..link(3) }, Cast::Multicast, &bytes);
    }
    bench.drain();
    assert_eq!(bench.queried, [link(3)]);
    assert_eq!(bench.core.refusals().total(), 0);
}

#[test]
fn excess_routes_between_networks_are_dropped_in_any_family() {
    let closeness = |here: &str, there: &str| Place { here: socket(here), there: socket(there) }.closeness();
    let near = [
        closeness("10.77.0.1:1", "10.77.0.2:1"),
        closeness("[fe80::1%3]:1", "[fe80::2%3]:1"),
        closeness("[fd00:77::1]:1", "[fd00:77::2]:1"),
    ];
    let far = [closeness("10.77.0.1:1", "10.78.0.2:1"), closeness("[fd00:0:0:2::1]:1", "[fd00:0:0:3::2]:1")];
    assert!(near.iter().min() > far.iter().max(), "{near:?} {far:?}");
}
