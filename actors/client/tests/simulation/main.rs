//! The property for every order of events: each receiver gets each class of each sender in order, also across
//! its incarnations, and nothing twice, and each confirmed message ends once.

mod world;

use proptest::{array::uniform3, prelude::*};
use sinew_client::DirectLinks;
use sinew_runtime::wire::Class;

use self::world::{APPS, Step, World, tid};

fn class() -> impl Strategy<Value = Class> {
    prop_oneof![Just(Class::Control), Just(Class::Stream), Just(Class::Bulk)]
}

fn step_without_faults() -> impl Strategy<Value = Step> {
    let app = 0..APPS;
    prop_oneof![
        6 => (app.clone(), app.clone(), class(), any::<bool>(), 1..4_usize)
            .prop_map(|(from, to, class, confirm, times)| Step::Send { from, to, class, confirm, times }),
        1 => (app.clone(), app.clone(), class()).prop_map(|(from, to, class)| Step::Burst { from, to, class }),
        8 => app.clone().prop_map(Step::NodeReads),
        5 => app.clone().prop_map(Step::NodeWrites),
        5 => app.clone().prop_map(Step::Poll),
        4 => (app.clone(), app.clone()).prop_map(|(at, peer)| Step::PollLink(at, peer)),
        2 => app.clone().prop_map(Step::PollEnds),
        3 => app.prop_map(Step::FinishMaking),
    ]
}

fn step_with_faults() -> impl Strategy<Value = Step> {
    let app = 0..APPS;
    prop_oneof![
        60 => step_without_faults(),
        1 => app.clone().prop_map(Step::Kill),
        2 => app.clone().prop_map(Step::Revive),
        1 => Just(Step::RestartNode),
        1 => app.prop_map(Step::LoseNotification),
    ]
}

/// The settings of all applications: each accepts links or not, and requests them early, late, or never.
fn direct_links() -> impl Strategy<Value = [DirectLinks; APPS]> {
    uniform3(prop_oneof![
        4 => Just(DirectLinks::Always),
        4 => Just(DirectLinks::Automatic),
        1 => Just(DirectLinks::Never),
    ])
}

fn run(direct_links: [DirectLinks; APPS], steps: Vec<Step>) -> World {
    let mut world = World::new(direct_links);
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
    fn path_changes_keep_messages_complete_and_ordered(
        links in direct_links(),
        steps in proptest::collection::vec(step_without_faults(), 1..400),
    ) {
        run(links, steps);
    }

    #[test]
    fn restarts_keep_messages_ordered_and_unique(
        links in direct_links(),
        steps in proptest::collection::vec(step_with_faults(), 1..400),
    ) {
        run(links, steps);
    }
}

/// The node's queue serves a lane that was passed over for long: one mark behind all others would come too
/// early.
#[test]
fn messages_at_node_precede_direct_ones_in_every_class() {
    let world = World::switching(&[Step::Burst { from: 0, to: 1, class: Class::Control }]);
    finish(world);
}

#[test]
fn ring_messages_of_dead_sender_stay_in_order() {
    let send = Step::Send { from: 0, to: 1, class: Class::Bulk, confirm: true, times: 3 };
    let mut world = World::switching(&[send, Step::NodeReads(0), Step::NodeReads(0), Step::NodeReads(0)]);
    for step in [Step::Kill(0), Step::PollEnds(1)] {
        world.step(step);
    }
    finish(world);
}

fn busy_peers_end_with_one_open_link(links: DirectLinks) {
    let steps = (0..400).flat_map(|_| {
        let send = |from, to| Step::Send { from, to, class: Class::Control, confirm: true, times: 1 };
        let both = |step: fn(usize) -> Step| [step(0), step(1)];
        [send(0, 1), send(1, 0)]
            .into_iter()
            .chain(both(Step::NodeReads))
            .chain(both(Step::NodeReads))
            .chain(both(Step::NodeWrites))
            .chain(both(Step::Poll))
            .chain(both(Step::Poll))
            .chain(both(Step::FinishMaking))
            .chain([Step::PollLink(0, 1), Step::PollLink(1, 0), Step::PollLink(0, 1), Step::PollLink(1, 0)])
    });
    let world = run([links; APPS], steps.collect());
    let number = world.apps[0].routes.link(tid(1)).expect("a link");
    assert_eq!(world.apps[1].routes.link(tid(0)), Some(number));
    assert!(world.apps[0].routes.is_open(tid(1)) && world.apps[1].routes.is_open(tid(0)));
    assert!(world.on_links > 300, "{} went directly", world.on_links);
}

#[test]
fn busy_peers_with_permanent_links_keep_one_open_link() {
    busy_peers_end_with_one_open_link(DirectLinks::Always);
}

#[test]
fn busy_peers_with_automatic_links_keep_one_open_link() {
    busy_peers_end_with_one_open_link(DirectLinks::Automatic);
}

/// The newest value of a Stream replaces an older one that waits at the node. It also replaces one of another
/// incarnation, which waits before the marks of a link of that incarnation.
#[test]
fn replacing_stream_value_waits_for_former_ring() {
    let stream = Step::Send { from: 0, to: 1, class: Class::Stream, confirm: false, times: 1 };
    let mut world = World::switching(&[stream, Step::NodeReads(0)]);
    for step in [Step::Kill(0), Step::Revive(0), stream, Step::NodeReads(0)] {
        world.step(step);
    }
    finish(world);
}
