//! How nodes end: restarts that are too many, faults while a node stops, groups of faults at once.

use std::sync::{
    Arc,
    atomic::{AtomicU64, Ordering},
};

use sinew::{fault::Fault, node::NodeEnd, prelude::*};
use sinew_tests::{
    DEADLINE, Ground, all_run,
    puppet::{Job, Seen, Stage, desk, lives, outcome_of_job, send_jobs, wait_for_numbers},
    ready_for, until,
};

use crate::node_with_a_puppet_that_fails_at_each_job;

fn gave_up(node: Node) -> String {
    match node.wait_for_end() {
        NodeEnd::GaveUp(why) => why,
        NodeEnd::Stopped => panic!("it was not told to stop"),
    }
}

#[test]
fn as_many_restarts_as_are_allowed_are_survived_and_one_more_is_the_end() {
    let ((puppet, log), (desk, key)) = (Stage::new().app("puppet"), desk("desk"));
    // However long the restarts take.
    let node = Ground::new().node("node").configure(|config| {
        (config.supervision.app_restarts_max, config.supervision.app_window) = (2, 10 * DEADLINE);
    });
    let node = node.app(puppet).app(desk).start().expect("a node");
    all_run(&[&node]);
    let sender = key.sender();
    for life in 2..=3 {
        node.handle().inject("puppet", Fault::panic()).expect("it is there");
        log.wait_for(Seen::Started(life));
        assert_eq!(outcome_of_job(&sender, "puppet", life), Outcome::Delivered);
    }
    node.handle().inject("puppet", Fault::panic()).expect("it is there");
    let why = gave_up(node);
    assert!(why.starts_with("applications: more than 2 restarts"), "{why}");
    assert_eq!(lives(&log), 3);
}

#[test]
fn an_application_whose_device_is_absent_is_tried_again_uncounted_and_those_that_require_it_wait() {
    // Given: a drive that finds its device at the third start, and a reader whose factory finds its own at the second
    let drive = Stage::new().started(|puppet, context| {
        if puppet.life < 3 {
            context.fail_start("device /dev/ttyUSB0 is absent: plug it in");
        }
    });
    let (drive, log) = drive.app("drive");
    let tries = Arc::new(AtomicU64::new(0));
    let reader = AppSpec::try_new("reader", move || match tries.fetch_add(1, Ordering::Relaxed) {
        0 => Err("device /dev/ttyUSB1 is absent"),
        _ => Ok(Reader),
    });
    let (gait, seen) = Stage::new().app("gait");
    // When: no restart is allowed
    let node = Ground::new().node("node").configure(|config| config.supervision.app_restarts_max = 0);
    let gait = gait.requires(["drive", "reader"]);
    let node = node.app(drive).app(reader).app(gait).start().expect("a node");
    // Then
    all_run(&[&node]);
    assert_eq!(lives(&log), 3);
    assert!(seen.all().contains(&Seen::Started(1)));
    // A panic counts all the same.
    node.handle().inject("drive", Fault::panic()).expect("it is there");
    assert!(gave_up(node).starts_with("applications: more than 0 restarts"));
}

struct Reader;

impl Actor for Reader {
    type Context = AppContext<Self>;
}

#[test]
fn no_restart_allowed_means_that_the_first_fault_is_the_end() {
    let (puppet, log) = Stage::new().app("puppet");
    let node = Ground::new().node("node").configure(|config| config.supervision.layer_restarts_max = 0);
    let node = node.app(puppet).start().expect("a node");
    all_run(&[&node]);
    node.handle().inject("NDL", Fault::panic()).expect("every node has it");
    let why = gave_up(node);
    assert!(why.starts_with("layers: more than 0 restarts"), "{why}");
    assert!(log.all().contains(&Seen::Stopping(1)), "the applications were told");
}

#[test]
fn restarts_of_layers_and_of_applications_are_counted_apart() {
    let (puppet, log) = Stage::new().app("puppet");
    let node = Ground::new().node("node").configure(|config| {
        // Together they are more than either may have.
        (config.supervision.layer_restarts_max, config.supervision.app_restarts_max) = (5, 5);
    });
    let node = node.app(puppet).start().expect("a node");
    all_run(&[&node]);
    for life in 2..=4 {
        node.handle().inject("puppet", Fault::panic()).expect("it is there");
        node.handle().inject("NDL", Fault::panic()).expect("every node has it");
        log.wait_for(Seen::Started(life));
        ready_for(&node.handle(), "NDL", life);
    }
    assert_eq!(node.stop(), NodeEnd::Stopped);
}

