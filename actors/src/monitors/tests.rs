//! What monitors promise: claims, and in [`world`] two nodes with an unreliable link.

mod world;

use std::time::Duration;

use sinew_runtime::{
    monitor::{Down, DownClass, MonitorError, MonitorId},
    tid::{AppAddress, Incarnation, NodeAddress, Tid},
    time::Time,
};

use super::{
    Cause, Core, Input,
    core::{MONITORS_MAX, NOBODY_EVERY, Output, PER_WATCHER_MAX, REPEAT, RETRY},
    words::{LifeState, Lives, Watch},
};

const HERE: NodeAddress = NodeAddress::new(0x7f00_0001);
const THERE: NodeAddress = NodeAddress::new(0x7f00_0002);
const LIFE: Incarnation = Incarnation(5);

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
        Self { core: Core::new(HERE, LIFE, 4, 1 << 20), now: Time::from_nanos(1_000_000_000) }
    }

    fn hears(&mut self, input: Input) -> Vec<Output> {
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
        Output::Tell { watcher, down } => Some((*watcher, down.clone())),
        Output::Watch { .. } | Output::Lives { .. } => None,
    };
    outputs.iter().filter_map(down).collect()
}

fn classes(outputs: &[Output]) -> Vec<DownClass> {
    downs(outputs).into_iter().map(|(_, down)| down.class).collect()
}

// spec: MON-1
#[test]
fn the_end_of_a_life_is_told_once_to_each_who_watches_it() {
    let mut bench = Bench::new();
    bench.hears(Input::Began { app: app(0) });
    let first = bench.monitors(1, Tid::new(HERE, app(0))).0.unwrap();
    let second = bench.monitors(2, Tid::new(HERE, app(0))).0.unwrap();
    let told = downs(&bench.hears(ended(0, false)));
    let down = |monitor| Down {
        monitor,
        tid: Tid::new(HERE, app(0)),
        class: DownClass::Panic,
        why: "panicked: its end".to_owned(),
    };
    assert_eq!(told, [(app(1), down(first)), (app(2), down(second))]);
    assert_eq!(bench.hears(ended(0, false)), [], "of the next life nobody wanted to know");
}

// spec: MON-7
#[test]
fn an_address_that_was_used_again_is_remembered_for_its_last_end() {
    let mut bench = Bench::new();
    // Given: one that is gone twice, and then as many others as are remembered beside it
    for index in [0].into_iter().chain(0..1_024) {
        bench.hears(Input::Began { app: app(index) });
        bench.hears(ended(index, true));
    }
    // When
    let watch = Watch { incarnation: LIFE, version: 1, apps: vec![app(0)] };
    let told = bench.hears(Input::Watch { from: THERE, watch });
    // Then
    let [Output::Lives { lives, .. }] = &told[..] else { panic!("{told:?}") };
    let cause = lives.lives[0].ended.as_ref().map(|ended| ended.cause.class);
    assert_eq!(cause, Some(DownClass::Panic));
}

// spec: MON-7
#[test]
fn how_the_robots_own_ended_stays_known_however_many_guests_come_and_go() {
    // Given
    let mut bench = Bench::new();
    bench.hears(Input::Began { app: app(0) });
    bench.hears(ended(0, true));
    // When
    for index in 1..=2_000 {
        bench.hears(Input::GuestBegan { app: app(index) });
        bench.hears(ended(index, true));
    }
    // Then
    let watch = Watch { incarnation: LIFE, version: 1, apps: vec![app(0), app(1), app(2_000)] };
    let told = bench.hears(Input::Watch { from: THERE, watch });
    let [Output::Lives { lives, .. }] = &told[..] else { panic!("{told:?}") };
    let are_known: Vec<_> = lives.lives.iter().map(|state| state.ended.is_some()).collect();
    assert_eq!(are_known, [true, false, true], "of guests those that went last");
}

