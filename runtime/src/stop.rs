//! The messages by which the stop of the whole system is pressed, released, acknowledged and shown.
//!
//! A stop is no safety function. It makes guarded outputs safe, says which nodes confirmed that, and keeps them safe
//! until it is released and each application acknowledges it. The latch that the outputs of a node read is
//! [`StopLatch`](crate::protection::StopLatch).
//!
//! They go to `node/stop` of the sender's own node.

use serde::{Deserialize, Serialize};

use crate::{
    tid::{Incarnation, NodeAddress, Tid},
    wire::Payload,
};

/// Presses the stop of the whole system; [`StopReport`] is the reply, as soon as all nodes have confirmed, or
/// `within_ms` later.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct PressStop {
    /// The reason, for logs and reports; of a longer one the first 200 bytes are kept.
    pub reason: String,
    /// How long the node waits for the confirmations, in milliseconds; at most 60,000.
    pub within_ms: u32,
}

/// Releases the stop: all presses that the node knows. Only an operator may; [`StopReport`] is the reply.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct ReleaseStop {
    /// How long the node waits until all nodes have released, in milliseconds; at most 60,000.
    pub within_ms: u32,
}

/// Asks for the state of the stop; [`StopReport`] is the reply.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct AskStop {}

/// Acknowledges, for an application in a process of its own, a stop that is released. Until then its node hands over no
/// echo of it, so that its outputs cannot be armed. It ends as `Delivered`, or as `ByHandler` while a stop is in force.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct AcknowledgeStop {}

/// Whether a node is stopped.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum StopState {
    /// Outputs may be armed.
    Released,
    /// No press is known. Outputs stay as they are and cannot be armed: the node does not know yet whether the others
    /// are stopped.
    Held,
    /// A stop is in force.
    Stopped,
}

/// The state of the stop, as one node knows it.
///
/// # Examples
///
/// ```
/// use sinew::stop::StopReport;
///
/// /// Names the nodes that may still move.
/// fn unconfirmed(report: &StopReport) -> Vec<&str> {
///     report.nodes.iter().filter(|node| node.confirmed_us.is_none()).map(|node| node.name.as_str()).collect()
/// }
/// ```
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct StopReport {
    /// The state of this node.
    pub state: StopState,
    /// The presses that are not released; at most 128.
    pub presses: Vec<StopPress>,
    /// This node first, then the others that it knows; at most 1,024.
    pub nodes: Vec<StopNode>,
    /// Why nothing was done; `None`: it was done, or nothing was asked.
    pub refused: Option<String>,
}

impl StopReport {
    /// Returns whether the system is stopped and every known node has confirmed that its outputs are safe.
    #[must_use]
    pub fn is_confirmed(&self) -> bool {
        self.state == StopState::Stopped && self.nodes.iter().all(|node| node.confirmed_us.is_some())
    }
}

/// A press that is not released.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct StopPress {
    /// The node where it was pressed.
    pub node: NodeAddress,
    /// The incarnation of that node.
    pub incarnation: Incarnation,
    /// Its number in that incarnation, from 1 on.
    pub number: u32,
    /// The application that pressed.
    pub by: Tid,
    /// Its reason.
    pub reason: String,
}

/// One node's part in the stop.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct StopNode {
    /// The node.
    pub node: NodeAddress,
    /// Its name.
    pub name: String,
    /// Its state, as last received; `None`: nothing was received from this incarnation.
    pub state: Option<StopState>,
    /// Time from the newest press, as the reporting node learned of it, until the confirmation of this node was there,
    /// in microseconds; `None`: it has not confirmed, no stop is in force, or this is the reporting node and it has
    /// just started: it may not know all others.
    pub confirmed_us: Option<u64>,
    /// Time that the node itself needed from its own knowledge of the press until its outputs were safe, in
    /// microseconds.
    pub safe_us: Option<u64>,
    /// Number of guarded outputs in its process.
    pub outputs: u32,
    /// Time after the press within which its own watchdogs make its outputs safe although it has not confirmed, in
    /// microseconds; `None`: no such time is known.
    pub bound_us: Option<u64>,
    /// Why it has not confirmed, or from where the bound is, in words; empty if it has confirmed.
    pub note: String,
}

impl Payload for PressStop {
    const NAME: &'static str = "sinew.stop.press";
}

impl Payload for ReleaseStop {
    const NAME: &'static str = "sinew.stop.release";
}

impl Payload for AcknowledgeStop {
    const NAME: &'static str = "sinew.stop.acknowledge";
}

impl Payload for AskStop {
    const NAME: &'static str = "sinew.stop.ask";
}

impl Payload for StopReport {
    const NAME: &'static str = "sinew.stop.report";
}
