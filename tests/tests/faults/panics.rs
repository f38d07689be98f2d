//! Panics in every place of an application's code.

use std::{
    panic::panic_any,
    sync::{Arc, Mutex},
};

use sinew::{
    fault::Fault,
    message::{Rejection, SendError},
    prelude::*,
};
use sinew_runtime::event_queue::EventQueue;
use sinew_testkit::{
    DEADLINE, Loopback, all_run,
    scripted::{
        Job, Order, Script, Seen, incarnations, numbers, outcome_of_job, send_jobs, sender_app, wait,
        wait_for_numbers,
    },
    until,
};

use super::perform;

#[test]
fn poison_message_fails_once_and_is_not_redelivered() {
    let script = Script::new().got(|scripted, _| assert!(scripted.number != 13, "thirteen"));
    let (_node, sender, log) = perform(script, |app| app);
    assert_eq!(outcome_of_job(&sender, "scripted", 13), Outcome::Failed);
    assert_eq!(outcome_of_job(&sender, "scripted", 14), Outcome::Delivered);
    assert_eq!(numbers(&log.all()), [13, 14]);
    assert!(log.all().contains(&Seen::Got(2, 14)), "by a new incarnation behind the same TID");
}

#[test]
fn request_of_panicking_handler_fails_and_next_is_answered() {
    let script = Script::new().got(|scripted, _| assert!(scripted.number != 13, "thirteen"));
    let (_node, sender, _log) = perform(script, |app| app);
    let ask = |number| {
        wait(sender.message("scripted", &Order { number }).ask::<Order>(DEADLINE).expect("it is sent"))
    };
    let words = ask(13).expect_err("it failed").to_string();
    assert!(words.contains("panicked") || words.contains("Failed"), "{words}");
    assert_eq!(ask(14).expect("a reply").number, 14);
}

#[test]
fn panic_in_started_keeps_queued_messages() {
    let script = Script::new().started(|scripted, context| {
        if scripted.incarnation == 1 {
            // In the mailbox before the panic.
            context.send(context.tid(), &Job { number: 1 }).expect("it has room");
            panic!("not today");
        }
    });
    let (node, _sender, log) = perform(script, |app| app);
    log.wait_for(Seen::Got(2, 1));
    all_run(&[&node]);
}

#[test]
fn panic_in_period_ends_it_with_that_incarnation() {
    let script = Script::new().started(|scripted, context| {
        let incarnation = scripted.incarnation;
        context.every(Duration::from_millis(1), move |scripted, tick, _| {
            assert!(incarnation > 1 || tick.number < 3, "in the third turn of a period");
            if scripted.incarnation == 2 && tick.number == 5 {
                scripted.note("fifth turn");
            }
        });
    });
    let (_node, _sender, log) = perform(script, |app| app);
    log.wait_for(Seen::Note(2, "fifth turn"));
}

#[test]
fn stream_continues_after_a_panic_in_its_handler() {
    let queue = EventQueue::<u64>::new(16);
    let reads = queue.clone();
    let script = Script::new()
        .started(move |_, context| {
            context.add_stream(reads.attach());
        })
        .got(|scripted, _| assert!(scripted.number != 13, "in a stream"));
    let (node, _sender, log) = perform(script, |app| app);
    all_run(&[&node]);
    for number in [12, 13, 14] {
        queue.post(number).expect("it has room");
    }
    log.wait_for(Seen::Got(2, 14));
    assert_eq!(numbers(&log.all()), [12, 13, 14]);
}

#[test]
fn panic_in_spawned_future_ends_only_that_incarnation() {
    let script = Script::new().started(|scripted, context| {
        if scripted.incarnation == 1 {
            let future = async {
                actix::clock::sleep(Duration::from_millis(1)).await;
                panic!("in a future");
            };
            context.spawn(future.into_actor(scripted));
        }
    });
    let (_node, sender, log) = perform(script, |app| app);
    log.wait_for(Seen::Started(2));
    assert_eq!(outcome_of_job(&sender, "scripted", 1), Outcome::Delivered);
}

