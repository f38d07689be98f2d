//! The facts and events of NDL for other layers and applications.

use std::{fmt, net::SocketAddr};

use serde::{Deserialize, Serialize};
use sinew_runtime::{
    tid::{Incarnation, NodeAddress, Tid},
    wire::{Class, Payload},
};

use crate::leave_reason::LeaveReason;

/// A membership change, sent to GNCL and to the sync manager.
#[derive(Clone, Debug, PartialEq, Eq)]
#[expect(missing_docs, reason = "each field is what its name says")]
pub enum MembershipFact {
    /// A node was found, possibly in a new incarnation. `NodeLost` of the old incarnation came before.
    NodeFound {
        node: NodeAddress,
        incarnation: Incarnation,
        /// Addresses at which its GNCL listens, the preferred one first.
        gncl: Vec<SocketAddr>,
    },
    /// A node was lost.
    NodeLost { node: NodeAddress, incarnation: Incarnation, why: LossReason },
}

/// A membership change. Applications that handle this payload receive it from their node's NDL.
///
/// # Examples
///
/// ```
/// use sinew::prelude::*;
///
/// struct Gait;
/// # impl Actor for Gait { type Context = AppContext<Self>; }
///
/// impl Handler<Delivery<NodeEvent>> for Gait {
///     type Result = ();
///     fn handle(&mut self, event: Delivery<NodeEvent>, _: &mut Self::Context) {
///         if let NodeEvent::NodeLost { name, why, silent_us, .. } = &event.payload {
///             println!("node {name} is lost after {silent_us} us of silence: {why}");
///         }
///     }
/// }
///
/// let gait = AppSpec::new("gait", || Gait).handles::<NodeEvent>();
/// ```
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum NodeEvent {
    /// A node was found.
    NodeFound {
        /// Address of the node.
        node: NodeAddress,
        /// Name of the node.
        name: String,
        /// Incarnation of the node.
        incarnation: Incarnation,
    },
    /// A node was lost.
    NodeLost {
        /// Address of the node.
        node: NodeAddress,
        /// Name of the node.
        name: String,
        /// Incarnation that ended.
        incarnation: Incarnation,
        /// Reason of the loss.
        why: LossReason,
        /// Time since its last sign of life, in microseconds.
        silent_us: u64,
        /// Time after which a silent node is lost, with the settings that it was watched with, in
        /// microseconds. `silent_us` exceeds it only if this node itself was starved (NDL-4.2), or if the
        /// connection was still established (NDL-4.5).
        #[serde(default)]
        bound_us: u64,
    },
    /// A layer or an application of a live node is stalled. The node reports it itself in its answers, except
    /// [`Trouble::Unheard`].
    AppStalled {
        /// The node's address.
        node: NodeAddress,
        /// The node's name.
        name: String,
        /// The stalled layer or application.
        app: Tid,
        /// Name of the layer or application.
        app_name: String,
        /// Trouble of the layer or application.
        trouble: Trouble,
        /// Duration of the trouble when the node first reported it, in microseconds.
        since_us: u64,
    },
    /// A layer or an application runs again, or is not meant to be present any more.
    AppResumed {
        /// The node's address.
        node: NodeAddress,
        /// The node's name.
        name: String,
        /// The layer or application that runs again.
        app: Tid,
        /// Name of the layer or application.
        app_name: String,
    },
    /// A node is present in a new incarnation: its process ended and was restarted.
    NodeRestarted {
        /// Address of the node.
        node: NodeAddress,
        /// Name of the node.
        name: String,
        /// New incarnation of the node.
        incarnation: Incarnation,
        /// Time since the last sign of life of the previous incarnation, in microseconds. It may exceed
        /// `bound_us` if that incarnation was lost or had left before this one started. That loss was sent as
        /// [`NodeLost`](Self::NodeLost), unless the application was behind.
        #[serde(default)]
        silent_us: u64,
        /// Time after which the previous incarnation would have been lost for its silence, as in
        /// [`NodeLost`](Self::NodeLost), in microseconds.
        #[serde(default)]
        bound_us: u64,
    },
}

impl Payload for NodeEvent {
    const NAME: &'static str = "sinew.node_event";
    const CLASS: Class = Class::Control;
}

