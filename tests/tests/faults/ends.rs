//! The ways in which nodes end: too many restarts, faults while a node stops, many faults at once.

use std::sync::{
    Arc,
    atomic::{AtomicU64, Ordering},
};

use sinew::{fault::Fault, node::NodeEnd, prelude::*};
use sinew_testkit::{
    DEADLINE, Loopback, all_run, ready_for,
    scripted::{Job, Script, Seen, incarnations, outcome_of_job, send_jobs, sender_app, wait_for_numbers},
    until,
};

use super::{node_that_fails_at_each_job, perform};

fn gave_up(node: Node) -> String {
    match node.wait_for_end() {
        NodeEnd::GaveUp(why) => why,
        NodeEnd::Stopped => panic!("it was not asked to stop"),
    }
}

#[test]
fn one_restart_beyond_the_limit_is_the_end() {
    let ((scripted, log), (sender_app, key)) = (Script::new().app("scripted"), sender_app("sender"));
    // However long the restarts take.
    let node = Loopback::new().node("node").configure(|config| {
        (config.supervision.app_restarts_max, config.supervision.app_window) = (2, 10 * DEADLINE);
    });
    let node = node.app(scripted).app(sender_app).start().expect("a node");
    all_run(&[&node]);
    let sender = key.sender();
    for incarnation in 2..=3 {
        node.handle().inject("scripted", Fault::panic()).expect("it is there");
        log.wait_for(Seen::Started(incarnation));
        assert_eq!(outcome_of_job(&sender, "scripted", incarnation), Outcome::Delivered);
    }
    node.handle().inject("scripted", Fault::panic()).expect("it is there");
    let why = gave_up(node);
    assert!(why.starts_with("applications: more than 2 restarts"), "{why}");
    assert_eq!(incarnations(&log), 3);
}

#[test]
fn absent_device_is_retried_uncounted() {
    // Given: a drive that finds its device at the third start, and a reader with a factory that finds its
    // device at the second
    let drive = Script::new().started(|scripted, context| {
        if scripted.incarnation < 3 {
            context.fail_start("device /dev/ttyUSB0 is absent: plug it in");
        }
    });
    let (drive, log) = drive.app("drive");
    let tries = Arc::new(AtomicU64::new(0));
    let reader = AppSpec::try_new("reader", move || match tries.fetch_add(1, Ordering::Relaxed) {
        0 => Err("device /dev/ttyUSB1 is absent"),
        _ => Ok(Reader),
    });
    let (gait, seen) = Script::new().app("gait");
    // When: no restart is allowed
    let node = Loopback::new().node("node").configure(|config| config.supervision.app_restarts_max = 0);
    let gait = gait.requires(["drive", "reader"]);
    let node = node.app(drive).app(reader).app(gait).start().expect("a node");
    // Then
    all_run(&[&node]);
    assert_eq!(incarnations(&log), 3);
    assert!(seen.all().contains(&Seen::Started(1)));
    // A panic is counted all the same.
    node.handle().inject("drive", Fault::panic()).expect("it is there");
    assert!(gave_up(node).starts_with("applications: more than 0 restarts"));
}

struct Reader;

impl Actor for Reader {
    type Context = AppContext<Self>;
}

#[test]
fn first_fault_ends_node_without_allowed_restarts() {
    let (scripted, log) = Script::new().app("scripted");
    let node = Loopback::new().node("node").configure(|config| config.supervision.layer_restarts_max = 0);
    let node = node.app(scripted).start().expect("a node");
    all_run(&[&node]);
    node.handle().inject("NDL", Fault::panic()).expect("every node has it");
    let why = gave_up(node);
    assert!(why.starts_with("layers: more than 0 restarts"), "{why}");
    assert!(log.all().contains(&Seen::Stopping(1)), "the applications were stopped");
}

