//! Faults on real nodes: their effects, and their limits. One module for each theme.

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
use sinew_testkit::{
    DEADLINE, Log, Loopback, all_run,
    scripted::{Job, Script, ScriptedApp, Seen, sender_app, wait},
    until,
};

/// A fault, as a user would write it.
fn fault(text: &str) -> Fault {
    text.parse().unwrap_or_else(|error| panic!("{error}"))
}

/// A node with the application of `script`, as `declare` changes it, and the test's own sender on it.
fn perform(
    script: Script,
    declare: impl FnOnce(AppSpec<ScriptedApp>) -> AppSpec<ScriptedApp>,
) -> (Node, Sender, Log<Seen>) {
    let ((scripted, log), (sender_app, key)) = (script.app("scripted"), sender_app("sender"));
    let node = Loopback::new().node("node").app(declare(scripted)).app(sender_app).start().expect("a node");
    (node, key.sender(), log)
}

/// Sends the job until the scripted application has taken it; the attempts before it had outcomes, too.
#[track_caller]
fn gets_through(sender: &Sender, number: u64) {
    until("a job gets through", || {
        let sent = sender.message("scripted", &Job { number }).confirmed(DEADLINE).ok()?;
        (wait(sent) == Outcome::Delivered).then_some(())
    });
}

/// A node that tolerates 1,000 failures of its scripted application, with its log and a sender to it.
fn node_that_fails_at_each_job() -> (Node, Log<Seen>, Sender) {
    let script = Script::new().got(|_, _| panic!("each one"));
    let ((scripted, log), (sender_app, key)) = (script.app("scripted"), sender_app("sender"));
    let node = Loopback::new().node("node").configure(|config| config.supervision.app_restarts_max = 1_000);
    let node = node.app(scripted).app(sender_app).start().expect("a node");
    all_run(&[&node]);
    (node, log, key.sender())
}
