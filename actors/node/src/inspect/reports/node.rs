//! The question about a node and the nodes that it knows, and its answer.

use serde::{Deserialize, Serialize};
use sinew_model::bounded::at_most;
use sinew_runtime::{
    stop::StopState,
    tid::{Incarnation, NodeAddress},
    wire::Payload,
};

use super::{
    ForeignReport, GuardReport, IdleReport, LISTED_MAX, LostEchoReport, LostReport, PeerReport,
    RealTimeReport, RecordingReport, RefusalReport, Report, RetainedReport, SecurityReport, Shortened,
    SourceReport, StallReport, TroubleReport, UnguardedReport, UnhandledReport,
};

/// Maximum number of nodes in one answer.
pub const PEERS_MAX: usize = 1_024;
/// Maximum number of discovery sources in one answer.
const SOURCES_MAX: usize = 16;
/// Maximum number of multicast groups that a node queries: one per family.
const GROUPS_MAX: usize = 2;

/// Asks for the node's own report and the nodes that it knows. [`NodeReport`] answers.
#[derive(Clone, Copy, Debug, Default, Serialize, Deserialize)]
pub struct AskNode {}

impl Payload for AskNode {
    const NAME: &'static str = "sinew.inspect.node";
}

/// A node, and the nodes that it knows.
///
/// # Examples
///
/// ```
/// use sinew::{AppAddress, Endpoint, Tid, client::ApiError, inspect::{AskNode, NodeReport}, prelude::*};
///
/// fn ask(endpoint: &mut Endpoint) -> Result<NodeReport, ApiError> {
///     let node = Tid::new(endpoint.tid().node, AppAddress::INSPECT);
///     endpoint.message(node, &AskNode {}).ask(Duration::from_secs(1))
/// }
/// ```
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct NodeReport {
    /// Its address.
    pub node: NodeAddress,
    /// Its name.
    pub name: String,
    /// Its incarnation.
    pub incarnation: Incarnation,
    /// Time since it started.
    pub up_us: u64,
    /// Its process ID.
    pub pid: u32,
    /// The version of Sinew that it runs.
    pub version: String,
    /// Whether it is about to end.
    pub stopping: bool,
    /// Number of refused inputs from outside, and of messages without a receiver.
    pub refused: u64,
    /// Its project.
    #[serde(default)]
    pub project: String,
    /// How it authenticates to other nodes, or that it does not; `None`: an older version that does not report it.
    #[serde(default)]
    pub security: Option<SecurityReport>,
    /// Address of the interface on which it discovers others.
    #[serde(default)]
    pub interface: String,
    /// Whether that is the default; `None`: an older version that does not report it.
    #[serde(default)]
    pub is_interface_default: Option<bool>,
    /// The address of its NDL.
    #[serde(default)]
    pub udp: Option<String>,
    /// The address of its GNCL, as announced.
    #[serde(default)]
    pub gncl: Option<String>,
    /// The first of `groups`, for readers that do not know those; from an older version, the only group that it
    /// reports.
    #[serde(default)]
    pub group: Option<String>,
    /// The multicast groups that it queries, IPv4 before IPv6; empty if it does not use multicast.
    #[serde(default, deserialize_with = "at_most::<_, _, GROUPS_MAX>")]
    pub groups: Vec<String>,
    /// The seed addresses.
    #[serde(default, deserialize_with = "at_most::<_, _, LISTED_MAX>")]
    pub seeds: Vec<String>,
    /// The discovery sources, and the results of each.
    #[serde(default, deserialize_with = "at_most::<_, _, SOURCES_MAX>")]
    pub sources: Vec<SourceReport>,
    /// Lost nodes that have not returned, as far as it remembers.
    #[serde(default, deserialize_with = "at_most::<_, _, LISTED_MAX>")]
    pub lost: Vec<LostReport>,
    /// Number of further ones that did not fit.
    #[serde(default)]
    pub lost_left_out: u64,
    /// How often its own NDL got no CPU, so that it counted no node as silent.
    #[serde(default)]
    pub own_stalls: Option<StallReport>,
    /// Number of its layers and applications in trouble.
    #[serde(default)]
    pub troubled: u32,
    /// The first of them: at most four.
    #[serde(default, deserialize_with = "at_most::<_, _, LISTED_MAX>")]
    pub troubles: Vec<TroubleReport>,
    /// Number of its clients that do not read their queued messages.
    #[serde(default)]
    pub idle_clients: u32,
    /// The first of them: at most two.
    #[serde(default, deserialize_with = "at_most::<_, _, LISTED_MAX>")]
    pub idle: Vec<IdleReport>,
    /// Nodes of other projects from which it receives datagrams.
    #[serde(default, deserialize_with = "at_most::<_, _, LISTED_MAX>")]
    pub foreign: Vec<ForeignReport>,
    /// Number of further ones that did not fit.
    #[serde(default)]
    pub foreign_left_out: u64,
    /// Inputs from outside that its layers refused, per cause, the latest first.
    #[serde(default, deserialize_with = "at_most::<_, _, LISTED_MAX>")]
    pub refusals: Vec<RefusalReport>,
    /// Number of further causes that did not fit.
    #[serde(default)]
    pub refusals_left_out: u64,
    /// Types that its applications did not handle or could not read, the latest first; then types that its
    /// applications sent and receivers on other nodes did not handle or could not read.
    #[serde(default, deserialize_with = "at_most::<_, _, LISTED_MAX>")]
    pub unhandled: Vec<UnhandledReport>,
    /// Protected messages that its applications refused because they do not guard the sender, the latest first.
    #[serde(
        default,
        skip_serializing_if = "Vec::is_empty",
        deserialize_with = "at_most::<_, _, LISTED_MAX>"
    )]
    pub unguarded: Vec<UnguardedReport>,
    /// Echoes of its applications that were not delivered to the senders that they guard, the latest first.
    #[serde(
        default,
        skip_serializing_if = "Vec::is_empty",
        deserialize_with = "at_most::<_, _, LISTED_MAX>"
    )]
    pub lost_echoes: Vec<LostEchoReport>,
    /// Its real-time rights and its lateness after its start; `None`: not measured yet, switched off, or an older
    /// version.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub real_time: Option<RealTimeReport>,
    /// The state of its recording; `None`: an older version.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub recording: Option<RecordingReport>,
    /// The values that it retains for later members of groups; `None`: an older version.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub retained: Option<RetainedReport>,
    /// Whether the system is stopped, as the outputs of the node see it; `None`: an older version.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub stop: Option<StopState>,
    /// The outputs that applications in the node's process guard, in the order of their creation.
    #[serde(
        default,
        skip_serializing_if = "Vec::is_empty",
        deserialize_with = "at_most::<_, _, LISTED_MAX>"
    )]
    pub guards: Vec<GuardReport>,
    /// Number of further ones that did not fit.
    #[serde(default)]
    pub guards_left_out: u64,
    /// The known nodes, in the order of their addresses.
    #[serde(deserialize_with = "at_most::<_, _, PEERS_MAX>")]
    pub peers: Vec<PeerReport>,
    /// Number of further ones that did not fit.
    pub left_out: u64,
}

