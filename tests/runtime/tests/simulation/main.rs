//! Random histories of a supervisor, each order checked against the [`model`] and the simulated world.

mod model;

use std::{collections::BTreeMap, time::Duration};

use sinew_runtime::{
    supervision::core::{
        AutoShutdown, ChildId, ChildState, Core, Flags, Generation, Input, Intensity, Order, Policy, Reason,
        Restart, Strategy,
    },
    time::Time,
};
use sinew_sim::{Chance, Seed, number};

use self::model::Model;

/// Histories in an ordinary run.
const HISTORIES: u64 = 50_000;
/// Sets another number; `docs/book/src/contributing/testing.md` has the command.
const HISTORIES_VARIABLE: &str = "SINEW_HISTORIES";
/// The one history to replay.
const SEED_VARIABLE: &str = "SINEW_HISTORY";
const STEPS_MAX: u64 = 80;

#[test]
fn any_history_gives_the_orders_of_the_otp_rules() {
    let (histories, only) = (number(HISTORIES_VARIABLE).unwrap_or(HISTORIES), number(SEED_VARIABLE));
    let mut seen = Seen::default();
    for number in only.map_or(0..histories, |only| only..only + 1) {
        let seed = Seed {
            number,
            variable: SEED_VARIABLE,
            package: "sinew-runtime-tests",
            target: "--test simulation",
            test: "any_history",
        };
        seed.run(|| History::new(number).run(&mut seen));
    }
    println!("{histories} histories: {seen:?}");
    if only.is_none() {
        seen.must_cover_everything();
    }
}

/// Counts the events, so that an ineffective generator is noticed.
#[derive(Debug, Default)]
struct Seen {
    inputs: u64,
    orders: u64,
    restarts: u64,
    gave_up: u64,
    shut_down: u64,
    done: u64,
    refused: u64,
    abandoned: u64,
}

impl Seen {
    fn note(&mut self, order: &Order) {
        self.orders += 1;
        match order {
            Order::Spawn(_, generation) => self.restarts += u64::from(*generation > 1),
            Order::Abandon(..) => self.abandoned += 1,
            Order::Done(..) => self.done += 1,
            Order::Refused(..) => self.refused += 1,
            Order::Ended(Reason::GaveUp(_)) => self.gave_up += 1,
            Order::Ended(_) => self.shut_down += 1,
            Order::Stop(..)
            | Order::Failed(..)
            | Order::Ready(_)
            | Order::Gone(..)
            | Order::Deleted(_)
            | Order::AllReady => {}
        }
    }

    fn must_cover_everything(&self) {
        let Self { restarts, gave_up, shut_down, done, refused, abandoned, .. } = self;
        let rarest = [restarts, gave_up, shut_down, done, refused, abandoned].into_iter().min();
        assert!(rarest.is_some_and(|count| *count > 1_000), "something was hardly tried: {self:?}");
    }
}

/// The running incarnations, as a shell would see them. Panics at an impossible order.
#[derive(Default)]
struct World {
    alive: BTreeMap<ChildId, Generation>,
    /// Abandoned, and may report their end late.
    taken: Vec<(ChildId, Generation)>,
    ended: bool,
}

impl World {
    fn obey(&mut self, order: &Order) {
        assert!(!self.ended || matches!(order, Order::Refused(..)), "an order after the last one: {order:?}");
        match order {
            Order::Spawn(id, generation) => {
                assert!(self.alive.insert(*id, *generation).is_none(), "two lives of one child");
            }
            Order::Stop(id, generation) => assert_eq!(self.alive.get(id), Some(generation)),
            Order::Abandon(id, generation) => {
                assert_eq!(self.alive.remove(id), Some(*generation));
                self.taken.push((*id, *generation));
            }
            Order::Ended(_) => {
                assert!(self.alive.is_empty(), "ended with {:?} alive", self.alive);
                self.ended = true;
            }
            Order::Failed(id, _) | Order::Gone(id, _) | Order::Deleted(id) => {
                assert!(!self.alive.contains_key(id), "the end of a live child was reported");
            }
            Order::Ready(_) | Order::AllReady | Order::Done(..) | Order::Refused(..) => {}
        }
    }
}

