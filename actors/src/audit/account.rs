//! The counters of one place, and the law that they obey.

use std::fmt;

use serde::{Deserialize, Serialize};
use sinew_runtime::{
    mailbox::Tally,
    tid::{AppAddress, NodeAddress},
    wire::Class,
};

use crate::{gncl::Arrived, outlet::OutletAccount};

/// Where messages are counted. A message goes through several of them, one after the other.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub enum Place {
    /// The mailbox of an application of the node, in its process or in one of its own.
    Mailbox {
        /// Whose.
        app: AppAddress,
        /// Its name.
        name: String,
        /// Of which messages.
        class: Class,
    },
    /// What the node hands to an application that another process has registered.
    Client {
        /// Whose.
        app: AppAddress,
        /// Its name.
        name: String,
    },
    /// What goes to another node: delivered once that has acknowledged it.
    ToNode {
        /// Which.
        node: NodeAddress,
        /// Of which messages; `None`: all go the same way.
        class: Option<Class>,
    },
    /// What another node has brought.
    FromNode {
        /// Which.
        node: NodeAddress,
        /// Of which messages; `None`: all come the same way.
        class: Option<Class>,
    },
    /// Mailboxes that are gone, or that an answer had no room for.
    OtherMailboxes,
    /// Clients that are gone, or that an answer had no room for.
    OtherClients,
    /// To lives of nodes that are gone.
    ToFormerNodes,
    /// From lives of nodes that are gone.
    FromFormerNodes,
}

/// What became of the messages that a place took, in messages since the node's start.
///
/// `taken = delivered + superseded + rejected + expired + failed + lost + unknown + waiting + unacknowledged`.
///
/// # Examples
///
/// ```
/// use sinew::audit::Account;
///
/// let mailbox = Account { taken: 10, delivered: 7, superseded: 2, waiting: 1, ..Account::default() };
/// assert_eq!(mailbox.unexplained(), 0);
/// ```
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct Account {
    /// Accepted. What was refused is not among these.
    #[serde(skip_serializing_if = "is_zero")]
    pub taken: u64,
    /// Of those taken, frames of the layers and outcomes, on their way to a client or a node.
    #[serde(skip_serializing_if = "is_zero")]
    pub own: u64,
    /// Handled (mailbox), written to its process (client), acknowledged by the node (to a node), or handed to whom it was for (from a
    /// node).
    #[serde(skip_serializing_if = "is_zero")]
    pub delivered: u64,
    /// Of those delivered that a node has brought, what a mailbox or a client of this node counts as taken.
    #[serde(skip_serializing_if = "is_zero")]
    pub handed_on: u64,
    /// A newer value took their place.
    #[serde(skip_serializing_if = "is_zero")]
    pub superseded: u64,
    /// Taken, and refused later: by the handler, or because the application ended or is away. From a node: nobody took them.
    #[serde(skip_serializing_if = "is_zero")]
    pub rejected: u64,
    /// Older than their time to live.
    #[serde(skip_serializing_if = "is_zero")]
    pub expired: u64,
    /// In the hand of something that panicked or ended.
    #[serde(skip_serializing_if = "is_zero")]
    pub failed: u64,
    /// Not sent before the node, or the client, was gone.
    #[serde(skip_serializing_if = "is_zero")]
    pub lost: u64,
    /// Sent, and nobody can say whether they arrived.
    #[serde(skip_serializing_if = "is_zero")]
    pub unknown: u64,
    /// In a queue or a line now, or in the hand of an application.
    #[serde(skip_serializing_if = "is_zero")]
    pub waiting: u64,
    /// Sent to a node that has not said to have them.
    #[serde(skip_serializing_if = "is_zero")]
    pub unacknowledged: u64,
    /// Handed back to their senders at once.
    #[serde(skip_serializing_if = "is_zero")]
    pub refused: u64,
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde calls it with a reference")]
const fn is_zero(number: &u64) -> bool {
    *number == 0
}

impl Account {
    /// Messages that were taken and are nowhere; negative: that ended and were not taken. 0 when all is well.
    #[must_use]
    pub fn unexplained(&self) -> i64 {
        let ends = [self.delivered, self.superseded, self.rejected, self.expired, self.failed, self.lost];
        let here = [self.unknown, self.waiting, self.unacknowledged];
        // What another node says may be any number.
        let known = ends.into_iter().chain(here).fold(0, u64::wrapping_add);
        self.taken.wrapping_sub(known).cast_signed()
    }

    /// Whether nothing was ever taken or refused.
    pub(crate) fn is_empty(&self) -> bool {
        *self == Self::default()
    }

    /// Of one class of a mailbox.
    pub(crate) const fn of_mailbox((tally, held): (Tally, u64)) -> Self {
        let Tally { taken, refused, delivered, superseded, rejected, expired, failed } = tally;
        Self {
            taken,
            own: 0,
            delivered,
            handed_on: 0,
            superseded,
            rejected,
            expired,
            failed,
            lost: 0,
            unknown: 0,
            waiting: held,
            unacknowledged: 0,
            refused,
        }
    }

    /// Of one class to a node, or of a client.
    pub(crate) const fn of_outlet(account: &OutletAccount) -> Self {
        Self {
            taken: account.taken,
            own: account.own,
            delivered: account.arrived,
            handed_on: 0,
            superseded: account.superseded,
            rejected: 0,
            expired: account.expired,
            failed: 0,
            lost: account.lost,
            unknown: account.unknown,
            waiting: account.waiting,
            unacknowledged: account.unacknowledged,
            refused: account.refused,
        }
    }

    /// Of one class from a node.
    pub(crate) const fn of_arrivals(arrived: &Arrived) -> Self {
        Self {
            taken: arrived.taken,
            own: 0,
            delivered: arrived.handed_on + arrived.told,
            handed_on: arrived.handed_on,
            superseded: arrived.superseded,
            rejected: arrived.refused,
            expired: arrived.expired,
            failed: arrived.failed,
            lost: 0,
            unknown: 0,
            waiting: arrived.waiting,
            unacknowledged: 0,
            refused: 0,
        }
    }

    /// The same, of something that is gone: what waited there has failed.
    pub(crate) const fn over(self) -> Self {
        Self { failed: self.failed + self.waiting, waiting: 0, ..self }
    }
}

impl std::ops::Add for Account {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        let sum = u64::wrapping_add;
        Self {
            taken: sum(self.taken, other.taken),
            own: sum(self.own, other.own),
            delivered: sum(self.delivered, other.delivered),
            handed_on: sum(self.handed_on, other.handed_on),
            superseded: sum(self.superseded, other.superseded),
            rejected: sum(self.rejected, other.rejected),
            expired: sum(self.expired, other.expired),
            failed: sum(self.failed, other.failed),
            lost: sum(self.lost, other.lost),
            unknown: sum(self.unknown, other.unknown),
            waiting: sum(self.waiting, other.waiting),
            unacknowledged: sum(self.unacknowledged, other.unacknowledged),
            refused: sum(self.refused, other.refused),
        }
    }
}

