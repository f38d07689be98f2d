use proptest::prelude::{Just, ProptestConfig, prop_oneof, proptest};

use super::*;
use crate::time::Time;

const MS: u64 = 1_000_000;

fn at(ms: u64) -> Time {
    Time::from_nanos((ms + 1) * MS)
}

fn supervisor(strategy: Strategy, children: usize) -> Core {
    let mut core = Core::new(
        strategy,
        Intensity::default(),
        (0..children).map(|index| (child(index), Policy::default())).collect(),
    );
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
    let mut core = Core::new(Strategy::OneForOne, Intensity::default(), vec![(ChildId(0), policy)]);
    core.handle(at(0), Input::Started);
    assert_eq!(orders(&mut core), [Order::AllReady]);
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
    let mut core = Core::new(Strategy::OneForOne, Intensity::default(), vec![(ChildId(0), policy)]);
    core.handle(at(0), Input::Started);
    core.handle(at(0), Input::Released(ChildId(0)));
    core.handle(at(1), panicked(0, 1));
    core.handle(at(1), Input::Released(ChildId(0)));
    orders(&mut core);
    core.handle(core.next_wake().unwrap(), Input::TimePassed);
    assert_eq!(orders(&mut core), [Order::Spawn(ChildId(0), 2)]);
}

#[derive(Clone, Debug)]
enum Step {
    Ready(usize),
    Panic(usize),
    Normal(usize),
    Wait(u64),
    Stop,
}

fn any_step() -> impl proptest::strategy::Strategy<Value = Step> {
    use proptest::strategy::Strategy as _;
    prop_oneof![
        6 => (0usize..4).prop_map(Step::Ready),
        2 => (0usize..4).prop_map(Step::Panic),
        1 => (0usize..4).prop_map(Step::Normal),
        4 => (0u64..12_000).prop_map(Step::Wait),
        1 => Just(Step::Stop),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(2_000))]
    #[test]
    fn any_history_keeps_the_rules(
        kind in 0usize..3,
        steps in proptest::collection::vec(any_step(), 0..80),
    ) {
        let strategy = [Strategy::OneForOne, Strategy::RestForOne, Strategy::OneForAll][kind];
        let mut core = supervisor(strategy, 4);
        let mut world = World::default();
        let mut now = 0;
        world.obey(&mut core, strategy);
        for step in steps {
            let alive = |index: usize| world.alive[index];
            let input = match step {
                Step::Ready(index) => alive(index).map(|g| Input::BecameReady(child(index), g)),
                Step::Panic(index) => alive(index).map(|g| panicked(index, g)),
                Step::Normal(index) => alive(index).map(|g| Input::Ended(child(index), g, Reason::Normal)),
                Step::Wait(ms) => { now += ms; Some(Input::TimePassed) }
                Step::Stop => Some(Input::StopOrdered),
            };
            if let Some(input) = input {
                world.hear(&input);
                core.handle(at(now), input);
                world.obey(&mut core, strategy);
            }
        }
    }
}

/// A direct model of what lives; it panics where an order breaks a rule.
#[derive(Default)]
struct World {
    alive: [Option<u64>; 4],
    ready: [bool; 4],
    stopping: [bool; 4],
    ended: bool,
}

impl World {
    fn hear(&mut self, input: &Input) {
        match input {
            Input::BecameReady(id, _) => self.ready[id.0 as usize] = true,
            Input::Ended(id, ..) => self.gone(id.0 as usize),
            Input::Hung(..)
            | Input::Started
            | Input::Released(_)
            | Input::TimePassed
            | Input::StopOrdered => {}
        }
    }

    fn gone(&mut self, index: usize) {
        (self.alive[index], self.ready[index], self.stopping[index]) = (None, false, false);
    }

    fn obey(&mut self, core: &mut Core, strategy: Strategy) {
        while let Some(order) = core.poll() {
            assert!(!self.ended, "an order after the last one: {order:?}");
            match order {
                Order::Spawn(id, generation) => {
                    let index = id.0 as usize;
                    assert!(self.alive[index].is_none(), "two lives of one child");
                    assert!(
                        strategy == Strategy::OneForOne || self.ready[..index].iter().all(|ready| *ready),
                        "started before those it depends on"
                    );
                    self.alive[index] = Some(generation);
                }
                Order::Stop(id, generation) => {
                    let index = id.0 as usize;
                    assert_eq!(self.alive[index], Some(generation));
                    assert!(!self.stopping.contains(&true), "one stop at a time");
                    self.stopping[index] = true;
                }
                Order::Abandon(id, generation) => {
                    let index = id.0 as usize;
                    assert_eq!(self.alive[index], Some(generation));
                    self.gone(index);
                }
                Order::Ended(_) => {
                    assert_eq!(self.alive, [None; 4]);
                    self.ended = true;
                }
                Order::Failed(..) | Order::Ready(_) | Order::Gone(..) | Order::AllReady => {}
            }
        }
    }
}
