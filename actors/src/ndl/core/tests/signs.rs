//! Members that do not answer, and of which GNCL hears. spec: NDL-4.7

use std::time::Duration;

use sinew_runtime::tid::{AppAddress, Incarnation, Tid};

use super::world::{PERIOD, World, ms, node};
use crate::{
    gncl::LinkFact,
    ndl::{
        LossReason, NodeEvent, Trouble,
        core::{Host, Input},
    },
};

/// Two nodes, and no datagram between them any more.
fn two_that_are_cut() -> World {
    let mut world = World::of_members(2);
    world.cut(1, 2);
    world.cut(2, 1);
    world
}

/// GNCL of the first reads of the second, in that life, every tenth of a period.
fn reads(world: &mut World, life: u64, duration: Duration) {
    let end = world.now + duration;
    while world.now < end {
        let (node, incarnation, at) = (node(2), Incarnation(life), world.now);
        world.input(1, Input::SignSeen { node, incarnation, at });
        world.run(PERIOD / 10);
    }
}

#[test]
fn who_is_read_of_is_not_lost_however_many_answers_are_missed() {
    let mut world = two_that_are_cut();
    reads(&mut world, 1, PERIOD * 50);
    assert_eq!(world.losses(1), []);
    assert_eq!(
        world.at(1).core.members(world.now)[0].missed,
        49,
        "the first question was asked when the way was cut"
    );
}

#[test]
fn who_is_read_of_no_more_is_lost_within_the_bound_from_then() {
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
fn what_is_read_of_another_life_is_no_sign_of_this_one() {
    let mut world = two_that_are_cut();
    reads(&mut world, 2, PERIOD * 4);
    assert_eq!(world.losses(1), [(2, LossReason::LinkDown)]);
}

#[test]
fn what_is_read_of_a_process_that_has_ended_keeps_nobody() {
    let mut world = two_that_are_cut();
    world.run_until(PERIOD * 2, |world| !world.at(1).probes.is_empty());
    let (node, incarnation) = world.at(1).probes[0];
    let asked = world.now;
    world.input(1, Input::Probed { node, incarnation, host: Host::Refuses, asked });
    reads(&mut world, 1, PERIOD * 3);
    assert_eq!(world.losses(1), [(2, LossReason::Crashed)]);
}

#[test]
fn a_connection_that_is_made_is_a_sign_whatever_its_host_has_said_before() {
    // Given: a member whose host has refused what it was sent, as while GNCL is restarted there
    let mut world = two_that_are_cut();
    world.run_until(PERIOD * 2, |world| !world.at(1).probes.is_empty());
    let ((of, incarnation), asked) = (world.at(1).probes[0], world.now);
    let refused = || Input::Probed { node: of, incarnation, host: Host::Refuses, asked };
    world.input(1, refused());
    // When: it connects, and what it was asked before is heard once more
    world.run(ms(1));
    world.link(1, LinkFact::LinkUp { node: of, incarnation });
    world.input(1, refused());
    // Then: what is read of it counts
    reads(&mut world, 1, PERIOD * 5);
    assert_eq!(world.losses(1), []);
    // And: where nothing is, its silence is counted from there
    let mut world = two_that_are_cut();
    world.run(PERIOD * 2);
    world.link(1, LinkFact::LinkUp { node: of, incarnation });
    let linked = world.now;
    world.run_until(PERIOD * 10, |world| !world.losses(1).is_empty());
    let Some(NodeEvent::NodeLost { silent_us, .. }) = world.at(1).events.last() else { panic!("a loss") };
    assert_eq!(u128::from(*silent_us), world.now.since(linked).as_micros());
}

#[test]
fn only_who_is_about_to_be_lost_is_in_doubt() {
    let mut world = World::of_members(3);
    world.cut(2, 1);
    for missed in 0..3 {
        let members = world.at(1).core.members(world.now);
        assert_eq!((members[0].missed, members[1].missed), (missed, 0));
        let is_in_doubt = world.at(1).core.in_doubt() == [(node(2), Incarnation(1))];
        assert_eq!(is_in_doubt, missed == 2, "{missed} missed");
        world.run_until(PERIOD * 2, |world| {
            !world.knows(1, 2) || world.at(1).core.members(world.now)[0].missed > missed
        });
        world.run(ms(1));
    }
}

#[test]
fn that_the_ndl_of_a_living_node_is_not_heard_is_told_once_and_so_is_that_it_answers_again() {
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
fn who_asks_us_is_not_lost_until_it_asks_no_more_though_our_questions_do_not_reach_it() {
    // given: nothing that the first says reaches the second, whose questions come; it loses the first, and asks ever more seldom
    let mut world = World::of_members(2);
    world.cut(1, 2);
    // when
    let took = world.run_until(PERIOD * 20, |world| !world.knows(1, 2));
    // then
    assert!(!world.knows(2, 1) && took > PERIOD * 5, "{took:?}");
    let Some(NodeEvent::NodeLost { silent_us, bound_us, .. }) = world.at(1).events.last() else {
        panic!("a loss")
    };
    assert!(silent_us <= bound_us, "{silent_us}");
}
