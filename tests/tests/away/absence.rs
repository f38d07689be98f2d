//! Messages for an application between its end and its next Ready: kept, rejected, or kept for a limited
//! time.

use std::{
    sync::{Arc, Mutex, mpsc::sync_channel},
    time::Duration,
};

use sinew::{
    message::{Confirmation, Rejection, Sender},
    prelude::*,
    supervision::ReadyGate,
};
use sinew_testkit::{
    DEADLINE, Log, Loopback, all_run,
    scripted::{Job, Script, ScriptedApp, Seen, SenderApp, numbers, outcome_of_job, sender_app, wait},
    until,
};

/// Reported by the first incarnation just before it ends while it handles the first message.
const IN_HAND: &str = "in hand";

/// A scripted application with two incarnations. The first ends at the first message, when the test permits
/// it. The second becomes ready when the test permits it.
struct Scene {
    log: Log<Seen>,
    may_die: std::sync::mpsc::SyncSender<()>,
    gate: Arc<Mutex<Option<ReadyGate>>>,
}

fn scene() -> (AppSpec<ScriptedApp>, Scene) {
    let (may_die, dies) = sync_channel(1);
    let (dies, gate) = (Mutex::new(dies), Arc::new(Mutex::new(None)));
    let held = gate.clone();
    let (spec, log) = Script::new()
        .started(move |scripted, context| {
            if scripted.incarnation == 2 {
                *held.lock().expect("nobody panics with it") = context.hold_ready();
                scripted.note("holds");
            }
        })
        .got(move |scripted, _| {
            if scripted.incarnation == 1 {
                scripted.note(IN_HAND);
                let let_go = dies.lock().expect("nobody panics with it").recv_timeout(DEADLINE);
                let_go.expect("the test lets it end");
                panic!("its end");
            }
        })
        .app("scripted");
    (spec, Scene { log, may_die, gate })
}

fn start(spec: AppSpec<ScriptedApp>) -> (Node, SenderApp) {
    let (sender_app, key) = sender_app("sender");
    let node = Loopback::new().node("node").app(spec).app(sender_app).start().expect("a node");
    all_run(&[&node]);
    (node, key)
}

fn confirmed(sender: &Sender, number: u64) -> Confirmation {
    sender.message("scripted", &Job { number }).confirmed(DEADLINE).expect("it has room")
}

impl Scene {
    /// Sends one message that is handled and two that wait; then the application ends.
    fn die(&self, sender: &Sender) -> [Confirmation; 3] {
        let first = confirmed(sender, 1);
        self.log.wait_for(Seen::Note(1, IN_HAND));
        let rest = [2, 3].map(|number| confirmed(sender, number));
        self.may_die.send(()).expect("it waits");
        self.log.wait_for(Seen::Note(2, "holds"));
        let [second, third] = rest;
        [first, second, third]
    }

    fn become_ready(&self) {
        self.gate.lock().expect("nobody panics with it").take().expect("it holds").reached();
    }
}

#[test]
fn drop_policy_rejects_messages_until_ready() {
    let (spec, scene) = scene();
    let (_node, key) = start(spec.while_down(DownPolicy::Drop));
    let sender = key.sender();
    // When: it ends while it handles one message and two wait
    let outcomes = scene.die(&sender).map(wait);
    let away = Outcome::Rejected(Rejection::Down);
    assert_eq!(outcomes, [Outcome::Failed, away, away]);
    // Then: while the new incarnation is not ready, messages are rejected and the sender is notified at once
    let refused = sender.send("scripted", &Job { number: 4 }).expect_err("it is away");
    assert_eq!(refused, sinew::message::SendError::Rejected(Rejection::Down));
    // And: once it is ready, messages are delivered as before.
    scene.become_ready();
    let sent = until("it takes messages again", || {
        sender.message("scripted", &Job { number: 5 }).confirmed(DEADLINE).ok().map(wait)
    });
    assert_eq!(sent, Outcome::Delivered);
    assert_eq!(numbers(&scene.log.all()), [1, 5]);
}

#[test]
fn hold_policy_keeps_messages_in_order() {
    let (spec, scene) = scene();
    let (_node, key) = start(spec);
    let sender = key.sender();
    let [first, second, third] = scene.die(&sender);
    scene.become_ready();
    assert_eq!(outcome_of_job(&sender, "scripted", 4), Outcome::Delivered);
    assert_eq!([first, second, third].map(wait), [Outcome::Failed, Outcome::Delivered, Outcome::Delivered]);
    assert_eq!(numbers(&scene.log.all()), [1, 2, 3, 4]);
}

#[test]
fn hold_for_policy_rejects_after_its_time() {
    // Given: an application that is down for long, because its requirement ends with it and does not return
    let gate = Arc::new(Mutex::new(None));
    let held = gate.clone();
    let (anchor, anchor_log) = Script::new()
        .started(move |scripted, context| {
            if scripted.incarnation == 2 {
                *held.lock().expect("nobody panics with it") = context.hold_ready();
                scripted.note("holds");
            }
        })
        .got(|_, _| panic!("its end"))
        .app("anchor");
    let (scripted, log) =
        Script::new().got(|scripted, _| assert!(scripted.number != 13, "its end")).app("scripted");
    let scripted = scripted.requires(["anchor"]).while_down(DownPolicy::HoldFor(Duration::from_millis(50)));
    let (sender_app, key) = sender_app("sender");
    let node =
        Loopback::new().node("node").app(scripted).app(anchor).app(sender_app).start().expect("a node");
    all_run(&[&node]);
    let sender = key.sender();
    // When
    sender.send("anchor", &Job { number: 1 }).expect("it has room");
    anchor_log.wait_for(Seen::Note(2, "holds"));
    assert_eq!(outcome_of_job(&sender, "scripted", 13), Outcome::Failed);
    let kept = confirmed(&sender, 1);
    // Then: it is kept for a while, and rejected when that time is over
    assert_eq!(wait(kept), Outcome::Rejected(Rejection::Down));
    assert!(sender.send("scripted", &Job { number: 2 }).is_err());
    gate.lock().expect("nobody panics with it").take().expect("it holds").reached();
    log.wait_for(Seen::Started(2));
    let sent = until("it takes messages again", || {
        sender.message("scripted", &Job { number: 3 }).confirmed(DEADLINE).ok().map(wait)
    });
    assert_eq!(sent, Outcome::Delivered);
    assert_eq!(numbers(&log.all()), [13, 3]);
}
