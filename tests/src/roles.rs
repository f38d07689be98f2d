//! The roles of processes: the program of the scenarios starts itself again with `--role NAME`.

mod commanded;
mod node_under_test;
mod process_under_test;
mod unread_log;

use std::process::ExitCode;

use crate::{attacks, barriers, clients, contracts, link_faults, params, recording, slow_consumer, stops};

/// The options of a role, after its configuration.
struct Options<'a>(&'a [String]);

impl Options<'_> {
    fn has(&self, name: &str) -> bool {
        self.0.iter().any(|argument| argument == name)
    }

    /// The values of an option that may be repeated.
    fn values(&self, name: &str) -> Vec<String> {
        let pairs = self.0.windows(2).filter(|pair| pair[0] == name);
        pairs.map(|pair| pair[1].clone()).collect()
    }

    fn value(&self, name: &str) -> Option<String> {
        self.values(name).into_iter().next()
    }
}

/// Runs the role that this process was started for; `None` if it has none.
#[must_use]
pub fn run() -> Option<ExitCode> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [flag, role, arguments @ ..] = &arguments[..] else { return None };
    if flag != "--role" {
        return None;
    }
    match &**role {
        "command_node" => return Some(commanded::run_node(arguments)),
        "commanded" => return Some(commanded::run_program(arguments)),
        "node_under_test" => return Some(node_under_test::run(arguments)),
        "process_under_test" => return Some(process_under_test::run(arguments)),
        "unread_log" => return Some(unread_log::run(arguments)),
        "robot-node" => attacks::run_node(arguments),
        "decoy" => attacks::run_decoy(arguments),
        "party" => barriers::run_party(arguments),
        "link-node" => link_faults::run_node(arguments),
        "contract-node" => contracts::run_node(arguments),
        "recorded" => recording::run_node(arguments),
        "param-node" => params::run_node(arguments),
        "stop-node" => stops::run_node(arguments),
        "sender" => slow_consumer::run_sender(arguments),
        "receiver" => slow_consumer::run_receiver(arguments),
        client => clients::run_role(client, arguments),
    }
    Some(ExitCode::SUCCESS)
}
