//! The questions about messages to many, and their answers.

use serde::{Deserialize, Serialize};
use sinew_model::bounded::at_most;
use sinew_runtime::{
    tid::{AppAddress, Tid},
    wire::Payload,
};

use super::{AccessVerdict, Report, access::CLASSES, halve};

/// Maximum number of applications, or groups, in one answer about a message to many.
pub const REACHED_MAX: usize = 256;

/// Asks which applications of the asked node a message from this one to many reaches, and whether it may.
/// [`ReachReport`] answers. No message is sent to them.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub struct AskReach {
    /// The sender.
    pub source: Tid,
    /// The destination on each node: a group, every application ([`AppAddress::ALL`]), or the application at an
    /// address.
    pub to: AppAddress,
}

impl Payload for AskReach {
    const NAME: &'static str = "sinew.inspect.reach";
}

/// Asks for the groups of this application for which the access list's verdict differs from that on messages to the
/// application alone. [`ReachReport`] answers.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub struct AskGroups {
    /// The sender.
    pub source: Tid,
    /// The receiver: an application of the asked node.
    pub member: Tid,
}

impl Payload for AskGroups {
    const NAME: &'static str = "sinew.inspect.groups";
}

/// The applications that messages to many reach at a node, and its access list's verdicts.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ReachReport {
    /// Whether the node has a list; without one everything is allowed.
    pub is_given: bool,
    /// In the order of their addresses; the sender does not receive its own message and is not listed.
    #[serde(deserialize_with = "at_most::<_, _, REACHED_MAX>")]
    pub reached: Vec<Reached>,
    /// Number of further ones that did not fit; for groups, all that a rule names count, regardless of the verdict.
    pub left_out: u64,
}

impl Payload for ReachReport {
    const NAME: &'static str = "sinew.inspect.reach_report";
}

/// An application that receives a message to many, if the list allows it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Reached {
    /// The destination: a group that it is a member of, every application, or its address on each node.
    pub to: AppAddress,
    /// The application.
    pub app: Tid,
    /// The verdict on each class, if there is a list.
    #[serde(deserialize_with = "at_most::<_, _, CLASSES>")]
    pub verdicts: Vec<AccessVerdict>,
}

/// A group of applications that has members on a node.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct GroupReport {
    /// The group. Its name cannot be derived from it.
    pub group: AppAddress,
    /// Number of its members on the node.
    pub members: u64,
}

impl Report for ReachReport {
    fn halve(&mut self) -> bool {
        halve(&mut self.reached, &mut self.left_out)
    }
}
