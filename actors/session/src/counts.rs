//! The counts of the messages at one place, and the invariant that they satisfy.

use serde::{Deserialize, Serialize};
use sinew_runtime::mailbox::Tally;

use crate::outlet::OutletAccount;

/// The outcomes of the messages that a place took, in messages since the node's start.
///
/// `taken = delivered + superseded + rejected + expired + failed + lost + unknown + waiting + unacknowledged`.
///
/// # Examples
///
/// ```
/// use sinew_session::counts::Account;
///
/// let mailbox = Account { taken: 10, delivered: 7, superseded: 2, waiting: 1, ..Account::default() };
/// assert_eq!(mailbox.unexplained(), 0);
/// ```
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct Account {
    /// Accepted. Refused messages are not counted here.
    #[serde(skip_serializing_if = "is_zero")]
    pub taken: u64,
    /// Of those taken: frames of the layers and outcomes that are sent to a client or a node.
    #[serde(skip_serializing_if = "is_zero")]
    pub own: u64,
    /// Delivered: handled (mailbox), written to its process (client), acknowledged by the node (to a node),
    /// or forwarded to the destination (from a node).
    #[serde(skip_serializing_if = "is_zero")]
    pub delivered: u64,
    /// Of those delivered from another node: messages that a mailbox or a client of this node counts as taken.
    #[serde(skip_serializing_if = "is_zero")]
    pub handed_on: u64,
    /// Superseded by a newer value.
    #[serde(skip_serializing_if = "is_zero")]
    pub superseded: u64,
    /// Taken and rejected later: by the handler, or because the application ended or is down. From a node: no
    /// application took them.
    #[serde(skip_serializing_if = "is_zero")]
    pub rejected: u64,
    /// Older than their time to live.
    #[serde(skip_serializing_if = "is_zero")]
    pub expired: u64,
    /// Failed: their handler panicked or ended.
    #[serde(skip_serializing_if = "is_zero")]
    pub failed: u64,
    /// Not sent before the node or the client was lost.
    #[serde(skip_serializing_if = "is_zero")]
    pub lost: u64,
    /// Sent, and whether they arrived is unknown.
    #[serde(skip_serializing_if = "is_zero")]
    pub unknown: u64,
    /// Queued now, or with a handler now.
    #[serde(skip_serializing_if = "is_zero")]
    pub waiting: u64,
    /// Sent to a node that has not acknowledged them yet.
    #[serde(skip_serializing_if = "is_zero")]
    pub unacknowledged: u64,
    /// Returned to their senders at once.
    #[serde(skip_serializing_if = "is_zero")]
    pub refused: u64,
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde calls it with a reference")]
const fn is_zero(number: &u64) -> bool {
    *number == 0
}

impl Account {
    /// Returns the number of messages that were taken and are not accounted for; negative for messages that
    /// ended without being taken. 0 if all messages are accounted for.
    #[must_use]
    pub fn unexplained(&self) -> i64 {
        let ends = [self.delivered, self.superseded, self.rejected, self.expired, self.failed, self.lost];
        let here = [self.unknown, self.waiting, self.unacknowledged];
        // Another node may report any number.
        let known = ends.into_iter().chain(here).fold(0, u64::wrapping_add);
        self.taken.wrapping_sub(known).cast_signed()
    }

    /// Returns whether no message was ever taken or refused.
    pub fn is_empty(&self) -> bool {
        *self == Self::default()
    }

    /// Returns the account of one class of a mailbox.
    pub const fn of_mailbox((tally, held): (Tally, u64)) -> Self {
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

    /// Returns the account of a place that has ended: the messages that waited there have failed.
    pub const fn over(self) -> Self {
        Self { failed: self.failed + self.waiting, waiting: 0, ..self }
    }
}

impl From<&OutletAccount> for Account {
    /// Returns the account of one class to a node, or of a client.
    fn from(account: &OutletAccount) -> Self {
        Self {
            taken: account.taken,
            own: account.own,
            delivered: account.arrived,
            superseded: account.superseded,
            expired: account.expired,
            lost: account.lost,
            unknown: account.unknown,
            waiting: account.waiting,
            unacknowledged: account.unacknowledged,
            refused: account.refused,
            ..Self::default()
        }
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lost_and_doubly_ended_messages_are_unexplained() {
        let all = Account { taken: 5, delivered: 2, expired: 1, waiting: 2, ..Account::default() };
        assert_eq!(all.unexplained(), 0);
        assert_eq!(Account { waiting: 1, ..all }.unexplained(), 1);
        assert_eq!(Account { lost: 1, ..all }.unexplained(), -1);
    }

    #[test]
    fn any_counters_of_another_node_can_be_added() {
        let most = Account { taken: 0, delivered: u64::MAX, lost: u64::MAX, ..Account::default() };
        assert_eq!(most.unexplained(), 2);
        assert_eq!((most + most).delivered, u64::MAX - 1);
    }
}
