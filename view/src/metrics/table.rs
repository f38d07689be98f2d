//! All metrics: name, labels, help. The book's page `reference/metrics.md` has the same table.

/// The first part of each name.
pub(super) const PREFIX: &str = "sinew";

/// Whether a value only grows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Shape {
    /// A count since the node's start; its name ends in `_total`.
    Counter,
    /// A value at this moment.
    Gauge,
    /// Counts of times by their length, and their sum, since the node's start; the names of its samples end in
    /// `_bucket`, `_count` and `_sum`.
    Histogram,
}

/// A metric.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Metric {
    /// Its name, without prefix, unit and suffix.
    pub name: &'static str,
    /// Whether it only grows.
    pub shape: Shape,
    /// Whether it is a time in seconds.
    pub is_seconds: bool,
    /// The names of its labels.
    pub labels: &'static [&'static str],
    /// Its meaning.
    pub help: &'static str,
}

impl Metric {
    /// Returns the name of its samples; of a histogram, the part that they share.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew_view::METRICS;
    ///
    /// assert!(METRICS.iter().any(|metric| metric.full_name() == "sinew_peer_round_trip_seconds"));
    /// assert!(METRICS.iter().any(|metric| metric.full_name() == "sinew_restarts_total"));
    /// ```
    #[must_use]
    pub fn full_name(&self) -> String {
        let unit = if self.is_seconds { "_seconds" } else { "" };
        let suffix = if self.shape == Shape::Counter { "_total" } else { "" };
        format!("{PREFIX}_{}{unit}{suffix}", self.name)
    }
}

