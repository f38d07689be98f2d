//! Tests of single decisions. `tests/runtime/tests/simulation` covers all histories, `table` all states.

use std::time::Duration;

use super::*;
use crate::time::Time;

const MS: u64 = 1_000_000;

fn at(ms: u64) -> Time {
    Time::from_nanos((ms + 1) * MS)
}

fn supervisor(strategy: Strategy, children: usize) -> Core {
    let mut core =
        Core::new(strategy.into(), 0, (0..children).map(|index| (child(index), Policy::default())).collect());
    core.handle(at(0), Input::Started);
    core
}

fn orders(core: &mut Core) -> Vec<Order> {
    std::iter::from_fn(|| core.poll()).collect()
}

/// Makes all children ready, in order.
fn all_ready(core: &mut Core, children: usize) {
    for index in 0..children {
        core.handle(at(0), Input::BecameReady(child(index), 1));
    }
    orders(core);
}

fn child(index: usize) -> ChildId {
    ChildId(index as u64)
}

fn panicked(index: usize, generation: u64) -> Input {
    Input::Ended(child(index), generation, Reason::Panic("oh".into()))
}

#[test]
fn child_starts_when_the_one_before_is_ready() {
    let mut core = supervisor(Strategy::RestForOne, 2);
    assert_eq!(orders(&mut core), [Order::Spawn(ChildId(0), 1)]);
    core.handle(at(5), Input::BecameReady(ChildId(0), 1));
    assert_eq!(orders(&mut core), [Order::Ready(ChildId(0)), Order::Spawn(ChildId(1), 1)]);
    core.handle(at(6), Input::BecameReady(ChildId(1), 1));
    assert_eq!(orders(&mut core), [Order::Ready(ChildId(1)), Order::AllReady]);
}

#[test]
fn rest_for_one_restarts_later_children_in_order() {
    let mut core = supervisor(Strategy::RestForOne, 3);
    all_ready(&mut core, 3);
    core.handle(at(10), panicked(0, 1));
    assert_eq!(orders(&mut core)[1..], [Order::Stop(ChildId(2), 1)]);
    core.handle(at(11), Input::Ended(ChildId(2), 1, Reason::Shutdown));
    assert_eq!(orders(&mut core)[1..], [Order::Stop(ChildId(1), 1)]);
    core.handle(at(12), Input::Ended(ChildId(1), 1, Reason::Shutdown));
    assert_eq!(orders(&mut core)[1..], [Order::Spawn(ChildId(0), 2)]);
    core.handle(at(13), Input::BecameReady(ChildId(0), 2));
    assert_eq!(orders(&mut core), [Order::Ready(ChildId(0)), Order::Spawn(ChildId(1), 2)]);
}

#[test]
fn one_for_one_leaves_the_siblings_alone() {
    let mut core = supervisor(Strategy::OneForOne, 2);
    all_ready(&mut core, 2);
    core.handle(at(10), panicked(0, 1));
    assert_eq!(orders(&mut core), [Order::Failed(ChildId(0), Reason::Panic("oh".into()))]);
    core.handle(core.next_wake().unwrap(), Input::TimePassed);
    assert_eq!(orders(&mut core), [Order::Spawn(ChildId(0), 2)]);
}

#[test]
fn event_of_an_earlier_incarnation_is_ignored() {
    let mut core = supervisor(Strategy::OneForOne, 1);
    all_ready(&mut core, 1);
    core.handle(at(10), panicked(0, 1));
    core.handle(core.next_wake().unwrap(), Input::TimePassed);
    orders(&mut core);
    core.handle(at(20), panicked(0, 1));
    core.handle(at(20), Input::BecameReady(ChildId(0), 1));
    assert_eq!(orders(&mut core), []);
}

#[test]
fn too_many_restarts_in_the_window_end_it() {
    let mut core = supervisor(Strategy::OneForOne, 2);
    all_ready(&mut core, 2);
    for generation in 1..=6 {
        core.handle(at(generation * 20), panicked(0, generation));
        if generation < 6 {
            core.handle(core.next_wake().unwrap(), Input::TimePassed);
        }
    }
    assert!(orders(&mut core).contains(&Order::Stop(ChildId(1), 1)), "the sibling is stopped in order");
    core.handle(at(200), Input::Ended(ChildId(1), 1, Reason::Shutdown));
    let last = orders(&mut core).pop();
    assert!(matches!(last, Some(Order::Ended(Reason::GaveUp(why))) if why.contains("oh")));
}

