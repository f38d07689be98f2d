//! What a message between two processes of one node costs, beside raw references of the same run.
//!
//! `cargo bench -p sinew --bench lncl [-- [--short] WORD...]` runs the cases whose name holds every WORD, each in fresh
//! processes: a node, and the two applications in processes of their own, which speak through LNCL (`socket`, `ring`; `task_ring`: as
//! tasks of tokio) or directly (`direct`, `task_direct`), by the blocking NodeAPI unless they are tasks.
//! JSON lines are on the standard output, the same as rows of a table on the standard error; `--short` does a tenth of the
//! rounds of the cases at 1000 bytes. Times are microseconds. Nothing here asserts a time.
//!
//! - Round trips at 8 B, 64 B, 1000 B, 64 KiB and 1 MiB, back to back and one every millisecond.
//! - `loan`: the same at 64 KiB and 1 MiB through rings that take them in one piece, written in the ring, beside copied into it.
//! - `table_1`: the paper's test, 1024 packets of 1000 bytes, one way, the first ones included, beside the same of each reference, and the
//!   paper's mean of 46.2 us, which is another machine's.
//!   With the receiver in C++ too if `SINEW_CPP_ECHO` is the path of what `echo.cpp` was compiled to, as in `docs/TESTING.md`.
//! - `fan_in`: eight processes send to one, each 1000 bytes every millisecond, one way.
//! - `flood`: 1000 bytes as fast as a window of 128 unanswered ones lets it.
//!
//! Each three times: wherever the scheduler likes, all on one CPU, and one CPU for each application (the node has none of its
//! own then). References: a hand-written ring in shared memory without any check, woken by a futex or polled
//! (`sinew_shm::bare`), and a unix stream socket between the two. Other people's middleware: `benches/peers`.

#[cfg(target_os = "linux")]
mod case;
#[cfg(target_os = "linux")]
mod crowds;
#[cfg(target_os = "linux")]
mod ends;
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
