//! The outcomes of a confirmed message at each of its members: the reports on the wire, and the table that
//! collects them. Pure.
//!
//! A message to a group, to every application, or to one address on all nodes is one send with one outcome
//! for each member. A report is about one member, or about one node that has members:
//!
//! ```text
//!  TID (8)   state (1)       for each report: 9 bytes, little-endian; 128 in one frame at most
//! ```
//!
//! | state | of a member | of a node (its application address is 0) |
//! | --- | --- | --- |
//! | an outcome's code | its outcome | the outcome of the node's copy: it applies to members that have no outcome of their own |
//! | `0xfe` | | all of its members have been reported |
//! | `0xff` | it has a copy | it has a copy, and reports its members itself |

use std::collections::{BTreeMap, BTreeSet};

use super::Outcome;
use crate::tid::{AppAddress, NodeAddress, Tid};

/// Maximum number of members and nodes in one table, and so of entries in one list. Members above it are
/// unknown, through an entry of their node.
pub const MEMBERS_MAX: usize = 4_096;
/// Maximum number of reports in one frame, small enough for the control frames of every layer.
pub const REPORTS_MAX: usize = 128;

/// Bytes of one report.
const EACH: usize = 9;
const LISTED: u8 = 0xfe;
const PENDING: u8 = 0xff;

/// The outcome of a confirmed message at one of its members.
///
/// If a node did not list its members, the entry has the node's address and the application address of the
/// message's destination. It represents all members of that node.
///
/// # Examples
///
/// ```
/// use sinew::{Outcome, Tid, message::MemberOutcome};
///
/// /// The drives that may still move.
/// fn not_stopped(members: &[MemberOutcome]) -> Vec<Tid> {
///     let failed = members.iter().filter(|member| member.outcome != Outcome::Delivered);
///     failed.map(|member| member.tid).collect()
/// }
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct MemberOutcome {
    /// The TID of the member.
    pub tid: Tid,
    /// The outcome of its copy.
    pub outcome: Outcome,
}

/// The state of a member, or of a node.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MemberState {
    /// The member or node has a copy, and no outcome yet.
    Pending,
    /// For a node: all of its members have been reported.
    Listed,
    /// The copy has this outcome.
    Settled(Outcome),
}

/// One report about a member, or about a node, which has the application address [`AppAddress::NONE`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MemberReport {
    /// The TID of the member or node.
    pub tid: Tid,
    /// The state of the member or node.
    pub state: MemberState,
}

impl MemberReport {
    /// Creates a report about a member.
    #[must_use]
    pub const fn of_member(tid: Tid, state: MemberState) -> Self {
        Self { tid, state }
    }

    /// Creates a report about a node.
    #[must_use]
    pub const fn of_node(node: NodeAddress, state: MemberState) -> Self {
        Self { tid: Tid::new(node, AppAddress::NONE), state }
    }

    /// Encodes the reports of one frame.
    #[must_use]
    pub fn encode(reports: &[Self]) -> Vec<u8> {
        let mut bytes = Vec::with_capacity(EACH * reports.len());
        for Self { tid, state } in reports {
            bytes.extend_from_slice(&tid.bits().to_le_bytes());
            bytes.push(match state {
                MemberState::Pending => PENDING,
                MemberState::Listed => LISTED,
                MemberState::Settled(outcome) => outcome.code(),
            });
        }
        bytes
    }

    /// Decodes the reports of one frame, and skips states that this version does not know. Returns `None` if
    /// the payload is empty, has an incomplete report, or has more than [`REPORTS_MAX`] reports.
    #[must_use]
    pub fn decode(payload: &[u8]) -> Option<Vec<Self>> {
        let (reports, rest) = payload.as_chunks::<EACH>();
        let is_right = rest.is_empty() && (1..=REPORTS_MAX).contains(&reports.len());
        is_right.then(|| reports.iter().filter_map(Self::decode_one).collect())
    }

    /// Returns how many reports fit in a payload of this length: at least one, at most [`REPORTS_MAX`].
    #[must_use]
    pub const fn in_payload(payload_max: usize) -> usize {
        let fitting = payload_max / EACH;
        if fitting == 0 {
            1
        } else if fitting < REPORTS_MAX {
            fitting
        } else {
            REPORTS_MAX
        }
    }

    fn decode_one(bytes: &[u8; EACH]) -> Option<Self> {
        let [tid @ .., code] = *bytes;
        let state = match code {
            PENDING => MemberState::Pending,
            LISTED => MemberState::Listed,
            code => MemberState::Settled(Outcome::from_code(code)?),
        };
        Some(Self { tid: Tid::from_bits(u64::from_le_bytes(tid)), state })
    }
}

/// The state of a node.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum NodeState {
    /// The node has not listed all of its members.
    Pending,
    /// The node has listed its members, and the outcome of its copy is unknown.
    Listed,
    /// The outcome of the node's copy arrived.
    Settled { listed: bool, outcome: Outcome },
}

/// The members of one confirmed message, and their outcomes as far as they are known.
///
/// Reports may come in any order and more than once: the first outcome of a member counts.
#[derive(Debug)]
pub struct MemberTable {
    destination: Tid,
    /// The node of the sender.
    here: NodeAddress,
    members: BTreeMap<Tid, Option<Outcome>>,
    nodes: BTreeMap<NodeAddress, NodeState>,
    /// Nodes with members for which the table had no room.
    cut: BTreeSet<NodeAddress>,
    members_max: usize,
}