#[test]
fn child_that_never_becomes_ready_is_retried() {
    let mut core = supervisor(Strategy::RestForOne, 1);
    orders(&mut core);
    core.handle(core.next_wake().unwrap(), Input::TimePassed);
    assert_eq!(
        orders(&mut core),
        [Order::Abandon(ChildId(0), 1), Order::Failed(ChildId(0), Reason::StartTimeout)]
    );
    core.handle(core.next_wake().unwrap(), Input::TimePassed);
    assert_eq!(orders(&mut core), [Order::Spawn(ChildId(0), 2)]);
}

#[test]
fn extended_deadline_ends_at_the_latest_extension() {
    let mut core = supervisor(Strategy::RestForOne, 2);
    all_ready(&mut core, 2);
    core.handle(at(10), Input::StopOrdered);
    orders(&mut core);
    let (deadline, later) = (core.next_wake().unwrap(), core.next_wake().unwrap() + Duration::from_secs(1));
    core.handle(deadline, Input::DeadlineExtended(ChildId(1), 1, later));
    core.handle(deadline, Input::DeadlineExtended(ChildId(1), 1, deadline));
    core.handle(deadline, Input::DeadlineExtended(ChildId(1), 0, later + Duration::from_secs(1)));
    core.handle(deadline, Input::TimePassed);
    assert_eq!((orders(&mut core), core.next_wake()), (vec![], Some(later)));
    core.handle(later, Input::TimePassed);
    assert_eq!(orders(&mut core)[0], Order::Abandon(ChildId(1), 1));
    let kept = |core: &Core| core.child(ChildId(1)).map(|child| child.abandoned);
    assert_eq!(kept(&core), Some(1), "it keeps its thread");
    core.handle(later, Input::Ended(ChildId(1), 1, Reason::Killed));
    assert_eq!(kept(&core), Some(0));
}

#[test]
fn stop_runs_in_reverse_and_abandons_late_children() {
    let mut core = supervisor(Strategy::RestForOne, 2);
    all_ready(&mut core, 2);
    core.handle(at(10), Input::StopOrdered);
    assert_eq!(orders(&mut core), [Order::Stop(ChildId(1), 1)]);
    core.handle(core.next_wake().unwrap(), Input::TimePassed);
    let seen = orders(&mut core);
    assert_eq!(seen[0], Order::Abandon(ChildId(1), 1));
    assert_eq!(seen.last(), Some(&Order::Stop(ChildId(0), 1)));
    core.handle(at(600), Input::Ended(ChildId(0), 1, Reason::Shutdown));
    assert_eq!(orders(&mut core).last(), Some(&Order::Ended(Reason::Shutdown)));
}

#[test]
fn held_child_waits_for_release_also_after_a_failure() {
    let policy = Policy { held: true, ..Policy::default() };
    let mut core = Core::new(Strategy::OneForOne.into(), 0, vec![(ChildId(0), policy)]);
    core.handle(at(0), Input::Started);
    assert_eq!(orders(&mut core), []);
    core.handle(at(1), Input::Released(ChildId(0)));
    assert_eq!(orders(&mut core), [Order::Spawn(ChildId(0), 1)]);
    core.handle(at(2), Input::BecameReady(ChildId(0), 1));
    core.handle(at(3), panicked(0, 1));
    core.handle(core.next_wake().unwrap(), Input::TimePassed);
    assert!(!orders(&mut core).contains(&Order::Spawn(ChildId(0), 2)));
    core.handle(at(30), Input::Released(ChildId(0)));
    assert_eq!(orders(&mut core), [Order::Spawn(ChildId(0), 2)]);
}

#[test]
fn release_during_the_back_off_is_kept() {
    let policy = Policy { held: true, ..Policy::default() };
    let mut core = Core::new(Strategy::OneForOne.into(), 0, vec![(ChildId(0), policy)]);
    core.handle(at(0), Input::Started);
    core.handle(at(0), Input::Released(ChildId(0)));
    core.handle(at(1), panicked(0, 1));
    core.handle(at(1), Input::Released(ChildId(0)));
    orders(&mut core);
    core.handle(core.next_wake().unwrap(), Input::TimePassed);
    assert_eq!(orders(&mut core), [Order::Spawn(ChildId(0), 2)]);
}