struct History {
    chance: Chance,
    now: Time,
    next_id: u64,
    core: Core,
    model: Model,
    world: World,
    sent: Vec<(Time, Input)>,
}

impl History {
    fn new(seed: u64) -> Self {
        let mut chance = Chance::new(seed.wrapping_mul(0x2545_f491_4f6c_dd1d));
        let flags = any_flags(&mut chance);
        let count = chance.below(6);
        let children: Vec<_> = (0..count).map(|id| (ChildId(id), any_policy(&mut chance))).collect();
        Self {
            chance,
            now: Time::from_nanos(1_000_000),
            next_id: count,
            core: Core::new(flags, seed, children.clone()),
            model: Model::new(flags, children),
            world: World::default(),
            sent: Vec::new(),
        }
    }

    fn run(mut self, seen: &mut Seen) {
        let steps = 1 + self.chance.below(STEPS_MAX);
        for step in 0..steps {
            if step == 0 && self.chance.below(10) > 0 {
                self.send(Input::Started, seen);
            }
            if self.world.ended && self.chance.below(3) > 0 {
                break;
            }
            let input = self.any_input();
            self.send(input, seen);
        }
        // After any history: ordered to stop, and given time, it ends.
        self.send(Input::StopOrdered, seen);
        for _ in 0..=self.next_id {
            if let Some(wake) = self.core.next_wake() {
                self.now = self.now.max(wake);
            }
            self.send(Input::TimePassed, seen);
        }
        assert!(self.model.is_ended() && self.world.ended, "does not end: {}", self.story());
    }

    fn send(&mut self, input: Input, seen: &mut Seen) {
        seen.inputs += 1;
        self.sent.push((self.now, input.clone()));
        if let Input::Ended(id, generation, _) = &input {
            if self.world.alive.get(id) == Some(generation) {
                self.world.alive.remove(id);
            }
            self.world.taken.retain(|taken| taken != &(*id, *generation));
        }
        self.core.handle(self.now, input.clone());
        let ordered: Vec<Order> = std::iter::from_fn(|| self.core.poll()).collect();
        for order in &ordered {
            seen.note(order);
            self.world.obey(order);
        }
        let core = &self.core;
        let restart_at = |id| match core.child(id)?.state {
            ChildState::BackingOff(at) => Some(at),
            ChildState::Down | ChildState::Starting(_) | ChildState::Ready | ChildState::Stopping(_) => None,
        };
        let expected = self.model.step(self.now, &input, &restart_at);
        let same =
            ordered.len() == expected.len() && ordered.iter().zip(&expected).all(|(a, b)| is_same(a, b));
        assert!(same, "the rules say\n  {expected:?}\nand the core\n  {ordered:?}\nafter{}", self.story());
    }

    fn story(&self) -> String {
        let sent: String =
            self.sent.iter().map(|(at, input)| format!("\n  {:?} {input:?}", at.since(Time::ZERO))).collect();
        format!("{sent}\nwith {:?}", self.core.flags())
    }

    fn any_input(&mut self) -> Input {
        match self.chance.below(100) {
            0..30 => self.some_life_is_ready(),
            30..40 => {
                let (id, generation) = self.any_life();
                Input::Ended(id, generation, any_reason(&mut self.chance))
            }
            40..42 => {
                let (id, generation) = self.any_life();
                Input::Hung(id, generation, Reason::Hung(String::new()))
            }
            42..50 => Input::Released(self.any_id()),
            50..56 => Input::TerminateChild(self.any_id()),
            56..63 => Input::RestartChild(self.any_id()),
            63..67 => Input::DeleteChild(self.any_id()),
            67..71 => {
                let present = self.core.children().next().filter(|_| self.chance.below(5) == 0);
                let id = present.unwrap_or(ChildId(self.next_id));
                self.next_id += u64::from(present.is_none());
                Input::AddChild(id, any_policy(&mut self.chance))
            }
            71..72 if self.chance.below(4) == 0 => Input::StopOrdered,
            72..75 => match self.world.taken.last() {
                Some((id, generation)) => Input::Ended(*id, *generation, Reason::Killed),
                None => Input::Started,
            },
            75..78 => {
                let (id, generation) = self.any_life();
                // Some times are in the past, which has no effect.
                let until = self.now + Duration::from_millis(self.chance.below(200));
                Input::DeadlineExtended(id, generation, until)
            }
            _ => self.some_time_passes(),
        }
    }

