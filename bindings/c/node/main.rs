//! `sinew-node CONFIGURATION`: a node with no application of its own, for programs that come in through its socket.
//!
//! It prints `up` when they can connect, and stops in order at SIGINT, SIGTERM and SIGHUP. Its log is on the standard error; `SINEW_LOG` sets the
//! level (`SINEW_LOG=warn`). A node that cannot print `up`, as on a full disk, runs all the same, and has exit code 1 in the end. A
//! reader that has closed its pipe is no error.

#![warn(clippy::print_stdout, clippy::print_stderr)] // The macros panic where a pipe is closed or a disk is full.

use std::{
    fmt::Display,
    io::{self, Write as _},
    process::ExitCode,
};

use sinew::{Node, NodeConfig};

fn main() -> ExitCode {
    let mut arguments = std::env::args().skip(1);
    let (Some(path), None) = (arguments.next(), arguments.next()) else {
        note("give it one file, the node's configuration (docs/CONFIGURATION.md)");
        return ExitCode::FAILURE;
    };
    match start(&path) {
        Ok(node) => {
            let is_said = say_up();
            let code = node.run();
            if is_said || code != ExitCode::SUCCESS { code } else { ExitCode::FAILURE }
        }
        Err(why) => {
            note(why);
            ExitCode::FAILURE
        }
    }
}

/// Says that programs may come. Returns whether standard output took it, or has no reader.
fn say_up() -> bool {
    let mut out = io::stdout();
    let Err(error) = out.write_all(b"up\n").and_then(|()| out.flush()) else { return true };
    if error.kind() == io::ErrorKind::BrokenPipe {
        return true;
    }
    note(format_args!(
        "the node is up, and standard output did not take that: {error}; free space where it goes"
    ));
    false
}

/// Prints a line to standard error. Nothing can be done where that fails.
fn note(text: impl Display) {
    let _ = writeln!(io::stderr(), "sinew-node: {text}");
}

fn start(path: &str) -> Result<Node, Box<dyn std::error::Error>> {
    let config = NodeConfig::from_file(path)?;
    if config.lncl.socket.is_none() {
        return Err(format!("{path} sets no lncl.socket: no program could come in").into());
    }
    Ok(Node::builder(config.name.clone()).config(config).heed_signals().start()?)
}
