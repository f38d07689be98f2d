//! `sinew`: shows a running system, from any one node of it.
//!
//! It comes in through a node's socket like any other program, and asks each node's inspection (`sinew::inspect`) through ordinary
//! messages. It changes nothing, but for what `send` sends and the access
//! list that `reload` has a node read again. `keys` asks no node: it makes the files by which nodes know each other.

#![warn(clippy::print_stdout, clippy::print_stderr)] // `output` prints: the macros panic where a pipe is closed or a disk is full.

mod apps;
mod arguments;
mod audit;
mod doctor;
mod door;
mod keys;
mod messagepack;
mod nodes;
mod output;
mod ping;
mod reload;
mod security;
mod send;
mod system;
mod table;
mod tree;
mod watch;
mod why;

use std::{ffi::OsString, process::ExitCode};

use arguments::{Arguments, Command};
use system::{Fault, System};

/// Exit code where all is fine.
const EXIT_OK: u8 = 0;
/// Exit code where something was found.
const EXIT_FINDING: u8 = 1;
/// Exit code of a wrong command line; clap has the same.
const EXIT_USAGE: u8 = 2;
/// Exit code where no node lets us in, or the one that does gives no answer.
const EXIT_NO_NODE: u8 = 3;
/// Exit code where all is fine, but standard output did not take all of it.
const EXIT_NOT_WRITTEN: u8 = 4;

/// What a command has to say.
struct Report {
    /// For people.
    text: String,
    /// For programs.
    json: serde_json::Value,
    /// Whether all is fine.
    is_fine: bool,
}

fn main() -> ExitCode {
    let arguments = match Arguments::read() {
        Ok(arguments) => arguments,
        Err(error) => return refused(&error),
    };
    match run(&arguments) {
        Ok(said) => {
            let json = || if said.json.is_null() { String::new() } else { format!("{:#}\n", said.json) };
            let text = if arguments.json { json() } else { said.text };
            output::print(&text);
            output::exit_code(if said.is_fine { EXIT_OK } else { EXIT_FINDING })
        }
        Err(error) => {
            output::note(format_args!("sinew: {error}"));
            if arguments.json {
                print_fault(&error.to_string());
            }
            output::exit_code(error.code())
        }
    }
}

/// For programs, beside the words for people.
fn print_fault(why: &str) {
    output::line(&format!("{:#}", serde_json::json!({ "fault": why })));
}

/// A wrong command line, or one that asks for help or the version.
fn refused(error: &clap::Error) -> ExitCode {
    let printed = error.print();
    if !error.use_stderr() {
        // Help and version go to standard output.
        output::keep(printed);
        return output::exit_code(EXIT_OK);
    }
    if ask_for_json(std::env::args_os().skip(1)) {
        let why = error.render().to_string();
        print_fault(why.strip_prefix("error: ").unwrap_or(&why).trim_end());
    }
    output::exit_code(EXIT_USAGE)
}

/// Whether a command line that cannot be read asks for JSON. What stands behind `--` is no option.
fn ask_for_json(words: impl IntoIterator<Item = OsString>) -> bool {
    words.into_iter().take_while(|word| word != "--").any(|word| word == "--json")
}

fn run(arguments: &Arguments) -> Result<Report, Fault> {
    let inside = |show: &dyn Fn(&mut System) -> Result<Report, Fault>| {
        let mut system = System::enter(arguments.socket.as_deref(), arguments.within())?;
        let said = show(&mut system);
        system.leave();
        said
    };
    match &arguments.command {
        Command::Nodes => inside(&|system| nodes::show(system, arguments.wide)),
        Command::Apps => inside(&|system| apps::show(system, arguments.wide)),
        Command::Tree { node } => inside(&|system| tree::show(system, node.as_deref())),
        Command::Ping { target, count } => inside(&|system| ping::show(system, target, *count)),
        Command::Send(order) => inside(&|system| send::show(system, order)),
        Command::Watch(order) => inside(&|system| watch::show(system, order, arguments.json)),
        Command::Why(order) => inside(&|system| why::show(system, order, arguments.wide)),
        Command::Barriers => inside(&apps::barriers),
        Command::Audit => inside(&audit::show),
        Command::Reload => inside(&reload::show),
        Command::Doctor { interface } => Ok(doctor::show(interface.clone(), arguments)),
        Command::Keys(order) => keys::show(order),
        Command::Completions { shell } => Ok(completions(*shell)),
    }
}

/// The shell's file, as it is, whatever else was asked for.
fn completions(shell: clap_complete::Shell) -> Report {
    let mut bytes = Vec::new();
    clap_complete::generate(shell, &mut arguments::command(), "sinew", &mut bytes);
    let text = String::from_utf8_lossy(&bytes).into_owned();
    Report { json: serde_json::json!({ "shell": shell.to_string(), "text": text }), text, is_fine: true }
}
