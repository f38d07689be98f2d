//! The guarantees of monitors: claims, and in [`world`] two nodes with an unreliable link.

mod world;

use std::time::Duration;

use sinew_model::cause::Cause;
use sinew_runtime::{
    monitor::{Down, DownClass, MonitorError, MonitorId},
    tid::{AppAddress, Incarnation, NodeAddress, Tid},
    time::Time,
};

use super::{
    Core, Input,
    core::{MISSING_INTERVAL, MONITORS_MAX, Output, PER_WATCHER_MAX, REPEAT},
    protocol::{LifeState, Lives, Watch},
};

const HERE: NodeAddress = NodeAddress::new(0x7f00_0001);
const THERE: NodeAddress = NodeAddress::new(0x7f00_0002);
const INCARNATION: Incarnation = Incarnation(5);

fn app(index: u32) -> AppAddress {
    AppAddress::fixed(index).unwrap()
}

fn panicked() -> Cause {
    Cause::new(DownClass::Panic, "panicked: its end")
}

fn ended(index: u32, is_gone: bool) -> Input {
    Input::Ended { app: app(index), cause: panicked(), is_gone }
}

/// A core and its clock.
struct Bench {
    core: Core,
    now: Time,
}

impl Bench {
    fn new() -> Self {
        Self { core: Core::new(HERE, INCARNATION, 4, 1 << 20), now: Time::from_nanos(1_000_000_000) }
    }

    fn handle(&mut self, input: Input) -> Vec<Output> {
        self.core.handle(self.now, input);
        std::iter::from_fn(|| self.core.poll()).collect()
    }

    fn monitors(&mut self, watcher: u32, target: Tid) -> (Result<MonitorId, MonitorError>, Vec<Output>) {
        let set = self.core.monitor(self.now, app(watcher), target);
        (set, std::iter::from_fn(|| self.core.poll()).collect())
    }
}

fn downs(outputs: &[Output]) -> Vec<(AppAddress, Down)> {
    let down = |output: &Output| match output {
        Output::Notify { watcher, down } => Some((*watcher, down.clone())),
        Output::Watch { .. } | Output::Lives { .. } => None,
    };
    outputs.iter().filter_map(down).collect()
}

fn classes(outputs: &[Output]) -> Vec<DownClass> {
    downs(outputs).into_iter().map(|(_, down)| down.class).collect()
}

// spec: MON-1
#[test]
fn each_watcher_is_notified_once_of_an_end() {
    let mut bench = Bench::new();
    bench.handle(Input::Started { app: app(0) });
    let first = bench.monitors(1, Tid::new(HERE, app(0))).0.unwrap();
    let second = bench.monitors(2, Tid::new(HERE, app(0))).0.unwrap();
    let notified = downs(&bench.handle(ended(0, false)));
    let down = |monitor| Down {
        monitor,
        tid: Tid::new(HERE, app(0)),
        class: DownClass::Panic,
        why: "panicked: its end".to_owned(),
    };
    assert_eq!(notified, [(app(1), down(first)), (app(2), down(second))]);
    assert_eq!(bench.handle(ended(0, false)), [], "no monitor was set on the next life");
}

// spec: MON-7
#[test]
fn reused_address_keeps_its_last_end() {
    let mut bench = Bench::new();
    // Given: an application that ends twice, and then as many others as are remembered beside it
    for index in [0].into_iter().chain(0..1_024) {
        bench.handle(Input::Started { app: app(index) });
        bench.handle(ended(index, true));
    }
    // When
    let watch = Watch { incarnation: INCARNATION, version: 1, apps: vec![app(0)] };
    let notified = bench.handle(Input::Watch { from: THERE, watch });
    // Then
    let [Output::Lives { lives, .. }] = &notified[..] else { panic!("{notified:?}") };
    let cause = lives.lives[0].ended.as_ref().map(|ended| ended.cause.class);
    assert_eq!(cause, Some(DownClass::Panic));
}

// spec: MON-7
#[test]
fn guests_do_not_displace_ends_of_own_applications() {
    // Given
    let mut bench = Bench::new();
    bench.handle(Input::Started { app: app(0) });
    bench.handle(ended(0, true));
    // When
    for index in 1..=2_000 {
        bench.handle(Input::GuestStarted { app: app(index) });
        bench.handle(ended(index, true));
    }
    // Then
    let watch = Watch { incarnation: INCARNATION, version: 1, apps: vec![app(0), app(1), app(2_000)] };
    let notified = bench.handle(Input::Watch { from: THERE, watch });
    let [Output::Lives { lives, .. }] = &notified[..] else { panic!("{notified:?}") };
    let are_remembered: Vec<_> = lives.lives.iter().map(|state| state.ended.is_some()).collect();
    assert_eq!(are_remembered, [true, false, true], "of guests those that went last");
}

