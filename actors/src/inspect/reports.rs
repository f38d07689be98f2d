//! The questions and what answers them. Times are microseconds before the answer was made, unless a name says otherwise.

mod access;
mod peers;
mod reach;
mod security;

pub use access::{AccessReport, AccessVerdict, AskAccess, AskReload, ReloadReport};
pub use peers::{
    DialReport, ForeignReport, IdleReport, LinkReport, LostReport, PeerReport, RouteReport, SourceReport,
    StallReport, StreamReport, TroubleReport,
};
pub use reach::{AskGroups, AskReach, REACHED_MAX, ReachReport, Reached};
pub use security::{CertificateReport, SecurityReport};

use serde::{Deserialize, Serialize};
use sinew_runtime::{
    outcome::Rejection,
    tid::{Incarnation, NodeAddress, Tid},
    wire::{Class, Kind, encode},
};

use crate::{
    audit::{NodeAudit, put_together},
    payload,
    sync::at_most,
};

/// Nodes in one answer at most.
pub const PEERS_MAX: usize = 1_024;
/// Applications in one answer at most.
pub const APPS_MAX: usize = 1_024;
/// Lines of a tree in one answer at most.
pub const TREE_MAX: usize = 1_024;
/// Sources of addresses in one answer at most.
const SOURCES_MAX: usize = 16;
/// Multicast groups that a node asks at most: one of each family.
const GROUPS_MAX: usize = 2;
/// Lost nodes, causes of refusals, or barriers, in one answer at most.
pub(super) const TOLD_MAX: usize = 64;
/// Names that one application lacks at most: as many as it may require.
pub(super) const MISSING_MAX: usize = 64;
/// Payloads that one application is said to handle at most: as many as stand in the directory.
pub(super) const KINDS_MAX: usize = 64;
/// Messages of an application that is watched in one answer, at most.
pub const SEEN_MAX: usize = 256;
/// Longest payload that is shown to a watcher, in bytes; of a longer one only its length is.
pub const SEEN_BYTES_MAX: usize = 16 * 1024;

payload!("sinew.ping" =>
    /// Asks for a sign of life, confirmed: whoever it is for need not know it.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::{Endpoint, Outcome, Tid, client::ApiError, inspect::Ping, prelude::*};
    ///
    /// fn lives(endpoint: &mut Endpoint, app: Tid) -> Result<bool, ApiError> {
    ///     let outcome = endpoint.message(app, &Ping {}).confirmed(Duration::from_millis(100))?;
    ///     Ok(outcome == Outcome::Delivered)
    /// }
    /// ```
    #[derive(Clone, Copy, Debug, Default)]
    pub struct Ping {}
);

payload!("sinew.inspect.node" =>
    /// Who are you, and whom do you know? [`NodeReport`] answers.
    #[derive(Clone, Copy, Debug, Default)]
    pub struct AskNode {}
);

payload!("sinew.inspect.apps" =>
    /// Which applications do you have, and whom do they wait for? [`AppsReport`] answers.
    #[derive(Clone, Copy, Debug, Default)]
    pub struct AskApps {}
);

payload!("sinew.inspect.tree" =>
    /// Who supervises whom? [`TreeReport`] answers.
    #[derive(Clone, Copy, Debug, Default)]
    pub struct AskTree {}
);

payload!("sinew.inspect.audit" =>
    /// Where is every message that you ever had? [`AuditReport`] answers.
    #[derive(Clone, Copy, Debug, Default)]
    pub struct AskAudit {}
);

payload!("sinew.inspect.watch" =>
    /// Which messages has this application of yours got and sent, since I asked last? [`WatchReport`] answers.
    ///
    /// The first question begins the watch, and is answered with nothing. It is over 3 s after the last one.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::{AppAddress, Endpoint, Tid, client::ApiError, inspect::{AskWatch, WatchReport}, prelude::*};
    ///
    /// /// Returns the messages to the application since the last call. The first call begins the watch.
    /// fn watch(endpoint: &mut Endpoint, app: Tid) -> Result<WatchReport, ApiError> {
    ///     let inspect = Tid::new(app.node, AppAddress::INSPECT);
    ///     let question = AskWatch { app, received: true, sent: false };
    ///     endpoint.message(inspect, &question).ask(Duration::from_secs(1))
    /// }
    /// ```
    #[derive(Clone, Copy, Debug)]
    pub struct AskWatch {
        /// The application.
        pub app: Tid,
        /// Whether to show what it gets.
        pub received: bool,
        /// Whether to show what it sends.
        pub sent: bool,
    }
);