fn core_of(flags: Flags, policies: &[Policy]) -> Core {
    let children =
        policies.iter().enumerate().map(|(index, policy)| (child(index), policy.clone())).collect();
    let mut core = Core::new(flags, 0, children);
    core.handle(at(0), Input::Started);
    all_ready(&mut core, policies.len());
    core
}

fn of(restart: Restart) -> Policy {
    Policy { restart, ..Policy::default() }
}

#[test]
fn terminated_child_stays_down_and_deleted_one_is_gone() {
    let mut core = core_of(Flags::default(), &[of(Restart::Permanent)]);
    core.handle(at(1), Input::TerminateChild(child(0)));
    assert_eq!(orders(&mut core), [Order::Stop(child(0), 1)]);
    core.handle(at(2), Input::Ended(child(0), 1, Reason::Normal));
    let stopped = [Order::Gone(child(0), Reason::Shutdown), Order::Done(Command::Terminate, child(0))];
    assert_eq!(orders(&mut core)[..2], stopped);
    core.handle(at(3), Input::RestartChild(child(0)));
    assert_eq!(orders(&mut core), [Order::Done(Command::Restart, child(0)), Order::Spawn(child(0), 2)]);
    core.handle(at(4), Input::DeleteChild(child(0)));
    assert_eq!(orders(&mut core), [Order::Refused(Command::Delete, child(0), ChildCommandError::Running)]);
}

#[test]
fn slow_stop_does_not_delay_independent_siblings() {
    let mut core = core_of(Flags::default(), &[of(Restart::Permanent), of(Restart::Permanent)]);
    core.handle(at(1), Input::TerminateChild(child(1)));
    core.handle(at(1), panicked(0, 1));
    orders(&mut core);
    core.handle(at(2), Input::TimePassed);
    assert_eq!(orders(&mut core), [Order::Spawn(child(0), 2)]);
}

#[test]
fn end_of_the_last_significant_child_ends_all() {
    let flags = Flags { auto_shutdown: AutoShutdown::AllSignificant, ..Flags::default() };
    let works = Policy { significant: true, ..of(Restart::Transient) };
    let mut core = core_of(flags, &[works.clone(), works, of(Restart::Permanent)]);
    core.handle(at(1), Input::Ended(child(0), 1, Reason::Normal));
    assert!(!orders(&mut core).contains(&Order::Stop(child(2), 1)), "one still works");
    core.handle(at(2), Input::Ended(child(1), 1, Reason::Normal));
    assert!(orders(&mut core).contains(&Order::Stop(child(2), 1)));
    core.handle(at(3), Input::Ended(child(2), 1, Reason::Normal));
    assert_eq!(orders(&mut core).pop(), Some(Order::Ended(Reason::Shutdown)));
}

#[test]
fn temporary_child_stopped_with_its_group_is_finished() {
    // Found by the simulation: it counted as working until it had stopped, and its supervisor remained
    // without any work.
    let flags = Flags { auto_shutdown: AutoShutdown::AllSignificant, ..Strategy::RestForOne.into() };
    let works = |restart| Policy { significant: true, ..of(restart) };
    let mut core =
        core_of(flags, &[works(Restart::Transient), of(Restart::Permanent), works(Restart::Temporary)]);
    core.handle(at(1), panicked(1, 1));
    core.handle(at(1), Input::Ended(child(0), 1, Reason::Normal));
    core.handle(at(1), Input::Ended(child(2), 1, Reason::Normal));
    assert_eq!(orders(&mut core).pop(), Some(Order::Ended(Reason::Shutdown)));
}

#[test]
fn thread_loss_by_a_neighbour_is_not_counted() {
    let flags =
        Flags { intensity: Intensity { restarts_max: 0, ..Intensity::default() }, ..Flags::default() };
    let mut core = core_of(flags, &[of(Restart::Permanent)]);
    core.handle(at(1), Input::Ended(child(0), 1, Reason::ThreadEnded));
    core.handle(core.next_wake().unwrap(), Input::TimePassed);
    assert_eq!(orders(&mut core).pop(), Some(Order::Spawn(child(0), 2)));
    core.handle(at(5), panicked(0, 2));
    assert!(matches!(orders(&mut core).pop(), Some(Order::Ended(Reason::GaveUp(_)))));
}

