//! `sinew`: shows a running system, from any one node of it.
//!
//! It comes in through a node's socket like any other program, and asks each node's inspection (`sinew::inspect`) through ordinary
//! messages. It changes nothing.

mod apps;
mod arguments;
mod door;
mod nodes;
mod system;
mod table;

use std::process::ExitCode;

use clap::Parser;

use arguments::{Arguments, Command};
use system::System;

/// Exit code where all is fine.
const FINE: u8 = 0;
/// Exit code where something was found, or could not be done.
const FINDING: u8 = 1;

/// What a command has to say.
struct Said {
    /// For people.
    text: String,
    /// For programs.
    json: serde_json::Value,
    /// Whether all is fine.
    is_fine: bool,
}

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    match run(&arguments) {
        Ok(said) => {
            let json = || format!("{:#}\n", said.json);
            let text = if arguments.json { json() } else { said.text };
            // A reader that has seen enough, as `head`, is no fault.
            let _ = std::io::Write::write_all(&mut std::io::stdout(), text.as_bytes());
            ExitCode::from(if said.is_fine { FINE } else { FINDING })
        }
        Err(error) => {
            eprintln!("sinew: {error}");
            ExitCode::from(FINDING)
        }
    }
}

fn run(arguments: &Arguments) -> Result<Said, system::Fault> {
    let system = || System::enter(arguments.socket.as_deref(), arguments.within());
    match &arguments.command {
        Command::Nodes => Ok(nodes::show(&mut system()?)?),
        Command::Apps => Ok(apps::show(&mut system()?)?),
        Command::Barriers => Ok(apps::barriers(&mut system()?)?),
    }
}
