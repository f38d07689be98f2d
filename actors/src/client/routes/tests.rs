//! Whatever happens in whatever order: each receiver sees each class of each sender in order, across its lives too, and nothing
//! twice, and each confirmed message ends once.

use proptest::prelude::*;
use sinew_runtime::wire::Class;

use super::simulation::{APPS, Step, World, tid};

fn class() -> impl Strategy<Value = Class> {
    prop_oneof![Just(Class::Control), Just(Class::Stream), Just(Class::Bulk)]
}

fn calm() -> impl Strategy<Value = Step> {
    let app = 0..APPS;
    prop_oneof![
        6 => (app.clone(), app.clone(), class(), any::<bool>(), 1..4_usize)
            .prop_map(|(from, to, class, confirm, times)| Step::Send { from, to, class, confirm, times }),
        1 => (app.clone(), app.clone(), class()).prop_map(|(from, to, class)| Step::Burst { from, to, class }),
        8 => app.clone().prop_map(Step::NodeReads),
        5 => app.clone().prop_map(Step::NodeWrites),
        5 => app.clone().prop_map(Step::Look),
        4 => (app.clone(), app.clone()).prop_map(|(at, peer)| Step::LookAtLink(at, peer)),
        2 => app.prop_map(Step::LookAtEnds),
    ]
}

fn stormy() -> impl Strategy<Value = Step> {
    let app = 0..APPS;
    prop_oneof![
        60 => calm(),
        1 => app.clone().prop_map(Step::Kill),
        2 => app.clone().prop_map(Step::Revive),
        1 => Just(Step::RestartNode),
        1 => app.prop_map(Step::LoseWord),
    ]
}

fn run(steps: Vec<Step>) -> World {
    let mut world = World::new();
    for step in steps {
        world.step(step);
    }
    finish(world)
}

fn finish(mut world: World) -> World {
    world.settle();
    world.check();
    world
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 100, ..ProptestConfig::default() })]

    #[test]
    fn nothing_is_lost_doubled_or_out_of_order_while_ways_change(
        steps in proptest::collection::vec(calm(), 1..400),
    ) {
        run(steps);
    }

    #[test]
    fn nothing_is_doubled_or_out_of_order_whoever_ends_and_comes_back(
        steps in proptest::collection::vec(stormy(), 1..400),
    ) {
        run(steps);
    }
}

/// The node's queue gives a lane its turn that was passed over for long: one mark behind all others would come too early.
#[test]
fn what_waits_at_the_node_is_seen_before_what_came_directly_whatever_its_class() {
    let world = World::switching(&[Step::Burst { from: 0, to: 1, class: Class::Control }]);
    finish(world);
}

#[test]
fn what_a_sender_wrote_into_a_ring_before_it_died_comes_in_order() {
    let send = Step::Send { from: 0, to: 1, class: Class::Bulk, confirm: true, times: 3 };
    let mut world = World::switching(&[send, Step::NodeReads(0), Step::NodeReads(0), Step::NodeReads(0)]);
    for step in [Step::Kill(0), Step::LookAtEnds(1)] {
        world.step(step);
    }
    finish(world);
}

#[test]
fn two_that_send_much_to_each_other_end_with_one_open_link() {
    let steps = (0..400).flat_map(|_| {
        let send = |from, to| Step::Send { from, to, class: Class::Control, confirm: true, times: 1 };
        let both = |step: fn(usize) -> Step| [step(0), step(1)];
        [send(0, 1), send(1, 0)]
            .into_iter()
            .chain(both(Step::NodeReads))
            .chain(both(Step::NodeReads))
            .chain(both(Step::NodeWrites))
            .chain(both(Step::Look))
            .chain(both(Step::Look))
            .chain([
                Step::LookAtLink(0, 1),
                Step::LookAtLink(1, 0),
                Step::LookAtLink(0, 1),
                Step::LookAtLink(1, 0),
            ])
    });
    let world = run(steps.collect());
    let number = world.apps[0].routes.link(tid(1)).expect("a link");
    assert_eq!(world.apps[1].routes.link(tid(0)), Some(number));
    assert!(world.apps[0].routes.is_open(tid(1)) && world.apps[1].routes.is_open(tid(0)));
    assert!(world.on_links > 300, "{} went directly", world.on_links);
}

/// The newest value of a Stream takes the place of an older one that waits at the node: also that of another life, which
/// waits before the marks of a link of that life.
#[test]
fn a_stream_of_the_next_life_that_took_the_place_of_an_older_value_does_not_come_before_the_ring_of_the_former_one()
 {
    let stream = Step::Send { from: 0, to: 1, class: Class::Stream, confirm: false, times: 1 };
    let mut world = World::switching(&[stream, Step::NodeReads(0)]);
    for step in [Step::Kill(0), Step::Revive(0), stream, Step::NodeReads(0)] {
        world.step(step);
    }
    finish(world);
}
