//! The view of NDL for tools: the present nodes, how they were found, and their state.

use std::{collections::BTreeMap, net::SocketAddr, time::Duration};

use sinew_model::{
    clocks::ClockOffset,
    facts::Trouble,
    progress::{IdleClient, Part, Progress},
};
use sinew_runtime::{
    tid::{Incarnation, NodeAddress, Tid},
    time::Time,
};

use super::{
    Core, LostNode, Member, Neighbour, OwnStalls, Place, RememberedPeer, Source,
    local_addresses::LocalAddresses, remembered::Present, routes::Route,
};

/// A node that is present.
///
/// # Examples
///
/// ```
/// use sinew::discovery::KnownNode;
///
/// /// How much longer this node's loss may stay unnoticed than the robot can bear, 200 ms.
/// fn is_watched_too_slowly(node: &KnownNode) -> bool {
///     node.bound > std::time::Duration::from_millis(200)
/// }
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct KnownNode {
    /// Address of the node.
    pub node: NodeAddress,
    /// Name of the node.
    pub name: String,
    /// Incarnation of the node.
    pub incarnation: Incarnation,
    /// Address at which its NDL answers and is queried first.
    pub udp: SocketAddr,
    /// All known routes to the node, the used one first. Empty if this node has lost each local address from
    /// which it queried the node.
    pub routes: Vec<KnownRoute>,
    /// Addresses at which its GNCL listens, the preferred one first.
    pub gncl: Vec<SocketAddr>,
    /// Time between two of its queries.
    pub period: Duration,
    /// Time at which it was found. This incarnation has been present since then.
    pub since: Time,
    /// The sources that name its addresses, each with the time at which it first did. That may be long before
    /// the node was found, or in an earlier incarnation.
    pub sources: BTreeMap<Source, Time>,
    /// Time of its last sign of life.
    pub heard: Time,
    /// Number of consecutive missed answers.
    pub missed: u32,
    /// Time between two queries to it.
    pub asked_every: Duration,
    /// Time after its last sign of life within which its loss is known, except for stalls of this node. It is
    /// `asked_every` times one more than the number of answers that may be missed.
    pub bound: Duration,
    /// Number of its stalled layers and applications, as it reports. Includes its NDL if that does not answer.
    pub troubled: usize,
    /// The first of them: its NDL if that does not answer, then reported layers, then applications by their
    /// addresses, four at most.
    pub troubles: Vec<TroubledApp>,
    /// Number of its clients (applications with `NodeApi`, in any language) that do not
    /// read their pending messages, as it reports. No `NodeEvent` reports them.
    pub idle_clients: usize,
    /// The first of them by their addresses, two at most.
    pub idle: Vec<IdleApp>,
    /// Network time of the last query and its answer.
    pub round_trip: Option<Duration>,
    /// Present offset of its clock from the local one, and the drift.
    pub offset: Option<ClockOffset>,
}

/// A route to a node: a local address, and an address of the node at which it answers.
///
/// # Examples
///
/// ```
/// use sinew::{NodeHandle, discovery::KnownRoute};
///
/// fn show_routes(handle: &NodeHandle) {
///     for KnownRoute { here, there, round_trip, .. } in handle.members().iter().flat_map(|node| &node.routes) {
///         println!("{here} -> {there}: {round_trip:?}");
///     }
/// }
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct KnownRoute {
    /// Local address.
    pub here: SocketAddr,
    /// Name of the interface with the local address. `None` if `ndl.interface` names addresses alone: the
    /// interfaces are not watched then.
    pub interface: Option<String>,
    /// Remote address.
    pub there: SocketAddr,
    /// Number of consecutive rounds of queries that were not answered there.
    pub missed: u32,
    /// Smoothed network time of the last queries and answers there.
    pub round_trip: Option<Duration>,
}

impl KnownRoute {
    fn of(route: &Route, local: &LocalAddresses) -> Self {
        let Route { place: Place { here, there }, missed, round_trip, .. } = *route;
        Self { here, interface: local.interface_of(here).map(str::to_owned), there, missed, round_trip }
    }
}

/// A stalled layer or application.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TroubledApp {
    /// Address of the layer or application.
    pub app: Tid,
    /// Name of the layer or application.
    pub name: String,
    /// Trouble of the layer or application.
    pub trouble: Trouble,
    /// Duration of the trouble, as its node last reported.
    pub since: Duration,
}

/// A client that does not read its pending messages. Messages of applications have waited at its node, and it
/// has taken none, for a second and more. It hangs, is stopped, does not receive, or is still processing the
/// last messages.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct IdleApp {
    /// Address of the client.
    pub app: Tid,
    /// First 24 bytes of the client's name.
    pub name: String,
    /// Minimum duration of the idle state, as its node last reported.
    pub since: Duration,
}

fn idle(node: NodeAddress, client: &IdleClient) -> IdleApp {
    let since = Duration::from_millis(client.since_ms.into());
    IdleApp { app: Tid::new(node, client.app), name: client.name.clone(), since }
}

