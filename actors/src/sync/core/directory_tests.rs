//! The directory, as those see it who want to hear of it.

use sinew_runtime::wire::Kind;

use super::*;

fn is(name: &str, node: NodeAddress, index: u32, ready: bool) -> Output {
    let entry =
        DirectoryEntry { name: name.to_owned(), tid: Tid::new(node, app(index)), ready, kinds: Vec::new() };
    Output::TellDirectory { app: app(9), event: DirectoryEvent::Is(entry) }
}

fn gone(name: &str, node: NodeAddress, index: u32) -> Output {
    let event = DirectoryEvent::Gone { name: name.to_owned(), tid: Tid::new(node, app(index)) };
    Output::TellDirectory { app: app(9), event }
}

fn watched() -> Bench {
    let mut bench = Bench::new();
    bench.registers(9, "", &[]);
    bench.ready(9);
    bench.registers(0, "hip", &[]);
    bench
}

#[test]
fn who_watches_hears_of_all_that_is_there_and_then_of_each_change_once() {
    let mut bench = watched();
    assert_eq!(bench.hears(Input::DirectoryWanted { app: app(9) }), [is("hip", HERE, 0, false)]);
    assert_eq!(bench.ready(0), [is("hip", HERE, 0, true)]);
    bench.links(KNEE, LIFE);
    assert!(bench.list(KNEE, list(1, &[("knee", true, &[])])).contains(&is("knee", KNEE, 0, true)));
    assert_eq!(bench.breaks(KNEE), [is("knee", KNEE, 0, false)]);
    assert_eq!(bench.lost(KNEE, LossReason::LinkDown), [gone("knee", KNEE, 0)]);
    assert_eq!(bench.down(9), [release(9)]);
    assert_eq!(bench.hears(Input::AppChanged(AppFact::Unregistered { app: app(0) })), [], "it is over");
}

#[test]
fn what_was_not_taken_is_told_later_as_it_is_then() {
    let mut bench = watched();
    bench.hears(Input::DirectoryWanted { app: app(9) });
    let Output::TellDirectory { event, .. } = is("hip", HERE, 0, false) else { panic!("it is one") };
    assert_eq!(bench.hears(Input::DirectoryNotTaken { app: app(9), event }), []);
    assert_eq!(bench.ready(0), [], "it has no room yet");
    assert_eq!(bench.core.next_wake(), Some(bench.now + RETRY));
    assert_eq!(bench.passes(RETRY), [is("hip", HERE, 0, true)]);
    let outputs = bench.hears(Input::AppChanged(AppFact::Unregistered { app: app(0) }));
    assert_eq!(outputs, [gone("hip", HERE, 0)]);
    let Output::TellDirectory { event, .. } = gone("hip", HERE, 0) else { panic!("it is one") };
    bench.hears(Input::DirectoryNotTaken { app: app(9), event });
    assert_eq!(bench.passes(RETRY), [gone("hip", HERE, 0)]);
}

// spec: SYNC-14
#[test]
fn who_had_no_room_for_one_event_is_offered_no_other_before_it_had_time_to_read() {
    let mut bench = watched();
    bench.links(KNEE, LIFE);
    for (index, name) in [(1, "knee"), (2, "ankle")] {
        bench.registers(index, name, &[]);
    }
    let wanted = Input::DirectoryWanted { app: app(9) };
    bench.core.handle(bench.now, wanted);
    assert_eq!(bench.core.poll(), Some(is("ankle", HERE, 2, false)));
    let Some(Output::TellDirectory { event, .. }) = bench.core.poll() else { panic!("of the hip") };
    // Much is due, but an event that was not taken is no occasion for it.
    bench.now = bench.now + REPEAT;
    assert_eq!(bench.hears(Input::DirectoryNotTaken { app: app(9), event }), []);
    assert_eq!(published(&bench.hears(Input::TimePassed)).len(), 1, "this is");
    bench.ready(2);
    let told: Vec<_> = bench.passes(RETRY);
    let told: Vec<_> = told.into_iter().filter(|out| matches!(out, Output::TellDirectory { .. })).collect();
    assert_eq!(told, [is("ankle", HERE, 2, true), is("hip", HERE, 0, false), is("knee", HERE, 1, false)]);
}

