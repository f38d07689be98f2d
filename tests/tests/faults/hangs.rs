//! Hung actors on whole nodes: their replacement, the fate of their messages, and their late return.

use std::sync::{Arc, Condvar, Mutex, PoisonError};

use sinew::{events::Trouble, fault::Fault, message::Sender, node::NodeEnd, prelude::*};
use sinew_testkit::{
    DEADLINE, Log, Loopback, all_run, ready_for,
    scripted::{
        Job, Script, ScriptedApp, Seen, incarnations, numbers, outcome_of_job, send_jobs, sender_app, wait,
        wait_for_numbers,
    },
    sees, until,
};
use sinew_tests::load::LAYERS;

use super::gets_through;

/// Far above the time of a healthy turn on a loaded machine, and short enough for a test.
const BUDGET: Duration = Duration::from_millis(100);
/// A hang that is noticed however late the watchdog checks: a machine that stalls for a moment extends the
/// deadline.
const HANG: Duration = Duration::from_secs(4);
/// Time in which two nodes with short periods lose each other: longer than a busy machine stalls.
const LOSS: Duration = Duration::from_secs(2);

/// Blocks each waiting thread until the test opens it or ends.
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

/// Releases the threads of a failed test.
struct Opener(Gate);

impl Drop for Opener {
    fn drop(&mut self) {
        self.0.open();
    }
}

/// Same as [`super::perform`], with [`BUDGET`] for each turn.
fn perform(
    script: Script,
    declare: impl FnOnce(AppSpec<ScriptedApp>) -> AppSpec<ScriptedApp>,
) -> (Node, Sender, Log<Seen>) {
    super::perform(script, |app| declare(app.progress_within(BUDGET)))
}

/// NDL has a thread of its own: a node with a blocked IO thread does not look lost, and the blocking
/// application is reported by name.
#[test]
fn app_that_stalls_the_io_thread_is_named() {
    let (gate, loopback) = (Opener(Gate::default()), Loopback::new());
    let blocks = gate.0.clone();
    let quick = |builder: NodeBuilder| {
        builder.configure(|config| (config.ndl.period, config.ndl.missed_max) = (LOSS / 4, 4))
    };
    let (watcher, log) = Script::new().app("watcher");
    let here = quick(loopback.node("home")).app(watcher.handles::<NodeEvent>()).start().expect("a node");
    let (slow, _) = Script::new().got(move |_, _| blocks.wait()).app("slow");
    let slow = slow.place(Place::io()).progress_within(Duration::from_secs(60));
    let (sender_app, key) = sender_app("sender");
    let there = quick(loopback.node("there")).app(slow).app(sender_app).start().expect("a node");
    all_run(&[&here, &there]);
    sees(&here.handle(), there.address());
    // When
    send_jobs(&key.sender(), "slow", [1]);
    // Then
    let stalled = |seen: &Seen| matches!(seen, Seen::Node(NodeEvent::AppStalled { app_name, trouble: Trouble::Stalled, .. }) if app_name == "slow");
    log.wait("the stall", |seen| seen.iter().any(stalled).then_some(()));
    let known = here.handle().members();
    assert!(known.iter().any(|node| node.troubles.iter().any(|app| app.name == "slow")), "{known:?}");
    // The stall lasts for longer than a loss takes, and no node is lost: this sleep is the stall, not a wait
    // for an event.
    std::thread::sleep(2 * LOSS);
    gate.0.open();
    let resumed = |seen: &Seen| matches!(seen, Seen::Node(NodeEvent::AppResumed { app_name, .. }) if app_name == "slow");
    log.wait("its end", |seen| seen.iter().any(resumed).then_some(()));
    let lost = |seen: &Seen| matches!(seen, Seen::Node(NodeEvent::NodeLost { .. }));
    assert!(!log.all().iter().any(lost), "{:?}", log.all());
}

#[test]
fn hung_app_is_replaced_and_its_queue_kept() {
    let gate = Opener(Gate::default());
    let blocks = gate.0.clone();
    let script = Script::new().got(move |scripted, context| {
        if scripted.number == 13 {
            blocks.wait();
            scripted.note(if context.send(context.tid(), &Job { number: 99 }).is_err() {
                "refused"
            } else {
                "sent"
            });
        }
    });
    let (_node, sender, log) = perform(script, |app| app);
    let hung = sender.message("scripted", &Job { number: 13 }).confirmed(DEADLINE).expect("it has room");
    send_jobs(&sender, "scripted", [14, 15]);
    assert_eq!(wait(hung), Outcome::Failed);
    assert_eq!(wait_for_numbers(&log, 3), [13, 14, 15]);
    assert!(log.all().contains(&Seen::Got(2, 14)));
    gate.0.open();
    log.wait_for(Seen::Dropped(1));
    assert!(log.all().contains(&Seen::Note(1, "refused")), "who comes back late can send nothing");
    assert_eq!(outcome_of_job(&sender, "scripted", 16), Outcome::Delivered);
    assert_eq!(numbers(&log.all()), [13, 14, 15, 16], "nor is it given anything more");
}