#[test]
fn too_many_abandoned_incarnations_end_it() {
    let flags = Flags { abandoned_max: 1, ..Flags::default() };
    let mut core = core_of(flags, &[of(Restart::Permanent)]);
    let hung = |generation| Input::Hung(child(0), generation, Reason::Hung("busy".into()));
    for generation in 1..=2 {
        core.handle(at(generation * 100), hung(generation));
        core.handle(at(generation * 100 + 1), Input::Ended(child(0), generation, Reason::Killed));
        core.handle(at(generation * 100 + 50), Input::TimePassed);
        assert!(!core.is_ending());
    }
    core.handle(at(300), hung(3));
    core.handle(at(350), Input::TimePassed);
    assert!(!core.is_ending());
    core.handle(at(400), hung(4));
    assert!(
        matches!(orders(&mut core).pop(), Some(Order::Ended(Reason::GaveUp(why))) if why.contains("let go"))
    );
}

#[test]
fn same_seed_gives_the_same_waits() {
    let wait = |seed| {
        let policy = Policy { backoff_min: Duration::from_millis(100), ..Policy::default() };
        let mut core = Core::new(Flags::default(), seed, vec![(child(0), policy)]);
        core.handle(at(0), Input::Started);
        core.handle(at(0), panicked(0, 1));
        core.next_wake().unwrap().since(at(0))
    };
    assert_eq!(wait(7), wait(7));
    let waits: BTreeSet<_> = (0..100).map(wait).collect();
    assert!(waits.len() > 50);
    assert!(waits.iter().all(|wait| (75..=100).contains(&wait.as_millis())), "{waits:?}");
}

fn cannot_start(generation: u64) -> Input {
    Input::Ended(child(0), generation, Reason::StartFailed("no device".to_owned()))
}

/// Restarts the first child; returns the time until the restart.
fn started_again(core: &mut Core, now: &mut Time) -> Duration {
    let due = core.next_wake().expect("it is tried again");
    let waited = due.since(*now);
    *now = due;
    core.handle(*now, Input::TimePassed);
    assert!(orders(core).iter().any(|order| matches!(order, Order::Spawn(..))));
    waited
}

#[test]
fn start_that_fails_by_a_call_is_retried_forever() {
    let mut core = supervisor(Strategy::OneForOne, 1);
    orders(&mut core);
    let (mut now, mut waits) = (at(0), Vec::new());
    for generation in 1..=20 {
        core.handle(now, cannot_start(generation));
        assert_eq!(core.child(child(0)).expect("it is there").cannot_start_since, Some(at(0)));
        waits.push(started_again(&mut core, &mut now));
    }
    let StartRetry { wait_min, wait_max, .. } = StartRetry::default();
    assert!(waits[0] <= wait_min && waits[0] >= wait_min * 3 / 4, "{waits:?}");
    assert!(waits[19] <= wait_max && waits[19] >= wait_max * 3 / 4, "{waits:?}");
    assert_eq!(core.restarts_in_window(now), 0);
    core.handle(now, Input::BecameReady(child(0), 21));
    assert_eq!(core.child(child(0)).expect("it is there").cannot_start_since, None);
}

#[test]
fn panics_between_failed_starts_are_counted() {
    let mut core = supervisor(Strategy::OneForOne, 1);
    orders(&mut core);
    let mut now = at(0);
    core.handle(now, cannot_start(1));
    started_again(&mut core, &mut now);
    core.handle(now, panicked(0, 2));
    assert_eq!(core.restarts_in_window(now), 1);
    started_again(&mut core, &mut now);
    core.handle(now, Input::BecameReady(child(0), 3));
    core.handle(now, cannot_start(3));
    assert_eq!(core.restarts_in_window(now), 2);
}

#[test]
fn failed_starts_count_when_their_time_is_over() {
    let start_retry = StartRetry { give_up_after: Some(Duration::from_secs(1)), ..StartRetry::default() };
    let policy = Policy { start_retry, ..Policy::default() };
    let mut core = Core::new(Strategy::OneForOne.into(), 0, vec![(child(0), policy)]);
    core.handle(at(0), Input::Started);
    orders(&mut core);
    let mut now = at(0);
    for generation in 1..1_000 {
        core.handle(now, cannot_start(generation));
        if core.is_ending() {
            assert!(now.since(at(0)) >= Duration::from_secs(1));
            return;
        }
        started_again(&mut core, &mut now);
    }
    panic!("it never gives up");
}
