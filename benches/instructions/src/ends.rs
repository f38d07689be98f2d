//! The processes of the paths.

use sinew::{
    Endpoint, NodeApi, Registration,
    client::{DirectLinks, LoanedMessage},
    prelude::*,
};
use sinew_figures::{
    Pace, Rounds,
    process::{await_end, print_ready},
};
use sinew_runtime::wire::Kind;

use crate::{
    nodes::At,
    paths::Path,
    ping::{self, DEADLINE},
};

const BYTES: usize = 1_000;
/// A message that is echoed.
const BLOCK: Kind = Kind::named("instructions.block");
/// The last message: the echo has ended when its answer comes.
const LAST: Kind = Kind::named("instructions.last");

/// Runs this process in a role.
pub(crate) fn play(role: &str) {
    let words: Vec<&str> = role.split(' ').collect();
    match words[..] {
        ["node", socket] => node(socket),
        ["echo_endpoint", path, socket] => echo_endpoint(Path::named(path), socket),
        ["ping_endpoint", path, socket, rounds] => ping_endpoint(Path::named(path), socket, number(rounds)),
        ["echo_node", path, at] => echo_node(Path::named(path), At::read(at)),
        ["ping_node", path, at, rounds] => ping_node(Path::named(path), At::read(at), number(rounds)),
        [path, rounds] => in_process(Path::named(path), number(rounds)),
        _ => panic!("no such role: {role}"),
    }
}

fn number(word: &str) -> u32 {
    word.parse().expect("a number that this program wrote itself")
}

fn rounds(counted: u32) -> Rounds {
    Rounds { bytes: BYTES, pace: Pace::BackToBack, warm_up: 0, counted }
}

/// Returns a node that no other node finds.
fn alone() -> NodeBuilder {
    Node::builder("instructions").configure(|config| {
        config.ndl.multicast = None;
        config.ndl.mdns_port = None;
        config.rt.probe = Duration::ZERO;
    })
}

fn in_process(path: Path, counted: u32) {
    let (ping, figures) = ping::ping(rounds(counted));
    let there = if path == Path::SameThread { "ping" } else { "echo" };
    let node = alone().app(ping::echo().place(Place::thread(there))).app(ping.place(Place::thread("ping")));
    let node = node.start().expect("a node");
    figures.recv_timeout(DEADLINE).expect("the rounds end");
    node.stop();
}

fn node(socket: &str) {
    let node = alone().configure(|config| config.lncl.socket = Some(socket.into())).start().expect("a node");
    print_ready();
    await_end();
    node.stop();
}

fn register(path: Path, socket: &str, name: &str) -> Endpoint {
    let api = NodeApi::connect(socket).expect("the node's door");
    let links = if path == Path::Direct { DirectLinks::Always } else { DirectLinks::Never };
    let registration = Registration::new().direct(links).name(name).deadline(DEADLINE);
    api.register_transport_address(registration).expect("an address")
}

fn filled(endpoint: &mut Endpoint, to: Tid, kind: Kind, bytes: &[u8]) -> LoanedMessage {
    let mut message = endpoint.create_message(to, kind, bytes.len()).expect("not too long");
    message.copy_from_slice(bytes);
    message
}

fn echo_endpoint(path: Path, socket: &str) {
    let mut endpoint = register(path, socket, "echo");
    print_ready();
    while let Some(received) = endpoint.receive(DEADLINE).expect("the node lives") {
        let kind = received.kind();
        let back = filled(&mut endpoint, received.source(), kind, received.bytes());
        endpoint.loaned(back).send().expect("there is room");
        if kind == LAST {
            await_end();
            return;
        }
    }
}

fn ping_endpoint(path: Path, socket: &str, counted: u32) {
    let mut endpoint = register(path, socket, "ping");
    let to = endpoint.resolve("echo", DEADLINE).expect("the node lives").expect("it is registered");
    let block = [7; BYTES];
    for round in 0..=counted {
        let message = filled(&mut endpoint, to, if round == counted { LAST } else { BLOCK }, &block);
        endpoint.loaned(message).send().expect("there is room");
        let back = endpoint.receive(DEADLINE).expect("the node lives").expect("the echo answers");
        assert_eq!(back.bytes(), block);
    }
}

/// Returns a node with one application, placed as the path has it.
fn with_app<A>(path: Path, name: &str, at: At, app: AppSpec<A>) -> Node
where
    A: Actor<Context = AppContext<A>>,
{
    let app = if path == Path::NodesIo { app.on_io_thread() } else { app.own_thread() };
    at.node(name).app(app).start().expect("a node")
}

fn echo_node(path: Path, at: At) {
    let node = with_app(path, "echo", at, ping::echo());
    print_ready();
    await_end();
    node.stop();
}

fn ping_node(path: Path, at: At, counted: u32) {
    let (ping, figures) = ping::ping(rounds(counted));
    let node = with_app(path, "ping", at, ping);
    figures.recv_timeout(DEADLINE).expect("the rounds end");
    node.stop();
}
