//! Sinew's ends: the node, and two applications in processes of their own, by the blocking NodeAPI.

use std::{os::unix::process::CommandExt, path::PathBuf, process::Command, time::Duration};

use sinew::{
    Endpoint, NodeApi, Registration,
    client::{DirectLinks, LoanedMessage, Spin, Transport},
    prelude::*,
};
use sinew_figures::{
    Figures, Pinning, Rounds,
    process::{Process, await_end, print_ready},
};
use sinew_runtime::{time::Time, wire::Kind};

use crate::{
    case::{Way, role},
    crowds::{Ages, PACKET},
};

/// No wait of this bench is longer.
pub(crate) const DEADLINE: Duration = Duration::from_secs(20);
/// Poll duration of an endpoint that polls before it sleeps: longer than any round trip.
const LOOKS: Duration = Duration::from_secs(1);
/// Bytes of a ring: the default of a node.
const RING_BYTES: usize = 256 * 1024;
/// Bytes of a ring that holds the longest message in one piece.
const LONG_RING_BYTES: usize = 4 * 1024 * 1024;
/// A message that is echoed unchanged.
pub(crate) const BLOCK: Kind = Kind::named("lncl.block");
/// A message that is echoed with its age in its first bytes.
const AGED: Kind = Kind::named("lncl.aged");
/// Packets of the paper's Table 1.
pub(crate) const TABLE_ONE: usize = 1024;

/// The node of a case, in a process of its own.
pub(crate) struct Home {
    _process: Process,
    socket: PathBuf,
}

impl Home {
    pub(crate) fn start(pinning: Pinning) -> Self {
        Self::with_rings(pinning, RING_BYTES)
    }

    fn with_rings(pinning: Pinning, ring_bytes: usize) -> Self {
        let socket = std::env::temp_dir().join(format!("sinew-bench-lncl-{}", std::process::id()));
        let process = Process::start(&format!("node {} {} {ring_bytes}", pinning.name(), socket.display()));
        Self { _process: process, socket }
    }

    pub(crate) fn socket(&self) -> &str {
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
pub(crate) fn node(socket: &str, ring_bytes: usize) {
    let node = Node::builder("lncl").configure(|config| {
        config.lncl.socket = Some(socket.into());
        config.lncl.ring_bytes = ring_bytes;
        config.ndl.multicast = None;
        config.ndl.mdns_port = None;
        config.rt.probe = Duration::ZERO;
    });
    let _node = node.start().expect("a node");
    print_ready();
    await_end();
}

/// Registers the address `name` with this transport.
pub(crate) fn register(way: Way, socket: &str, name: &str) -> Endpoint {
    let registration = match way {
        Way::Socket => Registration::new().transport(Transport::Socket),
        Way::Ring => Registration::new().direct(DirectLinks::Never),
        Way::TaskRing | Way::TaskDirect => unreachable!("its ends are in tasks.rs"),
        Way::Default => Registration::new(),
        Way::Direct => direct(),
        Way::DirectSpin => direct().spin(Spin::For(LOOKS)),
    };
    let api = NodeApi::connect(socket).expect("the node's door");
    api.register_transport_address(registration.name(name)).expect("an address")
}

/// Rings of the longest sort, for the long payloads.
fn direct() -> Registration {
    Registration::new().direct(DirectLinks::Always).direct_ring_bytes(1 << 20)
}

/// Where a payload is written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Memory {
    /// In the ring, if that is possible.
    Lent,
    /// In memory of its own, from which it is copied when it is sent.
    Copied,
}

impl Memory {
    fn maker(self, socket: &str) -> Maker {
        Maker(
            (self == Self::Copied)
                .then(|| register(Way::Socket, socket, &format!("maker-{}", std::process::id()))),
        )
    }
}

/// The creator of messages: the endpoint that sends them, or another one without a ring for them.
struct Maker(Option<Endpoint>);

impl Maker {
    fn create(&mut self, endpoint: &mut Endpoint, to: Tid, kind: Kind, length: usize) -> LoanedMessage {
        self.0.as_mut().unwrap_or(endpoint).create_message(to, kind, length).expect("not too long")
    }
}

/// The application that echoes: until the measuring end ends this process.
pub(crate) fn echo(way: Way, memory: Memory, socket: &str) {
    let (mut endpoint, mut maker) = (register(way, socket, "echo"), memory.maker(socket));
    print_ready();
    while let Some(received) = endpoint.receive(DEADLINE).expect("the node lives") {
        let (to, bytes) = (received.source(), received.bytes());
        let mut back = maker.create(&mut endpoint, to, received.kind(), bytes.len());
        back.copy_from_slice(bytes);
        if received.kind() == AGED {
            let age = received.age(Time::now()).expect("of this host");
            back[..8].copy_from_slice(&(age.as_nanos() as u64).to_le_bytes());
        }
        endpoint.loaned(back).send().expect("the node takes it");
    }
}

/// The environment variable that names the program that `echo.cpp` was compiled to.
pub(crate) const CPP_ECHO: &str = "SINEW_CPP_ECHO";

/// The same in C++, in this process's place.
pub(crate) fn become_cpp_echo(socket: &str) {
    let program = std::env::var_os(CPP_ECHO).expect("it was there when the cases were chosen");
    panic!("no echo in C++: {}", Command::new(program).arg(socket).exec());
}

/// The measuring application, and the echoing one.
struct Pair {
    endpoint: Endpoint,
    to: Tid,
    maker: Maker,
    _echo: Process,
    _home: Home,
}

impl Pair {
    fn start(way: Way, pinning: Pinning, echo: &str) -> Self {
        Self::at(Home::start(pinning), way, pinning, echo)
    }

