//! Addresses that several hosts have, as that of a bridge for containers: what leads to this host is not the member.

use super::*;

const BRIDGE: [u8; 4] = [172, 17, 0, 1];

/// GNCL at this address.
fn listener(ip: [u8; 4]) -> (u32, u16) {
    (u32::from_be_bytes(ip), 5_002)
}

/// A member whose GNCL listens at these.
fn listening_at(gncl: &[[u8; 4]]) -> Announcement {
    let (gncl_ip, gncl_port) = listener(gncl[0]);
    let gncl_further = gncl[1..].iter().copied().map(listener).collect();
    Announcement { gncl_ip, gncl_port, gncl_further, ..member() }
}

fn sockets(all: &[[u8; 4]]) -> Vec<SocketAddr> {
    all.iter().map(|ip| (*ip, 5_002).into()).collect()
}

/// The member, met on both ways, of which GNCL was told so.
fn met(own: &[[u8; 4]], gncl: &[[u8; 4]]) -> (Bench, Vec<SocketAddr>) {
    let mut bench = Bench::new();
    bench.core.use_own(&sockets(own));
    bench.answer(way(0), listening_at(gncl));
    let [MembershipFact::NodeFound { gncl: told, .. }] = &bench.facts[..] else {
        panic!("{:?}", bench.facts)
    };
    let told = told.clone();
    bench.answer(way(1), listening_at(gncl));
    (bench, told)
}

// spec: NDL-3.6, NDL-4.6
#[test]
fn an_address_that_this_host_has_itself_is_neither_dialled_nor_tried_for_a_member_of_another_host() {
    let (bench, told) = met(&[BRIDGE], &[[10, 9, 0, 2], BRIDGE]);
    assert_eq!(told, sockets(&[[10, 9, 0, 2]]));
    assert_eq!(bench.probed(), told);
    assert_eq!(bench.core.members(bench.now)[0].gncl, told);
    // One of its own paths, where nobody looks which addresses there are; and one of loopback in any case.
    let ours = [[10, 1, 0, 1], [127, 0, 0, 1]];
    let (bench, told) = met(&[], &[ours[0], [10, 9, 0, 2], ours[1]]);
    assert_eq!(told, sockets(&[[10, 9, 0, 2]]));
    assert_eq!(bench.probed(), told);
}

// spec: NDL-3.6
#[test]
fn gncl_is_told_when_this_host_takes_an_address_of_a_member_and_when_it_gives_it_up() {
    let both = [[10, 0, 0, 2], BRIDGE];
    let (mut bench, told) = met(&[], &both);
    assert_eq!(told, sockets(&both));
    let live = |bench: &mut Bench| {
        for _ in 0..4 {
            bench.pass(PERIOD);
            bench.answer(way(0), listening_at(&both));
        }
    };
    bench.core.use_own(&sockets(&[BRIDGE]));
    live(&mut bench);
    assert_eq!(bench.moves, [sockets(&both[..1])]);
    bench.core.use_own(&[]);
    live(&mut bench);
    assert_eq!(bench.moves.last(), Some(&sockets(&both)));
}

// spec: NDL-3.6
#[test]
fn a_member_on_this_host_is_dialled_and_tried_at_the_addresses_of_this_host() {
    let mut bench = Bench::new();
    let all = [[10, 9, 0, 1], BRIDGE];
    bench.core.use_own(&sockets(&all));
    let here = Place { there: ([10, 0, 0, 1], 7_401).into(), ..way(0) };
    let ndl = vec![(u32::from_be_bytes([10, 0, 0, 1]), 7_401)];
    bench.speak(here, Announcement { ndl, ..listening_at(&all) });
    assert_eq!(bench.core.members(bench.now)[0].gncl, sockets(&all));
    assert_eq!(bench.probed(), sockets(&all));
}

// spec: NDL-3.6, NDL-4.6
#[test]
fn a_member_that_says_no_other_address_is_dialled_there_and_its_host_is_not_told_by_what_ours_says() {
    let (bench, told) = met(&[BRIDGE], &[BRIDGE]);
    assert_eq!(told, sockets(&[BRIDGE]));
    assert_eq!(bench.probed(), []);
}

// spec: NDL-4.6
#[test]
fn a_host_is_tried_where_its_node_answered_last_and_not_where_it_had_failed_before() {
    let both = [[10, 0, 0, 2], [10, 1, 0, 2]];
    let (mut bench, _) = met(&[], &both);
    bench.pass(PERIOD);
    assert_eq!(bench.probed(), sockets(&both));
    for _ in 0..5 {
        bench.pass(PERIOD);
        bench.answer(way(1), listening_at(&both));
    }
    assert_eq!(bench.probed(), sockets(&both[1..]));
    // When: it answers nowhere
    bench.pass(PERIOD * 2);
    assert_eq!(bench.probed(), sockets(&both[1..]));
}

// spec: NDL-4.5
#[test]
fn a_silent_member_whose_link_stands_is_lost_unless_it_can_be_reached_at_another_address() {
    for (further, is_there) in [(BRIDGE, false), ([10, 9, 0, 2], true)] {
        let mut bench = Bench::new();
        bench.core.use_own(&sockets(&[BRIDGE]));
        bench.answer(way(0), Announcement { ndl: vec![], ..listening_at(&[[10, 0, 0, 2], further]) });
        let incarnation = member().incarnation;
        bench.core.handle(bench.now, Input::Link(LinkFact::LinkUp { node: node(2), incarnation }));
        bench.pass(PERIOD * 5);
        assert_eq!(bench.life().is_some(), is_there, "GNCL is at {further:?} besides");
    }
}
