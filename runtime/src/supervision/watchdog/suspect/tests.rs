//! Accusations of hung actors, and their exceptions.

use proptest::prelude::*;

use super::*;
use crate::supervision::{liveness::Activity, watchdog::processor::Condition};

const MS: Duration = Duration::from_millis(1);
const PERIOD: Duration = Duration::from_millis(5);
const BUDGET: Duration = Duration::from_millis(100);

const fn ms(ms: u64) -> Time {
    Time::from_nanos(1_000_000_000 + ms * 1_000_000)
}

fn busy(turn: u64, begun: Option<Time>) -> ActivitySnapshot {
    ActivitySnapshot { turn, activity: Activity::Task, begun }
}

fn on_time(now: u64, snapshot: ActivitySnapshot) -> Check {
    Check { now: ms(now), late: Duration::ZERO, snapshot }
}

/// A thread that ran and waited for this many milliseconds.
fn cpu(ran: u64, waited: u64, condition: Condition) -> Option<Sample> {
    Some(Sample { ran: ran * 1_000_000, waited: waited * 1_000_000, condition })
}

/// The time of the first accusation, with a check every 5 ms, when `snapshot` is seen at each check.
fn accused(
    snapshot: ActivitySnapshot,
    late: impl Fn(u64) -> Duration,
    sample: impl Fn(u64) -> Option<Sample>,
) -> Option<u64> {
    let mut suspect = TurnSuspect::new(BUDGET);
    (0..400).map(|check| check * 5).find(|now| {
        let check = Check { now: ms(*now), late: late(*now), snapshot };
        suspect.check(check, PERIOD, || sample(*now)).is_some()
    })
}

fn never_late(_: u64) -> Duration {
    Duration::ZERO
}

#[test]
fn blocked_turn_is_accused_after_its_budget() {
    let blocked = |_| cpu(0, 0, Condition::Blocked);
    assert_eq!(accused(busy(1, Some(ms(0))), never_late, blocked), Some(100));
    assert_eq!(accused(busy(1, None), never_late, blocked), Some(100), "counted from when it was seen first");
}

#[test]
fn spinning_turn_is_accused_too() {
    let spins = |now| cpu(now, 0, Condition::Runnable);
    assert_eq!(accused(busy(1, Some(ms(0))), never_late, spins), Some(100));
}

#[test]
fn without_cpu_account_only_the_clock_counts() {
    assert_eq!(accused(busy(1, Some(ms(0))), never_late, |_| None), Some(100));
}

#[test]
fn time_without_a_cpu_is_not_counted() {
    // Given the CPU again at 500 ms, after 480 ms without; then it spins.
    let starved = |now| match now {
        0..=20 => cpu(now, 0, Condition::Runnable),
        21..500 => cpu(20, 0, Condition::Runnable),
        _ => cpu(now - 480, 480, Condition::Runnable),
    };
    assert_eq!(accused(busy(1, Some(ms(0))), never_late, starved), Some(580));
}

#[test]
fn thread_without_any_cpu_is_never_accused() {
    assert_eq!(accused(busy(1, Some(ms(0))), never_late, |_| cpu(0, 0, Condition::Runnable)), None);
    assert_eq!(accused(busy(1, Some(ms(0))), never_late, |_| cpu(0, 0, Condition::Stopped)), None);
}

#[test]
fn stopped_process_does_not_accuse_its_actors() {
    // Stopped from 10 to 910 ms: the check that was due at 10 comes 900 ms late.
    let mut suspect = TurnSuspect::new(BUDGET);
    let blocked = || cpu(0, 0, Condition::Blocked);
    let snapshot = busy(1, Some(ms(0)));
    assert_eq!(suspect.check(on_time(5, snapshot), PERIOD, blocked), None);
    let late = Check { now: ms(910), late: 900 * MS, snapshot };
    assert_eq!(suspect.check(late, PERIOD, blocked), None);
    assert_eq!(suspect.check(on_time(995, snapshot), PERIOD, blocked), None);
    let hang = suspect.check(on_time(1_000, snapshot), PERIOD, blocked).expect("now it is");
    assert_eq!((hang.lasted, hang.excused), (1_000 * MS, 900 * MS));
}

#[test]
fn turn_before_a_late_check_is_excused() {
    let mut suspect = TurnSuspect::new(BUDGET);
    let blocked = || cpu(0, 0, Condition::Blocked);
    let snapshot = busy(3, Some(ms(1)));
    let late = Check { now: ms(910), late: 900 * MS, snapshot };
    assert_eq!(suspect.check(late, PERIOD, blocked), None);
    assert_eq!(suspect.check(on_time(915, snapshot), PERIOD, blocked), None);
}

#[test]
fn changing_turns_are_no_hang() {
    let mut suspect = TurnSuspect::new(BUDGET);
    for check in 0..1_000 {
        let snapshot = busy(check * 2 + 1, None);
        assert_eq!(suspect.check(on_time(check * 5, snapshot), PERIOD, || None), None);
    }
}

#[test]
fn idle_actor_is_no_hang() {
    assert_eq!(accused(busy(2, Some(ms(0))), never_late, |_| None), None);
}

