//! Actors that do not come back, on whole nodes: who takes over, what becomes of the messages, what a late return does.

use std::sync::{Arc, Condvar, Mutex, PoisonError};

use sinew::{events::Trouble, fault::Fault, message::Sender, node::NodeEnd, prelude::*};
use sinew_tests::{
    DEADLINE, Ground, Log, all_run,
    load::LAYERS,
    puppet::{
        Job, Puppet, Seen, Stage, desk, lives, numbers, outcome_of_job, send_jobs, wait, wait_for_numbers,
    },
    ready_for, sees, until,
};

/// Far above what a healthy turn needs on a loaded machine, and short enough for a test.
const BUDGET: Duration = Duration::from_millis(100);
/// A hang that is noticed however late the watchdog comes to it: a machine that stands still for a moment gives that back.
const HANG: Duration = Duration::from_secs(4);
/// Time in which two nodes whose watches are quick lose each other: longer than a busy machine stands still.
const LOSS: Duration = Duration::from_secs(2);

/// Blocks whoever waits at it until the test opens it, or ends.
#[derive(Clone, Debug, Default)]
struct Gate(Arc<(Mutex<bool>, Condvar)>);

impl Gate {
    fn wait(&self) {
        let (open, changed) = &*self.0;
        let mut open = open.lock().unwrap_or_else(PoisonError::into_inner);
        while !*open {
            open = changed.wait(open).unwrap_or_else(PoisonError::into_inner);
        }
    }

    fn open(&self) {
        *self.0.0.lock().unwrap_or_else(PoisonError::into_inner) = true;
        self.0.1.notify_all();
    }
}

/// A test that fails lets its threads go all the same.
struct Opener(Gate);

impl Drop for Opener {
    fn drop(&mut self) {
        self.0.open();
    }
}

fn perform(
    stage: Stage,
    declare: impl FnOnce(AppSpec<Puppet>) -> AppSpec<Puppet>,
) -> (Node, Sender, Log<Seen>) {
    let ((puppet, log), (desk, key)) = (stage.app("puppet"), desk("desk"));
    let node = Ground::new().node("node").app(declare(puppet.progress_within(BUDGET))).app(desk);
    let node = node.start().expect("a node");
    (node, key.sender(), log)
}

/// NDL has a thread of its own: what blocks the node's IO thread makes the node not look lost, and is told by its name.
#[test]
fn an_application_that_stalls_its_nodes_io_thread_is_named_to_other_nodes_and_its_node_is_not_lost() {
    let (gate, ground) = (Opener(Gate::default()), Ground::new());
    let blocks = gate.0.clone();
    let quick = |builder: NodeBuilder| {
        builder.configure(|config| (config.ndl.period, config.ndl.missed_max) = (LOSS / 4, 4))
    };
    let (watcher, log) = Stage::new().app("watcher");
    let here = quick(ground.node("home")).app(watcher.handles::<NodeEvent>()).start().expect("a node");
    let (slow, _) = Stage::new().got(move |_, _| blocks.wait()).app("slow");
    let slow = slow.place(Place::io()).progress_within(Duration::from_secs(60));
    let (desk, key) = desk("desk");
    let there = quick(ground.node("there")).app(slow).app(desk).start().expect("a node");
    all_run(&[&here, &there]);
    sees(&here.handle(), there.address());
    // When
    send_jobs(&key.sender(), "slow", [1]);
    // Then
    let stalled = |seen: &Seen| matches!(seen, Seen::Node(NodeEvent::AppStalled { app_name, trouble: Trouble::Stalled, .. }) if app_name == "slow");
    log.wait("the stall", |seen| seen.iter().any(stalled).then_some(()));
    let known = here.handle().members();
    assert!(known.iter().any(|node| node.troubles.iter().any(|app| app.name == "slow")), "{known:?}");
    // It lasts for longer than a loss takes, and nobody is lost: that is the time, not a wait for anything.
    std::thread::sleep(2 * LOSS);
    gate.0.open();
    let resumed = |seen: &Seen| matches!(seen, Seen::Node(NodeEvent::AppResumed { app_name, .. }) if app_name == "slow");
    log.wait("its end", |seen| seen.iter().any(resumed).then_some(()));
    let lost = |seen: &Seen| matches!(seen, Seen::Node(NodeEvent::NodeLost { .. }));
    assert!(!log.all().iter().any(lost), "{:?}", log.all());
}

