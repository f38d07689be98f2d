//! The direct links of one endpoint: a ring to and from each of some other processes, beside the way through the node.
//!
//! When which way is taken is decided in `routes.rs`; here are the sockets and the memory.

mod budget;
mod descriptors;
mod standing;
#[cfg(test)]
mod tests;

use std::{
    collections::{BTreeMap, VecDeque},
    os::unix::net::UnixStream,
    sync::Arc,
    time::{Duration, Instant},
};

use rustix::net::Shutdown;
use sinew_runtime::{
    outcome::{Outcome, ReceiptSink, Rejection, Ticket},
    tid::Tid,
    time::Time,
    wire::{Flags, Kind, Message},
};
use sinew_shm::{Any, AnyError, Offer, Spin, Waiter};

use super::{
    ApiError,
    lent::Draft,
    link::{
        LinkOptions, Writer,
        loan::InRing,
        ring::{self, NAP},
        socket,
    },
    routes::{Answered, Directness, Farewell, Left, LinkNumber, Marked, Passed, Routes, Way},
};
use crate::{
    lncl::payload::{self, Introduce, Introduction, Registered, Switch},
    ring::{self as rings, Exchange, ExchangeError, RingError},
};

use budget::{Budget, PROCESS, Share};
use standing::{Alone, Pair, Put};
pub(super) use standing::{Came, Everything, Standing};

/// Messages at most that wait for the rest of a ring of which the sender has said no more. One more is refused as `QueueFull`.
const EARLY_MAX: usize = 4_096;
/// Bytes of a direct link's ring, if nothing else is asked for.
pub(super) const RING_BYTES: usize = 64 * 1024;
/// Bytes of a peer's ring at most.
const RING_BYTES_MAX: usize = 1 << 20;
/// Time until it is looked again whether there is room for what is owed to a peer.
const OWED_AGAIN: Duration = Duration::from_millis(1);

/// What is common to all direct links of an endpoint.
pub(super) struct Terms {
    /// Its own address.
    pub(super) own: Tid,
    /// Bytes of each ring.
    pub(super) ring_bytes: usize,
    /// Longest payload in bytes.
    pub(super) payload_max: usize,
    pub(super) options: LinkOptions,
    /// What all rings together may take.
    budget: &'static Budget,
}

/// A link of which the peer knows our half.
struct Offered {
    peer: Tid,
    number: LinkNumber,
    socket: Arc<UnixStream>,
    exchange: Exchange,
    share: Share,
}

/// What one who has ended its link, or its next life, has sent through the node.
struct Early {
    /// The link that is read first.
    after: LinkNumber,
    messages: VecDeque<Message>,
}

/// What is to be done with a message that came through the node.
pub(super) enum InTurn {
    /// To be sorted in.
    Now(Message),
    /// It is kept until its turn has come.
    Later,
    /// Too many are kept: to be refused.
    Never(Message),
}

/// The direct links of an endpoint.
pub(super) struct Direct {
    terms: Terms,
    routes: Routes,
    /// The socket to the node, over which the ends of links come. `None` where there are no links.
    control: Option<Arc<UnixStream>>,
    offered: Vec<Offered>,
    /// Written to; not read yet.
    held: Vec<Standing>,
    /// Written to and read.
    pub(super) open: Vec<Standing>,
    /// What came through the node and was sent after what that link's ring still holds.
    early: BTreeMap<Tid, Early>,
    /// When it is looked again who has gone, and what is to be said again.
    look_at: Time,
    /// When one who only sends looks for answers of the node.
    hear_at: Time,
    /// When it is tried again to write what waits for room.
    flush_at: Time,
    /// A caller writes a frame there, and wants to know first when that is done.
    writing: Option<LinkNumber>,
}

/// What became of a message that was to go directly.
pub(super) enum Sent {
    /// It is in the ring, or waits for room as the newest of its Stream.
    Taken,
    /// Part of it is in the ring, and the rest follows when there is room.
    Begun,
    /// There is no room.
    Full(Draft),
    /// The peer has gone.
    Gone(Draft),
}

