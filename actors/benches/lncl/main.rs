//! The cost of a message between two processes of one node, beside raw references of the same run.
//!
//! `cargo bench -p sinew --bench lncl [-- [--short] WORD...]` runs the cases that have every WORD in their
//! names, each in fresh processes: a node, and the two applications. The applications communicate through
//! LNCL (`socket`, `ring`; `task_ring`: as tokio tasks) or directly (`direct`, `task_direct`; `default`: once they are
//! frequent peers). They use the blocking NodeAPI unless they are tasks. The standard output has JSON lines, the
//! standard error the same as rows of a table. `--short` runs a tenth of the rounds of the cases at 1000 bytes.
//! Times are microseconds. Nothing here asserts a time.
//!
//! - Round trips at 8 B, 64 B, 1000 B, 64 KiB and 1 MiB, back to back and one every millisecond.
//! - `loan`: the same at 64 KiB and 1 MiB through rings that hold them in one piece, written in the ring,
//!   beside copied into it.
//! - `table_1`: the paper's test, 1024 one-way packets of 1000 bytes, including the first ones. It is shown
//!   beside the same for each reference and the paper's mean of 46.2 us, which was measured on another
//!   machine. The C++ receiver is measured too if `SINEW_CPP_ECHO` is the path of the compiled `echo.cpp`, as
//!   in `docs/book/src/contributing/testing.md`.
//! - `fan_in`: eight processes send to one, each 1000 bytes every millisecond, one way.
//! - `flood`: 1000 bytes as fast as a window of 128 unacknowledged ones allows.
//! - `commands`: 64 bytes of class Control there and back every millisecond, beside a flood of Bulk of 1000 bytes from
//!   the same sender to the same receiver, and without it.
//! - `mesh`: 64 addresses in eight processes, each of which sends 1000 bytes to all others as fast as they are
//!   received.
//!
//! Each case runs three times: placed by the scheduler, all on one CPU, and one CPU for each application (the
//! node then has none of its own). The references are a hand-written ring in shared memory without any
//! checks, woken by a futex or polled (`sinew_shm::bare`), and a unix stream socket between the two.
//! `benches/peers` measures other middleware.

#[cfg(target_os = "linux")]
mod case;
#[cfg(target_os = "linux")]
mod crowds;
#[cfg(target_os = "linux")]
mod ends;
#[cfg(target_os = "linux")]
mod mesh;
#[cfg(target_os = "linux")]
mod raw;
#[cfg(target_os = "linux")]
mod tasks;

#[cfg(target_os = "linux")]
fn main() -> std::process::ExitCode {
    if let Some(role) = sinew_figures::process::role() {
        return case::play(&role);
    }
    let asked = sinew_figures::Asked::read(include_str!("main.rs"), &["--short"]);
    let is_short = asked.is_short();
    let wanted = asked.wanted(case::all(is_short), |case| case.name());
    eprintln!("machine: {}", sinew_figures::machine());
    sinew_figures::Beside::head();
    let failed = wanted.into_iter().filter(|case| !case.run(is_short)).count();
    if failed == 0 { std::process::ExitCode::SUCCESS } else { std::process::ExitCode::FAILURE }
}

#[cfg(not(target_os = "linux"))]
fn main() {
    eprintln!("no sealed shared memory here");
}
