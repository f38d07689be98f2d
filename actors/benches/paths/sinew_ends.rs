//! Sinew's ends: applications that send a block there and back.

use std::path::Path;

use sinew::{NodeApi, Registration, prelude::*};
use sinew_figures::{
    End, Figures, Pinning,
    process::{Process, print_ready},
};

use crate::{
    ping::{Back, DEADLINE, There, echo, ping},
    rounds,
};

/// Returns a node that no other node finds.
fn alone(name: &str) -> NodeBuilder {
    Node::builder(name).configure(|config| {
        config.ndl.multicast = None;
        config.ndl.mdns_port = None;
        config.rt.probe = Duration::ZERO;
    })
}

/// Measures two applications of one node.
pub(crate) fn in_process(bytes: usize, pinning: Pinning, same_thread: bool) -> Figures {
    let place = |name: &str, end| match pinning.cpu(end) {
        Some(cpu) => Place::thread(name).on_cpu(cpu),
        None => Place::thread(name),
    };
    let (ping, figures) = ping(rounds(bytes));
    let there = if same_thread { place("ping", End::Measuring) } else { place("echo", End::Echoing) };
    let node = alone("paths").app(echo().place(there)).app(ping.place(place("ping", End::Measuring))).start();
    let node = node.expect("a node");
    let figures = figures.recv_timeout(DEADLINE).expect("the rounds end");
    node.stop();
    figures
}

/// An application of a node and an endpoint in another process.
pub(crate) fn through_lncl(path: &Path, bytes: usize, start_echo: impl FnOnce() -> Process) -> Figures {
    let (ping, figures) = ping(rounds(bytes));
    let node = alone("paths").configure(|config| config.lncl.socket = Some(path.to_owned()));
    let node = node.app(ping.on_io_thread()).start().expect("a node");
    let other = start_echo();
    let figures = figures.recv_timeout(DEADLINE).expect("the rounds end");
    drop(other);
    node.stop();
    figures
}

/// An application of a node and another one in a process of its own: this program, started again by the node.
pub(crate) fn to_own_process(bytes: usize, pinning: Pinning) -> Figures {
    let (ping, figures) = ping(rounds(bytes));
    // Its process inherits the CPUs of the measuring end.
    let there = pinning.cpu(End::Echoing).map_or_else(Place::process, |cpu| Place::process().on_cpu(cpu));
    let node = alone("paths").app(echo().place(there)).app(ping.on_io_thread()).start().expect("a node");
    let figures = figures.recv_timeout(DEADLINE).expect("the rounds end");
    node.stop();
    figures
}

/// The endpoint that echoes.
pub(crate) fn echo_endpoint(at: &str) {
    print_ready();
    let api = NodeApi::connect(Path::new(at)).expect("the node's door");
    let mut endpoint = api.register_transport_address(Registration::new().name("echo")).expect("an address");
    loop {
        let Some(there) = endpoint.receive(DEADLINE).expect("the node lives") else { return };
        let source = there.source();
        let block = there.decode::<There>().expect("a block").block;
        endpoint.send(source, &Back { block }).expect("the measuring end takes it");
    }
}