impl Payload for NodeReport {
    const NAME: &'static str = "sinew.inspect.node_report";
}

impl Report for NodeReport {
    /// Halves the longest list, in bytes, so that no list displaces the others. spec: INSPECT-3
    fn halve(&mut self) -> bool {
        // `troubled` and `idle_clients` already count the entries of these two lists.
        let [mut troubles_left_out, mut idle_left_out, mut unhandled_left_out] = [0_u64; 3];
        let [mut unguarded_left_out, mut echoes_left_out] = [0_u64; 2];
        let mut lists: [&mut dyn Shortened; 10] = [
            &mut (&mut self.peers, &mut self.left_out),
            &mut (&mut self.lost, &mut self.lost_left_out),
            &mut (&mut self.foreign, &mut self.foreign_left_out),
            &mut (&mut self.refusals, &mut self.refusals_left_out),
            &mut (&mut self.unhandled, &mut unhandled_left_out),
            &mut (&mut self.unguarded, &mut unguarded_left_out),
            &mut (&mut self.lost_echoes, &mut echoes_left_out),
            &mut (&mut self.guards, &mut self.guards_left_out),
            &mut (&mut self.troubles, &mut troubles_left_out),
            &mut (&mut self.idle, &mut idle_left_out),
        ];
        lists.iter_mut().max_by_key(|list| list.bytes()).is_some_and(|list| list.halve())
    }
}
