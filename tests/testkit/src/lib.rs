//! Parts of all scenarios: processes, hosts, a network with faults, histories of messages, reports.
//!
//! Parts that know Sinew's nodes need the feature `nodes`.
//!
//! | module | content |
//! | --- | --- |
//! | `process` | a process: start, stop, signals, waits for its output and its end |
//! | `resources` | memory, descriptors and threads of a process |
//! | `threads` | threads that run until a flag is set |
//! | `hosts` | hosts made of network namespaces, and a radio between them |
//! | `log` | observations in order, and waits for them |
//! | `random` | random numbers from a seed |
//! | `preload`, `sandbox` | processes with a changed system |
//! | `loopback` | nodes of this process on loopback |
//! | `scripted` | an application that runs code of the scenario, and a sender for the test |
//! | `outcomes` | outcomes of confirmed messages while others are sent |
//! | `network` | a network that fails on command |
//! | `history` | the fate of each message |
//! | `keys` | keys of a robot |
//! | `options` | command-line options that several programs have |
//! | `reference` | files of the documents that are generated from the code |
//! | `report` | durations with percentiles, and the form of results |

mod directory;
#[cfg(feature = "nodes")]
pub mod history;
mod hosts;
#[cfg(feature = "nodes")]
pub mod keys;
mod log;
#[cfg(feature = "nodes")]
mod loopback;
#[cfg(feature = "nodes")]
pub mod network;
#[cfg(feature = "nodes")]
pub mod options;
#[cfg(feature = "nodes")]
mod outcomes;
pub mod preload;
mod process;
pub mod random;
pub mod reference;
#[cfg(feature = "nodes")]
pub mod report;
mod resources;
pub mod sandbox;
#[cfg(feature = "nodes")]
pub mod scripted;
mod threads;

pub use self::{
    directory::TestDirectory,
    hosts::{Addresses, Carried, Host, Hosts, Queue, Radio, Weather},
    log::{Log, until},
    process::{NodeProcess, numbers, program, wait_until_asleep, wait_until_paused},
    resources::Resources,
    threads::{SetOnDrop, join},
};
#[cfg(feature = "nodes")]
pub use loopback::{Loopback, all_run, ready_for, sees};
#[cfg(feature = "nodes")]
pub use outcomes::PendingOutcomes;

use std::{
    net::SocketAddrV4,
    sync::atomic::{AtomicU32, Ordering},
    time::Duration,
};

/// Maximum wait of a scenario for one event. It is generous, because the machine may be busy with other
/// tests.
pub const DEADLINE: Duration = Duration::from_secs(60);

/// Numbers per process; after these it starts again with its first one. A process id has at most 22 bits
/// (`proc(5)`, `pid_max`).
const NUMBERS: u32 = 1 << 10;

/// A number that no other test of this host has at the same time: this process's id and a counter.
#[must_use]
pub fn unique() -> u32 {
    static COUNT: AtomicU32 = AtomicU32::new(0);
    std::process::id() * NUMBERS + COUNT.fetch_add(1, Ordering::Relaxed) % NUMBERS
}

/// A multicast group and port for this test only, never routed.
#[must_use]
pub fn own_group() -> SocketAddrV4 {
    let number = unique();
    let octets = [239, 255, (number >> 8) as u8, number as u8];
    SocketAddrV4::new(octets.into(), 20_000 + (number % 20_000) as u16)
}
