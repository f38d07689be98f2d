//! The direct links of one endpoint: a ring to and a ring from each of some other processes, in addition to
//! the path through the node.
//!
//! `routes.rs` decides which path a message takes; this module holds the sockets and the memory.

mod accounts;
mod budget;
mod descriptors;
mod ends;
mod established;
mod in_flight;
mod link_maker;
mod link_setup;
mod observer;
mod peer_fd;
mod reorder;
mod room;
#[cfg(test)]
mod tests;
mod turns;
mod wait_ends;

use std::{
    collections::{BTreeMap, VecDeque},
    os::unix::net::UnixStream,
    sync::Arc,
    time::Duration,
};

use accounts::LinkAccounts;
use budget::{Budget, PROCESS};
use reorder::ReorderBuffer;
use rustix::net::Shutdown;
use sinew_protocol::{
    payload::{self, Gone, Introduce, Introduction, Observe, Registered, Switch},
    ring::{ExchangeError, RingError},
};
use sinew_runtime::{
    outcome::{Outcome, ReceiptSink, Rejection, Ticket},
    tid::Tid,
    time::Time,
    wire::{Class, Flags, Kind, Message},
};
use sinew_shm::{Any, AnyError, Counters, Spin, WaitSet};

use super::{
    ApiError, DirectLinks,
    link::{LinkOptions, Writer, loan::InRing, ring, ring::CHECK_INTERVAL, socket},
    loan::Draft,
    routes::{LinkNumber, Route, Routes},
};
pub(super) use established::{EstablishedLink, LinkRead};
use established::{Pair, Put};
pub(super) use in_flight::{InFlightRequest, PEER_END_TIMEOUT, Resolution};
use link_maker::LinkTasks;
use link_setup::LinkSetup;
use observer::Observer;
use peer_fd::{DEFERRED_CLOSE, DeferredClose};
pub(super) use reorder::ReorderDecision;
pub(super) use room::Room;
use turns::Turns;
pub(super) use wait_ends::AllEnds;
use wait_ends::LinkEnds;

/// Bytes of a direct link's ring, if the configuration sets no other size.
pub(super) const RING_BYTES: usize = 64 * 1024;
/// Maximum bytes of a peer's ring.
const RING_BYTES_MAX: usize = 1 << 20;
/// Interval between checks whether a ring has room for pending messages to a peer.
const FLUSH_INTERVAL: Duration = Duration::from_millis(1);

/// The settings that all direct links of an endpoint share.
pub(super) struct Terms {
    /// The address of this endpoint.
    pub(super) own: Tid,
    /// Bytes of each ring.
    pub(super) ring_bytes: usize,
    /// Longest payload in bytes.
    pub(super) payload_max: usize,
    pub(super) options: LinkOptions,
    /// The counters that the node can read.
    counters: Option<Counters>,
    /// The limit for the memory of all rings together.
    budget: &'static Budget,
    /// The threads that close unexpected descriptors passed by peers.
    closing: &'static DeferredClose,
}

/// The direct links of an endpoint.
pub(super) struct Direct {
    terms: Terms,
    routes: Routes,
    /// The socket to the node, through which the ends of links arrive. `None` if there are no links.
    control: Option<Arc<UnixStream>>,
    /// Links that are being set up.
    setups: Vec<LinkSetup>,
    tasks: LinkTasks,
    /// Links that are written to but not read yet.
    held: Vec<EstablishedLink>,
    /// Links that are written to and read.
    pub(super) open: Vec<EstablishedLink>,
    /// The places in the set of all rings, each with its index in `open`.
    by_slot: Vec<(u8, usize)>,
    turns: Turns,
    /// Messages that arrived through the node but were sent after messages that are still in that link's
    /// ring.
    reordered: BTreeMap<Tid, ReorderBuffer>,
    /// When to check next for closed links and for messages to repeat.
    next_check: Time,
    /// When an endpoint that only sends checks next for answers of the node.
    next_poll: Time,
    /// When the pending messages are written next.
    next_flush: Time,
    /// The link to which a caller writes a frame; the caller must learn first that the frame is written.
    writing: Option<LinkNumber>,
    /// The message that was half written there when the link ended.
    cut: Option<Message>,
    /// The confirmed message that waits for its answer, if it was sent on a link.
    in_flight: Option<InFlightRequest>,
    /// Present while this application is watched or recorded.
    observer: Option<Observer>,
    /// `None` if there are no links.
    accounts: Option<LinkAccounts>,
    /// Stream values that were lost with a link, per destination, and that the endpoint has not counted yet.
    unsent: BTreeMap<Tid, u64>,
}

