//! What the scenarios stand on: puppets that do as they are told and write down what they saw, programs that are watched
//! line by line, and hosts made of network namespaces.

pub mod attacks;
pub mod clients;
pub mod dice;
mod ground;
pub mod history;
pub mod keys;
pub mod link_faults;
pub mod load;
mod log;
pub mod meetings;
mod numbers;
mod preload;
mod program;

pub mod orders;
pub mod proxy;
pub mod puppet;
pub mod sandbox;
pub mod slow_consumer;

pub use ground::{Ground, all_run, ready_for, sees};
pub use log::{Log, until};
pub use program::{
    Program, node_under_test, process_under_test, program, wait_until_asleep, wait_until_frozen,
};
pub use sinew_hosts::{Host, Hosts};

use std::{
    net::SocketAddrV4,
    path::PathBuf,
    sync::atomic::{AtomicU32, Ordering},
    time::Duration,
};

/// No scenario waits longer than this for one thing. It is generous: the machine may be busy with other tests.
pub const DEADLINE: Duration = Duration::from_secs(60);

/// Numbers that one process has; beyond them it takes its first ones again. An id of a process has 22 bits at most (`proc(5)`, `pid_max`).
const NUMBERS: u32 = 1 << 10;

/// A number that no other test of this host has at the same time: this process's id and a count.
#[must_use]
pub fn unique() -> u32 {
    static COUNT: AtomicU32 = AtomicU32::new(0);
    std::process::id() * NUMBERS + COUNT.fetch_add(1, Ordering::Relaxed) % NUMBERS
}

/// A multicast group and port of this test's own, never routed.
#[must_use]
pub fn own_group() -> SocketAddrV4 {
    let number = unique();
    let octets = [239, 255, (number >> 8) as u8, number as u8];
    SocketAddrV4::new(octets.into(), 20_000 + (number % 20_000) as u16)
}

/// An empty directory of this test's own; the test removes it by dropping the value.
#[derive(Debug)]
pub struct OwnDirectory(PathBuf);

impl OwnDirectory {
    /// Makes the directory.
    ///
    /// # Panics
    /// If the host's directory for temporary files cannot be written to.
    #[must_use]
    pub fn new() -> Self {
        let path = std::env::temp_dir().join(format!("sinew-test-{}", unique()));
        std::fs::create_dir_all(&path).expect("a directory for temporary files");
        Self(path)
    }

    /// A path inside.
    #[must_use]
    pub fn join(&self, name: &str) -> PathBuf {
        self.0.join(name)
    }
}

impl Default for OwnDirectory {
    fn default() -> Self {
        Self::new()
    }
}

impl Drop for OwnDirectory {
    fn drop(&mut self) {
        // A directory for temporary files that stays is no reason to fail a test.
        let _ = std::fs::remove_dir_all(&self.0);
    }
}
