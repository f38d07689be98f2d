//! How a link begins: the registration, the node's answer, and what carries the messages from then on.

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
use sinew_runtime::{
    tid::{NodeAddress, Tid},
    time::Time,
    wire::{FrameCodec, FrameError, HEADER_LEN, Header, HeaderError, Kind, Message},
};
use tokio_util::codec::Decoder;

use super::{Ended, Link, LinkOptions, Reader, Writer, asked, connect, ring, socket};
use crate::{
    client::ApiError,
    lncl::payload::{self, Missing, Refusal, Register, Registered, Waiting},
    ring::{self as rings, Exchange, ExchangeError},
};

/// Time that the node has for its part of the exchange of offers.
const EXCHANGE: Duration = Duration::from_secs(2);
/// Longest payload before the node has said how long they may be.
const GREETING_BYTES_MAX: usize = 64 * 1024;

/// A registration that the node has not answered yet.
pub(in crate::client) struct Greeting {
    socket: Arc<UnixStream>,
    options: LinkOptions,
    /// The answer, as far as it has come, and no byte more: descriptors may come with the next.
    frame: BytesMut,
    filled: usize,
    /// What the node says that it waits for; `None` if it has said nothing at all.
    missing: Option<Vec<String>>,
    /// The address is given; the node's half of the rings has not come yet.
    offered: Option<Offered>,
    /// The node has given it up, and says that another one may succeed.
    may_begin_anew: bool,
}

/// This side's half of the rings, which the node knows.
struct Offered {
    registered: Registered,
    /// Nobody else has it: locked so that whoever has a reference to the endpoint may be on any thread.
    exchange: Mutex<Exchange>,
    /// Until then the node may take for its own.
    until: Time,
}