/// The node's link, and the numbers by which this endpoint knows what it has asked.
pub(super) struct ToNode<'a> {
    pub(super) writer: &'a Arc<Writer>,
    pub(super) correlation: &'a mut u64,
}

impl Terms {
    pub(super) fn of(registered: &Registered, options: LinkOptions) -> Self {
        Self {
            own: Tid::new(registered.node, registered.app),
            ring_bytes: options.direct_ring_bytes.min(registered.ring.unwrap_or_default() as usize),
            payload_max: registered.payload_max as usize,
            options,
            budget: &PROCESS,
        }
    }
}

impl ToNode<'_> {
    /// Says something of which the outcome is to be known, if there is room; the number by which it will be.
    fn ask(&mut self, mut frame: Message) -> Option<u64> {
        *self.correlation += 1;
        frame.header.correlation = *self.correlation;
        frame.header.flags = Flags::CONFIRM;
        self.writer.try_write(&frame).then_some(*self.correlation)
    }

    fn answer(&self, own: Tid, to: Tid, correlation: u64, outcome: Outcome) {
        self.writer.settle(Ticket { source: to, destination: own, correlation }, outcome);
    }
}

impl Direct {
    /// The links of an endpoint whose ends come over `control`; none at all without it.
    pub(super) const fn new(terms: Terms, control: Option<Arc<UnixStream>>) -> Self {
        let directness = if control.is_some() { Directness::Allowed } else { Directness::Off };
        let routes = Routes::new(terms.own, directness);
        Self {
            terms,
            routes,
            control,
            offered: Vec::new(),
            held: Vec::new(),
            open: Vec::new(),
            early: BTreeMap::new(),
            look_at: Time::ZERO,
            hear_at: Time::ZERO,
            flush_at: Time::ZERO,
            writing: None,
        }
    }

    /// The link on which a message to `destination` goes; `None` for the way through the node, and then an introduction is
    /// asked for where that makes sense.
    pub(super) fn way(&mut self, destination: Tid, now: Time, node: &mut ToNode<'_>) -> Option<LinkNumber> {
        self.control.as_ref()?;
        match self.routes.way(destination, now) {
            Way::Direct(number) => Some(number),
            Way::Through => None,
            Way::ThroughAndAsk if !self.terms.budget.has_room(self.terms.ring_bytes) => {
                self.routes.no_memory(destination, now);
                None
            }
            Way::ThroughAndAsk => {
                let introduce = Introduce { to: destination.bits() };
                let lncl = payload::lncl_of(destination.node);
                let frame = payload::frame(Kind::LNCL_INTRODUCE, self.terms.own, lncl, &introduce);
                match node.ask(frame) {
                    Some(correlation) => self.routes.asked(destination, correlation, now),
                    None => self.routes.not_asked(destination, now),
                }
                None
            }
        }
    }

    /// Lends room in the ring of a link; `None` if there is none now.
    pub(super) fn lend(&mut self, number: LinkNumber, length: usize) -> Option<InRing> {
        self.standing(number)?.writer.lend(length)
    }

    /// Sends on a link, as far as there is room.
    ///
    /// # Errors
    /// [`ApiError::Lent`], or it is too long for its rings.
    pub(super) fn send(&mut self, number: LinkNumber, draft: Draft, now: Time) -> Result<Sent, ApiError> {
        let Some(link) = self.standing(number) else { return Ok(Sent::Gone(draft)) };
        match link.send_draft(draft) {
            Err((ApiError::Closed(_), draft)) => {
                // Its last words are read before it is forgotten.
                let peer = link.peer;
                let _ = self.routes.hung_up(peer, Left::Something, now);
                self.look_at = now;
                Ok(Sent::Gone(draft))
            }
            Err((error, _)) => Err(error),
            Ok(Put::Taken) => Ok(Sent::Taken),
            Ok(Put::Begun) => Ok(Sent::Begun),
            Ok(Put::Full(message)) => Ok(Sent::Full(message.into())),
        }
    }

    /// A sender has lost its patience there. Until the peer takes something no other one waits.
    pub(super) fn has_stalled(&mut self, number: LinkNumber) {
        if let Some(link) = self.standing(number) {
            link.is_stalled = true;
        }
    }

