//! Messages for an application between its end and its next Ready: kept, refused, or kept for a while.

use std::{
    sync::{Arc, Mutex, mpsc::sync_channel},
    time::Duration,
};

use sinew::{
    message::{Confirmation, Rejection, Sender},
    prelude::*,
    supervision::ReadyGate,
};
use sinew_tests::{
    DEADLINE, Ground, Log, all_run,
    puppet::{DeskKey, Job, Puppet, Seen, Stage, desk, numbers, outcome_of_job, wait},
    until,
};

/// Said by its first life when it is about to end with the first message in its hand.
const IN_HAND: &str = "in hand";

/// A puppet whose first life ends at the first message, once it may, and whose second life is ready once it may be.
struct Scene {
    log: Log<Seen>,
    may_die: std::sync::mpsc::SyncSender<()>,
    gate: Arc<Mutex<Option<ReadyGate>>>,
}

fn scene() -> (AppSpec<Puppet>, Scene) {
    let (may_die, dies) = sync_channel(1);
    let (dies, gate) = (Mutex::new(dies), Arc::new(Mutex::new(None)));
    let held = gate.clone();
    let (spec, log) = Stage::new()
        .started(move |puppet, context| {
            if puppet.life == 2 {
                *held.lock().expect("nobody panics with it") = context.hold_ready();
                puppet.say("holds");
            }
        })
        .got(move |puppet, _| {
            if puppet.life == 1 {
                puppet.say(IN_HAND);
                let let_go = dies.lock().expect("nobody panics with it").recv_timeout(DEADLINE);
                let_go.expect("the test lets it end");
                panic!("its end");
            }
        })
        .app("puppet");
    (spec, Scene { log, may_die, gate })
}

fn start(spec: AppSpec<Puppet>) -> (Node, DeskKey) {
    let (desk, key) = desk("desk");
    let node = Ground::new().node("node").app(spec).app(desk).start().expect("a node");
    all_run(&[&node]);
    (node, key)
}

fn confirmed(sender: &Sender, number: u64) -> Confirmation {
    sender.message("puppet", &Job { number }).confirmed(DEADLINE).expect("it has room")
}

impl Scene {
    /// One message in its hand, two that wait; then it ends.
    fn die(&self, sender: &Sender) -> [Confirmation; 3] {
        let first = confirmed(sender, 1);
        self.log.wait_for(Seen::Said(1, IN_HAND));
        let rest = [2, 3].map(|number| confirmed(sender, number));
        self.may_die.send(()).expect("it waits");
        self.log.wait_for(Seen::Said(2, "holds"));
        let [second, third] = rest;
        [first, second, third]
    }

    fn become_ready(&self) {
        self.gate.lock().expect("nobody panics with it").take().expect("it holds").reached();
    }
}

#[test]
fn an_application_that_drops_while_away_refuses_what_waits_and_what_comes_until_it_is_ready_again() {
    let (spec, scene) = scene();
    let (_node, key) = start(spec.while_down(DownPolicy::Drop));
    let sender = key.sender();
    // When it ends with one message in its hand and two behind it
    let outcomes = scene.die(&sender).map(wait);
    let away = Outcome::Rejected(Rejection::Down);
    assert_eq!(outcomes, [Outcome::Failed, away, away]);
    // Then, while the new life is not ready, nobody takes a message, and its sender is told at once
    let refused = sender.send("puppet", &Job { number: 4 }).expect_err("it is away");
    assert_eq!(refused, sinew::message::SendError::Rejected(Rejection::Down));
    // And when it is ready, it is as before.
    scene.become_ready();
    let sent = until("it takes messages again", || {
        sender.message("puppet", &Job { number: 5 }).confirmed(DEADLINE).ok().map(wait)
    });
    assert_eq!(sent, Outcome::Delivered);
    assert_eq!(numbers(&scene.log.all()), [1, 5]);
}

#[test]
fn an_application_that_holds_while_away_handles_what_came_meanwhile_in_order() {
    let (spec, scene) = scene();
    let (_node, key) = start(spec);
    let sender = key.sender();
    let [first, second, third] = scene.die(&sender);
    scene.become_ready();
    assert_eq!(outcome_of_job(&sender, "puppet", 4), Outcome::Delivered);
    assert_eq!([first, second, third].map(wait), [Outcome::Failed, Outcome::Delivered, Outcome::Delivered]);
    assert_eq!(numbers(&scene.log.all()), [1, 2, 3, 4]);
}

#[test]
fn an_application_that_holds_for_a_time_refuses_from_then_on() {
    // Given: an application that is away for long, because what it requires ends with it and stays away
    let gate = Arc::new(Mutex::new(None));
    let held = gate.clone();
    let (anchor, anchor_log) = Stage::new()
        .started(move |puppet, context| {
            if puppet.life == 2 {
                *held.lock().expect("nobody panics with it") = context.hold_ready();
                puppet.say("holds");
            }
        })
        .got(|_, _| panic!("its end"))
        .app("anchor");
    let (puppet, log) = Stage::new().got(|puppet, _| assert!(puppet.number != 13, "its end")).app("puppet");
    let puppet = puppet.requires(["anchor"]).while_down(DownPolicy::HoldFor(Duration::from_millis(50)));
    let (desk, key) = desk("desk");
    let node = Ground::new().node("node").app(puppet).app(anchor).app(desk).start().expect("a node");
    all_run(&[&node]);
    let sender = key.sender();
    // When
    sender.send("anchor", &Job { number: 1 }).expect("it has room");
    anchor_log.wait_for(Seen::Said(2, "holds"));
    assert_eq!(outcome_of_job(&sender, "puppet", 13), Outcome::Failed);
    let kept = confirmed(&sender, 1);
    // Then: it is kept for a while and refused when that is over
    assert_eq!(wait(kept), Outcome::Rejected(Rejection::Down));
    assert!(sender.send("puppet", &Job { number: 2 }).is_err());
    gate.lock().expect("nobody panics with it").take().expect("it holds").reached();
    log.wait_for(Seen::Started(2));
    let sent = until("it takes messages again", || {
        sender.message("puppet", &Job { number: 3 }).confirmed(DEADLINE).ok().map(wait)
    });
    assert_eq!(sent, Outcome::Delivered);
    assert_eq!(numbers(&log.all()), [13, 3]);
}
