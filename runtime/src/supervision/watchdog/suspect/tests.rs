//! Who is accused, and who has an excuse.

use super::*;
use crate::supervision::{vitals::Doing, watchdog::processor::Condition};

const MS: Duration = Duration::from_millis(1);
const PERIOD: Duration = Duration::from_millis(5);
const BUDGET: Duration = Duration::from_millis(100);

const fn ms(ms: u64) -> Time {
    Time::from_nanos(1_000_000_000 + ms * 1_000_000)
}

fn busy(turn: u64, begun: Option<Time>) -> Sight {
    Sight { turn, doing: Doing::Task, begun }
}

fn on_time(now: u64, sight: Sight) -> Look {
    Look { now: ms(now), late: Duration::ZERO, sight }
}

/// A thread that ran and waited for so many milliseconds.
fn cpu(ran: u64, waited: u64, condition: Condition) -> Option<Sample> {
    Some(Sample { ran: ran * 1_000_000, waited: waited * 1_000_000, condition })
}

/// The time of the first accusation, looking every 5 ms, when `sight` is seen at each look.
fn accused(
    sight: Sight,
    late: impl Fn(u64) -> Duration,
    sample: impl Fn(u64) -> Option<Sample>,
) -> Option<u64> {
    let mut suspect = TurnSuspect::new(BUDGET);
    (0..400).map(|look| look * 5).find(|now| {
        let look = Look { now: ms(*now), late: late(*now), sight };
        suspect.look(look, PERIOD, || sample(*now)).is_some()
    })
}

fn never_late(_: u64) -> Duration {
    Duration::ZERO
}

#[test]
fn a_turn_that_blocks_is_accused_when_its_budget_is_over() {
    let blocked = |_| cpu(0, 0, Condition::Blocked);
    assert_eq!(accused(busy(1, Some(ms(0))), never_late, blocked), Some(100));
    assert_eq!(accused(busy(1, None), never_late, blocked), Some(100), "counted from when it was seen first");
}

#[test]
fn a_turn_that_spins_is_accused_too() {
    let spins = |now| cpu(now, 0, Condition::Runnable);
    assert_eq!(accused(busy(1, Some(ms(0))), never_late, spins), Some(100));
}

#[test]
fn without_an_account_of_the_cpu_the_clock_alone_counts() {
    assert_eq!(accused(busy(1, Some(ms(0))), never_late, |_| None), Some(100));
}

#[test]
fn time_without_a_cpu_is_not_held_against_anybody() {
    // Given the CPU again at 500 ms, after 480 ms without; then it spins.
    let starved = |now| match now {
        0..=20 => cpu(now, 0, Condition::Runnable),
        21..500 => cpu(20, 0, Condition::Runnable),
        _ => cpu(now - 480, 480, Condition::Runnable),
    };
    assert_eq!(accused(busy(1, Some(ms(0))), never_late, starved), Some(580));
}

#[test]
fn a_thread_that_gets_no_cpu_at_all_is_never_accused() {
    assert_eq!(accused(busy(1, Some(ms(0))), never_late, |_| cpu(0, 0, Condition::Runnable)), None);
    assert_eq!(accused(busy(1, Some(ms(0))), never_late, |_| cpu(0, 0, Condition::Stopped)), None);
}

#[test]
fn a_process_that_was_stopped_does_not_accuse_its_actors_when_it_goes_on() {
    // Stopped from 10 to 910 ms: the look that was due at 10 comes 900 ms late.
    let mut suspect = TurnSuspect::new(BUDGET);
    let blocked = || cpu(0, 0, Condition::Blocked);
    let sight = busy(1, Some(ms(0)));
    assert_eq!(suspect.look(on_time(5, sight), PERIOD, blocked), None);
    let late = Look { now: ms(910), late: 900 * MS, sight };
    assert_eq!(suspect.look(late, PERIOD, blocked), None);
    assert_eq!(suspect.look(on_time(995, sight), PERIOD, blocked), None);
    let hang = suspect.look(on_time(1_000, sight), PERIOD, blocked).expect("now it is");
    assert_eq!((hang.lasted, hang.excused), (1_000 * MS, 900 * MS));
}

#[test]
fn a_turn_that_began_before_a_late_look_is_excused_for_it() {
    let mut suspect = TurnSuspect::new(BUDGET);
    let blocked = || cpu(0, 0, Condition::Blocked);
    let sight = busy(3, Some(ms(1)));
    let late = Look { now: ms(910), late: 900 * MS, sight };
    assert_eq!(suspect.look(late, PERIOD, blocked), None);
    assert_eq!(suspect.look(on_time(915, sight), PERIOD, blocked), None);
}

#[test]
fn turns_that_change_are_no_hang_however_busy() {
    let mut suspect = TurnSuspect::new(BUDGET);
    for look in 0..1_000 {
        let sight = busy(look * 2 + 1, None);
        assert_eq!(suspect.look(on_time(look * 5, sight), PERIOD, || None), None);
    }
}

#[test]
fn an_actor_that_rests_is_no_hang() {
    assert_eq!(accused(busy(2, Some(ms(0))), never_late, |_| None), None);
}