    /// Whether a sender has lost its patience there, and the peer has taken nothing since.
    pub(super) fn is_stalled(&mut self, number: LinkNumber) -> bool {
        self.standing(number).is_some_and(|link| link.is_stalled)
    }

    /// Whether nothing is left half written on a link, or it has ended.
    pub(super) fn is_whole(&mut self, number: LinkNumber) -> bool {
        self.standing(number).is_none_or(Standing::is_whole)
    }

    /// Waits until a link has room for the beginning of a frame of so many bytes, or ends, or `within` this time.
    pub(super) fn await_room(&mut self, number: LinkNumber, length: usize, within: Duration) {
        if let Some(link) = self.standing(number) {
            link.await_room(length, within);
        }
    }

    fn standing(&mut self, number: LinkNumber) -> Option<&mut Standing> {
        self.open.iter_mut().chain(&mut self.held).find(|link| link.number == number)
    }

    /// Whether this link has not ended.
    pub(super) fn has(&self, number: LinkNumber) -> bool {
        self.open.iter().chain(&self.held).any(|link| link.number == number)
    }

    /// Does what a frame of the node asks for. Hands it back if it is not about links.
    pub(super) fn heed(&mut self, message: Message, now: Time, node: &mut ToNode<'_>) -> Option<Message> {
        match message.header.kind {
            Kind::LNCL_INTRODUCTION => self.meet(&message, now, node),
            Kind::LNCL_INTRODUCED => self.go_on(&message, now, node),
            Kind::LNCL_SWITCH => self.mark(&message, now, node),
            Kind::OUTCOME => return self.hear(message, now),
            // Not an enum of ours: an open set of numbers.
            _ => return Some(message),
        }
        None
    }

    /// Another one asks for a link.
    fn meet(&mut self, message: &Message, now: Time, node: &ToNode<'_>) {
        let Ok(Introduction { peer, number, pid: _ }) = payload::read(&message.payload) else { return };
        let (peer, number) = (Tid::from_bits(peer), LinkNumber(number));
        // A new life may ask before it was seen that the former one has ended.
        self.see_ends(now);
        let met = self.routes.introduction(peer).and_then(|()| self.offer(peer, number));
        let outcome = met.map_or_else(Outcome::Rejected, |()| Outcome::Delivered);
        node.answer(self.terms.own, message.header.source, message.header.correlation, outcome);
    }

    fn offer(&mut self, peer: Tid, number: LinkNumber) -> Result<(), Rejection> {
        let socket = self.take_end(number).ok_or(Rejection::QueueFull)?;
        if !self.terms.budget.has_room(self.terms.ring_bytes) {
            return Err(Rejection::Unsupported);
        }
        let (exchange, share) = self.prepare(&socket).map_err(|why| {
            tracing::warn!(%peer, %why, "a direct link was not made");
            Rejection::QueueFull
        })?;
        self.routes.offered(peer, number);
        self.offered.push(Offered { peer, number, socket, exchange, share });
        Ok(())
    }

    fn prepare(&self, socket: &UnixStream) -> Result<(Exchange, Share), ExchangeError> {
        let share = self.terms.budget.take(self.terms.ring_bytes).ok_or(ExchangeError::Budget)?;
        let [own, theirs] = [self.terms.ring_bytes, RING_BYTES_MAX].map(rings::capacity);
        let exchange = Exchange::prepare_for(own, self.terms.options.bell, theirs)?;
        exchange.offer(socket)?;
        Ok((exchange, share))
    }

    fn take_end(&self, number: LinkNumber) -> Option<Arc<UnixStream>> {
        descriptors::take(self.control.as_ref()?, number).map(Arc::new)
    }