fn troubled(node: NodeAddress, part: &Part) -> TroubledApp {
    TroubledApp {
        app: Tid::new(node, part.app),
        name: part.name.clone(),
        trouble: part.trouble.0,
        since: Duration::from_millis(part.since_ms.into()),
    }
}

impl Core {
    /// Returns whether a node is present.
    pub fn has_member(&self, node: NodeAddress) -> bool {
        self.members.contains_key(&node)
    }

    /// Returns the present nodes, in the order of their addresses.
    pub fn members(&self, now: Time) -> Vec<KnownNode> {
        let views = self.members.iter().map(|(node, member)| KnownNode {
            node: *node,
            name: member.announcement.name.clone(),
            incarnation: member.announcement.incarnation,
            udp: member.routes.best().there,
            routes: member.routes.iter().map(|route| KnownRoute::of(route, &self.local_addresses)).collect(),
            gncl: member.gncl_addresses(&self.local_addresses),
            period: Duration::from_micros(member.announcement.period_us.into()),
            since: member.since,
            sources: self.sources(member),
            heard: member.last_seen,
            missed: member.missed,
            troubled: member.progress.troubled as usize + usize::from(member.troubles.unheard().is_some()),
            troubles: (member.troubles.unheard().into_iter().chain(&member.progress.parts))
                .map(|part| troubled(*node, part))
                .collect(),
            idle_clients: member.progress.idle as usize,
            idle: member.progress.clients.iter().map(|client| idle(*node, client)).collect(),
            asked_every: self.paces.of(member).period,
            bound: self.paces.of(member).bound(),
            round_trip: member.clock.round_trip(),
            offset: member.clock.offset(now),
        });
        views.collect()
    }

    /// Returns the sources that name a member's places, each with the time at which it first did.
    pub(super) fn sources(&self, member: &Member) -> BTreeMap<Source, Time> {
        let mut sources = BTreeMap::new();
        let contacts = member.routes.places().filter_map(|place| self.contacts.get(&place));
        for (source, at) in contacts.flat_map(|contact| &contact.sources) {
            let first = sources.entry(*source).or_insert(*at);
            *first = (*at).min(*first);
        }
        sources
    }

    /// Returns the number of stalled layers and applications of this node, and the first of them. // spec: NDL-9
    pub fn own_troubles(&self) -> (usize, Vec<TroubledApp>) {
        let Progress { troubled: count, parts, .. } = &self.local_node.progress;
        (
            *count as usize,
            parts.iter().map(|part| troubled(self.local_node.announcement.node, part)).collect(),
        )
    }

    /// Returns the number of idle clients of this node, and the first of them. // spec: NDL-9.1
    pub fn own_idle(&self) -> (usize, Vec<IdleApp>) {
        let Progress { idle: count, clients, .. } = &self.local_node.progress;
        (
            *count as usize,
            clients.iter().map(|client| idle(self.local_node.announcement.node, client)).collect(),
        )
    }

    /// Returns the remembered nodes that were members and have not returned.
    pub fn lost_nodes(&self) -> Vec<(NodeAddress, LostNode)> {
        self.introspection.lost_nodes()
    }

    /// Returns the name of a node that is present or was lost, or else its address.
    pub fn name_of(&self, node: NodeAddress) -> String {
        let member = self.members.get(&node).map(|member| member.announcement.name.clone());
        member.or_else(|| self.introspection.name_of(node)).unwrap_or_else(|| node.to_string())
    }

    /// Returns the members that are lost at the next missed answer, or when a newcomer with their address
    /// shows that it is alive. They are not lost if GNCL received from them, which must be
    /// [reported](super::Input::HintReceived) before that.
    pub fn in_doubt(&self) -> Vec<(NodeAddress, Incarnation)> {
        self.members.in_doubt(&self.paces, |node| self.conflicts.contains_key(&node))
    }

    /// Returns the remembered addresses, ordered by the last contact, oldest first. Members count as met now.
    pub fn remembered(&self) -> Vec<RememberedPeer> {
        let (members, authenticated, local) = (&self.members, &self.authenticated, &self.local_addresses);
        self.remembered.peers(&Present { members, authenticated, local })
    }

    /// Returns the number of changes of the remembered addresses.
    pub const fn remembered_changes(&self) -> u64 {
        self.remembered.changes()
    }

    /// Returns whether the addresses of earlier incarnations have been loaded.
    pub const fn has_loaded_remembered(&self) -> bool {
        self.remembered.is_loaded()
    }

    /// Returns whether another node is present.
    pub fn has_members(&self) -> bool {
        !self.members.is_empty()
    }

    /// Returns how often this node's own timer was so late that no node was counted as silent.
    pub const fn own_stalls(&self) -> OwnStalls {
        self.introspection.stalls()
    }

    /// Returns the received nodes of other projects, and their addresses.
    pub fn neighbours(&self) -> Vec<(SocketAddr, Neighbour)> {
        self.introspection.neighbours()
    }
}
