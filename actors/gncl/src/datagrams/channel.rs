//! The datagram channel between this node and one peer: the core, its lock, and the socket for sending.

use std::{
    net::SocketAddr,
    sync::{
        Arc, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicU64, Ordering},
    },
};

use sinew_model::refusals::Refusals;
use sinew_runtime::{
    outcome::Rejection,
    router::{MessageSink as _, SubmitError},
    tid::{NodeAddress, Tid},
    time::Time,
    wire::{Checksum, Class, Flags, HEADER_LEN, Header, Kind, Message},
};

use super::{
    alarm::Alarm,
    core::{Core, Order, stamp},
    incoming::Incoming,
    lengths::Report,
    outgoing::{Offered, Position},
    packet::{ACK_LEN, Content, DATAGRAM_MAX, PREFIX_LEN, Packet, Prefix, RANGE_LEN, RANGES_MAX},
    sockets::{Announcement, BoundSocket},
};
use crate::{peer_session::PeerSession, segments::Segments};

/// Maximum payload bytes of a value sent by datagram.
pub(super) const PAYLOAD_MAX: usize = DATAGRAM_MAX - PREFIX_LEN - HEADER_LEN;

/// The key by which Stream conflates values.
type Flow = (Tid, Tid, Kind);

fn flow_of(header: &Header) -> Flow {
    (header.source, header.destination, header.kind)
}

/// The last forwarded numbers of one incarnation of a peer. They outlive the peer's other state, because
/// later values have larger numbers. spec: DATAGRAM-3
#[derive(Clone, Debug)]
pub(crate) struct ForwardedNumbers(Incoming<Flow>);

/// The address where a peer reads datagrams.
#[derive(Clone, Debug)]
struct Target {
    bound: BoundSocket,
    address: SocketAddr,
    key: u64,
}

/// The local socket and the remote address of the Stream connection.
#[derive(Clone, Debug)]
struct Connection {
    bound: BoundSocket,
    remote: SocketAddr,
}

struct State {
    core: Core<Flow, Message>,
    connection: Option<Connection>,
    target: Option<Target>,
    /// Longest payload that the peer accepts, in bytes.
    payload_max: usize,
    /// Whether values are no longer sent by datagram.
    is_retired: bool,
    /// The longest datagram that arrives, as last reported to the peer's connections.
    narrow: Option<usize>,
}

impl State {
    /// Returns when the next action is due.
    fn next_wake(&self) -> Option<Time> {
        match self.target {
            Some(_) => self.core.next_wake(),
            // Nothing is sent to a peer that has not announced its address.
            None => self.core.outgoing.offer_at(),
        }
    }
}

/// Whether a value received over the connection is newer than all forwarded ones, including datagrams.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Freshness {
    New,
    /// A newer value, or this one, was forwarded already.
    Old,
}

/// The datagrams between this node and one incarnation of another.
pub(crate) struct Channel {
    here: NodeAddress,
    node: NodeAddress,
    /// The key required in the peer's datagrams.
    key: u64,
    /// Locked only briefly. A thread may lock the connection's outlet while it holds this lock, never the
    /// other way round.
    state: Mutex<State>,
    /// Time of the last frame from the peer on a connection.
    last_frame: AtomicU64,
    alarm: Arc<Alarm>,
    segments: Arc<Segments>,
    refusals: Arc<Refusals>,
}

impl Channel {
    /// Creates a channel. `now` is the first number. A later channel with the same incarnation starts above
    /// all numbers of this one, because values are sent less often than once a nanosecond. `former` holds the
    /// numbers forwarded by an earlier channel with the same incarnation.
    pub(crate) fn new(
        now: Time,
        (here, node): (NodeAddress, NodeAddress),
        key: u64,
        former: Option<ForwardedNumbers>,
        (alarm, segments, refusals): (Arc<Alarm>, Arc<Segments>, Arc<Refusals>),
    ) -> Self {
        let mut core = Core::new(now.as_nanos());
        if let Some(ForwardedNumbers(incoming)) = former {
            core.incoming = incoming;
        }
        let state =
            State { core, connection: None, target: None, payload_max: 0, is_retired: false, narrow: None };
        let (state, last_frame) = (Mutex::new(state), AtomicU64::new(0));
        Self { here, node, key, state, last_frame, alarm, segments, refusals }
    }

