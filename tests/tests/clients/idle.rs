//! A client that takes nothing of what waits for it: other nodes know, nobody is told, and its node is not lost.

use std::process::Command;

use rustix::process::Signal;
use sinew::{
    Outcome, Tid,
    inspect::{AskNode, NodeReport, Ping},
    message::Sender,
    prelude::*,
};
use sinew_tests::{
    DEADLINE, Ground, Log, OwnDirectory, Program, all_run, program,
    puppet::{Seen, Stage, desk, send_jobs, wait},
    sees, until,
};

/// A node with clients: processes with a blocking endpoint, which say what they receive.
struct Scene {
    /// Of an application in the clients' node.
    sender: Sender,
    here: Node,
    /// What an application on the other node heard.
    heard: Log<Seen>,
    there: Node,
    directory: OwnDirectory,
}

impl Scene {
    fn new() -> Self {
        let (directory, ground) = (OwnDirectory::new(), Ground::new());
        // Answers some times in the time after which a client that takes nothing is said, and a loss that needs seconds.
        let watched = |builder: NodeBuilder| {
            builder.configure(|config| {
                (config.ndl.period, config.ndl.missed_max) = (Duration::from_millis(100), 40);
            })
        };
        let (watcher, heard) = Stage::new().app("watcher");
        let here = watched(ground.node("home")).app(watcher.handles::<NodeEvent>()).start().expect("a node");
        let (desk, key) = desk("desk");
        let socket = directory.join("node.sock");
        let opened = watched(ground.node("there")).configure(|config| config.lncl.socket = Some(socket));
        let there = opened.app(desk).start().expect("a node");
        all_run(&[&here, &there]);
        sees(&here.handle(), there.address());
        Self { sender: key.sender(), here, heard, there, directory }
    }

    /// A client that runs, and that the sender knows.
    fn client(&self, name: &str) -> (Program, Tid) {
        let mut command = Command::new(program("client_kills"));
        command.args(["--role", "recorder"]).arg(self.directory.join("node.sock")).arg(name);
        let mut client = Program::start(name, command);
        client.wait_for(&["up"]);
        (client, until("the client is known", || self.sender.resolve(name)))
    }

    /// The clients that take nothing, as the other node knows; `None` as long as it does not know that node.
    fn idle(&self) -> Option<Vec<(Tid, String)>> {
        let known = self.here.handle().members().pop()?;
        assert_eq!(known.idle_clients, known.idle.len(), "there are fewer than can be named");
        assert!(known.idle.iter().all(|client| client.since >= Duration::from_secs(1)), "{:?}", known.idle);
        Some(known.idle.into_iter().map(|client| (client.app, client.name)).collect())
    }

    /// Waits until the other node knows of any that take nothing. Which these are.
    fn wait_for_idle(&self) -> Vec<(Tid, String)> {
        until("a client that takes nothing is known", || self.idle().filter(|idle| !idle.is_empty()))
    }

    /// The same, as their own node says.
    fn idle_of_itself(&self) -> Vec<(Tid, String)> {
        let inspection = Tid::new(self.there.address(), AppAddress::INSPECT);
        let asked = self.sender.message(inspection, &AskNode {}).ask::<NodeReport>(DEADLINE);
        let said = wait(asked.expect("it has a place")).expect("an answer");
        assert_eq!(said.idle_clients as usize, said.idle.len(), "there are fewer than can be named");
        said.idle.into_iter().map(|client| (client.app, client.name)).collect()
    }

    /// Waits until it knows of none any more.
    fn wait_for_none(&self) {
        until("no client that takes nothing is known", || self.idle().filter(Vec::is_empty));
    }
}

// spec: NDL-9.1
#[test]
fn a_client_that_takes_nothing_is_known_to_other_nodes_until_it_does_or_is_gone_and_its_node_is_not_lost() {
    let scene = Scene::new();
    let (mut hand, tid) = scene.client("hand");
    let shown = [(tid, "hand".to_owned())];
    // When: messages come for it that it does not take.
    hand.freeze();
    send_jobs(&scene.sender, "hand", [1, 2]);
    // Then
    assert_eq!(scene.wait_for_idle(), shown);
    assert_eq!(scene.idle_of_itself(), shown);
    // When: it goes on.
    hand.signal(Signal::CONT);
    // Then
    hand.wait_for(&["bulk 2"]);
    scene.wait_for_none();
    // When: it is stopped again, and its process ends.
    hand.freeze();
    send_jobs(&scene.sender, "hand", [3]);
    assert_eq!(scene.wait_for_idle(), shown);
    hand.signal(Signal::KILL);
    // Then
    scene.wait_for_none();
    let is_lost = |seen: &Seen| matches!(seen, Seen::Node(NodeEvent::NodeLost { .. }));
    // Whichever else a busy machine has stall.
    let is_of_it = |seen: &Seen| matches!(seen, Seen::Node(NodeEvent::AppStalled { app, .. } | NodeEvent::AppResumed { app, .. }) if *app == tid);
    assert!(!scene.heard.all().iter().any(|seen| is_lost(seen) || is_of_it(seen)), "{:?}", scene.heard.all());
}

#[test]
fn stopped_clients_are_well_for_which_nothing_waits_or_nothing_but_pings() {
    let scene = Scene::new();
    let [(mut resting, _), (mut pinged, _), (mut hand, tid)] =
        ["resting", "pinged", "hand"].map(|name| scene.client(name));
    // Given: all have taken what came for them.
    for (client, name) in [(&mut resting, "resting"), (&mut pinged, "pinged"), (&mut hand, "hand")] {
        send_jobs(&scene.sender, name, [1]);
        client.wait_for(&["bulk 1"]);
        client.freeze();
    }
    // Whom a slow machine had leave that for a while is not named any more.
    scene.wait_for_none();
    // When: a message waits for one of them, later than a ping for another.
    let answer = scene.sender.message("pinged", &Ping {}).confirmed(DEADLINE).expect("it has a place");
    send_jobs(&scene.sender, "hand", [2]);
    // Then: what waits for the other one is seen in the same looks.
    assert_eq!(scene.wait_for_idle(), [(tid, "hand".to_owned())]);
    // When
    pinged.signal(Signal::CONT);
    // Then
    assert_eq!(wait(answer), Outcome::Delivered, "it did wait");
}
