//! The direct links of one endpoint: a ring to and from each of some other processes, beside the way through the node.
//!
//! When which way is taken is decided in `routes.rs`; here are the sockets and the memory.

mod budget;
mod descriptors;
mod early;
mod errand;
mod foreign;
mod meeting;
mod room;
mod standing;
#[cfg(test)]
mod tests;

use std::{
    collections::{BTreeMap, VecDeque},
    os::unix::net::UnixStream,
    sync::Arc,
    time::Duration,
};

use rustix::net::Shutdown;
use sinew_runtime::{
    outcome::{Outcome, ReceiptSink, Rejection, Ticket},
    tid::Tid,
    time::Time,
    wire::{Class, Flags, Kind, Message},
};
use sinew_shm::{Any, AnyError, Spin, Waiter};

use super::{
    ApiError,
    link::{
        LinkOptions, Writer,
        loan::InRing,
        ring::{self, NAP},
        socket,
    },
    loan::Draft,
    routes::{Answered, Directness, Farewell, LINKS_MAX, Left, LinkNumber, Marked, Passed, Routes, Way},
};
use crate::{
    lncl::payload::{self, Gone, Introduce, Introduction, Registered, Switch},
    ring::{self as rings, Exchange, ExchangeError, RingError},
};

use budget::{Budget, PROCESS, Share};
use early::Early;
pub(super) use early::InTurn;
use errand::Errand;
pub(super) use errand::{Fate, GONE_WITHIN};
use foreign::{CLOSING, Closing, Half, LinkEnd};
pub(super) use room::Room;
use standing::{Alone, Pair, Put};
pub(super) use standing::{Came, Everything, Standing};

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
    /// What closes what peers pass wrongly.
    closing: &'static Closing,
}

/// A link of which the peer knows our half.
struct Offered {
    peer: Tid,
    number: LinkNumber,
    socket: LinkEnd,
    half: Half,
    share: Share,
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
    /// What was half written there when the link ended.
    cut: Option<Message>,
    /// The confirmed message whose answer is waited for, if it went on a link.
    errand: Option<Errand>,
    /// Values of a Stream that were lost with a link, and that the endpoint has not counted yet, for whom they were.
    unsent: BTreeMap<Tid, u64>,
}

/// What became of a message that was to go directly.
pub(super) enum Sent {
    /// It is in the ring, or waits for room as the newest of its Stream.
    Taken,
    /// Part of it is in the ring: [`Direct::write_on`].
    Begun,
    /// There is no room.
    Full(Draft),
    /// The peer has gone.
    Gone(Draft),
}

/// How far a message is that was begun.
pub(super) enum Writing {
    Whole,
    /// There is no room for more.
    Part,
    /// The link has ended before it was whole: nobody has received it.
    Cut(Draft),
}

/// The node's link, and the numbers by which this endpoint knows what it has asked.
pub(super) struct ToNode<'a> {
    pub(super) writer: &'a Arc<Writer>,
    pub(super) correlation: &'a mut u64,
}

impl Terms {
    pub(super) fn of(registered: &Registered, options: &LinkOptions) -> Self {
        Self {
            own: Tid::new(registered.node, registered.app),
            ring_bytes: options.direct_ring_bytes.min(registered.ring.unwrap_or_default() as usize),
            payload_max: registered.payload_max as usize,
            options: options.clone(),
            budget: &PROCESS,
            closing: &CLOSING,
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
            cut: None,
            errand: None,
            unsent: BTreeMap::new(),
        }
    }

