//! Nodes whose GNCL listens at several addresses. spec: NDL-4.5

use std::net::{Ipv4Addr, SocketAddrV4};

use sinew_runtime::tid::Incarnation;

use super::world::{PERIOD, Spec, World, ms, node, udp};
use crate::{
    gncl::LinkFact,
    ndl::{LossReason, MembershipFact},
};

const FURTHER: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::new(10, 1, 0, 1), 6_000);

/// Two nodes that know each other; the second has another address.
fn two() -> World {
    let mut world = World::new();
    world.start(1, &Spec::of(1));
    world.start(2, &Spec { further: vec![FURTHER], ..Spec::of(2) });
    world.run_until(ms(1), |world| world.knows(1, 2) && world.knows(2, 1));
    world
}

fn up() -> LinkFact {
    LinkFact::LinkUp { node: node(2), incarnation: Incarnation(1) }
}

fn broken() -> LinkFact {
    LinkFact::LinkBroken { node: node(2), incarnation: Incarnation(1) }
}

#[test]
fn all_addresses_of_a_node_are_told_with_the_preferred_one_first() {
    let world = two();
    let [MembershipFact::NodeFound { gncl, .. }] = &world.at(1).facts[..] else {
        panic!("one node is found: {:?}", world.at(1).facts)
    };
    assert_eq!(gncl[..], [([10, 0, 0, 1], 5_002).into(), FURTHER.into()]);
    assert_eq!(world.at(1).core.members(world.now)[0].gncl, *gncl);
}

#[test]
fn a_silent_node_with_another_address_is_there_as_long_as_its_link_stands_or_is_made_again() {
    let mut world = two();
    world.link(1, up());
    world.kill(2);
    world.run(PERIOD * 8);
    assert_eq!(world.losses(1), []);
    world.link(1, broken());
    world.run(ms(900));
    assert_eq!(world.losses(1), []);
    world.link(1, up());
    world.run(PERIOD * 8);
    assert_eq!(world.losses(1), [], "it is back over the other address");
    world.link(1, broken());
    world.run(ms(1_000) + PERIOD);
    assert_eq!(world.losses(1), [(2, LossReason::LinkDown)]);
}

#[test]
fn a_link_that_was_there_before_the_node_was_known_keeps_it_too_when_it_is_silent() {
    // given: GNCL accepts the node when all of NDL's datagrams are lost still
    let mut world = World::new();
    world.cut(1, 2);
    world.cut(2, 1);
    world.start(1, &Spec::of(1));
    world.start(2, &Spec { further: vec![FURTHER], ..Spec::of(2) });
    world.link(1, up());
    world.mend();
    world.run_until(PERIOD * 2, |world| world.knows(1, 2));
    // when
    world.kill(2);
    world.run(PERIOD * 8);
    // then
    assert_eq!(world.losses(1), []);
    world.link(1, broken());
    world.run(ms(1_000) + PERIOD);
    assert_eq!(world.losses(1), [(2, LossReason::LinkDown)]);
}

#[test]
fn a_silent_node_with_another_address_and_no_link_is_lost_like_any_other() {
    let mut world = two();
    world.kill(2);
    world.run(PERIOD * 4);
    assert_eq!(world.losses(1), [(2, LossReason::LinkDown)]);
}

#[test]
fn a_link_that_ended_with_a_restart_of_gncl_keeps_nobody_and_one_that_outlived_ndl_alone_does() {
    let mut world = two();
    world.link(1, up());
    world.kill(2);
    world.run(PERIOD * 8);
    // when: NDL alone is restarted
    world.with(udp(1), |core, now| core.look_at_links(now, |_, _| true));
    world.restart_shell(1);
    world.run(PERIOD * 8);
    assert_eq!(world.losses(1), []);
    // when: GNCL, too, which links nobody again
    world.with(udp(1), |core, now| core.look_at_links(now, |_, _| false));
    world.restart_shell(1);
    world.run(ms(900));
    assert_eq!(world.losses(1), []);
    world.run(ms(100) + PERIOD * 2);
    assert_eq!(world.losses(1), [(2, LossReason::LinkDown)]);
}

// spec: NDL-4.3
#[test]
fn a_link_that_ended_with_a_restart_of_gncl_and_is_refused_is_a_crash_but_not_one_that_never_was() {
    for was_linked in [true, false] {
        let mut world = two();
        if was_linked {
            world.link(1, up());
        }
        world.with(udp(1), |core, now| core.look_at_links(now, |_, _| false));
        world.restart_shell(1);
        world.kill(2);
        world.link(1, LinkFact::DialRefused { node: node(2), incarnation: Incarnation(1) });
        let expected = if was_linked { vec![(2, LossReason::Crashed)] } else { vec![] };
        assert_eq!(world.losses(1), expected);
    }
}
