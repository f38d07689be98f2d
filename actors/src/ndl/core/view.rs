//! What a tool can ask NDL: who is there, how it was found, how it does.

use std::{collections::BTreeMap, net::SocketAddr, time::Duration};

use sinew_runtime::{
    tid::{Incarnation, NodeAddress, Tid},
    time::Time,
};

use super::{Core, LostNode, Member, Neighbour, OwnStalls, Place, Source, routes::Route};
use crate::{
    clocks::ClockOffset,
    ndl::{IdleClient, Part, Progress, Trouble},
};

/// A node that is there.
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
    /// Its address.
    pub node: NodeAddress,
    /// Its name.
    pub name: String,
    /// Which life of it this is.
    pub incarnation: Incarnation,
    /// Where its NDL answers, and is asked first.
    pub udp: SocketAddr,
    /// All ways to it that are known, that one first. None: this node has none of the addresses any more that it was asked from.
    pub routes: Vec<KnownRoute>,
    /// Where its GNCL listens: the address that it prefers first.
    pub gncl: Vec<SocketAddr>,
    /// Time between two of its queries.
    pub period: Duration,
    /// When it was found: since then this life of it has been there.
    pub since: Time,
    /// Who says that its addresses are to be asked, and when each did so first: long before it was found, perhaps, or in an earlier life of it.
    pub sources: BTreeMap<Source, Time>,
    /// Its last sign of life.
    pub heard: Time,
    /// Answers that it missed in a row.
    pub missed: u32,
    /// Time between two queries to it.
    pub asked_every: Duration,
    /// Time after its last sign of life within which its loss is known, our own stalls aside: `asked_every` times the answers that it may
    /// miss and one more.
    pub bound: Duration,
    /// How many of its layers and applications do not get on, as it says; and its NDL where that is not heard.
    pub troubled: usize,
    /// The first of them: its NDL where that is not heard; then, as it says, layers, then applications by their addresses, four at most.
    pub troubles: Vec<TroubledApp>,
    /// How many of its clients (applications with [`NodeApi`](crate::NodeApi), in any language) take nothing of what waits for them, as it
    /// says. No [`NodeEvent`](crate::events::NodeEvent) tells of it.
    pub idle_clients: usize,
    /// The first of them by their addresses, two at most.
    pub idle: Vec<IdleApp>,
    /// Time of the last query and its answer on the network.
    pub round_trip: Option<Duration>,
    /// How far its clock is from ours, now, and how fast that changes.
    pub offset: Option<ClockOffset>,
}

/// A way to a node: an address of this node, and one of the other where it answers.
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
    /// This node's.
    pub here: SocketAddr,
    /// The other one's.
    pub there: SocketAddr,
    /// Rounds of questions in a row that were not answered there.
    pub missed: u32,
    /// Time of a query and its answer on the network there, of the last ones.
    pub round_trip: Option<Duration>,
}

impl KnownRoute {
    const fn of(route: &Route) -> Self {
        let Route { place: Place { here, there }, missed, round_trip, .. } = *route;
        Self { here, there, missed, round_trip }
    }
}

/// A layer or an application that does not get on.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TroubledApp {
    /// Its address.
    pub app: Tid,
    /// Its name.
    pub name: String,
    /// What is wrong with it.
    pub trouble: Trouble,
    /// For how long that has been so, as its node said last.
    pub since: Duration,
}

/// A client that takes nothing of what waits for it: messages of applications have waited for it at its node, and it has taken nothing,
/// for a second and more. It hangs, is stopped, does not receive, or needs that long for what it took last.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct IdleApp {
    /// Its address.
    pub app: Tid,
    /// The first 24 bytes of its name.
    pub name: String,
    /// For how long at least that has been so, as its node said last.
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
    /// Whether a node is there.
    pub(crate) fn has_member(&self, node: NodeAddress) -> bool {
        self.members.contains_key(&node)
    }

    /// Who is there, in the order of their addresses.
    pub(crate) fn members(&self, now: Time) -> Vec<KnownNode> {
        let views = self.members.iter().map(|(node, member)| KnownNode {
            node: *node,
            name: member.announcement.name.clone(),
            incarnation: member.announcement.incarnation,
            udp: member.routes.best().there,
            routes: member.routes.iter().map(KnownRoute::of).collect(),
            gncl: member.gncl_addresses(&self.own),
            period: Duration::from_micros(member.announcement.period_us.into()),
            since: member.since,
            sources: self.sources(member),
            heard: member.heard,
            missed: member.missed,
            troubled: member.progress.troubled as usize + usize::from(member.troubles.unheard().is_some()),
            troubles: (member.troubles.unheard().into_iter().chain(&member.progress.parts))
                .map(|part| troubled(*node, part))
                .collect(),
            idle_clients: member.progress.idle as usize,
            idle: member.progress.clients.iter().map(|client| idle(*node, client)).collect(),
            asked_every: self.paces[member.pace].period,
            bound: self.paces[member.pace].bound(),
            round_trip: member.clock.round_trip(),
            offset: member.clock.offset(now),
        });
        views.collect()
    }

    /// Who says that a member is to be asked, wherever it is asked, and when each did so first.
    pub(super) fn sources(&self, member: &Member) -> BTreeMap<Source, Time> {
        let mut sources = BTreeMap::new();
        let contacts = member.routes.places().filter_map(|place| self.contacts.get(&place));
        for (source, at) in contacts.flat_map(|contact| &contact.sources) {
            let first = sources.entry(*source).or_insert(*at);
            *first = (*at).min(*first);
        }
        sources
    }

    /// How many layers and applications of this node do not get on, and the first of them. // spec: NDL-9
    pub(crate) fn own_troubles(&self) -> (usize, Vec<TroubledApp>) {
        let Progress { troubled: count, parts, .. } = &self.progress;
        (*count as usize, parts.iter().map(|part| troubled(self.me.node, part)).collect())
    }

    /// How many clients of this node take nothing of what waits for them, and the first of them. // spec: NDL-9.1
    pub(crate) fn own_idle(&self) -> (usize, Vec<IdleApp>) {
        let Progress { idle: count, clients, .. } = &self.progress;
        (*count as usize, clients.iter().map(|client| idle(self.me.node, client)).collect())
    }

    /// Who was there and has not come back, as far as is remembered.
    pub(crate) fn lost_nodes(&self) -> Vec<(NodeAddress, LostNode)> {
        self.recall.lost_nodes()
    }

    /// The name of a node that is there, or was lost; its address where neither is so.
    pub(crate) fn name_of(&self, node: NodeAddress) -> String {
        let member = self.members.get(&node).map(|member| member.announcement.name.clone());
        member.or_else(|| self.recall.name_of(node)).unwrap_or_else(|| node.to_string())
    }

    /// Whether a node is there beside this one.
    pub(crate) fn knows_others(&self) -> bool {
        !self.members.is_empty()
    }

    /// How often this node's own timer came so late that nobody was counted as silent.
    pub(crate) const fn own_stalls(&self) -> OwnStalls {
        self.recall.stalls()
    }

    /// Nodes of other projects that are heard, and where.
    pub(crate) fn neighbours(&self) -> Vec<(SocketAddr, Neighbour)> {
        self.recall.neighbours()
    }
}
