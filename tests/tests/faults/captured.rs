//! User values that an application's factory captured. Their drop is user code: it can be slow, never return,
//! or panic.

use std::sync::{
    Mutex,
    mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel},
};

use sinew::{
    StartError,
    node::{CommandError, NodeEnd},
    prelude::*,
};
use sinew_testkit::{
    DEADLINE, Log, Loopback, all_run,
    scripted::{Script, Seen, SenderApp, outcome_of_job, sender_app},
    until,
};

/// Its drop does not return before the test permits it.
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

/// Lets the drop return when this is dropped, and holds the log of the drop.
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

/// An application; its factory has captured a value.
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

/// A node with an application that fails at 13, and a key to send to it.
fn with_a_knee(loopback: &Loopback) -> (NodeBuilder, Log<Seen>, SenderApp) {
    let ((sender_app, key), script) =
        (sender_app("sender"), Script::new().got(|scripted, _| assert!(scripted.number != 13)));
    let (knee, log) = script.app("knee");
    (loopback.node("node").app(knee).app(sender_app), log, key)
}

/// Checks that another application fails and is restarted.
fn supervision_goes_on(key: SenderApp, log: &Log<Seen>) {
    assert_eq!(outcome_of_job(&key.sender(), "knee", 13), Outcome::Failed);
    log.wait_for(Seen::Started(2));
}

#[test]
fn captured_value_of_removed_app_does_not_block_supervision() {
    let (captured, hold) = captured();
    let (builder, log, key) = with_a_knee(&Loopback::new());
    let node = builder.app(holder("app", captured)).start().expect("a node");
    // Releases the drop before the node ends, also if the test fails.
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
fn captured_value_of_rejected_app_does_not_block_supervision() {
    let (captured, hold) = captured();
    let (builder, log, key) = with_a_knee(&Loopback::new());
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
fn node_ends_despite_captured_values() {
    let (captured, mut hold) = captured();
    let (builder, _, _) = with_a_knee(&Loopback::new());
    let node = builder.app(holder("app", captured)).start().expect("a node");
    all_run(&[&node]);
    let (sender, receiver) = sync_channel(1);
    std::thread::spawn(move || sender.send(node.stop()).expect("it is waited for"));
    let end = receiver.recv_timeout(DEADLINE);
    assert_ne!(end, Err(RecvTimeoutError::Timeout), "the node waits for what is not its own");
    hold.ends();
}

#[test]
fn failed_start_is_reported_despite_captured_values() {
    let ((first, mut held), (second, mut held_too)) = (captured(), captured());
    let address = AppAddress::fixed(7).expect("a fixed one");
    let [first, second] =
        [("first", first), ("second", second)].map(|(name, it)| holder(name, it).address(address));
    let (sender, receiver) = sync_channel(1);
    std::thread::spawn(move || {
        let started = Loopback::new().node("node").app(first).app(second).start();
        sender.send(started.map(drop)).expect("it is waited for");
    });
    let started = receiver.recv_timeout(DEADLINE).expect("the start does not wait for what is not its own");
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
fn panic_in_drop_of_captured_value_affects_no_other() {
    let (builder, log, key) = with_a_knee(&Loopback::new());
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