    /// The other one has agreed to a link: it stands, and is switched to.
    fn go_on(&mut self, message: &Message, now: Time, node: &mut ToNode<'_>) {
        let Ok(Introduction { peer, number, pid: _ }) = payload::read(&message.payload) else { return };
        let (peer, number) = (Tid::from_bits(peer), LinkNumber(number));
        // Taken in any case: what nobody holds hangs up.
        let socket = self.take_end(number);
        if !self.routes.introduced(peer, message.header.correlation) {
            return;
        }
        let connected = socket.ok_or(ExchangeError::Missing).and_then(|socket| {
            let theirs = Exchange::receive(&socket)?.ok_or(ExchangeError::Missing)?;
            let (exchange, share) = self.prepare(&socket)?;
            self.connect(Offered { peer, number, socket, exchange, share }, theirs)
        });
        match connected {
            Ok(link) => {
                self.held.push(link);
                let said = node.ask(self.switch_to(peer, number));
                self.routes.connected(peer, number, said, now);
            }
            Err(why) => {
                tracing::warn!(%peer, %why, "a direct link was not made");
                self.routes.ended(peer, now);
            }
        }
    }

    fn connect(&self, offered: Offered, theirs: Offer) -> Result<Standing, ExchangeError> {
        let Offered { peer, number, socket, exchange, share } = offered;
        let (producer, consumer) = exchange.finish(theirs)?;
        let writer = ring::Writer::new(socket.clone(), producer, self.terms.options);
        let pair = Pair { own: self.terms.own, peer, number, socket };
        Ok(Standing::new(pair, writer, consumer, share, self.terms.payload_max))
    }

    fn switch_to(&self, peer: Tid, number: LinkNumber) -> Message {
        let switch = Switch { peer: peer.bits(), number: number.0 };
        payload::frame(Kind::LNCL_SWITCH, self.terms.own, payload::lncl_of(peer.node), &switch)
    }

    /// A mark of a peer's SWITCH has come.
    fn mark(&mut self, message: &Message, now: Time, node: &mut ToNode<'_>) {
        let Ok(Switch { peer, number }) = payload::read(&message.payload) else { return };
        let (peer, number) = (Tid::from_bits(peer), LinkNumber(number));
        let header = &message.header;
        let confirm = header.flags.has(Flags::CONFIRM).then_some(header.correlation);
        let told = match self.routes.marked(peer, number, header.class, confirm) {
            Marked::Wait => None,
            Marked::Known => confirm.map(|correlation| (correlation, Outcome::Delivered)),
            Marked::Unknown => {
                confirm.map(|correlation| (correlation, Outcome::Rejected(Rejection::Unsupported)))
            }
            Marked::Open { confirm } => {
                let index = self.held.iter().position(|link| link.number == number);
                self.open.extend(index.map(|index| self.held.swap_remove(index)));
                confirm.map(|correlation| (correlation, Outcome::Delivered))
            }
            Marked::Connect { confirm } => {
                let connected = self.connect_offered(peer, number, now, node);
                let why = Outcome::Rejected(Rejection::Malformed);
                let outcome = if connected { Outcome::Delivered } else { why };
                confirm.map(|correlation| (correlation, outcome))
            }
        };
        if let Some((correlation, outcome)) = told {
            node.answer(self.terms.own, header.source, correlation, outcome);
        }
    }

    /// The peer has switched to the link that it had asked for: its offer is there.
    fn connect_offered(&mut self, peer: Tid, number: LinkNumber, now: Time, node: &mut ToNode<'_>) -> bool {
        let Some(index) = self.offered.iter().position(|link| link.number == number) else { return false };
        let offered = self.offered.swap_remove(index);
        let theirs = Exchange::receive(&offered.socket).and_then(|offer| offer.ok_or(ExchangeError::Missing));
        match theirs.and_then(|theirs| self.connect(offered, theirs)) {
            Ok(link) => {
                self.open.push(link);
                let said = node.ask(self.switch_to(peer, number));
                self.routes.connected(peer, number, said, now);
                true
            }
            Err(why) => {
                tracing::warn!(%peer, %why, "a direct link was not made");
                self.routes.ended(peer, now);
                false
            }
        }
    }

    fn hear(&mut self, message: Message, now: Time) -> Option<Message> {
        let outcome = message.payload.first().and_then(|code| Outcome::from_code(*code));
        match self.routes.answered(message.header.correlation, outcome.unwrap_or(Outcome::Unknown), now) {
            Answered::NotOurs => return Some(message),
            Answered::Noted => {}
            Answered::End(peer, number) => self.end(peer, number, now),
        }
        None
    }

