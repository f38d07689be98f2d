//! A child that holds the descriptors of its parent, as one of `fork` does that closes none, and lives on after it.

use std::{
    fs,
    os::fd::OwnedFd,
    process::{Command, Stdio},
};

use rustix::{
    io::{FdFlags, fcntl_setfd},
    process::{PidfdFlags, PidfdGetfdFlags, getpid, pidfd_getfd, pidfd_open},
};

/// Longer than any test waits for something.
const LIVES: &str = "120";

/// Starts one; its process id.
pub(super) fn fork() -> u32 {
    // What this process opens is closed in its children, unless they get copies of which that is not so.
    let copies = copies();
    for copy in &copies {
        fcntl_setfd(copy, FdFlags::empty()).expect("the descriptor is our own");
    }
    let mut sleep = Command::new("sleep");
    let child = sleep.arg(LIVES).stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
    child.spawn().expect("every system has sleep").id()
}

/// Of all that this process has open, beside what it was started with.
fn copies() -> Vec<OwnedFd> {
    let own = pidfd_open(getpid(), PidfdFlags::empty()).expect("this process lives");
    let numbers = fs::read_dir("/proc/self/fd").expect("the system tells").flatten();
    let numbers = numbers.filter_map(|entry| entry.file_name().to_str()?.parse().ok());
    let numbers: Vec<i32> = numbers.filter(|number| *number > 2).collect();
    // The directory itself is closed by now.
    numbers
        .into_iter()
        .filter_map(|number| pidfd_getfd(&own, number, PidfdGetfdFlags::empty()).ok())
        .collect()
}