/// The first action of the checks other than none and a probe.
fn stall(
    turn: impl Fn(u64) -> u64,
    taken: impl Fn(u64) -> u64,
    waiting: usize,
    sample: impl Fn(u64) -> Option<Sample>,
) -> (Option<u64>, Option<(u64, Stall)>) {
    stall_beside(|_| Neighbours::default(), turn, taken, waiting, sample)
}

/// The same, with neighbours on its thread.
fn stall_beside(
    neighbours: impl Fn(u64) -> Neighbours,
    turn: impl Fn(u64) -> u64,
    taken: impl Fn(u64) -> u64,
    waiting: usize,
    sample: impl Fn(u64) -> Option<Sample>,
) -> (Option<u64>, Option<(u64, Stall)>) {
    let mut suspect = StallSuspect::new(BUDGET);
    let mut probed = None;
    for now in (0..400).map(|check| check * 5) {
        let check = on_time(now, busy(turn(now), None));
        let backlog = Backlog { waiting, taken: taken(now), since: None };
        match suspect.check(check, backlog, || neighbours(now), || sample(now)) {
            Stall::None => {}
            Stall::Probe => probed = Some(now),
            other @ (Stall::Waits(_) | Stall::ThreadIsAway(_)) => return (probed, Some((now, other))),
        }
    }
    (probed, None)
}

#[test]
fn stalled_actor_waits_for_something_else() {
    let polled_when_probed = |now| if now > 50 { 4 } else { 2 };
    let (probed, end) = stall(polled_when_probed, |_| 7, 3, |_| None);
    // The first check sees that messages were received.
    assert_eq!(probed, Some(50));
    assert!(matches!(end, Some((100, Stall::Waits(_)))), "{end:?}");
}

#[test]
fn blocked_thread_is_distinguished() {
    let (_, end) = stall(|_| 2, |_| 7, 3, |_| cpu(0, 0, Condition::Blocked));
    assert!(matches!(end, Some((100, Stall::ThreadIsAway(_)))), "{end:?}");
    let (_, end) = stall(|_| 2, |_| 7, 3, |_| cpu(0, 0, Condition::Runnable));
    assert_eq!(end, None, "a thread that gets no CPU is not away");
}

#[test]
fn actor_with_waiting_messages_is_checked_more_often() {
    let mut suspect = StallSuspect::new(BUDGET);
    let mut is_open = |now, waiting, taken| {
        let backlog = Backlog { waiting, taken, since: None };
        suspect.check(on_time(now, busy(2, None)), backlog, Neighbours::default, || None);
        suspect.is_open()
    };
    assert!(!is_open(0, 3, 7), "the first check");
    assert!(is_open(5, 3, 7));
    assert!(!is_open(10, 3, 8), "it has taken one");
    assert!(is_open(15, 3, 8));
    assert!(!is_open(20, 0, 8), "none waits");
}

#[test]
fn messages_of_stopping_actor_do_not_count_as_waiting() {
    let mut suspect = StallSuspect::new(BUDGET);
    let backlog = Backlog { waiting: 3, taken: 7, since: None };
    suspect.check(on_time(0, busy(2, None)), backlog, Neighbours::default, || None);
    assert!(suspect.has_waiting());
    suspect.reset(ms(5));
    assert!(!suspect.has_waiting());
}

#[test]
fn active_or_idle_actor_is_left_alone() {
    assert_eq!(stall(|_| 2, |now| now / 90, 3, |_| None).1, None);
    assert_eq!(stall(|_| 2, |_| 7, 0, |_| None), (None, None));
}

#[test]
fn thread_that_rarely_gets_a_cpu_is_not_abandoned() {
    // Woken by the probe at 50 ms it runs for a moment, and from then on another thread has its CPU.
    let rarely = |now| match now {
        0..55 => cpu(0, 0, Condition::Blocked),
        _ => cpu(1, 0, Condition::Runnable),
    };
    assert_eq!(stall(|_| 2, |_| 7, 3, rarely).1, None);
}

#[test]
fn actor_behind_busy_neighbours_is_let_wait() {
    let blocked = |_| cpu(0, 0, Condition::Blocked);
    let in_a_long_turn = |_| Neighbours { are_busy: true, turns: 1 };
    assert_eq!(stall_beside(in_a_long_turn, |_| 2, |_| 7, 3, blocked).1, None);
    // They have one turn after the other, and every check falls between two of them.
    let between_turns = |now| Neighbours { are_busy: false, turns: now / 50 * 2 };
    assert_eq!(stall_beside(between_turns, |_| 2, |_| 7, 3, blocked).1, None);
    // From 300 ms on none of them has a turn either: the thread hangs elsewhere.
    let until_300 = |now: u64| Neighbours { are_busy: false, turns: now.min(300) / 50 * 2 };
    let (_, end) = stall_beside(until_300, |_| 2, |_| 7, 3, blocked);
    assert!(matches!(end, Some((400, Stall::ThreadIsAway(_)))), "{end:?}");
}

