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
    wire::{FrameCodec, FrameError, HEADER_LEN, Header, HeaderError, Kind, Message},
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

/// A registration that the node has not answered yet.
pub(in crate::api) struct Greeting {
    socket: Arc<UnixStream>,
    options: LinkOptions,
    /// The answer, as far as it has come, and no byte more: descriptors may come with the next.
    frame: BytesMut,
    filled: usize,
}

impl Greeting {
    /// Connects, and asks for an address.
    pub(in crate::api) fn begin(
        path: &Path,
        register: &Register,
        options: LinkOptions,
    ) -> Result<Self, ApiError> {
        let socket = Arc::new(connect(path)?);
        let lncl = payload::lncl_of(NodeAddress::HERE);
        let asked = asked(register, options.transport);
        let frame = payload::frame(Kind::LNCL_REGISTER, Tid::NONE, lncl, &asked);
        let written = socket::Writer::new(socket.clone(), &options).write(&frame);
        let mut greeting = Self { socket, options, frame: BytesMut::zeroed(HEADER_LEN), filled: 0 };
        match written {
            Ok(()) => Ok(greeting),
            Err(error) => Err(greeting.explain(error)),
        }
    }

    /// Who is refused before it has said a word finds a closed socket, and the reason in it.
    fn explain(&mut self, error: ApiError) -> ApiError {
        match self.wait(Time::now()) {
            Err(refused @ ApiError::Refused(_)) => refused,
            // It said nothing, or nothing that says more.
            Ok(_) | Err(_) => error,
        }
    }

    /// Waits for the answer; `None` if the node has not given it by the deadline. May be called again then.
    pub(in crate::api) fn wait(&mut self, deadline: Time) -> Result<Option<Link>, ApiError> {
        if !self.fill(deadline)? {
            return Ok(None);
        }
        if self.frame.len() == HEADER_LEN {
            let start = self.frame.first_chunk().ok_or(HeaderError::NotAFrame).and_then(Header::payload_len);
            let length = start.map_err(FrameError::from)? as usize;
            self.frame.resize(HEADER_LEN + length.min(GREETING_BYTES_MAX), 0);
            if !self.fill(deadline)? {
                return Ok(None);
            }
        }
        let unreadable = || ApiError::Closed("the node's first frame cannot be read".to_owned());
        let message = FrameCodec::new(GREETING_BYTES_MAX).decode(&mut self.frame)?.ok_or_else(unreadable)?;
        self.finish(read_greeting(&message)?).map(Some)
    }

    /// Agrees with the node on what carries the messages.
    fn finish(&self, registered: Registered) -> Result<Link, ApiError> {
        let (socket, options) = (self.socket.clone(), &self.options);
        let payload_max = registered.payload_max as usize;
        let (writer, reader) = match registered.ring {
            None => {
                let writer = socket::Writer::new(socket.clone(), options);
                (Writer::Socket(writer), Reader::Socket(socket::Reader::new(socket, payload_max)))
            }
            Some(ring_bytes) => {
                let (producer, consumer) =
                    ring::exchange(&socket, ring_bytes, options.bell.clone(), Time::now() + EXCHANGE)?;
                let reader = ring::Reader::new(socket.clone(), consumer, payload_max, options.spin);
                let writer = Arc::new(ring::Writer::new(socket, producer, options));
                (Writer::Ring(writer), Reader::Ring(Box::new(reader)))
            }
        };
        Ok(Link { registered, writer: Arc::new(writer), reader })
    }

    /// Whether all that is wanted has come by the deadline.
    fn fill(&mut self, deadline: Time) -> Result<bool, ApiError> {
        while self.filled < self.frame.len() {
            match recv(&self.socket, &mut self.frame[self.filled..], RecvFlags::DONTWAIT) {
                Ok((0, _)) => return Err(ApiError::Closed("the node closed it without a word".to_owned())),
                Ok((count, _)) => self.filled += count,
                Err(Errno::INTR) => {}
                Err(Errno::AGAIN) => {
                    let is_ready = socket::wait(&self.socket, PollFlags::IN, deadline);
                    if !is_ready.map_err(|error| ApiError::Closed(error.to_string()))? {
                        return Ok(false);
                    }
                }
                Err(error) => return Err(ApiError::Closed(error.to_string())),
            }
        }
        Ok(true)
    }
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
