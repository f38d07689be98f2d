//! Where messages go: the routing table of a node, read by senders without a lock.

mod copies;
mod each;
mod groups;
pub mod guard;
pub mod tap;
#[cfg(test)]
mod tests;

use std::{
    collections::{BTreeMap, BTreeSet},
    sync::{
        Arc, Mutex, OnceLock,
        atomic::{AtomicU64, Ordering},
    },
    task::Waker,
};

use arc_swap::ArcSwap;

use self::{
    copies::Copies,
    each::OpenSends,
    groups::{Groups, Joined},
    guard::Guard,
    tap::Tap,
};
use crate::{
    outcome::{Rejection, Ticket},
    post::lock,
    tid::{AppAddress, NodeAddress, Tid},
    undelivered::{RefusalSink, is_noted},
    wire::{Flags, Header, Kind, Message},
};

/// A place that takes messages: a mailbox, a client's socket, the connection to a node.
pub trait Outlet: Send + Sync {
    /// Takes the message, or hands it back with the reason. Never blocks.
    ///
    /// # Errors
    /// The message, untouched, and why it was not taken.
    fn submit(&self, message: Message) -> Result<(), Refused>;

    /// As [`submit`](Self::submit), by one who keeps what finds a full queue and offers it again: that is not counted as refused. `room`
    /// is woken, once, when a queue that was full has room again; of several who wait for that, only the last one. An outlet that cannot
    /// tell wakes nobody.
    ///
    /// # Errors
    /// As `submit`.
    fn offer(&self, message: Message, room: Option<&Waker>) -> Result<(), Refused> {
        let _ = room;
        self.submit(message)
    }

    /// Nobody waits any more for the reply to the request that `ticket` names: if it waits here, it is taken out and ends as
    /// [`Outcome::Expired`](crate::outcome::Outcome::Expired), as if its time were over. Returns whether it was, or whoever has it is told.
    fn cancel(&self, ticket: Ticket) -> bool {
        let _ = ticket;
        false
    }
}

/// A message that an [`Outlet`] did not take.
#[derive(Debug)]
pub struct Refused {
    /// The message, untouched.
    pub message: Message,
    /// Why it was not taken.
    pub why: Rejection,
}

impl Refused {
    /// Refuses `message` because of `why`.
    #[must_use]
    pub const fn new(message: Message, why: Rejection) -> Self {
        Self { message, why }
    }
}

/// One application's line in the routing table.
#[derive(Clone)]
pub struct LocalRoute {
    /// What takes its messages.
    pub outlet: Arc<dyn Outlet>,
    /// What it handles, as far as it told: a layer's event that is among it, it gets.
    pub events: Arc<[Kind]>,
}

#[derive(Clone, Default)]
struct Table {
    /// Who watches; nobody, as a rule.
    tap: Option<Arc<dyn Tap>>,
    /// Who decides what may reach this node's applications; nobody where everything may.
    guard: Option<Arc<dyn Guard>>,
    local: BTreeMap<AppAddress, LocalRoute>,
    peers: BTreeMap<NodeAddress, Arc<dyn Outlet>>,
}

/// Who is in which group. Apart from the routes: applications join and leave far more often than they come and go, and a change copies the way
/// to one group, not the routes.
#[derive(Clone, Default)]
struct Members {
    /// Applications of this node.
    here: Groups<AppAddress>,
    /// Nodes that have members.
    elsewhere: Groups<NodeAddress>,
}

/// What a sender looks at: both at once, so that no group seems to have nobody where one member hands over to another. A change replaces one
/// part and shares the other.
#[derive(Clone, Default)]
struct Snapshot {
    table: Arc<Table>,
    members: Members,
}

/// The groups that each application and each node is in; who holds it is the one writer.
#[derive(Default)]
struct Writing {
    here: Joined<AppAddress>,
    elsewhere: Joined<NodeAddress>,
}

/// How many a message is for.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Reach {
    /// Applications of this node.
    pub here: usize,
    /// Other nodes.
    pub elsewhere: usize,
}

/// Who decides about one message; nobody: it may go anywhere.
type Judge<'a> = Option<&'a Arc<dyn Guard>>;

