//! The report of a node about others: the known nodes, the lost ones, and those of other projects.

use serde::{Deserialize, Serialize};
use sinew_runtime::tid::{Incarnation, NodeAddress, Tid};

use sinew_model::bounded::at_most;

/// Maximum number of connections to one node, and of the sources by which it was found.
const LINKS_MAX: usize = 8;
/// Maximum number of listed layers and applications of a peer that are in trouble.
const TROUBLES_MAX: usize = 8;

/// A node that was lost.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct LostReport {
    /// Its address.
    pub node: NodeAddress,
    /// Its name.
    pub name: String,
    /// The incarnation of the node that was lost.
    pub incarnation: Incarnation,
    /// The address of its NDL.
    pub udp: String,
    /// Time since it was lost.
    pub lost_us: u64,
    /// The reason: `left`, `gave up: ` with its reason, `crashed`, `hung`, `link down`, `restarted`, `duplicate`.
    pub why: String,
    /// How long it had been silent at that time.
    pub silent_us: u64,
    /// The detection bound: time after its last sign of life within which its loss had to be detected.
    #[serde(default)]
    pub bound_us: Option<u64>,
    /// How it had been found: `seed`, `multicast`, `mdns`, `query`, `remembered`.
    #[serde(deserialize_with = "at_most::<_, _, LINKS_MAX>")]
    pub found_by: Vec<String>,
}

/// The state of a discovery source, which supplies NDL with addresses to query.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct SourceReport {
    /// `seed`, `multicast`, `mdns`, `query`, `remembered`.
    pub source: String,
    /// Whether the configuration enables it.
    pub is_on: bool,
    /// Addresses that it supplied and that are queried now: one per address and local interface that leads there.
    pub places: u64,
    /// Known nodes that it found, possibly together with other sources.
    pub found: u64,
}

/// Delays of NDL's timer that were so long that no node was counted as silent: the process got no CPU, or its host
/// slept. Each of them delays the detection of a loss by that time plus one period.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct StallReport {
    /// Number of delays since the node started.
    pub count: u64,
    /// The longest delay.
    pub longest_us: u64,
    /// Time since the last delay, if there was any.
    pub last_us: Option<u64>,
}

/// A node of another project from which datagrams are received.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ForeignReport {
    /// Its address.
    pub node: NodeAddress,
    /// Its name.
    pub name: String,
    /// Its project.
    pub project: String,
    /// Its UDP address.
    pub udp: String,
    /// Time since its last datagram.
    pub ago_us: u64,
}

/// The last dial to a node, if it failed and none has led to a connection since.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct DialReport {
    /// The address that was dialled.
    pub address: String,
    /// The error of the system, or why the peer is not authenticated, with the remedy.
    pub error: String,
    /// How far the dial got. `refused`: no listener. `not proven`: the peer is not authenticated as the expected node,
    /// or rejects this one. `hung up`: the peer closed the connection before that. `system`: any other error, mostly no
    /// route. Empty: an older version.
    #[serde(default)]
    pub fault: String,
    /// Time since the dial.
    pub ago_us: u64,
    /// Number of failed dials since the last connection.
    pub failed: u64,
}

/// A layer or an application of a node that is in trouble although the node is alive.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct TroubleReport {
    /// Its address.
    pub app: Tid,
    /// Its name.
    pub name: String,
    /// `stalled` (one turn of it has lasted for 250 ms or more), `away` (it failed and is being restarted), `given up`
    /// (it failed and is not restarted).
    pub trouble: String,
    /// Duration of that state, as its node last reported.
    pub since_us: u64,
}

/// A client of a node (an application with `NodeApi`) that does not read its queued messages.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct IdleReport {
    /// Its address.
    pub app: Tid,
    /// The first 24 bytes of its name.
    pub name: String,
    /// Minimum duration of that state, as its node last reported.
    pub since_us: u64,
}

