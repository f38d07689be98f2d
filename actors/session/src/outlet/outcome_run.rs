//! A run of outcomes: the same one of messages with consecutive correlations from one application to another.

use sinew_runtime::{
    outcome::{Outcome, Ticket},
    tid::Tid,
};

/// The same outcome of up to [`OUTCOMES_MAX`](super::OUTCOMES_MAX) messages with consecutive correlations from one
/// application to another, and which of them are not settled yet.
///
/// # Examples
///
/// ```
/// use sinew_runtime::{outcome::{Outcome, Ticket}, tid::Tid};
/// use sinew_session::outlet::OutcomeRun;
///
/// let first = Ticket { source: Tid::NONE, destination: Tid::NONE, correlation: 7 };
/// let mut run = OutcomeRun::new(first, 2, Outcome::Delivered);
/// let next = OutcomeRun::new(Ticket { correlation: 9, ..first }, 1, Outcome::Delivered);
/// assert!(run.extend(&next));
/// assert_eq!(run.len(), 3);
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct OutcomeRun {
    /// The first message.
    first: Ticket,
    outcome: Outcome,
    /// The messages that are not settled: bit n stands for correlation `first.correlation + n`.
    left: u128,
}

impl OutcomeRun {
    /// Creates the run of `count` messages, from that of `first` on. More than 128 count as 128.
    pub fn new(first: Ticket, count: u8, outcome: Outcome) -> Self {
        let rest = u128::BITS.saturating_sub(u32::from(count));
        Self { first, outcome, left: u128::MAX.checked_shr(rest).unwrap_or(0) }
    }

    /// Returns the number of messages that are not settled.
    pub const fn len(&self) -> usize {
        self.left.count_ones() as usize
    }

    /// Whether every message is settled.
    pub const fn is_empty(&self) -> bool {
        self.left == 0
    }

    /// Adds the messages of `next`, and returns whether it did: they must have the same outcome and the same ends,
    /// follow those of this run, and fit into it. No message of either may be settled.
    pub fn extend(&mut self, next: &Self) -> bool {
        let (count, first) = (u128::BITS - self.left.leading_zeros(), self.first);
        let follows = self.outcome == next.outcome
            && (first.source, first.destination) == (next.first.source, next.first.destination)
            && first.correlation.checked_add(u64::from(count)) == Some(next.first.correlation)
            && count <= next.left.leading_zeros();
        let Some(more) = next.left.checked_shl(count).filter(|_| follows) else { return false };
        self.left |= more;
        true
    }

    /// Returns the destination of the messages.
    pub(super) const fn destination(&self) -> Tid {
        self.first.destination
    }

    /// Returns the outcome of each message.
    pub(super) const fn outcome(&self) -> Outcome {
        self.outcome
    }

    /// Settles the message of `ticket`. Returns whether it is one of the run that was not settled.
    pub(super) fn settle(&mut self, ticket: Ticket) -> bool {
        let Some(at) = ticket.correlation.checked_sub(self.first.correlation) else { return false };
        let bit = u32::try_from(at).ok().and_then(|at| 1_u128.checked_shl(at)).unwrap_or(0);
        let is_one =
            self.left & bit != 0 && ticket == Ticket { correlation: ticket.correlation, ..self.first };
        if is_one {
            self.left &= !bit;
        }
        is_one
    }

    /// Returns the messages that are not settled.
    #[cfg(test)]
    pub(super) fn tickets(&self) -> impl Iterator<Item = Ticket> {
        let Self { first, left, .. } = *self;
        (0..u128::BITS)
            .filter(move |at| left & (1_u128 << *at) != 0)
            .map(move |at| Ticket { correlation: first.correlation + u64::from(at), ..first })
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use sinew_runtime::tid::{AppAddress, NodeAddress};

    use super::*;

    fn ticket(correlation: u64) -> Ticket {
        let tid = |node| Tid::new(NodeAddress::new(node), AppAddress::new(0x1001));
        Ticket { source: tid(1), destination: tid(2), correlation }
    }

    fn correlations(run: &OutcomeRun) -> Vec<u64> {
        run.tickets().map(|ticket| ticket.correlation).collect()
    }

    proptest! {
        #[test]
        fn each_message_of_a_run_is_settled_once(first in any::<u64>(), count in 1..=128_u8, at in 0..200_u64) {
            let first = first.min(u64::MAX - 127);
            let mut run = OutcomeRun::new(ticket(first), count, Outcome::Delivered);
            prop_assert_eq!(run.len(), usize::from(count));
            let one = ticket(first.wrapping_add(at));
            prop_assert_eq!(run.settle(one), at < u64::from(count));
            prop_assert!(!run.settle(one));
            let other_source = Ticket { source: one.destination, ..one };
            let other_destination = Ticket { destination: one.source, ..one };
            prop_assert!(!run.settle(other_source));
            prop_assert!(!run.settle(other_destination));
            let others = (0..u64::from(count)).filter(|other| *other != at).map(|other| first + other);
            prop_assert_eq!(correlations(&run), others.collect::<Vec<_>>());
        }

        #[test]
        fn run_grows_by_the_messages_behind_it(count in 1..=128_u8, more in 1..=128_u8, skipped in 0..3_u64) {
            let run = OutcomeRun::new(ticket(5), count, Outcome::Delivered);
            let next = ticket(5 + u64::from(count) + skipped);
            let mut longer = run.clone();
            let fits = u32::from(count) + u32::from(more) <= 128;
            prop_assert_eq!(longer.extend(&OutcomeRun::new(next, more, Outcome::Delivered)), fits && skipped == 0);
            let added = if fits && skipped == 0 { u64::from(more) } else { 0 };
            prop_assert_eq!(correlations(&longer), (5..5 + u64::from(count) + added).collect::<Vec<_>>());
        }
    }

    #[test]
    fn run_takes_no_other_outcome_and_no_other_pair() {
        let mut run = OutcomeRun::new(ticket(u64::MAX), 1, Outcome::Delivered);
        assert!(!run.extend(&OutcomeRun::new(ticket(0), 1, Outcome::Delivered)), "correlations do not wrap");
        run = OutcomeRun::new(ticket(1), 1, Outcome::Delivered);
        assert!(!run.extend(&OutcomeRun::new(ticket(2), 1, Outcome::Failed)));
        let other = Ticket { source: ticket(2).destination, ..ticket(2) };
        assert!(!run.extend(&OutcomeRun::new(other, 1, Outcome::Delivered)));
        assert_eq!(run.len(), 1);
    }
}