payload!("sinew.inspect.node_report" =>
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
    #[derive(Clone, Debug, PartialEq, Eq)]
    pub struct NodeReport {
        /// Its address.
        pub node: NodeAddress,
        /// Its name.
        pub name: String,
        /// Which life of it this is.
        pub incarnation: Incarnation,
        /// Time since it started.
        pub up_us: u64,
        /// Its process.
        pub pid: u32,
        /// The version of Sinew that it runs.
        pub version: String,
        /// Whether it is about to end.
        pub stopping: bool,
        /// What it refused that came from outside, and messages that nobody took.
        pub refused: u64,
        /// The project that it is of.
        #[serde(default)]
        pub project: String,
        /// How it proves itself to other nodes, or that it does not; `None`: it is of a version that does not say.
        #[serde(default)]
        pub security: Option<SecurityReport>,
        /// Address of the interface where it looks for others.
        #[serde(default)]
        pub interface: String,
        /// Whether nobody has chosen that; `None`: it is of a version that does not say.
        #[serde(default)]
        pub is_interface_default: Option<bool>,
        /// Where its NDL answers.
        #[serde(default)]
        pub udp: Option<String>,
        /// Where its GNCL listens, as it announces it.
        #[serde(default)]
        pub gncl: Option<String>,
        /// The first of `groups`, for who does not know those; of a version that does not say them, the only one that it says.
        #[serde(default)]
        pub group: Option<String>,
        /// The multicast groups that it asks, that of IPv4 before that of IPv6; none where it takes no part.
        #[serde(default, deserialize_with = "at_most::<_, _, GROUPS_MAX>")]
        pub groups: Vec<String>,
        /// The addresses that it was told to ask.
        #[serde(default, deserialize_with = "at_most::<_, _, TOLD_MAX>")]
        pub seeds: Vec<String>,
        /// Who tells it where to ask for others, and what came of that.
        #[serde(default, deserialize_with = "at_most::<_, _, SOURCES_MAX>")]
        pub sources: Vec<SourceReport>,
        /// Nodes that it knew and that have not come back, as far as it remembers.
        #[serde(default, deserialize_with = "at_most::<_, _, TOLD_MAX>")]
        pub lost: Vec<LostReport>,
        /// Further ones that had no room.
        #[serde(default)]
        pub lost_left_out: u64,
        /// How often its own NDL was starved, so that it counted nobody as silent.
        #[serde(default)]
        pub own_stalls: Option<StallReport>,
        /// How many of its layers and applications do not get on.
        #[serde(default)]
        pub troubled: u32,
        /// The first of them: four at most.
        #[serde(default, deserialize_with = "at_most::<_, _, TOLD_MAX>")]
        pub troubles: Vec<TroubleReport>,
        /// How many of its clients take nothing of what waits for them.
        #[serde(default)]
        pub idle_clients: u32,
        /// The first of them: two at most.
        #[serde(default, deserialize_with = "at_most::<_, _, TOLD_MAX>")]
        pub idle: Vec<IdleReport>,
        /// Nodes of other projects that it hears.
        #[serde(default, deserialize_with = "at_most::<_, _, TOLD_MAX>")]
        pub foreign: Vec<ForeignReport>,
        /// Further ones that had no room.
        #[serde(default)]
        pub foreign_left_out: u64,
        /// What its layers refused that came from outside, for each cause, the latest first.
        #[serde(default, deserialize_with = "at_most::<_, _, TOLD_MAX>")]
        pub refusals: Vec<RefusalReport>,
        /// Further causes that had no room.
        #[serde(default)]
        pub refusals_left_out: u64,
        /// Types that its applications did not handle or could not read, the latest first; then those that its applications sent, and
        /// receivers at other nodes did not handle or could not read.
        #[serde(default, deserialize_with = "at_most::<_, _, TOLD_MAX>")]
        pub unhandled: Vec<UnhandledReport>,
        /// The nodes that it knows, in the order of their addresses.
        #[serde(deserialize_with = "at_most::<_, _, PEERS_MAX>")]
        pub peers: Vec<PeerReport>,
        /// Further ones that had no room.
        pub left_out: u64,
    }
);

