//! `sinew-node CONFIGURATION`: a node without applications of its own, for programs that connect to its
//! socket.
//!
//! It prints `up` when they can connect, and stops in order at SIGINT, SIGTERM and SIGHUP. Its log is on the
//! standard error; `SINEW_LOG` sets the level (`SINEW_LOG=warn`). `--help` and `--version` print, and start
//! nothing. A node that cannot print `up`, as on a full disk, runs all the same, and exits with code 1 at the
//! end. A reader that has closed its pipe is no error.
//!
//! With `record.file` in its configuration it writes a recording, and finishes it at its end, within 10 s. A recording
//! that does not begin, or is not whole, stops no node: the exit code at the end is 1.

#![warn(clippy::print_stdout, clippy::print_stderr)] // The macros panic where a pipe is closed or a disk is full.

use std::{
    fmt::Display,
    io::{self, Write as _},
    process::ExitCode,
    time::Duration,
};

use sinew_model::config::NodeConfig;
use sinew_node::Node;
use sinew_recorder::{End, Recording, RecordingError};
use sinew_runtime::log;

/// Time limit for the end of the recording, after the node has ended.
const RECORDING_ENDS_WITHIN: Duration = Duration::from_secs(10);

const HELP: &str = "\
A node with no application of its own, for programs that come in through its socket

Usage: sinew-node CONFIGURATION

Arguments:
  CONFIGURATION  The node's configuration, a TOML file that sets lncl.socket (docs/book/src/reference/configuration.md)

Options:
  -h, --help     Print help
  -V, --version  Print version

It prints `up` when programs can connect, and stops in order at SIGINT, SIGTERM and SIGHUP. SINEW_LOG sets the level of its log (SINEW_LOG=warn).

Exit codes:
  0  it was stopped in order
  1  it could not start, or gave up; or its recording is not whole
  2  the command line is wrong

Example:
  sinew-node bindings/c/examples/knee.toml
";

fn main() -> ExitCode {
    let arguments: Vec<_> = std::env::args().skip(1).collect();
    let words: Vec<_> = arguments.iter().map(String::as_str).collect();
    match words[..] {
        ["-h" | "--help"] => printed(HELP),
        ["-V" | "--version"] => printed(concat!("sinew-node ", env!("CARGO_PKG_VERSION"), "\n")),
        ["--", path] => run(path),
        [option] if option.starts_with('-') => {
            usage(format_args!("there is no option {option:?}; a file of this name is ./{option}"))
        }
        [path] => run(path),
        [] => usage(format_args!("the configuration of the node is missing")),
        [..] => usage(format_args!("there are {} arguments, and one is legal", words.len())),
    }
}

/// A wrong command line.
fn usage(why: impl Display) -> ExitCode {
    note(format_args!("{why}. Usage: sinew-node CONFIGURATION; see `sinew-node --help`"));
    ExitCode::from(2)
}

/// Prints a text that the user requested.
fn printed(text: &str) -> ExitCode {
    let mut out = io::stdout();
    match out.write_all(text.as_bytes()).and_then(|()| out.flush()) {
        Err(error) if error.kind() != io::ErrorKind::BrokenPipe => {
            note(format_args!("standard output is incomplete: {error}; free space on its device"));
            ExitCode::FAILURE
        }
        Ok(()) | Err(_) => ExitCode::SUCCESS,
    }
}

fn run(path: &str) -> ExitCode {
    match start(path) {
        Ok((node, config)) => {
            let recording = record(&config);
            let is_printed = print_up();
            let code = node.run();
            let is_recorded = recording.is_ok_and(|recording| recording.is_none_or(finish));
            let is_fine = is_printed && is_recorded;
            if is_fine || code != ExitCode::SUCCESS { code } else { ExitCode::FAILURE }
        }
        Err(why) => {
            note(why);
            ExitCode::FAILURE
        }
    }
}

/// Prints that programs can connect. Returns true if standard output accepted it, or has no reader.
fn print_up() -> bool {
    let mut out = io::stdout();
    let Err(error) = out.write_all(b"up\n").and_then(|()| out.flush()) else { return true };
    if error.kind() == io::ErrorKind::BrokenPipe {
        return true;
    }
    note(format_args!(
        "the node is up, but standard output could not be written: {error}; free space on its device"
    ));
    false
}

/// Prints a line to standard error; ignores a failure.
fn note(text: impl Display) {
    let _ = writeln!(io::stderr(), "sinew-node: {text}");
}

/// Finishes the file of the recording. Returns whether it has all messages.
fn finish(recording: Recording) -> bool {
    let file = recording.file().display().to_string();
    match recording.finish_within(RECORDING_ENDS_WITHIN) {
        Ok(summary) => {
            summary.faults.iter().for_each(|fault| note(format_args!("the recording {file}: {fault}")));
            if let End::Full | End::Unreadable(_) = &summary.end {
                note(format_args!("the recording {file}: {}", summary.end));
            }
            summary.is_whole()
        }
        Err(why) => {
            note(format_args!("the recording {file}: {why}"));
            false
        }
    }
}

/// Starts the node of a configuration.
fn start(path: &str) -> Result<(Node, NodeConfig), Box<dyn std::error::Error>> {
    let config = NodeConfig::from_file(path)?;
    if config.lncl.socket.is_none() {
        return Err(format!("{path} sets no lncl.socket: no program could come in").into());
    }
    let builder = Node::builder(config.name.clone()).config(config.clone()).heed_signals();
    Ok((builder.writes_recording().start()?, config))
}

/// Begins the recording that the configuration asks for. Applications may run already, so that a failure does not stop
/// the node.
fn record(config: &NodeConfig) -> Result<Option<Recording>, RecordingError> {
    Recording::configured(config).inspect_err(|why| {
        log::error!(%why, "record.file is not written");
        log::print(format!("sinew-node: record.file is not written: {why}"));
    })
}
