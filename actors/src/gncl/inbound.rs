//! What is checked before a peer's frame becomes a message of this node. spec: GNCL-11

use std::{cell::RefCell, sync::Arc};

use sinew_runtime::{
    outcome::{MemberReport, Outcome, Receipt, Rejection, Ticket},
    router::Refused,
    tid::{AppAddress, NodeAddress, Tid},
    time::Time,
    wakes,
    wire::{Checksum, Class, Flags, Header, Kind, Message},
};

use super::{
    arrivals::End,
    core::{Decline, Lane, read},
    datagrams::{Announcement, Freshness},
    peer::Peer,
    spin::Spin,
    way::{Hand, Taken, Way},
};
use crate::{
    outlet::{LinkNumber, OUTCOMES_MAX, line_of, read_outcomes},
    session::Ack,
    stores::Stores,
    undelivered::Report,
};

/// Outcomes that are told together at most, but for those of one frame.
const OUTCOMES_AT_ONCE: usize = 1_024;

/// The way in for the frames of one peer.
pub(super) struct Inbound {
    pub(super) stores: Arc<Stores>,
    pub(super) peer: Arc<Peer>,
    pub(super) spin: Arc<Spin>,
    /// Whose connections this is one of.
    pub(super) lane: Lane,
    /// The connection on which they come.
    pub(super) link: LinkNumber,
    /// What they have for a checksum.
    pub(super) checksum: Checksum,
    /// What the peer said in this [`Batch`] of the fate of messages to it, and was not told on: [`OUTCOMES_AT_ONCE`] and one frame's at most.
    pub(super) outcomes: RefCell<Vec<(Ticket, Outcome)>>,
}

/// Frames that came at once. At the end of it, or at a panic, outcomes that were among them are told, what was taken is acknowledged if
/// that is due, and then everybody is woken who has got something.
pub(super) struct Batch<'a> {
    inbound: &'a Inbound,
    _wakes: wakes::Batch,
}

impl Drop for Batch<'_> {
    fn drop(&mut self) {
        self.inbound.tell_outcomes();
        if let Some(way) = self.inbound.peer.way(self.inbound.lane) {
            way.acknowledge_if_due();
        }
    }
}