#[test]
fn planned_hang_is_noticed_and_replaced() {
    let (_node, sender, log) = perform(Script::new(), |app| app.fault(Fault::hang(HANG).at_event(2)));
    let outcomes: Vec<_> = (1..=3).map(|number| outcome_of_job(&sender, "scripted", number)).collect();
    assert_eq!(outcomes, [Outcome::Delivered, Outcome::Failed, Outcome::Delivered]);
    assert!(log.all().contains(&Seen::Got(2, 3)), "{:?}", log.all());
}

#[test]
fn hang_in_started_timer_or_future_is_noticed() {
    for place in ["started", "timer", "future"] {
        let gate = Opener(Gate::default());
        let blocks = gate.0.clone();
        let script = Script::new().started(move |scripted, context| {
            let blocks = blocks.clone();
            match (scripted.incarnation, place) {
                (1, "started") => blocks.wait(),
                (1, "timer") => {
                    context.after(Duration::from_millis(1), move |_, _, _| blocks.wait());
                }
                (1, _) => {
                    context.spawn(async move { blocks.wait() }.into_actor(scripted));
                }
                _ => {}
            }
        });
        let (node, sender, log) = perform(script, |app| app);
        log.wait_for(Seen::Started(2));
        assert_eq!(outcome_of_job(&sender, "scripted", 1), Outcome::Delivered, "{place}");
        all_run(&[&node]);
        gate.0.open();
        log.wait_for(Seen::Dropped(1));
    }
}

#[test]
fn hang_in_factory_is_a_failed_start_and_retried() {
    let gate = Opener(Gate::default());
    let blocks = gate.0.clone();
    let script = Script::new().made(move |incarnation| {
        if incarnation == 1 {
            blocks.wait();
        }
    });
    let (node, sender, log) = perform(script, |app| app.start_within(Duration::from_secs(2)));
    log.wait_for(Seen::Started(2));
    assert_eq!(outcome_of_job(&sender, "scripted", 1), Outcome::Delivered);
    all_run(&[&node]);
    gate.0.open();
    log.wait_for(Seen::Dropped(1));
    assert_eq!(outcome_of_job(&sender, "scripted", 2), Outcome::Delivered);
    assert!(!log.all().contains(&Seen::Started(1)), "who is made late is not started");
    assert!(!log.all().contains(&Seen::Stopping(2)), "and does not end who has taken its place");
    assert_eq!(node.handle().lives("scripted").map(|lives| lives.readies), Some(1), "which goes on living");
}

#[test]
fn hang_in_stopping_delays_no_other_stop() {
    let gate = Opener(Gate::default());
    let blocks = gate.0.clone();
    let script = Script::new().stopping(move |_, _| {
        blocks.wait();
        Running::Stop
    });
    let ((wild, log), (calm, other)) = (script.app("wild"), Script::new().app("calm"));
    let wild = wild.progress_within(BUDGET).stop_within(BUDGET);
    let node = Loopback::new().node("node").app(calm).app(wild).start().expect("a node");
    all_run(&[&node]);
    assert_eq!(node.stop(), NodeEnd::Stopped);
    assert!(log.all().contains(&Seen::Stopping(1)));
    assert!(other.all().ends_with(&[Seen::Stopping(1), Seen::Dropped(1)]), "{:?}", other.all());
}

#[test]
fn hang_in_drop_does_not_delay_the_next_incarnation() {
    let gate = Opener(Gate::default());
    let blocks = gate.0.clone();
    let script = Script::new().got(|scripted, _| assert!(scripted.number != 13, "thirteen")).dropped(
        move |incarnation| {
            if incarnation == 1 {
                blocks.wait();
            }
        },
    );
    let (_node, sender, log) = perform(script, |app| app);
    assert_eq!(outcome_of_job(&sender, "scripted", 13), Outcome::Failed);
    assert_eq!(outcome_of_job(&sender, "scripted", 14), Outcome::Delivered);
    assert_eq!(incarnations(&log), 2);
}

#[test]
fn neighbours_of_hung_app_move_with_their_messages() {
    let gate = Opener(Gate::default());
    let blocks = gate.0.clone();
    let script = Script::new().got(move |scripted, _| {
        if scripted.number == 13 {
            blocks.wait();
        }
    });
    let ((wild, at_wild), (calm, at_calm), (sender_app, key)) =
        (script.app("wild"), Script::new().app("calm"), sender_app("sender"));
    let place = || Place::thread("shared");
    let wild = wild.place(place()).progress_within(BUDGET);
    let node = Loopback::new()
        .node("node")
        .app(wild)
        .app(calm.place(place()))
        .app(sender_app)
        .start()
        .expect("a node");
    all_run(&[&node]);
    let sender = key.sender();
    send_jobs(&sender, "wild", [13, 14]);
    at_wild.wait_for(Seen::Got(1, 13));
    send_jobs(&sender, "calm", 1..=10);
    assert_eq!(wait_for_numbers(&at_calm, 10), (1..=10).collect::<Vec<_>>());
    assert_eq!(wait_for_numbers(&at_wild, 2), [13, 14]);
}

