//! A peer that is written by hand from `docs/protocol/gncl.md`: its connections, its socket, and the bytes of its
//! datagrams.

use std::net::SocketAddr;

use sinew_runtime::{
    tid::{NodeAddress, Tid},
    time::Time,
    wire::{Class, Flags, Kind, Message, decode_datagram, encode_frame},
};
use tokio::net::UdpSocket;

use super::super::bench::{ByHand, KIND, NINE, Node, introduction, within};
use crate::{
    core::{CLASSES, DATAGRAMS, Introduction, Lane, read, write},
    datagrams::Announcement,
    frame::frame,
};

pub(super) const ACK: u8 = 1;
pub(super) const VALUE: u8 = 2;
pub(super) const PROBE: u8 = 4;
/// The key that the node's datagrams to the handwritten peer must have.
pub(super) const KEY: u64 = 77;

/// Waits until values to `peer` are sent by datagram.
pub(super) async fn opened(node: &Node, peer: NodeAddress) {
    let is_open =
        || node.state.store.peer(peer).is_some_and(|peer| peer.channel().expect("both can").is_open());
    within("datagrams to get through", async {
        while !is_open() {
            tokio::task::yield_now().await;
        }
    })
    .await;
}

/// A datagram as the handwritten peer reads it.
pub(super) struct Received {
    pub(super) what: u8,
    pub(super) stamp: u32,
    /// The number of a probe.
    pub(super) probe: Option<u64>,
    pub(super) length: usize,
    pub(super) value: Option<Message>,
    pub(super) numbers: Vec<(u64, u32)>,
}

/// A handwritten peer, with connections for Control and Stream, and a socket.
pub(super) struct DatagramPeer {
    _first: ByHand,
    pub(super) stream: ByHand,
    pub(super) socket: UdpSocket,
    /// The address at which the node reads datagrams, and the key for it.
    pub(super) to: SocketAddr,
    pub(super) key: u64,
}

impl DatagramPeer {
    pub(super) async fn linked_to(node: &mut Node) -> Self {
        Self::dialling(node, 1).await
    }

    /// The same, with this dial and the next one.
    pub(super) async fn dialling(node: &mut Node, dial: u64) -> Self {
        let features = vec![CLASSES.to_owned(), DATAGRAMS.to_owned()];
        let hello = Introduction { features, dial, ..introduction(node.address()) };
        let first = ByHand::greeting(node, &hello).await;
        node.up().await;
        let hello = Introduction { lane: Lane::Stream, link: dial, dial: dial + 1, ..hello };
        let mut stream = ByHand::greeting(node, &hello).await;
        let said = stream.receive().await;
        assert_eq!(said.header.kind, Kind::GNCL_DATAGRAMS);
        let said: Announcement = read(&said.payload).expect("it says where");
        let socket = UdpSocket::bind("127.0.0.1:0").await.expect("loopback has a port");
        let to = SocketAddr::from(([127, 0, 0, 1], said.port));
        assert_eq!((to, said.address), (node.listens_at(), 0), "the same port as for TCP");
        let mut remote = Self { _first: first, stream, socket, to, key: said.key };
        remote.announce(node, KEY).await;
        remote
    }

    pub(super) async fn announce(&mut self, node: &Node, key: u64) {
        let port = self.socket.local_addr().expect("it is bound").port();
        let said = Announcement { port, key, address: 0 };
        self.stream.send(&frame(NINE, node.address(), Kind::GNCL_DATAGRAMS, write(&said))).await;
    }

    /// The same, with datagrams in use.
    pub(super) async fn open_to(node: &mut Node) -> Self {
        Self::linked_to(node).await.open(node).await
    }

    pub(super) async fn open(self, node: &Node) -> Self {
        let probe = self.receive().await;
        assert_eq!((probe.what, probe.length), (PROBE, 1_200));
        self.acknowledge_probe(&probe).await;
        opened(node, NINE).await;
        self
    }

    pub(super) fn datagram(&self, key: u64, what: u8, rest: &[u8]) -> Vec<u8> {
        let mut bytes = vec![1, what, 0, 0];
        bytes.extend(NINE.bits().to_le_bytes());
        bytes.extend(key.to_le_bytes());
        bytes.extend(1_000_u32.to_le_bytes());
        let head = if what & (ACK | PROBE) == 0 { &[][..] } else { rest };
        bytes.extend(crc32fast::hash(&[&bytes, head].concat()).to_le_bytes());
        bytes.extend(rest);
        bytes
    }

