//! A client that takes nothing of what waits for it: other nodes are told, and its node is not lost.

use std::process::Command;

use rustix::process::Signal;
use sinew::{Sender, Tid, Trouble, prelude::*};
use sinew_tests::{
    Ground, Log, OwnDirectory, Program, all_run, program,
    puppet::{Seen, Stage, desk, send_jobs},
    sees, until,
};

/// The client: a process with a blocking endpoint, which says what it receives.
const CLIENT: &str = "hand";

struct Scene {
    client: Program,
    client_tid: Tid,
    /// Of an application in the client's node.
    sender: Sender,
    here: Node,
    /// What an application on the other node heard.
    heard: Log<Seen>,
    _there: Node,
    _directory: OwnDirectory,
}

impl Scene {
    fn new() -> Self {
        let (directory, ground) = (OwnDirectory::new(), Ground::new());
        let socket = directory.join("node.sock");
        // Answers twice in the time in which a client that takes nothing is told, and a loss that needs seconds.
        let watched = |builder: NodeBuilder| {
            builder.configure(|config| {
                (config.ndl.period, config.ndl.missed_max) = (Duration::from_millis(100), 40);
            })
        };
        let (watcher, heard) = Stage::new().app("watcher");
        let here = watched(ground.node("here")).app(watcher.handles::<NodeEvent>()).start().expect("a node");
        let (desk, key) = desk("desk");
        let opened =
            watched(ground.node("there")).configure(|config| config.lncl.socket = Some(socket.clone()));
        let there = opened.app(desk).start().expect("a node");
        all_run(&[&here, &there]);
        sees(&here.handle(), there.address());
        let mut command = Command::new(program("client_kills"));
        command.args(["--role", "recorder"]).arg(&socket).arg(CLIENT);
        let mut client = Program::start(CLIENT, command);
        client.wait_for(&["up"]);
        let sender = key.sender();
        let client_tid = until("the client is known", || sender.resolve(CLIENT));
        Self { client, client_tid, sender, here, heard, _there: there, _directory: directory }
    }

    /// Waits until the other node was told this of the client, in this order, and nothing else.
    fn wait_for(&self, words: &[&str]) {
        let told: Vec<_> = words.iter().map(|word| (*word, "there".to_owned(), self.client_tid)).collect();
        self.heard.wait(&format!("{words:?}"), |seen| (told_of_client(seen) == told).then_some(()));
    }

    /// What the other node knows not to get on of the client.
    fn known(&self) -> Vec<(Tid, Trouble)> {
        let known = self.here.handle().members();
        let troubles = known.iter().flat_map(|node| &node.troubles).filter(|one| one.name == CLIENT);
        troubles.map(|one| (one.app, one.trouble)).collect()
    }
}

/// What was told of the client, whichever else a busy machine has stall: a word, the node's name, and the client's address.
fn told_of_client(seen: &[Seen]) -> Vec<(&'static str, String, Tid)> {
    let told = seen.iter().filter_map(|seen| {
        let Seen::Node(event) = seen else { return None };
        if let NodeEvent::AppStalled { name, app, app_name, trouble: Trouble::Stalled, .. } = event {
            (app_name == CLIENT).then(|| ("stalled", name.clone(), *app))
        } else if let NodeEvent::AppResumed { name, app, app_name, .. } = event {
            (app_name == CLIENT).then(|| ("resumed", name.clone(), *app))
        } else {
            None
        }
    });
    told.collect()
}

// spec: NDL-9.1
#[test]
fn a_client_that_takes_nothing_is_named_to_other_nodes_until_it_does_or_is_gone_and_its_node_is_not_lost() {
    let mut scene = Scene::new();
    // When: messages come for it that it does not take.
    scene.client.freeze();
    send_jobs(&scene.sender, CLIENT, [1, 2]);
    // Then: it is named, in what is told and in what is known.
    scene.wait_for(&["stalled"]);
    assert_eq!(scene.known(), [(scene.client_tid, Trouble::Stalled)]);
    // When: it goes on.
    scene.client.signal(Signal::CONT);
    // Then
    scene.client.wait_for(&["bulk 2"]);
    scene.wait_for(&["stalled", "resumed"]);
    assert_eq!(scene.known(), []);
    // When: it is stopped again, and its process ends.
    scene.client.freeze();
    send_jobs(&scene.sender, CLIENT, [3]);
    scene.wait_for(&["stalled", "resumed", "stalled"]);
    scene.client.signal(Signal::KILL);
    // Then
    scene.wait_for(&["stalled", "resumed", "stalled", "resumed"]);
    assert_eq!(scene.known(), []);
    let lost = |seen: &Seen| matches!(seen, Seen::Node(NodeEvent::NodeLost { .. }));
    assert!(!scene.heard.all().iter().any(lost), "{:?}", scene.heard.all());
}

/// How often the client's node has to answer before it is believed that it says nothing of the client: some times what a stall takes.
const ANSWERS: usize = 20;

#[test]
fn a_client_for_which_nothing_waits_is_well_also_where_it_is_stopped() {
    // Given: one that has taken what came for it.
    let mut scene = Scene::new();
    send_jobs(&scene.sender, CLIENT, [1]);
    scene.client.wait_for(&["bulk 1"]);
    // When
    scene.client.freeze();
    // Then
    let mut before = None;
    for answer in 0..ANSWERS {
        before = until(&format!("answer {answer} of the client's node"), || {
            let last = scene.here.handle().members().first().map(|node| node.heard);
            (last.is_some() && last != before).then_some(last)
        });
    }
    assert_eq!(told_of_client(&scene.heard.all()), []);
    scene.client.signal(Signal::CONT);
    send_jobs(&scene.sender, CLIENT, [2]);
    scene.client.wait_for(&["bulk 2"]);
}