#[test]
fn panic_has_limited_time_for_a_user_hook() {
    let mut suspect = TurnSuspect::new(BUDGET);
    let snapshot = ActivitySnapshot { turn: 1, activity: Activity::Panic, begun: None };
    let accused = (0..4_000).map(|check| check * 5).find(|now| {
        let check = on_time(*now, snapshot);
        suspect.check(check, PERIOD, || cpu(0, 0, Condition::Blocked)).is_some()
    });
    assert_eq!(accused, Some(1_000));
}

/// Longest time between two checks at rest, of this budget.
const RESTING: u64 = 25;

proptest! {
    /// The turn begins between two rare checks, and its thread waits for a CPU before that and after.
    #[test]
    fn turn_begun_at_rest_is_accused_in_time(
        begun in 0..RESTING,
        waited_before in 0_u64..10,
        waited_after in 0_u64..30,
    ) {
        let mut suspect = TurnSuspect::new(BUDGET);
        let thread = |waited| cpu(1, 1_000 + waited, Condition::Blocked);
        let idle = on_time(0, busy(2, Some(ms(0))));
        prop_assert_eq!(suspect.check(idle, PERIOD, || thread(0)), None);
        let (snapshot, waited) = (busy(3, Some(ms(begun))), waited_before + waited_after);
        let first = on_time(RESTING, snapshot);
        prop_assert_eq!(suspect.check(first, PERIOD, || thread(waited)), None);
        suspect.excuse_start(first, 1_000_000_000, thread(waited));
        prop_assert!(suspect.is_open());
        let accused = (RESTING..400).find(|now| {
            suspect.check(on_time(*now, snapshot), PERIOD, || thread(waited)).is_some()
        });
        // No more is excused than the time from the start to the first check.
        let excused = waited.min(RESTING - begun);
        prop_assert_eq!(accused, Some(begun + 100 + excused));
        prop_assert_eq!(suspect.deadline(snapshot), Some(ms(begun + 100 + excused)));
    }

    /// Messages begin to wait between two rare checks; the mailbox has recorded when. Others may have been taken
    /// between the first check and that time.
    #[test]
    fn messages_waiting_since_rest_are_missed_in_time(
        since in 0..RESTING,
        taken_before in 0_u64..3,
    ) {
        let mut suspect = StallSuspect::new(BUDGET);
        let mut check = |now: u64, waiting, since| {
            let taken = if now == 0 { 7 } else { 7 + taken_before };
            let backlog = Backlog { waiting, taken, since };
            suspect.check(on_time(now, busy(2, None)), backlog, Neighbours::default, || None)
        };
        prop_assert_eq!(check(0, 0, None), Stall::None);
        let (mut probed, mut accused) = (None, None);
        for now in RESTING..400 {
            match check(now, 3, Some(ms(since))) {
                Stall::None => {}
                Stall::Probe => probed = Some(now),
                Stall::Waits(_) | Stall::ThreadIsAway(_) => {
                    accused = accused.or(Some(now));
                }
            }
        }
        prop_assert_eq!((probed, accused), (Some(since + 50), Some(since + 100)));
    }
}

#[test]
fn lateness_before_first_check_of_waiting_messages_is_excused() {
    // The process is stopped from 10 to 910 ms; the messages wait since 5 ms.
    let mut suspect = StallSuspect::new(BUDGET);
    let mut check = |now, late: u64, waiting, taken| {
        let check = Check { late: Duration::from_millis(late), ..on_time(now, busy(2, None)) };
        let backlog = Backlog { waiting, taken, since: Some(ms(5)).filter(|_| waiting > 0) };
        suspect.check(check, backlog, Neighbours::default, || None)
    };
    assert_eq!(check(0, 0, 0, 7), Stall::None);
    assert_eq!([check(910, 900, 3, 8), check(915, 0, 3, 8)], [Stall::None, Stall::Probe]);
    assert_eq!(check(1_004, 0, 3, 8), Stall::None);
    assert!(matches!(check(1_005, 0, 3, 8), Stall::ThreadIsAway(_)));
}

#[test]
fn record_of_a_former_incarnation_is_ignored() {
    let mut suspect = StallSuspect::new(BUDGET);
    let mut check = |now| {
        let backlog = Backlog { waiting: 3, taken: 7, since: Some(ms(1)) };
        suspect.check(on_time(now, busy(2, None)), backlog, Neighbours::default, || None)
    };
    assert_eq!(check(200), Stall::None);
    assert_eq!([check(249), check(250)], [Stall::None, Stall::Probe]);
}

#[test]
fn former_record_of_waiting_messages_is_ignored() {
    let mut suspect = StallSuspect::new(BUDGET);
    let backlog = |waiting| Backlog { waiting, taken: 7, since: Some(ms(1)) };
    let mut check = |now: u64, waiting| {
        suspect.check(on_time(now, busy(2, None)), backlog(waiting), Neighbours::default, || None)
    };
    assert_eq!(check(0, 0), Stall::None);
    assert_eq!(check(40, 0), Stall::None);
    assert_eq!([check(80, 3), check(89, 3), check(90, 3)], [Stall::None, Stall::None, Stall::Probe]);
}
