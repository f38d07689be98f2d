//! The policies of an application that loses a requirement.

use std::{
    sync::{
        Mutex,
        mpsc::{SyncSender, sync_channel},
    },
    thread::sleep,
    time::Duration,
};

use sinew::{Endpoint, NodeApi, Registration, StartError, message::Sender, node::LifeState, prelude::*};
use sinew_testkit::{
    DEADLINE, Log, Loopback, TestDirectory, all_run,
    scripted::{Job, Order, Script, ScriptedApp, Seen, numbers, sender_app},
    until,
};

/// A node on which a walker requires an anchor; the test registers and drops the anchor.
struct Scene {
    node: Node,
    sender: Sender,
    api: NodeApi,
    _directory: TestDirectory,
}

fn start(walker: AppSpec<ScriptedApp>, witness: Option<AppSpec<ScriptedApp>>) -> Scene {
    let (directory, (sender_app, key)) = (TestDirectory::new(), sender_app("sender"));
    let socket = directory.join("node.sock");
    let mut node = Loopback::new()
        .node("node")
        .configure(|config| config.lncl.socket = Some(socket.clone()))
        .app(walker.requires(["anchor"]).handles::<RequirementEvent>());
    if let Some(witness) = witness {
        node = node.app(witness.requires(["anchor"]).handles::<RequirementEvent>());
    }
    let node = node.app(sender_app).start().expect("a node");
    let api = NodeApi::connect(socket).expect("the node listens");
    Scene { node, sender: key.sender(), api, _directory: directory }
}

impl Scene {
    fn anchor(&self) -> Endpoint {
        let anchor = Registration::new().name("anchor");
        // The name becomes free a moment after its former holder has left.
        until("the anchor is registered", || self.api.register_transport_address(anchor.clone()).ok())
    }
}

fn lost() -> Seen {
    Seen::Requirement(RequirementEvent::Lost { name: "anchor".to_owned() })
}

fn met() -> Seen {
    Seen::Requirement(RequirementEvent::Met { name: "anchor".to_owned() })
}

fn position(log: &Log<Seen>, of: &Seen) -> usize {
    log.all().iter().position(|seen| seen == of).expect("it was waited for")
}

#[test]
fn pause_holds_messages_and_periods_until_met() {
    const LIMIT: Duration = Duration::from_secs(4);
    const PERIOD: Duration = Duration::from_millis(1);
    // The number of periods that fit into the pause; on a busy machine fewer are missed.
    const MADE_UP_FOR: u64 = (LIMIT.as_millis() / PERIOD.as_millis()) as u64;
    // Given: a period, and an input watchdog that would trip within the pause
    let (walker, log) = Script::new()
        .started(|_, context| {
            context.every(PERIOD, |scripted, tick, _| {
                scripted.note(if tick.missed < MADE_UP_FOR { "tick" } else { "made up for" });
            });
            context.watch_input::<Job>(None, LIMIT, |scripted, _, _| scripted.note("accused"));
        })
        .app("walker");
    let scene = start(walker.on_requirement_lost(RequirementPolicy::Pause), None);
    let anchor = scene.anchor();
    log.wait_for(Seen::Note(1, "tick"));
    // When
    drop(anchor);
    log.wait_for(lost());
    let sender = &scene.sender;
    for number in 1..=10 {
        sender.send("walker", &Order { number }).expect("it has room");
    }
    sleep(LIMIT + Duration::from_millis(200));
    let _anchor = scene.anchor();
    log.wait_for(Seen::Got(1, 10));
    // Then
    let (all, first, last) = (log.all(), position(&log, &lost()), position(&log, &met()));
    assert_eq!(last, first + 1, "between them it did nothing");
    assert_eq!(numbers(&all), (1..=10).collect::<Vec<_>>());
    for never in ["made up for", "accused"] {
        assert!(!all.contains(&Seen::Note(1, never)), "{never}");
    }
    let ticks = all.iter().filter(|seen| **seen == Seen::Note(1, "tick")).count();
    log.wait_for_many(Seen::Note(1, "tick"), ticks + 3);
}