#[test]
fn a_storm_of_panics_in_twenty_applications_loses_no_message_of_any() {
    let (desk, key) = desk("desk");
    let mut node = Ground::new().node("node").app(desk).configure(|config| {
        config.supervision.app_restarts_max = 1_000;
        config.supervision.app_window = Duration::from_millis(1);
    });
    let mut logs = Vec::new();
    for number in 0..20 {
        let stage = Stage::new().got(|puppet, _| assert!(!puppet.number.is_multiple_of(7), "a storm"));
        // Four share a thread: whoever panics there has neighbours.
        let name = format!("puppet {number}");
        let (app, log) = stage.app(&name);
        node = node.app(app.place(Place::thread(format!("thread {}", number % 5))));
        logs.push((name, log));
    }
    let node = node.start().expect("a node");
    all_run(&[&node]);
    let sender = key.sender();
    for number in 1..=28 {
        for (name, _) in &logs {
            send_jobs(&sender, name, [number]);
        }
    }
    for (name, log) in &logs {
        assert_eq!(wait_for_numbers(log, 28), (1..=28).collect::<Vec<_>>(), "{name}");
        log.wait_for(Seen::Started(5));
    }
    assert_eq!(node.stop(), NodeEnd::Stopped);
}

#[test]
fn a_panic_in_a_layer_while_the_node_stops_does_not_hold_it_up() {
    for layer in ["LNCL", "sync", "GNCL", "NDL"] {
        let stage = Stage::new().stopping(|puppet, _| {
            puppet.say("ramping down");
            Running::Stop
        });
        let (puppet, log) = stage.app("puppet");
        let node = Ground::new().node("node").app(puppet).start().expect("a node");
        all_run(&[&node]);
        let handle = node.handle();
        handle.stop();
        handle.inject(layer, Fault::panic()).expect("every node has it");
        assert_eq!(node.wait_for_end(), NodeEnd::Stopped, "{layer}");
        log.wait_for(Seen::Said(1, "ramping down"));
    }
}

#[test]
fn an_application_that_panics_while_it_ramps_down_is_not_started_again() {
    let stage = Stage::new().stopping(|puppet, context| {
        if puppet.number == 0 {
            puppet.number = 1;
            context.after(Duration::from_millis(1), |_, _, _| panic!("in the middle of the ramp"));
        }
        Running::Continue
    });
    let ((wild, log), (calm, other)) = (stage.app("wild"), Stage::new().app("calm"));
    let node = Ground::new().node("node").app(calm).app(wild).start().expect("a node");
    all_run(&[&node]);
    assert_eq!(node.stop(), NodeEnd::Stopped);
    assert_eq!(log.all(), [Seen::Made(1), Seen::Started(1), Seen::Stopping(1), Seen::Dropped(1)]);
    assert!(other.all().ends_with(&[Seen::Stopping(1), Seen::Dropped(1)]));
}

#[test]
fn an_application_that_never_ends_its_ramp_is_ended_when_its_time_is_over_and_the_others_have_theirs() {
    let ((stubborn, log), (calm, other)) =
        (Stage::new().stopping(|_, _| Running::Continue).app("stubborn"), Stage::new().app("calm"));
    let stubborn = stubborn.stop_within(Duration::from_millis(30));
    let node = Ground::new().node("node").app(calm).app(stubborn).start().expect("a node");
    all_run(&[&node]);
    assert_eq!(node.stop(), NodeEnd::Stopped);
    log.wait_for(Seen::Dropped(1));
    assert!(other.all().ends_with(&[Seen::Stopping(1), Seen::Dropped(1)]));
}

#[test]
fn a_node_that_is_told_to_stop_in_the_middle_of_restarts_stops() {
    let (node, log, sender) = node_with_a_puppet_that_fails_at_each_job();
    send_jobs(&sender, "puppet", 0..200);
    log.wait_for(Seen::Started(3));
    assert_eq!(node.stop(), NodeEnd::Stopped);
    let made = log.all().iter().filter(|seen| matches!(seen, Seen::Made(_))).count();
    let dropped = log.all().iter().filter(|seen| matches!(seen, Seen::Dropped(_))).count();
    assert_eq!(made, dropped, "nobody is left behind");
}