    /// Records a Stream connection between these two addresses, with `bound` beside it. The peer accepts
    /// payloads of `payload_max` bytes. Returns the announcement to send there. spec: DATAGRAM-2
    pub(crate) fn connected(
        &self,
        bound: BoundSocket,
        (local, remote): (SocketAddr, SocketAddr),
        payload_max: usize,
    ) -> Announcement {
        let announcement = bound.announcement(local, self.key);
        let state = &mut *self.lock();
        state.connection = Some(Connection { bound, remote });
        state.payload_max = payload_max.min(PAYLOAD_MAX);
        announcement
    }

    /// Processes the peer's announcement of its datagram address.
    pub(crate) fn announced(&self, now: Time, announcement: Announcement, session: &PeerSession) {
        let wake = {
            let state = &mut *self.lock();
            let Some(Connection { bound, remote }) = state.connection.clone() else { return };
            if state.is_retired {
                return;
            }
            if state.target.as_ref().is_some_and(|target| target.key != announcement.key) {
                state.core.begin_anew();
            }
            let target =
                announcement.target(remote).map(|address| Target { bound, address, key: announcement.key });
            let is_same =
                |former: &Target, new: &Target| (former.address, former.key) == (new.address, new.key);
            match (&state.target, &target) {
                (Some(former), Some(new)) if is_same(former, new) => state.core.reconnected(now),
                (_, Some(_)) => state.core.announced(now),
                (_, None) => state.core.retire(),
            }
            state.target = target;
            self.offer_to_connection(now, state, session);
            state.next_wake()
        };
        self.alarm.set(wake);
    }

    /// Submits a message of class Stream, by datagram if possible, otherwise by the connection.
    ///
    /// # Errors
    /// Returns the message if the connection's outlet does not accept it.
    pub(crate) fn submit(&self, message: Message, session: &PeerSession) -> Result<(), SubmitError> {
        match self.by_datagram(message) {
            None => Ok(()),
            // The lock is released here, because a long message is written in pieces.
            Some(message) => self.by_connection(message, session),
        }
    }

    /// Queues the message for a datagram, or returns it with its number for the connection.
    fn by_datagram(&self, message: Message) -> Option<Message> {
        let flow = flow_of(&message.header);
        let wake = {
            let now = Time::now();
            let state = &mut *self.lock();
            let fits = message.payload.len() <= state.payload_max;
            let may =
                fits && !state.is_retired && message.receipt.is_none() && !message.header.is_expired(now);
            let left = if may {
                let bytes = PREFIX_LEN + message.size();
                let expiry = message.header.expiry();
                state.core.submit(flow, message, bytes, expiry).err()
            } else {
                Some(message)
            };
            if let Some(mut message) = left {
                message.header.correlation = state.core.outgoing.start_on_connection(flow);
                return Some(message);
            }
            self.write(state, now);
            state.next_wake()
        };
        self.alarm.set(wake);
        None
    }

    /// Submits the message to the connection. The flow's datagram value is kept until the connection has
    /// accepted the newer one.
    fn by_connection(&self, message: Message, session: &PeerSession) -> Result<(), SubmitError> {
        let (flow, number) = (flow_of(&message.header), message.header.correlation);
        let taken = session.outlet.submit(message);
        let outgoing = &mut self.lock().core.outgoing;
        match taken {
            Ok(()) => {
                outgoing.accepted_by_connection(flow, number);
                Ok(())
            }
            Err(mut refused) => {
                outgoing.rejected_by_connection(flow);
                refused.message.header.correlation = 0;
                Err(refused)
            }
        }
    }

