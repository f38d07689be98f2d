//! What goes by datagram between this node and one peer: the core, its lock, and the socket that is written to.

use std::{
    net::SocketAddr,
    sync::{
        Arc, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicU64, Ordering},
    },
};

use sinew_runtime::{
    outcome::Rejection,
    router::{Outlet as _, Refused},
    tid::{NodeAddress, Tid},
    time::Time,
    wire::{Checksum, Class, Flags, HEADER_LEN, Header, Kind, Message},
};

use super::{
    core::{Core, Order, stamp},
    incoming::Incoming,
    lengths::Report,
    outgoing::{Offered, Position},
    packet::{ACK_LEN, Content, DATAGRAM_MAX, PREFIX_LEN, Packet, Prefix, RANGE_LEN, RANGES_MAX},
    reader::Alarm,
    sockets::{Announcement, Door},
};
use crate::{
    gncl::{peer::Store, segments::Segments, way::Way},
    refusals::Refusals,
};

/// Bytes of a payload at most that goes by datagram.
pub(super) const PAYLOAD_MAX: usize = DATAGRAM_MAX - PREFIX_LEN - HEADER_LEN;

/// What Stream conflates by.
type Flow = (Tid, Tid, Kind);

fn flow_of(header: &Header) -> Flow {
    (header.source, header.destination, header.kind)
}

/// The numbers that were handed on of one life of a peer: they outlive what else is known of it, as those of later values are larger
/// still. spec: DATAGRAM-3
#[derive(Clone, Debug)]
pub(in crate::gncl) struct HandedOn(Incoming<Flow>);

/// Where a peer reads datagrams.
#[derive(Clone, Debug)]
struct Target {
    door: Door,
    address: SocketAddr,
    key: u64,
}

/// The two addresses of the connection for Stream.
#[derive(Clone, Debug)]
struct Connection {
    door: Door,
    remote: SocketAddr,
}

struct State {
    core: Core<Flow, Message>,
    connection: Option<Connection>,
    target: Option<Target>,
    /// Longest payload that the peer takes, in bytes.
    payload_max: usize,
    /// No value goes by datagram any more.
    is_retired: bool,
    /// The longest datagram that arrives, as connections to the peer know it.
    narrow: Option<usize>,
}

impl State {
    /// When something is to be sent or looked at.
    fn next_wake(&self) -> Option<Time> {
        match self.target {
            Some(_) => self.core.next_wake(),
            // Nothing is said to a peer that has not said where.
            None => self.core.outgoing.offer_at(),
        }
    }
}

/// Whether a value that came by the connection is to be handed on, and by datagram.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::gncl) enum Freshness {
    New,
    /// A newer one, or itself, was handed on.
    Old,
}

/// The datagrams between this node and one life of another.
pub(in crate::gncl) struct Channel {
    here: NodeAddress,
    node: NodeAddress,
    /// What the peer's datagrams are to have.
    key: u64,
    /// Locked for a moment. The outlet of the connection may be locked with it in hand, never the other way round.
    state: Mutex<State>,
    /// When the peer spoke on a connection last.
    heard: AtomicU64,
    alarm: Arc<Alarm>,
    segments: Arc<Segments>,
    refusals: Arc<Refusals>,
}

impl Channel {
    /// `now` is the first number: a later channel with the same life of the peer goes on above it, as nobody sends a value each nanosecond.
    /// `former` is what an earlier one with the same life handed on.
    pub(in crate::gncl) fn new(
        now: Time,
        (here, node): (NodeAddress, NodeAddress),
        key: u64,
        former: Option<HandedOn>,
        store: &Store,
    ) -> Self {
        let mut core = Core::new(now.as_nanos());
        if let Some(HandedOn(incoming)) = former {
            core.incoming = incoming;
        }
        let state =
            State { core, connection: None, target: None, payload_max: 0, is_retired: false, narrow: None };
        let (state, heard) = (Mutex::new(state), AtomicU64::new(0));
        let Store { alarm, segments, refusals, .. } = store;
        let (alarm, segments, refusals) = (alarm.clone(), segments.clone(), refusals.clone());
        Self { here, node, key, state, heard, alarm, segments, refusals }
    }

    /// There is a connection for Stream, between these two addresses, and `door` is beside it; the peer takes payloads of `payload_max`
    /// bytes. Returns what the peer is to be told there. spec: DATAGRAM-2
    pub(in crate::gncl) fn connected(
        &self,
        door: Door,
        (local, remote): (SocketAddr, SocketAddr),
        payload_max: usize,
    ) -> Announcement {
        let announcement = door.announcement(local, self.key);
        let state = &mut *self.lock();
        state.connection = Some(Connection { door, remote });
        state.payload_max = payload_max.min(PAYLOAD_MAX);
        announcement
    }