/// A node as seen by another one.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct PeerReport {
    /// Its address.
    pub node: NodeAddress,
    /// Its name, if it is up.
    pub name: Option<String>,
    /// Its incarnation.
    pub incarnation: Incarnation,
    /// Whether it answers; else it is lost, and messages for it or from it remain.
    pub is_there: bool,
    /// Time since this incarnation was found.
    pub found_us: Option<u64>,
    /// The discovery sources that supply its addresses: `seed`, `multicast`, `mdns`, `query`, `remembered`.
    #[serde(deserialize_with = "at_most::<_, _, LINKS_MAX>")]
    pub found_by: Vec<String>,
    /// Time since its last sign of life.
    pub silent_us: Option<u64>,
    /// Number of consecutive missed answers.
    pub missed: u32,
    /// Time between two queries to it, if it is up.
    #[serde(default)]
    pub asked_every_us: Option<u64>,
    /// Detection bound: time after its last sign of life within which its loss is detected, if it is up.
    #[serde(default)]
    pub bound_us: Option<u64>,
    /// Number of its layers and applications in trouble, as it reports.
    #[serde(default)]
    pub troubled: u32,
    /// The first of them: at most four, and 64 over all peers.
    #[serde(default, deserialize_with = "at_most::<_, _, TROUBLES_MAX>")]
    pub troubles: Vec<TroubleReport>,
    /// Number of its clients that do not read their queued messages, as it reports.
    #[serde(default)]
    pub idle_clients: u32,
    /// The first of them: at most two, and 64 over all peers.
    #[serde(default, deserialize_with = "at_most::<_, _, TROUBLES_MAX>")]
    pub idle: Vec<IdleReport>,
    /// The routes on which NDL queries it, the one in use first.
    #[serde(default, deserialize_with = "at_most::<_, _, LINKS_MAX>")]
    pub routes: Vec<RouteReport>,
    /// Round-trip time of the last query and its answer on the network, in nanoseconds.
    pub round_trip_ns: Option<u64>,
    /// Its clock minus the clock of the reporting node, in nanoseconds.
    pub offset_ns: Option<i64>,
    /// Maximum error of the offset, in nanoseconds.
    pub offset_bound_ns: Option<u64>,
    /// How much faster its clock runs than the clock of the reporting node, in parts per billion: 1,000 are 1 ppm.
    #[serde(default)]
    pub drift_ppb: Option<i64>,
    /// Maximum error of the drift; 200,000 as long as it is unknown.
    #[serde(default)]
    pub drift_bound_ppb: Option<u64>,
    /// Time since the connection to it was established.
    #[serde(default)]
    pub linked_us: Option<u64>,
    /// Time since the last connection was lost, if there is none.
    #[serde(default)]
    pub broken_us: Option<u64>,
    /// The last dial, if it failed.
    #[serde(default)]
    pub dial: Option<DialReport>,
    /// The connections to it.
    #[serde(deserialize_with = "at_most::<_, _, LINKS_MAX>")]
    pub links: Vec<LinkReport>,
    /// The transport of Stream values to it; `None` if one connection carries all classes.
    #[serde(default)]
    pub stream: Option<StreamReport>,
}

/// A route to a node.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct RouteReport {
    /// The UDP address of the reporting node.
    pub here: String,
    /// The name of the interface with that address; `None` if `ndl.interface` names addresses alone.
    #[serde(default)]
    pub interface: Option<String>,
    /// The UDP address of the other node.
    pub there: String,
    /// Number of consecutive rounds of queries without an answer on this route.
    pub missed: u32,
    /// Round-trip time of recent queries and answers on this route, in nanoseconds.
    pub round_trip_ns: Option<u64>,
}

/// The transport of Stream values to a node: each in a datagram of its own (UDP), or over the connection (TCP).
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct StreamReport {
    /// Whether the reporting node may send datagrams: `gncl.datagrams`.
    pub is_on: bool,
    /// Whether both nodes have agreed on datagrams. If not, all values use the connection.
    pub is_agreed: bool,
    /// Values sent by datagram so far.
    pub sent: u64,
    /// Those that the other node has acknowledged.
    pub arrived: u64,
    /// The longest payload sent by datagram, in bytes, if longer datagrams do not arrive; longer values use the
    /// connection.
    #[serde(default)]
    pub payload_max: Option<u64>,
}

impl PeerReport {
    /// Returns the report of a lost node about which nothing else is known.
    #[must_use]
    pub const fn lost(node: NodeAddress, incarnation: Incarnation) -> Self {
        Self {
            node,
            name: None,
            incarnation,
            is_there: false,
            found_us: None,
            found_by: Vec::new(),
            silent_us: None,
            missed: 0,
            asked_every_us: None,
            bound_us: None,
            troubled: 0,
            troubles: Vec::new(),
            idle_clients: 0,
            idle: Vec::new(),
            routes: Vec::new(),
            round_trip_ns: None,
            offset_ns: None,
            offset_bound_ns: None,
            drift_ppb: None,
            drift_bound_ppb: None,
            linked_us: None,
            broken_us: None,
            dial: None,
            links: Vec::new(),
            stream: None,
        }
    }
}

/// A connection that carries messages of a class to a node.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct LinkReport {
    /// `control`, `stream`, `bulk`; `all` if one connection carries all classes.
    pub class: String,
    /// Whether it is connected now.
    pub is_up: bool,
    /// Messages that wait to be sent.
    pub waiting: u64,
    /// Confirmed messages without an outcome.
    pub unconfirmed: u64,
}