/// The result of sending a message on a direct link.
pub(super) enum Sent {
    /// The message is in the ring, or waits for room as the newest of its Stream.
    Taken,
    /// Part of the message is in the ring; [`Direct::write_on`] writes the rest.
    Begun,
    /// The ring has no room.
    Full(Draft),
    /// The peer has gone.
    Gone(Draft),
}

/// The progress of a partly written message.
pub(super) enum Writing {
    Whole,
    /// The ring has no room for more.
    Part,
    /// The link has ended before the message was complete: nobody has received it.
    Cut(Draft),
}

/// The connection to the node, and the counter of the correlation numbers that this endpoint has used for its
/// requests.
pub(super) struct NodeWriter<'a> {
    pub(super) writer: &'a Arc<Writer>,
    pub(super) correlation: &'a mut u64,
}

impl Terms {
    pub(super) fn of(registered: &Registered, options: &LinkOptions, writer: &Writer) -> Self {
        Self {
            own: Tid::new(registered.node, registered.app),
            ring_bytes: options.direct_ring_bytes.min(registered.ring.unwrap_or_default() as usize),
            payload_max: registered.payload_max as usize,
            options: options.clone(),
            counters: writer.counters(),
            budget: &PROCESS,
            closing: &DEFERRED_CLOSE,
        }
    }
}

