//! Nodes that are watched at paces of their own.

use std::time::Duration;

use sinew_model::{config::WatchGroup, facts::NodeEvent};

use super::world::{PERIOD, Spec, World, ms, node};
use crate::core::Output;

const FAST: Duration = ms(10);

/// Node 1 watches node 2 every 10 ms, with at most two missed answers, and node 3 at the common pace.
fn leg_and_console() -> World {
    let mut world = World::new();
    let watch = vec![WatchGroup { nodes: vec!["node-2".to_owned()], period: FAST, missed_max: 2 }];
    world.start(1, &Spec { watch, ..Spec::of(1) });
    world.start(2, &Spec::of(2));
    world.start(3, &Spec::of(3));
    world.run(ms(105));
    assert!(world.has_member(1, 2) && world.has_member(1, 3));
    world.forget_the_past();
    world
}

/// Returns the lost nodes with the silence and the bound, in microseconds.
fn losses(world: &World) -> Vec<(u32, u64, u64)> {
    let events = world.at(1).events.iter().filter_map(|event| match event {
        NodeEvent::NodeLost { node, silent_us, bound_us, .. } => Some((node.bits(), *silent_us, *bound_us)),
        NodeEvent::NodeFound { .. }
        | NodeEvent::NodeRestarted { .. }
        | NodeEvent::AppStalled { .. }
        | NodeEvent::AppResumed { .. } => None,
    });
    events.collect()
}

// spec: NDL-2.4
#[test]
fn leg_and_console_are_lost_within_their_own_bounds() {
    let mut world = leg_and_console();
    world.kill(2);
    world.kill(3);
    world.run(ms(31));
    let [(2, silent_us, 30_000)] = losses(&world)[..] else { panic!("{:?}", losses(&world)) };
    assert!((20_000..=30_000).contains(&silent_us), "{silent_us}");
    world.run(PERIOD * 4);
    let [_, (3, silent_us, 2_000_000)] = losses(&world)[..] else { panic!("{:?}", losses(&world)) };
    assert!((1_500_000..=2_000_000).contains(&silent_us), "{silent_us}");
}

#[test]
fn only_the_watched_leg_costs_its_faster_pace() {
    let mut world = leg_and_console();
    world.run(ms(5_000));
    // 500 queries to it; for each period one to the console, three to the group, and answers to two.
    assert!((500..=565).contains(&world.at(1).datagrams_sent), "{}", world.at(1).datagrams_sent);
    let [leg, console] = &world.at(1).core.members(world.now)[..] else { panic!("two members") };
    assert_eq!([leg.asked_every, console.asked_every], [FAST, PERIOD]);
}

// spec: NDL-3.1
#[test]
fn leg_over_a_slow_path_is_not_lost() {
    let mut world = World::new();
    world.flight = Duration::from_micros(22_500);
    let watch = vec![WatchGroup { nodes: vec!["node-2".to_owned()], period: FAST, missed_max: 100 }];
    world.start(1, &Spec { watch, ..Spec::of(1) });
    world.start(2, &Spec::of(2));
    world.run(ms(3_000));
    assert!(world.has_member(1, 2));
    assert_eq!(losses(&world), []);
    assert_eq!(world.at(1).core.refusals().of("NDL answer without a question"), 0);
    // when: it is gone
    world.kill(2);
    world.run(ms(1_056));
    // then: the last answer came at most 45 ms after it was killed
    let [(2, silent_us, 1_010_000)] = losses(&world)[..] else { panic!("{:?}", losses(&world)) };
    assert!((1_000_000..=1_010_000).contains(&silent_us), "{silent_us}");
}

// spec: NDL-4.2
#[test]
fn stall_too_long_for_the_leg_costs_no_member() {
    for stall in [6, 15, 40, 200] {
        let mut world = leg_and_console();
        world.stall(1, ms(stall));
        world.run(ms(stall) + PERIOD * 5);
        assert_eq!(losses(&world), [], "after {stall} ms");
        let is_reported = |output: &Output| matches!(output, Output::Stalled { .. });
        let is_long = stall > 15;
        assert!(!is_long || world.at(1).others.iter().any(is_reported), "after {stall} ms");
        assert!(world.at(1).core.own_stalls().count <= 1, "one stall, whoever's cycle it made late");
    }
}

// spec: NDL-4.2
#[test]
fn always_late_timer_still_detects_a_dead_leg() {
    for late in [0, 4, 6, 12, 25] {
        // given: a node that gets the CPU late each time
        let mut world = leg_and_console();
        world.process(1).late = ms(late);
        world.run(PERIOD * 10);
        assert_eq!(losses(&world), [], "late by {late} ms");
        // when
        world.kill(2);
        let took = world.run_until(PERIOD * 2, |world| !losses(world).is_empty());
        // then: one cycle of four counts, two have to, and three grace periods may follow
        let cycle = FAST + ms(late);
        let bound = if late > 5 { cycle * 4 * 3 + (FAST / 2 + ms(late)) * 3 } else { cycle * 3 };
        assert!(took <= bound, "late by {late} ms: lost after {took:?}");
        assert_eq!(losses(&world)[0].0, 2);
    }
}

#[test]
fn lost_leg_is_queried_at_the_common_pace() {
    let mut world = leg_and_console();
    world.kill(2);
    world.run(PERIOD * 40);
    world.forget_the_past();
    world.run(PERIOD * 32);
    assert!(world.at(1).datagrams_sent < 32 * 6, "{}", world.at(1).datagrams_sent);
    world.start(2, &Spec { incarnation: 2, ..Spec::of(2) });
    world.run(ms(105));
    world.forget_the_past();
    world.kill(2);
    world.run_until(ms(31), |world| !losses(world).is_empty());
    assert_eq!(losses(&world)[0].0, node(2).bits());
}