#[test]
fn watchdog_works_again_after_a_panic_in_its_alert() {
    let script = Script::new().started(|_, context| {
        context.watch_input::<Job>(None, Duration::from_millis(1), |scripted, _, _| {
            assert!(scripted.incarnation > 1, "in an alert");
            scripted.note("silence");
        });
    });
    let (_node, _sender, log) = perform(script, |app| app);
    log.wait_for(Seen::Note(2, "silence"));
}

#[test]
fn panic_in_drop_after_panic_does_not_abort() {
    let script = Script::new()
        .got(|scripted, _| assert!(scripted.number != 13, "first"))
        .dropped(|incarnation| assert!(incarnation != 1, "second, while the first is cleared away"));
    let (_node, sender, log) = perform(script, |app| app);
    assert_eq!(outcome_of_job(&sender, "scripted", 13), Outcome::Failed);
    assert_eq!(outcome_of_job(&sender, "scripted", 14), Outcome::Delivered);
    assert!(log.all().contains(&Seen::Dropped(1)));
}

#[test]
fn panic_in_factory_is_a_failed_start_and_retried() {
    let script = Script::new()
        .made(|incarnation| assert!(incarnation > 2, "no such device"))
        .got(|scripted, _| scripted.note("home"));
    let (node, sender, log) = perform(script, |app| app);
    send_jobs(&sender, "scripted", [1]);
    log.wait_for(Seen::Note(3, "home"));
    assert_eq!(incarnations(&log), 1, "the first two never came to be");
    all_run(&[&node]);
}

#[test]
fn panic_in_stopping_does_not_prevent_clean_node_stop() {
    let (calm, other) = Script::new().app("calm");
    let (wild, log) = Script::new().stopping(|_, _| panic!("not now")).app("wild");
    let node = Loopback::new().node("node").app(calm).app(wild).start().expect("a node");
    all_run(&[&node]);
    assert_eq!(node.stop(), sinew::node::NodeEnd::Stopped);
    assert!(log.all().contains(&Seen::Stopping(1)));
    assert!(log.all().contains(&Seen::Dropped(1)));
    assert!(!log.all().contains(&Seen::Made(2)), "nothing is started in a node that stops");
    assert!(other.all().ends_with(&[Seen::Stopping(1), Seen::Dropped(1)]), "the other one was stopped");
}

/// Panics again after the panic that carries it.
struct Bomb;

impl Drop for Bomb {
    fn drop(&mut self) {
        panic!("in the drop of what a panic carried");
    }
}

#[test]
fn panic_with_bomb_payload_is_reported_once() {
    let script = Script::new().got(|scripted, _| {
        if scripted.number == 13 {
            panic_any(Bomb);
        }
    });
    let (scripted, log) = script.app("scripted");
    let (neighbour, other) = Script::new().app("neighbour");
    let (sender_app, key) = sender_app("sender");
    let place = || Place::thread("shared");
    let node = Loopback::new()
        .node("node")
        .app(scripted.place(place()))
        .app(neighbour.place(place()))
        .app(sender_app);
    let _node = node.start().expect("a node");
    let sender = key.sender();
    assert_eq!(outcome_of_job(&sender, "scripted", 13), Outcome::Failed);
    assert_eq!(outcome_of_job(&sender, "scripted", 14), Outcome::Delivered);
    assert_eq!(outcome_of_job(&sender, "neighbour", 1), Outcome::Delivered);
    assert_eq!((incarnations(&log), incarnations(&other)), (2, 1));
}

#[test]
fn panic_does_not_affect_neighbours_on_its_thread() {
    let script = Script::new().got(|scripted, _| assert!(scripted.number != 13, "thirteen"));
    let ((wild, _log), (calm, other)) = (script.app("wild"), Script::new().app("calm"));
    let (sender_app, key) = sender_app("sender");
    let place = || Place::thread("shared");
    let node = Loopback::new().node("node").app(wild.place(place())).app(calm.place(place())).app(sender_app);
    let _node = node.start().expect("a node");
    let sender = key.sender();
    for round in 0..5 {
        assert_eq!(outcome_of_job(&sender, "calm", round), Outcome::Delivered);
        assert_eq!(outcome_of_job(&sender, "wild", 13), Outcome::Failed);
    }
    assert_eq!(outcome_of_job(&sender, "calm", 5), Outcome::Delivered);
    assert_eq!(incarnations(&other), 1);
}