#[test]
fn a_hung_application_is_replaced_its_message_failed_and_those_behind_are_handled_in_order() {
    let gate = Opener(Gate::default());
    let blocks = gate.0.clone();
    let stage = Stage::new().got(move |puppet, context| {
        if puppet.number == 13 {
            blocks.wait();
            puppet.say(if context.send(context.tid(), &Job { number: 99 }).is_err() {
                "refused"
            } else {
                "sent"
            });
        }
    });
    let (_node, sender, log) = perform(stage, |app| app);
    let hung = sender.message("puppet", &Job { number: 13 }).confirmed(DEADLINE).expect("it has room");
    send_jobs(&sender, "puppet", [14, 15]);
    assert_eq!(wait(hung), Outcome::Failed);
    assert_eq!(wait_for_numbers(&log, 3), [13, 14, 15]);
    assert!(log.all().contains(&Seen::Got(2, 14)));
    gate.0.open();
    log.wait_for(Seen::Dropped(1));
    assert!(log.all().contains(&Seen::Said(1, "refused")), "who comes back late can send nothing");
    assert_eq!(outcome_of_job(&sender, "puppet", 16), Outcome::Delivered);
    assert_eq!(numbers(&log.all()), [13, 14, 15, 16], "nor is it given anything more");
}

#[test]
fn a_planned_hang_is_noticed_and_the_next_life_goes_on() {
    let (_node, sender, log) = perform(Stage::new(), |app| app.fault(Fault::hang(HANG).at_event(2)));
    let outcomes: Vec<_> = (1..=3).map(|number| outcome_of_job(&sender, "puppet", number)).collect();
    assert_eq!(outcomes, [Outcome::Delivered, Outcome::Failed, Outcome::Delivered]);
    assert!(log.all().contains(&Seen::Got(2, 3)), "{:?}", log.all());
}

#[test]
fn a_hang_in_started_in_a_timer_or_in_a_future_is_noticed_as_well() {
    for place in ["started", "timer", "future"] {
        let gate = Opener(Gate::default());
        let blocks = gate.0.clone();
        let stage = Stage::new().started(move |puppet, context| {
            let blocks = blocks.clone();
            match (puppet.life, place) {
                (1, "started") => blocks.wait(),
                (1, "timer") => {
                    context.after(Duration::from_millis(1), move |_, _, _| blocks.wait());
                }
                (1, _) => {
                    context.spawn(async move { blocks.wait() }.into_actor(puppet));
                }
                _ => {}
            }
        });
        let (node, sender, log) = perform(stage, |app| app);
        log.wait_for(Seen::Started(2));
        assert_eq!(outcome_of_job(&sender, "puppet", 1), Outcome::Delivered, "{place}");
        all_run(&[&node]);
        gate.0.open();
        log.wait_for(Seen::Dropped(1));
    }
}

#[test]
fn a_hang_in_the_factory_is_a_failed_start_and_is_tried_again_on_another_thread() {
    let gate = Opener(Gate::default());
    let blocks = gate.0.clone();
    let stage = Stage::new().made(move |life| {
        if life == 1 {
            blocks.wait();
        }
    });
    let (node, sender, log) = perform(stage, |app| app.start_within(Duration::from_secs(2)));
    log.wait_for(Seen::Started(2));
    assert_eq!(outcome_of_job(&sender, "puppet", 1), Outcome::Delivered);
    all_run(&[&node]);
    gate.0.open();
    log.wait_for(Seen::Dropped(1));
    assert_eq!(outcome_of_job(&sender, "puppet", 2), Outcome::Delivered);
    assert!(!log.all().contains(&Seen::Started(1)), "who is made late is not started");
    assert!(!log.all().contains(&Seen::Stopping(2)), "and does not end who has taken its place");
    assert_eq!(node.handle().lives("puppet").map(|lives| lives.readies), Some(1), "which goes on living");
}

