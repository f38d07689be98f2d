//! The audit of the whole system: what all nodes say, side by side.

use std::collections::BTreeSet;

use serde::{Deserialize, Serialize};
use sinew_runtime::{tid::NodeAddress, wire::Class};

use super::{
    account::{Account, Place},
    compare,
    reading::NodeAudit,
};

/// Where every message is that was ever sent, as far as the nodes say. Shown with `{}` it is a table to read; every field can be written by
/// serde, as JSON for instance.
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
    /// The node that has asked.
    pub asked_by: NodeAddress,
    /// What each node says of itself.
    pub nodes: Vec<NodeAudit>,
    /// Nodes that are there and did not answer: too slow, too old to know the question, or without a connection.
    pub silent: Vec<NodeAddress>,
    /// Both ends of each link beside each other.
    pub links: Vec<Link>,
    /// What cannot be explained. Empty when all is well.
    pub unexplained: Vec<Unexplained>,
}

/// One direction of a link between two nodes: what one says that it has sent, and the other that it has taken.
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
    /// Who sends.
    pub from: NodeAddress,
    /// Who takes.
    pub to: NodeAddress,
    /// Of which messages; `None`: of all.
    pub class: Option<Class>,
    /// What can be compared.
    pub state: LinkState,
    /// Messages, and voids in the place of some, that the sender has numbered since the session began.
    pub sent: u64,
    /// Of these, those of which it knows that they have arrived.
    pub acknowledged: u64,
    /// Those that the other has taken, where both speak of one session.
    pub taken: Option<u64>,
}

/// What the two ends of a link speak of.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum LinkState {
    /// The same session.
    OneSession,
    /// One of them has begun anew, and the other does not know it yet: what was under way ends as `Unknown`.
    BegunAnew,
    /// The other end says nothing of it.
    OneEndOnly,
}

/// Messages that nobody can explain.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Unexplained {
    /// Where.
    pub at: At,
    /// How many are missing; negative: how many are too many.
    pub messages: i64,
}

/// Where messages cannot be explained.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum At {
    /// They were taken there, and neither ended nor wait.
    Place {
        /// On which node.
        node: NodeAddress,
        /// In which place.
        place: Place,
    },
    /// One end says that they arrived, and the other that they did not.
    Link {
        /// Who sends.
        from: NodeAddress,
        /// Who takes.
        to: NodeAddress,
        /// Of which messages; `None`: of all.
        class: Option<Class>,
    },
}

impl Audit {
    /// Puts two readings of these nodes side by side: all of `before` were read before any of `after`. Who is not in both of them, in the
    /// same life, is silent.
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

    /// Each node of `after` was read before, too.
    pub(super) fn of(
        asked_by: NodeAddress,
        before: &[NodeAudit],
        after: Vec<NodeAudit>,
        silent: Vec<NodeAddress>,
    ) -> Self {
        let (links, unexplained) = (compare::links(&after), compare::unexplained(before, &after));
        Self { asked_by, nodes: after, silent, links, unexplained }
    }

    /// Messages that nobody can explain, all together: 0 when all is well. Those that are missing and those that are too
    /// many do not make up for each other.
    #[must_use]
    pub fn missing(&self) -> u64 {
        self.unexplained.iter().fold(0, |sum, found| sum.saturating_add(found.messages.unsigned_abs()))
    }

    /// What became of the messages of all nodes: each is counted where it is, and none twice for having come from another node.
    ///
    /// Exact once nothing moves and as long as no session was begun anew: of what ended as unknown some may have arrived, and what had arrived in
    /// the former session is counted twice.
    #[must_use]
    pub fn total(&self) -> Account {
        self.nodes
            .iter()
            .flat_map(|node| node.entries.iter().map(|entry| self.part(node, &entry.place, entry.account)))
            .sum()
    }

    /// What a place adds to the total.
    fn part(&self, node: &NodeAudit, place: &Place, account: Account) -> Account {
        let has = |address: NodeAddress| self.nodes.iter().find(|other| other.node == address);
        match place {
            Place::ToNode { node: to, class } => match has(*to) {
                // What has arrived is counted by the other node.
                Some(to) => {
                    let there = to.account(&Place::FromNode { node: node.node, class: *class }).taken;
                    let sent = account.delivered.wrapping_add(account.unacknowledged);
                    let not_there = sent.saturating_sub(there);
                    // What is known to have arrived is under way no more: the other one has begun a session anew, and counts it elsewhere.
                    let unacknowledged = account.unacknowledged.min(not_there);
                    Account { delivered: not_there - unacknowledged, unacknowledged, ..account }
                }
                None => account,
            },
            Place::FromNode { node: from, .. } => {
                let told = account.delivered.wrapping_sub(account.handed_on);
                let taken = if has(*from).is_some() { 0 } else { account.taken };
                Account {
                    taken: taken.wrapping_sub(account.handed_on),
                    delivered: told,
                    handed_on: 0,
                    ..account
                }
            }
            Place::FromFormerNodes => {
                let told = account.delivered.wrapping_sub(account.handed_on);
                let taken = account.taken.wrapping_sub(account.handed_on);
                Account { taken, delivered: told, handed_on: 0, ..account }
            }
            Place::Mailbox { .. }
            | Place::Client { .. }
            | Place::OtherMailboxes
            | Place::OtherClients
            | Place::ToFormerNodes => account,
        }
    }
}
