//! The membership core. Inputs are datagrams, link facts and time. Outputs are orders to the shell and facts
//! for others.
//!
//! After each input the shell takes [`Core::poll`] until it is empty, then sleeps until [`Core::next_wake`].
//! The core outlives the shell: the node's state owns it, and a restarted shell goes on with the same
//! members.
//!
//! [`Core`] has parts with state and rules of their own. It gives each input to the parts that it concerns, and
//! executes their decisions. A part sees another one only if it gets it as an argument.
//!
//! | part | state |
//! | --- | --- |
//! | `local_node` | the local node's announcement, and its claim to its address |
//! | `local_addresses` | the addresses of this host, and the seeds |
//! | `paces` | when which members are queried |
//! | `members` | the nodes that answer |
//! | `departed` | the departed nodes, and their last incarnations |
//! | `authenticated` | the incarnations with an authenticated connection: no datagram ends their membership |
//! | `address_conflict` | newcomers with a member's address: a restart, or a second process |
//! | `contacts` | the addresses with which datagrams are exchanged, and the queries to them |
//! | `remembered` | where members are queried first after a restart |
//! | `subscribers` | the applications that subscribe to node events, and the events for them |
//! | `introspection` | state for tools, which decides nothing |
//!
//! | file of `Core` | decision |
//! | --- | --- |
//! | `on_datagram` | the meaning of a datagram |
//! | `incarnations` | nodes that join, leave, and return |
//! | `ownership` | which of two processes has a node address |
//! | `cycle` | which nodes are queried, and which missed too many answers |
//! | `paths` | the use of local addresses that are added or removed |
//! | `view` | the state for tools |
//!
//! | value | content |
//! | --- | --- |
//! | `output` | the orders and facts for the shell |
//! | `member` | the state of a member |
//! | `routes` | from where to where a member is queried |
//! | `liveness_hints` | liveness of a member that does not answer |
//! | `host` | the response of a silent member's host |
//! | `troubles` | the stalled parts of a member |
//! | `clock` | the offset of a peer's clock |
//! | `contact` | an address with which datagrams are exchanged |
//! | `queries` | the sent queries, and their correlation ids |
//! | `budget` | the cost limit of a flood |
//! | `sources` | the sources of addresses to query |
//! | `grace_period` | the time to read answers after a late timer |

mod address_conflict;
mod authenticated;
mod budget;
mod clock;
mod contact;
mod contacts;
mod cycle;
mod departed;
#[cfg(feature = "testing")]
mod faults;
mod grace_period;
mod host;
mod incarnations;
mod introspection;
mod liveness_hints;
mod local_addresses;
mod local_node;
mod member;
mod members;
mod on_datagram;
mod output;
mod ownership;
mod paces;
mod paths;
mod queries;
mod remembered;
mod routes;
mod sources;
mod subscribers;
#[cfg(test)]
mod tests;
mod troubles;
mod view;

use std::{
    collections::VecDeque,
    net::{SocketAddr, SocketAddrV4},
};

use sinew_model::{
    config::NodeConfig,
    facts::{AppFact, LinkFact},
    progress::Progress,
    refusals::Refusals,
};
use sinew_runtime::{
    tid::{Incarnation, NodeAddress},
    time::Time,
};

pub use self::host::Host;
pub(crate) use self::introspection::Neighbour;
pub use self::introspection::{LostNode, OwnStalls};
pub use self::output::Output;
pub(crate) use self::remembered::{REMEMBERED_MAX, RememberedPeer, UNANSWERED_MAX};
pub use self::routes::Place;
pub use self::sources::Source;
pub use self::sources::SourceCounts;
pub use self::view::{IdleApp, KnownNode, KnownRoute, TroubledApp};

use self::{
    address_conflict::AddressConflicts,
    authenticated::Authenticated,
    contact::Role,
    contacts::Contacts,
    departed::Departed,
    introspection::Introspection,
    local_addresses::LocalAddresses,
    local_node::LocalNode,
    member::Member,
    members::Members,
    paces::Paces,
    remembered::{Present, Remembered},
    subscribers::Subscribers,
};
use super::datagram::{Announcement, Answer, Leave};

