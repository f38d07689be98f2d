//! Sinew beside iceoryx2, zenoh and what the system itself gives, in one harness and one table.
//!
//! `cargo run --release --manifest-path benches/peers/Cargo.toml [-- --short] [WORD...]` runs the cases whose name holds every
//! WORD. Each path is measured in fresh processes, one after the other, right behind the bare path that is its reference: the
//! rows of one payload, pace and pinning belong together. JSON lines are on the standard output, the table is on the standard
//! error; times are microseconds. All traffic stays on the loopback interface.
//!
//! On one machine: a bare ring in shared memory woken by a futex (the reference), a unix stream, iceoryx2 woken by its events,
//! and Sinew's endpoints in two processes with rings through their node, with direct links, and as tasks of tokio. Without
//! sleeping: a bare ring that is polled (the reference), iceoryx2 polled, and Sinew's direct links that look before they sleep.
//! Between nodes: blocking TCP (the reference), zenoh's peers over TCP with express publications, and Sinew's applications on
//! their node's IO thread and on threads of their own.
//!
//! A flood is one way: 1000 bytes as fast as they go until the last one is there, each kept until it can be sent.
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
#[allow(dead_code, reason = "the bench has a report of its own")]
mod one_way;
mod path;
#[path = "../../../actors/benches/ping/mod.rs"]
mod ping;
mod raw;
mod shared_memory;
mod zenoh;

use std::process::ExitCode;

use clap::Parser;

/// Sinew beside iceoryx2, zenoh and what the system itself gives: round trips and floods, one table.
#[derive(Parser)]
struct Arguments {
    /// A tenth of the rounds
    #[arg(long)]
    short: bool,
    /// Only cases whose name holds every one of these words; `list` prints the names
    words: Vec<String>,
}

fn main() -> ExitCode {
    if let Some(role) = sinew_figures::process::role() {
        path::play(&role);
        return ExitCode::SUCCESS;
    }
    let Arguments { short, words } = Arguments::parse();
    let cases: Vec<_> = path::cases().collect();
    if words == ["list"] {
        cases.iter().for_each(|case| println!("{}", case.name()));
        return ExitCode::SUCCESS;
    }
    eprintln!("machine: {}", sinew_figures::machine());
    sinew_figures::Beside::head();
    let wanted = cases.iter().filter(|case| words.iter().all(|word| case.name().contains(word.as_str())));
    let failed = wanted.filter(|case| !case.run(short)).count();
    eprintln!();
    flood::run(short, &words);
    if failed == 0 { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}
