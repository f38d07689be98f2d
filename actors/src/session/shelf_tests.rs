//! What loses its use in a line: found without a look at what does not, and taken out wherever it stands.

use std::{
    collections::{BTreeMap, BTreeSet},
    time::Duration,
};

use proptest::prelude::*;

use super::*;

const LIMITS: ShelfLimits =
    ShelfLimits { lines: 4, line_messages: 1_000, line_bytes: 100_000, messages: 4_000, bytes: 400_000 };
const BYTES: usize = 10;

/// A message, and the second after which it has no use.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Perishable(u32, Option<u64>);

impl Waits for Perishable {
    fn expiry(&self) -> Time {
        self.1.map_or(Time::MAX, at)
    }
}

fn at(second: u64) -> Time {
    Time::ZERO + Duration::from_secs(second)
}

fn names(messages: Vec<Perishable>) -> Vec<u32> {
    messages.into_iter().map(|Perishable(name, _)| name).collect()
}

/// Two lines; only 1 and 5 have a use for ever.
fn shelf() -> Shelf<u64, Perishable> {
    let mut shelf = Shelf::new(LIMITS);
    for (line, name, expiry) in
        [(1, 1, None), (1, 2, Some(30)), (2, 3, Some(20)), (1, 4, Some(10)), (1, 5, None), (2, 6, Some(40))]
    {
        shelf.put(line, Perishable(name, expiry), BYTES).expect("there is room");
    }
    shelf
}

#[test]
fn what_has_expired_is_taken_out_wherever_it_stands_and_what_has_not_stays() {
    let mut shelf = shelf();
    assert_eq!(shelf.next_expiry(), at(10));
    assert_eq!(names(shelf.take_expired(at(10), 9)), [0; 0], "its last instant is one in which it has a use");
    assert_eq!(names(shelf.take_expired(at(25), 9)), [4, 3]);
    assert_eq!((shelf.messages(), shelf.bytes(), shelf.next_expiry()), (4, 4 * BYTES, at(30)));
    assert_eq!(shelf.offer(1).map(|(message, _)| message.0), Some(1));
    assert!(!shelf.taken(1));
    assert_eq!(shelf.offer(1).map(|(message, _)| message.0), Some(2));
}

#[test]
fn no_more_expire_at_once_than_are_asked_for_and_those_first_that_are_over_longest() {
    let mut shelf = shelf();
    assert_eq!(names(shelf.take_expired(at(100), 3)), [4, 3, 2]);
    assert_eq!(names(shelf.take_expired(at(100), 3)), [6]);
    assert_eq!((shelf.next_expiry(), shelf.held()), (Time::MAX, vec![1]));
}

#[test]
fn a_line_whose_last_message_expires_is_over_but_not_while_one_is_offered() {
    let mut shelf = shelf();
    let change = shelf.change();
    assert_eq!(shelf.offer(2).map(|(message, _)| message.0), Some(3));
    assert_eq!(names(shelf.take_expired(at(100), 9)), [4, 2, 6]);
    assert_eq!((shelf.held(), shelf.change()), (vec![1, 2], change));
    shelf.put_back(2, Perishable(3, Some(20)), BYTES);
    assert_eq!(names(shelf.take_expired(at(100), 9)), [3], "what was put back expires, too");
    assert_eq!((shelf.held(), shelf.change()), (vec![1], change + 1));
}

#[derive(Clone, Debug)]
enum Step {
    Put(u64, Option<u64>),
    Offer(u64),
    Taken(u64),
    PutBack(u64),
    TakeBack(u64, u32),
    Expire(u64, usize),
    Useless(u32),
    Forget,
}

