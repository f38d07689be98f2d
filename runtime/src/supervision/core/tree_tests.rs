//! Trees of supervisors: single claims, and random histories.

use std::{collections::BTreeMap, time::Duration};

use sinew_sim::{Seed, number};

use super::{window::Chance, *};

/// The one history to replay.
const SEED_VARIABLE: &str = "SINEW_HISTORY";

fn at(ms: u64) -> Time {
    Time::from_nanos((ms + 1) * 1_000_000)
}

fn id(number: u64) -> ChildId {
    ChildId(number)
}

fn worker(number: u64) -> Planned {
    Planned::Worker(id(number), Policy::default())
}

/// Supervisor 100 with a worker 1 and a supervisor 10 with the workers 11 and 12.
fn two_floors(below: Flags) -> Tree {
    let leg = Plan { id: id(10), flags: below, children: vec![worker(11), worker(12)] };
    let children = vec![worker(1), Planned::Supervisor(leg, Policy::default())];
    Tree::new(Plan { id: id(100), flags: Flags::default(), children }, 0)
}

fn orders(tree: &mut Tree) -> Vec<Order> {
    std::iter::from_fn(|| tree.poll()).collect()
}

fn panicked(number: u64, generation: Generation) -> Input {
    Input::Ended(id(number), generation, Reason::Panic("oh".into()))
}

/// Started, with all children ready.
fn running(mut tree: Tree) -> Tree {
    tree.handle(at(0), Input::Started);
    for number in [1, 11, 12] {
        tree.handle(at(0), Input::BecameReady(id(number), 1));
    }
    orders(&mut tree);
    tree
}

#[test]
fn supervisor_is_ready_when_its_last_child_is() {
    let mut tree = two_floors(Strategy::RestForOne.into());
    tree.handle(at(0), Input::Started);
    assert_eq!(orders(&mut tree), [Order::Spawn(id(1), 1), Order::Spawn(id(11), 1)]);
    tree.handle(at(1), Input::BecameReady(id(1), 1));
    tree.handle(at(1), Input::BecameReady(id(11), 1));
    assert_eq!(orders(&mut tree).last(), Some(&Order::Spawn(id(12), 1)));
    tree.handle(at(2), Input::BecameReady(id(12), 1));
    assert_eq!(orders(&mut tree), [Order::Ready(id(12)), Order::Ready(id(10)), Order::AllReady]);
}

#[test]
fn failed_supervisor_restarts_with_a_fresh_set() {
    let flags = Flags {
        intensity: Intensity { restarts_max: 0, ..Intensity::default() },
        ..Strategy::OneForAll.into()
    };
    let mut tree = running(two_floors(flags));
    tree.handle(at(1), panicked(11, 1));
    assert_eq!(
        orders(&mut tree),
        [Order::Failed(id(11), Reason::Panic("oh".into())), Order::Stop(id(12), 1)]
    );
    tree.handle(at(2), Input::Ended(id(12), 1, Reason::Normal));
    let seen = orders(&mut tree);
    assert!(matches!(&seen[1], Order::Failed(failed, Reason::GaveUp(_)) if *failed == id(10)), "{seen:?}");
    tree.handle(tree.next_wake().unwrap(), Input::TimePassed);
    assert_eq!(orders(&mut tree), [Order::Spawn(id(11), 2)]);
    assert_eq!(tree.child(id(1)).unwrap().generation, 1, "who has no part in it lives on");
    tree.handle(at(9), panicked(11, 1));
    assert_eq!(orders(&mut tree), [], "a word of an earlier life is ignored in the next one, too");
}

#[test]
fn release_while_its_supervisor_is_down_is_kept() {
    let held = Planned::Worker(id(11), Policy { held: true, ..Policy::default() });
    let below =
        Flags { intensity: Intensity { restarts_max: 0, ..Intensity::default() }, ..Flags::default() };
    let leg = Plan { id: id(10), flags: below, children: vec![held] };
    let children = vec![Planned::Supervisor(leg, Policy::default())];
    let mut tree = Tree::new(Plan { id: id(100), flags: Flags::default(), children }, 0);
    tree.handle(at(0), Input::Started);
    tree.handle(at(0), Input::Released(id(11)));
    tree.handle(at(1), panicked(11, 1));
    tree.handle(at(1), Input::Released(id(11)));
    orders(&mut tree);
    tree.handle(tree.next_wake().unwrap(), Input::TimePassed);
    assert_eq!(orders(&mut tree), [Order::Spawn(id(11), 2)]);
}

