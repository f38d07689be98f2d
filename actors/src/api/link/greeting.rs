//! How a link begins: the registration, the node's answer, and what carries the messages from then on.

use std::{os::unix::net::UnixStream, path::Path, sync::Arc, time::Duration};

use bytes::BytesMut;
use rustix::{
    event::PollFlags,
    io::Errno,
    net::{RecvFlags, recv},
};
use sinew_runtime::{
    tid::{NodeAddress, Tid},
    time::Time,
    wire::{FrameCodec, HEADER_LEN, Header, HeaderError, Kind, Message},
};
use tokio_util::codec::Decoder;

use super::{Link, LinkOptions, Reader, Writer, asked, connect, ring, socket};
use crate::{
    api::ApiError,
    lncl::payload::{self, Refusal, Register, Registered},
};

/// Time that the node has for its part of the exchange of offers.
const EXCHANGE: Duration = Duration::from_secs(2);
/// Longest payload before the node has said how long they may be.
const GREETING_BYTES_MAX: usize = 64 * 1024;

/// Connects and registers; `None` if the node has not answered by the deadline.
pub(in crate::api) fn open(
    path: &Path,
    register: &Register,
    deadline: Time,
    options: LinkOptions,
) -> Result<Option<Link>, ApiError> {
    let socket = Arc::new(connect(path)?);
    let plain = socket::Writer::new(socket.clone(), options.patience);
    let lncl = payload::lncl_of(NodeAddress::HERE);
    let asked = asked(register, options.transport);
    plain.write(&payload::frame(Kind::LNCL_REGISTER, Tid::NONE, lncl, &asked))?;
    let Some(registered) = greeting(&socket, deadline)?.map(|message| read_greeting(&message)).transpose()?
    else {
        return Ok(None);
    };
    let payload_max = registered.payload_max as usize;
    let (writer, reader) = match registered.ring {
        None => (Writer::Socket(plain), Reader::Socket(socket::Reader::new(socket, payload_max))),
        Some(ring_bytes) => {
            let (producer, consumer) = ring::exchange(&socket, ring_bytes, Time::now() + EXCHANGE)?;
            let reader = ring::Reader::new(socket.clone(), consumer, payload_max, options.spin);
            (Writer::Ring(ring::Writer::new(socket, producer, options)), Reader::Ring(Box::new(reader)))
        }
    };
    Ok(Some(Link { registered, writer: Arc::new(writer), reader }))
}

/// Reads the node's first frame and no byte more, since descriptors may come with the next; `None` at the deadline.
fn greeting(socket: &UnixStream, deadline: Time) -> Result<Option<Message>, ApiError> {
    let mut frame = BytesMut::zeroed(HEADER_LEN);
    if !read_exactly(socket, &mut frame, deadline)? {
        return Ok(None);
    }
    let start = frame.first_chunk().ok_or(HeaderError::NotAFrame).and_then(Header::payload_len);
    let length = start.map_err(sinew_runtime::wire::FrameError::from)? as usize;
    frame.resize(HEADER_LEN + length.min(GREETING_BYTES_MAX), 0);
    if !read_exactly(socket, &mut frame[HEADER_LEN..], deadline)? {
        return Ok(None);
    }
    Ok(FrameCodec::new(GREETING_BYTES_MAX).decode(&mut frame)?)
}

/// Whether all of it has come by the deadline.
fn read_exactly(socket: &UnixStream, mut target: &mut [u8], deadline: Time) -> Result<bool, ApiError> {
    while !target.is_empty() {
        match recv(socket, &mut *target, RecvFlags::DONTWAIT) {
            Ok((0, _)) => return Err(ApiError::Closed("the node closed it without a word".to_owned())),
            Ok((count, _)) => target = &mut target[count..],
            Err(Errno::INTR) => {}
            Err(Errno::AGAIN) => {
                let is_ready = socket::wait(socket, PollFlags::IN, deadline);
                if !is_ready.map_err(|error| ApiError::Closed(error.to_string()))? {
                    return Ok(false);
                }
            }
            Err(error) => return Err(ApiError::Closed(error.to_string())),
        }
    }
    Ok(true)
}

fn read_greeting(message: &Message) -> Result<Registered, ApiError> {
    let unreadable = |error: rmp_serde::decode::Error| ApiError::Closed(error.to_string());
    match message.header.kind {
        Kind::LNCL_REGISTERED => payload::read(&message.payload).map_err(unreadable),
        Kind::LNCL_REFUSAL => {
            let refusal: Refusal = payload::read(&message.payload).map_err(unreadable)?;
            Err(ApiError::Refused(refusal.sentence))
        }
        // Not an enum of ours: an open set of numbers.
        kind => Err(ApiError::Closed(format!("the node's first frame has kind {kind}"))),
    }
}
