//! What an application does when it loses what it requires.

use std::{
    sync::{
        Mutex,
        mpsc::{SyncSender, sync_channel},
    },
    thread::sleep,
    time::Duration,
};

use sinew::{Endpoint, NodeApi, Registration, StartError, message::Sender, node::LifeState, prelude::*};
use sinew_tests::{
    DEADLINE, Ground, Log, OwnDirectory, all_run,
    puppet::{Job, Order, Puppet, Seen, Stage, desk, numbers},
    until,
};

/// A node on which a walker requires an anchor that the test registers and drops.
struct Scene {
    node: Node,
    sender: Sender,
    api: NodeApi,
    _directory: OwnDirectory,
}

fn start(walker: AppSpec<Puppet>, witness: Option<AppSpec<Puppet>>) -> Scene {
    let (directory, (desk, key)) = (OwnDirectory::new(), desk("desk"));
    let socket = directory.join("node.sock");
    let mut node = Ground::new()
        .node("node")
        .configure(|config| config.lncl.socket = Some(socket.clone()))
        .app(walker.requires(["anchor"]).handles::<RequirementEvent>());
    if let Some(witness) = witness {
        node = node.app(witness.requires(["anchor"]).handles::<RequirementEvent>());
    }
    let node = node.app(desk).start().expect("a node");
    let api = NodeApi::connect(socket).expect("the node listens");
    Scene { node, sender: key.sender(), api, _directory: directory }
}

impl Scene {
    fn anchor(&self) -> Endpoint {
        let anchor = Registration::new().name("anchor");
        // Its name is free a moment after its former holder has gone.
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
fn an_application_that_pauses_handles_no_message_and_no_period_until_all_is_met_again() {
    const LIMIT: Duration = Duration::from_secs(4);
    const PERIOD: Duration = Duration::from_millis(1);
    // As many as the pause has; a machine that is busy misses fewer.
    const MADE_UP_FOR: u64 = (LIMIT.as_millis() / PERIOD.as_millis()) as u64;
    // Given: a period, and an input watchdog that would accuse within the pause
    let (walker, log) = Stage::new()
        .started(|_, context| {
            context.every(PERIOD, |puppet, tick, _| {
                puppet.say(if tick.missed < MADE_UP_FOR { "tick" } else { "made up for" });
            });
            context.watch_input::<Job>(None, LIMIT, |puppet, _, _| puppet.say("accused"));
        })
        .app("walker");
    let scene = start(walker.on_requirement_lost(RequirementPolicy::Pause), None);
    let anchor = scene.anchor();
    log.wait_for(Seen::Said(1, "tick"));
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
        assert!(!all.contains(&Seen::Said(1, never)), "{never}");
    }
    let ticks = all.iter().filter(|seen| **seen == Seen::Said(1, "tick")).count();
    log.wait_for_many(Seen::Said(1, "tick"), ticks + 3);
}

#[test]
fn the_tree_shows_who_is_paused_and_why_and_who_was_stopped_is_not_said_to_have_failed() {
    let ((walker, log), (anchor, _)) = (Stage::new().app("walker"), Stage::new().app("anchor"));
    let walker = walker.requires(["anchor"]).on_requirement_lost(RequirementPolicy::Pause);
    let node = Ground::new().node("node").app(anchor).app(walker).start().expect("a node");
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
fn an_application_that_pauses_is_stopped_in_order() {
    let (walker, log) = Stage::new().app("walker");
    let scene = start(walker.on_requirement_lost(RequirementPolicy::Pause), None);
    drop(scene.anchor());
    log.wait_for(lost());
    scene.node.stop();
    log.wait_for(Seen::Stopping(1));
}

#[test]
fn a_safe_state_is_entered_ahead_of_every_message_that_waits_and_left_when_all_is_met() {
    // Given: a walker with a message in its hand and a backlog behind it, and one that witnesses the loss
    let (let_go, held): (SyncSender<()>, _) = sync_channel(1);
    let held = Mutex::new(held);
    let (walker, log) = Stage::new()
        .got(move |puppet, _| {
            if puppet.number == 1 {
                puppet.say("in hand");
                let held = held.lock().expect("nobody panics with it").recv_timeout(DEADLINE);
                held.expect("the test lets it go on");
            }
        })
        .app("walker");
    let walker = walker.safe_state(
        |puppet, lost, _| {
            assert_eq!(lost.name(), "anchor");
            puppet.say("safe");
        },
        |puppet, _, _| puppet.say("back"),
    );
    let (witness, witnessed) = Stage::new().app("witness");
    let scene = start(walker, Some(witness));
    let anchor = scene.anchor();
    all_run(&[&scene.node]);
    let sender = &scene.sender;
    sender.send("walker", &Order { number: 1 }).expect("it has room");
    log.wait_for(Seen::Said(1, "in hand"));
    for number in 2..=200 {
        sender.send("walker", &Order { number }).expect("it has room");
    }
    // When: the witness, registered behind the walker, is told behind it
    drop(anchor);
    witnessed.wait_for(lost());
    let_go.send(()).expect("it waits");
    // Then
    log.wait_for(Seen::Got(1, 200));
    let hand = position(&log, &Seen::Said(1, "in hand"));
    assert_eq!(log.all()[hand + 1..hand + 4], [Seen::Said(1, "safe"), lost(), Seen::Got(1, 2)]);
    let _anchor = scene.anchor();
    log.wait_for(Seen::Said(1, "back"));
}

#[test]
fn an_application_that_restarts_goes_through_the_barrier_again_as_often_as_it_must() {
    let (walker, log) = Stage::new().app("walker");
    let walker = walker.on_requirement_lost(RequirementPolicy::Restart).restart(Restart::Transient);
    let scene = start(walker, None);
    // More often than the node would bear failures.
    for life in 1..=8 {
        let anchor = scene.anchor();
        log.wait_for(Seen::Started(life));
        assert!(!log.all().contains(&Seen::Started(life + 1)));
        drop(anchor);
        log.wait_for(Seen::Stopping(life));
    }
    assert_eq!(scene.node.stop(), sinew::node::NodeEnd::Stopped);
}

#[test]
fn an_application_that_carries_on_is_told_and_handles_what_comes() {
    let (walker, log) = Stage::new().app("walker");
    let scene = start(walker, None);
    drop(scene.anchor());
    log.wait_for(lost());
    scene.sender.send("walker", &Job { number: 1 }).expect("it has room");
    log.wait_for(Seen::Got(1, 1));
    let _anchor = scene.anchor();
    log.wait_for(met());
}

#[test]
fn a_safe_state_that_is_not_declared_is_refused_in_words() {
    let (walker, _log) = Stage::new().app("walker");
    let walker = walker.on_requirement_lost(RequirementPolicy::SafeState);
    let error = Ground::new().node("node").app(walker).start().expect_err("it has none");
    assert!(matches!(error, StartError::Application { .. }));
    assert!(error.to_string().contains("declare it with `safe_state`"), "{error}");
}
