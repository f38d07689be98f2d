//! The part of GNCL that outlives its restarts: the peers with their sessions, as `peer.rs` and `way.rs` have
//! them.

use std::collections::{BTreeMap, VecDeque};

use bytes::Bytes;
use sinew_gncl::core::{Attach, Lane, write};
use sinew_runtime::{
    tid::{AppAddress, Incarnation, NodeAddress, Tid},
    time::Time,
    wire::{Checksum, HEADER_LEN, Header, Kind, Message},
};
use sinew_session::{Ack, AckEffect, Arrival, Receiving, Sending, Window};

/// The window of a session: that of a node with the defaults.
const WINDOW: Window = Window { messages: 1_024, bytes: 4 << 20 };

/// A message as a session keeps it.
pub(crate) type Kept = (Header, Bytes);

/// A frame of GNCL itself.
pub(crate) fn frame(here: NodeAddress, there: NodeAddress, kind: Kind, payload: Bytes) -> Kept {
    (Header::new(kind, Tid::new(here, AppAddress::GNCL), Tid::new(there, AppAddress::GNCL)), payload)
}

/// Returns the bytes of a frame.
pub(crate) fn bytes_of((header, payload): &Kept, checksum: Checksum) -> Vec<u8> {
    [&checksum.encode(header, payload)[..], payload].concat()
}

/// The present connection of a session.
#[derive(Clone, Copy, Debug)]
struct Link {
    number: u64,
    checksum: Checksum,
}

/// One session: the messages of a lane in both directions.
#[derive(Debug)]
pub(crate) struct Way {
    ends: (NodeAddress, NodeAddress),
    sending: Sending<Kept>,
    receiving: Receiving,
    queue: VecDeque<Kept>,
    links: u64,
    link: Option<Link>,
    /// The GOODBYE behind all messages.
    last: Option<Kept>,
    has_said_last: bool,
    is_fenced: bool,
    /// Bytes to write on the present connection.
    pub(crate) written: Vec<u8>,
}

impl Way {
    fn new(now: Time, ends: (NodeAddress, NodeAddress)) -> Self {
        let memory = now.as_nanos();
        Self {
            ends,
            sending: Sending::new(memory, WINDOW),
            receiving: Receiving::new(memory),
            queue: VecDeque::new(),
            links: 0,
            link: None,
            last: None,
            has_said_last: false,
            is_fenced: false,
            written: Vec::new(),
        }
    }

    /// Uses another connection. The WELCOME is written first, then an ACK; messages wait for the peer's ACK.
    pub(crate) fn connect(&mut self, checksum: Checksum, welcome: Option<&Kept>) -> u64 {
        self.sending.link_ended();
        self.links += 1;
        self.link = Some(Link { number: self.links, checksum });
        self.has_said_last = false;
        self.written.clear();
        if let Some(welcome) = welcome {
            self.written.extend(bytes_of(welcome, Checksum::Crc));
        }
        self.receiving.attach(self.links);
        self.acknowledge();
        self.links
    }

    pub(crate) fn disconnect(&mut self, number: u64) {
        if self.link.is_some_and(|link| link.number == number) {
            self.link = None;
            self.sending.link_ended();
            self.written.clear();
        }
    }

    /// Ends the connection of a former instance of GNCL.
    pub(crate) fn cut(&mut self) {
        self.disconnect(self.links);
    }

    pub(crate) const fn is_connected(&self) -> bool {
        self.link.is_some()
    }

    /// Writes a frame of GNCL itself, if there is a connection.
    pub(crate) fn send_signal(&mut self, kind: Kind, payload: Bytes) {
        if let Some(Link { checksum, .. }) = self.link {
            let (here, there) = self.ends;
            self.written.extend(bytes_of(&frame(here, there, kind, payload), checksum));
        }
    }

    pub(crate) fn acknowledge(&mut self) {
        let epoch = self.sending.epoch();
        let ack = self.receiving.ack(epoch, None);
        self.send_signal(Kind::GNCL_ACK, write(&ack));
        if self.link.is_some() {
            self.sending.epoch_announced(epoch);
            self.drain();
        }
    }

    /// Writes as many messages as the window allows.
    fn drain(&mut self) {
        let Some(Link { checksum, .. }) = self.link else { return };
        while let Some((number, message)) = self.sending.again() {
            let (header, payload) = message.expect("nothing is voided here");
            let header = Header { number: number as u16, ..*header };
            self.written.extend(bytes_of(&(header, payload.clone()), checksum));
        }
        while self.sending.has_room()
            && let Some((header, payload)) = self.queue.pop_front()
        {
            let number = self.sending.keep((header, payload.clone()), HEADER_LEN + payload.len());
            let header = Header { number: number as u16, ..header };
            self.written.extend(bytes_of(&(header, payload), checksum));
        }
        if self.queue.is_empty()
            && self.sending.is_through()
            && !self.has_said_last
            && let Some(last) = &self.last
        {
            self.written.extend(bytes_of(last, checksum));
            self.has_said_last = true;
        }
    }