/// What was refused because of one cause.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct RefusalReport {
    /// The cause.
    pub cause: String,
    /// How often.
    pub count: u64,
    /// What the last one was about that was logged.
    pub detail: String,
    /// Time since then.
    pub ago_us: u64,
}

/// Messages of one type that an application did not handle, or could not read.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct UnhandledReport {
    /// The application.
    pub receiver: Tid,
    /// Sender of the latest of them.
    pub sender: Tid,
    /// Their type.
    pub kind: Kind,
    /// Its name, where the node knows it.
    #[serde(default)]
    pub kind_name: Option<String>,
    /// Whether it cannot read them; else it does not handle the type.
    #[serde(default)]
    pub is_malformed: bool,
    /// Number of messages.
    pub count: u64,
    /// Time since the latest.
    pub ago_us: u64,
    /// What mends it.
    #[serde(default)]
    pub remedy: String,
}

payload!("sinew.inspect.apps_report" =>
    /// The applications of a node.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::{AppAddress, Endpoint, Tid, client::ApiError, inspect::{AppsReport, AskApps}, prelude::*};
    ///
    /// /// The applications of a node that are not ready.
    /// fn not_ready(endpoint: &mut Endpoint, node: NodeAddress) -> Result<Vec<Tid>, ApiError> {
    ///     let inspect = Tid::new(node, AppAddress::INSPECT);
    ///     let report: AppsReport = endpoint.message(inspect, &AskApps {}).ask(Duration::from_secs(1))?;
    ///     Ok(report.apps.iter().filter(|app| !app.ready).map(|app| app.tid).collect())
    /// }
    /// ```
    #[derive(Clone, Debug, PartialEq, Eq)]
    pub struct AppsReport {
        /// The node's name.
        pub name: String,
        /// Its applications, in the order of their addresses.
        #[serde(deserialize_with = "at_most::<_, _, APPS_MAX>")]
        pub apps: Vec<AppReport>,
        /// Further ones that had no room.
        pub left_out: u64,
        /// The run-time barriers at which applications of this node wait.
        #[serde(default, deserialize_with = "at_most::<_, _, TOLD_MAX>")]
        pub barriers: Vec<BarrierReport>,
        /// Further ones that had no room.
        #[serde(default)]
        pub barriers_left_out: u64,
    }
);

/// An application, in the node's process or another.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct AppReport {
    /// Its address.
    pub tid: Tid,
    /// Its name, if it has one.
    pub name: Option<String>,
    /// Whether it has started and takes messages.
    pub ready: bool,
    /// How long it has waited at the start-up barrier or at a phase, if it waits there.
    pub waits_us: Option<u64>,
    /// What it lacks of what it requires: before its start what it waits for, later what it lost.
    #[serde(deserialize_with = "at_most::<_, _, MISSING_MAX>")]
    pub missing: Vec<Missing>,
    /// Further ones that had no room.
    #[serde(default)]
    pub missing_left_out: u64,
    /// How its former life ended, while this one is not ready.
    pub ended: Option<String>,
    /// The payloads that it handles, as far as it tells: of one in a process of its own those that it named when it registered.
    #[serde(default, deserialize_with = "at_most::<_, _, KINDS_MAX>")]
    pub kinds: Vec<KindReport>,
    /// Further ones that had no room.
    #[serde(default)]
    pub kinds_left_out: u64,
}

/// A type of payload.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct KindReport {
    /// Its kind.
    pub kind: Kind,
    /// Its name, where the node knows that.
    pub name: Option<String>,
}