    fn at(home: Home, way: Way, pinning: Pinning, echo: &str) -> Self {
        let echo = Process::start(&role(echo, way, pinning, home.socket()));
        let mut endpoint = register(way, home.socket(), "ping");
        let to = endpoint.resolve("echo", DEADLINE).expect("the node lives").expect("it is registered");
        Self { endpoint, to, maker: Maker(None), _echo: echo, _home: home }
    }

    /// Sends `buffer`, and fills it with the reply.
    fn round_trip(&mut self, kind: Kind, buffer: &mut [u8]) {
        let mut block = self.maker.create(&mut self.endpoint, self.to, kind, buffer.len());
        block.copy_from_slice(buffer);
        self.endpoint.loaned(block).send().expect("the node takes it");
        let back = self.endpoint.receive(DEADLINE).expect("the node lives").expect("the echo answers");
        buffer.copy_from_slice(back.bytes());
    }
}

/// Round trips between two applications.
pub(crate) fn round_trips(way: Way, bytes: usize, rounds: Rounds, pinning: Pinning) -> Figures {
    let (mut pair, mut buffer) = (Pair::start(way, pinning, "echo"), vec![7; bytes]);
    rounds.time(|| pair.round_trip(BLOCK, &mut buffer))
}

/// Runs the same round trips through rings that hold the payload in one piece. Returns also whether it was
/// written in place.
pub(crate) fn loans(
    way: Way,
    memory: Memory,
    bytes: usize,
    rounds: Rounds,
    pinning: Pinning,
) -> (Figures, bool) {
    let home = Home::with_rings(pinning, LONG_RING_BYTES);
    let echo = match memory {
        Memory::Lent => "echo",
        Memory::Copied => "echo_copied",
    };
    let maker = memory.maker(home.socket());
    let mut pair = Pair { maker, ..Pair::at(home, way, pinning, echo) };
    let mut buffer = vec![7; bytes];
    let figures = rounds.time(|| pair.round_trip(BLOCK, &mut buffer));
    let last = pair.maker.create(&mut pair.endpoint, pair.to, BLOCK, bytes);
    (figures, last.is_in_place())
}

/// The paper's test: how old each of the first 1024 packets is when it is received.
pub(crate) fn table_one(way: Way, pinning: Pinning, echo: &str) -> Ages {
    let (mut pair, mut packet) = (Pair::start(way, pinning, echo), vec![7; PACKET]);
    let ages = (0..TABLE_ONE).map(|_| {
        pair.round_trip(AGED, &mut packet);
        packet.first_chunk().map_or(0, |bytes| u64::from_le_bytes(*bytes))
    });
    Ages::of(&ages.collect::<Vec<_>>())
}
