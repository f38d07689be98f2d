//! A client that does not read its messages: other nodes know of it, no notification is sent, and its node is
//! not lost.

use sinew_tests::role;

use rustix::process::Signal;
use sinew::{
    Outcome, Tid,
    inspect::{AskNode, NodeReport, Ping},
    message::Sender,
    prelude::*,
};
use sinew_testkit::{
    DEADLINE, Log, Loopback, NodeProcess, TestDirectory, all_run,
    scripted::{Script, Seen, send_jobs, sender_app, wait},
    sees, until,
};

/// A node with clients: processes with a blocking endpoint that report the messages that they receive.
struct Scene {
    /// The sender of an application in the clients' node.
    sender: Sender,
    here: Node,
    /// Events of an application on the other node.
    seen: Log<Seen>,
    there: Node,
    directory: TestDirectory,
}

impl Scene {
    fn new() -> Self {
        let (directory, loopback) = (TestDirectory::new(), Loopback::new());
        // Several answers fit into the time after which an idle client is reported; a loss takes seconds.
        let watched = |builder: NodeBuilder| {
            builder.configure(|config| {
                (config.ndl.period, config.ndl.missed_max) = (Duration::from_millis(100), 40);
            })
        };
        let (watcher, seen) = Script::new().app("watcher");
        let here =
            watched(loopback.node("home")).app(watcher.handles::<NodeEvent>()).start().expect("a node");
        let (sender_app, key) = sender_app("sender");
        let socket = directory.join("node.sock");
        let opened = watched(loopback.node("there")).configure(|config| config.lncl.socket = Some(socket));
        let there = opened.app(sender_app).start().expect("a node");
        all_run(&[&here, &there]);
        sees(&here.handle(), there.address());
        Self { sender: key.sender(), here, seen, there, directory }
    }

    /// A running client that the sender knows.
    fn client(&self, name: &str) -> (NodeProcess, Tid) {
        let mut command = role("recorder");
        command.arg(self.directory.join("node.sock")).arg(name);
        let mut client = NodeProcess::start(name, command);
        client.wait_for(&["up"]);
        (client, until("the client is known", || self.sender.resolve(name)))
    }

    /// The idle clients, as the other node knows them; `None` while it does not know that node.
    fn idle(&self) -> Option<Vec<(Tid, String)>> {
        let known = self.here.handle().members().pop()?;
        assert_eq!(known.idle_clients, known.idle.len(), "there are fewer than can be named");
        assert!(known.idle.iter().all(|client| client.since >= Duration::from_secs(1)), "{:?}", known.idle);
        Some(known.idle.into_iter().map(|client| (client.app, client.name)).collect())
    }

    /// Waits until the other node knows of idle clients. Returns them.
    fn wait_for_idle(&self) -> Vec<(Tid, String)> {
        until("a client that takes nothing is known", || self.idle().filter(|idle| !idle.is_empty()))
    }

    /// The idle clients as their own node reports them.
    fn idle_of_itself(&self) -> Vec<(Tid, String)> {
        let inspection = Tid::new(self.there.address(), AppAddress::INSPECT);
        let asked = self.sender.message(inspection, &AskNode {}).ask::<NodeReport>(DEADLINE);
        let report = wait(asked.expect("it has a place")).expect("an answer");
        assert_eq!(report.idle_clients as usize, report.idle.len(), "there are fewer than can be named");
        report.idle.into_iter().map(|client| (client.app, client.name)).collect()
    }

    /// Waits until the other node knows of no idle client.
    fn wait_for_none(&self) {
        until("no client that takes nothing is known", || self.idle().filter(Vec::is_empty));
    }
}

// spec: NDL-9.1
#[test]
fn other_nodes_know_an_idle_client_until_it_reads() {
    let scene = Scene::new();
    let (mut hand, tid) = scene.client("hand");
    let shown = [(tid, "hand".to_owned())];
    // When: messages arrive for it and it does not read them.
    hand.pause();
    send_jobs(&scene.sender, "hand", [1, 2]);
    // Then
    assert_eq!(scene.wait_for_idle(), shown);
    assert_eq!(scene.idle_of_itself(), shown);
    // When: it continues.
    hand.signal(Signal::CONT);
    // Then
    hand.wait_for(&["bulk 2"]);
    scene.wait_for_none();
    // When: it is stopped again, and its process ends.
    hand.pause();
    send_jobs(&scene.sender, "hand", [3]);
    assert_eq!(scene.wait_for_idle(), shown);
    hand.signal(Signal::KILL);
    // Then
    scene.wait_for_none();
    let is_lost = |seen: &Seen| matches!(seen, Seen::Node(NodeEvent::NodeLost { .. }));
    // Ignores other applications that stall on a busy machine.
    let is_of_it = |seen: &Seen| matches!(seen, Seen::Node(NodeEvent::AppStalled { app, .. } | NodeEvent::AppResumed { app, .. }) if *app == tid);
    assert!(!scene.seen.all().iter().any(|seen| is_lost(seen) || is_of_it(seen)), "{:?}", scene.seen.all());
}

#[test]
fn clients_without_waiting_messages_are_not_idle() {
    let scene = Scene::new();
    let [(mut resting, _), (mut pinged, _), (mut hand, tid)] =
        ["resting", "pinged", "hand"].map(|name| scene.client(name));
    // Given: all have read their messages.
    for (client, name) in [(&mut resting, "resting"), (&mut pinged, "pinged"), (&mut hand, "hand")] {
        send_jobs(&scene.sender, name, [1]);
        client.wait_for(&["bulk 1"]);
        client.pause();
    }
    // Clients that were slow to read on a slow machine are no longer listed.
    scene.wait_for_none();
    // When: a message waits for one of them, later than a ping for another.
    let answer = scene.sender.message("pinged", &Ping {}).confirmed(DEADLINE).expect("it has a place");
    send_jobs(&scene.sender, "hand", [2]);
    // Then: messages that wait for the other client are found by the same checks.
    assert_eq!(scene.wait_for_idle(), [(tid, "hand".to_owned())]);
    // When
    pinged.signal(Signal::CONT);
    // Then
    assert_eq!(wait(answer), Outcome::Delivered, "it did wait");
}
