//! What a node says of others: those that it knows, those that it lost, those of other projects.

use serde::{Deserialize, Serialize};
use sinew_runtime::tid::{Incarnation, NodeAddress, Tid};

use crate::sync::at_most;

/// Connections to one node at most, and ways in which it was found.
const LINKS_MAX: usize = 8;
/// Layers and applications of a peer that do not get on and are named, at most.
const TROUBLES_MAX: usize = 8;

/// A node that was there.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct LostReport {
    /// Its address.
    pub node: NodeAddress,
    /// Its name.
    pub name: String,
    /// Which life of it that was.
    pub incarnation: Incarnation,
    /// Where its NDL answered.
    pub udp: String,
    /// Time since it was lost.
    pub lost_us: u64,
    /// How that was noticed: `left`, `gave up: ` with its reason, `crashed`, `hung`, `link down`, `restarted`, `duplicate`.
    pub why: String,
    /// How long it had been silent then.
    pub silent_us: u64,
    /// Time after its last sign of life within which its loss was to be known.
    #[serde(default)]
    pub bound_us: Option<u64>,
    /// How it had been found: `seed`, `multicast`, `mdns`, `query`, `remembered`.
    #[serde(deserialize_with = "at_most::<_, _, LINKS_MAX>")]
    pub found_by: Vec<String>,
}

/// What a source of addresses has come to: who says to NDL where to ask.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct SourceReport {
    /// `seed`, `multicast`, `mdns`, `query`, `remembered`.
    pub source: String,
    /// Whether the configuration lets it say anything.
    pub is_on: bool,
    /// Places that it named and that are asked now: an address, from each of this node's that leads there.
    pub places: u64,
    /// Nodes that are there and that it found, perhaps beside others.
    pub found: u64,
}

/// How often the timer of a node's NDL came so late that it counted nobody as silent: it got no processor, or its host slept. Each of these puts
/// a loss off by as much and one period.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct StallReport {
    /// How often since the node started.
    pub count: u64,
    /// How late it was at worst.
    pub longest_us: u64,
    /// Time since the last one, if there was any.
    pub last_us: Option<u64>,
}

/// A node of another project that is heard.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ForeignReport {
    /// Its address.
    pub node: NodeAddress,
    /// Its name.
    pub name: String,
    /// Its project.
    pub project: String,
    /// Where it speaks.
    pub udp: String,
    /// Time since it was heard.
    pub ago_us: u64,
}

/// The last dial to a node, if it failed and none has led to a connection since.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct DialReport {
    /// Where to.
    pub address: String,
    /// What the system said, or why it is not proven who is there and what to do.
    pub error: String,
    /// How far it came: `refused` (nobody listens there), `not proven` (somebody listens, and it is not proven that he is who is meant, or he does
    /// not take this node), `hung up` (he did before that was proven), `system` (anything else: mostly there is no way). Empty: of a version that
    /// does not say.
    #[serde(default)]
    pub fault: String,
    /// Time since then.
    pub ago_us: u64,
    /// How many have failed since there was a connection.
    pub failed: u64,
}

/// A layer or an application of a node that does not get on, though the node lives.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct TroubleReport {
    /// Its address.
    pub app: Tid,
    /// Its name.
    pub name: String,
    /// `stalled` (one turn of it has lasted for 250 ms and more), `away` (it failed and is started again), `given up` (it failed and is not).
    pub trouble: String,
    /// For how long that has been so, as its node said last.
    pub since_us: u64,
}

/// A client of a node (an application with `NodeApi`) that takes nothing of what waits for it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct IdleReport {
    /// Its address.
    pub app: Tid,
    /// The first 24 bytes of its name.
    pub name: String,
    /// For how long at least that has been so, as its node said last.
    pub since_us: u64,
}

