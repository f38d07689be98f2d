//! Memory allocations per value of class Stream, by datagrams and by the connection, at both ends together.
//!
//! `cargo bench -p sinew --bench stream_allocations [-- --short]` runs two nodes in this process with a
//! counting allocator, so it measures no times. The standard output has JSON lines. Counting starts after
//! half a second.

mod stream_ends;

use std::{alloc::System, net::SocketAddrV4};

use serde_json::json;
use sinew::prelude::*;
use stats_alloc::{INSTRUMENTED_SYSTEM, StatsAlloc};

use crate::stream_ends::{By, Plan, giver, taker};

#[global_allocator]
static MEMORY: &StatsAlloc<System> = &INSTRUMENTED_SYSTEM;

/// No wait is longer.
const DEADLINE: Duration = Duration::from_secs(60);

fn meter() -> [u64; 3] {
    let stats = MEMORY.stats();
    [(stats.allocations + stats.reallocations) as u64, stats.bytes_allocated as u64, 0]
}

fn nothing() -> [u64; 3] {
    [0; 3]
}

/// A node on the loopback interface, in a group that only this process has.
fn node(name: &str, host: u8) -> NodeBuilder {
    let id = std::process::id();
    let group = SocketAddrV4::new([239, 255, 85, (id % 200 + 1) as u8].into(), 20_000 + (id % 20_000) as u16);
    Node::builder(name).address([127, 0, 0, host]).configure(|config| {
        config.ndl.multicast = Some(group);
        config.ndl.mdns_port = None;
        config.rt.probe = Duration::ZERO;
    })
}

fn main() {
    let is_short = sinew_figures::Asked::read(include_str!("stream_allocations.rs"), &["--short"]).is_short();
    let values = if is_short { 1_000 } else { 10_000 };
    for by in By::ALL {
        for channels in [1, 16] {
            let plan = Plan { by, channels, values };
            let (there, taken) = taker(plan, node("there", 2), nothing);
            let (here, given) = giver(plan, node("home", 1), meter);
            let [allocations, bytes, _] = given.recv_timeout(DEADLINE).expect("all are given").counted;
            let came = taken.recv_timeout(DEADLINE).expect("the last ones come").ages.rounds();
            here.stop();
            there.stop();
            let all = channels as u64 * (values + 1);
            let line = json!({
                "bench": "stream_allocations", "case": format!("{}-{channels}", by.name()), "values": all, "came": came,
                "allocations_each_1000_values": 1_000 * allocations / all, "bytes_each_1000_values": 1_000 * bytes / all,
            });
            println!("{line}");
        }
    }
}