    /// Keeps back what was sent after what is left in its sender's ring.
    pub(super) fn keep_early(&mut self, message: Message) -> InTurn {
        let header = &message.header;
        // A group is another destination: its order is its own.
        if self.is_empty() || !header.kind.is_user() || header.destination != self.terms.own {
            return InTurn::Now(message);
        }
        let (source, class) = (header.source, header.class);
        let after = match self.early.get(&source) {
            Some(early) => early.after,
            None => match self.routes.passed(source, class, Time::now()) {
                Passed::Take => return InTurn::Now(message),
                Passed::AfterLink(after) => after,
            },
        };
        if self.early.values().map(|early| early.messages.len()).sum::<usize>() >= EARLY_MAX {
            return InTurn::Never(message);
        }
        let early = self.early.entry(source).or_insert_with(|| Early { after, messages: VecDeque::new() });
        early.messages.push_back(message);
        InTurn::Later
    }

    /// The next of those that were kept back whose turn has come.
    pub(super) fn next_early(&mut self, now: Time) -> Option<Message> {
        if self.early.is_empty() {
            return None;
        }
        self.pop_early().or_else(|| {
            self.see_ends(now);
            self.pop_early()
        })
    }

    fn pop_early(&mut self) -> Option<Message> {
        let routes = &self.routes;
        let is_due = |(source, early): &(&Tid, &mut Early)| routes.link(**source) != Some(early.after);
        let (source, early) = self.early.iter_mut().find(is_due)?;
        let (source, message) = (*source, early.messages.pop_front());
        if early.messages.is_empty() {
            self.early.remove(&source);
        }
        message
    }

    /// Looks who has gone and what is to be said again, now and then.
    pub(super) fn look(&mut self, now: Time, node: &mut ToNode<'_>) {
        if now >= self.flush_at {
            self.flush_at = now + NAP;
            self.flush();
        }
        if now < self.look_at {
            return;
        }
        self.look_at = now + NAP;
        self.see_ends(now);
        while let Some((peer, number)) = self.routes.switch_due(now) {
            match node.ask(self.switch_to(peer, number)) {
                Some(correlation) => self.routes.switched(peer, correlation, now),
                None => self.routes.not_switched(peer, now),
            }
        }
    }

    /// A caller waits for room there: what answers its frame must not come before it knows that the frame is written.
    pub(super) const fn is_writing_on(&mut self, link: Option<LinkNumber>) {
        self.writing = link;
    }

    fn flush(&mut self) {
        let writing = self.writing;
        for link in self.open.iter_mut().chain(&mut self.held).filter(|link| Some(link.number) != writing) {
            link.flush();
        }
    }

    /// Whether there are no links, made or in the making.
    pub(super) fn is_empty(&self) -> bool {
        self.open.is_empty() && self.held.is_empty() && self.offered.is_empty() && self.early.is_empty()
    }

    /// Whether the answer to an introduction that was asked for may have come; true once a nap.
    pub(super) fn is_asking(&mut self, now: Time) -> bool {
        if now < self.hear_at {
            return false;
        }
        self.hear_at = now + NAP;
        self.routes.is_asking()
    }

    /// Whether something may be due that nobody rings for: a SWITCH, the end of a link that is not read yet.
    pub(super) fn is_to_be_looked_at(&self) -> bool {
        !self.is_empty() || self.routes.is_asking()
    }

    /// A task has heard something of the open links.
    pub(super) const fn heard(&mut self, has_one_hung_up: bool) {
        if has_one_hung_up {
            self.look_at = Time::ZERO;
        }
    }

    /// Ends the open link at `index`, whose ring holds what it cannot.
    pub(super) fn fail<T>(&mut self, index: usize, why: &RingError) -> Option<T> {
        let (peer, number) = (self.open[index].peer, self.open[index].number);
        tracing::warn!(%peer, %why, "a direct link is closed; what goes there goes through the node");
        self.end(peer, number, Time::now());
        None
    }