/// The trouble of a stalled layer or application.
///
/// # Examples
///
/// ```
/// use sinew::events::{NodeEvent, Trouble};
///
/// fn needs_service(event: &NodeEvent) -> bool {
///     matches!(event, NodeEvent::AppStalled { trouble: Trouble::GivenUp, .. })
/// }
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub enum Trouble {
    /// One turn of the part (a handler, a timer, a future) has lasted for 250 ms and more.
    Stalled,
    /// The part has failed, and is being restarted or waits for its restart.
    Down,
    /// The part has failed, and is not restarted.
    GivenUp,
    /// For NDL only: it does not answer, while other connections of the node deliver. NDL hangs, or datagrams are lost.
    Unheard,
}

/// The cause of a loss. Its `Display` adds the remedy.
///
/// # Examples
///
/// ```
/// use sinew::events::LossReason;
///
/// /// Whether a cable or a radio is to be looked at.
/// fn is_the_network(why: &LossReason) -> bool {
///     matches!(why, LossReason::LinkDown)
/// }
/// assert_eq!(LossReason::Left.to_string(), "it stopped in order");
/// ```
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum LossReason {
    /// The node stopped in order.
    Left,
    /// The node gave up. The text is its own reason, of 200 bytes at most, without control characters. Its
    /// process may have to be restarted.
    GaveUp(String),
    /// The node's process has ended: its host refuses connections to it.
    Crashed,
    /// The node missed the configured number of consecutive answers, and its host accepts connections for it:
    /// its process does not run.
    Hung,
    /// The node missed that number of answers, and its host does not respond either, or this node cannot send there.
    LinkDown,
    /// The node is present in a new incarnation.
    Restarted,
    /// Another process holds its node address, and held it before. Other nodes accept that process.
    Duplicate,
}

impl fmt::Display for LossReason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Left => "it stopped in order",
            Self::GaveUp(reason) => return write!(f, "it gave up: {reason}"),
            Self::Crashed => {
                "its process has ended, nothing listens at its address; start it again, its log says why it ended"
            }
            Self::Hung => {
                "it does not answer, and its host does; is its process stopped (SIGSTOP), in a debugger, or without a CPU?"
            }
            Self::LinkDown => {
                "neither it nor its host answers; is the cable in, the interface up (`ip link`), its host on?"
            }
            Self::Restarted => "its process ended without a stop, and was started again",
            Self::Duplicate => {
                "another process holds its node address; give one of the two another `address` under [node]"
            }
        })
    }
}

impl LossReason {
    /// Returns whether the node itself announced its end. Its remaining data is accepted, and it is not
    /// queried any more.
    pub const fn is_announced(&self) -> bool {
        match self {
            Self::Left | Self::GaveUp(_) => true,
            Self::Crashed | Self::Hung | Self::LinkDown | Self::Restarted | Self::Duplicate => false,
        }
    }

    /// Returns the reason for a node that announced its end. // spec: NDL-4.8
    pub fn announced(gave_up: Option<LeaveReason>) -> Self {
        gave_up.map_or(Self::Left, |reason| Self::GaveUp(reason.into()))
    }
}

#[cfg(test)]
mod tests {
    use sinew_runtime::wire::{decode, encode};

    use super::*;

    /// The former format, without the silence of the previous incarnation.
    #[derive(Debug, PartialEq, Eq, Serialize, Deserialize)]
    enum FormerEvent {
        NodeRestarted { node: NodeAddress, name: String, incarnation: Incarnation },
    }

    #[test]
    fn restart_without_silence_is_understood_in_both_directions() {
        let (node, incarnation) = (NodeAddress::new(7), Incarnation(2));
        let name = || "knee".to_owned();
        let former = FormerEvent::NodeRestarted { node, name: name(), incarnation };
        let of_silence = |silent_us, bound_us| {
            let name = name();
            NodeEvent::NodeRestarted { node, name, incarnation, silent_us, bound_us }
        };
        let from_him: NodeEvent = decode(&encode(&former)).expect("what he does not say is 0");
        assert_eq!(from_him, of_silence(0, 0));
        let bytes = encode(&of_silence(5, 9));
        let to_him: FormerEvent = decode(&bytes).expect("what he does not know is skipped");
        assert_eq!(to_him, former);
    }
}
