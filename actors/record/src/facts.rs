//! The facts that a journal has besides messages. They are written as MessagePack.

use serde::{Deserialize, Serialize};
use sinew_runtime::tid::{AppAddress, Incarnation, NodeAddress};

use crate::channel::Form;

/// A fact of one form.
pub trait Fact: Serialize + for<'de> Deserialize<'de> {
    /// The form of its records.
    const FORM: Form;
}

/// A change on the node, or of another node, as this node knows it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[expect(missing_docs, reason = "each field is what its name says")]
pub enum NodeFact {
    /// The recording began.
    Began { node: NodeAddress, name: String, project: String, incarnation: Incarnation },
    /// Another node is present.
    NodeFound { node: NodeAddress, name: String, incarnation: Incarnation },
    /// Another node is not present any more.
    NodeLost { node: NodeAddress, name: String, incarnation: Incarnation, why: String },
    /// An application has a name, on this node or another one.
    AppNamed { node: NodeAddress, app: AppAddress, name: String, is_ready: bool },
    /// An application has the name no more.
    AppGone { node: NodeAddress, app: AppAddress, name: String },
    /// An actor of this node's process was restarted; `why` is how its last incarnation ended. `app` is the address of
    /// an application; layers and supervisors have none.
    Restarted {
        node: NodeAddress,
        app: Option<AppAddress>,
        name: String,
        supervisor: String,
        restarts: u64,
        why: String,
    },
    /// The state of a barrier has changed: its open generation, the waiting applications and the missing ones.
    Barrier { name: String, generation: u64, waiting: Vec<String>, missing: Vec<String> },
    /// The name of a payload type.
    TypeNamed { kind: u32, name: String },
    /// A trigger to freeze the span around the time of this record, which may be wrong by `bound_ns`.
    Triggered { id: String, cause: String, bound_ns: u64 },
}

impl Fact for NodeFact {
    const FORM: Form = Form::Node;
}

/// The clocks at the time of the record.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct ClockFact {
    /// Nanoseconds from this host's monotonic clock to its wall clock.
    pub wall_offset_ns: i64,
    /// The clocks of other nodes, relative to this one's.
    pub peers: Vec<PeerClock>,
}

impl Fact for ClockFact {
    const FORM: Form = Form::Clock;
}

/// The monotonic clock of another node.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct PeerClock {
    /// The other node.
    pub node: NodeAddress,
    /// The incarnation of it.
    pub incarnation: Incarnation,
    /// Its clock less this node's, in nanoseconds.
    pub theirs_minus_ours_ns: i64,
    /// The largest error of this, in nanoseconds.
    pub bound_ns: u64,
    /// How fast its clock gains on this node's, in parts per billion.
    #[serde(default)]
    pub drift_ppb: i64,
    /// The largest error of that. 200,000 with a drift of 0: the drift is unknown.
    #[serde(default)]
    pub drift_bound_ppb: u64,
}

/// A line of the node's log.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct LogFact {
    /// `error`, `warn`, `info`, `debug` or `trace`.
    pub level: String,
    /// The module that wrote it.
    pub target: String,
    /// The text with its fields.
    pub text: String,
}

impl Fact for LogFact {
    const FORM: Form = Form::Log;
}
