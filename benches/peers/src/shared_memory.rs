//! Sinew's endpoints in two processes of one machine, and their node in a third.

use std::path::PathBuf;

use sinew::{
    AsyncEndpoint, Endpoint, NodeApi, Registration, Tid,
    client::{DirectLinks, LoanedMessage, Spin},
    prelude::*,
};
use sinew_figures::{
    Figures, Pinning, Rounds,
    process::{Process, await_end, print_ready},
};
use sinew_runtime::wire::Kind;
use tokio::runtime::{Builder, Runtime};

use crate::{
    path::{Path, echo_role},
    ping::DEADLINE,
};

/// Poll duration of an endpoint that polls before it sleeps: longer than any round trip.
const LOOKS: Duration = Duration::from_secs(1);
/// Holds the longest payload in one piece.
const DIRECT_RING_BYTES: usize = 1 << 20;
const BLOCK: Kind = Kind::named("peers.block");

/// How messages travel between the two endpoints.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Way {
    /// As an endpoint that asks for nothing.
    Default,
    /// Rings from each to the node.
    Ring,
    /// Rings from each to the other.
    Direct,
    /// The same, looking before they sleep.
    DirectSpin,
    /// As `Ring`, the endpoints being tasks of tokio.
    TaskRing,
    /// As `Direct`, the same.
    TaskDirect,
}

impl Way {
    pub(crate) const fn name(self) -> &'static str {
        match self {
            Self::Default => "sinew_default",
            Self::Ring => "sinew_ring",
            Self::Direct => "sinew_direct",
            Self::DirectSpin => "sinew_direct_spin",
            Self::TaskRing => "sinew_task_ring",
            Self::TaskDirect => "sinew_task_direct",
        }
    }

    const fn is_of_tasks(self) -> bool {
        matches!(self, Self::TaskRing | Self::TaskDirect)
    }

    fn registration(self, name: &str) -> Registration {
        let registration = Registration::new().name(name);
        match self {
            Self::Default => registration,
            Self::Ring | Self::TaskRing => registration.direct(DirectLinks::Never),
            Self::Direct | Self::TaskDirect => {
                registration.direct(DirectLinks::Always).direct_ring_bytes(DIRECT_RING_BYTES)
            }
            Self::DirectSpin => Self::Direct.registration(name).spin(Spin::For(LOOKS)),
        }
    }
}

/// The node, in a process of its own.
struct Home {
    _process: Process,
    socket: PathBuf,
}

impl Home {
    fn start(pinning: Pinning) -> Self {
        let socket = std::env::temp_dir().join(format!("sinew-peers-{}", std::process::id()));
        let process = Process::start(&format!("node {} {}", pinning.name(), socket.display()));
        Self { _process: process, socket }
    }

    fn socket(&self) -> &str {
        self.socket.to_str().expect("a path of this program's own")
    }
}

impl Drop for Home {
    fn drop(&mut self) {
        // Left by the node, which is killed.
        let _ = std::fs::remove_file(&self.socket);
    }
}

/// The node: until the measuring end ends this process.
pub(crate) fn node(socket: &str) {
    let node = Node::builder("peers").configure(|config| {
        config.lncl.socket = Some(socket.into());
        config.ndl.multicast = None;
        config.ndl.mdns_port = None;
        config.rt.probe = Duration::ZERO;
    });
    let _node = node.start().expect("a node");
    print_ready();
    await_end();
}

/// Round trips between two endpoints.
pub(crate) fn measure(way: Way, rounds: Rounds, pinning: Pinning) -> Figures {
    let home = Home::start(pinning);
    let _echo = Process::start(&echo_role(Path::Endpoints(way), rounds.bytes, pinning, home.socket()));
    let mut buffer = vec![7; rounds.bytes];
    if way.is_of_tasks() {
        let runtime = runtime();
        let mut endpoint = runtime.block_on(register_task(way, home.socket(), "ping"));
        let to = runtime.block_on(endpoint.resolve("echo", DEADLINE)).expect("the node lives");
        let to = to.expect("it is registered");
        return rounds.time(|| runtime.block_on(task_round_trip(&mut endpoint, to, &mut buffer)));
    }
    let mut endpoint = register(way, home.socket(), "ping");
    let to = endpoint.resolve("echo", DEADLINE).expect("the node lives").expect("it is registered");
    rounds.time(|| {
        let mut block = endpoint.create_message(to, BLOCK, buffer.len()).expect("not too long");
        block.copy_from_slice(&buffer);
        endpoint.loaned(block).send().expect("it is taken");
        let back = endpoint.receive(DEADLINE).expect("the node lives").expect("the echo answers");
        buffer.copy_from_slice(back.bytes());
    })
}

/// The endpoint that echoes.
pub(crate) fn echo(way: Way, socket: &str) {
    if way.is_of_tasks() {
        return runtime().block_on(echo_task(way, socket));
    }
    let mut endpoint = register(way, socket, "echo");
    print_ready();
    while let Some(received) = endpoint.receive(DEADLINE).expect("the node lives") {
        let (to, bytes) = (received.source(), received.bytes());
        let mut back = endpoint.create_message(to, BLOCK, bytes.len()).expect("not too long");
        back.copy_from_slice(bytes);
        endpoint.loaned(back).send().expect("it is taken");
    }
}

fn register(way: Way, socket: &str, name: &str) -> Endpoint {
    let api = NodeApi::connect(socket).expect("the node's door");
    api.register_transport_address(way.registration(name)).expect("an address")
}

fn runtime() -> Runtime {
    Builder::new_current_thread().enable_all().build().expect("a runtime")
}

async fn register_task(way: Way, socket: &str, name: &str) -> AsyncEndpoint {
    let api = NodeApi::connect(socket).expect("the node's door");
    api.register_transport_address_async(way.registration(name)).await.expect("an address")
}

fn filled(endpoint: &mut AsyncEndpoint, to: Tid, bytes: &[u8]) -> LoanedMessage {
    let mut message = endpoint.create_message(to, BLOCK, bytes.len()).expect("not too long");
    message.copy_from_slice(bytes);
    message
}

async fn task_round_trip(endpoint: &mut AsyncEndpoint, to: Tid, buffer: &mut [u8]) {
    let block = filled(endpoint, to, buffer);
    endpoint.loaned(block).send().await.expect("it is taken");
    let back = endpoint.receive().await.expect("the echo answers");
    buffer.copy_from_slice(back.bytes());
}

async fn echo_task(way: Way, socket: &str) {
    let mut endpoint = register_task(way, socket, "echo").await;
    print_ready();
    loop {
        let received = endpoint.receive().await.expect("the node lives");
        let back = filled(&mut endpoint, received.source(), received.bytes());
        endpoint.loaned(back).send().await.expect("it is taken");
    }
}
