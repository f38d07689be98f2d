//! Panics in every place of an application's life.

use std::{
    panic::panic_any,
    sync::{Arc, Mutex},
};

use sinew::{
    fault::Fault,
    message::{Rejection, SendError, Sender},
    prelude::*,
};
use sinew_runtime::{app::DynApp, post::Post};
use sinew_tests::{
    DEADLINE, Ground, Log, all_run,
    puppet::{
        Job, Order, Puppet, Seen, Stage, desk, lives, numbers, outcome_of_job, send_jobs, wait,
        wait_for_numbers,
    },
    until,
};

/// A node with a puppet, and the test's own sender there.
fn perform(
    stage: Stage,
    declare: impl FnOnce(AppSpec<Puppet>) -> AppSpec<Puppet>,
) -> (Node, Sender, Log<Seen>) {
    let ((puppet, log), (desk, key)) = (stage.app("puppet"), desk("desk"));
    let node = Ground::new().node("node").app(declare(puppet)).app(desk).start().expect("a node");
    (node, key.sender(), log)
}

#[test]
fn a_poison_message_fails_once_and_is_not_handed_over_again() {
    let stage = Stage::new().got(|puppet, _| assert!(puppet.number != 13, "thirteen"));
    let (_node, sender, log) = perform(stage, |app| app);
    assert_eq!(outcome_of_job(&sender, "puppet", 13), Outcome::Failed);
    assert_eq!(outcome_of_job(&sender, "puppet", 14), Outcome::Delivered);
    assert_eq!(numbers(&log.all()), [13, 14]);
    assert!(log.all().contains(&Seen::Got(2, 14)), "by a new life behind the same TID");
}

#[test]
fn a_request_whose_handler_panics_ends_as_failed_and_the_next_one_is_answered() {
    let stage = Stage::new().got(|puppet, _| assert!(puppet.number != 13, "thirteen"));
    let (_node, sender, _log) = perform(stage, |app| app);
    let ask = |number| {
        wait(sender.message("puppet", &Order { number }).ask::<Order>(DEADLINE).expect("it is sent"))
    };
    let words = ask(13).expect_err("it failed").to_string();
    assert!(words.contains("panicked") || words.contains("Failed"), "{words}");
    assert_eq!(ask(14).expect("a reply").number, 14);
}

#[test]
fn a_panic_in_started_is_a_failed_start_and_what_waited_is_handled_by_the_next_life() {
    let stage = Stage::new().started(|puppet, context| {
        if puppet.life == 1 {
            // In the mailbox before the panic.
            context.send(context.tid(), &Job { number: 1 }).expect("it has room");
            panic!("not today");
        }
    });
    let (node, _sender, log) = perform(stage, |app| app);
    log.wait_for(Seen::Got(2, 1));
    all_run(&[&node]);
}

#[test]
fn a_panic_in_a_timer_ends_that_life_only() {
    let stage = Stage::new().started(|puppet, context| {
        if puppet.life == 1 {
            context.after(Duration::from_millis(1), |_, _, _| panic!("in a timer"));
        }
    });
    let (_node, sender, log) = perform(stage, |app| app);
    log.wait_for(Seen::Started(2));
    assert_eq!(outcome_of_job(&sender, "puppet", 1), Outcome::Delivered);
}

#[test]
fn a_panic_in_a_period_ends_the_period_with_that_life_and_the_next_has_its_own() {
    let stage = Stage::new().started(|puppet, context| {
        let life = puppet.life;
        context.every(Duration::from_millis(1), move |puppet, tick, _| {
            assert!(life > 1 || tick.number < 3, "in the third turn of a period");
            if puppet.life == 2 && tick.number == 5 {
                puppet.say("fifth turn");
            }
        });
    });
    let (_node, _sender, log) = perform(stage, |app| app);
    log.wait_for(Seen::Said(2, "fifth turn"));
}

#[test]
fn a_panic_in_a_stream_ends_that_life_and_the_stream_goes_on_in_the_next() {
    let post = Post::<u64>::new(16);
    let reads = post.clone();
    let stage = Stage::new()
        .started(move |_, context| {
            context.add_stream(reads.attach());
        })
        .got(|puppet, _| assert!(puppet.number != 13, "in a stream"));
    let (node, _sender, log) = perform(stage, |app| app);
    all_run(&[&node]);
    for number in [12, 13, 14] {
        post.post(number).expect("it has room");
    }
    log.wait_for(Seen::Got(2, 14));
    assert_eq!(numbers(&log.all()), [12, 13, 14]);
}

