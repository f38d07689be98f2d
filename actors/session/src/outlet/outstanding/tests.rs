//! The pending outcomes of destinations: removed in order, and settled one by one or together.

use std::sync::{Arc, Mutex};

use proptest::prelude::*;
use sinew_runtime::{
    outcome::ReceiptSink,
    tid::{AppAddress, NodeAddress},
};

use super::*;

const GRACE: Duration = Duration::from_nanos(10);

/// A sink for outcomes that only records the tickets.
#[derive(Default)]
struct NullSink(Mutex<Vec<Ticket>>);

impl ReceiptSink for NullSink {
    fn settle(&self, ticket: Ticket, _: Outcome) {
        self.0.lock().unwrap().push(ticket);
    }
}

fn tid(app: u32) -> Tid {
    Tid::new(NodeAddress::new(2), AppAddress::new(0x1000 + app))
}

/// Messages numbered from 0, each to one of the destinations; `None` as expiry: never.
fn outstanding(sent: &[(u32, Option<u64>)]) -> Outstanding {
    outstanding_at(&Arc::default(), sent)
}

/// The same, with the sink of their outcomes.
fn outstanding_at(sink: &Arc<NullSink>, sent: &[(u32, Option<u64>)]) -> Outstanding {
    let shares = Shares { unconfirmed_max: usize::MAX / UNCONFIRMED_DESTINATIONS, outcome_room: None };
    let mut outstanding = Outstanding::new(shares);
    for (correlation, (to, expiry)) in (0..).zip(sent) {
        let ticket = Ticket { source: tid(0), destination: tid(*to), correlation };
        let expiry = expiry.map_or(Time::MAX, Time::from_nanos);
        outstanding.add_waiting(Some(ticket.destination));
        let sent = SentMessage { receipt: Receipt::new(sink.clone(), ticket), expiry, written: 0 };
        assert!(outstanding.sent(sent).is_none(), "no outcome was reported");
    }
    outstanding
}

fn correlations(receipts: &[Receipt]) -> Vec<u64> {
    receipts.iter().map(|receipt| receipt.ticket().correlation).collect()
}

proptest! {
    #[test]
    fn outcomes_settle_together_as_one_by_one(
        sent in proptest::collection::vec(0..3_u32, 0..40),
        // In the order of the messages, with some left out, repeated, for another destination, or unknown.
        reported in proptest::collection::vec((0..44_usize, any::<bool>(), 0..30_u32), 0..40),
    ) {
        let sent: Vec<_> = sent.into_iter().map(|to| (to, None)).collect();
        let in_order = reported.iter().enumerate().map(|(at, (other, is_next, _))| if *is_next { at } else { *other });
        let outcomes: Vec<_> = in_order
            .zip(&reported)
            .map(|(number, (.., to))| {
                let to = if *to < 2 { *to } else { sent.get(number).map_or(0, |(to, _)| *to) };
                Ticket { source: tid(0), destination: tid(to), correlation: number as u64 }
            })
            .collect();
        let (one_by_one, together) = (Arc::<NullSink>::default(), Arc::<NullSink>::default());
        let mut expected = outstanding_at(&one_by_one, &sent);
        let mut deferred = DeferredActions::default();
        let mut expected_left = outcomes.clone();
        expected_left.retain(|ticket| {
            let mut run = OutcomeRun::new(*ticket, 1, Outcome::Delivered);
            expected.confirm(&mut run, &mut deferred);
            !run.is_empty()
        });
        deferred.run();
        let (mut outstanding, mut deferred) = (outstanding_at(&together, &sent), DeferredActions::default());
        let mut runs = Vec::<OutcomeRun>::new();
        for ticket in outcomes {
            let run = OutcomeRun::new(ticket, 1, Outcome::Delivered);
            if !runs.last_mut().is_some_and(|last| last.extend(&run)) {
                runs.push(run);
            }
        }
        outstanding.confirm_all(&mut runs, &mut deferred);
        deferred.run();
        let left: Vec<Ticket> = runs.iter().flat_map(OutcomeRun::tickets).collect();
        prop_assert_eq!(left, expected_left);
        prop_assert_eq!(&*together.0.lock().unwrap(), &*one_by_one.0.lock().unwrap());
        prop_assert_eq!(outstanding.open(), expected.open());
        let pending = |all: &mut Outstanding| all.take_all().map(|sent| sent.receipt).collect::<Vec<_>>();
        let (pending, expected) = (pending(&mut outstanding), pending(&mut expected));
        prop_assert_eq!(correlations(&pending), correlations(&expected));
    }

    #[test]
    fn overdue_messages_are_removed_in_order(
        sent in proptest::collection::vec((0..4_u32, proptest::option::of(0..100_u64)), 0..60),
        now in 0..130_u64,
    ) {
        let mut outstanding = outstanding(&sent);
        let is_over = |expiry: Option<u64>| expiry.is_some_and(|expiry| now > expiry + 10);
        // By destination, and of each the oldest first.
        let mut all: Vec<(u32, u64, bool)> =
            (0..).zip(&sent).map(|(number, (to, expiry))| (*to, number, is_over(*expiry))).collect();
        all.sort_unstable();
        let those = |over: bool| all.iter().filter(|(.., is)| *is == over).map(|(_, number, _)| *number).collect::<Vec<_>>();
        let overdue = outstanding.take_overdue(Time::from_nanos(now), GRACE);
        prop_assert_eq!(correlations(&overdue), those(true));
        prop_assert_eq!(outstanding.open(), those(false).len());
        let left: Vec<Receipt> = outstanding.take_all().map(|sent| sent.receipt).collect();
        prop_assert_eq!(correlations(&left), those(false));
    }
}

