//! Scenarios with whole nodes, and the roles of their processes. One program, `scenarios`, runs all of them
//! in their long form.

pub mod attacks;
pub mod barriers;
pub mod careless;
pub mod clients;
pub mod contracts;
pub mod link_faults;
pub mod load;
pub mod orders;
pub mod params;
pub mod recording;
pub mod roles;
pub mod slow_consumer;
pub mod stops;

use std::{path::Path, process::Command};

use sinew_testkit::{Host, NodeProcess, program, sandbox::after_shell};

/// The name of the program, which has all roles.
const PROGRAM: &str = "scenarios";

/// A command that starts a process in this role.
#[must_use]
pub fn role(name: &str) -> Command {
    let mut command = Command::new(program(PROGRAM));
    command.args(["--role", name]);
    command
}

/// The node of the scenarios, on `host` or on this one, with the configuration in `config`.
#[must_use]
pub fn node_under_test(host: Option<&Host>, config: &Path, arguments: &[&str]) -> NodeProcess {
    let mut command = role("node_under_test");
    command.arg(config).args(arguments);
    if let Some(host) = host {
        command = host.moved(&command);
    }
    NodeProcess::start(&config.display().to_string(), command)
}

/// The node of the scenarios with applications in processes of their own, with the configuration in `config`.
/// Its standard error is captured, too.
#[must_use]
pub fn process_under_test(config: &Path, arguments: &[&str]) -> NodeProcess {
    let mut command = role("process_under_test");
    command.arg(config).args(arguments);
    NodeProcess::start(&config.display().to_string(), after_shell("exec 2>&1", &command))
}
