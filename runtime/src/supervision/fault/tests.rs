//! The meaning of a plan, and the time of a fault.

use std::{
    sync::{Arc, Mutex},
    task::{Context, Poll},
};

use futures_util::{StreamExt, task::noop_waker};
use proptest::prelude::*;

use super::*;
use crate::{
    event_queue::{EventQueue, EventStream},
    supervision::{Launch, ReadyGate, Reason, RunningActor},
};

fn fault(text: &str) -> Fault {
    text.parse().unwrap_or_else(|error| panic!("{error}"))
}

fn words(text: &str) -> String {
    text.parse::<FaultPlan>().expect_err("it is wrong").to_string()
}

#[test]
fn grammar_gives_fault_and_trigger() {
    let ms = Duration::from_millis;
    assert_eq!(fault("panic"), Fault::panic());
    assert_eq!(fault("panic@1000"), Fault::panic().at_event(1_000));
    assert_eq!(fault("hang(200ms)@5"), Fault::hang(ms(200)).at_event(5));
    assert_eq!(fault("hang"), Fault::hang_for_ever());
    assert_eq!(fault("slow( 3ms ) @ 100..200"), Fault::slow(ms(3)).at_events(100..200));
    assert_eq!(fault("stop@every(500)"), Fault::stop().at_every(500));
    assert_eq!(fault("hang(1s)@start(2)"), Fault::hang(ms(1_000)).at_start(2));
}

#[test]
fn plan_names_actors_even_with_spaces_and_colons() {
    let plan: FaultPlan = "sync manager:stop@1;\n a:b:panic ,".parse().expect("a plan");
    let expected =
        [("sync manager".to_owned(), Fault::stop().at_event(1)), ("a:b".to_owned(), Fault::panic())];
    assert_eq!(plan.faults(), expected);
    assert_eq!("".parse(), Ok(FaultPlan::default()));
}

#[test]
fn invalid_plan_is_rejected_with_a_correction() {
    for (text, teaches) in [
        ("knee:explode@3", "`explode` is nothing that can happen; write panic, stop, hang"),
        ("knee:slow@3", "write slow(3ms)"),
        ("knee:panic@0", "from 1 as in @1000"),
        ("knee:panic@9..9", "its end is not part of it"),
        ("knee:hang(200)@1", "its unit, us, ms or s"),
        ("knee:hang(2000000s)", "at most 3600s"),
        ("panic@3", "write the actor's name before it"),
    ] {
        assert!(words(text).contains(teaches), "{text}: {}", words(text));
        assert!(words(text).contains(text), "the error names what was given");
    }
    assert!(words(&"a:panic,".repeat(PLANNED_MAX + 1)).contains("more than"));
}

fn any_fault() -> impl Strategy<Value = Fault> {
    let time = || (0..3_600_000_000_u64).prop_map(Duration::from_micros);
    let kind = prop_oneof![
        Just(FaultKind::Panic),
        Just(FaultKind::Stop),
        Just(FaultKind::Hang(None)),
        time().prop_map(|time| FaultKind::Hang(Some(time))),
        time().prop_map(FaultKind::Slow),
    ];
    let moment = prop_oneof![
        Just(FaultMoment::Now),
        (1..u64::MAX).prop_map(FaultMoment::Event),
        (1..u64::MAX / 2, 1..u64::MAX / 2)
            .prop_map(|(start, length)| FaultMoment::Events(start..start + length)),
        (1..u64::MAX).prop_map(FaultMoment::EveryEvents),
        (1..u64::MAX).prop_map(FaultMoment::Start),
    ];
    (kind, moment).prop_map(|(kind, moment)| Fault { kind, moment })
}

proptest! {
    #[test]
    fn every_plan_round_trips(faults in prop::collection::vec(("[a-z.]{1,9}", any_fault()), 0..9)) {
        let plan = FaultPlan(faults);
        prop_assert_eq!(plan.to_string().parse(), Ok(plan));
    }

    #[test]
    fn any_text_is_a_plan_or_an_error(text in "\\PC*") {
        let _ = text.parse::<FaultPlan>();
    }
}

/// Takes events out of an event queue and keeps them; `None` marks a stop.
struct Clerk(EventStream<u32>, Arc<Mutex<Vec<Option<u32>>>>);

