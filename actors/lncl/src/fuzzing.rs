//! Fuzz target: any frames of a client, in any state of its connection, against the session's invariants.

use bytes::BytesMut;
use sinew_protocol::payload::{
    self, Group, Introduce, Introduction, Register, Resolve, Switch, TypeDeclaration,
};
use sinew_runtime::{
    fuzzing::is_read_as_written,
    outcome::Outcome,
    tid::{AppAddress, NodeAddress, Tid},
    wire::{Checksum, FrameCodec, HEADER_LEN, Header, Kind, MAGIC, Message, VERSION},
};
use tokio_util::codec::{Decoder as _, Encoder as _};

use super::session::{GROUPS_MAX, Order, Session};

const CLIENT: Tid = Tid::new(NodeAddress::new(0x7f00_0001), AppAddress::new(0x8000_0001));
const PAYLOAD_MAX: usize = 4_096;

/// Returns the frames of a complete session: registration, group, requests, message, outcome, and end.
pub fn some_frames() -> Vec<Vec<u8>> {
    let group = Group { group: AppAddress::group("legs"), member: true };
    let frames = [
        payload::frame(
            Kind::LNCL_REGISTER,
            Tid::NONE,
            CLIENT,
            &Register { name: Some("hip".to_owned()), ..Register::default() },
        ),
        payload::frame(Kind::LNCL_GROUP, CLIENT, CLIENT, &group),
        payload::frame(
            Kind::LNCL_RESOLVE,
            CLIENT,
            CLIENT,
            &Resolve { name: "knee".to_owned(), nearest: true },
        ),
        payload::frame(Kind::LNCL_INTRODUCE, CLIENT, CLIENT, &Introduce { to: CLIENT.bits() }),
        payload::frame(Kind::LNCL_SWITCH, CLIENT, CLIENT, &Switch { peer: CLIENT.bits(), number: 1 }),
        payload::frame(Kind::LNCL_TYPE, CLIENT, CLIENT, &declaration()),
        Message::new(Header::new(Kind::OUTCOME, CLIENT, CLIENT), vec![Outcome::Delivered.code()].into()),
        Message::new(Header::new(Kind::named("torque"), CLIENT, CLIENT), vec![1; 8].into()),
        Message::new(Header::new(Kind::LNCL_UNREGISTER, CLIENT, CLIENT), bytes::Bytes::new()),
    ];
    let mut codec = FrameCodec::in_memory(PAYLOAD_MAX);
    let mut bytes = BytesMut::new();
    for frame in &frames {
        codec.encode(frame, &mut bytes).expect("it is short");
    }
    vec![[&[200][..], &bytes].concat()]
}

/// Returns the declaration of a struct without fields.
fn declaration() -> TypeDeclaration {
    let (kind, policy) = (Kind::named("torque"), "accept-additions".to_owned());
    TypeDeclaration { kind, handles: true, sends: false, policy, protected: false, schema: vec![1, 0, 0] }
}

pub fn control(bytes: &[u8]) -> bool {
    let Some((piece, bytes)) = bytes.split_first() else { return false };
    let mut mended = bytes.to_vec();
    mend(&mut mended);
    let as_it_is = converse(bytes, 1 + usize::from(*piece));
    converse(&mended, 1 + usize::from(*piece)) || as_it_is
}

/// Gives each frame a valid start, and the client's own source in half of the cases.
fn mend(mut bytes: &mut [u8]) {
    while bytes.len() >= HEADER_LEN {
        bytes[..2].copy_from_slice(&MAGIC);
        bytes[2..4].copy_from_slice(&[VERSION, HEADER_LEN as u8]);
        bytes[5] &= 0x0F;
        bytes[6..8].fill(0);
        if bytes[16] & 1 == 0 {
            bytes[16..24].copy_from_slice(&CLIENT.bits().to_le_bytes());
        }
        let start = bytes.first_chunk().expect("a header is longer");
        let length = Header::payload_len(start).expect("it was just made one") as usize;
        if bytes.len() < HEADER_LEN + length {
            return;
        }
        bytes = &mut bytes[HEADER_LEN + length..];
    }
}

/// Handles frames as LNCL's shell does, until it would end the connection.
fn converse(bytes: &[u8], pieces: usize) -> bool {
    let mut codec = FrameCodec::new(PAYLOAD_MAX);
    codec.set_checksum(Checksum::None);
    let (mut session, mut buffer, mut is_registered, mut groups) =
        (Session::default(), BytesMut::new(), false, 0_usize);
    for piece in bytes.chunks(pieces) {
        buffer.extend_from_slice(piece);
        loop {
            let message = match codec.decode(&mut buffer) {
                Ok(Some(message)) => message,
                Ok(None) => break,
                Err(_) => return is_registered,
            };
            let source = message.header.source;
            payloads(&message.payload);
            match session.handle(message) {
                Order::Register(_) => {
                    assert!(!is_registered, "one connection has one address");
                    is_registered = true;
                    session.registered(CLIENT);
                    session.released(CLIENT);
                }
                Order::Unregister | Order::End(_) => return is_registered,
                Order::SetMember { group, member, .. } => {
                    assert!(is_registered && group.is_group());
                    groups += usize::from(member);
                }
                Order::Route(message) => {
                    assert!(
                        is_registered && message.header.kind.is_user() && message.header.source == CLIENT
                    );
                }
                Order::RefuseMessage { .. } => assert!(is_registered),
                Order::Settle { .. }
                | Order::RefuseMembership { .. }
                | Order::Resolve { .. }
                | Order::Introduce { .. }
                | Order::Switch { .. }
                | Order::DeclareType(_)
                | Order::Ready
                | Order::Observe(_) => assert!(is_registered && source == CLIENT),
            }
        }
        assert!(buffer.capacity() <= 2 * FrameCodec::BUFFER_KEPT);
    }
    assert!(groups <= GROUPS_MAX || bytes.len() > GROUPS_MAX * HEADER_LEN);
    is_registered
}

/// Checks the payloads that a client reads, and those that a node reads.
fn payloads(bytes: &[u8]) {
    is_read_as_written::<Register>(bytes);
    is_read_as_written::<payload::Registered>(bytes);
    is_read_as_written::<payload::Refusal>(bytes);
    is_read_as_written::<payload::Waiting>(bytes);
    is_read_as_written::<payload::Undelivered>(bytes);
    is_read_as_written::<payload::Gone>(bytes);
    is_read_as_written::<Introduction>(bytes);
    is_read_as_written::<TypeDeclaration>(bytes);
}
