//! Claims about single decisions. All histories are in `simulation`, all states in `table`.

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
fn a_child_is_started_when_the_one_before_it_is_ready() {
    let mut core = supervisor(Strategy::RestForOne, 2);
    assert_eq!(orders(&mut core), [Order::Spawn(ChildId(0), 1)]);
    core.handle(at(5), Input::BecameReady(ChildId(0), 1));
    assert_eq!(orders(&mut core), [Order::Ready(ChildId(0)), Order::Spawn(ChildId(1), 1)]);
    core.handle(at(6), Input::BecameReady(ChildId(1), 1));
    assert_eq!(orders(&mut core), [Order::Ready(ChildId(1)), Order::AllReady]);
}

#[test]
fn rest_for_one_stops_those_after_last_first_and_starts_them_again_in_order() {
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
fn an_event_of_an_earlier_life_is_ignored() {
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
fn too_many_restarts_in_the_window_end_it_with_words() {
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
fn a_child_that_never_becomes_ready_is_abandoned_and_tried_again() {
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
fn one_that_was_not_given_its_time_has_more_of_it_and_not_without_end() {
    let mut core = supervisor(Strategy::RestForOne, 2);
    all_ready(&mut core, 2);
    core.handle(at(10), Input::StopOrdered);
    orders(&mut core);
    let (deadline, later) = (core.next_wake().unwrap(), core.next_wake().unwrap() + Duration::from_secs(1));
    core.handle(deadline, Input::Reprieved(ChildId(1), 1, later));
    core.handle(deadline, Input::Reprieved(ChildId(1), 1, deadline));
    core.handle(deadline, Input::Reprieved(ChildId(1), 0, later + Duration::from_secs(1)));
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
fn stop_runs_backwards_and_abandons_who_does_not_obey() {
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
fn a_held_child_starts_when_it_is_released_and_waits_again_after_a_failure() {
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
fn a_release_that_comes_during_the_back_off_is_not_forgotten() {
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
fn a_terminated_child_stays_down_until_it_is_restarted_and_a_deleted_one_is_forgotten() {
    let mut core = core_of(Flags::default(), &[of(Restart::Permanent)]);
    core.handle(at(1), Input::TerminateChild(child(0)));
    assert_eq!(orders(&mut core), [Order::Stop(child(0), 1)]);
    core.handle(at(2), Input::Ended(child(0), 1, Reason::Normal));
    let stopped = [Order::Gone(child(0), Reason::Shutdown), Order::Done(Command::Terminate, child(0))];
    assert_eq!(orders(&mut core)[..2], stopped);
    core.handle(at(3), Input::RestartChild(child(0)));
    assert_eq!(orders(&mut core), [Order::Done(Command::Restart, child(0)), Order::Spawn(child(0), 2)]);
    core.handle(at(4), Input::DeleteChild(child(0)));
    assert_eq!(orders(&mut core), [Order::Refused(Command::Delete, child(0), Refusal::Running)]);
}

#[test]
fn one_that_takes_its_time_to_stop_keeps_no_independent_sibling_waiting() {
    let mut core = core_of(Flags::default(), &[of(Restart::Permanent), of(Restart::Permanent)]);
    core.handle(at(1), Input::TerminateChild(child(1)));
    core.handle(at(1), panicked(0, 1));
    orders(&mut core);
    core.handle(at(2), Input::TimePassed);
    assert_eq!(orders(&mut core), [Order::Spawn(child(0), 2)]);
}

#[test]
fn the_end_of_the_last_significant_child_is_the_end_of_all() {
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
fn a_temporary_child_that_is_stopped_with_its_group_has_done_its_work() {
    // Found by the simulation: it counted as working until it had stopped, and its supervisor lived on with nothing to do.
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
fn who_lost_its_thread_through_a_neighbour_does_not_pay_for_it() {
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
fn more_lives_that_do_not_let_go_than_allowed_end_it_and_one_that_let_go_does_not_count() {
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
fn the_same_seed_gives_the_same_waits_and_others_give_others() {
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

/// Lets the first child be started again; returns how long that took.
fn started_again(core: &mut Core, now: &mut Time) -> Duration {
    let due = core.next_wake().expect("it is tried again");
    let waited = due.since(*now);
    *now = due;
    core.handle(*now, Input::TimePassed);
    assert!(orders(core).iter().any(|order| matches!(order, Order::Spawn(..))));
    waited
}

#[test]
fn a_start_that_fails_by_a_call_is_tried_without_end_at_growing_intervals() {
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
fn panics_between_failed_starts_count_and_so_does_a_failed_start_of_one_that_was_ready() {
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
