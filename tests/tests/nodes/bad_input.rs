//! Bytes from outside: they are rejected and counted, and the node keeps running.

use std::{
    io::{Read, Write},
    net::{SocketAddr, TcpStream, UdpSocket},
    os::unix::net::UnixStream,
    path::{Path, PathBuf},
    sync::mpsc::{Receiver, sync_channel},
};

use sinew::{Class, NodeApi, Registration, message::Kind, prelude::*};
use sinew_runtime::wire::{Header, encode_frame};
use sinew_testkit::{DEADLINE, TestDirectory, own_group};

payload!("bad_input.count", Bulk => struct Count { number: u64 });

struct Witness(std::sync::mpsc::SyncSender<u64>);

impl Actor for Witness {
    type Context = AppContext<Self>;
}

impl Handler<Delivery<Count>> for Witness {
    type Result = ();

    fn handle(&mut self, count: Delivery<Count>, _: &mut Self::Context) {
        self.0.send(count.number).expect("the test listens");
    }
}

/// A node with all its sockets open, and a check that it works.
struct Victim {
    node: Node,
    socket: PathBuf,
    seen: Receiver<u64>,
    _directory: TestDirectory,
}

impl Victim {
    fn start() -> Self {
        let directory = TestDirectory::new();
        let socket = directory.join("lncl");
        let (sees, seen) = sync_channel(100);
        let witness = AppSpec::new("witness", move || Witness(sees.clone())).handles::<Count>();
        let (group, door) = (own_group(), socket.clone());
        let node = Node::builder("victim").app(witness).configure(move |config| {
            config.ndl.multicast = Some(group);
            config.ndl.mdns_port = None;
            config.lncl.socket = Some(door);
        });
        let node = node.start().expect("a node");
        node.handle().wait_until_running(DEADLINE).expect("its application runs");
        Self { node, socket, seen, _directory: directory }
    }

    fn gncl(&self) -> SocketAddr {
        self.node.handle().gncl_address().expect("GNCL listens")
    }

    fn ndl(&self) -> SocketAddr {
        self.node.handle().ndl_address().expect("NDL listens")
    }

    /// Checks that a new client's message still reaches the application.
    fn assert_lives(&self, number: u64) {
        let api = NodeApi::connect(&self.socket).expect("the node accepts clients");
        let mut endpoint = api.register_transport_address(Registration::new()).expect("an address");
        let outcome =
            endpoint.message(self.witness(), &Count { number }).confirmed(DEADLINE).expect("an outcome");
        assert_eq!(outcome, Outcome::Delivered);
        assert_eq!(self.seen.recv_timeout(DEADLINE), Ok(number));
    }

    fn witness(&self) -> Tid {
        self.node.handle().resolve("witness").expect("it is registered")
    }
}

fn frame(change: impl FnOnce(&mut [u8])) -> Vec<u8> {
    let mut bytes = bytes::BytesMut::new();
    let header = Header::new(Kind::GNCL_HELLO, Tid::NONE, Tid::BROADCAST);
    encode_frame(&header, b"no introduction", &mut bytes);
    change(&mut bytes);
    bytes.to_vec()
}

/// Frames that no peer and no client may send, with the name of each fault.
fn bad_frames() -> Vec<(&'static str, Vec<u8>)> {
    vec![
        ("garbage", (0..997u32).map(|n| (n * 31) as u8).collect()),
        ("another version", frame(|bytes| bytes[2] = 9)),
        ("a length of 4 GiB", frame(|bytes| bytes[4..8].fill(0xff))),
        ("a damaged payload", frame(|bytes| bytes[70] ^= 1)),
        ("a class that is none", frame(|bytes| bytes[12] = 7)),
        ("a hello that is none", frame(|_| {})),
        ("half a frame", frame(|_| {})[..40].to_vec()),
    ]
}