    /// Offers pending values to the connection. The lock is held, so that a newer value is queued behind them.
    fn offer_to_connection(&self, now: Time, state: &mut State, session: &PeerSession) {
        let is_retired = state.is_retired;
        state.core.outgoing.offer_to_connection(now, |number, mut message| {
            message.header.correlation = number;
            let offered = if is_retired {
                // These are the last values, at most one per flow. There is no later attempt.
                session.outlet.submit_beyond(message)
            } else {
                session.outlet.offer(message, None)
            };
            match offered {
                Ok(()) => Offered::Taken,
                Err(SubmitError { message, why: Rejection::QueueFull }) => Offered::Full(message),
                Err(refused) => {
                    let detail = format!("a value for node {}: {}", self.node, refused.why);
                    self.refusals.count(now, "value not sent", &detail);
                    Offered::Refused
                }
            }
        });
    }

    /// Returns whether a datagram is from the peer. spec: DATAGRAM-1
    pub(crate) const fn has_key(&self, prefix: Prefix) -> bool {
        prefix.key == self.key
    }

    /// Processes a datagram of the peer. Returns its value if it must be forwarded. The caller calls
    /// [`flush`](Self::flush) next.
    pub(crate) fn on_datagram(
        &self,
        now: Time,
        prefix: Prefix,
        content: &Content<'_>,
        value: Option<Message>,
    ) -> Option<Message> {
        let state = &mut *self.lock();
        if let Some(acknowledgement) = &content.acknowledgement
            && state.core.acknowledged(now, acknowledgement)
        {
            sinew_runtime::log::debug!(node = %self.node, "values of class Stream go by datagram");
        }
        if let Some(number) = content.probe {
            state.core.on_probe(now, prefix.stamp, number);
        }
        let mut message = value?;
        let number = std::mem::take(&mut message.header.correlation);
        // spec: DATAGRAM-3
        let is_new = state.core.incoming.on_value(now, prefix.stamp, flow_of(&message.header), number);
        is_new.then_some(message)
    }

    /// Checks a value received over the connection. spec: DATAGRAM-3
    pub(crate) fn on_connection_value(&self, header: &mut Header) -> Freshness {
        let number = std::mem::take(&mut header.correlation);
        // 0: the peer does not number its values.
        let is_new = number == 0 || self.lock().core.incoming.on_connection_value(flow_of(header), number);
        if is_new { Freshness::New } else { Freshness::Old }
    }

    /// Records a frame from the peer on a connection.
    pub(crate) fn on_frame(&self, now: Time) {
        // SYNC: Relaxed; nothing else depends on it.
        self.last_frame.store(now.as_nanos(), Ordering::Relaxed);
    }

    /// Sends all datagrams that are due.
    pub(crate) fn flush(&self, now: Time) {
        let wake = {
            let state = &mut *self.lock();
            self.write(state, now);
            state.next_wake()
        };
        self.alarm.set(wake);
    }

    /// Handles the passing of time. Returns when to call this again.
    pub(crate) fn tick(&self, now: Time, session: &PeerSession) -> Option<Time> {
        let (wake, blocked, report, narrow) = {
            let state = &mut *self.lock();
            let last_frame = Time::from_nanos(self.last_frame.load(Ordering::Relaxed));
            let is_blocked = state.core.tick(now, last_frame);
            self.offer_to_connection(now, state, session);
            self.write(state, now);
            let target = state.target.as_ref().map(|target| target.address);
            let report = state.core.report().zip(target);
            let measured = state.core.lengths.narrow();
            let is_news =
                if measured.is_some() { measured != state.narrow } else { state.core.lengths.is_full() };
            let narrow = (is_news && measured != state.narrow).then_some(measured);
            state.narrow = narrow.unwrap_or(state.narrow);
            (state.next_wake(), target.filter(|_| is_blocked), report, narrow)
        };
        if let Some(narrow) = narrow {
            self.segments.measured(self.node, narrow);
        }
        if let Some((report, to)) = report {
            self.log(report, to);
        }
        if let Some(to) = blocked {
            sinew_runtime::log::warn!(
                node = %self.node, %to,
                "datagrams (UDP) to this node, or its answers, do not get through, though its connection (TCP) lives: class Stream goes by \
                 the connection, where one lost packet can hold it up for 200 ms. Let UDP through at this port in every firewall on the \
                 way, or set `gncl.datagrams = false` to use the connection only"
            );
        }
        wake
    }

