//! A living node with stalled parts.

use sinew_model::{
    facts::{NodeEvent, Trouble},
    progress::{IdleClient, Part, Progress, TroubleCode},
};
use sinew_runtime::tid::{AppAddress, Tid};

use super::world::{PERIOD, World, ms, node};
use crate::core::Input;

fn part(app: u32, trouble: Trouble) -> Part {
    Part {
        app: AppAddress::new(app),
        name: format!("app-{app:x}"),
        trouble: TroubleCode(trouble),
        since_ms: 300,
    }
}

/// Returns the troubles reported to node 1 since the last call, in short form.
fn new_troubles(world: &mut World) -> Vec<(u32, Option<Trouble>)> {
    let events = std::mem::take(&mut world.process(1).events);
    let in_few_words = |event| match event {
        NodeEvent::AppStalled { app, trouble, since_us: 300_000, .. } => (app.app.bits(), Some(trouble)),
        NodeEvent::AppResumed { app, .. } => (app.app.bits(), None),
        other @ (NodeEvent::AppStalled { .. }
        | NodeEvent::NodeFound { .. }
        | NodeEvent::NodeLost { .. }
        | NodeEvent::NodeRestarted { .. }) => panic!("{other:?}"),
    };
    events.into_iter().map(in_few_words).collect()
}

fn report(world: &mut World, parts: Vec<Part>) {
    world.input(2, Input::ProgressSeen(Progress::of(parts)));
    world.run(PERIOD + ms(1));
}

// spec: NDL-9
#[test]
fn stall_on_a_living_node_is_reported_once() {
    let mut world = World::of_members(2);
    let (stalled, away) = (Trouble::Stalled, Trouble::Down);
    report(&mut world, vec![part(0x2000, stalled), part(3, stalled)]);
    assert_eq!(new_troubles(&mut world), [(3, Some(stalled)), (0x2000, Some(stalled))], "layers first");
    world.run(PERIOD * 5);
    assert_eq!(new_troubles(&mut world), []);
    let known = &world.at(1).core.members(world.now)[0];
    assert_eq!((known.troubled, known.troubles[1].app), (2, Tid::new(node(2), AppAddress::new(0x2000))));
    let own = world.at(2).core.own_troubles();
    assert_eq!(own, (known.troubled, known.troubles.clone()), "it reports the same about itself");
    report(&mut world, vec![part(0x2000, away)]);
    assert_eq!(new_troubles(&mut world), [(3, None), (0x2000, Some(away))]);
    report(&mut world, vec![]);
    assert_eq!(new_troubles(&mut world), [(0x2000, None)]);
    assert!(world.has_member(1, 2));
}

#[test]
fn first_four_of_many_stalled_parts_are_named() {
    let mut world = World::of_members(2);
    let many = |from: u32| (from..0x2006).map(|app| part(app, Trouble::GivenUp)).collect();
    report(&mut world, many(0x2001));
    assert_eq!(new_troubles(&mut world).len(), 4);
    assert_eq!(world.at(1).core.members(world.now)[0].troubled, 5);
    report(&mut world, many(0x2000));
    assert_eq!(new_troubles(&mut world), [(0x2000, Some(Trouble::GivenUp))]);
}

#[test]
fn named_part_resumes_after_an_overflow() {
    let mut world = World::of_members(2);
    let stalled = Trouble::Stalled;
    let many = |apps: &[u32]| apps.iter().map(|app| part(*app, stalled)).collect();
    report(&mut world, many(&[0x2009]));
    assert_eq!(new_troubles(&mut world), [(0x2009, Some(stalled))]);
    report(&mut world, many(&[0x2001, 0x2002, 0x2003, 0x2004, 0x2009]));
    assert_eq!(new_troubles(&mut world).len(), 4, "0x2009 is not named, and reported already");
    report(&mut world, many(&[0x2001]));
    let over = [0x2002, 0x2003, 0x2004, 0x2009].map(|app| (app, None));
    assert_eq!(new_troubles(&mut world), over);
    report(&mut world, many(&[]));
    assert_eq!(new_troubles(&mut world), [(0x2001, None)]);
}

#[test]
fn troubles_beyond_the_limit_are_reported_later() {
    let mut world = World::of_members(2);
    for first in (0..80).step_by(4) {
        // The first four of many, different ones each time.
        let mut parts: Vec<_> = (first..first + 5).map(|app| part(0x2000 + app, Trouble::Down)).collect();
        parts.push(part(0x3000, Trouble::Down));
        report(&mut world, parts);
    }
    assert_eq!(new_troubles(&mut world).len(), 64);
    report(&mut world, vec![part(0x3000, Trouble::Down)]);
    let events = new_troubles(&mut world);
    assert_eq!(events.len(), 65);
    assert_eq!(events.last(), Some(&(0x3000, Some(Trouble::Down))));
}

#[test]
fn late_subscriber_receives_present_troubles() {
    let mut world = World::of_members(2);
    report(&mut world, vec![part(0x2000, Trouble::Stalled)]);
    new_troubles(&mut world);
    let late = sinew_model::facts::AppFact::Ready { app: AppAddress::fixed(7).unwrap() };
    world.input(1, Input::AppChanged(late));
    let events = std::mem::take(&mut world.process(1).events);
    assert!(matches!(events[..], [NodeEvent::NodeFound { .. }, NodeEvent::AppStalled { .. }]), "{events:?}");
}

// spec: NDL-9.1
#[test]
fn stalled_clients_are_kept_without_events() {
    let mut world = World::of_members(2);
    let stalled = Trouble::Stalled;
    let client = |app| IdleClient { app: AppAddress::new(app), name: "hand".to_owned(), since_ms: 2_900 };
    let idle = |world: &World| {
        let known = &world.at(1).core.members(world.now)[0];
        (
            known.idle_clients,
            known.idle.iter().map(|client| (client.app.app.bits(), client.since)).collect::<Vec<_>>(),
        )
    };
    // When: many clients read nothing, different ones each time, and then an application of the node stalls, too.
    for first in (0..100).map(|round| 0x1000 + 100 * round) {
        let clients = (first..first + 100).map(client).collect();
        world.input(2, Input::ProgressSeen(Progress::default().with_clients(clients)));
        world.run(PERIOD + ms(1));
        assert_eq!(idle(&world), (100, vec![(first, ms(2_900)), (first + 1, ms(2_900))]));
        let (own, known) = (world.at(2).core.own_idle(), &world.at(1).core.members(world.now)[0]);
        assert_eq!(own, (known.idle_clients, known.idle.clone()), "it reports the same about itself");
    }
    let own = Progress::of(vec![part(0x9000_0000, stalled)]);
    world.input(2, Input::ProgressSeen(own.with_clients((0x1000..0x1064).map(client).collect())));
    world.run(PERIOD + ms(1));
    // Then
    assert_eq!(new_troubles(&mut world), [(0x9000_0000, Some(stalled))]);
    world.input(
        2,
        Input::ProgressSeen(Progress::default().with_clients((0x1000..0x1064).map(client).collect())),
    );
    world.run(PERIOD + ms(1));
    assert_eq!(new_troubles(&mut world), [(0x9000_0000, None)], "though clients are not all named");
    report(&mut world, vec![]);
    assert_eq!((new_troubles(&mut world), idle(&world)), (vec![], (0, vec![])));
}