    /// The peer says on that connection where it reads datagrams.
    pub(in crate::gncl) fn announced(&self, now: Time, said: Announcement, way: &Way) {
        let wake = {
            let state = &mut *self.lock();
            let Some(Connection { door, remote }) = state.connection.clone() else { return };
            if state.is_retired {
                return;
            }
            if state.target.as_ref().is_some_and(|target| target.key != said.key) {
                state.core.begin_anew();
            }
            let target = said.target(remote).map(|address| Target { door, address, key: said.key });
            let is_same =
                |former: &Target, new: &Target| (former.address, former.key) == (new.address, new.key);
            match (&state.target, &target) {
                (Some(former), Some(new)) if is_same(former, new) => state.core.reconnected(now),
                (_, Some(_)) => state.core.announced(now),
                (_, None) => state.core.retire(),
            }
            state.target = target;
            self.hand_over(now, state, way);
            state.next_wake()
        };
        self.alarm.set(wake);
    }

    /// Takes a message of class Stream: by datagram, if it may, or by the connection.
    ///
    /// # Errors
    /// The message: the connection's outlet does not take it.
    pub(in crate::gncl) fn submit(&self, message: Message, way: &Way) -> Result<(), Refused> {
        match self.by_datagram(message) {
            None => Ok(()),
            // Without the lock: a long one is written in pieces.
            Some(message) => self.by_connection(message, way),
        }
    }

