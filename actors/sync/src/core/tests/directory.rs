//! The directory, as its subscribers see it.

use sinew_model::facts::DeclaredTypes;
use sinew_runtime::wire::{Kind, SchemaHash};

use super::*;
use crate::own_app::AppTypes;

fn is(name: &str, node: NodeAddress, index: u32, ready: bool) -> Output {
    let entry =
        DirectoryEntry { name: name.to_owned(), tid: Tid::new(node, app(index)), ready, kinds: Vec::new() };
    Output::NotifyDirectory { app: app(9), event: DirectoryEvent::Is(entry) }
}

fn gone(name: &str, node: NodeAddress, index: u32) -> Output {
    let event = DirectoryEvent::Gone { name: name.to_owned(), tid: Tid::new(node, app(index)) };
    Output::NotifyDirectory { app: app(9), event }
}

fn watched() -> Bench {
    let mut bench = Bench::new();
    bench.registers(9, "", &[]);
    bench.ready(9);
    bench.registers(0, "hip", &[]);
    bench
}

#[test]
fn subscriber_receives_all_entries_then_each_change_once() {
    let mut bench = watched();
    assert_eq!(bench.handle(Input::DirectoryWanted { app: app(9) }), [is("hip", HERE, 0, false)]);
    assert_eq!(bench.ready(0), [is("hip", HERE, 0, true)]);
    bench.links(KNEE, INCARNATION);
    assert!(bench.list(KNEE, list(1, &[("knee", true, &[])])).contains(&is("knee", KNEE, 0, true)));
    assert_eq!(bench.breaks(KNEE), [is("knee", KNEE, 0, false)]);
    assert_eq!(bench.lost(KNEE, LossReason::LinkDown), [gone("knee", KNEE, 0)]);
    assert_eq!(bench.down(9), [release(9)]);
    assert_eq!(bench.handle(Input::AppChanged(AppFact::Unregistered { app: app(0) })), [], "it is over");
}

#[test]
fn declared_types_are_published_and_end_with_their_node() {
    let types = |hash| DeclaredTypes {
        handles: vec![(Kind::named("demo.angle"), SchemaHash(hash))],
        sends: vec![(Kind::named("demo.speed"), SchemaHash(hash + 1))],
    };
    let mut bench = watched();
    bench.links(KNEE, INCARNATION);
    bench.handle(Input::AppChanged(AppFact::Types { app: app(0), types: types(1) }));
    let lists = published(&bench.passes(REPEAT));
    let hip = lists[0].entries.iter().find(|entry| &*entry.name == "hip").unwrap();
    assert_eq!((&hip.handles, &hip.sends), (&types(1).handles, &types(1).sends));
    let mut knee = list(1, &[("knee", true, &[])]);
    (knee.entries[0].handles, knee.entries[0].sends) = (types(5).handles, types(5).sends);
    bench.list(KNEE, knee);
    let of = |name: &str, node, hash| AppTypes {
        tid: Tid::new(node, app(0)),
        name: name.to_owned(),
        types: types(hash),
    };
    assert_eq!(bench.core.declared_types(), [of("hip", HERE, 1), of("knee", KNEE, 5)]);
    assert_eq!(bench.core.own_declared_types(), [of("hip", HERE, 1)]);
    assert_eq!(bench.core.declared_types_of(KNEE), [of("knee", KNEE, 5)]);
    assert_eq!(bench.core.list_versions(), [(KNEE, (INCARNATION, 1))]);
    let knee = Tid::new(KNEE, app(0));
    assert_eq!(bench.core.name_of(knee).as_deref(), Some("knee"));
    let angle = |hash| (Kind::named("demo.angle"), SchemaHash(hash));
    assert!(bench.core.lists_handled(knee, angle(5)) && !bench.core.lists_handled(knee, angle(6)));
    bench.lost(KNEE, LossReason::LinkDown);
    assert_eq!(bench.core.declared_types(), [of("hip", HERE, 1)]);
    assert!(bench.core.list_versions().is_empty() && bench.core.name_of(knee).is_none());
}

#[test]
fn rejected_event_is_sent_later_in_its_latest_state() {
    let mut bench = watched();
    bench.handle(Input::DirectoryWanted { app: app(9) });
    let Output::NotifyDirectory { event, .. } = is("hip", HERE, 0, false) else { panic!("it is one") };
    assert_eq!(bench.handle(Input::DirectoryRejected { app: app(9), event }), []);
    assert_eq!(bench.ready(0), [], "it has no room yet");
    assert_eq!(bench.handle(Input::RoomMade), [is("hip", HERE, 0, true)]);
    let outputs = bench.handle(Input::AppChanged(AppFact::Unregistered { app: app(0) }));
    assert_eq!(outputs, [gone("hip", HERE, 0)]);
    let Output::NotifyDirectory { event, .. } = gone("hip", HERE, 0) else { panic!("it is one") };
    bench.handle(Input::DirectoryRejected { app: app(9), event });
    assert_eq!(bench.handle(Input::RoomMade), [gone("hip", HERE, 0)]);
}

