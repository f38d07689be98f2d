//! `sinew`: shows a running system, from any one node of it.
//!
//! It connects through a node's socket like any other program, and asks each node's inspection (`sinew::inspect`)
//! through ordinary messages. It changes nothing, except that `send` sends messages, `reload` makes a node read
//! its access list again, `param` sets parameters of applications, and `stop` presses and releases the stop. `record`
//! has the node record its messages, and writes them to a file. `play` sends them again, by a node of its own unless
//! told otherwise. `keys` asks no node: it creates the files by which nodes authenticate each other. `bag` reads the
//! files of recordings. `up` and `down` start and end the nodes of a robot file, on this host and on others, and
//! `status` shows them. `view` keeps asking all nodes, for programs that read their metrics, `top` for its
//! screen, and `logs -f` for new lines.

#![warn(clippy::print_stdout, clippy::print_stderr)] // `output` prints: the macros panic where a pipe is closed or a disk is full.

mod apps;
mod arguments;
mod audit;
mod bag;
mod contracts;
mod doctor;
mod keys;
mod logs;
mod man;
mod messagepack;
mod nodes;
mod output;
mod param;
mod ping;
mod play;
mod record;
mod reload;
mod schema;
mod security;
mod send;
mod sockets;
mod stop;
mod system;
mod table;
mod top;
mod tree;
mod unknown;
mod up;
mod view;
mod watch;
mod why;

use std::{ffi::OsString, process::ExitCode};

use arguments::{Arguments, Command};
use system::{System, SystemError};

/// Exit code if all is fine.
const EXIT_OK: u8 = 0;
/// Exit code if there is a finding.
const EXIT_FINDING: u8 = 1;
/// Exit code of an invalid command line, the same as that of clap.
const EXIT_USAGE: u8 = 2;
/// Exit code if no node accepts this command, or the one that does gives no answer.
const EXIT_NO_NODE: u8 = 3;
/// Exit code if all is fine, but standard output did not accept all of the text.
const EXIT_NOT_WRITTEN: u8 = 4;

/// The result of a command.
struct Report {
    /// For users.
    text: String,
    /// For programs.
    json: serde_json::Value,
    /// Whether all is fine.
    is_fine: bool,
}

fn main() -> ExitCode {
    // The library's warnings are about this command's own questions, which its user has not sent.
    sinew::silence_default_log();
    let arguments = match Arguments::read() {
        Ok(arguments) => arguments,
        Err(error) => return refused(&error),
    };
    if let Command::Host(order) = &arguments.command {
        return up::host(order);
    }
    match run(&arguments) {
        Ok(report) => {
            let json = || if report.json.is_null() { String::new() } else { format!("{:#}\n", report.json) };
            let text = if arguments.json { json() } else { report.text };
            output::print(&text);
            output::exit_code(if report.is_fine { EXIT_OK } else { EXIT_FINDING })
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

/// Prints a fault for programs, in addition to the text for users.
fn print_fault(why: &str) {
    output::line(&format!("{:#}", serde_json::json!({ "fault": why })));
}

/// Handles an invalid command line, or a request for help or the version.
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

/// Returns whether an invalid command line asks for JSON. Words after `--` are no options.
fn ask_for_json(words: impl IntoIterator<Item = OsString>) -> bool {
    words.into_iter().take_while(|word| word != "--").any(|word| word == "--json")
}

fn run(arguments: &Arguments) -> Result<Report, SystemError> {
    let inside = |show: &dyn Fn(&mut System) -> Result<Report, SystemError>| {
        let mut system = System::enter(arguments.socket.as_deref(), arguments.within())?;
        let report = show(&mut system);
        system.leave();
        report
    };
    match &arguments.command {
        Command::Nodes => {
            let is_searched = sockets::is_searched(arguments.socket.as_deref());
            inside(&|system| nodes::show(system, arguments.wide, is_searched))
        }
        Command::Apps => inside(&|system| apps::show(system, arguments.wide)),
        Command::Tree { node } => inside(&|system| tree::show(system, node.as_deref(), arguments.wide)),
        Command::Ping { target, count } => inside(&|system| ping::show(system, target, *count)),
        Command::Send(order) => inside(&|system| send::show(system, order)),
        Command::Watch(order) => {
            inside(&|system| watch::show(system, order, (arguments.json, arguments.wide)))
        }
        Command::Logs(order) => match order.robot() {
            Some(file) => up::logs(file, order.node()),
            None => inside(&|system| logs::show(system, order, arguments.json)),
        },
        Command::Top => top::show(arguments),
        Command::Play(order) => play::show(order, arguments),
        Command::Record(order) => inside(&|system| record::show(system, order)),
        Command::View(order) => view::show(order, arguments),
        Command::Why(order) => inside(&|system| why::show(system, order, arguments.wide)),
        Command::Schema { name } => inside(&|system| schema::show(system, name)),
        Command::Barriers => inside(&|system| apps::barriers(system, arguments.wide)),
        Command::Audit => inside(&|system| audit::show(system, arguments.wide)),
        Command::Contracts => inside(&|system| contracts::show(system, arguments.wide)),
        Command::Param(order) => inside(&|system| param::show(system, order, arguments.wide)),
        Command::Reload => inside(&reload::show),
        Command::Stop(order) => inside(&|system| stop::show(system, order, arguments.wide)),
        Command::Up(order) => up::up(order, (arguments.json, arguments.wide)),
        Command::Down(order) => up::down(order, (arguments.json, arguments.wide)),
        Command::Status(order) => up::status(order, arguments.wide),
        // Handled before: it prints no report.
        Command::Host(_) => Err(SystemError::Usage("`host` is the part of `sinew up` on a host".to_owned())),
        Command::Doctor { rt: Some(length), .. } => Ok(doctor::show_real_time(*length, arguments.wide)),
        Command::Doctor { interface, rt: None } => Ok(doctor::show(interface.clone(), arguments)),
        Command::Keys(order) => keys::show(order, arguments.wide),
        Command::Bag(order) => bag::show(order, arguments.wide),
        Command::Completions { shell } => Ok(completions(*shell)),
        Command::Man { folder } => man::write(folder),
    }
}

/// Returns the completion file of the shell, regardless of other options.
fn completions(shell: clap_complete::Shell) -> Report {
    let mut bytes = Vec::new();
    clap_complete::generate(shell, &mut arguments::command(), "sinew", &mut bytes);
    let text = String::from_utf8_lossy(&bytes).into_owned();
    Report { json: serde_json::json!({ "shell": shell.to_string(), "text": text }), text, is_fine: true }
}