fn any_step() -> impl Strategy<Value = Step> {
    let line = 0..3_u64;
    prop_oneof![
        10 => (line.clone(), proptest::option::of(0..50_u64)).prop_map(|(line, expiry)| Step::Put(line, expiry)),
        4 => line.clone().prop_map(Step::Offer),
        2 => line.clone().prop_map(Step::Taken),
        3 => line.clone().prop_map(Step::PutBack),
        1 => (line, 0..40_u32).prop_map(|(line, name)| Step::TakeBack(line, name)),
        3 => (0..50_u64, 0..5_usize).prop_map(|(second, at_most)| Step::Expire(second, at_most)),
        1 => (0..7_u32).prop_map(Step::Useless),
        1 => Just(Step::Forget),
    ]
}

proptest! {
    /// What it does with an index is what a look at every message would do.
    #[test]
    fn whatever_happens_what_expires_is_what_a_look_at_all_finds(steps in proptest::collection::vec(any_step(), 1..200)) {
        let mut shelf = Shelf::<u64, Perishable>::new(LIMITS);
        // All that waits, in order, and what is offered.
        let mut all = Vec::<(u64, Perishable)>::new();
        let mut offered = BTreeMap::<u64, Perishable>::new();
        for (name, step) in (0..).zip(steps) {
            match step {
                Step::Put(line, expiry) => {
                    let message = Perishable(name, expiry);
                    shelf.put(line, message.clone(), BYTES).expect("there is room");
                    all.push((line, message));
                }
                Step::Offer(line) => {
                    let first = all.iter().position(|(its, _)| *its == line);
                    let first = first.filter(|_| !offered.contains_key(&line));
                    let expected = first.map(|place| all.remove(place).1);
                    offered.extend(expected.clone().map(|message| (line, message)));
                    prop_assert_eq!(shelf.offer(line).map(|(message, _)| message), expected);
                }
                Step::Taken(line) => if offered.remove(&line).is_some() {
                    let is_over = all.iter().all(|(its, _)| *its != line);
                    prop_assert_eq!(shelf.taken(line), is_over);
                },
                Step::PutBack(line) => if let Some(message) = offered.remove(&line) {
                    shelf.put_back(line, message.clone(), BYTES);
                    all.insert(0, (line, message));
                },
                Step::TakeBack(line, wanted) => {
                    let place = all.iter().rposition(|(its, message)| *its == line && message.0 == wanted);
                    let expected = place.map(|place| all.remove(place).1);
                    prop_assert_eq!(shelf.take_back(line, |message| message.0 == wanted), expected);
                }
                Step::Expire(second, at_most) => {
                    let expired = shelf.take_expired(at(second), at_most);
                    let over = all.iter().filter(|(_, message)| message.expiry() < at(second)).count();
                    prop_assert_eq!(expired.len(), over.min(at_most));
                    prop_assert!(expired.iter().is_sorted_by_key(Waits::expiry));
                    prop_assert!(expired.iter().all(|message| message.expiry() < at(second)));
                    all.retain(|(_, message)| !expired.contains(message));
                }
                Step::Useless(seventh) => {
                    let has_no_use = |message: &Perishable| message.0 % 7 == seventh;
                    let mut expected: Vec<_> = all.iter().filter(|(_, message)| has_no_use(message)).cloned().collect();
                    expected.sort_by_key(|(line, _)| *line);
                    let expected: Vec<_> = expected.into_iter().map(|(_, message)| message).collect();
                    all.retain(|(_, message)| !has_no_use(message));
                    prop_assert_eq!(shelf.take_useless(has_no_use), expected);
                }
                Step::Forget => {
                    offered.clear();
                    shelf.forget_offers();
                }
            }
            let next = all.iter().map(|(_, message)| message.expiry()).min().unwrap_or(Time::MAX);
            prop_assert_eq!((shelf.messages(), shelf.next_expiry()), (all.len(), next));
            let held: BTreeSet<_> = all.iter().map(|(line, _)| *line).chain(offered.keys().copied()).collect();
            prop_assert_eq!(shelf.held(), held.into_iter().collect::<Vec<_>>());
        }
    }
}