/// Writes the bytes, closes the writing half, and reads to the end: the node has closed the connection.
fn offer(mut stream: impl Read + Write, close: impl FnOnce(), bytes: &[u8]) {
    // The node may reject the first bytes, and then the rest is not accepted.
    let _ = stream.write_all(bytes);
    close();
    let mut answer = Vec::new();
    // A connection reset is as good an end.
    let _ = stream.read_to_end(&mut answer);
}

#[test]
fn bad_frames_close_only_their_gncl_connection() {
    let victim = Victim::start();
    for (what, bytes) in bad_frames() {
        let stream = TcpStream::connect(victim.gncl()).unwrap_or_else(|error| panic!("{what}: {error}"));
        stream.set_read_timeout(Some(DEADLINE)).expect("a time limit");
        let half = stream.try_clone().expect("a second handle");
        offer(stream, move || drop(half.shutdown(std::net::Shutdown::Write)), &bytes);
    }
    victim.assert_lives(1);
    assert!(victim.node.handle().refused() >= 6, "refusals are counted");
}

#[test]
fn bad_frames_close_only_their_lncl_connection() {
    let victim = Victim::start();
    for (what, bytes) in bad_frames() {
        let stream = UnixStream::connect(&victim.socket).unwrap_or_else(|error| panic!("{what}: {error}"));
        stream.set_read_timeout(Some(DEADLINE)).expect("a time limit");
        let half = stream.try_clone().expect("a second handle");
        offer(stream, move || drop(half.shutdown(std::net::Shutdown::Write)), &bytes);
    }
    victim.assert_lives(2);
    assert!(victim.node.handle().refused() >= 6, "refusals are counted");
}

#[test]
fn datagram_flood_is_rejected_and_the_node_survives() {
    let victim = Victim::start();
    let flood = UdpSocket::bind("127.0.0.1:0").expect("a socket");
    let mut datagrams: Vec<_> = bad_frames().into_iter().map(|(_, bytes)| bytes).collect();
    datagrams.push(Vec::new());
    for round in 0..20_000 {
        // If the kernel has no room for it, it is rejected even earlier.
        let _ = flood.send_to(&datagrams[round % datagrams.len()], victim.ndl());
    }
    victim.assert_lives(3);
    assert!(victim.node.handle().refused() > 0, "refusals are counted");
}

/// Registers by hand, like a client in another language, and then sends a forged source.
#[test]
fn forged_source_is_rejected_and_counted() {
    let victim = Victim::start();
    let api = NodeApi::connect(&victim.socket).expect("the node accepts clients");
    let honest = api.register_transport_address(Registration::new()).expect("an address");
    let mut liar = register_by_hand(&victim.socket);
    let mut header = Header::new(Count::KIND, honest.tid(), victim.witness());
    header.class = Class::Bulk;
    let mut bytes = bytes::BytesMut::new();
    encode_frame(&header, &sinew_runtime::wire::encode(&Count { number: 666 }), &mut bytes);
    liar.write_all(&bytes).expect("the node reads");
    victim.assert_lives(4);
    assert_eq!(victim.seen.try_recv().ok(), None, "the forged message was not delivered");
    assert!(victim.node.handle().refused() > 0, "refusals are counted");
}

/// LNCL_REGISTER as `docs/protocol/lncl.md` specifies it: an empty map requests any address.
fn register_by_hand(socket: &Path) -> UnixStream {
    let mut stream = UnixStream::connect(socket).expect("the node accepts clients");
    let header = Header::new(Kind::LNCL_REGISTER, Tid::NONE, Tid::new(NodeAddress::HERE, AppAddress::LNCL));
    let mut bytes = bytes::BytesMut::new();
    encode_frame(&header, &[0x80], &mut bytes);
    stream.write_all(&bytes).expect("the node reads");
    let mut answer = [0; 64];
    stream.read_exact(&mut answer).expect("LNCL_REGISTERED");
    assert_eq!(answer[8..12], Kind::LNCL_REGISTERED.bits().to_le_bytes());
    stream
}