#[test]
fn a_start_that_fails_for_good_ends_in_the_words_of_the_layer() {
    let node = Ground::new().node("node");
    let node = (1..9).fold(node, |node, start| node.fault(format!("GNCL:panic@start({start})")));
    let words = node.start().expect_err("it cannot start").to_string();
    assert!(words.contains("layers did not start") && words.contains("its start"), "{words}");
}

#[test]
fn applications_start_behind_the_layers_and_end_before_them() {
    let (puppet, log) = Stage::new().app("puppet");
    // A layer's failed start takes the time that it takes: no application is made before.
    let node = Ground::new().node("node").app(puppet).fault("NDL:panic@start(1), NDL:slow(20ms)@start(2)");
    let node = node.start().expect("its second start succeeds");
    all_run(&[&node]);
    let ndl = node.handle().lives("NDL").expect("every node has it");
    let app = node.handle().lives("puppet").expect("it is there");
    assert!(ndl.ready < app.ready, "{ndl:?} {app:?}");
    assert_eq!(lives(&log), 1);
}

#[test]
fn a_fault_in_one_who_is_waited_for_keeps_the_waiting_one_at_the_barrier_until_it_is_over() {
    let stage = Stage::new().started(|puppet, _| assert!(puppet.life > 2, "not yet"));
    let ((sensor, at_sensor), (drive, at_drive)) = (stage.app("sensor"), Stage::new().app("drive"));
    let node =
        Ground::new().node("node").app(drive.requires(["sensor"])).app(sensor).start().expect("a node");
    all_run(&[&node]);
    assert_eq!(lives(&at_sensor), 3);
    assert_eq!(at_drive.all(), [Seen::Made(1), Seen::Started(1)], "it was let through once");
    let [sensor, drive] = ["sensor", "drive"].map(|name| node.handle().lives(name).expect("it is there"));
    assert!(sensor.ready < drive.ready, "and not before: {sensor:?} {drive:?}");
}

#[test]
fn a_chain_of_requirements_comes_up_in_order_whoever_fails_in_it() {
    let names = ["a", "b", "c", "d"];
    for failing in names {
        let mut node = Ground::new().node("node");
        for (index, name) in names.into_iter().enumerate().rev() {
            let requires = names[..index].last().copied();
            node = node.app(Stage::new().app(name).0.requires(requires));
        }
        let node = node.fault(format!("{failing}:panic@start(1)")).start().expect("a node");
        all_run(&[&node]);
        let ready =
            names.map(|name| node.handle().lives(name).and_then(|lives| lives.ready).expect("it is ready"));
        assert!(ready.is_sorted(), "with {failing}: {ready:?}");
    }
}

#[test]
fn a_dropped_node_ends_whatever_its_actors_do_meanwhile() {
    let stage = Stage::new().got(|_, _| panic!("each one")).dropped(|_| panic!("and once more"));
    let ((puppet, log), (desk, key)) = (stage.app("puppet"), desk("desk"));
    let node = Ground::new().node("node").app(puppet).app(desk).start().expect("a node");
    all_run(&[&node]);
    let sender = key.sender();
    let tid = sender.resolve("puppet").expect("it is there");
    send_jobs(&sender, "puppet", 0..3);
    drop(node);
    until("nobody takes messages any more", || sender.send(tid, &Job { number: 9 }).is_err().then_some(()));
    let count = |what: fn(&Seen) -> bool| log.all().iter().filter(|seen| what(seen)).count();
    let (made, dropped) =
        (|seen: &Seen| matches!(seen, Seen::Made(_)), |seen: &Seen| matches!(seen, Seen::Dropped(_)));
    // A life that was in the middle of a panic for longer than it had to stop may be dropped after its node.
    until("each life has come to its end", || (count(made) == count(dropped)).then_some(()));
}

#[test]
fn a_backlog_of_slow_messages_does_not_cost_an_application_its_orderly_stop() {
    let stage = Stage::new().got(|_, _| std::thread::sleep(Duration::from_millis(15))); // what makes it slow
    let ((puppet, log), (desk, key)) = (stage.app("puppet"), desk("desk"));
    let node = Ground::new().node("node").app(puppet).app(desk).start().expect("a node");
    all_run(&[&node]);
    send_jobs(&key.sender(), "puppet", 0..100);
    log.wait_for(Seen::Got(1, 1));
    assert_eq!(node.stop(), NodeEnd::Stopped);
    assert!(log.all().contains(&Seen::Stopping(1)), "its life was taken in the middle of the backlog");
}