#[test]
fn panic_on_the_io_thread_keeps_the_node_connected() {
    let loopback = Loopback::new();
    let script = Script::new().got(|scripted, _| assert!(scripted.number != 13, "on the io thread"));
    let ((scripted, log), (sender_app, key)) = (script.app("scripted"), sender_app("sender"));
    let there = loopback.node("there").app(scripted.on_io_thread()).start().expect("a node");
    let here = loopback.node("home").app(sender_app).start().expect("a node");
    let sender = key.sender();
    until("the scripted application's name is known here", || sender.resolve("scripted"));
    until("it is reached", || (outcome_of_job(&sender, "scripted", 1) == Outcome::Delivered).then_some(()));
    assert_eq!(outcome_of_job(&sender, "scripted", 13), Outcome::Failed, "its node reports it");
    assert_eq!(outcome_of_job(&sender, "scripted", 14), Outcome::Delivered);
    assert_eq!(incarnations(&log), 2);
    drop((here, there));
}

#[test]
fn sender_of_a_dead_incarnation_sends_nothing() {
    let held = Arc::new(Mutex::new(Vec::new()));
    let holds = held.clone();
    let script = Script::new()
        .started(move |scripted, context| {
            holds.lock().expect("nobody panics with it").push(context.sender());
            scripted.note("holds it");
        })
        .got(|scripted, _| assert!(scripted.number != 13, "thirteen"));
    let ((scripted, log), (witness, seen), (sender_app, key)) =
        (script.app("scripted"), Script::new().app("witness"), sender_app("sender"));
    let node =
        Loopback::new().node("node").app(scripted).app(witness).app(sender_app).start().expect("a node");
    all_run(&[&node]);
    let senders = || held.lock().expect("nobody panics with it").clone();
    // Like a thread of the application's own, which outlives it.
    senders()[0].send("witness", &Job { number: 1 }).expect("it has room");
    assert_eq!(outcome_of_job(&key.sender(), "scripted", 13), Outcome::Failed);
    log.wait_for(Seen::Note(2, "holds it"));
    let refused = senders()[0].send("witness", &Job { number: 2 });
    assert!(matches!(refused, Err(SendError::Over)), "{refused:?}");
    senders()[1].send("witness", &Job { number: 3 }).expect("it has room");
    assert_eq!(wait_for_numbers(&seen, 2), [1, 3]);
}

#[test]
fn temporary_app_is_gone_after_panic() {
    let script = Script::new().got(|scripted, _| assert!(scripted.number != 13, "thirteen"));
    let (node, sender, log) = perform(script, |app| app.restart(Restart::Temporary));
    all_run(&[&node]);
    let tid = sender.resolve("scripted").expect("it is there");
    assert_eq!(outcome_of_job(&sender, "scripted", 13), Outcome::Failed);
    until("its name is free", || sender.resolve("scripted").is_none().then_some(()));
    let refused = sender.send(tid, &Job { number: 1 }).expect_err("nobody is there");
    assert!(
        matches!(refused, SendError::Rejected(Rejection::NoSuchApplication | Rejection::Closed)),
        "{refused:?}"
    );
    assert_eq!(incarnations(&log), 1);
}

#[test]
fn transient_app_restarts_only_after_panic() {
    let script = Script::new().got(|scripted, context| match scripted.number {
        13 => panic!("thirteen"),
        99 => context.stop(),
        _ => {}
    });
    let (node, sender, log) = perform(script, |app| app.restart(Restart::Transient));
    all_run(&[&node]);
    assert_eq!(outcome_of_job(&sender, "scripted", 13), Outcome::Failed);
    assert_eq!(outcome_of_job(&sender, "scripted", 99), Outcome::Delivered);
    // Its name and its TID are kept: it may be restarted by a command, or with its group.
    until("nobody takes messages for it", || {
        sender.send("scripted", &Job { number: 1 }).is_err().then_some(())
    });
    assert_eq!(incarnations(&log), 2);
}

