//! The fault points themselves: planned in code, injected at run time, in applications and in layers.

use std::time::Duration;

use sinew::{fault::Fault, prelude::*};
use sinew_testkit::{
    Loopback, all_run,
    scripted::{Job, Script, Seen, numbers, outcome_of_job, sender_app},
    until,
};

use super::{fault, perform};

#[test]
fn planned_panic_strikes_the_nth_message() {
    let (node, sender, log) = perform(Script::new(), |app| app.fault(Fault::panic().at_event(2)));
    all_run(&[&node]);
    let outcomes: Vec<_> = (1..=3).map(|number| outcome_of_job(&sender, "scripted", number)).collect();
    assert_eq!(outcomes, [Outcome::Delivered, Outcome::Failed, Outcome::Delivered]);
    let got: Vec<_> = log.all().into_iter().filter(|seen| matches!(seen, Seen::Got(..))).collect();
    assert_eq!(got, [Seen::Got(1, 1), Seen::Got(2, 3)], "the second message never reached a handler");
}

#[test]
fn text_plan_strikes_applications_and_layers() {
    let ((scripted, log), (sender_app, key)) = (Script::new().app("scripted"), sender_app("sender"));
    let node = Loopback::new()
        .node("node")
        .app(scripted)
        .app(sender_app)
        .fault("scripted:stop@1, sync:panic@start(1)");
    let node = node.start().expect("the sync manager's second start succeeds");
    all_run(&[&node]);
    assert_eq!(
        outcome_of_job(&key.sender(), "scripted", 1),
        Outcome::Delivered,
        "it stops behind the message"
    );
    log.wait_for(Seen::Started(2));
    assert!(log.all().contains(&Seen::Stopping(1)), "in order");
}

#[test]
fn unknown_plan_target_fails_the_start_with_reason() {
    for (plan, teaches) in [
        ("knee:panic@1", "the applications scripted"),
        ("NDL:explode", "`explode` is nothing that can happen"),
    ] {
        let (scripted, _log) = Script::new().app("scripted");
        let error = Loopback::new().node("node").app(scripted).fault(plan).start().expect_err("it is wrong");
        assert!(error.to_string().contains(teaches), "{error}");
    }
}

#[test]
fn injected_fault_wakes_an_idle_application() {
    let (scripted, log) = Script::new().app("scripted");
    let node = Loopback::new().node("node").app(scripted).start().expect("a node");
    all_run(&[&node]);
    node.handle().inject("scripted", Fault::panic()).expect("it is there");
    log.wait_for(Seen::Started(2));
    assert!(!log.all().contains(&Seen::Stopping(1)), "a panic is no orderly stop");
    let error = node.handle().inject("pupet", Fault::panic()).expect_err("nobody is called that");
    assert!(error.to_string().contains("scripted"), "{error}");
}

#[test]
fn slow_application_handles_every_message_once() {
    let (node, sender, log) = perform(Script::new(), |app| app.fault(fault("slow(2ms)@3..6")));
    all_run(&[&node]);
    for number in 1..=10 {
        sender.send("scripted", &Job { number }).expect("it has room");
    }
    let all = log.wait("ten jobs", |seen| (numbers(seen).len() == 10).then(|| numbers(seen)));
    assert_eq!(all, (1..=10).collect::<Vec<_>>());
}

#[test]
fn injected_fault_restarts_a_layer_but_no_application() {
    let (node, sender, log) = perform(Script::new(), |app| app);
    all_run(&[&node]);
    let handle = node.handle();
    for (number, layer) in [(1, "LNCL"), (2, "sync"), (3, "GNCL"), (4, "NDL")] {
        let before = handle.lives(layer).expect("every node has it").readies;
        handle.inject(layer, Fault::panic()).expect("every node has it");
        assert_eq!(outcome_of_job(&sender, "scripted", number), Outcome::Delivered);
        until("the layer is ready again", || (handle.lives(layer)?.readies > before).then_some(()));
    }
    assert!(log.all().iter().all(|seen| !matches!(seen, Seen::Made(2) | Seen::Dropped(_))));
    drop(node);
    log.wait_for(Seen::Stopping(1));
}

#[test]
fn queued_messages_are_handled_after_a_hang() {
    let hang = Fault::hang(Duration::from_millis(20)).at_event(1);
    let (node, sender, log) = perform(Script::new(), |app| app.fault(hang));
    all_run(&[&node]);
    for number in 1..=3 {
        sender.send("scripted", &Job { number }).expect("it has room");
    }
    log.wait_for(Seen::Got(1, 3));
}

#[test]
fn tree_shows_failures_with_count_and_reason() {
    let (scripted, log) = Script::new().app("scripted");
    let node = Loopback::new().node("node").app(scripted).start().expect("a node");
    all_run(&[&node]);
    let handle = node.handle();
    for incarnation in 2..=3 {
        handle.inject("scripted", Fault::panic()).expect("it is there");
        log.wait_for(Seen::Started(incarnation));
    }
    handle.inject("GNCL", Fault::panic()).expect("every node has it");
    let of = |name: &str| {
        let tree = handle.tree().expect("it runs");
        let supervisors = tree.supervisors.into_iter().filter_map(|supervisor| supervisor.supervises);
        let child = supervisors.flat_map(|below| below.children).find(|child| child.name == name);
        let child = child.expect("it is supervised");
        (child.generation, child.restarts, child.last_reason)
    };
    let is = |name: &str, generation: u64, restarts: u64, words: &str| {
        until(&format!("the tree shows {name} in incarnation {generation} for `{words}`"), || {
            let (incarnation, again, reason) = of(name);
            let is_reason = reason.is_some_and(|reason| reason.to_string().contains(words));
            (incarnation == generation && again == restarts && is_reason).then_some(())
        });
    };
    is("scripted", 3, 2, "a fault was planned");
    is("GNCL", 2, 1, "a fault was planned");
    is("NDL", 2, 1, "told to stop");
    assert_eq!(of("LNCL"), (1, 0, None), "those before it are left alone");
}
