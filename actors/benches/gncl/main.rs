//! What messages between two nodes cost while others are under way between the same two.
//!
//! `cargo bench -p sinew --bench gncl [-- WORD...]` runs the cases whose name holds every WORD, each in two fresh processes, a
//! node in each. JSON lines are on the standard output, a table on the standard error. Times are microseconds, there and back.
//! Nothing here asserts a time.
//!
//! - `control_beside_bulk_N`: round trips of 64 bytes in class Control, one every millisecond: first alone, then beside a
//!   flood of Bulk messages of N bytes to another application of the other node, as fast as they are taken. What counts is the
//!   p99 beside the flood by the p99 alone (`p99_ratio_percent`).
//! - `control_beside_slow_consumer`: the same, and the application that is flooded takes a millisecond for each of its messages.

mod ends;

use std::{
    io::{BufRead, BufReader},
    process::{Child, Command, ExitCode, Stdio},
    time::Duration,
};

use sinew_figures::Alone;

/// The role of a process that this program starts of itself.
const ROLE: &str = "SINEW_GNCL_ROLE";

/// A case: the length of the Bulk messages in bytes, and how long whoever takes them takes for each.
struct Case {
    name: &'static str,
    bulk_bytes: usize,
    pause_us: u64,
}

const CASES: &[Case] = &[
    Case { name: "control_beside_bulk_1000", bulk_bytes: 1_000, pause_us: 0 },
    Case { name: "control_beside_bulk_65536", bulk_bytes: 65_536, pause_us: 0 },
    Case { name: "control_beside_bulk_1000000", bulk_bytes: 1_000_000, pause_us: 0 },
    Case { name: "control_beside_slow_consumer", bulk_bytes: 1_000, pause_us: 1_000 },
];

fn main() -> ExitCode {
    if let Ok(role) = std::env::var(ROLE) {
        return play(&role);
    }
    sinew_figures::head();
    let words: Vec<String> = std::env::args().skip(1).filter(|arg| !arg.starts_with('-')).collect();
    let wanted = CASES.iter().filter(|case| words.iter().all(|word| case.name.contains(word.as_str())));
    let failed = wanted.filter(|case| !run(case)).count();
    if failed == 0 { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}

/// Runs a case in a process of its own.
fn run(case: &Case) -> bool {
    let status = this_program(&format!("measure {}", case.name)).stdin(Stdio::null()).status();
    let worked = status.is_ok_and(|status| status.success());
    if !worked {
        eprintln!("{}: failed", case.name);
    }
    worked
}

fn this_program(role: &str) -> Command {
    let mut command = Command::new(std::env::current_exe().expect("this program has a path"));
    command.env(ROLE, role);
    command
}

fn play(role: &str) -> ExitCode {
    let words: Vec<&str> = role.split(' ').collect();
    match words[..] {
        ["measure", name] => {
            let case = CASES.iter().find(|case| case.name == name);
            measure(case.expect("a name that this program wrote itself"));
        }
        ["echo", group, pause_us] => {
            let pause_us = pause_us.parse().expect("a number that this program wrote itself");
            ends::echo(group, Duration::from_micros(pause_us));
        }
        _ => {
            eprintln!("no such role: {role}");
            return ExitCode::FAILURE;
        }
    }
    ExitCode::SUCCESS
}

fn measure(case: &Case) {
    let process = std::process::id();
    let group = format!("239.255.84.{}:{}", process % 200 + 1, 20_000 + process % 20_000);
    let _other = Other::start(&group, case.pause_us);
    let seen = ends::measure(&group, case.bulk_bytes);
    let report = |figure, seen, counts: &[(&str, u64)]| {
        Alone { bench: "gncl", case: case.name, figure, seen, counts }.report();
    };
    report("Control alone", &seen.alone, &[]);
    let counts = [
        ("bulk_mib_per_s", seen.bulk_bytes_per_s >> 20),
        (
            "p99_ratio_percent",
            (seen.beside.p99().as_nanos() * 100 / seen.alone.p99().as_nanos().max(1)) as u64,
        ),
    ];
    report("Control beside the flood", &seen.beside, &counts);
}

/// The other node's process; it is ended when this is dropped.
struct Other(Child);

impl Other {
    fn start(group: &str, pause_us: u64) -> Self {
        let mut command = this_program(&format!("echo {group} {pause_us}"));
        let mut child = command
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .expect("a process for the other node");
        let output = child.stdout.take().expect("its output is a pipe");
        BufReader::new(output).read_line(&mut String::new()).expect("the other node says that it is there");
        Self(child)
    }
}

impl Drop for Other {
    fn drop(&mut self) {
        // It may have ended by itself.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}