    /// Returns what goes by the connection, with its number.
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
                message.header.correlation = state.core.outgoing.given_elsewhere(flow);
                return Some(message);
            }
            self.write(state, now);
            state.next_wake()
        };
        self.alarm.set(wake);
        None
    }

    /// What goes by datagram of this flow stays as long as the connection has not taken what is newer.
    fn by_connection(&self, message: Message, way: &Way) -> Result<(), Refused> {
        let (flow, number) = (flow_of(&message.header), message.header.correlation);
        let taken = way.outlet.submit(message);
        let outgoing = &mut self.lock().core.outgoing;
        match taken {
            Ok(()) => {
                outgoing.taken_elsewhere(flow, number);
                Ok(())
            }
            Err(mut refused) => {
                outgoing.refused_elsewhere(flow);
                refused.message.header.correlation = 0;
                Err(refused)
            }
        }
    }

    /// Offers the connection what is for it. With the lock in hand, so that a newer value comes behind these.
    fn hand_over(&self, now: Time, state: &mut State, way: &Way) {
        let is_retired = state.is_retired;
        state.core.outgoing.hand_over(now, |number, mut message| {
            message.header.correlation = number;
            let offered = if is_retired {
                // The last ones, of so many flows at most: no other time comes.
                way.outlet.submit_beyond(message)
            } else {
                way.outlet.offer(message, None)
            };
            match offered {
                Ok(()) => Offered::Taken,
                Err(Refused { message, why: Rejection::QueueFull }) => Offered::Full(message),
                Err(refused) => {
                    let detail = format!("a value for node {}: {}", self.node, refused.why);
                    self.refusals.count(now, "value not sent", &detail);
                    Offered::Refused
                }
            }
        });
    }

    /// Whether a datagram is from the peer. spec: DATAGRAM-1
    pub(super) const fn knows(&self, prefix: Prefix) -> bool {
        prefix.key == self.key
    }

    /// A datagram of the peer has come. Returns the value in it, if it is to be handed on. [`flush`](Self::flush) follows.
    pub(super) fn came(
        &self,
        now: Time,
        prefix: Prefix,
        content: &Content<'_>,
        value: Option<Message>,
    ) -> Option<Message> {
        let state = &mut *self.lock();
        if let Some(said) = &content.acknowledgement
            && state.core.acknowledged(now, said)
        {
            crate::log::debug!(node = %self.node, "values of class Stream go by datagram");
        }
        if let Some(number) = content.probe {
            state.core.asked(now, prefix.stamp, number);
        }
        let mut message = value?;
        let number = std::mem::take(&mut message.header.correlation);
        // spec: DATAGRAM-3
        let is_new = state.core.incoming.came(now, prefix.stamp, flow_of(&message.header), number);
        is_new.then_some(message)
    }

    /// A value has come by the connection. spec: DATAGRAM-3
    pub(in crate::gncl) fn came_by_connection(&self, header: &mut Header) -> Freshness {
        let number = std::mem::take(&mut header.correlation);
        // 0: the peer numbers nothing.
        let is_new = number == 0 || self.lock().core.incoming.came_by_connection(flow_of(header), number);
        if is_new { Freshness::New } else { Freshness::Old }
    }

    /// The peer has spoken on a connection.
    pub(in crate::gncl) fn heard(&self, now: Time) {
        // SYNC: Relaxed; nothing else depends on it.
        self.heard.store(now.as_nanos(), Ordering::Relaxed);
    }

    /// Sends what is to be sent now.
    pub(super) fn flush(&self, now: Time) {
        let wake = {
            let state = &mut *self.lock();
            self.write(state, now);
            state.next_wake()
        };
        self.alarm.set(wake);
    }

    /// Time has passed. Returns when it is to be told again.
    pub(in crate::gncl) fn tick(&self, now: Time, way: &Way) -> Option<Time> {
        let (wake, blocked, report, narrow) = {
            let state = &mut *self.lock();
            let heard = Time::from_nanos(self.heard.load(Ordering::Relaxed));
            let is_blocked = state.core.tick(now, heard);
            self.hand_over(now, state, way);
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
            crate::log::warn!(
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
            Report::Narrow(longest) => crate::log::warn!(
                node = %self.node, %to, longest,
                "datagrams (UDP) of more than {longest} bytes do not arrive at this node, shorter ones do: longer values of class Stream go by the connection \
                 (TCP), where one lost packet can hold them up for 200 ms. Compare the MTU of the interfaces at both ends and on the way (`ip link`), and let \
                 ICMP \"packet too big\" through every firewall"
            ),
            Report::Full => {
                crate::log::info!(node = %self.node, %to, "datagrams (UDP) of every length arrive at this node again")
            }
        }
    }

    /// The longest payload that goes by datagram, where longer datagrams do not arrive.
    pub(in crate::gncl) fn payload_max(&self) -> Option<usize> {
        let longest = self.lock().core.lengths.narrow()?;
        Some(longest.saturating_sub(PREFIX_LEN + HEADER_LEN))
    }

    /// No value goes by datagram any more; what is under way goes by the connection.
    pub(in crate::gncl) fn retire(&self, way: &Way) {
        let wake = {
            let state = &mut *self.lock();
            state.is_retired = true;
            state.core.retire();
            self.hand_over(Time::now(), state, way);
            state.next_wake()
        };
        // A newer one may be on its way to the connection at this moment.
        self.alarm.set(wake);
    }

    /// The peer is gone.
    pub(in crate::gncl) fn end(&self) {
        let state = &mut *self.lock();
        (state.is_retired, state.target) = (true, None);
        state.core.end();
    }

    /// What of the peer's was handed on.
    pub(in crate::gncl) fn handed_on(&self) -> HandedOn {
        let mut incoming = self.lock().core.incoming.clone();
        incoming.begin_anew();
        HandedOn(incoming)
    }

    /// Values that are not known to have arrived.
    pub(in crate::gncl) fn left(&self) -> usize {
        self.lock().core.outgoing.left()
    }

    /// Where each value is that went by datagram.
    pub(in crate::gncl) fn position(&self) -> Position {
        self.lock().core.position()
    }

    /// Whether values go by datagram now.
    #[cfg(test)]
    pub(in crate::gncl) fn is_open(&self) -> bool {
        self.lock().core.is_open()
    }

    fn write(&self, state: &mut State, now: Time) {
        let State { core, target, .. } = state;
        let Some(target) = target else { return };
        loop {
            let mut packet = Packet::new(self.here, target.key, stamp(now));
            match core.poll(now) {
                None => return,
                Some(Order::Probe(number, length)) => packet.probe(number, length),
                Some(Order::Acknowledgement) => acknowledge(&mut packet, core, now, 0),
                Some(Order::Value(number, message)) => {
                    let mut header = message.header;
                    header.correlation = number;
                    header.flags = header.flags.without(Flags::CONFIRM);
                    let payload = message.payload.clone();
                    let head = Checksum::Crc.encode(&header, &payload);
                    acknowledge(&mut packet, core, now, HEADER_LEN + payload.len());
                    packet.value(&head, &payload);
                    core.outgoing.went(number, packet.len());
                }
            }
            // What the system does not take is a datagram that is lost, and sent again: the network does the same.
            let _ = target.door.socket.send_to(packet.bytes(), target.address);
        }
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Says with a datagram what has come, as far as there is room before `length` bytes.
fn acknowledge(packet: &mut Packet, core: &mut Core<Flow, Message>, now: Time, length: usize) {
    let before = packet.len() + length + ACK_LEN + RANGE_LEN;
    let Some(room) = core.lengths.room().checked_sub(before) else { return };
    let ranges_max = (room / RANGE_LEN + 1).min(RANGES_MAX);
    if let Some(said) = core.incoming.take(now, ranges_max) {
        packet.acknowledge(&said);
    }
}

/// The frame in a datagram, if it is a value.
pub(super) fn value(bytes: &[u8]) -> Option<Message> {
    let message = sinew_runtime::wire::decode_datagram(bytes).ok()?;
    let Header { class, flags, .. } = message.header;
    (class == Class::Stream && flags == Flags::NONE).then_some(message)
}