// spec: MON-2
#[test]
fn who_is_not_there_is_told_at_once() {
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
fn a_node_that_is_lost_ends_all_its_lives_and_one_that_is_only_cut_off_none() {
    let mut bench = Bench::new();
    bench.hears(Input::NodeFound { node: THERE, incarnation: LIFE });
    bench.hears(Input::LinkUp { node: THERE, incarnation: LIFE });
    bench.monitors(1, Tid::new(THERE, app(0))).0.unwrap();
    assert_eq!(downs(&bench.hears(Input::LinkBroken { node: THERE, incarnation: LIFE })), []);
    let former = Input::NodeLost { node: THERE, incarnation: Incarnation(4), why: "an earlier life".into() };
    assert_eq!(downs(&bench.hears(former)), []);
    let lost = Input::NodeLost { node: THERE, incarnation: LIFE, why: "its node left".into() };
    assert_eq!(classes(&bench.hears(lost.clone())), [DownClass::NodeLost]);
    assert_eq!(downs(&bench.hears(lost)), []);
}

// spec: MON-3
#[test]
fn the_elder_life_of_a_node_is_watched_after_a_later_one_was_another_process() {
    let mut bench = Bench::new();
    let elder = Incarnation(LIFE.0 - 1);
    bench.hears(Input::NodeFound { node: THERE, incarnation: LIFE });
    bench.hears(Input::LinkUp { node: THERE, incarnation: LIFE });
    bench.hears(Input::NodeLost { node: THERE, incarnation: LIFE, why: "it was another process".into() });
    bench.hears(Input::NodeFound { node: THERE, incarnation: elder });
    bench.hears(Input::LinkUp { node: THERE, incarnation: elder });
    bench.monitors(1, Tid::new(THERE, app(0))).0.unwrap();
    let lost = bench.hears(Input::NodeLost { node: THERE, incarnation: elder, why: "it is silent".into() });
    assert_eq!(classes(&lost), [DownClass::NodeLost]);
}

// spec: MON-3
#[test]
fn a_node_in_a_new_life_has_lost_the_old_one_whoever_says_so_first() {
    let mut bench = Bench::new();
    bench.hears(Input::LinkUp { node: THERE, incarnation: LIFE });
    bench.monitors(1, Tid::new(THERE, app(0))).0.unwrap();
    let again = bench.hears(Input::LinkUp { node: THERE, incarnation: Incarnation(6) });
    assert_eq!(classes(&again), [DownClass::NodeLost]);
    bench.monitors(1, Tid::new(THERE, app(0))).0.unwrap();
    let late = Input::NodeLost { node: THERE, incarnation: LIFE, why: "its node was restarted".into() };
    assert_eq!(downs(&bench.hears(late)), [], "it is about the life before");
}

// spec: MON-5
#[test]
fn the_monitors_of_a_watcher_end_with_its_life() {
    let mut bench = Bench::new();
    for index in [0, 1] {
        bench.hears(Input::Began { app: app(index) });
    }
    bench.monitors(1, Tid::new(HERE, app(0))).0.unwrap();
    bench.hears(ended(1, false));
    assert_eq!(bench.hears(ended(0, false)), []);
}

#[test]
fn who_demonitors_is_told_nothing_and_what_is_another_ones_stays() {
    let mut bench = Bench::new();
    bench.hears(Input::Began { app: app(0) });
    let kept = bench.monitors(1, Tid::new(HERE, app(0))).0.unwrap();
    let ended_one = bench.monitors(1, Tid::new(HERE, app(0))).0.unwrap();
    assert!(!bench.core.demonitor(bench.now, app(2), kept));
    assert!(bench.core.demonitor(bench.now, app(1), ended_one));
    let told = downs(&bench.hears(ended(0, true)));
    assert_eq!(told.into_iter().map(|(_, down)| down.monitor).collect::<Vec<_>>(), [kept]);
    assert!(!bench.core.demonitor(bench.now, app(1), kept), "it has spoken");
}

// spec: MON-6
#[test]
fn monitors_are_bounded_and_what_a_mailbox_did_not_take_counts_until_it_does() {
    let mut bench = Bench::new();
    bench.hears(Input::Began { app: app(0) });
    let target = Tid::new(HERE, app(0));
    for _ in 0..PER_WATCHER_MAX {
        bench.monitors(1, target).0.unwrap();
    }
    assert_eq!(bench.monitors(1, target).0, Err(MonitorError::TooMany(PER_WATCHER_MAX)));
    let told = downs(&bench.hears(ended(0, false)));
    assert_eq!(told.len(), PER_WATCHER_MAX);
    for (watcher, down) in told {
        bench.hears(Input::NotTaken { watcher, down });
    }
    assert_eq!(bench.monitors(1, target).0, Err(MonitorError::TooMany(PER_WATCHER_MAX)));
    bench.now = bench.now + RETRY;
    assert_eq!(downs(&bench.hears(Input::TimePassed)).len(), PER_WATCHER_MAX);
    bench.monitors(1, target).0.unwrap();
    for number in 1..MONITORS_MAX {
        bench.monitors(2 + number as u32 / 200, target).0.unwrap();
    }
    assert_eq!(bench.monitors(99, target).0, Err(MonitorError::NodeFull(MONITORS_MAX)));
}

/// A watcher that sets the next monitor in each `Down`, for a second. Returns how often it was told.
fn told_in_a_second(bench: &mut Bench, mut target: impl FnMut(u32) -> Tid) -> usize {
    let until = bench.now + Duration::from_secs(1);
    let (mut told, mut waiting) = (0, downs(&bench.monitors(1, target(0)).1).len());
    while bench.now < until {
        while waiting > 0 {
            (told, waiting) = (told + 1, waiting - 1);
            assert!(told < 100_000, "there is no end to it");
            waiting += downs(&bench.monitors(1, target(told as u32)).1).len();
        }
        bench.now = bench.core.next_wake().expect("what waits has its time").max(bench.now);
        waiting += downs(&bench.hears(Input::TimePassed)).len();
    }
    told + waiting
}

// spec: MON-8
#[test]
fn who_monitors_again_in_each_answer_that_nobody_is_there_is_answered_at_a_pace() {
    let second = (Duration::from_secs(1).as_nanos() / NOBODY_EVERY.as_nanos()) as usize;
    for node in [HERE, THERE] {
        for name in [|_| app(0), |number| app(number % 4_000)] as [fn(u32) -> AppAddress; 2] {
            let mut bench = Bench::new();
            let told = told_in_a_second(&mut bench, |number| Tid::new(node, name(number)));
            assert_eq!(told, PER_WATCHER_MAX + second, "on {node}");
        }
    }
}

// spec: MON-8
#[test]
fn the_answers_of_another_node_that_nobody_is_there_have_the_same_pace() {
    let mut bench = Bench::new();
    bench.hears(Input::LinkUp { node: THERE, incarnation: LIFE });
    let (mut told, mut version) = (0, 0);
    let target = Tid::new(THERE, app(0));
    for _ in 0..4 {
        for _ in 0..PER_WATCHER_MAX {
            // Refused as soon as what waits is as much as it may have.
            let _ = bench.monitors(1, target);
        }
        version += 1;
        let lives = vec![LifeState { app: app(0), life: 0, age_us: 0, ended: None }];
        let lives = Lives { incarnation: LIFE, version, lives };
        told += downs(&bench.hears(Input::Lives { from: THERE, lives })).len();
    }
    assert_eq!(told, PER_WATCHER_MAX);
}

// spec: MON-8
#[test]
fn an_answer_that_waits_counts_as_a_monitor_and_can_be_taken_back_and_ends_with_its_watcher() {
    let mut bench = Bench::new();
    bench.hears(Input::Began { app: app(1) });
    let target = Tid::new(HERE, app(0));
    for _ in 0..PER_WATCHER_MAX {
        assert_eq!(classes(&bench.monitors(1, target).1), [DownClass::NoSuchAddress]);
    }
    let waits: Vec<_> = (0..PER_WATCHER_MAX).map(|_| bench.monitors(1, target).0.unwrap()).collect();
    assert_eq!(bench.monitors(1, target).0, Err(MonitorError::TooMany(PER_WATCHER_MAX)));
    assert!(bench.core.demonitor(bench.now, app(1), waits[0]));
    bench.now = bench.now + NOBODY_EVERY * 2;
    let told: Vec<_> = downs(&bench.hears(Input::TimePassed)).iter().map(|(_, down)| down.monitor).collect();
    assert_eq!(told, [waits[1]], "the second one's time has come, and the first one was taken back");
    // Another watcher has its own pace.
    assert_eq!(classes(&bench.monitors(2, target).1), [DownClass::NoSuchAddress]);
    bench.hears(ended(1, true));
    bench.now = bench.now + Duration::from_secs(10);
    assert_eq!(bench.hears(Input::TimePassed), []);
}
