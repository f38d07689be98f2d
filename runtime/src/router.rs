//! The routing table of a node, read by senders without a lock.

mod changes;
mod copies;
mod each;
mod fan_out;
mod groups;
pub mod guard;
pub mod mismatches;
mod reach;
mod retained;
mod room;
mod sink;
mod stop;
pub mod tap;
#[cfg(test)]
mod tests;

use std::{
    collections::BTreeMap,
    sync::{
        Arc, Mutex, OnceLock,
        atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering},
    },
    task::Waker,
};

use arc_swap::ArcSwap;

pub(crate) use self::room::RoomWait;
use self::{
    copies::Copies,
    each::OpenSends,
    fan_out::for_each_here,
    groups::{Groups, Joined},
    guard::{Guard, Judge, ParameterRight},
    mismatches::Mismatches,
    retained::Retained,
    tap::{TAPS, Tap},
};
pub use self::{
    reach::Reach,
    retained::RetainedCounts,
    sink::{MessageSink, SubmitError},
};
use crate::{
    clock::Clock,
    outcome::{Rejection, Ticket},
    protection::StopLatch,
    tid::{AppAddress, NodeAddress, Tid},
    undelivered::{RefusalSink, is_noted},
    wire::{Flags, Header, Kind, Message},
};

/// The route to one application in the routing table.
#[derive(Clone)]
pub struct LocalRoute {
    /// The destination of its messages.
    pub sink: Arc<dyn MessageSink>,
    /// The kinds that it declared to handle: it receives layers' events of these kinds.
    pub events: Arc<[Kind]>,
}

#[derive(Clone, Default)]
struct Table {
    /// The observer of messages, usually none. One pointer also for several: [`tap::joined`].
    tap: Option<Arc<dyn Tap>>,
    /// The access check for this node's applications; `None`: no restriction.
    guard: Option<Arc<dyn Guard>>,
    /// The types that their senders and receivers declared differently, usually none.
    mismatches: Option<Arc<Mismatches>>,
    /// The senders that may set parameters.
    parameters: ParameterRight,
    local: BTreeMap<AppAddress, LocalRoute>,
    peers: BTreeMap<NodeAddress, Arc<dyn MessageSink>>,
}

/// The members of groups. Separate from the routes: memberships change far more often than routes, and a
/// change copies the path to one group, not the routes.
#[derive(Clone, Default)]
struct Members {
    /// Applications of this node.
    here: Groups<AppAddress>,
    /// Nodes that have members.
    elsewhere: Groups<NodeAddress>,
}

/// The tables that a sender reads. It reads both at once, so that a group never appears empty while one
/// member replaces another. A change replaces one part and shares the other.
#[derive(Clone, Default)]
struct Snapshot {
    table: Arc<Table>,
    members: Members,
}

/// The groups of each application and each node; the holder of its lock is the only writer.
#[derive(Default)]
struct Writing {
    here: Joined<AppAddress>,
    elsewhere: Joined<NodeAddress>,
    /// The observers, of which the table has one.
    taps: [Option<Arc<dyn Tap>>; TAPS],
    /// The number of changes of the routes to other nodes, and of removals of applications.
    route_changes: u64,
}

/// The routing table of a node. It is owned by the node, so that it outlives every layer.
pub struct Router {
    node: NodeAddress,
    snapshot: ArcSwap<Snapshot>,
    /// The lock of writers; readers never wait for it.
    writing: Mutex<Writing>,
    /// Rejections, indexed in the order of [`Rejection`].
    refused: [AtomicU64; Rejection::ALL.len()],
    /// Reports rejections of unconfirmed messages to their senders.
    refusals: OnceLock<Arc<dyn RefusalSink>>,
    /// Open confirmed messages to many with copies at other nodes.
    group_sends: Arc<OpenSends>,
    /// The sink for all messages, in a process that has no routes itself.
    uplink: Option<Arc<dyn MessageSink>>,
    /// The latest values of groups for later members. Its lock is taken before `writing`.
    retained: Mutex<Retained>,
    /// The stop that the outputs of this node's applications obey.
    stop: Arc<StopLatch>,
    /// The applications of which echoes are handed over after a stop.
    echo_sources: ArcSwap<stop::EchoSources>,
    /// The number of messages that wait for room in a queue.
    room_waits: AtomicUsize,
    /// Whether outputs in this process are measured by a dry run when they are made.
    runs_dry: AtomicBool,
    /// The clock of the applications that send with this table.
    clock: Clock,
}

