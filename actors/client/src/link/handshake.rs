//! How a link starts: the registration, the node's answer, and the choice of the transport for the messages.

use std::{
    os::unix::net::UnixStream,
    path::Path,
    sync::{Arc, Mutex, PoisonError},
    time::Duration,
};

use bytes::BytesMut;
use rustix::{
    event::PollFlags,
    io::Errno,
    net::{RecvFlags, recv},
};
use sinew_protocol::{
    payload::{self, Missing, Refusal, Register, Registered, Waiting},
    ring::{self as rings, Exchange, ExchangeError},
};
use sinew_runtime::{
    tid::{NodeAddress, Tid},
    time::Time,
    wire::{FrameCodec, FrameError, HEADER_LEN, Header, HeaderError, Kind, Message},
};
use tokio_util::codec::Decoder;

use super::{Ended, Link, LinkOptions, Reader, Writer, asked, connect, ring, socket};
use crate::ApiError;

/// Time limit for the node's part of the exchange of offers.
const EXCHANGE: Duration = Duration::from_secs(2);
/// Maximum payload before the node has announced its limit.
const HANDSHAKE_BYTES_MAX: usize = 64 * 1024;

/// A registration that the node has not answered yet.
pub(crate) struct RegistrationHandshake {
    socket: Arc<UnixStream>,
    options: LinkOptions,
    /// The received part of the answer, and no byte beyond it: descriptors may arrive with the next byte.
    frame: BytesMut,
    filled: usize,
    /// The requirements for which the node waits; `None` if it has not answered at all.
    missing: Option<Vec<String>>,
    /// The address is assigned; the node's half of the rings has not arrived yet.
    offered: Option<Offered>,
    /// The node has abandoned the registration and reports that another one may succeed.
    may_restart: bool,
}

/// This side's half of the rings, which the node knows.
struct Offered {
    registered: Registered,
    /// Used by one caller only; locked so that a reference to the endpoint can be on any thread.
    exchange: Mutex<Exchange>,
    /// The deadline for the node's half.
    until: Time,
}

impl RegistrationHandshake {
    /// Connects and sends the registration, until `deadline` at most.
    pub(crate) fn begin(
        path: &Path,
        register: &Register,
        options: LinkOptions,
        deadline: Time,
    ) -> Result<Self, ApiError> {
        let socket = Arc::new(connect(path, options.server_trust, deadline)?);
        let lncl = payload::lncl_of(NodeAddress::HERE);
        let asked = asked(register, &options);
        let frame = payload::frame(Kind::LNCL_REGISTER, Tid::NONE, lncl, &asked);
        let written = socket::Writer::new(socket.clone(), &options).write(&frame);
        let frame = BytesMut::zeroed(HEADER_LEN);
        let (filled, missing, offered, may_restart) = (0, None, None, false);
        let mut handshake = Self { socket, options, frame, filled, missing, offered, may_restart };
        match written {
            Ok(()) => Ok(handshake),
            Err(error) => Err(handshake.explain(error)),
        }
    }

    /// Replaces the error by the node's reason: a client that is refused before it has sent anything finds a
    /// closed socket that holds the reason.
    fn explain(&mut self, error: ApiError) -> ApiError {
        match self.wait(Time::now()) {
            Err(refused @ ApiError::Refused(_)) => refused,
            // No answer, or no more specific one.
            Ok(_) | Err(_) => error,
        }
    }

    /// Waits for the answer, or returns `None` if it has not arrived by the deadline. May be called again
    /// then.
    pub(crate) fn wait(&mut self, deadline: Time) -> Result<Option<Link>, ApiError> {
        if self.offered.is_none() {
            let Some(registered) = self.read_answer(deadline)? else { return Ok(None) };
            let Some(ring_bytes) = registered.ring else {
                return Ok(Some(self.with_types(self.plain(registered))));
            };
            let offered = self.offer(registered, ring_bytes);
            self.offered = Some(offered.map_err(|seen| self.reason_or(seen))?);
        }
        self.exchange(deadline)
    }

    /// Returns the socket on which the answer arrives.
    pub(crate) fn socket(&self) -> &UnixStream {
        &self.socket
    }

    /// Returns whether the node has ended the registration for a reason without fault, for example because it
    /// waited for the rings of a stopped process.
    pub(crate) const fn may_restart(&self) -> bool {
        self.may_restart
    }