#[test]
fn tree_shows_paused_and_stopped_without_failure() {
    let ((walker, log), (anchor, _)) = (Script::new().app("walker"), Script::new().app("anchor"));
    let walker = walker.requires(["anchor"]).on_requirement_lost(RequirementPolicy::Pause);
    let node = Loopback::new().node("node").app(anchor).app(walker).start().expect("a node");
    all_run(&[&node]);
    log.wait_for(Seen::Started(1));
    let walker = || node.handle().tree().ok()?.find("walker").cloned();
    let is = |state, missing: &[(&str, &str)]| {
        let lacks = |walker: &sinew::node::Supervised| {
            let lacks = walker.missing.iter().map(|absence| (&*absence.name, &*absence.why));
            lacks.eq(missing.iter().copied())
        };
        walker().filter(|walker| walker.state == state && lacks(walker))
    };
    until("it runs and lacks nothing", || is(LifeState::Ready, &[]));
    node.handle().stop_app("anchor").expect("it is there");
    let why = ("anchor", "stopped in order, not ready again");
    let shown = until("it is paused", || is(LifeState::Paused, std::slice::from_ref(&why))).to_string();
    assert!(shown.starts_with("walker: paused for "), "{shown}");
    assert!(shown.contains(", without anchor (stopped in order, not ready again)"), "{shown}");
    node.handle().restart_app("anchor").expect("it was stopped");
    until("it goes on", || is(LifeState::Ready, &[]));
}

#[test]
fn paused_application_stops_in_order() {
    let (walker, log) = Script::new().app("walker");
    let scene = start(walker.on_requirement_lost(RequirementPolicy::Pause), None);
    drop(scene.anchor());
    log.wait_for(lost());
    scene.node.stop();
    log.wait_for(Seen::Stopping(1));
}

#[test]
fn safe_state_precedes_queued_messages() {
    // Given: a walker that handles a message with a backlog behind it, and a witness of the loss
    let (let_go, held): (SyncSender<()>, _) = sync_channel(1);
    let held = Mutex::new(held);
    let (walker, log) = Script::new()
        .got(move |scripted, _| {
            if scripted.number == 1 {
                scripted.note("in hand");
                let held = held.lock().expect("nobody panics with it").recv_timeout(DEADLINE);
                held.expect("the test lets it go on");
            }
        })
        .app("walker");
    let walker = walker.safe_state(
        |scripted, lost, _| {
            assert_eq!(lost.name(), "anchor");
            scripted.note("safe");
        },
        |scripted, _, _| scripted.note("back"),
    );
    let (witness, witnessed) = Script::new().app("witness");
    let scene = start(walker, Some(witness));
    let anchor = scene.anchor();
    all_run(&[&scene.node]);
    let sender = &scene.sender;
    sender.send("walker", &Order { number: 1 }).expect("it has room");
    log.wait_for(Seen::Note(1, "in hand"));
    for number in 2..=200 {
        sender.send("walker", &Order { number }).expect("it has room");
    }
    // When: the witness, registered after the walker, is notified after it
    drop(anchor);
    witnessed.wait_for(lost());
    let_go.send(()).expect("it waits");
    // Then
    log.wait_for(Seen::Got(1, 200));
    let hand = position(&log, &Seen::Note(1, "in hand"));
    assert_eq!(log.all()[hand + 1..hand + 4], [Seen::Note(1, "safe"), lost(), Seen::Got(1, 2)]);
    let _anchor = scene.anchor();
    log.wait_for(Seen::Note(1, "back"));
}

#[test]
fn restart_policy_passes_the_barrier_each_time() {
    let (walker, log) = Script::new().app("walker");
    let walker = walker.on_requirement_lost(RequirementPolicy::Restart).restart(Restart::Transient);
    let scene = start(walker, None);
    // More often than the node would tolerate failures.
    for incarnation in 1..=8 {
        let anchor = scene.anchor();
        log.wait_for(Seen::Started(incarnation));
        assert!(!log.all().contains(&Seen::Started(incarnation + 1)));
        drop(anchor);
        log.wait_for(Seen::Stopping(incarnation));
    }
    assert_eq!(scene.node.stop(), sinew::node::NodeEnd::Stopped);
}

#[test]
fn carry_on_policy_notifies_and_keeps_handling() {
    let (walker, log) = Script::new().app("walker");
    let scene = start(walker, None);
    drop(scene.anchor());
    log.wait_for(lost());
    scene.sender.send("walker", &Job { number: 1 }).expect("it has room");
    log.wait_for(Seen::Got(1, 1));
    let _anchor = scene.anchor();
    log.wait_for(met());
}

#[test]
fn undeclared_safe_state_is_rejected_with_reason() {
    let (walker, _log) = Script::new().app("walker");
    let walker = walker.on_requirement_lost(RequirementPolicy::SafeState);
    let error = Loopback::new().node("node").app(walker).start().expect_err("it has none");
    assert!(matches!(error, StartError::Application { .. }));
    assert!(error.to_string().contains("declare it with `safe_state`"), "{error}");
}
