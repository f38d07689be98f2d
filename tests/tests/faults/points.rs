//! The fault points themselves: planned in code, injected at run time, in applications and in layers.

use std::time::Duration;

use sinew::{fault::Fault, prelude::*};
use sinew_tests::{
    Ground, all_run,
    puppet::{Job, Seen, Stage, desk, numbers, outcome_of_job},
    until,
};

use crate::fault;

#[test]
fn a_planned_panic_strikes_the_nth_message_and_fails_it() {
    let ((puppet, log), (desk, key)) = (Stage::new().app("puppet"), desk("desk"));
    let node = Ground::new().node("node").app(puppet.fault(Fault::panic().at_event(2))).app(desk);
    let node = node.start().expect("a node");
    all_run(&[&node]);
    let sender = key.sender();
    let outcomes: Vec<_> = (1..=3).map(|number| outcome_of_job(&sender, "puppet", number)).collect();
    assert_eq!(outcomes, [Outcome::Delivered, Outcome::Failed, Outcome::Delivered]);
    let got: Vec<_> = log.all().into_iter().filter(|seen| matches!(seen, Seen::Got(..))).collect();
    assert_eq!(got, [Seen::Got(1, 1), Seen::Got(2, 3)], "the second message never reached a handler");
}

#[test]
fn a_plan_of_words_strikes_applications_and_layers_of_its_node() {
    let ((puppet, log), (desk, key)) = (Stage::new().app("puppet"), desk("desk"));
    let node = Ground::new().node("node").app(puppet).app(desk).fault("puppet:stop@1, sync:panic@start(1)");
    let node = node.start().expect("the sync manager's second start succeeds");
    all_run(&[&node]);
    assert_eq!(outcome_of_job(&key.sender(), "puppet", 1), Outcome::Delivered, "it stops behind the message");
    log.wait_for(Seen::Started(2));
    assert!(log.all().contains(&Seen::Stopping(1)), "in order");
}

#[test]
fn a_plan_that_nobody_can_follow_fails_the_start_in_words() {
    for (plan, teaches) in
        [("knee:panic@1", "the applications puppet"), ("NDL:explode", "`explode` is nothing that can happen")]
    {
        let (puppet, _log) = Stage::new().app("puppet");
        let error = Ground::new().node("node").app(puppet).fault(plan).start().expect_err("it is wrong");
        assert!(error.to_string().contains(teaches), "{error}");
    }
}

#[test]
fn an_injected_fault_wakes_an_idle_application() {
    let (puppet, log) = Stage::new().app("puppet");
    let node = Ground::new().node("node").app(puppet).start().expect("a node");
    all_run(&[&node]);
    node.handle().inject("puppet", Fault::panic()).expect("it is there");
    log.wait_for(Seen::Started(2));
    assert!(!log.all().contains(&Seen::Stopping(1)), "a panic is no orderly stop");
    let error = node.handle().inject("pupet", Fault::panic()).expect_err("nobody is called that");
    assert!(error.to_string().contains("puppet"), "{error}");
}

#[test]
fn a_slow_application_handles_every_message_once() {
    let ((puppet, log), (desk, key)) = (Stage::new().app("puppet"), desk("desk"));
    let node = Ground::new().node("node").app(puppet.fault(fault("slow(2ms)@3..6"))).app(desk);
    let node = node.start().expect("a node");
    all_run(&[&node]);
    let sender = key.sender();
    for number in 1..=10 {
        sender.send("puppet", &Job { number }).expect("it has room");
    }
    let all = log.wait("ten jobs", |seen| (numbers(seen).len() == 10).then(|| numbers(seen)));
    assert_eq!(all, (1..=10).collect::<Vec<_>>());
}

#[test]
fn an_injected_fault_strikes_each_layer_and_the_application_lives_on() {
    let ((puppet, log), (desk, key)) = (Stage::new().app("puppet"), desk("desk"));
    let node = Ground::new().node("node").app(puppet).app(desk).start().expect("a node");
    all_run(&[&node]);
    let (sender, handle) = (key.sender(), node.handle());
    for (number, layer) in [(1, "LNCL"), (2, "sync"), (3, "GNCL"), (4, "NDL")] {
        let before = handle.lives(layer).expect("every node has it").readies;
        handle.inject(layer, Fault::panic()).expect("every node has it");
        assert_eq!(outcome_of_job(&sender, "puppet", number), Outcome::Delivered);
        until("the layer is ready again", || (handle.lives(layer)?.readies > before).then_some(()));
    }
    assert!(log.all().iter().all(|seen| !matches!(seen, Seen::Made(2) | Seen::Dropped(_))));
    drop(node);
    log.wait_for(Seen::Stopping(1));
}

#[test]
fn a_hang_ends_and_what_waited_is_handled() {
    let ((puppet, log), (desk, key)) = (Stage::new().app("puppet"), desk("desk"));
    let hang = Fault::hang(Duration::from_millis(20)).at_event(1);
    let node = Ground::new().node("node").app(puppet.fault(hang)).app(desk).start().expect("a node");
    all_run(&[&node]);
    let sender = key.sender();
    for number in 1..=3 {
        sender.send("puppet", &Job { number }).expect("it has room");
    }
    log.wait_for(Seen::Got(1, 3));
}

#[test]
fn the_tree_says_who_failed_how_often_and_why() {
    let (puppet, log) = Stage::new().app("puppet");
    let node = Ground::new().node("node").app(puppet).start().expect("a node");
    all_run(&[&node]);
    let handle = node.handle();
    for life in 2..=3 {
        handle.inject("puppet", Fault::panic()).expect("it is there");
        log.wait_for(Seen::Started(life));
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
        until(&format!("the tree shows {name} in life {generation} for `{words}`"), || {
            let (life, again, reason) = of(name);
            let said = reason.is_some_and(|reason| reason.to_string().contains(words));
            (life == generation && again == restarts && said).then_some(())
        });
    };
    is("puppet", 3, 2, "a fault was planned");
    is("GNCL", 2, 1, "a fault was planned");
    is("NDL", 2, 1, "told to stop");
    assert_eq!(of("LNCL"), (1, 0, None), "those before it are left alone");
}