    pub(super) async fn send(&self, what: u8, rest: &[u8]) {
        self.send_bytes(&self.datagram(self.key, what, rest)).await;
    }

    pub(super) async fn send_bytes(&self, bytes: &[u8]) {
        self.socket.send_to(bytes, self.to).await.expect("loopback takes it");
    }

    /// A probe is no accepted value.
    pub(super) async fn acknowledge_probe(&self, probe: &Received) {
        self.acknowledge_taken(probe.stamp, 0, &[probe.probe.expect("it has a number")]).await;
    }

    pub(super) async fn acknowledge(&self, echo: u32, numbers: &[u64]) {
        self.acknowledge_taken(echo, numbers.len() as u64, numbers).await;
    }

    async fn acknowledge_taken(&self, echo: u32, taken: u64, numbers: &[u64]) {
        let mut rest = Vec::from(echo.to_le_bytes());
        rest.extend(0_u32.to_le_bytes());
        rest.extend(taken.to_le_bytes());
        rest.extend((numbers.len() as u32).to_le_bytes());
        for number in numbers {
            rest.extend(number.to_le_bytes());
            rest.extend(0_u32.to_le_bytes());
        }
        self.send(ACK, &rest).await;
    }

    pub(super) fn value_bytes(&self, to: Tid, number: u64, source: Tid) -> Vec<u8> {
        let mut header = sinew_runtime::wire::Header::new(KIND, source, to);
        (header.class, header.correlation, header.sent) = (Class::Stream, number, Time::now());
        let mut bytes = bytes::BytesMut::new();
        encode_frame(&header, &number.to_le_bytes(), &mut bytes);
        bytes.to_vec()
    }

    pub(super) async fn send_value(&self, to: Tid, number: u64) {
        self.send(VALUE, &self.value_bytes(to, number, nines_app())).await;
    }

    pub(super) async fn receive(&self) -> Received {
        let mut buffer = vec![0; 2_000];
        let length = within("a datagram", self.socket.recv(&mut buffer)).await.expect("it is read");
        assert!(length <= 1_200);
        let bytes = &buffer[..length];
        let u32_at = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().expect("four"));
        let u64_at = |at: usize| u64::from_le_bytes(bytes[at..at + 8].try_into().expect("eight"));
        assert_eq!((bytes[0], bytes[2], bytes[3], u64_at(8)), (1, 0, 0, KEY));
        let (what, mut at, mut numbers) = (bytes[1], 24, Vec::new());
        if what & ACK != 0 {
            let count = usize::from(bytes[40]);
            numbers = (0..count).map(|n| (u64_at(44 + 12 * n), u32_at(52 + 12 * n))).collect();
            at = 44 + 12 * count;
        }
        let probe = (what & PROBE != 0).then(|| u64_at(at));
        at += if probe.is_some() { 8 } else { 0 };
        assert_eq!(u32_at(20), crc32fast::hash(&[&bytes[..20], &bytes[24..at]].concat()));
        let value = (what & VALUE != 0).then(|| decode_datagram(&bytes[at..]).expect("it is a frame"));
        Received { what, stamp: u32_at(16), probe, length, value, numbers }
    }

    /// Returns the next value, with its number.
    pub(super) async fn receive_value(&self) -> (u64, Vec<u8>) {
        loop {
            if let Some(value) = self.receive().await.value {
                assert_eq!((value.header.class, value.header.flags), (Class::Stream, Flags::NONE));
                return (value.header.correlation, value.payload.to_vec());
            }
        }
    }

    /// Returns the next value on the connection, with its number.
    pub(super) async fn receive_on_connection(&mut self) -> (u64, Vec<u8>) {
        loop {
            let message = self.stream.receive().await;
            if message.header.class == Class::Stream {
                return (message.header.correlation, message.payload.to_vec());
            }
        }
    }
}

pub(super) fn nines_app() -> Tid {
    Tid::new(NINE, sinew_runtime::tid::AppAddress::new(0x1001))
}