// spec: SYNC-14
#[test]
fn full_subscriber_gets_time_to_read_between_events() {
    let mut bench = watched();
    bench.links(KNEE, INCARNATION);
    for (index, name) in [(1, "knee"), (2, "ankle")] {
        bench.registers(index, name, &[]);
    }
    let wanted = Input::DirectoryWanted { app: app(9) };
    bench.core.handle(bench.now, wanted);
    assert_eq!(bench.core.poll(), Some(is("ankle", HERE, 2, false)));
    let Some(Output::NotifyDirectory { event, .. }) = bench.core.poll() else { panic!("of the hip") };
    // Much is due, but a rejected event does not trigger it.
    bench.now = bench.now + REPEAT;
    assert_eq!(bench.handle(Input::DirectoryRejected { app: app(9), event }), []);
    assert_eq!(published(&bench.handle(Input::TimePassed)).len(), 1, "this is");
    bench.ready(2);
    let outputs: Vec<_> = bench.handle(Input::RoomMade);
    let events: Vec<_> =
        outputs.into_iter().filter(|out| matches!(out, Output::NotifyDirectory { .. })).collect();
    assert_eq!(events, [is("ankle", HERE, 2, true), is("hip", HERE, 0, false), is("knee", HERE, 1, false)]);
}

// spec: SYNC-14
#[test]
fn directory_is_read_only_for_ready_subscribers() {
    let mut bench = watched();
    bench.handle(Input::DirectoryWanted { app: app(9) });
    assert!(!bench.core.subscribers.are_due(), "it has received all entries");
    bench.core.take_directory_changed();
    for input in [Input::TimePassed, Input::GroupsChanged(Published::default())] {
        bench.handle(input);
        assert!(!bench.core.take_directory_changed());
    }
    let Output::NotifyDirectory { event, .. } = is("hip", HERE, 0, false) else { panic!("it is one") };
    bench.handle(Input::DirectoryRejected { app: app(9), event });
    bench.core.subscribers.directory_changed();
    assert!(!bench.core.subscribers.are_due(), "it is full");
    bench.core.subscribers.room_made();
    assert!(bench.core.subscribers.are_due(), "it has room");
}

#[test]
fn handled_kinds_are_in_the_directory_of_every_node() {
    let mut bench = watched();
    let kinds = vec![Kind::named("demo.angle")];
    bench.links(KNEE, INCARNATION);
    bench.passes(SPACING);
    let outputs = bench.handle(Input::AppChanged(AppFact::Handles { app: app(0), kinds: kinds.clone() }));
    assert_eq!(bench.core.directory()[0].kinds, kinds);
    assert_eq!(published(&outputs)[0].entries[0].kinds, kinds);
    let mut theirs = list(1, &[("knee", true, &[])]);
    theirs.entries[0].kinds.clone_from(&kinds);
    bench.list(KNEE, theirs);
    assert_eq!(bench.core.directory()[1].kinds, kinds);
}

#[test]
fn last_published_names_count_for_access() {
    let mut bench = watched();
    bench.links(KNEE, INCARNATION);
    let names = |bench: &Bench, of| {
        let all = bench.core.names_elsewhere(of).flat_map(|names| {
            assert_eq!(names.incarnation, INCARNATION);
            names.names.into_iter().map(move |(app, name)| (Tid::new(names.node, app), name.to_owned()))
        });
        all.collect::<Vec<_>>()
    };
    bench.list(KNEE, list(1, &[("knee", true, &[])]));
    let knee = (Tid::new(KNEE, app(0)), "knee".to_owned());
    assert_eq!(names(&bench, None), std::slice::from_ref(&knee), "those of this node are known before");
    assert_eq!(names(&bench, Some(KNEE)), std::slice::from_ref(&knee));
    assert_eq!(names(&bench, Some(HERE)), []);
    // Messages that it sent before the loss still arrive, its last wills too.
    bench.breaks(KNEE);
    bench.lost(KNEE, LossReason::Crashed);
    assert_eq!((bench.core.directory().len(), names(&bench, None)), (1, vec![knee]));
    bench.links(KNEE, INCARNATION);
    bench.list(KNEE, list(2, &[("drive", true, &[])]));
    assert_eq!(names(&bench, Some(KNEE)), [(Tid::new(KNEE, app(0)), "drive".to_owned())]);
    assert_eq!(Input::TimePassed.names_changed(), NamesChanged::None);
}

#[test]
fn only_a_changed_directory_is_read_again() {
    // Given: the knee is linked and its list is known
    let mut bench = watched();
    bench.handle(Input::DirectoryWanted { app: app(9) });
    bench.links(KNEE, INCARNATION);
    let same = || list(1, &[("knee", true, &[])]);
    bench.list(KNEE, same());
    assert!(bench.core.take_directory_changed());
    // When
    bench.list(KNEE, same());
    bench.passes(REPEAT);
    bench.arrives("calibrated", 7);
    // Then
    assert!(!bench.core.take_directory_changed());
    // And: after a break the known entries count again, so the directory is read
    bench.breaks(KNEE);
    assert!(bench.core.take_directory_changed());
    bench.links(KNEE, INCARNATION);
    bench.core.take_directory_changed();
    assert!(bench.list(KNEE, same()).contains(&is("knee", KNEE, 0, true)));
    assert!(bench.core.take_directory_changed());
}

// spec: SYNC-6
#[test]
fn name_resolves_to_this_node_first() {
    // Given: the knee comes before the ankle, and its camera is not ready
    let mut bench = Bench::new();
    for (node, is_ready) in [(KNEE, false), (ANKLE, true)] {
        bench.links(node, INCARNATION);
        bench.list(node, list(1, &[("camera", is_ready, &[])]));
    }
    let [knee, ankle, hip] = [KNEE, ANKLE, HERE].map(|node| Tid::new(node, app(0)));
    assert_eq!(bench.registers(1, "gait", &["camera"]), [release(1)], "it is let go by the ankle's");
    assert_eq!(bench.core.called("camera"), [ankle, knee]);
    // When: this node has one, too
    bench.registers(0, "camera", &[]);
    // Then: the name is this node's, ready or not
    assert_eq!(bench.core.called("camera"), [hip, ankle, knee]);
}
