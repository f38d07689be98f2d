//! Observers of the outcomes of confirmed messages, while there are any: nodes that record.
//!
//! The sink of a receipt shows the outcome where the sender gets it. Receipts of copies and of quotas do not, so each
//! message is shown once.

use std::sync::Arc;

use super::{MemberReport, MemberState, Outcome, Ticket};
use crate::observers::Observers;

/// An observer of outcomes. It is called on the thread that settles the message, which may be a real-time thread, so it
/// must not wait.
pub trait OutcomeObserver: Send + Sync {
    /// Receives the outcome of the message of `ticket`. For one member of a message to many, the ticket has the member
    /// as its destination, or the address of its node where that has one outcome for all of its members.
    fn settled(&self, ticket: Ticket, outcome: Outcome);
}

static OBSERVERS: Observers<dyn OutcomeObserver> = Observers::new();

/// Adds an observer for as long as it lives, in place of `former`. Each outcome reaches one of the two. Returns `false`
/// if there are too many.
pub fn observe(observer: &Arc<dyn OutcomeObserver>, former: Option<&Arc<dyn OutcomeObserver>>) -> bool {
    OBSERVERS.add(observer, former)
}

/// Removes an observer. An outcome that another thread is just showing may still reach it.
pub fn stop_observing(observer: &Arc<dyn OutcomeObserver>) {
    OBSERVERS.remove(observer);
}

/// Shows the outcome of a message to all observers. Without any observer it costs one load.
#[inline]
pub fn show(ticket: Ticket, outcome: Outcome) {
    OBSERVERS.each(|observer| observer.settled(ticket, outcome));
}

/// Shows the outcomes of members of a message to many to all observers.
pub fn show_members(ticket: Ticket, reports: &[MemberReport]) {
    OBSERVERS.each(|observer| {
        for MemberReport { tid, state } in reports {
            if let MemberState::Settled(outcome) = *state {
                observer.settled(Ticket { destination: *tid, ..ticket }, outcome);
            }
        }
    });
}

#[cfg(test)]
mod tests {
    use std::{
        panic::{AssertUnwindSafe, catch_unwind},
        sync::Mutex,
        task::{Context, Poll},
    };

    use futures_util::task::noop_waker;

    use super::*;
    use crate::{
        lock,
        outcome::{Receipt, ReceiptSink, Rejection},
        pending::{Awaited, Pending, Settlement},
        tid::{AppAddress, NodeAddress, Tid},
    };

    /// A source that no other test has: all tests of this process share the observers.
    const SOURCE: Tid = Tid::new(NodeAddress::new(0x7f00_0063), AppAddress::new(0x1063));

    #[derive(Default)]
    struct Notes(Mutex<Vec<(Tid, Outcome)>>);

    impl OutcomeObserver for Notes {
        fn settled(&self, ticket: Ticket, outcome: Outcome) {
            if ticket.source == SOURCE {
                lock(&self.0).push((ticket.destination, outcome));
            }
        }
    }

    #[test]
    fn outcomes_of_a_message_and_its_members_are_shown() {
        let notes = Arc::new(Notes::default());
        let observer: Arc<dyn OutcomeObserver> = notes.clone();
        assert!(observe(&observer, None));
        let pending = Pending::new(1);
        let drives = Tid::group("drives");
        let wait = pending.open(Awaited::Outcome, drives).expect("it has room");
        let ticket = Ticket { source: SOURCE, destination: drives, correlation: wait.correlation() };
        let member = Tid::new(NodeAddress::new(0x7f00_0063), AppAddress::new(0x1064));
        let full = Outcome::Rejected(Rejection::QueueFull);
        pending.members(ticket, &[MemberReport::of_member(member, MemberState::Pending)]);
        pending.members(ticket, &[MemberReport::of_member(member, MemberState::Settled(full))]);
        pending.settle(ticket, Outcome::Delivered);
        stop_observing(&observer);
        show(ticket, Outcome::Unknown);
        assert_eq!(*lock(&notes.0), [(member, full), (drives, Outcome::Delivered)]);
    }

    #[test]
    fn observer_that_panics_leaves_no_message_without_outcome() {
        /// An application that no other test has, either.
        const WATCHED: Tid = Tid::new(NodeAddress::new(0x7f00_0063), AppAddress::new(0x1065));

        struct Panics;

        impl OutcomeObserver for Panics {
            fn settled(&self, ticket: Ticket, _: Outcome) {
                assert!(ticket.source != WATCHED || ticket.correlation != 2, "a fault of the observer's");
            }
        }

        let observer: Arc<dyn OutcomeObserver> = Arc::new(Panics);
        assert!(observe(&observer, None));
        let pending = Pending::new(3);
        let waits = [(); 3].map(|()| pending.open(Awaited::Outcome, Tid::NONE).expect("it has room"));
        let receipt = |correlation| {
            let ticket = Ticket { source: WATCHED, destination: Tid::NONE, correlation };
            (Receipt::new(pending.clone(), ticket), Outcome::Delivered)
        };
        let mut receipts: Vec<_> = waits.iter().map(|wait| receipt(wait.correlation())).collect();
        let settled = catch_unwind(AssertUnwindSafe(move || Receipt::settle_all(&mut receipts)));
        stop_observing(&observer);
        assert!(settled.is_err());
        let settlements = waits.map(|wait| wait.poll_settled(&Context::from_waker(&noop_waker())));
        for (settlement, expected) in
            settlements.into_iter().zip([Outcome::Delivered, Outcome::Delivered, Outcome::Failed])
        {
            assert!(matches!(settlement, Poll::Ready(Settlement::Outcome(outcome)) if outcome == expected));
        }
    }
}