#[test]
fn a_panic_in_a_spawned_future_ends_that_life_only() {
    let stage = Stage::new().started(|puppet, context| {
        if puppet.life == 1 {
            let future = async {
                actix::clock::sleep(Duration::from_millis(1)).await;
                panic!("in a future");
            };
            context.spawn(future.into_actor(puppet));
        }
    });
    let (_node, sender, log) = perform(stage, |app| app);
    log.wait_for(Seen::Started(2));
    assert_eq!(outcome_of_job(&sender, "puppet", 1), Outcome::Delivered);
}

#[test]
fn a_panic_in_a_watchdogs_alert_ends_that_life_and_the_next_one_watches_again() {
    let stage = Stage::new().started(|_, context| {
        context.watch_input::<Job>(None, Duration::from_millis(1), |puppet, _, _| {
            assert!(puppet.life > 1, "in an alert");
            puppet.say("silence");
        });
    });
    let (_node, _sender, log) = perform(stage, |app| app);
    log.wait_for(Seen::Said(2, "silence"));
}

#[test]
fn a_panic_in_the_drop_of_one_that_panicked_does_not_abort_the_process() {
    let stage = Stage::new()
        .got(|puppet, _| assert!(puppet.number != 13, "first"))
        .dropped(|life| assert!(life != 1, "second, while the first is cleared away"));
    let (_node, sender, log) = perform(stage, |app| app);
    assert_eq!(outcome_of_job(&sender, "puppet", 13), Outcome::Failed);
    assert_eq!(outcome_of_job(&sender, "puppet", 14), Outcome::Delivered);
    assert!(log.all().contains(&Seen::Dropped(1)));
}

#[test]
fn a_panic_in_the_factory_is_a_failed_start_and_is_tried_again() {
    let stage =
        Stage::new().made(|life| assert!(life > 2, "no such device")).got(|puppet, _| puppet.say("home"));
    let (node, sender, log) = perform(stage, |app| app);
    send_jobs(&sender, "puppet", [1]);
    log.wait_for(Seen::Said(3, "home"));
    assert_eq!(lives(&log), 1, "the first two never came to be");
    all_run(&[&node]);
}

#[test]
fn a_panic_in_stopping_does_not_keep_the_node_from_its_orderly_end() {
    let (calm, other) = Stage::new().app("calm");
    let (wild, log) = Stage::new().stopping(|_, _| panic!("not now")).app("wild");
    let node = Ground::new().node("node").app(calm).app(wild).start().expect("a node");
    all_run(&[&node]);
    assert_eq!(node.stop(), sinew::node::NodeEnd::Stopped);
    assert!(log.all().contains(&Seen::Stopping(1)));
    assert!(log.all().contains(&Seen::Dropped(1)));
    assert!(!log.all().contains(&Seen::Made(2)), "nothing is started in a node that stops");
    assert!(other.all().ends_with(&[Seen::Stopping(1), Seen::Dropped(1)]), "the other one was told");
}

#[test]
fn a_panic_that_carries_no_text_is_a_panic_like_any_other() {
    let stage = Stage::new().got(|puppet, _| {
        if puppet.number == 13 {
            panic_any(13_u64);
        }
    });
    let (_node, sender, _log) = perform(stage, |app| app);
    assert_eq!(outcome_of_job(&sender, "puppet", 13), Outcome::Failed);
    assert_eq!(outcome_of_job(&sender, "puppet", 14), Outcome::Delivered);
}

/// What panics once more when the panic that carries it is over.
struct Bomb;

impl Drop for Bomb {
    fn drop(&mut self) {
        panic!("in the drop of what a panic carried");
    }
}

#[test]
fn a_panic_that_carries_a_bomb_is_told_once_and_the_thread_lives_on() {
    let stage = Stage::new().got(|puppet, _| {
        if puppet.number == 13 {
            panic_any(Bomb);
        }
    });
    let (puppet, log) = stage.app("puppet");
    let (neighbour, other) = Stage::new().app("neighbour");
    let (desk, key) = desk("desk");
    let place = || Place::thread("shared");
    let node = Ground::new().node("node").app(puppet.place(place())).app(neighbour.place(place())).app(desk);
    let _node = node.start().expect("a node");
    let sender = key.sender();
    assert_eq!(outcome_of_job(&sender, "puppet", 13), Outcome::Failed);
    assert_eq!(outcome_of_job(&sender, "puppet", 14), Outcome::Delivered);
    assert_eq!(outcome_of_job(&sender, "neighbour", 1), Outcome::Delivered);
    assert_eq!((lives(&log), lives(&other)), (2, 1));
}

