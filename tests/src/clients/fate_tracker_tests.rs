//! The tracker detects every kind of violation of the law.

use super::*;

const BULK: Way = Way { to: 1, class: Class::Bulk };
const STREAM: Way = Way { to: 1, class: Class::Stream };

const fn at(nanos: u64) -> Time {
    Time::from_nanos(nanos)
}

/// Posters 0 and 1 are up; then come these entries.
fn tracker(entries: impl IntoIterator<Item = (Poster, u32, Entry)>) -> FateTracker {
    let mut tracker = FateTracker::default();
    for poster in [0, 1] {
        tracker.note(poster, 1, Entry::Up(at(1)));
    }
    entries.into_iter().for_each(|(poster, incarnation, entry)| tracker.note(poster, incarnation, entry));
    tracker
}

fn got(number: u64) -> (Poster, u32, Entry) {
    (1, 1, Entry::Got(0, 1, Class::Bulk, number))
}

fn sends(first: u64, count: u64) -> (Poster, u32, Entry) {
    (0, 1, Entry::Sends(BULK, first, count, at(5)))
}

fn asked(outcome: Outcome) -> [(Poster, u32, Entry); 2] {
    [(0, 1, Entry::Asks(BULK, 1, at(5))), (0, 1, Entry::Outcome(BULK, 1, outcome))]
}

#[test]
fn messages_received_in_order_are_delivered() {
    let account = tracker([sends(1, 2), got(1), got(2)]).account();
    assert!(account.holds(), "{account}");
    assert_eq!((account.of(Fate::Delivered), account.sent()), (2, 2));
}

#[test]
fn duplicate_reordered_or_invented_message_is_a_fault() {
    for wrong in [vec![got(1), got(1)], vec![got(2), got(1)], vec![got(1), got(2), got(3)]] {
        let account = tracker([sends(1, 2)].into_iter().chain(wrong)).account();
        assert!(account.faults > 0, "{account}");
    }
}

#[test]
fn skipped_message_is_a_silent_loss() {
    let account = tracker([sends(1, 2), got(2)]).account();
    assert_eq!(account.faults, 1, "{account}");
}

#[test]
fn missing_message_is_in_flight_while_both_ends_live() {
    let mut tracker = tracker([sends(1, 2), got(1)]);
    assert_eq!(tracker.account().of(Fate::InFlight), 1);
    tracker.killed(1, 1);
    assert_eq!(tracker.account().of(Fate::LostWithDestination), 1);
}

#[test]
fn last_messages_of_a_killed_source_end_with_it() {
    let mut tracker = tracker([sends(1, 2), got(1)]);
    tracker.killed(0, 1);
    let account = tracker.account();
    assert_eq!((account.of(Fate::EndedWithSource), account.faults), (1, 0), "{account}");
}

#[test]
fn newer_stream_value_supersedes_older_but_last_is_required() {
    let mut tracker = tracker([(0, 1, Entry::Sends(STREAM, 1, 3, at(5)))]);
    tracker.note(1, 1, Entry::Got(0, 1, Class::Stream, 2));
    let account = tracker.account();
    assert_eq!((account.of(Fate::Superseded), account.of(Fate::InFlight)), (1, 1), "{account}");
}

#[test]
fn false_outcome_is_a_fault() {
    let lies = [
        (Outcome::Delivered, false),
        (Outcome::Expired, true),
        (Outcome::Rejected(Rejection::QueueFull), true),
        (Outcome::Rejected(Rejection::ByHandler), false),
        (Outcome::Failed, false),
        (Outcome::PeerLost, false),
    ];
    for (outcome, handled) in lies {
        let account = tracker(asked(outcome).into_iter().chain(handled.then(|| got(1)))).account();
        assert_eq!(account.faults, 1, "{outcome:?} {handled}: {account}");
    }
}

#[test]
fn confirmed_message_has_exactly_one_outcome() {
    let [asks, outcome] = asked(Outcome::Unknown);
    assert_eq!(tracker([asks.clone()]).account().of(Fate::InFlight), 1);
    assert_eq!(tracker([asks.clone(), outcome.clone()]).account().of(Fate::Unknown), 1);
    assert_eq!(tracker([asks, outcome.clone(), outcome]).account().faults, 1);
}

#[test]
fn later_incarnation_continues_at_the_destination() {
    let mut tracker = tracker([sends(1, 4), got(1)]);
    tracker.killed(1, 1);
    tracker.note(1, 2, Entry::Up(at(9)));
    tracker.note(1, 2, Entry::Got(0, 1, Class::Bulk, 4));
    let account = tracker.account();
    assert_eq!((account.of(Fate::LostWithDestination), account.faults), (2, 0), "{account}");
    // Messages sent after the later incarnation was up must reach it.
    tracker.note(0, 1, Entry::Sends(BULK, 5, 2, at(10)));
    tracker.note(1, 2, Entry::Got(0, 1, Class::Bulk, 6));
    assert_eq!(tracker.account().faults, 1);
}

#[test]
fn message_of_earlier_incarnation_after_later_is_a_fault() {
    let mut tracker = tracker([sends(1, 1)]);
    tracker.note(0, 2, Entry::Sends(BULK, 1, 1, at(9)));
    tracker.note(1, 1, Entry::Got(0, 2, Class::Bulk, 1));
    tracker.note(1, 1, Entry::Got(0, 1, Class::Bulk, 1));
    assert_eq!(tracker.account().faults, 1);
}