#[test]
fn restart_type_of_a_hung_apps_neighbour_is_respected() {
    let gate = Opener(Gate::default());
    let blocks = gate.0.clone();
    let script = Script::new().got(move |_, _| blocks.wait());
    let ((wild, at_wild), (sender_app, key)) = (script.app("wild"), sender_app("sender"));
    let ((once, at_once), (calm, at_calm)) = (Script::new().app("once"), Script::new().app("calm"));
    let place = || Place::thread("shared");
    let node = Loopback::new()
        .node("node")
        .app(wild.place(place()).progress_within(BUDGET))
        .app(once.place(place()).restart(Restart::Temporary))
        .app(calm.place(place()).restart(Restart::Transient))
        .app(sender_app)
        .start()
        .expect("a node");
    all_run(&[&node]);
    // When
    send_jobs(&key.sender(), "wild", [1]);
    // Then
    at_calm.wait_for(Seen::Started(2));
    until("its name is free", || node.handle().resolve("once").is_none().then_some(()));
    at_wild.wait_for(Seen::Started(2));
    assert_eq!(incarnations(&at_once), 1, "whatever ended it: it is not started again");
}

#[test]
fn too_many_abandoned_threads_end_the_node() {
    let gate = Opener(Gate::default());
    let blocks = gate.0.clone();
    let script = Script::new().got(move |_, _| blocks.wait());
    let ((wild, log), (calm, other), (sender_app, key)) =
        (script.app("wild"), Script::new().app("calm"), sender_app("sender"));
    let wild = wild.progress_within(BUDGET / 2);
    let node = Loopback::new().node("node").app(wild).app(calm).app(sender_app).start().expect("a node");
    all_run(&[&node]);
    send_jobs(&key.sender(), "wild", 1..=10);
    let NodeEnd::GaveUp(why) = node.wait_for_end() else { panic!("it goes on giving threads up") };
    assert!(why.contains("threads") || why.contains("restarts"), "{why}");
    assert!(numbers(&log.all()).len() <= 6, "{:?}", log.all());
    assert!(other.all().ends_with(&[Seen::Stopping(1), Seen::Dropped(1)]), "{:?}", other.all());
}

/// Two linked nodes with a scripted application on the second and the test's sender on the first.
fn pair() -> (Node, Node, Sender, Log<Seen>) {
    let loopback = Loopback::new();
    let ((scripted, log), (sender_app, key)) = (Script::new().app("scripted"), sender_app("sender"));
    let there = loopback.node("there").app(scripted).start().expect("a node");
    let here = loopback.node("home").app(sender_app).start().expect("a node");
    all_run(&[&there, &here]);
    sees(&here.handle(), there.address());
    let sender = key.sender();
    until("the scripted application is known", || sender.resolve("scripted"));
    gets_through(&sender, 0);
    (here, there, sender, log)
}

#[test]
fn hung_layer_is_replaced_and_nodes_reconnect() {
    // All four at the same time, each on nodes of its own: the budget of a layer is one second.
    let hung = LAYERS.map(|layer| {
        std::thread::spawn(move || {
            let (here, there, sender, log) = pair();
            let before = LAYERS.map(|layer| there.handle().lives(layer).expect("every node has it").readies);
            there.handle().inject(layer, Fault::hang(HANG)).expect("every node has it");
            let from = LAYERS.iter().position(|name| *name == layer).expect("it is one");
            for index in from..LAYERS.len() {
                ready_for(&there.handle(), LAYERS[index], before[index] + 1);
            }
            gets_through(&sender, 1);
            assert_eq!(incarnations(&log), 1, "{layer}: the application was not restarted");
            // The return of the hung layer disturbs nothing.
            until("it has come back", || {
                let sent = sender.message("scripted", &Job { number: 2 }).confirmed(DEADLINE).ok()?;
                let struck =
                    there.handle().lives(layer).and_then(|lives| lives.struck).expect("it was struck");
                (wait(sent) == Outcome::Delivered && Time::now().since(struck) > HANG + BUDGET).then_some(())
            });
            sees(&there.handle(), here.address());
            assert_eq!(outcome_of_job(&sender, "scripted", 3), Outcome::Delivered);
        })
    });
    for (layer, hung) in LAYERS.into_iter().zip(hung) {
        assert!(hung.join().is_ok(), "{layer}");
    }
}

#[test]
fn layer_hang_within_budget_cuts_no_link() {
    let (here, there, sender, log) = pair();
    for layer in LAYERS {
        there.handle().inject(layer, Fault::hang(Duration::from_millis(100))).expect("every node has it");
        assert_eq!(outcome_of_job(&sender, "scripted", 1), Outcome::Delivered, "{layer}");
        assert_eq!(there.handle().lives(layer).map(|lives| lives.starts), Some(1), "{layer}");
    }
    assert_eq!(here.handle().members().len(), 1);
    assert_eq!(incarnations(&log), 1);
}
