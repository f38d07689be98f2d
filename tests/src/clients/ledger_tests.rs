//! The ledger finds every way in which the law can be broken.

use super::*;

const BULK: Way = Way { to: 1, class: Class::Bulk };
const STREAM: Way = Way { to: 1, class: Class::Stream };

const fn at(nanos: u64) -> Time {
    Time::from_nanos(nanos)
}

/// Posters 0 and 1 are up; then these.
fn ledger(entries: impl IntoIterator<Item = (Poster, u32, Entry)>) -> Ledger {
    let mut ledger = Ledger::default();
    for who in [0, 1] {
        ledger.note(who, 1, Entry::Up(at(1)));
    }
    entries.into_iter().for_each(|(who, life, entry)| ledger.note(who, life, entry));
    ledger
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
fn what_was_sent_and_came_in_order_is_delivered() {
    let account = ledger([sends(1, 2), got(1), got(2)]).account();
    assert!(account.holds(), "{account}");
    assert_eq!((account.of(Fate::Delivered), account.sent()), (2, 2));
}

#[test]
fn what_comes_twice_or_late_or_from_nowhere_is_a_fault() {
    for wrong in [vec![got(1), got(1)], vec![got(2), got(1)], vec![got(1), got(2), got(3)]] {
        let account = ledger([sends(1, 2)].into_iter().chain(wrong)).account();
        assert!(account.faults > 0, "{account}");
    }
}

#[test]
fn one_that_is_passed_over_was_lost_in_silence() {
    let account = ledger([sends(1, 2), got(2)]).account();
    assert_eq!(account.faults, 1, "{account}");
}

#[test]
fn one_that_has_not_come_is_on_its_way_while_both_live() {
    let mut ledger = ledger([sends(1, 2), got(1)]);
    assert_eq!(ledger.account().of(Fate::InFlight), 1);
    ledger.killed(1, 1);
    assert_eq!(ledger.account().of(Fate::LostWithDestination), 1);
}

#[test]
fn what_a_killed_source_said_last_ends_with_it() {
    let mut ledger = ledger([sends(1, 2), got(1)]);
    ledger.killed(0, 1);
    let account = ledger.account();
    assert_eq!((account.of(Fate::EndedWithSource), account.faults), (1, 0), "{account}");
}

#[test]
fn a_newer_value_of_a_stream_takes_an_older_ones_place_but_nothing_takes_the_last_ones() {
    let mut ledger = ledger([(0, 1, Entry::Sends(STREAM, 1, 3, at(5)))]);
    ledger.note(1, 1, Entry::Got(0, 1, Class::Stream, 2));
    let account = ledger.account();
    assert_eq!((account.of(Fate::Superseded), account.of(Fate::InFlight)), (1, 1), "{account}");
}

#[test]
fn an_outcome_that_is_not_what_happened_is_a_lie() {
    let lies = [
        (Outcome::Delivered, false),
        (Outcome::Expired, true),
        (Outcome::Rejected(Rejection::QueueFull), true),
        (Outcome::Rejected(Rejection::ByHandler), false),
        (Outcome::Failed, false),
        (Outcome::PeerLost, false),
    ];
    for (outcome, handled) in lies {
        let account = ledger(asked(outcome).into_iter().chain(handled.then(|| got(1)))).account();
        assert_eq!(account.faults, 1, "{outcome:?} {handled}: {account}");
    }
}

#[test]
fn a_confirmed_message_has_one_outcome() {
    let [asks, outcome] = asked(Outcome::Unknown);
    assert_eq!(ledger([asks.clone()]).account().of(Fate::InFlight), 1);
    assert_eq!(ledger([asks.clone(), outcome.clone()]).account().of(Fate::Unknown), 1);
    assert_eq!(ledger([asks, outcome.clone(), outcome]).account().faults, 1);
}

#[test]
fn a_later_life_of_the_destination_goes_on_where_the_earlier_one_ended() {
    let mut ledger = ledger([sends(1, 4), got(1)]);
    ledger.killed(1, 1);
    ledger.note(1, 2, Entry::Up(at(9)));
    ledger.note(1, 2, Entry::Got(0, 1, Class::Bulk, 4));
    let account = ledger.account();
    assert_eq!((account.of(Fate::LostWithDestination), account.faults), (2, 0), "{account}");
    // What was sent when the later life was there is owed to it.
    ledger.note(0, 1, Entry::Sends(BULK, 5, 2, at(10)));
    ledger.note(1, 2, Entry::Got(0, 1, Class::Bulk, 6));
    assert_eq!(ledger.account().faults, 1);
}

#[test]
fn an_earlier_life_of_a_source_is_not_heard_after_a_later_one() {
    let mut ledger = ledger([sends(1, 1)]);
    ledger.note(0, 2, Entry::Sends(BULK, 1, 1, at(9)));
    ledger.note(1, 1, Entry::Got(0, 2, Class::Bulk, 1));
    ledger.note(1, 1, Entry::Got(0, 1, Class::Bulk, 1));
    assert_eq!(ledger.account().faults, 1);
}