#[test]
fn run_settles_each_correlation_once_and_in_any_order() {
    // Two messages have correlation 1, and 3 was sent before 2.
    let sink = Arc::<NullSink>::default();
    let mut outstanding = outstanding(&[]);
    let ticket = |correlation| Ticket { source: tid(0), destination: tid(1), correlation };
    for correlation in [0, 1, 1, 3, 2, 9] {
        outstanding.add_waiting(Some(tid(1)));
        let receipt = Receipt::new(sink.clone(), ticket(correlation));
        assert!(outstanding.sent(SentMessage { receipt, expiry: Time::MAX, written: 0 }).is_none());
    }
    let mut runs = vec![OutcomeRun::new(ticket(1), 4, Outcome::Delivered)];
    let mut deferred = DeferredActions::default();
    outstanding.confirm_all(&mut runs, &mut deferred);
    deferred.run();
    let settled: Vec<_> = sink.0.lock().unwrap().iter().map(|ticket| ticket.correlation).collect();
    assert_eq!(settled, [1, 3, 2]);
    assert_eq!(runs.iter().flat_map(OutcomeRun::tickets).collect::<Vec<_>>(), [ticket(4)], "it was not sent");
    assert_eq!(outstanding.open(), 3);
    let left: Vec<Receipt> = outstanding.take_all().map(|sent| sent.receipt).collect();
    assert_eq!(correlations(&left), [0, 1, 9]);
}

#[test]
fn bound_without_the_lock_is_the_bound_under_it() {
    for (unconfirmed_max, outcome_room) in [
        (0, None),
        (1, None),
        (5, None),
        (5, Some(0)),
        (5, Some(1)),
        (5, Some(16)),
        (5, Some(1_000)),
        (1, Some(80)),
    ] {
        let open = Open::new(Shares { unconfirmed_max, outcome_room });
        for count in 0..100 {
            for to in [1, 2, 3] {
                let expected = lock(&open).is_at_bound(tid(to));
                assert_eq!(
                    open.is_at_bound(tid(to)),
                    expected,
                    "{count} of {unconfirmed_max}, {outcome_room:?}"
                );
            }
            open.add_waiting(Some(tid(1 + count % 2)));
            let ticket =
                Ticket { source: tid(0), destination: tid(1 + count % 2), correlation: count.into() };
            let receipt = Receipt::new(Arc::<NullSink>::default(), ticket);
            assert!(open.sent(SentMessage { receipt, expiry: Time::MAX, written: 0 }).is_none());
        }
    }
}

fn lock(open: &Open) -> std::sync::MutexGuard<'_, Outstanding> {
    open.all.lock().unwrap()
}

#[test]
fn silent_destinations_leave_no_state() {
    let sent: Vec<_> = (0..10_000).map(|to| (to, Some(1))).collect();
    let mut outstanding = outstanding(&sent);
    assert_eq!(outstanding.take_overdue(Time::MAX, GRACE).len(), sent.len());
    assert!(
        outstanding.destinations.len() <= EMPTY_DESTINATIONS_MAX,
        "{} destinations",
        outstanding.destinations.len()
    );
}