impl MemberTable {
    /// Creates the table of a message from an application of the node at `here` to `destination`. No member
    /// is known before that node reports.
    #[must_use]
    pub fn new(destination: Tid, here: NodeAddress) -> Self {
        Self::bounded(destination, here, MEMBERS_MAX)
    }

    fn bounded(destination: Tid, here: NodeAddress, members_max: usize) -> Self {
        let nodes = BTreeMap::from([(here, NodeState::Pending)]);
        Self { destination, here, members: BTreeMap::new(), nodes, cut: BTreeSet::new(), members_max }
    }

    /// Applies reports. Reports of a node that was not reported before are ignored, as are further members of
    /// a full table.
    pub fn note(&mut self, reports: &[MemberReport]) {
        for report in reports {
            if report.tid.app == AppAddress::NONE {
                self.note_node(report.tid.node, report.state);
            } else {
                self.note_member(report.tid, report.state);
            }
        }
    }

    fn note_node(&mut self, node: NodeAddress, state: MemberState) {
        let has_room = !self.is_full();
        match (self.nodes.get_mut(&node), state) {
            (None, MemberState::Pending) if has_room => {
                self.nodes.insert(node, NodeState::Pending);
            }
            (Some(known @ NodeState::Pending), MemberState::Listed) => *known = NodeState::Listed,
            (Some(known @ (NodeState::Pending | NodeState::Listed)), MemberState::Settled(outcome)) => {
                *known = NodeState::Settled { listed: *known == NodeState::Listed, outcome };
            }
            (Some(NodeState::Settled { listed, .. }), MemberState::Listed) => *listed = true,
            // The node was reported before, or has no copy.
            (None | Some(_), MemberState::Pending | MemberState::Listed | MemberState::Settled(_)) => {}
        }
    }

    fn note_member(&mut self, tid: Tid, state: MemberState) {
        let outcome = match state {
            MemberState::Pending => None,
            MemberState::Settled(outcome) => Some(outcome),
            MemberState::Listed => return,
        };
        let is_full = self.is_full();
        match self.members.get_mut(&tid) {
            Some(known) => *known = known.or(outcome),
            None if !self.nodes.contains_key(&tid.node) => {}
            None if is_full => {
                self.cut.insert(tid.node);
            }
            None => {
                self.members.insert(tid, outcome);
            }
        }
    }

    fn is_full(&self) -> bool {
        self.members.len() + self.nodes.len() >= self.members_max
    }

    /// Returns whether the table is complete: every node has listed its members, or no longer can, and each
    /// member has an outcome.
    #[must_use]
    pub fn is_complete(&self) -> bool {
        let is_known = self.nodes.values().all(|state| *state != NodeState::Pending);
        is_known && self.members.keys().all(|tid| self.outcome_of(*tid).is_some())
    }

    /// Returns the outcome of a member: its own, or that of its node's copy. A delivered copy is no outcome
    /// of a member that has none of its own.
    fn outcome_of(&self, tid: Tid) -> Option<Outcome> {
        let own = self.members.get(&tid).copied().flatten();
        own.or_else(|| match self.nodes.get(&tid.node) {
            Some(NodeState::Settled { outcome, .. }) if *outcome != Outcome::Delivered => Some(*outcome),
            Some(NodeState::Settled { .. } | NodeState::Listed | NodeState::Pending) | None => None,
        })
    }

    /// Returns one entry per member, in the order of TIDs. `last` is the outcome of the message as a whole,
    /// `None` at its deadline.
    ///
    /// A member without an outcome gets `last`, or [`Outcome::Unknown`] if `last` is `None` or
    /// [`Outcome::Delivered`]. A node that has not listed its members gets one entry for all of them in the
    /// same way.
    #[must_use]
    pub fn finish(mut self, last: Option<Outcome>) -> Vec<MemberOutcome> {
        if self.destination.is_single() {
            return vec![MemberOutcome { tid: self.destination, outcome: last.unwrap_or(Outcome::Unknown) }];
        }
        let rest = last.filter(|last| *last != Outcome::Delivered).unwrap_or(Outcome::Unknown);
        let mut all: BTreeMap<Tid, Outcome> =
            self.members.keys().map(|tid| (*tid, self.outcome_of(*tid).unwrap_or(rest))).collect();
        for (node, state) in std::mem::take(&mut self.nodes) {
            let outcome = match state {
                NodeState::Listed | NodeState::Settled { listed: true, .. } => {
                    if self.cut.contains(&node) {
                        Outcome::Unknown
                    } else {
                        continue;
                    }
                }
                NodeState::Settled { listed: false, outcome } if outcome != Outcome::Delivered => outcome,
                NodeState::Pending | NodeState::Settled { .. } => rest,
            };
            let tid = if node == self.here { self.destination } else { Tid::new(node, self.destination.app) };
            all.entry(tid).or_insert(outcome);
        }
        all.into_iter().map(|(tid, outcome)| MemberOutcome { tid, outcome }).collect()
    }
}

#[cfg(test)]
mod tests;