impl Inbound {
    /// Frames that were read at once, at `now`, are [received](Self::receive) as long as this lives.
    pub(super) fn batch(&self, now: Time) -> Batch<'_> {
        self.peer.gives_a_sign(now);
        Batch { inbound: self, _wakes: wakes::Batch::begin() }
    }

    /// Takes a frame that came at `now`, if it is the next one: delivers it, settles it, or refuses and counts it.
    ///
    /// # Errors
    /// It is not the next one, or an acknowledgement that is none: the peer is at fault.
    pub(super) fn receive(&self, now: Time, message: Message) -> Result<(), Decline> {
        let Some(way) = self.peer.way(self.lane) else { return Ok(()) };
        if let Some(channel) = self.peer.channel() {
            channel.heard(now);
        }
        if is_for_the_link(&message, Kind::GNCL_ACK) {
            let ack: Ack = read(&message.payload)?;
            way.heard(self.link, &ack, now);
            if !ack.held.is_empty() {
                self.peer.holds_what_may_expire();
            }
            return Ok(());
        }
        if is_for_the_link(&message, Kind::GNCL_DATAGRAMS) {
            return self.datagrams_announced(now, &message, way);
        }
        if is_for_the_link(&message, Kind::GNCL_UNDELIVERED) {
            // spec: GNCL-20
            let report: Report = read(&message.payload)?;
            report.note(&self.stores, self.peer.node, now);
            return Ok(());
        }
        // Counted first: what panics from here on must not come again.
        let taken = way.arrive(self.link, &message)?;
        self.spin.heard(now);
        if taken == Taken::No {
            return Ok(());
        }
        let hand = way.hand();
        let end = if is_for_the_link(&message, Kind::GNCL_VOID) {
            Some(End::Void)
        } else if is_for_the_link(&message, Kind::GNCL_OUTCOMES) {
            self.outcomes_at_once(now, &message)?;
            Some(End::Told)
        } else {
            self.take(now, message, way, taken)
        };
        match end {
            Some(end) => hand.ends(end),
            None => hand.empty(),
        }
        Ok(())
    }

    /// Of a connection that is not the present one it is old news, and about another address. spec: DATAGRAM-2
    fn datagrams_announced(&self, now: Time, message: &Message, way: &Way) -> Result<(), Decline> {
        if self.lane != Lane::Stream {
            return Err(Decline::Violation("DATAGRAMS came where none belongs".to_owned()));
        }
        let said: Announcement = read(&message.payload)?;
        if let Some(channel) = self.peer.channel()
            && way.comes_on(self.link)
        {
            channel.announced(now, said, way);
        }
        Ok(())
    }

    /// Takes a value that came by datagram at `now`, is newer than all of its flow before, and is in `hand`.
    pub(super) fn receive_datagram(&self, now: Time, message: Message, way: &Way, hand: Hand<'_>) {
        self.spin.heard(now);
        match self.take(now, message, way, Taken::Yes) {
            Some(end) => hand.ends(end),
            None => hand.empty(),
        }
    }

    /// Tells the peer what was taken, if it does not know.
    pub(super) fn acknowledge(&self) {
        if let Some(way) = self.peer.way(self.lane) {
            way.acknowledge_if_owed();
        }
    }

    /// Returns how it ended; `None`: it waits for its application.
    fn take(&self, now: Time, mut message: Message, way: &Way, taken: Taken) -> Option<End> {
        let header = message.header;
        if header.source.node != self.peer.node {
            // No outcome is sent: the source that it names has not sent it.
            self.count(now, "forged source", &message);
            return Some(End::Refused);
        }
        if header.class == Class::Stream
            && let Some(channel) = self.peer.channel()
            && channel.came_by_connection(&mut message.header) == Freshness::Old
        {
            return Some(End::Superseded);
        }
        if header.flags.has(Flags::OUTCOME) && header.kind == Kind::MEMBERS {
            self.members(now, &message);
            return Some(End::Told);
        }
        if header.flags.has(Flags::OUTCOME) {
            self.outcome(now, &message);
            return Some(End::Told);
        }
        if header.kind == Kind::CANCEL {
            self.cancel(way, message.ticket());
            return Some(End::Told);
        }
        self.attach_receipt(&mut message);
        if !header.kind.is_user() && !header.destination.app.is_layer() {
            // An application takes such words for those of its own node's layers.
            self.count(now, "a layer's words for an application", &message);
            message.reject(Rejection::Unsupported);
            return Some(End::Refused);
        }
        if header.destination.node != self.stores.node && header.destination.node != NodeAddress::ALL {
            self.count(now, "not for this node", &message);
            message.reject(Rejection::NoSuchNode);
            return Some(End::Refused);
        }
        if message.receipt.is_some() && header.class == Class::Stream {
            self.count(now, "unconfirmable", &message);
            message.reject(Rejection::Unsupported);
            return Some(End::Refused);
        }
        self.turn_to_our_clock(now, &mut message.header);
        if message.header.is_expired(now) {
            message.settle(Outcome::Expired);
            return Some(End::Expired);
        }
        match (taken, line_of(&message.header)) {
            (Taken::InLine(line), _) => self.put_in_line(way, line, message),
            (_, Some(line)) if self.stores.gncl.waits_before(&self.peer, line) => {
                self.put_in_line(way, line, message)
            }
            (_, Some(line)) => self.offer(way, line, message),
            (_, None) => Some(self.deliver(message)),
        }
    }

    /// Hands over what never waits here.
    fn deliver(&self, message: Message) -> End {
        let header = message.header;
        let is_told_here = !header.destination.is_single()
            || header.destination.app.is_layer()
            || header.flags.has(Flags::REPLY);
        match self.stores.router.deliver(message) {
            Ok(()) if is_told_here => End::Told,
            Ok(()) => End::HandedOn,
            // The router counts what nobody takes, and settles it.
            Err(_) => End::Refused,
        }
    }

    fn offer(&self, way: &Way, line: u64, message: Message) -> Option<End> {
        match self.stores.router.offer(message, None) {
            Ok(()) => Some(End::HandedOn),
            Err(Refused { message, why: Rejection::QueueFull }) => self.put_in_line(way, line, message),
            Err(refused) => {
                self.stores.router.refuse_arrived(refused);
                Some(End::Refused)
            }
        }
    }

    fn put_in_line(&self, way: &Way, line: u64, message: Message) -> Option<End> {
        match way.put_in_line(line, message) {
            Ok(is_news) => {
                if is_news {
                    // Only whoever is held already says when it takes more.
                    self.stores.gncl.held_up.notify_one();
                }
                None
            }
            Err(message) => {
                self.stores.router.refuse_arrived(Refused::new(message, Rejection::QueueFull));
                Some(End::Refused)
            }
        }
    }

    /// The time at which the peer sent it, in our clock; never later than `now`. And how wrong that may be: more, the longer NDL has not heard
    /// of the peer.
    ///
    /// As long as nobody has measured the clock of this life of the peer, or it is elsewhere than it was measured, its time to live counts from `now`, and whoever gets it is told that its age is not
    /// known. That of another life says nothing: it may have been on another host.
    fn turn_to_our_clock(&self, now: Time, header: &mut Header) {
        let measured = self.stores.clocks.get(self.peer.node, self.peer.incarnation);
        let times = measured.and_then(|clock| clock.in_our_clock(now, header.sent));
        header.sent = times.map_or(now, |(sent, _)| sent);
        header.set_sent_error(times.map(|(_, error)| error));
    }

    /// What becomes of a message to all nodes is said as from this one. spec: GNCL-12
    fn attach_receipt(&self, message: &mut Message) {
        if message.header.flags.has(Flags::CONFIRM) {
            let mut ticket = message.ticket();
            if ticket.destination.node == NodeAddress::ALL {
                ticket.destination = Tid::new(self.stores.node, ticket.destination.app);
            }
            message.receipt = Some(Receipt::new(self.peer.clone(), ticket));
        }
    }

    /// Whoever asked waits no more: what it asked for is taken back where it waits here. spec: GNCL-15
    fn cancel(&self, way: &Way, ticket: Ticket) {
        let line = (Class::Control as u64) << 32 | u64::from(ticket.destination.app.bits());
        if let Some(mut request) = way.take_back(line, ticket) {
            request.settle(Outcome::Expired);
        } else if ticket.destination.node == self.stores.node {
            self.stores.router.cancel(ticket);
        }
    }

    /// What the peer reports of its members that have copies of a message from here. spec: FRAME-7.3
    fn members(&self, now: Time, message: &Message) {
        match MemberReport::decode(&message.payload) {
            Some(reports) => {
                self.stores.router.members_reported(self.peer.node, about(&message.header), &reports);
            }
            None => self.count(now, "no reports about members", message),
        }
    }

    fn outcome(&self, now: Time, message: &Message) {
        let outcome = match message.payload[..] {
            [code] => Outcome::from_code(code),
            _ => None,
        };
        match outcome {
            // One that nobody waits for any more was settled as Unknown when an earlier connection ended.
            Some(outcome) => self.outcomes.borrow_mut().push((about(&message.header), outcome)),
            None => self.count(now, "no such outcome", message),
        }
    }

    /// Several in one frame; a code that is no outcome's spoils its own alone. spec: GNCL-17
    fn outcomes_at_once(&self, now: Time, message: &Message) -> Result<(), Decline> {
        let Some(all) = read_outcomes(&message.payload) else {
            let length = message.payload.len();
            return Err(Decline::Violation(format!(
                "OUTCOMES of {length} bytes are not 1 to {OUTCOMES_MAX}"
            )));
        };
        for said in all {
            match said.outcome {
                Some(outcome) => {
                    let ticket = said.ticket(self.stores.node, self.peer.node);
                    self.outcomes.borrow_mut().push((ticket, outcome));
                }
                None => self.count(now, "no such outcome", message),
            }
        }
        if self.outcomes.borrow().len() >= OUTCOMES_AT_ONCE {
            self.tell_outcomes();
        }
        Ok(())
    }

    /// Whoever is told runs into nothing that is borrowed here.
    fn tell_outcomes(&self) {
        let mut outcomes = self.outcomes.take();
        self.peer.confirm(&mut outcomes);
        outcomes.clear();
        self.outcomes.replace(outcomes);
    }

    fn count(&self, now: Time, cause: &'static str, message: &Message) {
        let (header, peer) = (&message.header, self.peer.node);
        let detail = format!("node {peer} sent a frame from {} to {}", header.source, header.destination);
        self.stores.gncl.refusals.count(now, cause, &detail);
    }
}

/// The message from here that an answer is about.
const fn about(answer: &Header) -> Ticket {
    Ticket { source: answer.destination, destination: answer.source, correlation: answer.correlation }
}

/// Whether this is about the connection itself, and of that kind.
fn is_for_the_link(message: &Message, kind: Kind) -> bool {
    message.header.destination.app == AppAddress::GNCL && message.header.kind == kind
}