    /// Returns the node's reason for closing, if it sent one, instead of the observed error.
    fn reason_or(&mut self, seen: ApiError) -> ApiError {
        // The node's offer precedes the reason. If the offer is broken, so is the reason.
        let reason = Exchange::receive(&self.socket).ok().and_then(|_| ring::received_refusal(&self.socket));
        let Some(Ended { why, again }) = reason else { return seen };
        self.may_restart = again;
        ApiError::Refused(why)
    }

    /// Returns the requirements for which the registration waits; empty if not known yet. `None` if the node
    /// has not answered at all.
    pub(crate) fn missing(self) -> Option<Vec<String>> {
        self.missing
    }

    /// Returns the node's answer, or `None` if it has not arrived.
    fn read_answer(&mut self, deadline: Time) -> Result<Option<Registered>, ApiError> {
        while let Some(message) = self.next(deadline)? {
            if message.header.kind != Kind::LNCL_WAITING {
                return read_registered(&message).map(Some);
            }
            let waiting: Waiting = payload::read(&message.payload).map_err(unreadable)?;
            let describe = |missing: Missing| format!("{} ({})", missing.what, missing.why);
            self.missing = Some(waiting.missing.into_iter().map(describe).collect());
        }
        Ok(None)
    }

    /// Returns the next frame, or `None` if it has not arrived by the deadline.
    fn next(&mut self, deadline: Time) -> Result<Option<Message>, ApiError> {
        if !self.fill(deadline)? {
            return Ok(None);
        }
        if self.frame.len() == HEADER_LEN {
            let start = self.frame.first_chunk().ok_or(HeaderError::NotAFrame).and_then(Header::payload_len);
            let length = start.map_err(FrameError::from)? as usize;
            self.frame.resize(HEADER_LEN + length.min(HANDSHAKE_BYTES_MAX), 0);
            if !self.fill(deadline)? {
                return Ok(None);
            }
        }
        let nothing = || ApiError::Closed("the node's first frame cannot be read".to_owned());
        let message = FrameCodec::new(HANDSHAKE_BYTES_MAX).decode(&mut self.frame)?.ok_or_else(nothing)?;
        (self.frame, self.filled) = (BytesMut::zeroed(HEADER_LEN), 0);
        Ok(Some(message))
    }

    /// Returns a link that sends all messages through the socket.
    fn plain(&self, registered: Registered) -> Link {
        let (socket, payload_max) = (self.socket.clone(), registered.payload_max as usize);
        let writer = Writer::Socket(socket::Writer::new(socket.clone(), &self.options));
        let reader = Reader::Socket(socket::Reader::new(socket, payload_max));
        Link { registered, writer: Arc::new(writer), reader }
    }

    fn offer(&self, registered: Registered, ring_bytes: u32) -> Result<Offered, ApiError> {
        let capacity = rings::capacity(ring_bytes as usize);
        let (exchange, offer) = Exchange::prepare(capacity, self.options.bell.clone()).map_err(no_rings)?;
        offer.send(&self.socket).map_err(|error| no_rings(error.into()))?;
        Ok(Offered { registered, exchange: Mutex::new(exchange), until: Time::now() + EXCHANGE })
    }

    /// Maps the node's offer, or returns `None` if it has not arrived by the deadline.
    fn exchange(&mut self, deadline: Time) -> Result<Option<Link>, ApiError> {
        let theirs = loop {
            if let Some(theirs) = Exchange::receive(&self.socket).map_err(no_rings)? {
                break theirs;
            }
            let Some(Offered { until, .. }) = self.offered else { return Ok(None) };
            let has_arrived = socket::wait(&self.socket, PollFlags::IN, deadline.min(until));
            if !has_arrived.map_err(|error| ApiError::Closed(error.to_string()))? {
                if deadline < until {
                    return Ok(None);
                }
                return Err(ApiError::Closed("it offered no shared memory in time".to_owned()));
            }
        };
        let Some(Offered { registered, exchange, .. }) = self.offered.take() else { return Ok(None) };
        let exchange = exchange.into_inner().unwrap_or_else(PoisonError::into_inner);
        let theirs = exchange.accept(theirs).map_err(no_rings)?;
        let (producer, consumer) = exchange.join(theirs);
        let (socket, options, payload_max) =
            (self.socket.clone(), &self.options, registered.payload_max as usize);
        let reader = ring::Reader::new(socket.clone(), consumer, payload_max, options);
        let writer = Writer::Ring(Arc::new(ring::Writer::new(socket, producer, options)));
        let link = Link { registered, writer: Arc::new(writer), reader: Reader::Ring(Box::new(reader)) };
        Ok(Some(self.with_types(link)))
    }

