//! The audit of the whole system: the reports of all nodes, compared.

use std::collections::BTreeSet;

use serde::{Deserialize, Serialize};
use sinew_runtime::{tid::NodeAddress, wire::Class};
use sinew_session::{counts::Account, place::Place};

use super::{compare, reading::NodeAudit};

/// The location of every message that was ever sent, as far as the nodes report it. `{}` displays it as a
/// table; serde can serialize every field, for example as JSON.
///
/// # Examples
///
/// ```
/// use sinew::audit::Audit;
///
/// fn report(audit: &Audit) {
///     let total = audit.total();
///     println!("{} taken, {} delivered, {} expired", total.taken, total.delivered, total.expired);
///     for unexplained in &audit.unexplained {
///         eprintln!("{:?} lacks {} messages", unexplained.at, unexplained.messages);
///     }
/// }
/// ```
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Audit {
    /// The node that ran the audit.
    pub asked_by: NodeAddress,
    /// The report of each node about itself.
    pub nodes: Vec<NodeAudit>,
    /// Known nodes that did not answer: too slow, too old to know the question, or without a connection.
    pub silent: Vec<NodeAddress>,
    /// Both ends of each link, compared.
    pub links: Vec<Link>,
    /// Messages that are not accounted for. Empty if all is well.
    pub unexplained: Vec<Unexplained>,
}

/// One direction of a link between two nodes: the messages that the sender counts as sent, and the receiver as taken.
///
/// # Examples
///
/// ```
/// use sinew::audit::Audit;
///
/// /// Messages that were sent and are not acknowledged yet.
/// fn under_way(audit: &Audit) -> u64 {
///     audit.links.iter().map(|link| link.sent - link.acknowledged).sum()
/// }
/// ```
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Link {
    /// The sending node.
    pub from: NodeAddress,
    /// The receiving node.
    pub to: NodeAddress,
    /// The class of the messages; `None` if the link carries all classes.
    pub class: Option<Class>,
    /// Whether the two ends can be compared.
    pub state: LinkState,
    /// Messages, and voids in the place of some, that the sender has numbered since the session began.
    pub sent: u64,
    /// Of these, the acknowledged ones.
    pub acknowledged: u64,
    /// Messages that the receiver has taken, if both ends report the same session.
    pub taken: Option<u64>,
}

/// Whether the two ends of a link report the same session.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum LinkState {
    /// The same session.
    OneSession,
    /// One end has started a new session, and the other does not know it yet: messages in flight end as `Unknown`.
    BegunAnew,
    /// The other end does not report this link.
    OneEndOnly,
}

/// Messages that are not accounted for.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Unexplained {
    /// The place or link.
    pub at: At,
    /// The number of missing messages; negative for surplus messages.
    pub messages: i64,
}

/// The place or link at which messages are not accounted for.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum At {
    /// Messages were taken in a place, and neither ended nor wait.
    Place {
        /// The node.
        node: NodeAddress,
        /// The place on the node.
        place: Place,
    },
    /// One end reports that messages arrived, and the other that they did not.
    Link {
        /// The sending node.
        from: NodeAddress,
        /// The receiving node.
        to: NodeAddress,
        /// The class of the messages; `None` if the link carries all classes.
        class: Option<Class>,
    },
}

impl Audit {
    /// Compares two readings of these nodes: all of `before` were read before any of `after`. A node that is
    /// not in both of them with the same incarnation counts as silent.
    #[must_use]
    pub fn of_readings(
        asked_by: NodeAddress,
        asked: &BTreeSet<NodeAddress>,
        before: &[NodeAudit],
        mut after: Vec<NodeAudit>,
    ) -> Self {
        let is_same_life = |node: &NodeAudit| {
            before.iter().any(|former| (former.node, former.incarnation) == (node.node, node.incarnation))
        };
        after.retain(is_same_life);
        after.sort_by_key(|node| node.node);
        let silent = asked.iter().filter(|asked| after.iter().all(|node| node.node != **asked));
        let silent = silent.copied().collect();
        Self::of(asked_by, before, after, silent)
    }

    /// Requires that each node of `after` was also read in `before`.
    pub(super) fn of(
        asked_by: NodeAddress,
        before: &[NodeAudit],
        after: Vec<NodeAudit>,
        silent: Vec<NodeAddress>,
    ) -> Self {
        let (links, unexplained) = (compare::links(&after), compare::unexplained(before, &after));
        Self { asked_by, nodes: after, silent, links, unexplained }
    }

    /// Returns the number of messages that are not accounted for: 0 if all is well. Missing and surplus
    /// messages do not cancel each other out.
    #[must_use]
    pub fn missing(&self) -> u64 {
        self.unexplained.iter().fold(0, |sum, found| sum.saturating_add(found.messages.unsigned_abs()))
    }

    /// Returns the outcomes of the messages of all nodes. Each message is counted once, even if it was sent
    /// from one node to another.
    ///
    /// Exact once no message is in flight and as long as no session was restarted. After a restart, some
    /// messages that ended as unknown may have arrived, and messages that had arrived in the former session
    /// are counted twice.
    #[must_use]
    pub fn total(&self) -> Account {
        self.nodes
            .iter()
            .flat_map(|node| node.entries.iter().map(|entry| self.part(node, &entry.place, entry.account)))
            .sum()
    }

    /// Returns the part of a place in the total.
    fn part(&self, node: &NodeAudit, place: &Place, account: Account) -> Account {
        let has = |address: NodeAddress| self.nodes.iter().find(|other| other.node == address);
        match place {
            Place::ToNode { node: to, class } => match has(*to) {
                // Messages that have arrived are counted by the other node.
                Some(to) => {
                    let there = to.account(&Place::FromNode { node: node.node, class: *class }).taken;
                    let sent = account.delivered.wrapping_add(account.unacknowledged);
                    let not_there = sent.saturating_sub(there);
                    // Acknowledged messages are not in flight any more: the other node has started a new
                    // session and counts them elsewhere.
                    let unacknowledged = account.unacknowledged.min(not_there);
                    Account { delivered: not_there - unacknowledged, unacknowledged, ..account }
                }
                None => account,
            },
            Place::FromNode { node: from, .. } => {
                let delivered = account.delivered.wrapping_sub(account.handed_on);
                let taken = if has(*from).is_some() { 0 } else { account.taken };
                Account { taken: taken.wrapping_sub(account.handed_on), delivered, handed_on: 0, ..account }
            }
            Place::FromFormerNodes => {
                let delivered = account.delivered.wrapping_sub(account.handed_on);
                let taken = account.taken.wrapping_sub(account.handed_on);
                Account { taken, delivered, handed_on: 0, ..account }
            }
            Place::Mailbox { .. }
            | Place::Client { .. }
            | Place::DirectLink { .. }
            | Place::OtherMailboxes
            | Place::OtherClients
            | Place::OtherDirectLinks
            | Place::ToFormerNodes => account,
        }
    }
}
