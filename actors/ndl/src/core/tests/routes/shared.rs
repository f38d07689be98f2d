//! Addresses that several hosts have, like that of a container bridge: an address that leads to this host is not the
//! member's.

use super::*;

const BRIDGE: [u8; 4] = [172, 17, 0, 1];

/// Returns GNCL's address with this IP.
fn listener(ip: [u8; 4]) -> (u32, u16) {
    (u32::from_be_bytes(ip), 5_002)
}

/// A member with a GNCL that listens at these addresses.
fn listening_at(gncl: &[[u8; 4]]) -> Announcement {
    let (gncl_ip, gncl_port) = listener(gncl[0]);
    let gncl_further = gncl[1..].iter().copied().map(listener).collect();
    Announcement { gncl_ip, gncl_port, gncl_further, ..member() }
}

fn sockets(all: &[[u8; 4]]) -> Vec<SocketAddr> {
    all.iter().map(|ip| (*ip, 5_002).into()).collect()
}

/// The member, met on both routes, with the addresses that GNCL was notified of.
fn met(own: &[[u8; 4]], gncl: &[[u8; 4]]) -> (Bench, Vec<SocketAddr>) {
    let mut bench = Bench::new();
    bench.core.use_local_addresses(&sockets(own));
    bench.answer(path(0), listening_at(gncl));
    let [MembershipFact::NodeFound { gncl: reported, .. }] = &bench.facts[..] else {
        panic!("{:?}", bench.facts)
    };
    let reported = reported.clone();
    bench.answer(path(1), listening_at(gncl));
    (bench, reported)
}

// spec: NDL-3.6, NDL-4.6
#[test]
fn own_address_is_not_used_for_a_remote_member() {
    let (bench, reported) = met(&[BRIDGE], &[[10, 9, 0, 2], BRIDGE]);
    assert_eq!(reported, sockets(&[[10, 9, 0, 2]]));
    assert_eq!(bench.probed(), reported);
    assert_eq!(bench.core.members(bench.now)[0].gncl, reported);
    // One of its own paths, without a list of own addresses; and a loopback address in any case.
    let ours = [[10, 1, 0, 1], [127, 0, 0, 1]];
    let (bench, reported) = met(&[], &[ours[0], [10, 9, 0, 2], ours[1]]);
    assert_eq!(reported, sockets(&[[10, 9, 0, 2]]));
    assert_eq!(bench.probed(), reported);
}

// spec: NDL-3.6
#[test]
fn gncl_is_notified_of_own_address_changes() {
    let both = [[10, 0, 0, 2], BRIDGE];
    let (mut bench, reported) = met(&[], &both);
    assert_eq!(reported, sockets(&both));
    let live = |bench: &mut Bench| {
        for _ in 0..4 {
            bench.pass(PERIOD);
            bench.answer(path(0), listening_at(&both));
        }
    };
    bench.core.use_local_addresses(&sockets(&[BRIDGE]));
    live(&mut bench);
    assert_eq!(bench.moves, [sockets(&both[..1])]);
    bench.core.use_local_addresses(&[]);
    live(&mut bench);
    assert_eq!(bench.moves.last(), Some(&sockets(&both)));
}

// spec: NDL-3.6
#[test]
fn member_on_this_host_is_dialled_at_own_addresses() {
    let mut bench = Bench::new();
    let all = [[10, 9, 0, 1], BRIDGE];
    bench.core.use_local_addresses(&sockets(&all));
    let here = Place { there: ([10, 0, 0, 1], 7_401).into(), ..path(0) };
    let ndl = vec![(u32::from_be_bytes([10, 0, 0, 1]), 7_401)];
    bench.speak(here, Announcement { ndl, ..listening_at(&all) });
    assert_eq!(bench.core.members(bench.now)[0].gncl, sockets(&all));
    assert_eq!(bench.probed(), sockets(&all));
}

// spec: NDL-3.6, NDL-4.6
#[test]
fn only_address_is_dialled_even_if_own() {
    let (bench, reported) = met(&[BRIDGE], &[BRIDGE]);
    assert_eq!(reported, sockets(&[BRIDGE]));
    assert_eq!(bench.probed(), []);
}

// spec: NDL-4.6
#[test]
fn host_is_tried_where_its_node_answered_last() {
    let both = [[10, 0, 0, 2], [10, 1, 0, 2]];
    let (mut bench, _) = met(&[], &both);
    bench.pass(PERIOD);
    assert_eq!(bench.probed(), sockets(&both));
    for _ in 0..5 {
        bench.pass(PERIOD);
        bench.answer(path(1), listening_at(&both));
    }
    assert_eq!(bench.probed(), sockets(&both[1..]));
    // When: it answers nowhere
    bench.pass(PERIOD * 2);
    assert_eq!(bench.probed(), sockets(&both[1..]));
}

// spec: NDL-4.5
#[test]
fn silent_linked_member_stays_with_another_reachable_address() {
    for (further, is_there) in [(BRIDGE, false), ([10, 9, 0, 2], true)] {
        let mut bench = Bench::new();
        bench.core.use_local_addresses(&sockets(&[BRIDGE]));
        bench.answer(path(0), Announcement { ndl: vec![], ..listening_at(&[[10, 0, 0, 2], further]) });
        let incarnation = member().incarnation;
        bench.core.handle(bench.now, Input::Link(LinkFact::LinkUp { node: node(2), incarnation }));
        bench.pass(PERIOD * 5);
        assert_eq!(bench.incarnation().is_some(), is_there, "GNCL is at {further:?} besides");
    }
}
