//! Sinew beside iceoryx2, zenoh and the primitives of the system, in one harness and one table.
//!
//! `cargo run --release --manifest-path benches/peers/Cargo.toml [-- --short] [WORD...]` runs the cases that
//! have every WORD in their names. Each path is measured in fresh processes, one after the other, directly
//! after its reference, the bare path. The rows of one payload, pace and pinning belong together. The
//! standard output has JSON lines, the standard error the table. Times are microseconds. All traffic stays on
//! the loopback interface. `--json FILE` writes a file of results for `benches/charts`; its format is described
//! in `sinew_figures::results`.
//!
//! On one machine: a bare ring in shared memory woken by a futex (the reference), a unix stream, iceoryx2
//! woken by its events, and Sinew's endpoints in two processes. The latter use rings through their node,
//! direct links, and tokio tasks. Without sleeping: a polled bare ring (the reference), polled iceoryx2, and
//! Sinew's direct links that poll before they sleep. Between nodes: blocking TCP (the reference), zenoh's
//! peers over TCP with express publications, and Sinew's applications. These are on their node's IO thread
//! and on their own threads.
//!
//! A flood is one way: 1000 bytes as fast as possible until the last one has arrived; each packet is kept
//! until there is room for it.
//!
//! Sinew's applications are those of its own bench, `cargo bench -p sinew --bench gncl`.

mod applications;
mod flood;
mod iceoryx2;
#[path = "../../../actors/benches/gncl/keys.rs"]
#[allow(dead_code, reason = "nobody has keys here: the others have none either")]
mod keys;
#[path = "../../../actors/benches/gncl/nodes.rs"]
#[allow(dead_code, reason = "the bench has cases in namespaces besides")]
mod nodes;
#[path = "../../../actors/benches/gncl/flood.rs"]
#[allow(dead_code, reason = "the bench has a report of its own, without CPU times")]
mod one_way;
mod path;
#[path = "../../../actors/benches/ping/mod.rs"]
mod ping;
mod raw;
mod shared_memory;
mod zenoh;

use std::{path::PathBuf, process::ExitCode};

use clap::Parser;
use sinew_figures::results::Recorder;

/// The command that runs this program, without its arguments.
const COMMAND: &str = "cargo run --release --manifest-path benches/peers/Cargo.toml";

/// Sinew beside iceoryx2, zenoh and the primitives of the system: round trips and floods, one table.
#[derive(Parser)]
struct Arguments {
    /// A tenth of the rounds
    #[arg(long)]
    short: bool,
    /// Write the results to this file, too, for `benches/charts`
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// Only cases that have every one of these words in their names; `list` prints the names
    words: Vec<String>,
}

fn main() -> ExitCode {
    if let Some(role) = sinew_figures::process::role() {
        path::play(&role);
        return ExitCode::SUCCESS;
    }
    let Arguments { short, json, words } = Arguments::parse();
    let cases: Vec<_> = path::cases().collect();
    if words == ["list"] {
        cases.iter().for_each(|case| println!("{}", case.name()));
        return ExitCode::SUCCESS;
    }
    let mut recorder = match Recorder::start(json, command(short, &words)) {
        Ok(recorder) => recorder,
        Err(why) => {
            eprintln!("the file of --json cannot be written: {why}");
            return ExitCode::from(2);
        }
    };
    eprintln!("machine: {}", sinew_figures::machine());
    sinew_figures::Beside::head();
    let wanted = cases.iter().filter(|case| words.iter().all(|word| case.name().contains(word.as_str())));
    let failed = wanted.filter(|case| !case.run(short, &mut recorder)).count();
    eprintln!();
    flood::run(short, &words, &mut recorder);
    if let Err(why) = recorder.finish() {
        eprintln!("the file of --json cannot be written: {why}");
        return ExitCode::FAILURE;
    }
    if failed == 0 { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}

/// Returns the command that repeats this run.
fn command(is_short: bool, words: &[String]) -> String {
    let mut arguments: Vec<&str> = words.iter().map(String::as_str).collect();
    if is_short {
        arguments.insert(0, "--short");
    }
    if arguments.is_empty() { COMMAND.to_owned() } else { format!("{COMMAND} -- {}", arguments.join(" ")) }
}