    /// When to look at the latest, if nothing comes before: what is owed is not said by itself.
    pub(super) fn wake_by(&mut self, deadline: Time) -> Time {
        if !self.open.iter().chain(&self.held).any(Standing::owes) {
            return deadline;
        }
        self.flush_at = Time::now() + OWED_AGAIN;
        deadline.min(self.flush_at)
    }

    /// What the end of a wait for the node and the open links says about the links.
    pub(super) fn note(&mut self, ended: &Result<Any, AnyError>) {
        match ended {
            Ok(Any::HungUp(1..)) => self.look_at = Time::ZERO,
            Err(AnyError::Corrupt { index: index @ 1.., cause }) => {
                self.fail::<()>(*index - 1, &RingError::from(*cause));
            }
            Ok(Any::Message(_) | Any::TimedOut | Any::HungUp(_))
            | Err(AnyError::Corrupt { .. } | AnyError::System(_)) => {}
        }
    }

    /// The connection to the node has ended; another one may follow.
    pub(super) fn node_has_ended(&mut self, now: Time) {
        self.routes.node_has_ended(now);
    }

    /// There is another connection to the node, or to its next life; the links stand.
    pub(super) fn node_is_back(&mut self, terms: Terms, control: Option<Arc<UnixStream>>) {
        (self.terms, self.control) = (terms, control);
    }

    /// Waits until something comes on an open link, for `left` at most. May end early without a reason.
    pub(super) fn wait(&mut self, left: Duration) {
        let deadline = self.wake_by(Time::now() + left);
        let until = Instant::now() + deadline.since(Time::now());
        let ended = Waiter::new(Spin::Off).wait(&mut Alone(&mut self.open), until);
        let at = |index: usize| index + 1;
        self.note(&match ended {
            Ok(Any::HungUp(index)) => Ok(Any::HungUp(at(index))),
            Err(AnyError::Corrupt { index, cause }) => Err(AnyError::Corrupt { index: at(index), cause }),
            other @ (Ok(Any::Message(_) | Any::TimedOut) | Err(AnyError::System(_))) => other,
        });
    }

    /// Ends the links whose peers have gone, or say no more there, and have left nothing.
    fn see_ends(&mut self, now: Time) {
        let standing = self.open.iter().chain(&self.held).map(|link| (link.peer, link.number, &link.socket));
        let offered = self.offered.iter().map(|link| (link.peer, link.number, &link.socket));
        let links: Vec<_> = standing.chain(offered).collect();
        if links.is_empty() {
            return;
        }
        let gone: Vec<_> = socket::which_hung_up(links.iter().map(|(_, _, socket)| &***socket))
            .into_iter()
            .map(|index| (links[index].0, links[index].1))
            .chain(self.early.iter().map(|(peer, early)| (*peer, early.after)))
            .filter(|(peer, number)| self.routes.link(*peer) == Some(*number))
            .collect();
        for (peer, number) in gone {
            let left = self.left(number);
            match (self.routes.hung_up(peer, left, now), left) {
                (Farewell::Keep, _) | (Farewell::Read, Left::Something) => {}
                (Farewell::Drop, _) | (Farewell::Read, Left::Nothing) => self.end(peer, number, now),
            }
        }
    }

    fn left(&mut self, number: LinkNumber) -> Left {
        let mut standing = self.open.iter_mut().chain(&mut self.held);
        let has_left = match standing.find(|link| link.number == number) {
            Some(link) => link.has_something(),
            None => self
                .offered
                .iter()
                .any(|link| link.number == number && descriptors::holds_something(&link.socket)),
        };
        if has_left { Left::Something } else { Left::Nothing }
    }

    /// Ends a link: the peer sees its socket hang up.
    pub(super) fn end(&mut self, peer: Tid, number: LinkNumber, now: Time) {
        self.open.retain(|link| link.number != number);
        self.held.retain(|link| link.number != number);
        self.offered.retain(|link| link.number != number);
        if self.routes.link(peer) == Some(number) {
            self.routes.ended(peer, now);
        }
    }
}

/// Whoever holds the socket still, the peer sees its end now. An error means that it is closed already.
fn hang_up(socket: &UnixStream) {
    let _ = rustix::net::shutdown(socket, Shutdown::Both);
}
