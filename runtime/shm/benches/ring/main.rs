//! Round trips through rings in shared memory, beside bare references of the same run.
//!
//! `cargo bench -p sinew-shm --bench ring [-- WORD...]` prints one JSON line for each case with every WORD in
//! its name. Two processes; both on one CPU, or one CPU each; back to back, or one round trip every
//! millisecond. The reference runs right before its case. Times are microseconds, for the round trip. Nothing
//! here asserts a time.
//!
//! References: a ring of four slots with a futex that is woken for every message, or polled without one,
//! written by hand in `bare.rs`, without checks; and a unix stream socket.

#[cfg(target_os = "linux")]
mod bare;
#[cfg(target_os = "linux")]
mod case;
#[cfg(target_os = "linux")]
mod ours;
#[cfg(target_os = "linux")]
mod pace;
#[cfg(target_os = "linux")]
mod stream;

#[cfg(target_os = "linux")]
fn main() {
    if let Ok(role) = std::env::var(case::ROLE) {
        return case::echo(&role);
    }
    let wanted =
        sinew_figures::Asked::read(include_str!("main.rs"), &[]).wanted(case::all(), |case| case.name());
    eprintln!("machine: {}", sinew_figures::machine());
    wanted.into_iter().for_each(case::run);
}

#[cfg(not(target_os = "linux"))]
fn main() {
    eprintln!("no sealed shared memory here");
}