#[test]
fn a_panic_leaves_the_neighbours_on_its_thread_alone() {
    let stage = Stage::new().got(|puppet, _| assert!(puppet.number != 13, "thirteen"));
    let ((wild, _log), (calm, other)) = (stage.app("wild"), Stage::new().app("calm"));
    let (desk, key) = desk("desk");
    let place = || Place::thread("shared");
    let node = Ground::new().node("node").app(wild.place(place())).app(calm.place(place())).app(desk);
    let _node = node.start().expect("a node");
    let sender = key.sender();
    for round in 0..5 {
        assert_eq!(outcome_of_job(&sender, "calm", round), Outcome::Delivered);
        assert_eq!(outcome_of_job(&sender, "wild", 13), Outcome::Failed);
    }
    assert_eq!(outcome_of_job(&sender, "calm", 5), Outcome::Delivered);
    assert_eq!(lives(&other), 1);
}

#[test]
fn a_panic_on_the_thread_of_the_sockets_does_not_cut_the_node_off() {
    let ground = Ground::new();
    let stage = Stage::new().got(|puppet, _| assert!(puppet.number != 13, "on the io thread"));
    let ((puppet, log), (desk, key)) = (stage.app("puppet"), desk("desk"));
    let there = ground.node("there").app(puppet.on_io_thread()).start().expect("a node");
    let here = ground.node("home").app(desk).start().expect("a node");
    let sender = key.sender();
    until("the puppet's name is known here", || sender.resolve("puppet"));
    until("it is reached", || (outcome_of_job(&sender, "puppet", 1) == Outcome::Delivered).then_some(()));
    assert_eq!(outcome_of_job(&sender, "puppet", 13), Outcome::Failed, "its node is there to say so");
    assert_eq!(outcome_of_job(&sender, "puppet", 14), Outcome::Delivered);
    assert_eq!(lives(&log), 2);
    drop((here, there));
}

#[test]
fn a_sender_that_is_held_past_a_panic_sends_nothing_beside_the_next_life() {
    let held = Arc::new(Mutex::new(Vec::new()));
    let holds = held.clone();
    let stage = Stage::new()
        .started(move |puppet, context| {
            holds.lock().expect("nobody panics with it").push(context.sender());
            puppet.say("holds it");
        })
        .got(|puppet, _| assert!(puppet.number != 13, "thirteen"));
    let ((puppet, log), (witness, seen), (desk, key)) =
        (stage.app("puppet"), Stage::new().app("witness"), desk("desk"));
    let node = Ground::new().node("node").app(puppet).app(witness).app(desk).start().expect("a node");
    all_run(&[&node]);
    let senders = || held.lock().expect("nobody panics with it").clone();
    // As from a thread of the application's own, which goes on after it.
    senders()[0].send("witness", &Job { number: 1 }).expect("it has room");
    assert_eq!(outcome_of_job(&key.sender(), "puppet", 13), Outcome::Failed);
    log.wait_for(Seen::Said(2, "holds it"));
    let refused = senders()[0].send("witness", &Job { number: 2 });
    assert!(matches!(refused, Err(SendError::Over)), "{refused:?}");
    senders()[1].send("witness", &Job { number: 3 }).expect("it has room");
    assert_eq!(wait_for_numbers(&seen, 2), [1, 3]);
}

#[test]
fn a_temporary_application_that_panics_is_gone_and_its_senders_are_told_so() {
    let stage = Stage::new().got(|puppet, _| assert!(puppet.number != 13, "thirteen"));
    let (node, sender, log) = perform(stage, |app| app.restart(Restart::Temporary));
    all_run(&[&node]);
    let tid = sender.resolve("puppet").expect("it is there");
    assert_eq!(outcome_of_job(&sender, "puppet", 13), Outcome::Failed);
    until("its name is free", || sender.resolve("puppet").is_none().then_some(()));
    let refused = sender.send(tid, &Job { number: 1 }).expect_err("nobody is there");
    assert!(
        matches!(refused, SendError::Rejected(Rejection::NoSuchApplication | Rejection::Closed)),
        "{refused:?}"
    );
    assert_eq!(lives(&log), 1);
}