    /// Declares the types of the application on a new link. A node of a former version would refuse the declaration.
    fn with_types(&self, link: Link) -> Link {
        let Registered { node, app, payload_max, types, .. } = link.registered;
        if types {
            self.options.types.declare(Tid::new(node, app), payload_max as usize, &link.writer);
        }
        link
    }

    /// Returns whether all wanted bytes have arrived by the deadline.
    fn fill(&mut self, deadline: Time) -> Result<bool, ApiError> {
        while self.filled < self.frame.len() {
            match recv(&self.socket, &mut self.frame[self.filled..], RecvFlags::DONTWAIT) {
                Ok((0, _)) => return Err(ApiError::Closed("the node closed it without a reason".to_owned())),
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

fn no_rings(error: ExchangeError) -> ApiError {
    ApiError::Closed(error.to_string())
}

fn unreadable(error: rmp_serde::decode::Error) -> ApiError {
    ApiError::Closed(error.to_string())
}

fn read_registered(message: &Message) -> Result<Registered, ApiError> {
    match message.header.kind {
        Kind::LNCL_REGISTERED => payload::read(&message.payload).map_err(unreadable),
        Kind::LNCL_REFUSAL => {
            let refusal: Refusal = payload::read(&message.payload).map_err(unreadable)?;
            Err(ApiError::Refused(refusal.sentence))
        }
        // Not an enum of this crate: an open set of numbers.
        kind => Err(ApiError::Closed(format!("the node's first frame has kind {kind}"))),
    }
}

#[cfg(test)]
#[cfg(target_os = "linux")]
mod tests {
    use std::{
        cell::{OnceCell, RefCell},
        io::Write,
        net::Shutdown,
        os::unix::net::UnixListener,
    };

    use rustix::net::{AddressFamily, SocketAddrUnix, SocketType, bind, listen, socket};
    use sinew_runtime::{tid::AppAddress, wire::encode_frame};
    use sinew_shm::BellKind;

    use super::*;
    use crate::{NodeApi, Registration, link::ServerTrust};
    use sinew_lncl::testing::{TestDirectory, WATCHDOG};

    const SHORT: Duration = Duration::from_millis(50);

    /// Plays a node as far as its answer: the address, and that rings are to follow.
    fn answer(listener: &UnixListener) -> UnixStream {
        let (mut client, _) = listener.accept().unwrap();
        let (node, app) = (NodeAddress::new(1), AppAddress::new(0x8000_0001));
        let node_name = "played".to_owned();
        let registered = Registered {
            node,
            app,
            node_name,
            payload_max: 4_096,
            ring: Some(4_096),
            types: false,
            ready: false,
        };
        let tid = Tid::new(node, app);
        let frame = payload::frame(Kind::LNCL_REGISTERED, payload::lncl_of(node), tid, &registered);
        client.write_all(&bytes_of(&frame)).unwrap();
        client
    }

    fn bytes_of(frame: &Message) -> BytesMut {
        let mut bytes = BytesMut::new();
        encode_frame(&frame.header, &frame.payload, &mut bytes);
        bytes
    }

    #[test]
    fn registration_repeats_until_node_has_rings() {
        // given
        let directory = TestDirectory::new();
        let path = directory.path().join("node.sock");
        let listener = UnixListener::bind(&path).unwrap();
        let registration = Registration::new();
        let long = Time::now() + WATCHDOG;
        let begun =
            RegistrationHandshake::begin(&path, &registration.register, registration.link.clone(), long);
        let mut handshake = begun.unwrap();
        assert!(handshake.wait(Time::now()).unwrap().is_none(), "it has not answered");
        let node = answer(&listener);
        assert!(handshake.wait(Time::now() + SHORT).unwrap().is_none(), "it has offered nothing");
        // when
        let (_, offer) = Exchange::prepare(rings::capacity(4_096), BellKind::Socket).unwrap();
        offer.send(&node).unwrap();
        // then
        let link = handshake.wait(Time::now() + WATCHDOG).unwrap().expect("both have offered");
        assert_eq!(link.registered.node_name, "played");
    }

    #[test]
    fn wait_for_rings_ends_at_deadline() {
        let directory = TestDirectory::new();
        let path = directory.path().join("node.sock");
        let listener = UnixListener::bind(&path).unwrap();
        let node = OnceCell::new();
        let answers = || {
            node.get_or_init(|| answer(&listener));
            true
        };
        let error = Registration::new().deadline(SHORT).register_at(&path, WATCHDOG, answers).err();
        assert!(matches!(error, Some(ApiError::NoAnswer(SHORT))), "{error:?}");
    }

    #[test]
    fn registration_dropped_while_stopped_starts_again() {
        for again in [true, false] {
            // Given: a node that has waited in vain for this side's offer, and then one that does not wait
            // any more.
            let directory = TestDirectory::new();
            let path = directory.path().join("node.sock");
            let listener = UnixListener::bind(&path).unwrap();
            let exchange = || Exchange::prepare(rings::capacity(4_096), BellKind::Socket).unwrap();
            let nodes = RefCell::new(Vec::new());
            let plays = || {
                let mut node = answer(&listener);
                exchange().1.send(&node).unwrap();
                let is_first = nodes.borrow().is_empty();
                if is_first {
                    let refusal = Refusal { sentence: "too late".to_owned(), again };
                    let lncl = payload::lncl_of(NodeAddress::new(1));
                    let frame = payload::frame(Kind::LNCL_REFUSAL, lncl, Tid::NONE, &refusal);
                    node.write_all(&bytes_of(&frame)).unwrap();
                    node.shutdown(Shutdown::Both).unwrap();
                }
                nodes.borrow_mut().push(node);
                true
            };
            // When: registration continues.
            let link = Registration::new().deadline(WATCHDOG).register_at(&path, WATCHDOG, plays);
            // Then:
            match link {
                Ok(link) => assert!(again && link.registered.node_name == "played"),
                Err(why) => assert!(!again && why.to_string() == "the node refused: too late", "{why}"),
            }
            assert_eq!(nodes.borrow().len(), if again { 2 } else { 1 });
        }
    }

    #[test]
    fn wait_for_full_backlog_ends_at_deadline() {
        // Given: a listener that accepts no connection, with a full backlog.
        let directory = TestDirectory::new();
        let path = directory.path().join("node.sock");
        let listener = socket(AddressFamily::UNIX, SocketType::STREAM, None).unwrap();
        bind(&listener, &SocketAddrUnix::new(&path).unwrap()).unwrap();
        listen(&listener, 0).unwrap();
        let _waiting = UnixStream::connect(&path).unwrap();
        // When:
        let api = NodeApi { path, server_trust: ServerTrust::AnyUser };
        let registered = api.register_transport_address(Registration::new().deadline(SHORT));
        // Then:
        let error = registered.unwrap_err();
        assert!(matches!(error, ApiError::NoAnswer(within) if within <= SHORT), "{error}");
    }

    #[test]
    fn late_registration_reports_missing_or_silent_node() {
        // Given: a node that sends this report, and then nothing.
        let hip = Missing { what: "hip".to_owned(), why: "not registered".to_owned() };
        let ends: [(Option<Vec<Missing>>, &[&str]); 3] =
            [(Some(vec![hip]), &["hip (not registered)"]), (Some(vec![]), &["hip", "knee"]), (None, &[])];
        for (sent, expected) in ends {
            let directory = TestDirectory::new();
            let path = directory.path().join("node.sock");
            let listener = UnixListener::bind(&path).unwrap();
            let node = OnceCell::new();
            // When: the node has sent it before the first poll, and the caller does not poll a second time.
            let plays = || {
                let is_first_poll = node.get().is_none();
                node.get_or_init(|| {
                    let (mut client, _) = listener.accept().unwrap();
                    let Some(missing) = sent.clone() else { return client };
                    let (kind, waiting) = (Kind::LNCL_WAITING, Waiting { missing });
                    let lncl = payload::lncl_of(NodeAddress::new(1));
                    client.write_all(&bytes_of(&payload::frame(kind, lncl, Tid::NONE, &waiting))).unwrap();
                    client
                });
                is_first_poll
            };
            let registration = Registration::new().requires(["hip", "knee"]).deadline(WATCHDOG);
            let error = registration.register_at(&path, SHORT, plays).err();
            // Then:
            let is_expected = if expected.is_empty() {
                matches!(error, Some(ApiError::NoAnswer(WATCHDOG)))
            } else {
                matches!(&error, Some(ApiError::Waiting { missing, .. }) if *missing == expected)
            };
            assert!(is_expected, "{error:?}");
        }
    }

    #[test]
    fn invalid_socket_path_is_reported() {
        for path in [String::new(), "x".repeat(108)] {
            let error = NodeApi::connect(&path).unwrap_err();
            assert!(matches!(error, ApiError::NotAPath { .. }), "{error}");
        }
    }
}