// spec: MON-2
#[test]
fn missing_target_is_reported_at_once() {
    let mut bench = Bench::new();
    let (_, outputs) = bench.monitors(1, Tid::new(HERE, app(0)));
    assert_eq!(classes(&outputs), [DownClass::NoSuchAddress]);
    let (_, outputs) = bench.monitors(1, Tid::new(THERE, app(0)));
    assert_eq!(classes(&outputs), [DownClass::NodeLost]);
    for many in [Tid::group("drives"), Tid::BROADCAST, Tid::new(THERE, AppAddress::SYNC)] {
        assert_eq!(bench.monitors(1, many).0, Err(MonitorError::NotOne(many)));
    }
}

// spec: MON-3
#[test]
fn lost_node_ends_lives_but_cut_link_not() {
    let mut bench = Bench::new();
    bench.handle(Input::NodeFound { node: THERE, incarnation: INCARNATION });
    bench.handle(Input::LinkUp { node: THERE, incarnation: INCARNATION });
    bench.monitors(1, Tid::new(THERE, app(0))).0.unwrap();
    assert_eq!(downs(&bench.handle(Input::LinkBroken { node: THERE, incarnation: INCARNATION })), []);
    let former = Input::NodeLost { node: THERE, incarnation: Incarnation(4), why: "an earlier life".into() };
    assert_eq!(downs(&bench.handle(former)), []);
    let lost = Input::NodeLost { node: THERE, incarnation: INCARNATION, why: "its node left".into() };
    assert_eq!(classes(&bench.handle(lost.clone())), [DownClass::NodeLost]);
    assert_eq!(downs(&bench.handle(lost)), []);
}

// spec: MON-3
#[test]
fn older_incarnation_is_watched_after_a_duplicate() {
    let mut bench = Bench::new();
    let elder = Incarnation(INCARNATION.0 - 1);
    bench.handle(Input::NodeFound { node: THERE, incarnation: INCARNATION });
    bench.handle(Input::LinkUp { node: THERE, incarnation: INCARNATION });
    bench.handle(Input::NodeLost {
        node: THERE,
        incarnation: INCARNATION,
        why: "it was another process".into(),
    });
    bench.handle(Input::NodeFound { node: THERE, incarnation: elder });
    bench.handle(Input::LinkUp { node: THERE, incarnation: elder });
    bench.monitors(1, Tid::new(THERE, app(0))).0.unwrap();
    let lost = bench.handle(Input::NodeLost { node: THERE, incarnation: elder, why: "it is silent".into() });
    assert_eq!(classes(&lost), [DownClass::NodeLost]);
}

// spec: MON-3
#[test]
fn new_incarnation_of_node_ends_the_old_one() {
    let mut bench = Bench::new();
    bench.handle(Input::LinkUp { node: THERE, incarnation: INCARNATION });
    bench.monitors(1, Tid::new(THERE, app(0))).0.unwrap();
    let again = bench.handle(Input::LinkUp { node: THERE, incarnation: Incarnation(6) });
    assert_eq!(classes(&again), [DownClass::NodeLost]);
    bench.monitors(1, Tid::new(THERE, app(0))).0.unwrap();
    let late =
        Input::NodeLost { node: THERE, incarnation: INCARNATION, why: "its node was restarted".into() };
    assert_eq!(downs(&bench.handle(late)), [], "it is about the life before");
}

// spec: MON-5
#[test]
fn monitors_end_with_their_watcher() {
    let mut bench = Bench::new();
    for index in [0, 1] {
        bench.handle(Input::Started { app: app(index) });
    }
    bench.monitors(1, Tid::new(HERE, app(0))).0.unwrap();
    bench.handle(ended(1, false));
    assert_eq!(bench.handle(ended(0, false)), []);
}

#[test]
fn demonitor_removes_only_own_monitor() {
    let mut bench = Bench::new();
    bench.handle(Input::Started { app: app(0) });
    let kept = bench.monitors(1, Tid::new(HERE, app(0))).0.unwrap();
    let ended_one = bench.monitors(1, Tid::new(HERE, app(0))).0.unwrap();
    assert!(!bench.core.demonitor(bench.now, app(2), kept));
    assert!(bench.core.demonitor(bench.now, app(1), ended_one));
    let notified = downs(&bench.handle(ended(0, true)));
    assert_eq!(notified.into_iter().map(|(_, down)| down.monitor).collect::<Vec<_>>(), [kept]);
    assert!(!bench.core.demonitor(bench.now, app(1), kept), "it has spoken");
}