impl RunningActor for Clerk {
    fn poll(&mut self, cx: &mut Context<'_>) -> Poll<Reason> {
        while let Poll::Ready(Some(event)) = self.0.poll_next_unpin(cx) {
            self.1.lock().expect("one thread").push(Some(event));
        }
        Poll::Pending
    }

    fn stop(&mut self) {
        self.1.lock().expect("one thread").push(None);
    }

    fn terminate(&mut self) {}
}

/// An armed clerk, its event queue, and its record.
struct Office {
    points: FaultPoints,
    launch: Launch,
    queue: EventQueue<u32>,
    done: Arc<Mutex<Vec<Option<u32>>>>,
}

impl Office {
    fn new() -> Self {
        let (points, queue) = (FaultPoints::default(), EventQueue::new(100));
        let done = Arc::new(Mutex::new(Vec::new()));
        let (reads, writes) = (queue.clone(), done.clone());
        let launch: Launch = Arc::new(move |_| Box::new(Clerk(reads.attach(), writes.clone())));
        let launch = points.arm("clerk", launch);
        Self { points, launch, queue, done }
    }

    fn inject(&self, text: &str) {
        self.points.inject("clerk", fault(text)).expect("it is armed");
    }

    fn start(&self) -> Result<Box<dyn RunningActor>, String> {
        let start = std::panic::AssertUnwindSafe(|| (self.launch)(ReadyGate::new(|| {})));
        std::panic::catch_unwind(start).map_err(crate::supervision::panics::panic_message)
    }

    /// Whether it panicked on these.
    fn work(&self, clerk: &mut Box<dyn RunningActor>, events: std::ops::RangeInclusive<u32>) -> bool {
        for event in events {
            self.queue.post(event).expect("it has room");
        }
        let turn = std::panic::AssertUnwindSafe(|| clerk.poll(&mut Context::from_waker(&noop_waker())));
        std::panic::catch_unwind(turn).is_err()
    }

    fn done(&self) -> Vec<Option<u32>> {
        std::mem::take(&mut self.done.lock().expect("one thread"))
    }
}

#[test]
fn nth_event_counts_over_incarnations_and_strikes_once() {
    let office = Office::new();
    office.inject("panic@3");
    let mut first = office.start().expect("it starts");
    assert!(office.work(&mut first, 1..=5));
    assert_eq!(office.done(), [Some(1), Some(2)], "3 was in its hand");
    let mut second = office.start().expect("it starts");
    assert!(!office.work(&mut second, 6..=9));
    assert_eq!(office.done(), [4, 5, 6, 7, 8, 9].map(Some));
}

#[test]
fn injected_number_counts_from_injection() {
    let office = Office::new();
    let mut clerk = office.start().expect("it starts");
    assert!(!office.work(&mut clerk, 1..=4));
    office.inject("panic@every(2)");
    for _ in 0..3 {
        assert!(office.work(&mut clerk, 1..=2));
    }
}

#[test]
fn now_strikes_the_next_turn_once_without_an_event() {
    let office = Office::new();
    let mut clerk = office.start().expect("it starts");
    office.inject("panic");
    assert!(office.work(&mut clerk, 1..=1));
    assert_eq!(office.done(), [], "the event was not touched");
    assert!(!office.work(&mut clerk, 2..=2));
    assert_eq!(office.done(), [1, 2].map(Some));
}

#[test]
fn stop_follows_the_turn_in_which_it_was_due() {
    let office = Office::new();
    office.inject("stop@2");
    let mut clerk = office.start().expect("it starts");
    assert!(!office.work(&mut clerk, 1..=3));
    assert_eq!(office.done(), [Some(1), Some(2), Some(3), None]);
}

#[test]
fn nth_start_fails() {
    let office = Office::new();
    office.inject("panic@start(2)");
    assert!(office.start().is_ok());
    assert!(office.start().is_err_and(|words| words.contains("its start")));
    assert!(office.start().is_ok());
}

#[test]
fn unknown_actor_and_excess_fault_are_reported() {
    let office = Office::new();
    let words = office.points.inject("clark", Fault::panic()).expect_err("nobody").to_string();
    assert!(words.contains("clark:panic") && words.contains("there are clerk"), "{words}");
    for _ in 0..INJECTED_MAX {
        office.inject("panic@9");
    }
    let words = office.points.inject("clerk", Fault::panic()).expect_err("full").to_string();
    assert!(words.contains("1024 faults wait"), "{words}");
}