/// The routing table of a node. It is owned by the node, so that it outlives every layer.
pub struct Router {
    node: NodeAddress,
    snapshot: ArcSwap<Snapshot>,
    /// Writers take turns; readers never wait for them.
    writing: Mutex<Writing>,
    /// For each reason in the order of [`Rejection`].
    refused: [AtomicU64; Rejection::ALL.len()],
    /// Who reports refusals of unconfirmed messages to their senders.
    refusals: OnceLock<Arc<dyn RefusalSink>>,
    /// Confirmed messages to many that other nodes have copies of.
    group_sends: Arc<OpenSends>,
    /// Where everything goes, in a process that knows no route itself.
    uplink: Option<Arc<dyn Outlet>>,
}

impl Router {
    /// The empty table of the node at `node`.
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
        }
    }

    /// The table of a process that is not the node itself: everything goes out through `uplink` to the node at `node`,
    /// which knows the routes.
    #[must_use]
    pub fn through(node: NodeAddress, uplink: Arc<dyn Outlet>) -> Self {
        Self { uplink: Some(uplink), ..Self::new(node) }
    }

    /// The node whose table this is.
    #[must_use]
    pub const fn node(&self) -> NodeAddress {
        self.node
    }

    /// `tid` with [`NodeAddress::HERE`] replaced by this node's address.
    #[must_use]
    pub fn absolute(&self, tid: Tid) -> Tid {
        if tid.node == NodeAddress::HERE && tid.app != AppAddress::NONE {
            Tid::new(self.node, tid.app)
        } else {
            tid
        }
    }

    /// Sends a message from an application of this node. A confirmed message that is refused is also settled so.
    ///
    /// # Errors
    /// Why nobody took the message. For a multicast: why no member took it, where that can be mended. A group without members is no error.
    pub fn send(&self, mut message: Message) -> Result<(), Rejection> {
        message.header.destination = self.absolute(message.header.destination);
        let destination = message.header.destination;
        if let Some(uplink) = &self.uplink {
            return self.account(Self::send_up(&**uplink, message));
        }
        let snapshot = self.snapshot.load();
        let table = &*snapshot.table;
        guard::note(table.guard.as_ref(), &message.header);
        let result = if destination.is_single() {
            Self::send_to_one(table, self.node, message)
        } else if destination.app == AppAddress::NONE {
            Err(Refused::new(message, Rejection::NoSuchApplication))
        } else if message.header.flags.has(Flags::ASK) {
            Err(Refused::new(message, Rejection::Unsupported))
        } else if message.receipt.is_some() {
            self.send_to_each(&snapshot, message)
        } else {
            self.multicast(&snapshot, message)
        };
        self.account(result)
    }

    /// How many applications of this node a message from here is handed to, each where it may have it, and to how many other nodes.
    #[must_use]
    pub fn reach(&self, destination: Tid) -> Reach {
        let Tid { node, app } = self.absolute(destination);
        if destination.is_single() {
            let is_here = node == self.node;
            return Reach { here: usize::from(is_here), elsewhere: usize::from(!is_here) };
        }
        let Snapshot { table, members } = &**self.snapshot.load();
        let here = match (node == self.node || node == NodeAddress::ALL, app) {
            (false, _) => 0,
            (true, group) if group.is_group() => members.here.members(group).len(),
            (true, AppAddress::ALL) => table.local.len(),
            (true, _) => 1,
        };
        let elsewhere = match (node, app) {
            (NodeAddress::ALL, group) if group.is_group() => members.elsewhere.members(group).len(),
            (NodeAddress::ALL, _) => table.peers.len(),
            (node, _) => usize::from(node != self.node),
        };
        Reach { here, elsewhere }
    }

    /// Hands a message that came from another node to this node's applications: it never leaves the node again.
    ///
    /// # Errors
    /// Why nobody took the message.
    pub fn deliver(&self, message: Message) -> Result<(), Rejection> {
        let snapshot = self.snapshot.load();
        self.deliver_by(&snapshot, snapshot.table.guard.as_ref(), message)
    }

    /// The same, by what another guard than the table's own says of it. It copies no table, however many applications there are.
    ///
    /// # Errors
    /// Why nobody took the message.
    pub fn deliver_judged_by(&self, message: Message, guard: &Arc<dyn Guard>) -> Result<(), Rejection> {
        self.deliver_by(&self.snapshot.load(), Some(guard), message)
    }

    fn deliver_by(&self, snapshot: &Snapshot, guard: Judge<'_>, message: Message) -> Result<(), Rejection> {
        let result = if message.header.destination.is_single() {
            submit_here(&snapshot.table, guard, message)
        } else if message.receipt.is_some() {
            self.deliver_to_each(snapshot, guard, message)
        } else {
            let copies = self.fan_out(snapshot, guard, &message);
            self.count(&copies, &message.header);
            Ok(())
        };
        result.map_err(|refused| self.refuse_arrived(refused))
    }

    /// Offers a message that came from another node to the one application of this node that it is for. One who is refused because of a
    /// full queue may offer it again, and is woken for that by `room` as [`Outlet::offer`] says; any other refusal is to be
    /// [told](Self::refuse).
    ///
    /// # Errors
    /// The message, and why it was not taken.
    pub fn offer(&self, message: Message, room: Option<&Waker>) -> Result<(), Refused> {
        let table = &self.snapshot.load().table;
        match table.local.get(&message.header.destination.app) {
            Some(route) => tap::hand_over(table.tap.as_ref(), message, true, |message| {
                if guard::refuses(table.guard.as_ref(), message.header.destination.app, &message.header) {
                    return Err(Refused::new(message, Rejection::NotAllowed));
                }
                route.outlet.offer(message, room)
            }),
            None => Err(Refused::new(message, Rejection::NoSuchApplication)),
        }
    }

    /// Nobody waits any more for the reply to this request, which came from here or from another node; see [`Outlet::cancel`].
    pub fn cancel(&self, ticket: Ticket) -> bool {
        let Tid { node, app } = ticket.destination;
        if let Some(uplink) = &self.uplink {
            return uplink.cancel(ticket);
        }
        let table = &self.snapshot.load().table;
        let outlet = if node == self.node {
            table.local.get(&app).map(|route| &route.outlet)
        } else {
            table.peers.get(&node)
        };
        outlet.is_some_and(|outlet| outlet.cancel(ticket))
    }

    /// Counts a message that nobody takes, and settles it so.
    pub fn refuse(&self, refused: Refused) {
        // The reason is told to whom the receipt belongs.
        let _ = self.account(Err(refused));
    }

    /// The same of a message that came from another node: its sender is told, whether it asked or not.
    pub fn refuse_arrived(&self, refused: Refused) -> Rejection {
        let Refused { message, why } = refused;
        self.report(message.header.destination, &message.header, why, 1);
        self.refuse(Refused::new(message, why));
        why
    }

    /// Has refusals of unconfirmed messages told to `sink` from now on. Set once.
    pub fn set_refusal_sink(&self, sink: Arc<dyn RefusalSink>) {
        // Whoever sets a second one keeps it for itself.
        let _ = self.refusals.set(sink);
    }

    /// `receiver` refused `count` messages with this header, whose sender had gone on.
    pub fn report(&self, receiver: Tid, header: &Header, why: Rejection, count: u64) {
        if let Some(sink) = self.refusals.get()
            && is_noted(header, why)
        {
            sink.refused(receiver, header, why, count);
        }
    }

    /// Hands a layer's message to an application of this node, past the access list and whoever watches.
    ///
    /// # Errors
    /// The message, and why it was not taken.
    pub fn tell(&self, app: AppAddress, message: Message) -> Result<(), Refused> {
        match self.snapshot.load().table.local.get(&app) {
            Some(route) => route.outlet.submit(message),
            None => Err(Refused::new(message, Rejection::NoSuchApplication)),
        }
    }

    /// Whether the application of this node at `app` subscribed to events of this kind.
    #[must_use]
    pub fn subscribes(&self, app: AppAddress, kind: Kind) -> bool {
        self.snapshot.load().table.local.get(&app).is_some_and(|route| route.events.contains(&kind))
    }

    /// How many messages nobody took.
    #[must_use]
    pub fn refused(&self) -> u64 {
        self.refused.iter().map(|count| count.load(Ordering::Relaxed)).sum()
    }

    /// How many messages nobody took, for each reason that there was.
    #[must_use]
    pub fn refused_because(&self) -> Vec<(Rejection, u64)> {
        let counts = self.refused.iter().map(|count| count.load(Ordering::Relaxed));
        Rejection::ALL.into_iter().zip(counts).filter(|(_, count)| *count > 0).collect()
    }

    fn account(&self, result: Result<(), Refused>) -> Result<(), Rejection> {
        result.map_err(|refused| {
            self.refused[refused.why as usize].fetch_add(1, Ordering::Relaxed);
            refused.message.reject(refused.why);
            refused.why
        })
    }

    fn send_up(uplink: &dyn Outlet, message: Message) -> Result<(), Refused> {
        if !message.header.destination.is_single() && message.header.flags.has(Flags::ASK) {
            return Err(Refused::new(message, Rejection::Unsupported));
        }
        uplink.submit(message)
    }

    fn send_to_one(table: &Table, here: NodeAddress, message: Message) -> Result<(), Refused> {
        let Tid { node, .. } = message.header.destination;
        if node == here {
            submit_here(table, table.guard.as_ref(), message)
        } else {
            tap::hand_over(table.tap.as_ref(), message, false, |message| match table.peers.get(&node) {
                Some(peer) => peer.submit(message),
                None => Err(Refused::new(message, Rejection::NoSuchNode)),
            })
        }
    }

    /// One copy for each node that has a member, and one for each member here.
    fn multicast(&self, snapshot: &Snapshot, message: Message) -> Result<(), Refused> {
        let Tid { node, app } = message.header.destination;
        let mut copies = Copies::default();
        let Snapshot { table, members } = snapshot;
        tap::saw_sent_to_many(table.tap.as_ref(), &message);
        if node == self.node || node == NodeAddress::ALL {
            copies = self.fan_out(snapshot, table.guard.as_ref(), &message);
        }
        let mut submit = |peer: &Arc<dyn Outlet>| {
            copies.note(peer.submit(copy_of(&message)).err().map(|refused| refused.why));
        };
        if node == NodeAddress::ALL && app.is_group() {
            let nodes = members.elsewhere.members(app);
            nodes.iter().filter_map(|node| table.peers.get(node)).for_each(submit);
        } else if node == NodeAddress::ALL {
            table.peers.values().for_each(submit);
        } else if let Some(peer) = table.peers.get(&node) {
            submit(peer);
        } else if node != self.node {
            return Err(Refused::new(message, Rejection::NoSuchNode));
        }
        match copies.why_none() {
            Some(why) if !copies.is_taken() => Err(Refused::new(message, why)),
            Some(_) | None => {
                self.count(&copies, &message.header);
                Ok(())
            }
        }
    }

    /// Of a message to many that others took, so that its sender hears nothing: the copies for which there was no room.
    fn count(&self, copies: &Copies, header: &Header) {
        for (why, count) in copies.without_room().filter(|(_, count)| *count > 0) {
            self.refused[why as usize].fetch_add(count, Ordering::Relaxed);
            self.report(header.destination, header, why, count);
        }
    }

    /// Copies for the members on this node, except the sender itself.
    fn fan_out(&self, snapshot: &Snapshot, guard: Judge<'_>, message: &Message) -> Copies {
        let mut copies = Copies::default();
        let here = self.node;
        for_each_here(snapshot, message.header.destination.app, |member, outlet| {
            let is_sender = here == message.header.source.node && member == message.header.source.app;
            if is_sender {
                return;
            }
            let refused = if guard::refuses(guard, member, &message.header) {
                Some(Rejection::NotAllowed)
            } else {
                outlet.submit(copy_of(message)).err().map(|refused| refused.why)
            };
            tap::saw_one_of_many(snapshot.table.tap.as_ref(), Tid::new(here, member), message, refused);
            copies.note(refused);
        });
        copies
    }

    fn change(&self, edit: impl FnOnce(&mut Table)) {
        let _turn = lock(&self.writing);
        let mut snapshot = Snapshot::clone(&self.snapshot.load());
        edit(Arc::make_mut(&mut snapshot.table));
        self.snapshot.store(Arc::new(snapshot));
    }

    /// Replaces who is in which group, if `edit` says that anything changed; the caller has the turn.
    fn regroup(&self, writing: &mut Writing, edit: impl FnOnce(&mut Writing, &mut Members) -> bool) -> bool {
        let mut snapshot = Snapshot::clone(&self.snapshot.load());
        let changed = edit(writing, &mut snapshot.members);
        if changed {
            self.snapshot.store(Arc::new(snapshot));
        }
        changed
    }

    /// Adds or replaces the route to an application of this node.
    pub fn set_local(&self, app: AppAddress, route: LocalRoute) {
        self.change(|table| {
            table.local.insert(app, route);
        });
    }

    /// Removes an application and its memberships.
    pub fn remove_local(&self, app: AppAddress) {
        let mut writing = lock(&self.writing);
        let mut snapshot = Snapshot::clone(&self.snapshot.load());
        Arc::make_mut(&mut snapshot.table).local.remove(&app);
        writing.here.set(app, BTreeSet::new(), &mut snapshot.members.here);
        self.snapshot.store(Arc::new(snapshot));
    }

    /// Makes `app` a member of `group`, or no longer one. Returns whether anything changed. What it costs does not depend on how many
    /// applications and groups there are, but on how many members this group has.
    pub fn set_member(&self, group: AppAddress, app: AppAddress, member: bool) -> bool {
        self.regroup(&mut lock(&self.writing), |writing, members| {
            if member {
                writing.here.join(group, app, &mut members.here)
            } else {
                writing.here.leave(group, app, &mut members.here)
            }
        })
    }

    /// Whether `app` is a member of `group`.
    #[must_use]
    pub fn is_member(&self, group: AppAddress, app: AppAddress) -> bool {
        self.snapshot.load().members.here.members(group).binary_search(&app).is_ok()
    }

    /// The applications of this node that a message to many reaches, in the order of their addresses: the members of a group, every
    /// application, or the one that has this address. Its sender may be among them, and gets none.
    #[must_use]
    pub fn members(&self, of: AppAddress) -> Vec<AppAddress> {
        let mut reached = Vec::new();
        for_each_here(&self.snapshot.load(), of, |app, _| reached.push(app));
        reached
    }

    /// Memberships of all applications of this node in all groups.
    #[must_use]
    pub fn memberships(&self) -> usize {
        lock(&self.writing).here.memberships()
    }

    /// Shows messages to `tap` from now on; to nobody, if there is none.
    pub fn set_tap(&self, tap: Option<Arc<dyn Tap>>) {
        self.change(|table| table.tap = tap);
    }

    /// Asks `guard` from now on what may reach the applications of this node.
    pub fn set_guard(&self, guard: Arc<dyn Guard>) {
        self.change(|table| table.guard = Some(guard));
    }

    /// Groups that have a member on this node, in the order of their addresses.
    #[must_use]
    pub fn groups(&self) -> Vec<AppAddress> {
        self.groups_with_members().into_iter().map(|(group, _)| group).collect()
    }

    /// The same with their members.
    #[must_use]
    pub fn groups_with_members(&self) -> Vec<(AppAddress, Arc<[AppAddress]>)> {
        self.snapshot.load().members.here.all()
    }

    /// Adds or replaces the route to another node.
    pub fn set_peer(&self, node: NodeAddress, outlet: Arc<dyn Outlet>) {
        self.change(|table| {
            table.peers.insert(node, outlet);
        });
    }

    /// Removes the route to another node.
    pub fn remove_peer(&self, node: NodeAddress) {
        self.change(|table| {
            table.peers.remove(&node);
        });
    }

    /// States which groups have members on another node. Only the ways to the groups that differ from what was said before are copied.
    pub fn set_remote_groups(&self, node: NodeAddress, groups: &[AppAddress]) {
        self.regroup(&mut lock(&self.writing), |writing, members| {
            writing.elsewhere.set(node, groups.iter().copied().collect(), &mut members.elsewhere)
        });
    }
}