/// What is done at each look until something other than nothing and a probe is.
fn stall(
    turn: impl Fn(u64) -> u64,
    taken: impl Fn(u64) -> u64,
    waiting: usize,
    sample: impl Fn(u64) -> Option<Sample>,
) -> (Option<u64>, Option<(u64, Stall)>) {
    stall_beside(|_| Neighbours::default(), turn, taken, waiting, sample)
}

/// The same beside others on its thread.
fn stall_beside(
    neighbours: impl Fn(u64) -> Neighbours,
    turn: impl Fn(u64) -> u64,
    taken: impl Fn(u64) -> u64,
    waiting: usize,
    sample: impl Fn(u64) -> Option<Sample>,
) -> (Option<u64>, Option<(u64, Stall)>) {
    let mut suspect = StallSuspect::new(BUDGET);
    let mut probed = None;
    for now in (0..400).map(|look| look * 5) {
        let look = on_time(now, busy(turn(now), None));
        match suspect.look(look, (waiting, taken(now)), || neighbours(now), || sample(now)) {
            Stall::None => {}
            Stall::Probe => probed = Some(now),
            other @ (Stall::Waits(_) | Stall::ThreadIsAway(_)) => return (probed, Some((now, other))),
        }
    }
    (probed, None)
}

#[test]
fn one_that_has_its_turn_and_takes_nothing_waits_for_something_else() {
    let polled_when_probed = |now| if now > 50 { 4 } else { 2 };
    let (probed, end) = stall(polled_when_probed, |_| 7, 3, |_| None);
    // The first look sees that messages were taken.
    assert_eq!(probed, Some(50));
    assert!(matches!(end, Some((100, Stall::Waits(_)))), "{end:?}");
}

#[test]
fn one_whose_thread_does_not_come_to_it_is_told_apart() {
    let (_, end) = stall(|_| 2, |_| 7, 3, |_| cpu(0, 0, Condition::Blocked));
    assert!(matches!(end, Some((100, Stall::ThreadIsAway(_)))), "{end:?}");
    let (_, end) = stall(|_| 2, |_| 7, 3, |_| cpu(0, 0, Condition::Runnable));
    assert_eq!(end, None, "a thread that gets no CPU is not away");
}

#[test]
fn one_that_lets_messages_wait_is_looked_at_more_often_until_it_takes_one() {
    let mut suspect = StallSuspect::new(BUDGET);
    let mut is_open = |now, waiting, taken| {
        suspect.look(on_time(now, busy(2, None)), (waiting, taken), Neighbours::default, || None);
        suspect.is_open()
    };
    assert!(!is_open(0, 3, 7), "the first look");
    assert!(is_open(5, 3, 7));
    assert!(!is_open(10, 3, 8), "it has taken one");
    assert!(is_open(15, 3, 8));
    assert!(!is_open(20, 0, 8), "none waits");
}

#[test]
fn one_that_takes_messages_or_has_none_is_left_alone() {
    assert_eq!(stall(|_| 2, |now| now / 90, 3, |_| None).1, None);
    assert_eq!(stall(|_| 2, |_| 7, 0, |_| None), (None, None));
}

#[test]
fn one_whose_thread_gets_a_moment_of_cpu_and_waits_again_is_not_called_away() {
    // Woken by the probe at 50 ms it runs for a moment, and from then on another has its CPU.
    let rarely = |now| match now {
        0..55 => cpu(0, 0, Condition::Blocked),
        _ => cpu(1, 0, Condition::Runnable),
    };
    assert_eq!(stall(|_| 2, |_| 7, 3, rarely).1, None);
}

#[test]
fn one_whose_thread_is_with_its_neighbours_is_let_wait_also_between_two_of_their_turns() {
    let blocked = |_| cpu(0, 0, Condition::Blocked);
    let in_a_long_turn = |_| Neighbours { are_busy: true, turns: 1 };
    assert_eq!(stall_beside(in_a_long_turn, |_| 2, |_| 7, 3, blocked).1, None);
    // They have one turn after the other, and every look falls between two of them.
    let between_turns = |now| Neighbours { are_busy: false, turns: now / 50 * 2 };
    assert_eq!(stall_beside(between_turns, |_| 2, |_| 7, 3, blocked).1, None);
    // From 300 ms on none of them has a turn either: the thread is away.
    let until_300 = |now: u64| Neighbours { are_busy: false, turns: now.min(300) / 50 * 2 };
    let (_, end) = stall_beside(until_300, |_| 2, |_| 7, 3, blocked);
    assert!(matches!(end, Some((400, Stall::ThreadIsAway(_)))), "{end:?}");
}

#[test]
fn a_panic_has_time_for_a_hook_of_the_programs_own_and_not_for_ever() {
    let mut suspect = TurnSuspect::new(BUDGET);
    let sight = Sight { turn: 1, doing: Doing::Panic, begun: None };
    let accused = (0..4_000).map(|look| look * 5).find(|now| {
        let look = on_time(*now, sight);
        suspect.look(look, PERIOD, || cpu(0, 0, Condition::Blocked)).is_some()
    });
    assert_eq!(accused, Some(1_000));
}