    fn some_life_is_ready(&mut self) -> Input {
        let starts = |(id, _): &&(ChildId, Generation)| {
            matches!(self.core.child(*id).map(|child| child.state), Some(ChildState::Starting(_)))
        };
        let alive: Vec<_> = self.world.alive.iter().map(|(id, generation)| (*id, *generation)).collect();
        let (id, generation) = match alive.iter().find(starts) {
            Some(life) if self.chance.below(5) > 0 => *life,
            Some(_) | None => self.any_life(),
        };
        Input::BecameReady(id, generation)
    }

    fn some_time_passes(&mut self) -> Input {
        let step = Duration::from_millis([1, 5, 5, 40, 300][self.chance.below(5) as usize]);
        let wake = self.core.next_wake().filter(|_| self.chance.below(2) > 0);
        self.now = wake.unwrap_or(self.now + step).max(self.now);
        Input::TimePassed
    }

    fn any_id(&mut self) -> ChildId {
        let unknown = self.next_id == 0 || self.chance.below(10) == 0;
        ChildId(self.chance.below(self.next_id + u64::from(unknown)))
    }

    /// Mostly a running incarnation; sometimes a former or a future one.
    fn any_life(&mut self) -> (ChildId, Generation) {
        let alive: Vec<_> = self.world.alive.iter().map(|(id, generation)| (*id, *generation)).collect();
        if alive.is_empty() || self.chance.below(12) == 0 {
            return (self.any_id(), self.chance.below(4));
        }
        alive[self.chance.below(alive.len() as u64) as usize]
    }
}

fn is_same(ordered: &Order, expected: &Order) -> bool {
    match (ordered, expected) {
        // The texts are for people and are not compared.
        (Order::Ended(Reason::GaveUp(_)), Order::Ended(Reason::GaveUp(_))) => true,
        _ => ordered == expected,
    }
}

fn any_flags(chance: &mut Chance) -> Flags {
    let strategies = [Strategy::OneForOne, Strategy::RestForOne, Strategy::OneForAll];
    let shutdowns = [AutoShutdown::Never, AutoShutdown::AnySignificant, AutoShutdown::AllSignificant];
    Flags {
        strategy: strategies[chance.below(3) as usize],
        intensity: Intensity {
            restarts_max: chance.below(12) as usize,
            losses_max: chance.below(6) as usize,
            // Some as long as a step of time: a restart exactly one window ago counts.
            window: Duration::from_millis([5, 40, 300, 1_000, 5_000][chance.below(5) as usize]),
        },
        auto_shutdown: shutdowns[chance.below(3) as usize],
        abandoned_max: chance.below(8) as usize,
    }
}

fn any_policy(chance: &mut Chance) -> Policy {
    let restarts = [Restart::Permanent, Restart::Permanent, Restart::Transient, Restart::Temporary];
    Policy {
        restart: restarts[chance.below(4) as usize],
        significant: chance.below(3) == 0,
        start_within: Duration::from_millis(1 + chance.below(5_000)),
        stop_within: Duration::from_millis(1 + chance.below(500)),
        backoff_min: Duration::from_millis(chance.below(4)),
        backoff_max: Duration::from_millis(3 + chance.below(100)),
        held: chance.below(4) == 0,
        ..Policy::default()
    }
}

fn any_reason(chance: &mut Chance) -> Reason {
    match chance.below(8) {
        0 | 1 => Reason::Normal,
        2 => Reason::Shutdown,
        3 => Reason::ThreadEnded,
        4 => Reason::ProcessEnded(String::new()),
        5 => Reason::RequirementLost(String::new()),
        _ => Reason::Panic(String::new()),
    }
}