// spec: SYNC-14
#[test]
fn the_directory_is_read_only_when_somebody_can_be_told_of_a_change() {
    let mut bench = watched();
    bench.hears(Input::DirectoryWanted { app: app(9) });
    assert!(!bench.core.watchers.are_due(bench.now), "it knows all");
    let later = bench.now + REPEAT;
    bench.core.take_directory_changed();
    for input in [Input::TimePassed, Input::GroupsChanged(Published::default())] {
        bench.hears(input);
        assert!(!bench.core.take_directory_changed());
    }
    let Output::TellDirectory { event, .. } = is("hip", HERE, 0, false) else { panic!("it is one") };
    bench.hears(Input::DirectoryNotTaken { app: app(9), event });
    bench.core.watchers.directory_changed();
    assert!(!bench.core.watchers.are_due(bench.now), "it rests");
    assert!(bench.core.watchers.are_due(later), "it has rested");
}

#[test]
fn what_an_application_handles_stands_in_the_directory_of_every_node() {
    let mut bench = watched();
    let kinds = vec![Kind::named("demo.angle")];
    bench.links(KNEE, LIFE);
    bench.passes(SPACING);
    let outputs = bench.hears(Input::AppChanged(AppFact::Handles { app: app(0), kinds: kinds.clone() }));
    assert_eq!(bench.core.directory()[0].kinds, kinds);
    assert_eq!(published(&outputs)[0].entries[0].kinds, kinds);
    let mut theirs = list(1, &[("knee", true, &[])]);
    theirs.entries[0].kinds.clone_from(&kinds);
    bench.list(KNEE, theirs);
    assert_eq!(bench.core.directory()[1].kinds, kinds);
}

#[test]
fn what_a_node_has_called_its_applications_counts_for_the_access_list_until_it_says_otherwise() {
    let mut bench = watched();
    bench.links(KNEE, LIFE);
    let names = |bench: &Bench, of| {
        let all = bench.core.names_elsewhere(of).flat_map(|said| {
            assert_eq!(said.life, LIFE);
            said.names.into_iter().map(move |(app, name)| (Tid::new(said.node, app), name.to_owned()))
        });
        all.collect::<Vec<_>>()
    };
    bench.list(KNEE, list(1, &[("knee", true, &[])]));
    let knee = (Tid::new(KNEE, app(0)), "knee".to_owned());
    assert_eq!(names(&bench, None), std::slice::from_ref(&knee), "those of this node are known before");
    assert_eq!(names(&bench, Some(KNEE)), std::slice::from_ref(&knee));
    assert_eq!(names(&bench, Some(HERE)), []);
    // What it sent before it was lost still comes, its last wills too.
    bench.breaks(KNEE);
    bench.lost(KNEE, LossReason::Crashed);
    assert_eq!((bench.core.directory().len(), names(&bench, None)), (1, vec![knee]));
    bench.links(KNEE, LIFE);
    bench.list(KNEE, list(2, &[("drive", true, &[])]));
    assert_eq!(names(&bench, Some(KNEE)), [(Tid::new(KNEE, app(0)), "drive".to_owned())]);
    assert_eq!(Input::TimePassed.may_name(), Named::Nobody);
}

#[test]
fn only_what_changes_the_directory_has_it_read_anew() {
    // Given: the knee is linked and its list is known
    let mut bench = watched();
    bench.hears(Input::DirectoryWanted { app: app(9) });
    bench.links(KNEE, LIFE);
    let same = || list(1, &[("knee", true, &[])]);
    bench.list(KNEE, same());
    assert!(bench.core.take_directory_changed());
    // When
    bench.list(KNEE, same());
    bench.passes(REPEAT);
    bench.arrives("calibrated", 7);
    // Then
    assert!(!bench.core.take_directory_changed());
    // And what is known counts again after a break, so that it is read
    bench.breaks(KNEE);
    assert!(bench.core.take_directory_changed());
    bench.links(KNEE, LIFE);
    bench.core.take_directory_changed();
    assert!(bench.list(KNEE, same()).contains(&is("knee", KNEE, 0, true)));
    assert!(bench.core.take_directory_changed());
}

// spec: SYNC-6
#[test]
fn a_name_is_this_nodes_or_that_of_an_application_which_is_ready() {
    // Given: the knee is before the ankle, and its camera is not ready
    let mut bench = Bench::new();
    for (node, is_ready) in [(KNEE, false), (ANKLE, true)] {
        bench.links(node, LIFE);
        bench.list(node, list(1, &[("camera", is_ready, &[])]));
    }
    let [knee, ankle, hip] = [KNEE, ANKLE, HERE].map(|node| Tid::new(node, app(0)));
    assert_eq!(bench.registers(1, "gait", &["camera"]), [release(1)], "it is let go by the ankle's");
    assert_eq!(bench.core.called("camera"), [ankle, knee]);
    // When: this node has one, too
    bench.registers(0, "camera", &[]);
    // Then it is this node's, ready or not
    assert_eq!(bench.core.called("camera"), [hip, ankle, knee]);
}