#[test]
fn layer_and_application_restarts_are_counted_apart() {
    let (scripted, log) = Script::new().app("scripted");
    let node = Loopback::new().node("node").configure(|config| {
        // Their sum is more than either limit.
        (config.supervision.layer_restarts_max, config.supervision.app_restarts_max) = (5, 5);
    });
    let node = node.app(scripted).start().expect("a node");
    all_run(&[&node]);
    for incarnation in 2..=4 {
        node.handle().inject("scripted", Fault::panic()).expect("it is there");
        node.handle().inject("NDL", Fault::panic()).expect("every node has it");
        log.wait_for(Seen::Started(incarnation));
        ready_for(&node.handle(), "NDL", incarnation);
    }
    assert_eq!(node.stop(), NodeEnd::Stopped);
}

#[test]
fn panic_storm_in_twenty_applications_loses_no_message() {
    let (sender_app, key) = sender_app("sender");
    let mut node = Loopback::new().node("node").app(sender_app).configure(|config| {
        config.supervision.app_restarts_max = 1_000;
        config.supervision.app_window = Duration::from_millis(1);
    });
    let mut logs = Vec::new();
    for number in 0..20 {
        let script = Script::new().got(|scripted, _| assert!(!scripted.number.is_multiple_of(7), "a storm"));
        // Four share a thread, so each panic has neighbours on the thread.
        let name = format!("scripted {number}");
        let (app, log) = script.app(&name);
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
fn layer_panic_does_not_delay_node_stop() {
    for layer in ["LNCL", "sync", "GNCL", "NDL"] {
        let script = Script::new().stopping(|scripted, _| {
            scripted.note("ramping down");
            Running::Stop
        });
        let (scripted, log) = script.app("scripted");
        let node = Loopback::new().node("node").app(scripted).start().expect("a node");
        all_run(&[&node]);
        let handle = node.handle();
        handle.stop();
        handle.inject(layer, Fault::panic()).expect("every node has it");
        assert_eq!(node.wait_for_end(), NodeEnd::Stopped, "{layer}");
        log.wait_for(Seen::Note(1, "ramping down"));
    }
}

#[test]
fn panic_while_ramping_down_is_not_restarted() {
    let script = Script::new().stopping(|scripted, context| {
        if scripted.number == 0 {
            scripted.number = 1;
            context.after(Duration::from_millis(1), |_, _, _| panic!("in the middle of the ramp"));
        }
        Running::Continue
    });
    let ((wild, log), (calm, other)) = (script.app("wild"), Script::new().app("calm"));
    let node = Loopback::new().node("node").app(calm).app(wild).start().expect("a node");
    all_run(&[&node]);
    assert_eq!(node.stop(), NodeEnd::Stopped);
    assert_eq!(log.all(), [Seen::Made(1), Seen::Started(1), Seen::Stopping(1), Seen::Dropped(1)]);
    assert!(other.all().ends_with(&[Seen::Stopping(1), Seen::Dropped(1)]));
}

#[test]
fn endless_ramp_ends_at_its_own_limit() {
    let ((stubborn, log), (calm, other)) =
        (Script::new().stopping(|_, _| Running::Continue).app("stubborn"), Script::new().app("calm"));
    let stubborn = stubborn.stop_within(Duration::from_millis(30));
    let node = Loopback::new().node("node").app(calm).app(stubborn).start().expect("a node");
    all_run(&[&node]);
    assert_eq!(node.stop(), NodeEnd::Stopped);
    log.wait_for(Seen::Dropped(1));
    assert!(other.all().ends_with(&[Seen::Stopping(1), Seen::Dropped(1)]));
}

#[test]
fn stop_order_during_restarts_stops_the_node() {
    let (node, log, sender) = node_that_fails_at_each_job();
    send_jobs(&sender, "scripted", 0..200);
    log.wait_for(Seen::Started(3));
    assert_eq!(node.stop(), NodeEnd::Stopped);
    let made = log.all().iter().filter(|seen| matches!(seen, Seen::Made(_))).count();
    let dropped = log.all().iter().filter(|seen| matches!(seen, Seen::Dropped(_))).count();
    assert_eq!(made, dropped, "nobody is left behind");
}

#[test]
fn permanent_start_failure_reports_the_layers_message() {
    let node = Loopback::new().node("node");
    let node = (1..9).fold(node, |node, start| node.fault(format!("GNCL:panic@start({start})")));
    let words = node.start().expect_err("it cannot start").to_string();
    assert!(words.contains("layers did not start") && words.contains("its start"), "{words}");
}

#[test]
fn applications_start_after_layers_and_end_before_them() {
    let (scripted, log) = Script::new().app("scripted");
    // A layer's failed start takes its time: no application is created before.
    let node =
        Loopback::new().node("node").app(scripted).fault("NDL:panic@start(1), NDL:slow(20ms)@start(2)");
    let node = node.start().expect("its second start succeeds");
    all_run(&[&node]);
    let ndl = node.handle().lives("NDL").expect("every node has it");
    let app = node.handle().lives("scripted").expect("it is there");
    assert!(ndl.ready < app.ready, "{ndl:?} {app:?}");
    assert_eq!(incarnations(&log), 1);
}

#[test]
fn faulty_requirement_holds_dependent_at_the_barrier() {
    let script = Script::new().started(|scripted, _| assert!(scripted.incarnation > 2, "not yet"));
    let ((sensor, at_sensor), (drive, at_drive)) = (script.app("sensor"), Script::new().app("drive"));
    let node =
        Loopback::new().node("node").app(drive.requires(["sensor"])).app(sensor).start().expect("a node");
    all_run(&[&node]);
    assert_eq!(incarnations(&at_sensor), 3);
    assert_eq!(at_drive.all(), [Seen::Made(1), Seen::Started(1)], "it was let through once");
    let [sensor, drive] = ["sensor", "drive"].map(|name| node.handle().lives(name).expect("it is there"));
    assert!(sensor.ready < drive.ready, "and not before: {sensor:?} {drive:?}");
}

#[test]
fn requirement_chain_starts_in_order_despite_faults() {
    let names = ["a", "b", "c", "d"];
    for failing in names {
        let mut node = Loopback::new().node("node");
        for (index, name) in names.into_iter().enumerate().rev() {
            let requires = names[..index].last().copied();
            node = node.app(Script::new().app(name).0.requires(requires));
        }
        let node = node.fault(format!("{failing}:panic@start(1)")).start().expect("a node");
        all_run(&[&node]);
        let ready =
            names.map(|name| node.handle().lives(name).and_then(|lives| lives.ready).expect("it is ready"));
        assert!(ready.is_sorted(), "with {failing}: {ready:?}");
    }
}

#[test]
fn dropped_node_ends_despite_failing_actors() {
    let script = Script::new().got(|_, _| panic!("each one")).dropped(|_| panic!("and once more"));
    let (node, sender, log) = perform(script, |app| app);
    all_run(&[&node]);
    let tid = sender.resolve("scripted").expect("it is there");
    send_jobs(&sender, "scripted", 0..3);
    drop(node);
    until("nobody takes messages any more", || sender.send(tid, &Job { number: 9 }).is_err().then_some(()));
    let count = |what: fn(&Seen) -> bool| log.all().iter().filter(|seen| what(seen)).count();
    let (made, dropped) =
        (|seen: &Seen| matches!(seen, Seen::Made(_)), |seen: &Seen| matches!(seen, Seen::Dropped(_)));
    // An incarnation that was panicking for longer than its stop limit may be dropped after its node.
    until("each incarnation has come to its end", || (count(made) == count(dropped)).then_some(()));
}

#[test]
fn backlog_of_slow_messages_does_not_prevent_clean_stop() {
    let script = Script::new().got(|_, _| std::thread::sleep(Duration::from_millis(15))); // makes it slow
    let (node, sender, log) = perform(script, |app| app);
    all_run(&[&node]);
    send_jobs(&sender, "scripted", 0..100);
    log.wait_for(Seen::Got(1, 1));
    assert_eq!(node.stop(), NodeEnd::Stopped);
    assert!(log.all().contains(&Seen::Stopping(1)), "it was killed in the middle of the backlog");
}
