//! A handwritten peer: it speaks the protocol frame by frame, as in another language.

use bytes::Bytes;
use sinew_runtime::{
    outcome::Outcome,
    tid::{AppAddress, Incarnation, NodeAddress},
    time::Time,
    wire::{Checksum, Flags, FrameCodec, Header, Kind, Message},
};
use sinew_session::Ack;
use tokio::net::TcpStream;
use tokio_util::codec::Decoder;

use super::{LONGEST, Node, within};
use crate::{
    core::{Introduction, Lane, Refusal, read, write},
    frame::frame,
};

/// A handwritten peer.
pub(in crate::tests) struct ByHand {
    pub(in crate::tests) socket: TcpStream,
    buffer: bytes::BytesMut,
    /// The number of the next message in its session.
    number: u16,
    /// The checksum of its frames.
    checksum: Checksum,
}

impl ByHand {
    pub(in crate::tests) async fn dial(node: &Node) -> Self {
        Self::on(
            within("a connection", TcpStream::connect(node.listens_at())).await.expect("the node listens"),
        )
    }

    pub(in crate::tests) fn on(socket: TcpStream) -> Self {
        Self { socket, buffer: bytes::BytesMut::new(), number: 1, checksum: Checksum::Crc }
    }

    /// Links to `node`, as its peer number 9.
    pub(in crate::tests) async fn linked_to(node: &mut Node) -> Self {
        let peer = Self::greeting(node, &introduction(node.address())).await;
        node.up().await;
        peer
    }

    /// Opens a connection to `node`, sends `hello`, and receives the WELCOME.
    pub(in crate::tests) async fn greeting(node: &Node, hello: &Introduction) -> Self {
        let mut peer = Self::dial(node).await;
        peer.send(&frame(NINE, node.address(), Kind::GNCL_HELLO, write(hello))).await;
        let welcome = peer.receive().await;
        assert_eq!(welcome.header.kind, Kind::GNCL_WELCOME);
        let welcome: Introduction = read(&welcome.payload).expect("a WELCOME has a payload");
        assert_eq!((welcome.node, welcome.peer), (node.address(), NINE));
        assert_eq!((welcome.lane, welcome.link), (hello.lane, hello.link));
        if hello.supports("guard") {
            peer.checksum = Checksum::Guarded;
        }
        peer.begin(node).await;
        peer
    }

    /// Sends its first ACK: everything from the first message on, as if it had not been there before.
    async fn begin(&mut self, node: &Node) {
        let theirs = self.try_receive_any().await.expect("the node says what it takes next");
        assert_eq!(theirs.header.kind, Kind::GNCL_ACK);
        let memory = Time::now().as_nanos();
        let ours = Ack {
            receiver_id: memory,
            epoch: memory,
            peer_epoch: 0,
            next: 1,
            change: 0,
            held: Vec::new(),
            room: None,
        };
        self.send(&frame(NINE, node.address(), Kind::GNCL_ACK, write(&ours))).await;
    }

    /// Breaks the order of its session's numbers.
    pub(in crate::tests) fn skip(&mut self, numbers: i32) {
        self.number = self.number.wrapping_add_signed(numbers as i16);
    }

    /// Writes a frame, with the next number if it is a message.
    pub(in crate::tests) async fn send(&mut self, message: &Message) {
        let mut bytes = bytes::BytesMut::new();
        let mut message = Message::new(message.header, message.payload.clone());
        let is_of_outcomes = matches!(message.header.kind, Kind::GNCL_OUTCOMES | Kind::GNCL_OUTCOME_RUNS);
        if message.header.destination.app != AppAddress::GNCL || is_of_outcomes {
            message.header.number = self.number;
            self.number = self.number.wrapping_add(1);
        }
        bytes.extend_from_slice(&self.checksum.encode(&message.header, &message.payload));
        bytes.extend_from_slice(&message.payload);
        self.send_bytes(&bytes).await;
    }

    pub(in crate::tests) async fn send_bytes(&mut self, bytes: &[u8]) {
        let writing = tokio::io::AsyncWriteExt::write_all(&mut self.socket, bytes);
        within("the node to read", writing).await.expect("the node reads");
    }

    /// Returns the next frame; panics if the node closes the connection instead.
    pub(in crate::tests) async fn receive(&mut self) -> Message {
        self.try_receive().await.expect("the node closed the connection")
    }

    /// Returns the next frame that is no ACK, or `None` when the node has closed the connection.
    pub(in crate::tests) async fn try_receive(&mut self) -> Option<Message> {
        loop {
            let message = self.try_receive_any().await?;
            if message.header.kind != Kind::GNCL_ACK {
                return Some(message);
            }
        }
    }

    pub(in crate::tests) async fn try_receive_any(&mut self) -> Option<Message> {
        loop {
            if let Some(message) =
                FrameCodec::new(LONGEST).decode(&mut self.buffer).expect("the node writes frames")
            {
                return Some(message);
            }
            let reading = tokio::io::AsyncReadExt::read_buf(&mut self.socket, &mut self.buffer);
            match within("bytes from the node", reading).await {
                Ok(0) | Err(_) => return None,
                Ok(_) => {}
            }
        }
    }

    /// Returns the refusal, which must come next, followed by the end of the connection.
    pub(in crate::tests) async fn refusal(mut self) -> Refusal {
        let message = self.receive().await;
        assert_eq!(message.header.kind, Kind::GNCL_REFUSAL);
        let refusal = read(&message.payload).expect("a REFUSAL has a payload");
        assert!(self.try_receive().await.is_none(), "the connection is closed after a refusal");
        refusal
    }

    /// Returns an outcome for the confirmed message `about`.
    pub(in crate::tests) fn outcome(about: &Message, outcome: Outcome) -> Message {
        let mut header = Header::new(Kind::OUTCOME, about.header.destination, about.header.source);
        header.flags = Flags::OUTCOME;
        header.correlation = about.header.correlation;
        Message::new(header, Bytes::copy_from_slice(&[outcome.code()]))
    }
}

/// The address of the handwritten peer.
pub(in crate::tests) const NINE: NodeAddress = NodeAddress::new(9);

pub(in crate::tests) fn introduction(to: NodeAddress) -> Introduction {
    Introduction {
        project: "sinew".to_owned(),
        node: NINE,
        name: "by-hand".to_owned(),
        incarnation: Incarnation(1),
        peer: to,
        dial: 1,
        payload_max: 1 << 20,
        answers_max: 8_192,
        features: Vec::new(),
        lane: Lane::Control,
        link: 0,
        datagrams_made: 0,
    }
}
