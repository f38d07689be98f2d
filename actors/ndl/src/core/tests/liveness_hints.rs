//! Members that do not answer, with liveness hints of GNCL. spec: NDL-4.7

use std::time::Duration;

use sinew_model::facts::{LinkFact, LossReason, NodeEvent, Trouble};
use sinew_runtime::tid::{AppAddress, Incarnation, Tid};

use super::world::{PERIOD, World, ms, node};
use crate::core::{Host, Input};

/// Two nodes, with no datagram between them any more.
fn two_that_are_cut() -> World {
    let mut world = World::of_members(2);
    world.cut(1, 2);
    world.cut(2, 1);
    world
}

/// Lets GNCL of the first read data of the second in this incarnation, every tenth of a period.
fn reads(world: &mut World, incarnation: u64, duration: Duration) {
    let end = world.now + duration;
    while world.now < end {
        let (node, incarnation, at) = (node(2), Incarnation(incarnation), world.now);
        world.input(1, Input::HintReceived { node, incarnation, at });
        world.run(PERIOD / 10);
    }
}

#[test]
fn node_read_by_gncl_survives_missed_answers() {
    let mut world = two_that_are_cut();
    reads(&mut world, 1, PERIOD * 50);
    assert_eq!(world.losses(1), []);
    assert_eq!(
        world.at(1).core.members(world.now)[0].missed,
        49,
        "the first query was sent when the path was cut"
    );
}

#[test]
fn node_no_longer_read_is_lost_within_the_bound() {
    for part in 0..10 {
        let mut world = two_that_are_cut();
        reads(&mut world, 1, PERIOD * 20 + PERIOD / 10 * part);
        let last = world.now;
        world.run_until(PERIOD * 5, |world| !world.losses(1).is_empty());
        let Some(NodeEvent::NodeLost { silent_us, bound_us, .. }) = world.at(1).events.last() else {
            panic!("a loss: {:?}", world.at(1).events)
        };
        assert!(world.now.since(last) >= PERIOD * 3 - PERIOD / 10 && silent_us <= bound_us, "{silent_us}");
        assert_eq!(*bound_us, 2_000_000);
    }
}

#[test]
fn data_of_another_incarnation_is_no_hint() {
    let mut world = two_that_are_cut();
    reads(&mut world, 2, PERIOD * 4);
    assert_eq!(world.losses(1), [(2, LossReason::LinkDown)]);
}

#[test]
fn data_of_an_ended_process_keeps_no_member() {
    let mut world = two_that_are_cut();
    world.run_until(PERIOD * 2, |world| !world.at(1).probes.is_empty());
    let (node, incarnation) = world.at(1).probes[0];
    let requested = world.now;
    world.input(1, Input::Probed { node, incarnation, host: Host::Refuses, requested });
    reads(&mut world, 1, PERIOD * 3);
    assert_eq!(world.losses(1), [(2, LossReason::Crashed)]);
}

#[test]
fn new_connection_is_a_hint_despite_an_earlier_refusal() {
    // Given: a member with a host that has refused connections, as during a restart of GNCL there
    let mut world = two_that_are_cut();
    world.run_until(PERIOD * 2, |world| !world.at(1).probes.is_empty());
    let ((of, incarnation), requested) = (world.at(1).probes[0], world.now);
    let refused = || Input::Probed { node: of, incarnation, host: Host::Refuses, requested };
    world.input(1, refused());
    // When: it connects, and the earlier refusal is received once more
    world.run(ms(1));
    world.link(1, LinkFact::LinkUp { node: of, incarnation });
    world.input(1, refused());
    // Then: data read of it counts
    reads(&mut world, 1, PERIOD * 5);
    assert_eq!(world.losses(1), []);
    // And: without any data its silence is counted from there
    let mut world = two_that_are_cut();
    world.run(PERIOD * 2);
    world.link(1, LinkFact::LinkUp { node: of, incarnation });
    let linked = world.now;
    world.run_until(PERIOD * 10, |world| !world.losses(1).is_empty());
    let Some(NodeEvent::NodeLost { silent_us, .. }) = world.at(1).events.last() else { panic!("a loss") };
    assert_eq!(u128::from(*silent_us), world.now.since(linked).as_micros());
}

#[test]
fn only_members_about_to_be_lost_are_in_doubt() {
    let mut world = World::of_members(3);
    world.cut(2, 1);
    for missed in 0..3 {
        let members = world.at(1).core.members(world.now);
        assert_eq!((members[0].missed, members[1].missed), (missed, 0));
        let is_in_doubt = world.at(1).core.in_doubt() == [(node(2), Incarnation(1))];
        assert_eq!(is_in_doubt, missed == 2, "{missed} missed");
        world.run_until(PERIOD * 2, |world| {
            !world.has_member(1, 2) || world.at(1).core.members(world.now)[0].missed > missed
        });
        world.run(ms(1));
    }
}

#[test]
fn silent_ndl_of_a_living_node_is_reported_once() {
    // given
    let mut world = two_that_are_cut();
    reads(&mut world, 1, PERIOD * 6);
    assert_eq!(world.at(1).events, []);
    // when
    reads(&mut world, 1, PERIOD * 6);
    // then
    let ndl = Tid::new(node(2), AppAddress::NDL);
    let stalled = NodeEvent::AppStalled {
        node: node(2),
        name: "node-2".to_owned(),
        app: ndl,
        app_name: "NDL".to_owned(),
        trouble: Trouble::Unheard,
        since_us: 3_000_000,
    };
    assert_eq!(world.at(1).events, [stalled]);
    let known = &world.at(1).core.members(world.now)[0];
    assert_eq!((known.troubled, known.troubles[0].app), (1, ndl));
    // when
    world.forget_the_past();
    world.mend();
    world.run(PERIOD * 3);
    // then
    let (node, name, app_name) = (node(2), "node-2".to_owned(), "NDL".to_owned());
    assert_eq!(world.at(1).events, [NodeEvent::AppResumed { node, name, app: ndl, app_name }]);
    assert_eq!(world.at(1).core.members(world.now)[0].troubled, 0);
}

#[test]
fn node_that_queries_us_is_not_lost_though_unreached() {
    // given: no datagram of the first reaches the second, but its queries arrive; it loses the first, and queries ever
    // less
    let mut world = World::of_members(2);
    world.cut(1, 2);
    // when
    let took = world.run_until(PERIOD * 20, |world| !world.has_member(1, 2));
    // then
    assert!(!world.has_member(2, 1) && took > PERIOD * 5, "{took:?}");
    let Some(NodeEvent::NodeLost { silent_us, bound_us, .. }) = world.at(1).events.last() else {
        panic!("a loss")
    };
    assert!(silent_us <= bound_us, "{silent_us}");
}