/// An input of the core.
#[derive(Clone, Debug)]
pub enum Input {
    /// A query was received.
    QueryReceived(Query),
    /// An answer was received; `sent` is in the sender's clock.
    AnswerReceived { from: Place, correlation: u64, sent: Time, answer: Answer },
    /// A leave was received.
    LeaveReceived { from: Place, leave: Leave },
    /// A source outside of the core names the address of a node of this project.
    AddressNamed { source: Source, address: SocketAddr },
    /// The addresses at which members of earlier incarnations of this node answered, as far as they were
    /// kept. This input is given once, also if there are none.
    PeersRemembered(Vec<RememberedPeer>),
    /// A connection of GNCL changed.
    Link(LinkFact),
    /// The host of a node that missed answers was probed, as requested by [`Output::Probe`].
    Probed { node: NodeAddress, incarnation: Incarnation, host: Host, requested: Time },
    /// GNCL received from this incarnation of a node at that time. Given for nodes [in doubt](Core::in_doubt).
    HintReceived { node: NodeAddress, incarnation: Incarnation, at: Time },
    /// The time of [`Core::next_wake`] was reached.
    TimePassed,
    /// The node stops in order.
    Stopping,
    /// An application that handles `NodeEvent` became ready, failed or ended.
    AppChanged(AppFact),
    /// The node's root reports the stalled parts of this node.
    ProgressSeen(Progress),
}

/// A received query; `sent` is in the sender's clock.
#[derive(Clone, Debug)]
pub struct Query {
    pub from: Place,
    pub cast: Cast,
    pub correlation: u64,
    pub sent: Time,
    pub announcement: Announcement,
}

/// The kind of destination of a received datagram.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Cast {
    /// This node's own address.
    Unicast,
    /// The multicast group.
    Multicast,
}

/// The number of a shell instance. Inputs of an older instance that still runs are ignored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Epoch(u64);

/// The membership state.
#[derive(Debug)]
pub struct Core {
    /// The number of the newest shell.
    epoch: u64,
    local_node: LocalNode,
    local_addresses: LocalAddresses,
    paces: Paces,
    members: Members,
    departed: Departed,
    authenticated: Authenticated,
    conflicts: AddressConflicts,
    contacts: Contacts,
    remembered: Remembered,
    subscribers: Subscribers,
    introspection: Introspection,
    outputs: VecDeque<Output>,
    refusals: Refusals,
}

impl Core {
    /// Creates the core of the node at `node`, without members. `boot_nonce` and `secret` are random.
    /// `secret` is never sent.
    pub fn new(
        config: &NodeConfig,
        node: NodeAddress,
        incarnation: Incarnation,
        boot_nonce: u64,
        secret: u128,
    ) -> Self {
        let ndl = &config.ndl;
        Self {
            epoch: 0,
            local_node: LocalNode::new(config, node, incarnation, boot_nonce),
            local_addresses: LocalAddresses::new(ndl.seeds.iter().map(|seed| seed.address).collect()),
            paces: Paces::new(ndl),
            members: Members::new(ndl.nodes_max),
            departed: Departed::new(ndl.nodes_max),
            authenticated: Authenticated::new(config),
            conflicts: AddressConflicts::default(),
            contacts: Contacts::new(ndl, secret),
            remembered: Remembered::default(),
            subscribers: Subscribers::default(),
            introspection: Introspection::default(),
            outputs: VecDeque::new(),
            refusals: Refusals::default(),
        }
    }

    /// Sets the addresses at which GNCL listens, the preferred one first. An empty list means none for now.
    /// `port6` is its port at this node's IPv6 addresses.
    pub fn announce_gncl(&mut self, (addresses, port6): (Vec<SocketAddrV4>, Option<u16>)) {
        self.local_node.announce_gncl(addresses, port6);
    }

    /// Starts a shell that has bound its sockets. `paths` are the local addresses for queries. The first
    /// queries are due at once.
    pub fn start(&mut self, now: Time, paths: &[SocketAddr]) -> Epoch {
        self.epoch += 1;
        self.use_paths(now, paths);
        self.begin(now);
        Epoch(self.epoch)
    }

    /// Returns whether `epoch` is that of the newest shell.
    pub const fn is_current(&self, epoch: Epoch) -> bool {
        self.epoch == epoch.0
    }

