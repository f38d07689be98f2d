//! A child that holds the file descriptors of its parent and outlives it, like a `fork` without `close`.

use std::{
    fs,
    os::fd::OwnedFd,
    process::{Command, Stdio},
};

use rustix::{
    io::{FdFlags, fcntl_setfd},
    process::{PidfdFlags, PidfdGetfdFlags, getpid, pidfd_getfd, pidfd_open},
};

/// Its lifetime in seconds: longer than any wait of a test.
const LIFETIME_S: &str = "120";

/// Starts a child and returns its process id.
pub(super) fn fork() -> u32 {
    // Descriptors of this process are close-on-exec, so the child inherits copies without that flag.
    let copies = copies();
    for copy in &copies {
        fcntl_setfd(copy, FdFlags::empty()).expect("the descriptor is our own");
    }
    let mut sleep = Command::new("sleep");
    let child = sleep.arg(LIFETIME_S).stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
    child.spawn().expect("every system has sleep").id()
}

/// Copies of all descriptors that this process has opened, other than those it was started with.
fn copies() -> Vec<OwnedFd> {
    let own = pidfd_open(getpid(), PidfdFlags::empty()).expect("this process is alive");
    let numbers = fs::read_dir("/proc/self/fd").expect("the system lists them").flatten();
    let numbers = numbers.filter_map(|entry| entry.file_name().to_str()?.parse().ok());
    let numbers: Vec<i32> = numbers.filter(|number| *number > 2).collect();
    // The descriptor of the directory itself is closed by now.
    numbers
        .into_iter()
        .filter_map(|number| pidfd_getfd(&own, number, PidfdGetfdFlags::empty()).ok())
        .collect()
}
