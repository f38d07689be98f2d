//! Nodes with a GNCL that listens at several addresses. spec: NDL-4.5

use std::net::{Ipv4Addr, SocketAddrV4};

use sinew_model::facts::{LinkFact, LossReason, MembershipFact};
use sinew_runtime::tid::Incarnation;

use super::world::{PERIOD, Spec, World, ms, node, udp};

const FURTHER: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::new(10, 1, 0, 1), 6_000);

/// Two nodes that know each other; the second has another address.
fn two() -> World {
    let mut world = World::new();
    world.start(1, &Spec::of(1));
    world.start(2, &Spec { further: vec![FURTHER], ..Spec::of(2) });
    world.run_until(ms(1), |world| world.has_member(1, 2) && world.has_member(2, 1));
    world
}

fn up() -> LinkFact {
    LinkFact::LinkUp { node: node(2), incarnation: Incarnation(1) }
}

fn broken() -> LinkFact {
    LinkFact::LinkBroken { node: node(2), incarnation: Incarnation(1) }
}

#[test]
fn all_addresses_are_reported_with_the_preferred_one_first() {
    let world = two();
    let [MembershipFact::NodeFound { gncl, .. }] = &world.at(1).facts[..] else {
        panic!("one node is found: {:?}", world.at(1).facts)
    };
    assert_eq!(gncl[..], [([10, 0, 0, 1], 5_002).into(), FURTHER.into()]);
    assert_eq!(world.at(1).core.members(world.now)[0].gncl, *gncl);
}

#[test]
fn silent_node_with_another_address_stays_while_linked() {
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
fn link_from_before_discovery_keeps_a_silent_node_too() {
    // given: GNCL accepts the node while all of NDL's datagrams are lost
    let mut world = World::new();
    world.cut(1, 2);
    world.cut(2, 1);
    world.start(1, &Spec::of(1));
    world.start(2, &Spec { further: vec![FURTHER], ..Spec::of(2) });
    world.link(1, up());
    world.mend();
    world.run_until(PERIOD * 2, |world| world.has_member(1, 2));
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
fn silent_unlinked_node_with_another_address_is_lost() {
    let mut world = two();
    world.kill(2);
    world.run(PERIOD * 4);
    assert_eq!(world.losses(1), [(2, LossReason::LinkDown)]);
}

#[test]
fn link_survives_a_restart_of_ndl_only() {
    let mut world = two();
    world.link(1, up());
    world.kill(2);
    world.run(PERIOD * 8);
    // when: NDL alone is restarted
    world.with(udp(1), |core, now| core.check_links(now, |_, _| true));
    world.restart_shell(1);
    world.run(PERIOD * 8);
    assert_eq!(world.losses(1), []);
    // when: GNCL is restarted too, and links no node again
    world.with(udp(1), |core, now| core.check_links(now, |_, _| false));
    world.restart_shell(1);
    world.run(ms(900));
    assert_eq!(world.losses(1), []);
    world.run(ms(100) + PERIOD * 2);
    assert_eq!(world.losses(1), [(2, LossReason::LinkDown)]);
}

// spec: NDL-4.3
#[test]
fn refusal_is_a_crash_only_after_a_former_link() {
    for was_linked in [true, false] {
        let mut world = two();
        if was_linked {
            world.link(1, up());
        }
        world.with(udp(1), |core, now| core.check_links(now, |_, _| false));
        world.restart_shell(1);
        world.kill(2);
        world.link(1, LinkFact::DialRefused { node: node(2), incarnation: Incarnation(1) });
        let expected = if was_linked { vec![(2, LossReason::Crashed)] } else { vec![] };
        assert_eq!(world.losses(1), expected);
    }
}