impl Router {
    /// Creates the empty table of the node at `node`.
    #[must_use]
    pub fn new(node: NodeAddress) -> Self {
        Self {
            node,
            snapshot: ArcSwap::default(),
            writing: Mutex::default(),
            refused: Default::default(),
            refusals: OnceLock::new(),
            group_sends: Arc::default(),
            uplink: None,
            retained: Mutex::default(),
            stop: Arc::default(),
            echo_sources: ArcSwap::default(),
            room_waits: AtomicUsize::new(0),
            runs_dry: AtomicBool::new(false),
            clock: Clock::WALL,
        }
    }

    /// Creates the table of a process that is not the node itself: all messages leave through `uplink` to the
    /// node at `node`, which has the routes.
    #[must_use]
    pub fn through(node: NodeAddress, uplink: Arc<dyn MessageSink>) -> Self {
        Self { uplink: Some(uplink), ..Self::new(node) }
    }

    /// Sets the clock of the applications that send with this table; without it they read the host's.
    #[must_use]
    pub fn on_clock(self, clock: Clock) -> Self {
        Self { clock, ..self }
    }

    /// Returns the clock of the applications that send with this table.
    #[must_use]
    #[inline]
    pub const fn clock(&self) -> &Clock {
        &self.clock
    }

    /// Returns the node of this table.
    #[must_use]
    pub const fn node(&self) -> NodeAddress {
        self.node
    }

    /// Returns `tid` with [`NodeAddress::HERE`] replaced by this node's address.
    #[must_use]
    pub fn absolute(&self, tid: Tid) -> Tid {
        if tid.node == NodeAddress::HERE && tid.app != AppAddress::NONE {
            Tid::new(self.node, tid.app)
        } else {
            tid
        }
    }

    /// Sends a message from an application of this node. A confirmed message that is rejected is also settled
    /// as rejected.
    ///
    /// # Errors
    /// The reason of the rejection. For a multicast: why no member accepted it, if that can be remedied. A
    /// group without members is no error.
    pub fn send(&self, mut message: Message) -> Result<(), Rejection> {
        message.header.destination = self.absolute(message.header.destination);
        let destination = message.header.destination;
        if self.is_cut(&message.header) {
            return self.account(Err(SubmitError::new(message, Rejection::NotAllowed)));
        }
        if let Some(uplink) = &self.uplink {
            return self.account(Self::send_up(&**uplink, message));
        }
        let snapshot = self.snapshot.load();
        let table = &*snapshot.table;
        guard::note(table.guard.as_ref(), &message.header);
        let result = if destination.is_single() {
            Self::send_to_one(table, self.node, message)
        } else if destination.app == AppAddress::NONE {
            Err(SubmitError::new(message, Rejection::NoSuchApplication))
        } else if message.header.flags.has_any(Flags::ASK.with(Flags::KEEP)) {
            self.send_flagged(message)
        } else {
            self.send_to_many(&snapshot, message, &mut Vec::new())
        };
        self.account(result)
    }

    /// Sends a message to many. Adds the nodes that had no room for one with KEEP to `behind`.
    fn send_to_many(
        &self,
        snapshot: &Snapshot,
        message: Message,
        behind: &mut Vec<NodeAddress>,
    ) -> Result<(), SubmitError> {
        if message.receipt.is_some() {
            self.send_to_each(snapshot, message, behind)
        } else {
            self.multicast(snapshot, message, behind)
        }
    }

    /// Delivers a message from another node to this node's applications: it is never forwarded to a node.
    ///
    /// # Errors
    /// The reason of the rejection.
    pub fn deliver(&self, message: Message) -> Result<(), Rejection> {
        let snapshot = self.snapshot.load();
        self.deliver_by(&snapshot, snapshot.table.judge(), message)
    }

    /// Same as [`deliver`](Self::deliver), for the last will of a node that is lost: `guard` replaces the table's own.
    /// Types are not compared: those in the directory may be of the next incarnation already. It copies no table, for
    /// any number of applications.
    ///
    /// # Errors
    /// The reason of the rejection.
    pub fn deliver_will(&self, message: Message, guard: Option<&Arc<dyn Guard>>) -> Result<(), Rejection> {
        let snapshot = self.snapshot.load();
        let table = &snapshot.table;
        let judge =
            Judge { guard: guard.or(table.guard.as_ref()), mismatches: None, parameters: table.parameters };
        self.deliver_by(&snapshot, judge, message)
    }

    fn deliver_by(&self, snapshot: &Snapshot, judge: Judge<'_>, message: Message) -> Result<(), Rejection> {
        let result = if self.is_cut(&message.header) {
            Err(SubmitError::new(message, Rejection::NotAllowed))
        } else if message.header.destination.is_single() {
            submit_here(&snapshot.table, judge, message)
        } else if message.header.flags.has(Flags::KEEP) {
            self.deliver_kept(judge, message)
        } else {
            self.deliver_to_many(snapshot, judge, message)
        };
        result.map_err(|refused| self.refuse_arrived(refused))
    }