#[test]
fn a_hang_in_stopping_costs_its_own_time_and_not_the_others_orderly_end() {
    let gate = Opener(Gate::default());
    let blocks = gate.0.clone();
    let stage = Stage::new().stopping(move |_, _| {
        blocks.wait();
        Running::Stop
    });
    let ((wild, log), (calm, other)) = (stage.app("wild"), Stage::new().app("calm"));
    let wild = wild.progress_within(BUDGET).stop_within(BUDGET);
    let node = Ground::new().node("node").app(calm).app(wild).start().expect("a node");
    all_run(&[&node]);
    assert_eq!(node.stop(), NodeEnd::Stopped);
    assert!(log.all().contains(&Seen::Stopping(1)));
    assert!(other.all().ends_with(&[Seen::Stopping(1), Seen::Dropped(1)]), "{:?}", other.all());
}

#[test]
fn a_hang_in_the_drop_of_one_that_panicked_does_not_keep_the_next_one_away() {
    let gate = Opener(Gate::default());
    let blocks = gate.0.clone();
    let stage = Stage::new().got(|puppet, _| assert!(puppet.number != 13, "thirteen")).dropped(move |life| {
        if life == 1 {
            blocks.wait();
        }
    });
    let (_node, sender, log) = perform(stage, |app| app);
    assert_eq!(outcome_of_job(&sender, "puppet", 13), Outcome::Failed);
    assert_eq!(outcome_of_job(&sender, "puppet", 14), Outcome::Delivered);
    assert_eq!(lives(&log), 2);
}

#[test]
fn neighbours_of_a_hung_application_move_to_another_thread_with_their_messages() {
    let gate = Opener(Gate::default());
    let blocks = gate.0.clone();
    let stage = Stage::new().got(move |puppet, _| {
        if puppet.number == 13 {
            blocks.wait();
        }
    });
    let ((wild, at_wild), (calm, at_calm), (desk, key)) =
        (stage.app("wild"), Stage::new().app("calm"), desk("desk"));
    let place = || Place::thread("shared");
    let wild = wild.place(place()).progress_within(BUDGET);
    let node =
        Ground::new().node("node").app(wild).app(calm.place(place())).app(desk).start().expect("a node");
    all_run(&[&node]);
    let sender = key.sender();
    send_jobs(&sender, "wild", [13, 14]);
    at_wild.wait_for(Seen::Got(1, 13));
    send_jobs(&sender, "calm", 1..=10);
    assert_eq!(wait_for_numbers(&at_calm, 10), (1..=10).collect::<Vec<_>>());
    assert_eq!(wait_for_numbers(&at_wild, 2), [13, 14]);
}

#[test]
fn a_temporary_neighbour_of_a_hung_application_is_gone_and_a_transient_one_comes_back() {
    let gate = Opener(Gate::default());
    let blocks = gate.0.clone();
    let stage = Stage::new().got(move |_, _| blocks.wait());
    let ((wild, at_wild), (desk, key)) = (stage.app("wild"), desk("desk"));
    let ((once, at_once), (calm, at_calm)) = (Stage::new().app("once"), Stage::new().app("calm"));
    let place = || Place::thread("shared");
    let node = Ground::new()
        .node("node")
        .app(wild.place(place()).progress_within(BUDGET))
        .app(once.place(place()).restart(Restart::Temporary))
        .app(calm.place(place()).restart(Restart::Transient))
        .app(desk)
        .start()
        .expect("a node");
    all_run(&[&node]);
    // When
    send_jobs(&key.sender(), "wild", [1]);
    // Then
    at_calm.wait_for(Seen::Started(2));
    until("its name is free", || node.handle().resolve("once").is_none().then_some(()));
    at_wild.wait_for(Seen::Started(2));
    assert_eq!(lives(&at_once), 1, "whoever ended it: it is not started again");
}

#[test]
fn a_slow_application_within_its_budget_is_not_accused() {
    let (_node, sender, log) = perform(Stage::new(), |app| app.fault(Fault::slow(BUDGET / 10).at_every(1)));
    send_jobs(&sender, "puppet", 1..=30);
    assert_eq!(wait_for_numbers(&log, 30), (1..=30).collect::<Vec<_>>());
    assert_eq!(lives(&log), 1, "together they took three budgets, each of them a tenth");
}