#[test]
fn stop_runs_in_reverse_through_all_levels() {
    let mut tree = running(two_floors(Flags::default()));
    tree.handle(at(1), Input::StopOrdered);
    let mut stopped = Vec::new();
    while let Some(order) = tree.poll() {
        if let Order::Stop(child, generation) = order {
            stopped.push(child.0);
            tree.handle(at(2), Input::Ended(child, generation, Reason::Normal));
        }
    }
    assert_eq!(stopped, [12, 11, 1]);
}

#[test]
fn added_child_survives_a_supervisor_restart() {
    let below =
        Flags { intensity: Intensity { restarts_max: 0, ..Intensity::default() }, ..Flags::default() };
    let mut tree = running(two_floors(below));
    tree.add(at(1), id(10), id(13), Policy::default());
    assert_eq!(orders(&mut tree), [Order::Done(Command::Add, id(13)), Order::Spawn(id(13), 1)]);
    tree.handle(at(2), Input::TerminateChild(id(12)));
    tree.handle(at(2), Input::Ended(id(12), 1, Reason::Normal));
    tree.handle(at(2), Input::DeleteChild(id(12)));
    assert!(orders(&mut tree).ends_with(&[Order::Deleted(id(12)), Order::Done(Command::Delete, id(12))]));
    tree.handle(at(3), panicked(11, 1));
    tree.handle(at(3), Input::Ended(id(13), 1, Reason::Normal));
    orders(&mut tree);
    tree.handle(tree.next_wake().unwrap(), Input::TimePassed);
    assert_eq!(orders(&mut tree), [Order::Spawn(id(11), 2), Order::Spawn(id(13), 2)]);
}

#[test]
fn supervisor_that_fails_repeatedly_fails_its_parent() {
    let below =
        Flags { intensity: Intensity { restarts_max: 0, ..Intensity::default() }, ..Flags::default() };
    let mut tree = running(two_floors(below));
    let mut now = 1;
    let end = loop {
        match tree.poll() {
            Some(Order::Ended(reason)) => break reason,
            Some(Order::Spawn(child, generation)) if child == id(11) => {
                tree.handle(at(now), panicked(11, generation));
            }
            Some(Order::Stop(child, generation)) => {
                tree.handle(at(now), Input::Ended(child, generation, Reason::Normal));
            }
            Some(_) => {}
            None if now == 1 => {
                now = 2;
                tree.handle(at(now), panicked(11, 1));
            }
            None => {
                now += 100;
                tree.handle(at(now), Input::TimePassed);
            }
        }
    };
    assert!(matches!(&end, Reason::GaveUp(why) if why.contains("oh")), "{end:?}");
}

/// The running incarnations, as a shell would see them.
#[derive(Default)]
struct World {
    alive: BTreeMap<ChildId, Generation>,
    ready: BTreeMap<ChildId, bool>,
    highest: BTreeMap<ChildId, Generation>,
    ended: bool,
}

impl World {
    fn obey(&mut self, tree: &mut Tree) {
        while let Some(order) = tree.poll() {
            assert!(!self.ended || matches!(order, Order::Refused(..)), "after the last order: {order:?}");
            match order {
                Order::Spawn(id, generation) => {
                    assert!(self.alive.insert(id, generation).is_none(), "two lives of {id}");
                    let before = self.highest.insert(id, generation);
                    assert!(before < Some(generation), "{id} lives its life {generation} twice");
                    self.ready.insert(id, false);
                }
                Order::Stop(id, generation) => assert_eq!(self.alive.get(&id), Some(&generation)),
                Order::Abandon(id, generation) => assert_eq!(self.alive.remove(&id), Some(generation)),
                Order::Ended(_) => {
                    assert!(self.alive.is_empty(), "ended with {:?} alive", self.alive);
                    self.ended = true;
                }
                Order::Failed(..)
                | Order::Ready(_)
                | Order::Gone(..)
                | Order::Deleted(_)
                | Order::AllReady
                | Order::Done(..)
                | Order::Refused(..) => {}
            }
        }
    }
}

