//! Faults on real nodes: what happens, and what does not. One binary, one module a theme.

mod captured;
mod doors;
mod ends;
mod groups;
mod hangs;
mod layers;
mod load;
mod logs;
mod mailboxes;
mod panics;
mod points;
mod processes;
mod returns;

use sinew::{fault::Fault, message::Sender, prelude::*};
use sinew_tests::{
    Ground, Log, all_run,
    puppet::{Seen, Stage, desk},
};

/// A fault, as one would write it.
fn fault(text: &str) -> Fault {
    text.parse().unwrap_or_else(|error| panic!("{error}"))
}

/// A node that lets "puppet" fail 1,000 times, with the puppet's log and who can send to it.
fn node_with_a_puppet_that_fails_at_each_job() -> (Node, Log<Seen>, Sender) {
    let stage = Stage::new().got(|_, _| panic!("each one"));
    let ((puppet, log), (desk, key)) = (stage.app("puppet"), desk("desk"));
    let node = Ground::new().node("node").configure(|config| config.supervision.app_restarts_max = 1_000);
    let node = node.app(puppet).app(desk).start().expect("a node");
    all_run(&[&node]);
    (node, log, key.sender())
}