/// Shows `each` the applications of this node that a message to many is for, in the order of their addresses.
fn for_each_here(snapshot: &Snapshot, of: AppAddress, mut each: impl FnMut(AppAddress, &Arc<dyn Outlet>)) {
    let Snapshot { table, members } = snapshot;
    if of.is_group() {
        let routes = members.here.members(of).iter().filter_map(|app| Some((*app, table.local.get(app)?)));
        routes.for_each(|(app, route)| each(app, &route.outlet));
    } else if of == AppAddress::ALL {
        let apps = table.local.iter().filter(|(app, _)| !app.is_layer());
        apps.for_each(|(app, route)| each(*app, &route.outlet));
    } else if let Some(route) = table.local.get(&of) {
        // A broadcast to the application that has this address on every node.
        each(of, &route.outlet);
    }
}

/// Hands a message to the one application of this node that it is for, if it may reach it.
fn submit_here(table: &Table, guard: Judge<'_>, message: Message) -> Result<(), Refused> {
    tap::hand_over(table.tap.as_ref(), message, false, |message| {
        let target = message.header.destination.app;
        match table.local.get(&target) {
            Some(_) if guard::refuses(guard, target, &message.header) => {
                Err(Refused::new(message, Rejection::NotAllowed))
            }
            Some(route) => route.outlet.submit(message),
            None => Err(Refused::new(message, Rejection::NoSuchApplication)),
        }
    })
}

/// A copy that shares the payload; receipts are never shared.
fn copy_of(message: &Message) -> Message {
    Message::new(message.header, message.payload.clone())
}