impl NodeWriter<'_> {
    /// Sends a request if there is room. Returns the correlation number of its outcome.
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
    /// Returns the links of an endpoint that receives its link ends over `control`; without it the endpoint
    /// has no links.
    pub(super) fn new(terms: Terms, control: Option<Arc<UnixStream>>) -> Self {
        let links = if control.is_some() { terms.options.direct_links } else { DirectLinks::Never };
        let routes = Routes::new(terms.own, links);
        let accounts = terms.counters.clone().map(LinkAccounts::new);
        Self {
            terms,
            routes,
            control,
            setups: Vec::new(),
            tasks: LinkTasks::default(),
            held: Vec::new(),
            open: Vec::new(),
            by_slot: Vec::new(),
            turns: Turns::default(),
            reordered: BTreeMap::new(),
            next_check: Time::ZERO,
            next_poll: Time::ZERO,
            next_flush: Time::ZERO,
            writing: None,
            cut: None,
            in_flight: None,
            observer: None,
            accounts,
            unsent: BTreeMap::new(),
        }
    }

    /// Returns the link for a message to `destination`, or `None` if it goes through the node. In that case a
    /// link is requested from the node if that is useful.
    pub(super) fn route(
        &mut self,
        destination: Tid,
        now: Time,
        node: &mut NodeWriter<'_>,
    ) -> Option<LinkNumber> {
        self.control.as_ref()?;
        match self.routes.route(destination, now) {
            Route::Direct(number) => Some(number),
            Route::ViaNode => None,
            Route::RequestLink if !self.routes.is_link_useful(now) => None,
            Route::RequestLink if !self.has_room() => {
                self.routes.no_room(destination, now);
                None
            }
            Route::RequestLink => {
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

    /// Returns whether this process may have one more link, and whether unexpected descriptors that arrive on
    /// it can be closed.
    fn has_room(&self) -> bool {
        self.terms.budget.has_room(self.terms.ring_bytes) && self.terms.closing.is_room()
    }

    /// Returns the link for a message to `destination`. Does not request a new link.
    pub(super) fn link_to(&self, destination: Tid) -> Option<LinkNumber> {
        self.control.as_ref().and_then(|_| self.routes.written_link(destination))
    }

    /// Records that a message to `destination` was sent through the node.
    pub(super) fn sent_through_node(&mut self, destination: Tid, now: Time) {
        self.routes.sent_through_node(destination, now);
    }

    /// Lends room in the ring of a link, or returns `None` if there is none now.
    pub(super) fn lend(&mut self, number: LinkNumber, length: usize) -> Option<InRing> {
        self.established(number)?.writer.lend(length)
    }

    /// Sends on a link if nothing waits before the message and there is room at once for all of it. Returns whether it
    /// was sent.
    pub(super) fn send_at_once(&mut self, number: LinkNumber, draft: &mut Draft) -> bool {
        self.established(number).is_some_and(|link| link.send_at_once(&draft.header, &mut draft.payload))
    }

    /// Sends on a link, as far as there is room.
    ///
    /// # Errors
    /// [`ApiError::LoanActive`], or an error if the message is too long for the rings.
    pub(super) fn send(&mut self, number: LinkNumber, draft: Draft, now: Time) -> Result<Sent, ApiError> {
        let Some(link) = self.established(number) else { return Ok(Sent::Gone(draft)) };
        match link.send_draft(draft) {
            Err((ApiError::Closed(_), draft)) => {
                let peer = link.peer;
                self.on_closed(peer, now);
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

    fn established(&mut self, number: LinkNumber) -> Option<&mut EstablishedLink> {
        let is_it = |link: &&mut EstablishedLink| link.number == number;
        self.open.iter_mut().find(is_it).or_else(|| self.held.iter_mut().find(is_it))
    }

    /// Returns whether this link is still established.
    pub(super) fn has(&self, number: LinkNumber) -> bool {
        self.open.iter().chain(&self.held).any(|link| link.number == number)
    }

    /// Reads from a link from now on.
    fn read_from(&mut self, link: EstablishedLink) {
        link.open();
        self.open.push(link);
        self.index_slots();
    }

    fn index_slots(&mut self) {
        let slots = self.open.iter().enumerate();
        self.by_slot = slots.filter_map(|(index, link)| Some((link.slot()?, index))).collect();
        self.by_slot.sort_unstable();
    }

    /// Returns the index of the open link at this place.
    pub(super) fn at_slot(&self, slot: u8) -> Option<usize> {
        let found = self.by_slot.binary_search_by_key(&slot, |(slot, _)| *slot).ok()?;
        Some(self.by_slot[found].1)
    }

    /// Records that the endpoint looks for what another thread has woken it for.
    pub(super) fn take_wake(&self) {
        // The results are found by their number.
        let _ = self.terms.options.set().is_some_and(WaitSet::take_wake);
    }

    /// Returns whether no check is due, and no message waits outside the rings.
    pub(super) fn is_quiet(&self, now: Time) -> bool {
        let has_links = !self.open.is_empty() || !self.held.is_empty();
        self.setups.is_empty()
            && self.tasks.is_empty()
            && self.reordered.is_empty()
            && self.unsent.is_empty()
            && (!has_links || now < self.next_flush && now < self.next_check)
    }

    /// Continues the setup of links. Checks periodically for closed links and for messages to repeat. Returns whether
    /// it has done so, which is also the time to check all rings.
    pub(super) fn check(&mut self, now: Time, node: &mut NodeWriter<'_>) -> bool {
        self.continue_setups(now, node);
        if now >= self.next_flush {
            self.next_flush = now + CHECK_INTERVAL;
            self.flush();
        }
        if now < self.next_check {
            return false;
        }
        self.next_check = now + CHECK_INTERVAL;
        self.check_hang_ups(now);
        while let Some((peer, number)) = self.routes.switch_due(now) {
            match node.ask(self.switch_to(peer, number)) {
                Some(correlation) => self.routes.switched(peer, correlation, now),
                None => self.routes.not_switched(peer, now),
            }
        }
        true
    }

    /// Records the link on which a caller waits for room. An answer to its frame must not be read before the
    /// caller knows that the frame is written.
    pub(super) const fn is_writing_on(&mut self, link: Option<LinkNumber>) {
        self.writing = link;
    }

    pub(super) fn flush(&mut self) {
        let writing = self.writing;
        for link in self.open.iter_mut().chain(&mut self.held).filter(|link| Some(link.number) != writing) {
            link.flush();
        }
    }

    /// Returns whether there are no links, neither established nor pending.
    pub(super) fn is_empty(&self) -> bool {
        self.open.is_empty()
            && self.held.is_empty()
            && self.setups.is_empty()
            && self.reordered.is_empty()
            && self.tasks.is_empty()
    }

    /// Returns whether the node may have said something about links: the answer to a request, a peer's end, whether
    /// this application is watched. True once per `CHECK_INTERVAL`.
    pub(super) fn must_poll_node(&mut self, now: Time) -> bool {
        if now < self.next_poll {
            return false;
        }
        self.next_poll = now + CHECK_INTERVAL;
        self.needs_checks()
    }

    /// Returns whether an event without a wake-up may be due: a SWITCH, or the end of a link that is not read
    /// yet.
    pub(super) fn needs_checks(&self) -> bool {
        !self.is_empty() || self.routes.is_asking()
    }

    /// Records that a task was woken by one of the open links.
    pub(super) const fn on_wake(&mut self, has_one_hung_up: bool) {
        if has_one_hung_up {
            self.next_check = Time::ZERO;
        }
    }

    /// Ends the open link at `index` because its ring holds invalid data.
    pub(super) fn fail<T>(&mut self, index: usize, why: &RingError) -> Option<T> {
        let (peer, number) = (self.open[index].peer, self.open[index].number);
        sinew_runtime::log::here!(warn: %peer, %why, "a direct link is closed; messages to that peer go through the node");
        self.end(peer, number, Time::now());
        None
    }

    /// Returns the latest time of the next check, at most `deadline`. Only the link `rings` wakes the caller
    /// for room, so pending messages on other links need the check.
    pub(super) fn wake_by(&mut self, deadline: Time, now: Time, rings: Option<LinkNumber>) -> Time {
        let mut others = self.open.iter().chain(&self.held).filter(|link| Some(link.number) != rings);
        if !others.any(EstablishedLink::has_pending) {
            return deadline;
        }
        // Never later: messages that end each wait must not put it off.
        self.next_flush = self.next_flush.min(now + FLUSH_INTERVAL);
        deadline.min(self.next_flush)
    }

    /// Returns whether pending messages on some link may still find room.
    pub(super) fn has_pending(&self) -> bool {
        self.links_with_pending().next().is_some()
    }

    /// Waits for room on a link with pending messages, for `within` at most.
    pub(super) fn await_pending(&mut self, within: Duration) {
        let first = self.links_with_pending().next().map(|link| link.number);
        if let Some(link) = first.and_then(|number| self.established(number)) {
            link.await_pending(within);
        }
    }

    /// Returns the links with pending messages to peers that are connected and still read.
    fn links_with_pending(&self) -> impl Iterator<Item = &EstablishedLink> {
        let links = self.open.iter().chain(&self.held);
        links.filter(|link| link.has_pending() && !link.is_stalled && !socket::has_hung_up(&link.socket))
    }

    /// Reports the pending messages that will find no room any more.
    pub(super) fn log_unsent(&self) {
        self.open.iter().chain(&self.held).for_each(EstablishedLink::log_unsent);
    }

    /// Records the result of a wait for the node and the open links.
    pub(super) fn note(&mut self, ended: &Result<Any, AnyError>) {
        match ended {
            Ok(Any::HungUp(1..)) => self.next_check = Time::ZERO,
            Err(AnyError::Corrupt { index: index @ 1.., cause }) => {
                self.fail::<()>(*index - 1, &RingError::from(*cause));
            }
            Ok(Any::Message(_) | Any::Ready | Any::TimedOut | Any::HungUp(_))
            | Err(AnyError::Corrupt { .. } | AnyError::System(_)) => {}
        }
    }

    /// Records that the connection to the node has ended; another one may follow.
    pub(super) fn on_node_end(&mut self, now: Time) {
        self.routes.on_node_end(now);
    }

    /// Records a new connection to the node or to its next incarnation; the links stay established.
    pub(super) fn on_reconnect(&mut self, terms: Terms, control: Option<Arc<UnixStream>>) {
        (self.terms, self.control) = (terms, control);
        // The node says it again.
        self.observer = None;
        // The node has kept what was counted in the former connection.
        self.accounts = self.terms.counters.clone().map(LinkAccounts::new);
        for link in self.open.iter_mut().chain(&mut self.held) {
            link.account =
                self.accounts.as_mut().map(|accounts| accounts.begin(link.peer)).unwrap_or_default();
        }
    }

    /// Waits until a message arrives on an open link, for `left` at most. May return early without a reason.
    pub(super) fn wait(&mut self, left: Duration) {
        let now = Time::now();
        let left = self.wake_by(now + left, now, None).since(now);
        self.take_wake();
        let mut waiter = ring::waiter(&LinkOptions { spin: Spin::Off, ..self.terms.options.clone() });
        let ended = waiter.wait_within(&mut LinkEnds(&mut self.open), left);
        let at = |index: usize| index + 1;
        self.note(&match ended {
            Ok(Any::HungUp(index)) => Ok(Any::HungUp(at(index))),
            Err(AnyError::Corrupt { index, cause }) => Err(AnyError::Corrupt { index: at(index), cause }),
            other @ (Ok(Any::Message(_) | Any::Ready | Any::TimedOut) | Err(AnyError::System(_))) => other,
        });
    }
}

/// Shuts the socket down, so that the peer observes the end even if another process holds a copy. An error
/// means that it is closed already.
fn hang_up(socket: &UnixStream) {
    let _ = rustix::net::shutdown(socket, Shutdown::Both);
}