    /// Submits a message. Returns whether it was accepted.
    pub(crate) fn submit(&mut self, message: Kept) -> bool {
        if self.last.is_some() {
            return false;
        }
        self.queue.push_back(message);
        self.drain();
        true
    }

    pub(crate) fn finish(&mut self) {
        let (here, there) = self.ends;
        self.last = Some(frame(here, there, Kind::GNCL_GOODBYE, Bytes::new()));
        self.drain();
    }

    pub(crate) fn on_ack(&mut self, link: u64, ack: &Ack) {
        if !self.receiving.on_epoch(link, ack.epoch) || self.link.is_none_or(|present| present.number != link)
        {
            return;
        }
        match self.sending.on_ack(ack) {
            AckEffect::Known | AckEffect::Resumed => self.drain(),
            AckEffect::Reset(_) => self.acknowledge(),
        }
    }

    /// Processes a numbered message. Returns whether to take it.
    ///
    /// # Errors
    /// The message does not have the next number.
    pub(crate) fn arrive(&mut self, link: u64, message: &Message) -> Result<bool, String> {
        if self.is_fenced {
            return Ok(false);
        }
        match self.receiving.arrive(link, message.header.number, message.size()) {
            Arrival::Take { ack_is_due } => {
                if ack_is_due {
                    self.acknowledge();
                }
                Ok(true)
            }
            Arrival::Fenced => Ok(false),
            Arrival::OutOfStep { expected } => Err(format!(
                "message {} came where {} is the next one",
                message.header.number, expected as u16
            )),
        }
    }

    /// Returns the number of messages that are not known to have arrived.
    fn left(&self) -> usize {
        self.queue.len() + self.sending.kept()
    }
}

/// One incarnation of another node.
#[derive(Debug)]
pub(crate) struct Peer {
    pub(crate) incarnation: Incarnation,
    pub(crate) ways: Vec<Way>,
    /// When something of it was last read, in the local clock.
    pub(crate) sign: Option<Time>,
    has_left: bool,
    is_over: bool,
}

impl Peer {
    pub(crate) fn way(&mut self, lane: Lane) -> Option<&mut Way> {
        self.ways.get_mut(lane as usize)
    }

    pub(crate) fn is_linked(&self) -> bool {
        self.ways.first().is_some_and(Way::is_connected)
    }

    pub(crate) fn left(&self) -> usize {
        self.ways.iter().map(Way::left).sum()
    }

    fn fence(&mut self) {
        self.is_over = true;
        self.ways.iter_mut().for_each(|way| way.is_fenced = true);
    }
}

/// All peers of a node.
#[derive(Debug, Default)]
pub(crate) struct Store(pub(crate) BTreeMap<NodeAddress, Peer>);

impl Store {
    /// Returns the peer of a connection, created if needed.
    pub(crate) fn meet(
        &mut self,
        now: Time,
        here: NodeAddress,
        attach: &Attach,
        keeps_former: bool,
    ) -> &mut Peer {
        let Attach { node, incarnation, by_class, .. } = *attach;
        let is_known = self.0.get(&node).is_some_and(|peer| {
            (peer.incarnation == incarnation || keeps_former) && (peer.ways.len() > 1) == by_class
        });
        if !is_known {
            self.0.remove(&node);
        }
        let ways = if by_class { Lane::ALL.len() } else { 1 };
        let peer = self.0.entry(node).or_insert_with(|| Peer {
            incarnation,
            ways: (0..ways).map(|_| Way::new(now, (here, node))).collect(),
            sign: None,
            has_left: false,
            is_over: false,
        });
        peer.incarnation = incarnation;
        peer
    }

    pub(crate) fn of(&mut self, node: NodeAddress, incarnation: Incarnation) -> Option<&mut Peer> {
        self.0.get_mut(&node).filter(|peer| peer.incarnation == incarnation)
    }

    /// Ends an incarnation: no further message of it is accepted.
    pub(crate) fn fence(&mut self, node: NodeAddress, incarnation: Incarnation) {
        self.of(node, incarnation).into_iter().for_each(Peer::fence);
    }

    pub(crate) fn leaves(&mut self, node: NodeAddress, incarnation: Incarnation) {
        self.of(node, incarnation).into_iter().for_each(|peer| peer.has_left = true);
    }

    pub(crate) fn stays(&mut self, node: NodeAddress, incarnation: Incarnation) {
        self.of(node, incarnation).into_iter().for_each(|peer| peer.has_left = false);
    }

    /// Returns whether this incarnation is no longer accepted.
    pub(crate) fn has_given_up(&self, node: NodeAddress, incarnation: Incarnation) -> bool {
        self.0.get(&node).is_some_and(|peer| peer.incarnation == incarnation && peer.is_over)
    }
}