const fn counter(name: &'static str, labels: &'static [&'static str], help: &'static str) -> Metric {
    Metric { name, shape: Shape::Counter, is_seconds: false, labels, help }
}

const fn gauge(name: &'static str, labels: &'static [&'static str], help: &'static str) -> Metric {
    Metric { name, shape: Shape::Gauge, is_seconds: false, labels, help }
}

const fn seconds(name: &'static str, labels: &'static [&'static str], help: &'static str) -> Metric {
    Metric { name, shape: Shape::Gauge, is_seconds: true, labels, help }
}

const fn times(name: &'static str, labels: &'static [&'static str], help: &'static str) -> Metric {
    Metric { name, shape: Shape::Histogram, is_seconds: true, labels, help }
}

const NODE: &[&str] = &["node"];
const PEER: &[&str] = &["node", "peer"];
const LINK: &[&str] = &["node", "peer", "class"];
const APP: &[&str] = &["node", "app"];
const WHY: &[&str] = &["node", "why"];

pub(super) const ENTRY_UP: Metric =
    gauge("entry_node_up", &[], "Whether the node through which sinew view sees the system answers.");
pub(super) const AGE: Metric = seconds("snapshot_age", &[], "Time since the nodes were asked.");
pub(super) const TOOK: Metric =
    seconds("snapshot_duration", &[], "Time from the first question to the nodes to the last answer.");
pub(super) const SAMPLES_LEFT_OUT: Metric =
    gauge("samples_left_out", &[], "Samples that had no room in this answer.");
pub(super) const LEFT_OUT: Metric =
    gauge("left_out", WHY, "Entries that had no room in the answers of a node, by the kind of entry.");

pub(super) const FOXGLOVE_CLIENTS: Metric =
    gauge("foxglove_clients", &[], "Clients of the server for Foxglove, with --foxglove.");
pub(super) const FOXGLOVE_MESSAGES: Metric =
    counter("foxglove_messages", &[], "Messages that were queued for clients of Foxglove.");
pub(super) const FOXGLOVE_DROPPED: Metric = counter(
    "foxglove_dropped",
    &["why"],
    "Messages that clients of Foxglove did not get: client read too slowly, or journal was not read in time.",
);

pub(super) const NODE_UP: Metric = gauge("node_up", NODE, "Whether the node answers.");
pub(super) const NODE_LOST: Metric =
    gauge("node_lost", WHY, "1 for each lost node that has not returned, with the class of its loss.");
pub(super) const NODE_STOPPING: Metric = gauge("node_stopping", NODE, "Whether the node is about to end.");
pub(super) const NODE_UPTIME: Metric = seconds("node_uptime", NODE, "Time since the node started.");
pub(super) const NODE_STALLS: Metric = counter(
    "node_stalls",
    NODE,
    "How often the node got no CPU for so long that it counted no peer as silent.",
);
pub(super) const NODE_STALL_LONGEST: Metric =
    seconds("node_stall_longest", NODE, "The longest of these times since the node started.");
pub(super) const NODE_TROUBLED: Metric =
    gauge("node_troubled", NODE, "Layers and applications that are stalled, being restarted or given up.");
pub(super) const NODE_FIFO: Metric = gauge(
    "node_fifo_priority",
    NODE,
    "Priority of SCHED_FIFO that the node got when it measured after its start; 0 if it was refused.",
);
pub(super) const NODE_MEMORY: Metric = gauge(
    "node_memory_locked",
    NODE,
    "Whether all memory of the node's process was locked when it measured after its start.",
);
pub(super) const NODE_LATENESS: Metric = seconds(
    "node_wake_lateness",
    &["node", "quantile"],
    "Time by which a thread woke late at 1 kHz after the start of the node.",
);
pub(super) const RECORDER_SEEN: Metric = counter(
    "recorder_messages",
    &["node"],
    "Messages that recordings of the node were to have, as the programs that write them report.",
);
pub(super) const RECORDER_DROPPED: Metric =
    counter("recorder_dropped", &["node"], "Of these, the messages that are in no file.");
pub(super) const RETAINED_VALUES: Metric =
    gauge("retained_values", NODE, "Latest values that the node keeps for later members of groups.");
pub(super) const RETAINED_BYTES: Metric =
    gauge("retained_bytes", NODE, "Bytes of the retained values of the node.");
pub(super) const RETAINED_DROPPED: Metric = counter(
    "retained_dropped",
    WHY,
    "Values that later members may lack: beyond a bound of the node, or the member had no room.",
);
pub(super) const NODE_STOPPED: Metric =
    gauge("node_stopped", NODE, "Whether the stop of the whole system is in force at the node.");
pub(super) const NODE_IDLE_CLIENTS: Metric =
    gauge("node_idle_clients", NODE, "Clients that do not read their queued messages.");
pub(super) const REFUSED: Metric =
    counter("refused", WHY, "Refused inputs from outside, and messages without a receiver, by cause.");

pub(super) const PEER_UP: Metric = gauge("peer_up", PEER, "Whether the node regards the peer as alive.");
pub(super) const PEER_SILENT: Metric =
    seconds("peer_silent", PEER, "Time since the last sign of life of the peer.");
pub(super) const PEER_LOSS_BOUND: Metric = seconds(
    "peer_loss_bound",
    PEER,
    "Time after its last sign of life within which the loss of the peer is detected.",
);
pub(super) const PEER_MISSED: Metric = gauge("peer_missed", PEER, "Consecutive missed answers of the peer.");
pub(super) const PEER_ROUND_TRIP: Metric =
    seconds("peer_round_trip", PEER, "Round-trip time of the last query and its answer on the network.");
pub(super) const CLOCK_OFFSET: Metric =
    seconds("peer_clock_offset", PEER, "The clock of the peer minus the clock of the node.");
pub(super) const CLOCK_OFFSET_BOUND: Metric =
    seconds("peer_clock_offset_bound", PEER, "Maximum error of the clock offset.");
pub(super) const CLOCK_DRIFT: Metric =
    gauge("peer_clock_drift_ratio", PEER, "How much faster the clock of the peer runs; 0.000001 is 1 ppm.");
pub(super) const CLOCK_DRIFT_BOUND: Metric =
    gauge("peer_clock_drift_bound_ratio", PEER, "Maximum error of the clock drift.");
pub(super) const DIALS_FAILED: Metric =
    gauge("peer_dials_failed", PEER, "Failed dials to the peer since the last connection.");
pub(super) const DATAGRAMS_SENT: Metric =
    counter("peer_datagrams_sent", PEER, "Stream values that the node has sent to the peer by datagram.");
pub(super) const DATAGRAMS_ACKED: Metric =
    counter("peer_datagrams_acknowledged", PEER, "Stream values by datagram that the peer has acknowledged.");
pub(super) const LINK_UP: Metric = gauge("link_up", LINK, "Whether the connection of this class is up.");
pub(super) const LINK_DEPTH: Metric =
    gauge("link_queue_depth", LINK, "Messages that wait to be sent on the connection.");
pub(super) const LINK_UNCONFIRMED: Metric =
    gauge("link_unconfirmed", LINK, "Confirmed messages on the connection without an outcome.");

pub(super) const APPS: Metric = gauge("apps", NODE, "Applications of the node.");
pub(super) const APP_READY: Metric =
    gauge("app_ready", APP, "Whether the application has started and accepts messages.");
pub(super) const APP_MISSING: Metric =
    gauge("app_missing", APP, "Requirements of the application that are not met.");
pub(super) const BARRIER_WAIT: Metric = seconds(
    "barrier_wait",
    APP,
    "How long the application has waited: for its start, at a phase or at a barrier.",
);
pub(super) const BARRIER_BLOCKED: Metric =
    seconds("barrier_blocked", APP, "How long an application of the node has lacked this one.");
pub(super) const RESTARTS: Metric =
    counter("restarts", APP, "Restarts of the application, the layer or the supervisor.");
pub(super) const MAILBOX_DEPTH: Metric = gauge("mailbox_depth", APP, "Messages in the mailbox.");
pub(super) const MAILBOX_DEPTH_MAX: Metric =
    gauge("mailbox_depth_max", APP, "The most messages that were ever in the mailbox at once.");
pub(super) const MAILBOX_OLDEST: Metric = seconds(
    "mailbox_oldest",
    APP,
    "Age of the oldest message in the mailbox, since it was sent; 0 if none waits.",
);

pub(super) const APP_AGE: Metric = times(
    "app_message_age",
    APP,
    "Age of each delivered message when its handler was called. An application in a process of its own has none.",
);

pub(super) const GUARD_SAFE: Metric =
    gauge("guard_safe", APP, "Whether an output that the application guards is safe: no command reaches it.");
pub(super) const GUARD_CAUSE: Metric = gauge(
    "guard_safe_cause",
    &["node", "app", "why"],
    "1 for each cause for which an output of the application is safe.",
);
pub(super) const GUARD_FAILED: Metric = gauge(
    "guard_safe_failed",
    APP,
    "Whether the function that makes an output of the application safe has failed and is called again.",
);

pub(super) const APP_MESSAGES: Metric = counter(
    "app_messages",
    &["node", "app", "class", "outcome"],
    "Messages to the application, by class and outcome. A client in a process of its own has class all.",
);
pub(super) const APP_DIRECT: Metric = counter(
    "app_direct_messages",
    &["node", "app", "outcome"],
    "Messages to the application on direct links, by outcome.",
);
pub(super) const PEER_SENT: Metric = counter(
    "peer_messages_sent",
    &["node", "peer", "class", "outcome"],
    "Messages that the node took for the peer, by class and outcome; delivered: acknowledged by the peer.",
);
pub(super) const PEER_RECEIVED: Metric = counter(
    "peer_messages_received",
    &["node", "peer", "class", "outcome"],
    "Messages from the peer, by class and outcome; delivered: forwarded to the destination.",
);

/// All metrics, in the order of the answer.
pub const METRICS: &[Metric] = &[
    ENTRY_UP,
    AGE,
    TOOK,
    SAMPLES_LEFT_OUT,
    LEFT_OUT,
    FOXGLOVE_CLIENTS,
    FOXGLOVE_MESSAGES,
    FOXGLOVE_DROPPED,
    NODE_UP,
    NODE_LOST,
    NODE_STOPPING,
    NODE_UPTIME,
    NODE_STALLS,
    NODE_STALL_LONGEST,
    NODE_FIFO,
    NODE_MEMORY,
    NODE_STOPPED,
    NODE_LATENESS,
    RECORDER_SEEN,
    RECORDER_DROPPED,
    RETAINED_VALUES,
    RETAINED_BYTES,
    RETAINED_DROPPED,
    NODE_TROUBLED,
    NODE_IDLE_CLIENTS,
    REFUSED,
    PEER_UP,
    PEER_SILENT,
    PEER_LOSS_BOUND,
    PEER_MISSED,
    PEER_ROUND_TRIP,
    CLOCK_OFFSET,
    CLOCK_OFFSET_BOUND,
    CLOCK_DRIFT,
    CLOCK_DRIFT_BOUND,
    DIALS_FAILED,
    DATAGRAMS_SENT,
    DATAGRAMS_ACKED,
    LINK_UP,
    LINK_DEPTH,
    LINK_UNCONFIRMED,
    APPS,
    APP_READY,
    APP_MISSING,
    BARRIER_WAIT,
    BARRIER_BLOCKED,
    RESTARTS,
    MAILBOX_DEPTH,
    MAILBOX_DEPTH_MAX,
    MAILBOX_OLDEST,
    APP_AGE,
    GUARD_SAFE,
    GUARD_CAUSE,
    GUARD_FAILED,
    APP_MESSAGES,
    APP_DIRECT,
    PEER_SENT,
    PEER_RECEIVED,
];