    fn deliver_to_many(
        &self,
        snapshot: &Snapshot,
        judge: Judge<'_>,
        message: Message,
    ) -> Result<(), SubmitError> {
        if message.receipt.is_some() {
            return self.deliver_to_each(snapshot, judge, message);
        }
        let copies = self.fan_out(snapshot, judge, &message);
        self.count(&copies, &message.header);
        Ok(())
    }

    /// Offers a message from another node to its one application on this node. After a full queue the caller
    /// may offer it again, and `room` is woken for that as in [`MessageSink::offer`]. Any other rejection must be
    /// [reported](Self::refuse).
    ///
    /// # Errors
    /// The message, and the reason of the rejection.
    pub fn offer(&self, message: Message, room: Option<&Waker>) -> Result<(), SubmitError> {
        if self.is_cut(&message.header) {
            return Err(SubmitError::new(message, Rejection::NotAllowed));
        }
        let table = &self.snapshot.load().table;
        let Some(route) = table.local.get(&message.header.destination.app) else {
            return Err(SubmitError::new(message, Rejection::NoSuchApplication));
        };
        let Some(tap) = &table.tap else { return offer_to(table, route, message, room) };
        tap::hand_over(&**tap, message, true, |message| offer_to(table, route, message, room))
    }

    /// Cancels this request, from here or from another node, as its reply is no longer awaited; see
    /// [`MessageSink::cancel`].
    pub fn cancel(&self, ticket: Ticket) -> bool {
        let Tid { node, app } = ticket.destination;
        if let Some(uplink) = &self.uplink {
            return uplink.cancel(ticket);
        }
        let table = &self.snapshot.load().table;
        let sink = if node == self.node {
            table.local.get(&app).map(|route| &route.sink)
        } else {
            table.peers.get(&node)
        };
        sink.is_some_and(|sink| sink.cancel(ticket))
    }

    /// Counts a rejected message, and settles it as rejected.
    pub fn refuse(&self, refused: SubmitError) {
        // The owner of the receipt is notified of the reason.
        let _ = self.account(Err(refused));
    }

    /// Same as [`refuse`](Self::refuse), for a message from another node: its sender is notified, also of an
    /// unconfirmed message.
    pub fn refuse_arrived(&self, refused: SubmitError) -> Rejection {
        let SubmitError { message, why } = refused;
        self.report(message.header.destination, &message.header, why, 1);
        self.refuse(SubmitError::new(message, why));
        why
    }

    /// Sets the sink for rejections of unconfirmed messages, once.
    pub fn set_refusal_sink(&self, sink: Arc<dyn RefusalSink>) {
        // A second call has no effect.
        let _ = self.refusals.set(sink);
    }

    /// Reports that `receiver` rejected `count` messages with this header after their send had returned.
    pub fn report(&self, receiver: Tid, header: &Header, why: Rejection, count: u64) {
        if let Some(sink) = self.refusals.get()
            && is_noted(header, why)
        {
            sink.refused(receiver, header, why, count);
        }
    }

    /// Hands a layer's message to an application of this node, without the access list and the tap.
    ///
    /// # Errors
    /// The message, and the reason of the rejection.
    pub fn notify_app(&self, app: AppAddress, message: Message) -> Result<(), SubmitError> {
        match self.snapshot.load().table.local.get(&app) {
            Some(route) => route.sink.submit(message),
            None => Err(SubmitError::new(message, Rejection::NoSuchApplication)),
        }
    }

    /// Returns whether the application of this node at `app` subscribed to events of this kind.
    #[must_use]
    pub fn subscribes(&self, app: AppAddress, kind: Kind) -> bool {
        self.snapshot.load().table.local.get(&app).is_some_and(|route| route.events.contains(&kind))
    }

    /// Returns the number of rejected messages.
    #[must_use]
    pub fn refused(&self) -> u64 {
        self.refused.iter().map(|count| count.load(Ordering::Relaxed)).sum()
    }

    /// Returns the number of rejected messages, for each reason that occurred.
    #[must_use]
    pub fn refused_because(&self) -> Vec<(Rejection, u64)> {
        let counts = self.refused.iter().map(|count| count.load(Ordering::Relaxed));
        Rejection::ALL.into_iter().zip(counts).filter(|(_, count)| *count > 0).collect()
    }