impl Greeting {
    /// Connects, and asks for an address, until `deadline` at most.
    pub(in crate::client) fn begin(
        path: &Path,
        register: &Register,
        options: LinkOptions,
        deadline: Time,
    ) -> Result<Self, ApiError> {
        let socket = Arc::new(connect(path, options.believed, deadline)?);
        let lncl = payload::lncl_of(NodeAddress::HERE);
        let asked = asked(register, options.transport);
        let frame = payload::frame(Kind::LNCL_REGISTER, Tid::NONE, lncl, &asked);
        let written = socket::Writer::new(socket.clone(), &options).write(&frame);
        let frame = BytesMut::zeroed(HEADER_LEN);
        let (filled, missing, offered, may_begin_anew) = (0, None, None, false);
        let mut greeting = Self { socket, options, frame, filled, missing, offered, may_begin_anew };
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
    pub(in crate::client) fn wait(&mut self, deadline: Time) -> Result<Option<Link>, ApiError> {
        if self.offered.is_none() {
            let Some(registered) = self.hear(deadline)? else { return Ok(None) };
            let Some(ring_bytes) = registered.ring else { return Ok(Some(self.plain(registered))) };
            let offered = self.offer(registered, ring_bytes);
            self.offered = Some(offered.map_err(|seen| self.told_in_place_of(seen))?);
        }
        self.exchange(deadline)
    }

    /// Whether the node has ended it for what is nobody's fault: it waited for the rings of a process that was stopped, say.
    pub(in crate::client) const fn may_begin_anew(&self) -> bool {
        self.may_begin_anew
    }

    /// What the node took leave with, if it did, in place of what was seen of that.
    fn told_in_place_of(&mut self, seen: ApiError) -> ApiError {
        // Before its words lies its offer. If that is broken, so are they.
        let words = Exchange::receive(&self.socket).ok().and_then(|_| ring::farewell(&self.socket));
        let Some(Ended { why, again }) = words else { return seen };
        self.may_begin_anew = again;
        ApiError::Refused(why)
    }

    /// What the node says that the registration waits for: nothing, if that is not known yet. `None` if it has said nothing at all.
    pub(in crate::client) fn missing(self) -> Option<Vec<String>> {
        self.missing
    }

    /// What the node has answered; `None` if it has not.
    fn hear(&mut self, deadline: Time) -> Result<Option<Registered>, ApiError> {
        while let Some(message) = self.next(deadline)? {
            if message.header.kind != Kind::LNCL_WAITING {
                return read_greeting(&message).map(Some);
            }
            let waiting: Waiting = payload::read(&message.payload).map_err(unreadable)?;
            let words = |missing: Missing| format!("{} ({})", missing.what, missing.why);
            self.missing = Some(waiting.missing.into_iter().map(words).collect());
        }
        Ok(None)
    }

    /// The next frame; `None` if it has not come by the deadline.
    fn next(&mut self, deadline: Time) -> Result<Option<Message>, ApiError> {
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
        let nothing = || ApiError::Closed("the node's first frame cannot be read".to_owned());
        let message = FrameCodec::new(GREETING_BYTES_MAX).decode(&mut self.frame)?.ok_or_else(nothing)?;
        (self.frame, self.filled) = (BytesMut::zeroed(HEADER_LEN), 0);
        Ok(Some(message))
    }

    /// Everything goes through the socket.
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

    /// Maps what the node has offered; `None` if it has not by the deadline.
    fn exchange(&mut self, deadline: Time) -> Result<Option<Link>, ApiError> {
        let theirs = loop {
            if let Some(theirs) = Exchange::receive(&self.socket).map_err(no_rings)? {
                break theirs;
            }
            let Some(Offered { until, .. }) = self.offered else { return Ok(None) };
            let has_come = socket::wait(&self.socket, PollFlags::IN, deadline.min(until));
            if !has_come.map_err(|error| ApiError::Closed(error.to_string()))? {
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
        let reader = ring::Reader::new(socket.clone(), consumer, payload_max, options.spin);
        let writer = Writer::Ring(Arc::new(ring::Writer::new(socket, producer, options)));
        Ok(Some(Link { registered, writer: Arc::new(writer), reader: Reader::Ring(Box::new(reader)) }))
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

fn no_rings(error: ExchangeError) -> ApiError {
    ApiError::Closed(error.to_string())
}

fn unreadable(error: rmp_serde::decode::Error) -> ApiError {
    ApiError::Closed(error.to_string())
}

fn read_greeting(message: &Message) -> Result<Registered, ApiError> {
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
    use crate::{
        client::{NodeApi, Registration, link::Believed},
        lncl::testing::{TestDirectory, WATCHDOG},
    };

    const SHORT: Duration = Duration::from_millis(50);

    /// Plays a node as far as its answer: the address, and that rings are to follow.
    fn answer(listener: &UnixListener) -> UnixStream {
        let (mut client, _) = listener.accept().unwrap();
        let (node, app) = (NodeAddress::new(1), AppAddress::new(0x8000_0001));
        let node_name = "played".to_owned();
        let registered = Registered { node, app, node_name, payload_max: 4_096, ring: Some(4_096) };
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
    fn a_node_that_has_no_rings_yet_is_waited_for_in_as_many_calls_as_it_takes() {
        // given
        let directory = TestDirectory::new();
        let path = directory.path().join("node.sock");
        let listener = UnixListener::bind(&path).unwrap();
        let registration = Registration::new();
        let long = Time::now() + WATCHDOG;
        let begun = Greeting::begin(&path, &registration.register, registration.link.clone(), long);
        let mut greeting = begun.unwrap();
        assert!(greeting.wait(Time::now()).unwrap().is_none(), "it has said nothing");
        let node = answer(&listener);
        assert!(greeting.wait(Time::now() + SHORT).unwrap().is_none(), "it has offered nothing");
        // when
        let (_, offer) = Exchange::prepare(rings::capacity(4_096), BellKind::Socket).unwrap();
        offer.send(&node).unwrap();
        // then
        let link = greeting.wait(Time::now() + WATCHDOG).unwrap().expect("both have offered");
        assert_eq!(link.registered.node_name, "played");
    }

    #[test]
    fn a_registration_waits_for_the_nodes_rings_no_longer_than_it_may() {
        let directory = TestDirectory::new();
        let path = directory.path().join("node.sock");
        let listener = UnixListener::bind(&path).unwrap();
        let node = OnceCell::new();
        let answers = || {
            node.get_or_init(|| answer(&listener));
            true
        };
        let error = Registration::new().deadline(SHORT).greet(&path, WATCHDOG, answers).err();
        assert!(matches!(error, Some(ApiError::NoAnswer(SHORT))), "{error:?}");
    }

    #[test]
    fn a_registration_that_the_node_gave_up_while_its_process_was_stopped_begins_anew() {
        for again in [true, false] {
            // Given: a node that has waited in vain for this side's offer, and then one that does not wait any more.
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
                    let words = payload::frame(Kind::LNCL_REFUSAL, lncl, Tid::NONE, &refusal);
                    node.write_all(&bytes_of(&words)).unwrap();
                    node.shutdown(Shutdown::Both).unwrap();
                }
                nodes.borrow_mut().push(node);
                true
            };
            // When: it goes on.
            let link = Registration::new().deadline(WATCHDOG).greet(&path, WATCHDOG, plays);
            // Then:
            match link {
                Ok(link) => assert!(again && link.registered.node_name == "played"),
                Err(why) => assert!(!again && why.to_string() == "the node refused: too late", "{why}"),
            }
            assert_eq!(nodes.borrow().len(), if again { 2 } else { 1 });
        }
    }

    #[test]
    fn a_registration_waits_for_a_place_at_the_door_no_longer_than_it_may() {
        // Given: somebody who listens, takes nobody, and has as many who wait as may.
        let directory = TestDirectory::new();
        let path = directory.path().join("node.sock");
        let door = socket(AddressFamily::UNIX, SocketType::STREAM, None).unwrap();
        bind(&door, &SocketAddrUnix::new(&path).unwrap()).unwrap();
        listen(&door, 0).unwrap();
        let _waiting = UnixStream::connect(&path).unwrap();
        // When:
        let api = NodeApi { path, believed: Believed::Anybody };
        let registered = api.register_transport_address(Registration::new().deadline(SHORT));
        // Then:
        let error = registered.unwrap_err();
        assert!(matches!(error, ApiError::NoAnswer(within) if within <= SHORT), "{error}");
    }

    #[test]
    fn a_registration_that_takes_too_long_says_what_is_missing_or_that_the_node_says_nothing() {
        // Given: a node that says so much, and then nothing.
        let hip = Missing { what: "hip".to_owned(), why: "not registered".to_owned() };
        let ends: [(Option<Vec<Missing>>, &[&str]); 3] =
            [(Some(vec![hip]), &["hip (not registered)"]), (Some(vec![]), &["hip", "knee"]), (None, &[])];
        for (said, told) in ends {
            let directory = TestDirectory::new();
            let path = directory.path().join("node.sock");
            let listener = UnixListener::bind(&path).unwrap();
            let node = OnceCell::new();
            // When: it has said so before the first look, and nobody wants to look a second time.
            let says = || {
                let looks_first = node.get().is_none();
                node.get_or_init(|| {
                    let (mut client, _) = listener.accept().unwrap();
                    let Some(missing) = said.clone() else { return client };
                    let (kind, waiting) = (Kind::LNCL_WAITING, Waiting { missing });
                    let lncl = payload::lncl_of(NodeAddress::new(1));
                    client.write_all(&bytes_of(&payload::frame(kind, lncl, Tid::NONE, &waiting))).unwrap();
                    client
                });
                looks_first
            };
            let registration = Registration::new().requires(["hip", "knee"]).deadline(WATCHDOG);
            let error = registration.greet(&path, SHORT, says).err();
            // Then:
            let is_said = if told.is_empty() {
                matches!(error, Some(ApiError::NoAnswer(WATCHDOG)))
            } else {
                matches!(&error, Some(ApiError::Waiting { missing, .. }) if *missing == told)
            };
            assert!(is_said, "{error:?}");
        }
    }

    #[test]
    fn what_is_no_path_of_a_socket_is_said_to_be_none() {
        for path in [String::new(), "x".repeat(108)] {
            let error = NodeApi::connect(&path).unwrap_err();
            assert!(matches!(error, ApiError::NotAPath { .. }), "{error}");
        }
    }
}