    /// The link on which a message to `destination` goes; `None` for the way through the node, and then an introduction is
    /// asked for where that makes sense.
    pub(super) fn way(&mut self, destination: Tid, now: Time, node: &mut ToNode<'_>) -> Option<LinkNumber> {
        self.control.as_ref()?;
        match self.routes.way(destination, now) {
            Way::Direct(number) => Some(number),
            Way::Through => None,
            Way::ThroughAndAsk if !self.has_room() => {
                self.routes.no_room(destination, now);
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

    /// Whether this process may have one more link, and what comes on it.
    fn has_room(&self) -> bool {
        self.terms.budget.has_room(self.terms.ring_bytes) && self.terms.closing.is_room()
    }

    /// The link on which a message to `destination` would go now. Nobody is asked for one.
    pub(super) fn link_to(&self, destination: Tid) -> Option<LinkNumber> {
        // Whether a link stands is no question of time.
        match self.routes.way(destination, Time::ZERO) {
            Way::Direct(number) => self.control.as_ref().map(|_| number),
            Way::Through | Way::ThroughAndAsk => None,
        }
    }

    /// Lends room in the ring of a link; `None` if there is none now.
    pub(super) fn lend(&mut self, number: LinkNumber, length: usize) -> Option<InRing> {
        self.standing(number)?.writer.lend(length)
    }

    /// Sends on a link, as far as there is room.
    ///
    /// # Errors
    /// [`ApiError::LoanActive`], or it is too long for its rings.
    pub(super) fn send(&mut self, number: LinkNumber, draft: Draft, now: Time) -> Result<Sent, ApiError> {
        let Some(link) = self.standing(number) else { return Ok(Sent::Gone(draft)) };
        match link.send_draft(draft) {
            Err((ApiError::Closed(_), draft)) => {
                let peer = link.peer;
                self.has_closed(peer, now);
                Ok(Sent::Gone(draft))
            }
            Err((error, _)) => Err(error),
            Ok(Put::Taken) => Ok(Sent::Taken),
            Ok(Put::Begun) => {
                self.cut = None;
                Ok(Sent::Begun)
            }
            Ok(Put::Full(message)) => Ok(Sent::Full(message.into())),
        }
    }

    fn standing(&mut self, number: LinkNumber) -> Option<&mut Standing> {
        self.open.iter_mut().chain(&mut self.held).find(|link| link.number == number)
    }

    /// Whether this link has not ended.
    pub(super) fn has(&self, number: LinkNumber) -> bool {
        self.open.iter().chain(&self.held).any(|link| link.number == number)
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

    pub(super) fn flush(&mut self) {
        let writing = self.writing;
        for link in self.open.iter_mut().chain(&mut self.held).filter(|link| Some(link.number) != writing) {
            link.flush();
        }
    }

    /// Whether there are no links, made or in the making.
    pub(super) fn is_empty(&self) -> bool {
        self.open.is_empty() && self.held.is_empty() && self.offered.is_empty() && self.early.is_empty()
    }

    /// Whether the answer to an introduction that was asked for may have come, or why a peer takes nothing; true once a nap.
    pub(super) fn is_asking(&mut self, now: Time) -> bool {
        if now < self.hear_at {
            return false;
        }
        self.hear_at = now + NAP;
        self.routes.is_asking() || self.open.iter().chain(&self.held).any(|link| link.is_stalled)
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
        crate::log::here!(warn: %peer, %why, "a direct link is closed; what goes there goes through the node");
        self.end(peer, number, Time::now());
        None
    }

    /// When to look at the latest, if nothing comes before: what is owed is not said by itself, but on the link that rings for room.
    pub(super) fn wake_by(&mut self, deadline: Time, now: Time, rings: Option<LinkNumber>) -> Time {
        let mut others = self.open.iter().chain(&self.held).filter(|link| Some(link.number) != rings);
        if !others.any(Standing::owes) {
            return deadline;
        }
        self.flush_at = now + OWED_AGAIN;
        deadline.min(self.flush_at)
    }

    /// Whether what waits for room on some link may still find it.
    pub(super) fn owes(&self) -> bool {
        self.owing().next().is_some()
    }

    /// Waits for room on a link that owes something, for `within` at most.
    pub(super) fn await_owed(&mut self, within: Duration) {
        let first = self.owing().next().map(|link| link.number);
        if let Some(link) = first.and_then(|number| self.standing(number)) {
            link.await_owed(within);
        }
    }

    /// Those that owe something to a peer that is there and takes something.
    fn owing(&self) -> impl Iterator<Item = &Standing> {
        let links = self.open.iter().chain(&self.held);
        links.filter(|link| link.owes() && !link.is_stalled && !socket::has_hung_up(&link.socket))
    }

    /// Says what waits for room and will find none any more.
    pub(super) fn tell_unsent(&self) {
        self.open.iter().chain(&self.held).for_each(Standing::tell_unsent);
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
        let now = Time::now();
        let left = self.wake_by(now + left, now, None).since(now);
        let ended = Waiter::new(Spin::Off).wait_within(&mut Alone(&mut self.open), left);
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
        let gone: Vec<_> = socket::which_hung_up(links.iter().map(|(_, _, socket)| &****socket))
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
        if self.writing == Some(number) {
            self.cut = self.standing(number).and_then(|link| link.cut());
        }
        // What its caller writes he has back.
        let has_caller = self.writing == Some(number);
        if let Some(link) = self.standing(number) {
            link.tell_unsent();
            let cut = link.cut().filter(|cut| !has_caller && cut.header.class == Class::Stream);
            let waiting = link.waiting() + usize::from(cut.is_some());
            self.note_unsent(peer, waiting as u64);
        }
        self.open.retain(|link| link.number != number);
        self.held.retain(|link| link.number != number);
        self.offered.retain(|link| link.number != number);
        if self.routes.link(peer) == Some(number) {
            self.routes.ended(peer, now);
        }
    }
}

/// Of what is lost with a link.
impl Direct {
    /// So many values waited for room there.
    fn note_unsent(&mut self, peer: Tid, values: u64) {
        if values > 0 {
            let is_full = self.unsent.len() >= LINKS_MAX && !self.unsent.contains_key(&peer);
            *self.unsent.entry(if is_full { Tid::NONE } else { peer }).or_default() += values;
        }
    }

    /// Ends all of them.
    pub(super) fn end_all(&mut self) {
        let links =
            self.open.iter().chain(&self.held).map(|link| (link.peer, link.number)).collect::<Vec<_>>();
        let now = Time::now();
        links.into_iter().for_each(|(peer, number)| self.end(peer, number, now));
    }

    /// Values of a Stream that waited for room in a link that has ended, since the last call: for whom, and how many.
    pub(super) fn take_unsent(&mut self) -> BTreeMap<Tid, u64> {
        std::mem::take(&mut self.unsent)
    }
}

/// Whoever holds the socket still, the peer sees its end now. An error means that it is closed already.
fn hang_up(socket: &UnixStream) {
    let _ = rustix::net::shutdown(socket, Shutdown::Both);
}