    fn account(&self, result: Result<(), SubmitError>) -> Result<(), Rejection> {
        result.map_err(|refused| {
            self.refused[refused.why as usize].fetch_add(1, Ordering::Relaxed);
            refused.message.reject(refused.why);
            refused.why
        })
    }

    fn send_up(uplink: &dyn MessageSink, message: Message) -> Result<(), SubmitError> {
        if !message.header.destination.is_single() && message.header.flags.has(Flags::ASK) {
            return Err(SubmitError::new(message, Rejection::Unsupported));
        }
        uplink.submit(message)
    }

    fn send_to_one(table: &Table, here: NodeAddress, message: Message) -> Result<(), SubmitError> {
        let Tid { node, .. } = message.header.destination;
        if node == here {
            return submit_here(table, table.judge(), message);
        }
        let peer = table.peers.get(&node);
        // Without an observer the message is passed on directly: a closure would move it twice more.
        let Some(tap) = &table.tap else { return submit_to(peer, message) };
        tap::hand_over(&**tap, message, false, |message| submit_to(peer, message))
    }

    /// Sends one copy to each node that has a member, and one to each member here.
    fn multicast(
        &self,
        snapshot: &Snapshot,
        message: Message,
        behind: &mut Vec<NodeAddress>,
    ) -> Result<(), SubmitError> {
        let Tid { node, app } = message.header.destination;
        let mut copies = Copies::default();
        let Snapshot { table, members } = snapshot;
        tap::saw_sent_to_many(table.tap.as_ref(), &message);
        if node == self.node || node == NodeAddress::ALL {
            copies = self.fan_out(snapshot, table.judge(), &message);
        }
        let mut submit = |(node, peer): (&NodeAddress, &Arc<dyn MessageSink>)| {
            let refused = peer.submit(copy_of(&message)).err().map(|refused| refused.why);
            copies.note(refused);
            if retained::is_behind(&message.header, refused) {
                behind.push(*node);
            }
        };
        if node == NodeAddress::ALL && app.is_group() {
            let nodes = members.elsewhere.members(app);
            nodes.iter().filter_map(|node| table.peers.get_key_value(node)).for_each(submit);
        } else if node == NodeAddress::ALL {
            table.peers.iter().for_each(submit);
        } else if let Some(peer) = table.peers.get_key_value(&node) {
            submit(peer);
        } else if node != self.node {
            return Err(SubmitError::new(message, Rejection::NoSuchNode));
        }
        match copies.why_none() {
            Some(why) if !copies.is_taken() => Err(SubmitError::new(message, why)),
            Some(_) | None => {
                self.count(&copies, &message.header);
                Ok(())
            }
        }
    }

    /// Counts the copies without room of a message to many that other members accepted, so that its sender is
    /// not notified.
    fn count(&self, copies: &Copies, header: &Header) {
        for (why, count) in copies.without_room().filter(|(_, count)| *count > 0) {
            self.refused[why as usize].fetch_add(count, Ordering::Relaxed);
            self.report(header.destination, header, why, count);
        }
    }
}

/// Submits a message to its one application of this node, if the guard allows it.
#[inline]
fn submit_here(table: &Table, judge: Judge<'_>, message: Message) -> Result<(), SubmitError> {
    let route = table.local.get(&message.header.destination.app);
    let Some(tap) = &table.tap else { return submit_by(route, judge, message) };
    tap::hand_over(&**tap, message, false, |message| submit_by(route, judge, message))
}

#[inline]
fn submit_by(route: Option<&LocalRoute>, judge: Judge<'_>, mut message: Message) -> Result<(), SubmitError> {
    let Some(route) = route else { return Err(SubmitError::new(message, Rejection::NoSuchApplication)) };
    match judge.check(&mut message) {
        Some(why) => Err(SubmitError::new(message, why)),
        None => route.sink.submit(message),
    }
}

/// Offers a message to an application of this node, if the guard allows it.
#[inline]
fn offer_to(
    table: &Table,
    route: &LocalRoute,
    mut message: Message,
    room: Option<&Waker>,
) -> Result<(), SubmitError> {
    match table.judge().check(&mut message) {
        Some(why) => Err(SubmitError::new(message, why)),
        None => route.sink.offer(message, room),
    }
}

/// Submits a message to another node.
#[inline]
fn submit_to(peer: Option<&Arc<dyn MessageSink>>, message: Message) -> Result<(), SubmitError> {
    match peer {
        Some(peer) => peer.submit(message),
        None => Err(SubmitError::new(message, Rejection::NoSuchNode)),
    }
}

/// Returns a copy that shares the payload, without the receipt.
fn copy_of(message: &Message) -> Message {
    Message::new(message.header, message.payload.clone())
}