/// A run-time barrier at which somebody waits.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct BarrierReport {
    /// The barrier's name.
    pub name: String,
    /// Who has to be there.
    #[serde(deserialize_with = "at_most::<_, _, MISSING_MAX>")]
    pub parties: Vec<String>,
    /// Whether it is a phase.
    #[serde(default)]
    pub is_phase: bool,
    /// How often it has opened, as far as the node knows; of a phase 0.
    pub generation: u64,
    /// Applications of the node that wait there.
    #[serde(deserialize_with = "at_most::<_, _, MISSING_MAX>")]
    pub waiting: Vec<WaitReport>,
    /// Further ones that had no room.
    #[serde(default)]
    pub waiting_left_out: u64,
    /// Who is missing.
    #[serde(deserialize_with = "at_most::<_, _, MISSING_MAX>")]
    pub missing: Vec<Missing>,
    /// Further ones that had no room.
    #[serde(default)]
    pub missing_left_out: u64,
}

/// Who waits at a run-time barrier.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct WaitReport {
    /// Its name, or its address.
    pub name: String,
    /// For how long.
    pub waits_us: u64,
}

/// A name that is required and not ready.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Missing {
    /// The name.
    pub name: String,
    /// The last that is known of it.
    pub why: String,
    /// For how long the node has known that it is missing; not longer than somebody there has waited for it, or lacks it.
    #[serde(default)]
    pub since_us: Option<u64>,
}

payload!("sinew.inspect.tree_report" =>
    /// The supervision tree of a node, each below its supervisor.
    #[derive(Clone, Debug, PartialEq, Eq)]
    pub struct TreeReport {
        /// The node's name.
        pub name: String,
        /// The tree from above, each supervisor's children after it.
        #[serde(deserialize_with = "at_most::<_, _, TREE_MAX>")]
        pub lines: Vec<TreeLine>,
        /// Further ones that had no room.
        pub left_out: u64,
    }
);

/// An actor or a supervisor.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct TreeLine {
    /// How many supervisors are above it.
    pub depth: u32,
    /// Its name.
    pub name: String,
    /// Its address, if it is an application.
    pub tid: Option<Tid>,
    /// Where it is in its life, in words.
    pub state: String,
    /// How long it has been there.
    pub since_us: u64,
    /// Which life of it this is, from 1; 0 before its first.
    pub life: u64,
    /// How often it was started again.
    pub restarts: u64,
    /// How its last life ended.
    pub last_reason: Option<String>,
    /// The name of its thread, or `own process`.
    pub place: Option<String>,
    /// Messages that wait for it.
    pub waiting: Option<u64>,
    /// The most that ever waited at once.
    pub waiting_most: Option<u64>,
    /// Of a supervisor: whom it restarts when one fails.
    pub strategy: Option<String>,
}

payload!("sinew.inspect.audit_report" =>
    /// What became of the messages of a node, as it was at one moment.
    /// [`Audit::of_readings`](crate::audit::Audit::of_readings) puts those of all nodes side by side.
    #[derive(Clone, Debug, PartialEq, Eq)]
    pub struct AuditReport {
        /// What it says of itself. Applications that have no room are counted together.
        pub audit: NodeAudit,
    }
);

payload!("sinew.inspect.watch_report" =>
    /// What an application got and sent.
    #[derive(Clone, Debug, Default, PartialEq, Eq)]
    pub struct WatchReport {
        /// In the order in which it was seen.
        #[serde(deserialize_with = "at_most::<_, _, SEEN_MAX>")]
        pub seen: Vec<SeenMessage>,
        /// Further ones, since the last answer, that had no room.
        pub dropped: u64,
        /// Whether more wait to be asked for.
        pub more: bool,
        /// Why nothing is watched, in words.
        pub refused: Option<String>,
    }
);

