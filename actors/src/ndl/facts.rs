//! What NDL says to the other layers and to applications.

use std::{fmt, net::SocketAddr};

use serde::{Deserialize, Serialize};
use sinew_runtime::{
    tid::{Incarnation, NodeAddress, Tid},
    wire::{Class, Payload},
};

use crate::last_words::LastWords;

/// A change in who is there, told to GNCL and to the sync manager.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum MembershipFact {
    /// A node is there that was not, or is there again in a new life (then `NodeLost` of the old one came before).
    NodeFound {
        node: NodeAddress,
        incarnation: Incarnation,
        /// Where its GNCL listens: the address that it prefers first.
        gncl: Vec<SocketAddr>,
    },
    /// A node is not there any more.
    NodeLost { node: NodeAddress, incarnation: Incarnation, why: LossReason },
}

/// A change in who is there. Applications that handle this payload get it from their node's NDL.
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
    /// A node is there that was not.
    NodeFound {
        /// Its address.
        node: NodeAddress,
        /// Its name.
        name: String,
        /// Which life of it this is.
        incarnation: Incarnation,
    },
    /// A node is not there any more.
    NodeLost {
        /// Its address.
        node: NodeAddress,
        /// Its name.
        name: String,
        /// Which life of it ended.
        incarnation: Incarnation,
        /// How this is known.
        why: LossReason,
        /// Time since its last sign of life, in microseconds.
        silent_us: u64,
        /// Time within which a node that falls silent is lost, with the settings that it was watched with, in microseconds. More only
        /// where this node itself was starved (NDL-4.2), or its connection still stood (NDL-4.5).
        #[serde(default)]
        bound_us: u64,
    },
    /// A layer or an application of a node that lives does not get on. It says so itself, in its answers; but for [`Trouble::Unheard`].
    AppStalled {
        /// The node's address.
        node: NodeAddress,
        /// The node's name.
        name: String,
        /// What does not get on.
        app: Tid,
        /// Its name.
        app_name: String,
        /// What is wrong with it.
        trouble: Trouble,
        /// For how long that had been so when the node said it first, in microseconds.
        since_us: u64,
    },
    /// It gets on again, or is not to be there any more.
    AppResumed {
        /// The node's address.
        node: NodeAddress,
        /// The node's name.
        name: String,
        /// What gets on.
        app: Tid,
        /// Its name.
        app_name: String,
    },
    /// A node is there in a new life: its process ended and was started again.
    NodeRestarted {
        /// Its address.
        node: NodeAddress,
        /// Its name.
        name: String,
        /// Which life of it this is.
        incarnation: Incarnation,
        /// Time since the last sign of the life before, in microseconds. It may be more than `bound_us` where that life was lost, or had left,
        /// before this one came: that was told as [`NodeLost`](Self::NodeLost), unless the application was behind.
        #[serde(default)]
        silent_us: u64,
        /// Time within which that life would have been lost for its silence, as in [`NodeLost`](Self::NodeLost), in microseconds.
        #[serde(default)]
        bound_us: u64,
    },
}

impl Payload for NodeEvent {
    const NAME: &'static str = "sinew.node_event";
    const CLASS: Class = Class::Control;
}

/// Why a layer or an application does not get on.
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
    /// One turn of it (a handler, a timer, a future) has lasted for 250 ms and more.
    Stalled,
    /// It has failed and is started again, or waits for that.
    Down,
    /// It has failed, and is not started again.
    GivenUp,
    /// Only of NDL: it does not answer, while other connections of the node deliver. It hangs, or datagrams do not get through.
    Unheard,
}

/// How a loss was noticed. Its `Display` adds the remedy.
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
    /// It stopped in order.
    Left,
    /// It gave up: its own reason, 200 bytes at most, without control characters. Its process may have to be started again.
    GaveUp(String),
    /// Its process has ended: its host refuses connections to it.
    Crashed,
    /// It missed as many answers in a row as the configuration allows, and its host takes connections for it: its process does not run.
    Hung,
    /// It missed as many, and its host does not answer either, or this node cannot send there.
    LinkDown,
    /// It is there in a new life.
    Restarted,
    /// Another process holds its node address, and held it before: nodes listen to that one.
    Duplicate,
}

impl fmt::Display for LossReason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Left => "it stopped in order",
            Self::GaveUp(words) => return write!(f, "it gave up: {words}"),
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
    /// Whether the node itself announced its end: what it still sends is taken, and it is not asked any more.
    pub(crate) const fn is_announced(&self) -> bool {
        match self {
            Self::Left | Self::GaveUp(_) => true,
            Self::Crashed | Self::Hung | Self::LinkDown | Self::Restarted | Self::Duplicate => false,
        }
    }

    /// The reason of a node that has announced its end. // spec: NDL-4.8
    pub(crate) fn announced(gave_up: Option<LastWords>) -> Self {
        gave_up.map_or(Self::Left, |words| Self::GaveUp(words.into()))
    }
}

#[cfg(test)]
mod tests {
    use sinew_runtime::wire::{decode, encode};

    use super::*;

    /// As it was when it did not say yet how long the life before had been silent.
    #[derive(Debug, PartialEq, Eq, Serialize, Deserialize)]
    enum FormerEvent {
        NodeRestarted { node: NodeAddress, name: String, incarnation: Incarnation },
    }

    #[test]
    fn a_restart_is_understood_by_who_does_not_know_of_silences_and_from_him() {
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