/// A node as another one sees it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct PeerReport {
    /// Its address.
    pub node: NodeAddress,
    /// Its name, if it is there.
    pub name: Option<String>,
    /// Which life of it this is.
    pub incarnation: Incarnation,
    /// Whether it answers; else it is lost, and there is still something for it or from it.
    pub is_there: bool,
    /// Time since this life of it was found.
    pub found_us: Option<u64>,
    /// Who says that its addresses are to be asked: `seed`, `multicast`, `mdns`, `query`, `remembered`.
    #[serde(deserialize_with = "at_most::<_, _, LINKS_MAX>")]
    pub found_by: Vec<String>,
    /// Time since its last sign of life.
    pub silent_us: Option<u64>,
    /// Answers that it missed in a row.
    pub missed: u32,
    /// Time between two queries to it, if it is there.
    #[serde(default)]
    pub asked_every_us: Option<u64>,
    /// Time after its last sign of life within which its loss is known, if it is there.
    #[serde(default)]
    pub bound_us: Option<u64>,
    /// How many of its layers and applications do not get on, as it says.
    #[serde(default)]
    pub troubled: u32,
    /// The first of them: four at most, and 64 of all peers.
    #[serde(default, deserialize_with = "at_most::<_, _, TROUBLES_MAX>")]
    pub troubles: Vec<TroubleReport>,
    /// How many of its clients take nothing of what waits for them, as it says.
    #[serde(default)]
    pub idle_clients: u32,
    /// The first of them: two at most, and 64 of all peers.
    #[serde(default, deserialize_with = "at_most::<_, _, TROUBLES_MAX>")]
    pub idle: Vec<IdleReport>,
    /// The ways on which NDL asks it, the one that is used first.
    #[serde(default, deserialize_with = "at_most::<_, _, LINKS_MAX>")]
    pub routes: Vec<RouteReport>,
    /// Time of the last query and its answer on the network, in nanoseconds.
    pub round_trip_ns: Option<u64>,
    /// Its clock minus that of the node that answers, in nanoseconds.
    pub offset_ns: Option<i64>,
    /// The error of that at most, in nanoseconds.
    pub offset_bound_ns: Option<u64>,
    /// By how much faster its clock runs than that of the node that answers, in billionths: 1,000 are 1 ppm.
    #[serde(default)]
    pub drift_ppb: Option<i64>,
    /// The error of that at most; 200,000 as long as nothing is known of it.
    #[serde(default)]
    pub drift_bound_ppb: Option<u64>,
    /// Since when there is a connection to it.
    #[serde(default)]
    pub linked_us: Option<u64>,
    /// When the last one broke, if there is none.
    #[serde(default)]
    pub broken_us: Option<u64>,
    /// The last dial, if it failed.
    #[serde(default)]
    pub dial: Option<DialReport>,
    /// The connections to it.
    #[serde(deserialize_with = "at_most::<_, _, LINKS_MAX>")]
    pub links: Vec<LinkReport>,
    /// How values of class Stream go to it; `None` where one connection carries all classes.
    #[serde(default)]
    pub stream: Option<StreamReport>,
}

/// A way to a node.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct RouteReport {
    /// The UDP address of the node that answers this.
    pub here: String,
    /// That of the other one.
    pub there: String,
    /// Rounds of questions in a row that were not answered there.
    pub missed: u32,
    /// Time of a query and its answer on the network there, in nanoseconds, of the last ones.
    pub round_trip_ns: Option<u64>,
}

/// How values of class Stream go to a node: each in a datagram of its own (UDP), or by the connection (TCP).
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct StreamReport {
    /// Whether the node that answers may send datagrams: `gncl.datagrams`.
    pub is_on: bool,
    /// Whether both have agreed on them. If not, all goes by the connection.
    pub is_agreed: bool,
    /// Values that went by datagram so far.
    pub sent: u64,
    /// Those of them that the other node has acknowledged.
    pub arrived: u64,
    /// The longest payload that goes by datagram, in bytes, where longer datagrams do not arrive; longer values go by the connection.
    #[serde(default)]
    pub payload_max: Option<u64>,
}

impl PeerReport {
    /// That of a node that is not there and of which nothing else is known.
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

/// What carries the messages of a class to a node.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct LinkReport {
    /// `control`, `stream`, `bulk`; `all` where one connection carries all.
    pub class: String,
    /// Whether it is connected now.
    pub is_up: bool,
    /// Messages that wait to be sent.
    pub waiting: u64,
    /// Confirmed ones whose outcome is not known yet.
    pub unconfirmed: u64,
}