impl std::iter::Sum for Account {
    fn sum<I: Iterator<Item = Self>>(accounts: I) -> Self {
        accounts.fold(Self::default(), std::ops::Add::add)
    }
}

impl fmt::Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        // A name from another node must not forge a line.
        match self {
            Self::Mailbox { app, name, class } => {
                write!(f, "mailbox {} ({app}), {class:?}", name.escape_debug())
            }
            Self::Client { app, name } => write!(f, "client {} ({app})", name.escape_debug()),
            Self::ToNode { node, class: Some(class) } => write!(f, "to {node}, {class:?}"),
            Self::ToNode { node, class: None } => write!(f, "to {node}"),
            Self::FromNode { node, class: Some(class) } => write!(f, "from {node}, {class:?}"),
            Self::FromNode { node, class: None } => write!(f, "from {node}"),
            Self::OtherMailboxes => f.write_str("other mailboxes, and those that are gone"),
            Self::OtherClients => f.write_str("other clients, and those that are gone"),
            Self::ToFormerNodes => f.write_str("to lives of nodes that are gone"),
            Self::FromFormerNodes => f.write_str("from lives of nodes that are gone"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_message_that_was_taken_and_is_nowhere_is_unexplained_and_one_that_ended_twice_is_too() {
        let all = Account { taken: 5, delivered: 2, expired: 1, waiting: 2, ..Account::default() };
        assert_eq!(all.unexplained(), 0);
        assert_eq!(Account { waiting: 1, ..all }.unexplained(), 1);
        assert_eq!(Account { lost: 1, ..all }.unexplained(), -1);
    }

    #[test]
    fn any_numbers_of_another_node_have_a_sum() {
        let most = Account { taken: 0, delivered: u64::MAX, lost: u64::MAX, ..Account::default() };
        assert_eq!(most.unexplained(), 2);
        assert_eq!((most + most).delivered, u64::MAX - 1);
    }
}