#[test]
fn more_threads_than_may_be_given_up_end_the_node_and_the_others_are_told() {
    let gate = Opener(Gate::default());
    let blocks = gate.0.clone();
    let stage = Stage::new().got(move |_, _| blocks.wait());
    let ((wild, log), (calm, other), (desk, key)) =
        (stage.app("wild"), Stage::new().app("calm"), desk("desk"));
    let wild = wild.progress_within(BUDGET / 2);
    let node = Ground::new().node("node").app(wild).app(calm).app(desk).start().expect("a node");
    all_run(&[&node]);
    send_jobs(&key.sender(), "wild", 1..=10);
    let NodeEnd::GaveUp(why) = node.wait_for_end() else { panic!("it goes on giving threads up") };
    assert!(why.contains("threads") || why.contains("restarts"), "{why}");
    assert!(numbers(&log.all()).len() <= 6, "{:?}", log.all());
    assert!(other.all().ends_with(&[Seen::Stopping(1), Seen::Dropped(1)]), "{:?}", other.all());
}

/// Two linked nodes with a puppet on the second and the test's sender on the first.
fn pair() -> (Node, Node, Sender, Log<Seen>) {
    let ground = Ground::new();
    let ((puppet, log), (desk, key)) = (Stage::new().app("puppet"), desk("desk"));
    let there = ground.node("there").app(puppet).start().expect("a node");
    let here = ground.node("home").app(desk).start().expect("a node");
    all_run(&[&there, &here]);
    sees(&here.handle(), there.address());
    let sender = key.sender();
    until("the puppet is known", || sender.resolve("puppet"));
    until("it is reached", || {
        let sent = sender.message("puppet", &Job { number: 0 }).confirmed(DEADLINE).ok()?;
        (wait(sent) == Outcome::Delivered).then_some(())
    });
    (here, there, sender, log)
}

#[test]
fn a_hung_layer_is_replaced_and_the_nodes_find_together_again() {
    // All four at once, each on nodes of its own: a layer's budget is a second.
    let hung = LAYERS.map(|layer| {
        std::thread::spawn(move || {
            let (here, there, sender, log) = pair();
            let before = LAYERS.map(|layer| there.handle().lives(layer).expect("every node has it").readies);
            there.handle().inject(layer, Fault::hang(HANG)).expect("every node has it");
            let from = LAYERS.iter().position(|name| *name == layer).expect("it is one");
            for index in from..LAYERS.len() {
                ready_for(&there.handle(), LAYERS[index], before[index] + 1);
            }
            until("a job gets through", || {
                let sent = sender.message("puppet", &Job { number: 1 }).confirmed(DEADLINE).ok()?;
                (wait(sent) == Outcome::Delivered).then_some(())
            });
            assert_eq!(lives(&log), 1, "{layer}: the application was not restarted");
            // When the hung one comes back, nothing is disturbed.
            until("it has come back", || {
                let sent = sender.message("puppet", &Job { number: 2 }).confirmed(DEADLINE).ok()?;
                let struck =
                    there.handle().lives(layer).and_then(|lives| lives.struck).expect("it was struck");
                (wait(sent) == Outcome::Delivered && Time::now().since(struck) > HANG + BUDGET).then_some(())
            });
            sees(&there.handle(), here.address());
            assert_eq!(outcome_of_job(&sender, "puppet", 3), Outcome::Delivered);
        })
    });
    for (layer, hung) in LAYERS.into_iter().zip(hung) {
        assert!(hung.join().is_ok(), "{layer}");
    }
}

#[test]
fn a_layer_that_hangs_for_less_than_its_budget_costs_a_delay_and_no_link() {
    let (here, there, sender, log) = pair();
    for layer in LAYERS {
        there.handle().inject(layer, Fault::hang(Duration::from_millis(100))).expect("every node has it");
        assert_eq!(outcome_of_job(&sender, "puppet", 1), Outcome::Delivered, "{layer}");
        assert_eq!(there.handle().lives(layer).map(|lives| lives.starts), Some(1), "{layer}");
    }
    assert_eq!(here.handle().members().len(), 1);
    assert_eq!(lives(&log), 1);
}
