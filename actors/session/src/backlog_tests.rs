//! Expired messages of a line: found without a visit of the others, and removed at any position.

use std::{
    collections::{BTreeMap, BTreeSet},
    time::Duration,
};

use proptest::prelude::*;

use super::*;

const LIMITS: BacklogLimits =
    BacklogLimits { queues: 4, queue_messages: 1_000, queue_bytes: 100_000, messages: 4_000, bytes: 400_000 };
const BYTES: usize = 10;

/// A message, and the second after which it has no use.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Expiring(u32, Option<u64>);

impl Expires for Expiring {
    fn expiry(&self) -> Time {
        self.1.map_or(Time::MAX, at)
    }
}

fn at(second: u64) -> Time {
    Time::ZERO + Duration::from_secs(second)
}

fn names(messages: Vec<Expiring>) -> Vec<u32> {
    messages.into_iter().map(|Expiring(name, _)| name).collect()
}

/// Two lines; only 1 and 5 have a use forever.
fn backlog() -> ReceiveBacklog<u64, Expiring> {
    let mut backlog = ReceiveBacklog::new(LIMITS);
    for (line, name, expiry) in
        [(1, 1, None), (1, 2, Some(30)), (2, 3, Some(20)), (1, 4, Some(10)), (1, 5, None), (2, 6, Some(40))]
    {
        backlog.put(line, Expiring(name, expiry), BYTES).expect("there is room");
    }
    backlog
}

#[test]
fn only_expired_messages_are_removed_anywhere() {
    let mut backlog = backlog();
    assert_eq!(backlog.next_expiry(), at(10));
    assert_eq!(
        names(backlog.take_expired(at(10), 9)),
        [0; 0],
        "its last instant is one in which it has a use"
    );
    assert_eq!(names(backlog.take_expired(at(25), 9)), [4, 3]);
    assert_eq!((backlog.messages(), backlog.bytes(), backlog.next_expiry()), (4, 4 * BYTES, at(30)));
    assert_eq!(backlog.offer(1).map(|(message, _)| message.0), Some(1));
    assert!(!backlog.taken(1));
    assert_eq!(backlog.offer(1).map(|(message, _)| message.0), Some(2));
}

#[test]
fn oldest_expired_are_removed_first_up_to_limit() {
    let mut backlog = backlog();
    assert_eq!(names(backlog.take_expired(at(100), 3)), [4, 3, 2]);
    assert_eq!(names(backlog.take_expired(at(100), 3)), [6]);
    assert_eq!((backlog.next_expiry(), backlog.held()), (Time::MAX, vec![1]));
}

#[test]
fn line_ends_with_last_message_unless_one_is_offered() {
    let mut backlog = backlog();
    let change = backlog.change();
    assert_eq!(backlog.offer(2).map(|(message, _)| message.0), Some(3));
    assert_eq!(names(backlog.take_expired(at(100), 9)), [4, 2, 6]);
    assert_eq!((backlog.held(), backlog.change()), (vec![1, 2], change));
    backlog.put_back(2, Expiring(3, Some(20)), BYTES);
    assert_eq!(names(backlog.take_expired(at(100), 9)), [3], "what was put back expires, too");
    assert_eq!((backlog.held(), backlog.change()), (vec![1], change + 1));
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
    /// The index gives the same result as a visit of every message.
    #[test]
    fn expiry_index_matches_full_scan(steps in proptest::collection::vec(any_step(), 1..200)) {
        let mut backlog = ReceiveBacklog::<u64, Expiring>::new(LIMITS);
        // All waiting messages in order, and the offered ones.
        let mut all = Vec::<(u64, Expiring)>::new();
        let mut offered = BTreeMap::<u64, Expiring>::new();
        for (name, step) in (0..).zip(steps) {
            match step {
                Step::Put(line, expiry) => {
                    let message = Expiring(name, expiry);
                    backlog.put(line, message.clone(), BYTES).expect("there is room");
                    all.push((line, message));
                }
                Step::Offer(line) => {
                    let first = all.iter().position(|(its, _)| *its == line);
                    let first = first.filter(|_| !offered.contains_key(&line));
                    let expected = first.map(|place| all.remove(place).1);
                    offered.extend(expected.clone().map(|message| (line, message)));
                    prop_assert_eq!(backlog.offer(line).map(|(message, _)| message), expected);
                }
                Step::Taken(line) => if offered.remove(&line).is_some() {
                    let is_over = all.iter().all(|(its, _)| *its != line);
                    prop_assert_eq!(backlog.taken(line), is_over);
                },
                Step::PutBack(line) => if let Some(message) = offered.remove(&line) {
                    backlog.put_back(line, message.clone(), BYTES);
                    all.insert(0, (line, message));
                },
                Step::TakeBack(line, wanted) => {
                    let place = all.iter().rposition(|(its, message)| *its == line && message.0 == wanted);
                    let expected = place.map(|place| all.remove(place).1);
                    prop_assert_eq!(backlog.take_back(line, |message| message.0 == wanted), expected);
                }
                Step::Expire(second, at_most) => {
                    let expired = backlog.take_expired(at(second), at_most);
                    let over = all.iter().filter(|(_, message)| message.expiry() < at(second)).count();
                    prop_assert_eq!(expired.len(), over.min(at_most));
                    prop_assert!(expired.iter().is_sorted_by_key(Expires::expiry));
                    prop_assert!(expired.iter().all(|message| message.expiry() < at(second)));
                    all.retain(|(_, message)| !expired.contains(message));
                }
                Step::Useless(seventh) => {
                    let has_no_use = |message: &Expiring| message.0 % 7 == seventh;
                    let mut expected: Vec<_> = all.iter().filter(|(_, message)| has_no_use(message)).cloned().collect();
                    expected.sort_by_key(|(line, _)| *line);
                    let expected: Vec<_> = expected.into_iter().map(|(_, message)| message).collect();
                    all.retain(|(_, message)| !has_no_use(message));
                    prop_assert_eq!(backlog.take_useless(has_no_use), expected);
                }
                Step::Forget => {
                    offered.clear();
                    backlog.forget_offers();
                }
            }
            let next = all.iter().map(|(_, message)| message.expiry()).min().unwrap_or(Time::MAX);
            prop_assert_eq!((backlog.messages(), backlog.next_expiry()), (all.len(), next));
            let held: BTreeSet<_> = all.iter().map(|(line, _)| *line).chain(offered.keys().copied()).collect();
            prop_assert_eq!(backlog.held(), held.into_iter().collect::<Vec<_>>());
        }
    }
}