#[test]
fn a_transient_application_is_restarted_after_a_panic_and_not_after_its_own_end() {
    let stage = Stage::new().got(|puppet, context| match puppet.number {
        13 => panic!("thirteen"),
        99 => context.stop(),
        _ => {}
    });
    let (node, sender, log) = perform(stage, |app| app.restart(Restart::Transient));
    all_run(&[&node]);
    assert_eq!(outcome_of_job(&sender, "puppet", 13), Outcome::Failed);
    assert_eq!(outcome_of_job(&sender, "puppet", 99), Outcome::Delivered);
    // Its name and its TID are kept for it: it may be started again by a command, or with its group.
    until("nobody takes messages for it", || {
        sender.send("puppet", &Job { number: 1 }).is_err().then_some(())
    });
    assert_eq!(lives(&log), 2);
}

#[test]
fn messages_behind_five_panics_in_a_row_are_all_handled_in_order() {
    let stage = Stage::new().got(|puppet, _| assert!(!puppet.number.is_multiple_of(10), "each tenth"));
    let (_node, sender, log) = perform(stage, |app| app);
    send_jobs(&sender, "puppet", 1..60);
    assert_eq!(wait_for_numbers(&log, 59), (1..60).collect::<Vec<_>>());
    assert_eq!(lives(&log), 6);
}

#[test]
fn one_panic_too_many_ends_the_node_in_order_and_the_other_nodes_are_told() {
    let ground = Ground::new();
    let stage = Stage::new().got(|puppet, _| assert!(puppet.number != 13, "thirteen"));
    let ((wild, log), (calm, other), (desk, key)) =
        (stage.app("wild"), Stage::new().app("calm"), desk("desk"));
    let node = ground.node("failing").app(wild).app(calm).app(desk).start().expect("a node");
    let (witness, seen) = Stage::new().app("witness");
    let witness = witness.handles::<NodeEvent>().handles::<RequirementEvent>().requires(["wild"]);
    let there = ground.node("there").app(witness).start().expect("a node");
    all_run(&[&node, &there]);
    let sender = key.sender();
    for _ in 0..6 {
        sender.send("wild", &Job { number: 13 }).expect("it has room");
    }
    let end = node.wait_for_end();
    let sinew::node::NodeEnd::GaveUp(why) = end else { panic!("{end:?}") };
    assert!(why.contains("more than 5 restarts") && why.contains("thirteen"), "{why}");
    assert_eq!(lives(&log), 6);
    assert!(other.all().ends_with(&[Seen::Stopping(1), Seen::Dropped(1)]), "{:?}", other.all());
    seen.wait_for(Seen::Requirement(RequirementEvent::Lost { name: "wild".to_owned() }));
    let is_told = |seen: &Seen| {
        matches!(seen, Seen::Node(NodeEvent::NodeLost { why: sinew::events::LossReason::GaveUp(words), .. })
            if words.contains("more than 5 restarts"))
    };
    seen.wait("the reason of the failing node", |all| all.iter().any(is_told).then_some(()));
    assert_eq!(lives(&seen), 1, "a lost requirement is told, not obeyed by a restart");
}

#[test]
fn a_node_that_a_panic_of_its_owner_drops_gives_up_and_is_not_taken_for_stopped() {
    let ground = Ground::new();
    let node = ground.node("failing").app(Stage::new().app("calm").0).start().expect("a node");
    let (witness, seen) = Stage::new().app("witness");
    let witness = witness.handles::<NodeEvent>().requires(["calm"]);
    let there = ground.node("there").app(witness).start().expect("a node");
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
fn a_node_whose_layers_give_up_is_lost_for_that_reason() {
    let ground = Ground::new();
    let failing = ground.node("failing").configure(|config| config.supervision.layer_restarts_max = 0);
    let node = failing.app(Stage::new().app("calm").0).start().expect("a node");
    let (witness, seen) = Stage::new().app("witness");
    let witness = witness.handles::<NodeEvent>().requires(["calm"]);
    let there = ground.node("there").app(witness).start().expect("a node");
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

/// All applications of a node at once.
#[test]
fn a_panic_storm_in_five_applications_at_once_leaves_each_with_its_own_messages() {
    let (desk, key) = desk("desk");
    let mut node = Ground::new().node("node").app(desk);
    let mut logs = Vec::new();
    for name in ["a", "b", "c", "d", "e"] {
        let (app, log) = Stage::new().got(|puppet, _| assert!(puppet.number != 13, "all at once")).app(name);
        node = node.app(DynApp::from(app));
        logs.push((name, log));
    }
    let node = node.start().expect("a node");
    all_run(&[&node]);
    let sender = key.sender();
    for (name, _) in &logs {
        send_jobs(&sender, name, [12, 13, 14]);
    }
    for (name, log) in &logs {
        assert_eq!(wait_for_numbers(log, 3), [12, 13, 14], "{name}");
        log.wait_for(Seen::Got(2, 14));
    }
}