    /// Handles an input.
    pub fn handle(&mut self, now: Time, input: Input) {
        if let Input::AppChanged(fact) = input {
            return self.subscribers.handle(&fact, self.members.events());
        }
        if let Input::ProgressSeen(progress) = input {
            self.local_node.progress = progress;
            return;
        }
        let Some(due) = self.paces.rest().due() else { return };
        if now.since(due) > self.paces.rest().bound() {
            // This node was not scheduled for so long that others may have lost it, and have found a later incarnation.
            self.local_node.settle(now, self.paces.rest());
        }
        match input {
            Input::QueryReceived(query) => {
                if self.concerns_us(now, query.from, &query.announcement) {
                    self.query_received(now, &query);
                }
            }
            Input::AnswerReceived { from, correlation, sent, answer } => {
                if self.concerns_us(now, from, &answer.announcement) {
                    self.answer_received(now, from, (correlation, sent), answer);
                }
            }
            Input::LeaveReceived { from, leave } => {
                if self.concerns_us(now, from, &leave.announcement) {
                    self.leave_received(now, from, leave);
                }
            }
            Input::AddressNamed { source, address } => self.address_named(now, source, address),
            Input::PeersRemembered(peers) => {
                let (remembered, present, (contacts, _)) = self.remembered_parts();
                for place in remembered.handle(now, peers, &present, contacts) {
                    self.query_on_receipt(now, place);
                }
            }
            Input::Link(fact) => self.link_changed(now, fact),
            Input::Probed { node, incarnation, host, requested } => {
                if let Some(member) = self.members.incarnation_mut(node, incarnation) {
                    member.host_probed(host, requested);
                }
            }
            Input::HintReceived { node, incarnation, at } => {
                if let Some(member) = self.members.incarnation_mut(node, incarnation) {
                    member.mark_alive(now, at);
                }
            }
            Input::TimePassed => self.time_passed(now),
            Input::Stopping => self.leave(),
            Input::AppChanged(_) | Input::ProgressSeen(_) => {
                unreachable!("it was taken above, whether NDL runs or not")
            }
        }
    }

    /// Returns the next order or fact. Events for applications follow after outputs for layers.
    pub fn poll(&mut self) -> Option<Output> {
        self.outputs.pop_front().or_else(|| {
            let (to, event) = self.subscribers.poll()?;
            Some(Output::Event { to, event })
        })
    }

    /// Returns when [`Input::TimePassed`] is due.
    pub fn next_wake(&self) -> Option<Time> {
        [self.conflicts.next_wake(), self.paces.next_wake()].into_iter().flatten().min()
    }

    /// Returns the announcement of this node.
    pub const fn announcement(&self) -> &Announcement {
        &self.local_node.announcement
    }

    /// Returns the stalled parts of this node.
    pub const fn progress(&self) -> &Progress {
        &self.local_node.progress
    }

    /// Returns the local UDP addresses.
    pub fn paths(&self) -> &[SocketAddr] {
        self.local_addresses.paths()
    }

    /// Returns the counts of rejected datagrams.
    pub const fn refusals(&self) -> &Refusals {
        &self.refusals
    }

    /// Returns the remembered addresses with the parts that they need: the present nodes, and the queried ones.
    const fn remembered_parts(&mut self) -> (&mut Remembered, Present<'_>, (&mut Contacts, &Departed)) {
        let Self { members, authenticated, local_addresses: local, contacts, departed, .. } = self;
        (&mut self.remembered, Present { members, authenticated, local }, (contacts, departed))
    }

    /// Sends a query to `to`, which has a contact.
    fn query(&mut self, now: Time, to: Place) {
        let pace = match self.contacts.role_at(&to) {
            Some(Role::Member(node)) => self.members.get(&node).map(|member| self.paces.of(member)),
            Some(Role::Candidate { .. } | Role::Former { .. }) | None => None,
        };
        let answerable = pace.unwrap_or_else(|| self.paces.rest()).answerable();
        self.outputs.extend(self.contacts.query(now, to, answerable));
    }

    /// Sends a query to `to` because of a received datagram, unless that was done just before.
    fn query_on_receipt(&mut self, now: Time, to: Place) {
        if self.contacts.may_query_on_receipt(now, to) {
            self.query(now, to);
        }
    }

    /// Queries the multicast group from each local address.
    fn query_group(&mut self, now: Time) {
        let answerable = self.paces.rest().answerable();
        self.outputs.extend(self.contacts.query_group(now, self.local_addresses.paths(), answerable));
    }

    /// Returns whether a datagram concerns this node. Datagrams of other projects and this node's own echo do
    /// not. // spec: NDL-1.2
    fn concerns_us(&mut self, now: Time, from: Place, announcement: &Announcement) -> bool {
        let local = &self.local_node.announcement;
        if announcement.project != local.project {
            self.introspection.received(now, from.there, announcement);
            return false;
        }
        // A datagram that was read just before its socket was closed is too late.
        announcement.boot_nonce != local.boot_nonce && self.paths().contains(&from.here)
    }
}
