//! What an application's factory captured is the user's, and so is its drop: slow, without end, or a panic.

use std::sync::{
    Mutex,
    mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel},
};

use sinew::{
    StartError,
    node::{CommandError, NodeEnd},
    prelude::*,
};
use sinew_tests::{
    DEADLINE, Ground, Log, all_run,
    puppet::{DeskKey, Seen, Stage, desk, outcome_of_job},
    until,
};

/// Is not dropped before the test says so.
struct Captured {
    log: Log<&'static str>,
    end: Mutex<Receiver<()>>,
}

impl Drop for Captured {
    fn drop(&mut self) {
        self.log.write("is being dropped");
        // The test has failed meanwhile, or drops its end.
        let _ = self.end.lock().map(|end| end.recv());
        self.log.write("is dropped");
    }
}

/// What lets the drop end, when this is dropped, and what is written of it.
struct Hold {
    log: Log<&'static str>,
    end: Option<SyncSender<()>>,
}

impl Hold {
    fn is_begun(&self) {
        self.log.wait_for("is being dropped");
    }

    fn ends(&mut self) {
        assert_eq!(self.log.all(), ["is being dropped"]);
        self.end.take();
        self.log.wait_for("is dropped");
    }
}

fn captured() -> (Captured, Hold) {
    let (log, (end, until)) = (Log::default(), sync_channel(1));
    (Captured { log: log.clone(), end: Mutex::new(until) }, Hold { log, end: Some(end) })
}

/// An application whose factory has captured something.
fn holder<T: Send + Sync + 'static>(name: &str, captured: T) -> AppSpec<Nothing> {
    AppSpec::new(name, move || {
        let _ = &captured;
        Nothing
    })
}

struct Nothing;

impl Actor for Nothing {
    type Context = AppContext<Self>;
}

/// A node with somebody who fails at 13, and who can tell it to.
fn with_a_knee(ground: &Ground) -> (NodeBuilder, Log<Seen>, DeskKey) {
    let ((desk, key), stage) = (desk("desk"), Stage::new().got(|puppet, _| assert!(puppet.number != 13)));
    let (knee, log) = stage.app("knee");
    (ground.node("node").app(knee).app(desk), log, key)
}

/// Somebody else fails, and comes back.
fn supervision_goes_on(key: DeskKey, log: &Log<Seen>) {
    assert_eq!(outcome_of_job(&key.sender(), "knee", 13), Outcome::Failed);
    log.wait_for(Seen::Started(2));
}

#[test]
fn what_a_removed_application_captured_and_does_not_let_go_holds_up_no_supervision() {
    let (captured, hold) = captured();
    let (builder, log, key) = with_a_knee(&Ground::new());
    let node = builder.app(holder("app", captured)).start().expect("a node");
    // Lets go before the node ends, whatever the test sees.
    let mut hold = hold;
    all_run(&[&node]);
    node.handle().stop_app("app").expect("it stops");
    node.handle().remove_app("app").expect("the answer does not wait for what it captured");
    hold.is_begun();
    supervision_goes_on(key, &log);
    until("its name is free", || node.handle().resolve("app").is_none().then_some(()));
    hold.ends();
}

#[test]
fn what_an_application_captured_that_was_not_taken_in_holds_up_no_supervision() {
    let (captured, hold) = captured();
    let (builder, log, key) = with_a_knee(&Ground::new());
    let node = builder.start().expect("a node");
    let mut hold = hold;
    all_run(&[&node]);
    let refused = node.handle().add_app(holder("knee", captured), None);
    assert!(matches!(refused, Err(CommandError::Start(StartError::SameName(_)))), "{refused:?}");
    hold.is_begun();
    supervision_goes_on(key, &log);
    hold.ends();
}

#[test]
fn a_node_ends_whatever_its_applications_captured() {
    let (captured, mut hold) = captured();
    let (builder, _, _) = with_a_knee(&Ground::new());
    let node = builder.app(holder("app", captured)).start().expect("a node");
    all_run(&[&node]);
    let (say, heard) = sync_channel(1);
    std::thread::spawn(move || say.send(node.stop()).expect("it is waited for"));
    let end = heard.recv_timeout(DEADLINE);
    assert_ne!(end, Err(RecvTimeoutError::Timeout), "the node waits for what is not its own");
    hold.ends();
}

#[test]
fn a_start_that_fails_is_told_whatever_its_applications_captured() {
    let ((first, mut held), (second, mut held_too)) = (captured(), captured());
    let address = AppAddress::fixed(7).expect("a fixed one");
    let [first, second] =
        [("first", first), ("second", second)].map(|(name, it)| holder(name, it).address(address));
    let (say, heard) = sync_channel(1);
    std::thread::spawn(move || {
        let started = Ground::new().node("node").app(first).app(second).start();
        say.send(started.map(drop)).expect("it is waited for");
    });
    let started = heard.recv_timeout(DEADLINE).expect("the start does not wait for what is not its own");
    assert!(matches!(started, Err(StartError::Application { .. })), "{started:?}");
    held.ends();
    held_too.ends();
}

struct Panics;

impl Drop for Panics {
    fn drop(&mut self) {
        panic!("what it captured panics");
    }
}

#[test]
fn a_panic_in_the_drop_of_what_a_removed_application_captured_is_nobody_elses() {
    let (builder, log, key) = with_a_knee(&Ground::new());
    let node = builder.app(holder("app", Panics)).start().expect("a node");
    all_run(&[&node]);
    node.handle().stop_app("app").expect("it stops");
    node.handle().remove_app("app").expect("the answer is given all the same");
    supervision_goes_on(key, &log);
    let (captured, mut hold) = captured();
    node.handle().add_app(holder("app", captured), None).expect("its name is free");
    node.handle().stop_app("app").expect("it stops");
    node.handle().remove_app("app").expect("it is removed");
    hold.is_begun();
    hold.ends();
    assert_eq!(node.stop(), NodeEnd::Stopped);
}