// spec: MON-6
#[test]
fn undelivered_downs_count_as_monitors() {
    let mut bench = Bench::new();
    bench.handle(Input::Started { app: app(0) });
    let target = Tid::new(HERE, app(0));
    for _ in 0..PER_WATCHER_MAX {
        bench.monitors(1, target).0.unwrap();
    }
    assert_eq!(bench.monitors(1, target).0, Err(MonitorError::TooMany(PER_WATCHER_MAX)));
    let notified = downs(&bench.handle(ended(0, false)));
    assert_eq!(notified.len(), PER_WATCHER_MAX);
    for (watcher, down) in notified {
        bench.handle(Input::DownRejected { watcher, down });
    }
    assert_eq!(bench.monitors(1, target).0, Err(MonitorError::TooMany(PER_WATCHER_MAX)));
    assert_eq!(downs(&bench.handle(Input::RoomMade)).len(), PER_WATCHER_MAX);
    bench.monitors(1, target).0.unwrap();
    for number in 1..MONITORS_MAX {
        bench.monitors(2 + number as u32 / 200, target).0.unwrap();
    }
    assert_eq!(bench.monitors(99, target).0, Err(MonitorError::NodeFull(MONITORS_MAX)));
}

/// A watcher that sets the next monitor in each `Down`, for a second. Returns the number of its
/// notifications.
fn notified_in_a_second(bench: &mut Bench, mut target: impl FnMut(u32) -> Tid) -> usize {
    let until = bench.now + Duration::from_secs(1);
    let (mut notified, mut waiting) = (0, downs(&bench.monitors(1, target(0)).1).len());
    while bench.now < until {
        while waiting > 0 {
            (notified, waiting) = (notified + 1, waiting - 1);
            assert!(notified < 100_000, "there is no end to it");
            waiting += downs(&bench.monitors(1, target(notified as u32)).1).len();
        }
        bench.now = bench.core.next_wake().expect("what waits has its time").max(bench.now);
        waiting += downs(&bench.handle(Input::TimePassed)).len();
    }
    notified + waiting
}

// spec: MON-8
#[test]
fn repeated_monitors_of_missing_target_are_rate_limited() {
    let second = (Duration::from_secs(1).as_nanos() / MISSING_INTERVAL.as_nanos()) as usize;
    for node in [HERE, THERE] {
        for name in [|_| app(0), |number| app(number % 4_000)] as [fn(u32) -> AppAddress; 2] {
            let mut bench = Bench::new();
            let notified = notified_in_a_second(&mut bench, |number| Tid::new(node, name(number)));
            assert_eq!(notified, PER_WATCHER_MAX + second, "on {node}");
        }
    }
}

// spec: MON-8
#[test]
fn remote_missing_targets_are_rate_limited_too() {
    let mut bench = Bench::new();
    bench.handle(Input::LinkUp { node: THERE, incarnation: INCARNATION });
    let (mut notified, mut version) = (0, 0);
    let target = Tid::new(THERE, app(0));
    for _ in 0..4 {
        for _ in 0..PER_WATCHER_MAX {
            // Refused as soon as the maximum number of monitors waits.
            let _ = bench.monitors(1, target);
        }
        version += 1;
        let lives = vec![LifeState { app: app(0), life: 0, age_us: 0, ended: None }];
        let lives = Lives { incarnation: INCARNATION, version, lives };
        notified += downs(&bench.handle(Input::Lives { from: THERE, lives })).len();
    }
    assert_eq!(notified, PER_WATCHER_MAX);
}

// spec: MON-8
#[test]
fn delayed_answer_counts_and_can_be_cancelled() {
    let mut bench = Bench::new();
    bench.handle(Input::Started { app: app(1) });
    let target = Tid::new(HERE, app(0));
    for _ in 0..PER_WATCHER_MAX {
        assert_eq!(classes(&bench.monitors(1, target).1), [DownClass::NoSuchAddress]);
    }
    let waits: Vec<_> = (0..PER_WATCHER_MAX).map(|_| bench.monitors(1, target).0.unwrap()).collect();
    assert_eq!(bench.monitors(1, target).0, Err(MonitorError::TooMany(PER_WATCHER_MAX)));
    assert!(bench.core.demonitor(bench.now, app(1), waits[0]));
    bench.now = bench.now + MISSING_INTERVAL * 2;
    let notified: Vec<_> =
        downs(&bench.handle(Input::TimePassed)).iter().map(|(_, down)| down.monitor).collect();
    assert_eq!(notified, [waits[1]], "the second one's time has come, and the first one was taken back");
    // Another watcher has its own limit.
    assert_eq!(classes(&bench.monitors(2, target).1), [DownClass::NoSuchAddress]);
    bench.handle(ended(1, true));
    bench.now = bench.now + Duration::from_secs(10);
    assert_eq!(bench.handle(Input::TimePassed), []);
}