    fn log(&self, report: Report, to: SocketAddr) {
        match report {
            Report::Narrow(longest) => sinew_runtime::log::warn!(
                node = %self.node, %to, longest,
                "datagrams (UDP) of more than {longest} bytes do not arrive at this node, shorter ones do: longer values of class Stream go by the connection \
                 (TCP), where one lost packet can hold them up for 200 ms. Compare the MTU of the interfaces at both ends and on the way (`ip link`), and let \
                 ICMP \"packet too big\" through every firewall"
            ),
            Report::Full => {
                sinew_runtime::log::info!(node = %self.node, %to, "datagrams (UDP) of every length arrive at this node again")
            }
        }
    }

    /// Returns the longest payload sent by datagram, if longer datagrams do not arrive.
    pub(crate) fn payload_max(&self) -> Option<usize> {
        let longest = self.lock().core.lengths.narrow()?;
        Some(longest.saturating_sub(PREFIX_LEN + HEADER_LEN))
    }

    /// Stops sending values by datagram; pending ones are sent over the connection.
    pub(crate) fn retire(&self, session: &PeerSession) {
        let wake = {
            let state = &mut *self.lock();
            state.is_retired = true;
            state.core.retire();
            self.offer_to_connection(Time::now(), state, session);
            state.next_wake()
        };
        // A newer value may be in submission to the connection at this moment.
        self.alarm.set(wake);
    }

    /// Ends the channel after the removal of the peer.
    pub(crate) fn end(&self) {
        let state = &mut *self.lock();
        (state.is_retired, state.target) = (true, None);
        state.core.end();
    }

    /// Returns the forwarded numbers of the peer's values.
    pub(crate) fn forwarded_numbers(&self) -> ForwardedNumbers {
        let mut incoming = self.lock().core.incoming.clone();
        incoming.begin_anew();
        ForwardedNumbers(incoming)
    }

    /// Returns the number of values that are not known to have arrived.
    pub(crate) fn left(&self) -> usize {
        self.lock().core.outgoing.left()
    }

    /// Returns where each value is that was sent by datagram.
    pub(crate) fn position(&self) -> Position {
        self.lock().core.position()
    }

    /// Returns whether values are sent by datagram now.
    #[cfg(test)]
    pub(crate) fn is_open(&self) -> bool {
        self.lock().core.is_open()
    }

    fn write(&self, state: &mut State, now: Time) {
        let State { core, target, .. } = state;
        let Some(target) = target else { return };
        loop {
            let Some(order) = core.poll(now) else { return };
            let mut packet = Packet::new(self.here, target.key, stamp(now));
            match order {
                Order::Probe(number, length) => packet.probe(number, length),
                Order::Acknowledgement => acknowledge(&mut packet, core, now, 0),
                Order::Value(number, message) => {
                    let mut header = message.header;
                    header.correlation = number;
                    header.flags = header.flags.without(Flags::CONFIRM);
                    let payload = message.payload.clone();
                    let head = Checksum::Crc.encode(&header, &payload);
                    acknowledge(&mut packet, core, now, HEADER_LEN + payload.len());
                    packet.value(&head, &payload);
                    core.outgoing.record_length(number, packet.len());
                }
            }
            // A datagram that the system does not accept counts as lost and is sent again, like one lost in
            // the network.
            let _ = target.bound.socket.send_to(packet.bytes(), target.address);
        }
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Adds an acknowledgement to a datagram, as far as there is room before `length` bytes.
fn acknowledge(packet: &mut Packet, core: &mut Core<Flow, Message>, now: Time, length: usize) {
    let before = packet.len() + length + ACK_LEN + RANGE_LEN;
    let Some(room) = core.lengths.room().checked_sub(before) else { return };
    let ranges_max = (room / RANGE_LEN + 1).min(RANGES_MAX);
    if let Some(acknowledgement) = core.incoming.take(now, ranges_max) {
        packet.acknowledge(&acknowledgement);
    }
}

/// Decodes the frame in a datagram, if it is a value.
pub(crate) fn read_value(bytes: &[u8]) -> Option<Message> {
    let message = sinew_runtime::wire::decode_datagram(bytes).ok()?;
    let Header { class, flags, .. } = message.header;
    (class == Class::Stream && flags == Flags::NONE).then_some(message)
}