#[test]
fn one_panic_too_many_ends_the_node_in_order() {
    let loopback = Loopback::new();
    let script = Script::new().got(|scripted, _| assert!(scripted.number != 13, "thirteen"));
    let ((wild, log), (calm, other), (sender_app, key)) =
        (script.app("wild"), Script::new().app("calm"), sender_app("sender"));
    let node = loopback.node("failing").app(wild).app(calm).app(sender_app).start().expect("a node");
    let (witness, seen) = Script::new().app("witness");
    let witness = witness.handles::<NodeEvent>().handles::<RequirementEvent>().requires(["wild"]);
    let there = loopback.node("there").app(witness).start().expect("a node");
    all_run(&[&node, &there]);
    let sender = key.sender();
    for _ in 0..6 {
        sender.send("wild", &Job { number: 13 }).expect("it has room");
    }
    let end = node.wait_for_end();
    let sinew::node::NodeEnd::GaveUp(why) = end else { panic!("{end:?}") };
    assert!(why.contains("more than 5 restarts") && why.contains("thirteen"), "{why}");
    assert_eq!(incarnations(&log), 6);
    assert!(other.all().ends_with(&[Seen::Stopping(1), Seen::Dropped(1)]), "{:?}", other.all());
    seen.wait_for(Seen::Requirement(RequirementEvent::Lost { name: "wild".to_owned() }));
    let is_told = |seen: &Seen| {
        matches!(seen, Seen::Node(NodeEvent::NodeLost { why: sinew::events::LossReason::GaveUp(words), .. })
            if words.contains("more than 5 restarts"))
    };
    seen.wait("the reason of the failing node", |all| all.iter().any(is_told).then_some(()));
    assert_eq!(incarnations(&seen), 1, "a lost requirement is reported, and causes no restart");
}

#[test]
fn panic_of_the_owner_does_not_count_as_stop() {
    let loopback = Loopback::new();
    let node = loopback.node("failing").app(Script::new().app("calm").0).start().expect("a node");
    let (witness, seen) = Script::new().app("witness");
    let witness = witness.handles::<NodeEvent>().requires(["calm"]);
    let there = loopback.node("there").app(witness).start().expect("a node");
    all_run(&[&node, &there]);
    let owner = std::thread::spawn(move || {
        let _node = node;
        panic!("on the owner's thread");
    });
    assert!(owner.join().is_err());
    let why = seen.wait("its loss", |all| all.iter().find_map(loss));
    assert!(
        matches!(&why, sinew::events::LossReason::GaveUp(words) if words.contains("panicked")),
        "{why:?}"
    );
}

#[test]
fn node_with_failed_layers_is_lost_for_that_reason() {
    let loopback = Loopback::new();
    let failing = loopback.node("failing").configure(|config| config.supervision.layer_restarts_max = 0);
    let node = failing.app(Script::new().app("calm").0).start().expect("a node");
    let (witness, seen) = Script::new().app("witness");
    let witness = witness.handles::<NodeEvent>().requires(["calm"]);
    let there = loopback.node("there").app(witness).start().expect("a node");
    all_run(&[&node, &there]);
    node.handle().inject("NDL", Fault::panic()).expect("every node has it");
    let why = seen.wait("its loss", |all| all.iter().find_map(loss));
    assert!(
        matches!(&why, sinew::events::LossReason::GaveUp(words) if words.contains("restarts")),
        "{why:?}"
    );
}

fn loss(seen: &Seen) -> Option<sinew::events::LossReason> {
    let Seen::Node(NodeEvent::NodeLost { why, .. }) = seen else { return None };
    Some(why.clone())
}