/// A message that the routing table of a node handed over, or did not.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct SeenMessage {
    /// Time since then.
    pub seen_us: u64,
    /// How old it was then, in nanoseconds; `None` where that is not known.
    #[serde(default)]
    pub age_ns: Option<u64>,
    /// The error of that at most: 0 for a message of the node's host, `None` where the age is not known.
    #[serde(default)]
    pub age_error_ns: Option<u64>,
    /// Whether the application has sent it; else it was for it.
    pub is_sent: bool,
    /// Who sent it.
    pub source: Tid,
    /// Whom it was for; a group's members get it, too.
    pub target: Tid,
    /// Type of its payload.
    pub kind: Kind,
    /// What that is called, if the node knows.
    pub name: Option<String>,
    /// Its class.
    pub class: Class,
    /// The source's n-th message.
    pub sequence: u64,
    /// `confirm`, `ask`, `reply` or nothing: what is asked of its receiver.
    pub wants: Option<String>,
    /// Length of its payload in bytes.
    pub length: u64,
    /// The payload, unless it is longer than [`SEEN_BYTES_MAX`].
    #[serde(with = "serde_bytes")]
    pub payload: Vec<u8>,
    /// Why it was not taken; else a queue or a connection has it.
    pub refused: Option<Rejection>,
}

/// An answer that has lists, from which what has no room is left out.
pub(super) trait Report {
    /// What it travels in.
    const TRAVELS: Class = Class::Control;

    /// Leaves out the second half of a list; whether there was any.
    fn halve(&mut self) -> bool;
}

fn halve<T>(list: &mut Vec<T>, left_out: &mut u64) -> bool {
    let kept = list.len() / 2;
    *left_out += (list.len() - kept) as u64;
    let had_any = !list.is_empty();
    list.truncate(kept);
    had_any
}

/// A list of a report, and how many further ones had no room in it.
trait Shortened {
    /// How long the list is in the answer, in bytes.
    fn bytes(&self) -> usize;
    /// Leaves out its second half; whether there was any.
    fn halve(&mut self) -> bool;
}

impl<T: Serialize> Shortened for (&mut Vec<T>, &mut u64) {
    fn bytes(&self) -> usize {
        encode(&self.0).len()
    }

    fn halve(&mut self) -> bool {
        halve(self.0, self.1)
    }
}

impl Report for NodeReport {
    /// The list that takes most bytes is halved, so that none is lost to the others. spec: INSPECT-3
    fn halve(&mut self) -> bool {
        // `troubled` and `idle_clients` count those of these two lists already.
        let [mut troubles_left_out, mut idle_left_out, mut unhandled_left_out] = [0_u64; 3];
        let mut lists: [&mut dyn Shortened; 7] = [
            &mut (&mut self.peers, &mut self.left_out),
            &mut (&mut self.lost, &mut self.lost_left_out),
            &mut (&mut self.foreign, &mut self.foreign_left_out),
            &mut (&mut self.refusals, &mut self.refusals_left_out),
            &mut (&mut self.unhandled, &mut unhandled_left_out),
            &mut (&mut self.troubles, &mut troubles_left_out),
            &mut (&mut self.idle, &mut idle_left_out),
        ];
        lists.iter_mut().max_by_key(|list| list.bytes()).is_some_and(|list| list.halve())
    }
}

impl Report for AppsReport {
    /// Before an application or a barrier what the applications handle is left out; then of these two lists the one that takes more bytes is
    /// halved, so that neither is lost to the other.
    fn halve(&mut self) -> bool {
        let mut had_kinds = false;
        for app in &mut self.apps {
            had_kinds |= !app.kinds.is_empty();
            app.kinds_left_out += app.kinds.len() as u64;
            app.kinds.clear();
        }
        if had_kinds {
            return true;
        }
        if encode(&self.barriers).len() > encode(&self.apps).len() {
            return halve(&mut self.barriers, &mut self.barriers_left_out);
        }
        halve(&mut self.apps, &mut self.left_out)
    }
}

impl Report for TreeReport {
    fn halve(&mut self) -> bool {
        halve(&mut self.lines, &mut self.left_out)
    }
}

impl Report for AuditReport {
    fn halve(&mut self) -> bool {
        put_together(&mut self.audit)
    }
}

/// It yields to all that the application sends and gets.
impl Report for WatchReport {
    const TRAVELS: Class = Class::Bulk;

    fn halve(&mut self) -> bool {
        halve(&mut self.seen, &mut self.dropped)
    }
}