fn any_plan(chance: &mut Chance, next: &mut u64, floors: u64) -> Plan {
    let strategies = [Strategy::OneForOne, Strategy::RestForOne, Strategy::OneForAll];
    let restarts = [Restart::Permanent, Restart::Transient, Restart::Temporary];
    let mut fresh = || {
        *next += 1;
        ChildId(*next)
    };
    let id = fresh();
    let count = chance.next() % 4;
    let kinds: Vec<_> = (0..count).map(|_| (fresh(), chance.next())).collect();
    let policy = |chance: &mut Chance| Policy {
        restart: restarts[(chance.next() % 3) as usize],
        significant: chance.next().is_multiple_of(4),
        held: chance.next().is_multiple_of(4),
        ..Policy::default()
    };
    let children = kinds
        .into_iter()
        .map(|(id, kind)| match kind % 3 {
            0 if floors > 0 => Planned::Supervisor(any_plan(chance, next, floors - 1), policy(chance)),
            _ => Planned::Worker(id, policy(chance)),
        })
        .collect();
    let intensity = Intensity { restarts_max: (chance.next() % 4) as usize, ..Intensity::default() };
    let auto = [AutoShutdown::Never, AutoShutdown::AnySignificant, AutoShutdown::AllSignificant];
    let flags = Flags {
        strategy: strategies[(chance.next() % 3) as usize],
        intensity,
        auto_shutdown: auto[(chance.next() % 3) as usize],
        ..Flags::default()
    };
    Plan { id, flags, children }
}

#[test]
fn any_tree_history_keeps_one_incarnation_and_ends() {
    let only = number(SEED_VARIABLE);
    for number in only.map_or(0..20_000, |only| only..only + 1) {
        let test = "supervision::core::tree_tests::any_history";
        let seed = Seed { number, variable: SEED_VARIABLE, package: "sinew-runtime", target: "--lib", test };
        seed.run(|| any_history(number));
    }
}

/// Panics if a child has two incarnations, or the tree never ends.
fn any_history(seed: u64) {
    let mut chance = Chance::new(seed);
    let mut next = 0;
    let mut tree = Tree::new(any_plan(&mut chance, &mut next, 2), seed);
    let mut world = World::default();
    let mut now = 0;
    tree.handle(at(now), Input::Started);
    world.obey(&mut tree);
    for _ in 0..chance.next() % 60 {
        let alive: Vec<_> = world.alive.iter().map(|(id, life)| (*id, *life)).collect();
        let any = id(chance.next() % (next + 1));
        let life = match alive.len() as u64 {
            0 => (any, 1),
            count => alive[(chance.next() % count) as usize],
        };
        let input = match chance.next() % 12 {
            0..5 => Input::BecameReady(life.0, life.1),
            5 => Input::Ended(life.0, life.1, Reason::Panic(String::new())),
            6 => Input::Ended(life.0, life.1, Reason::Normal),
            7 => Input::Released(any),
            8 => [Input::TerminateChild(any), Input::RestartChild(any), Input::DeleteChild(any)]
                [(chance.next() % 3) as usize]
                .clone(),
            9 => {
                next += 1;
                tree.add(at(now), any, id(next), Policy::default());
                Input::TimePassed
            }
            _ => {
                now += chance.next() % 3_000;
                Input::TimePassed
            }
        };
        if let Input::Ended(child, life, _) = &input
            && world.alive.get(child) == Some(life)
        {
            world.alive.remove(child);
        }
        tree.handle(at(now), input);
        world.obey(&mut tree);
    }
    tree.handle(at(now), Input::StopOrdered);
    world.obey(&mut tree);
    let mut wakes = 0;
    while let Some(wake) = tree.next_wake() {
        tree.handle(wake, Input::TimePassed);
        world.obey(&mut tree);
        wakes += 1;
        assert!(wakes < 1_000, "does not come to its end");
    }
    assert!(world.ended, "no word of its end");
}

#[test]
fn supervisor_has_no_deadline_of_its_own() {
    let mut tree = two_floors(Flags::default());
    tree.handle(at(0), Input::Started);
    tree.handle(at(0), Input::BecameReady(id(1), 1));
    tree.handle(at(0), Input::BecameReady(id(11), 1));
    orders(&mut tree);
    tree.handle(at(0) + Duration::from_secs(11), Input::TimePassed);
    let seen = orders(&mut tree);
    assert_eq!(seen[0], Order::Abandon(id(12), 1));
    assert!(
        !seen.iter().any(|order| matches!(order, Order::Failed(child, _) if *child == id(10))),
        "{seen:?}"
    );
}
