//! Changes of private state by which the simulation plants faults. Only the feature `testing` has them, and no node
//! has that feature.

use sinew_model::facts::LossReason;
use sinew_runtime::{tid::NodeAddress, time::Time};

use super::{Core, Place, contact::Role, queries::SentQuery};

/// Number of planted queries to one address that may be answered.
const QUERIES_MAX: usize = 4;

impl Core {
    /// Sets the number of consecutive missed answers of a member.
    pub fn set_missed(&mut self, node: NodeAddress, missed: u32) {
        if let Some(member) = self.members.get_mut(&node) {
            member.missed = missed;
        }
    }

    /// Forgets that the local timer has been late, so that each delay counts as the first one.
    pub fn forget_late_timers(&mut self) {
        for pace in &mut self.paces.all {
            pace.late_in_a_row = 0;
            pace.grace.iter_mut().for_each(|grace| grace.in_a_row = 0);
        }
    }

    /// Returns whether an answer with this correlation id is accepted from `place`.
    pub fn accepts_answer(&self, place: Place, correlation: u64) -> bool {
        self.contacts.get(&place).is_some_and(|contact| contact.queries.has(correlation))
    }

    /// Accepts an answer with this correlation id from `place`, as if a query had been sent now.
    pub fn accept_answer(&mut self, now: Time, place: Place, correlation: u64) {
        if let Some(mut contact) = self.contacts.get_mut(&place)
            && !contact.queries.has(correlation)
        {
            contact.queries.push(SentQuery { correlation, sent: now }, QUERIES_MAX);
        }
    }

    /// Loses a member and forgets its incarnation, so that an earlier one may return.
    pub fn forget_incarnation(&mut self, now: Time, node: NodeAddress) {
        self.lose(now, node, LossReason::Restarted);
        self.departed.remove(node);
    }

    /// Stops the queries to the addresses of departed nodes.
    pub fn forget_departed_addresses(&mut self) {
        self.contacts.retain(|_, contact| !matches!(contact.role, Role::Former { .. }));
    }
}
