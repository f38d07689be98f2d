//! Two hosts with a link of 10 Mbit/s between them: Control beside Bulk, and a bare TCP connection beside
//! another one.

use std::net::SocketAddrV4;

use sinew_figures::process::{self, Process};
use sinew_testkit::{Host, Hosts, Queue};

use crate::{beside, beside_raw, nodes::At};

/// Rate of the link.
const KBIT_PER_S: u32 = 10_000;
const PORT: u16 = 20_000;
/// Round trips without and with the flood.
const ROUNDS: u64 = 1_000;
/// Round trips of bare TCP: alone, and beside the flood, where each waits in its queue.
const ROUNDS_OF_RAW: [u64; 2] = [ROUNDS, ROUNDS / 4];
/// Bytes of a message of the flood.
const FLOODED: usize = 1000;

/// Creates the hosts, and runs both measurements on them; reports the reason if that is not possible. Returns
/// whether all completed runs went well.
pub(crate) fn measure(case: &str, queue: Queue) -> bool {
    let hosts = Hosts::new(2).and_then(|hosts| hosts.throttle(KBIT_PER_S, queue).map(|()| hosts));
    let hosts = match hosts {
        Ok(hosts) => hosts,
        Err(why) => {
            eprintln!("{case}: skipped: no slow link can be made here: {why}");
            return true;
        }
    };
    let [here, there] = [0, 1].map(|host| &hosts.all()[host]);
    let on = |host: &Host, role: &str| host.moved(&process::command(role));
    let (at, raw) = (At::loopback(), SocketAddrV4::new(there.address, PORT));
    let both = [
        (
            format!("beside_echo 0 {}", at.on(there.address)),
            format!("slow_nodes {case} {}", at.on(here.address)),
        ),
        (format!("beside_raw_echo {raw}"), format!("slow_raw {case} {raw}")),
    ];
    both.iter().all(|(echo, measure)| {
        let _echo = Process::start_command(on(there, echo), echo);
        process::has_run(on(here, measure))
    })
}

/// The measuring node.
pub(crate) fn nodes(case: &str, at: At) {
    beside::measure(case, at, FLOODED, ROUNDS);
}

/// The measuring end of bare TCP.
pub(crate) fn raw(case: &str, address: SocketAddrV4) {
    beside_raw::measure(case, address, FLOODED, ROUNDS_OF_RAW);
}
