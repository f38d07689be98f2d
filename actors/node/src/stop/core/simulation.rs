//! Seeded simulations of several nodes: cuts, restarts, presses and releases at the same time, lost and late states.

use super::{tests::*, *};

const SEEDS: u64 = 300;
const STEPS: u64 = 600;
/// Time of one step.
const STEP: Duration = Duration::from_millis(7);

/// A linear congruential generator: enough to vary the order of events, and the same for a seed.
struct Chance(u64);

impl Chance {
    fn below(&mut self, bound: u64) -> u64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 33) % bound
    }
}

/// One node: its core, and a model of its shell.
struct Node {
    core: Core,
    incarnation: u64,
    latch: StopState,
    /// Steps until its outputs are safe.
    moving: u64,
    kept: Stops,
}

impl Node {
    fn new(index: usize, incarnation: u64, kept: Stops, now: Time) -> Self {
        let own =
            Own { incarnation: Incarnation(incarnation), has_lived: incarnation > 1, ..own(NODES[index]) };
        let core = Core::new(own, kept.clone(), now);
        Self { core, incarnation, latch: StopState::Released, moving: 0, kept }
    }
}

struct World {
    chance: Chance,
    now: Time,
    nodes: Vec<Node>,
    /// States on their way: when they arrive, its sender and its receiver.
    under_way: Vec<(Time, usize, usize, Frame)>,
    /// Whether the nodes with these indices are cut off from the others.
    is_cut: [bool; NODES.len()],
    is_kept: bool,
    /// Presses that no release has known: the press, and where.
    open: Vec<(Origin, u32)>,
}

impl World {
    fn new(seed: u64) -> Self {
        let now = Time::from_nanos(1_000_000_000);
        let nodes = (0..NODES.len()).map(|index| Node::new(index, 1, Stops::default(), now)).collect();
        let is_kept = seed.is_multiple_of(2);
        let chance = Chance(seed);
        Self {
            chance,
            now,
            nodes,
            under_way: Vec::new(),
            is_cut: [false; NODES.len()],
            is_kept,
            open: Vec::new(),
        }
    }

    fn is_linked(&self, one: usize, other: usize) -> bool {
        !self.is_cut[one] && !self.is_cut[other]
    }

    fn handle(&mut self, index: usize, input: Input) {
        self.nodes[index].core.handle(self.now, input);
        while let Some(order) = self.nodes[index].core.poll() {
            match order {
                Output::SetLatch(state) => {
                    if state == StopState::Stopped {
                        self.nodes[index].moving = self.chance.below(3);
                    }
                    self.nodes[index].latch = state;
                }
                Output::PassStop => assert_ne!(self.nodes[index].latch, StopState::Stopped),
                Output::Send(to, frame) => self.send(index, to, *frame),
                Output::Keep => self.nodes[index].kept = self.nodes[index].core.stops().clone(),
            }
        }
        let node = &self.nodes[index];
        assert_eq!(node.latch == StopState::Stopped, node.core.is_stopped(), "the latch follows the core");
    }

    fn send(&mut self, from: usize, to: NodeAddress, frame: Frame) {
        if frame.is_safe {
            assert_eq!(self.nodes[from].moving, 0, "a node confirmed with a live output");
        }
        let Some(to) = NODES.iter().position(|node| address(*node) == to) else { return };
        if self.is_linked(from, to) && self.chance.below(10) > 0 {
            let delay = STEP / 2 * u32::try_from(self.chance.below(6)).expect("it is small");
            self.under_way.push((self.now + delay, from, to, frame));
        }
    }

    fn deliver(&mut self) {
        let now = self.now;
        let (due, rest) = std::mem::take(&mut self.under_way).into_iter().partition(|(at, ..)| *at <= now);
        self.under_way = rest;
        let due: Vec<(Time, usize, usize, Frame)> = due;
        for (_, from, to, frame) in due {
            if self.is_linked(from, to) {
                let operators = NODES.map(person).into();
                self.handle(to, Input::FrameReceived { from: address(NODES[from]), frame, operators });
            }
        }
    }

    /// Lets time pass at all nodes.
    fn tick(&mut self) {
        self.now = self.now + STEP;
        self.deliver();
        for index in 0..NODES.len() {
            let others = (0..NODES.len()).filter(|other| *other != index);
            let seen = others.map(|other| SeenNode {
                node: address(NODES[other]),
                incarnation: Incarnation(self.nodes[other].incarnation),
                name: String::new(),
                lost: (!self.is_linked(index, other)).then(|| "silent".to_owned()),
            });
            let seen = seen.collect();
            self.handle(index, Input::NodesSeen(seen));
            let not_safe = usize::from(std::mem::take(&mut self.nodes[index].moving) > 0);
            self.handle(index, Input::OutputsSeen(StoppedOutputs::default(), not_safe));
        }
    }

    /// Does something at random.
    fn act(&mut self) {
        let index = usize::try_from(self.chance.below(NODES.len() as u64)).expect("it is small");
        match self.chance.below(60) {
            0 => {
                self.handle(
                    index,
                    Input::Pressed { by: person(NODES[index]), reason: LeaveReason::of("a test") },
                );
                let core = &self.nodes[index].core;
                let origin = Origin { node: core.own.node, incarnation: core.own.incarnation };
                let pressed =
                    core.stops().entries().find(|entry| entry.origin == origin).expect("it pressed");
                self.open.push((origin, pressed.pressed));
            }
            1 => {
                let known: Vec<_> = self.nodes[index].core.stops().entries().cloned().collect();
                let knows = |origin: Origin, number: u32| {
                    known.iter().any(|entry| entry.origin == origin && entry.pressed >= number)
                };
                self.open.retain(|(origin, number)| !knows(*origin, *number));
                self.handle(index, Input::Released { by: person(NODES[index]) });
            }
            2 | 3 => self.is_cut[index] = !self.is_cut[index],
            4 => self.restart(index),
            _ => {}
        }
    }

    fn restart(&mut self, index: usize) {
        // Without a state directory the last node that knows a press must not end.
        let knows = |node: &Node, open: &(Origin, u32)| {
            node.core.stops().entries().any(|entry| entry.origin == open.0 && entry.pressed >= open.1)
        };
        let is_last = self.open.iter().any(|open| {
            let mut others = (0..NODES.len()).filter(|other| *other != index);
            !others.any(|other| knows(&self.nodes[other], open))
        });
        if is_last && !self.is_kept {
            return;
        }
        let kept = if self.is_kept { self.nodes[index].kept.clone() } else { Stops::default() };
        let incarnation = self.nodes[index].incarnation + 1;
        self.nodes[index] = Node::new(index, incarnation, kept, self.now);
        self.under_way.retain(|(_, from, to, _)| *from != index && *to != index);
        self.handle(index, Input::TimePassed);
    }
}

// spec: STOP-1, STOP-2, STOP-4, STOP-6
#[test]
fn linked_nodes_agree_and_keep_every_press() {
    for seed in 0..SEEDS {
        let mut world = World::new(seed);
        for _ in 0..STEPS {
            world.act();
            world.tick();
        }
        world.is_cut = [false; NODES.len()];
        // Longer than the refresh and the hold.
        for _ in 0..900 {
            world.tick();
        }
        let states: Vec<_> = world.nodes.iter().map(|node| node.latch).collect();
        assert!(states.iter().all(|state| *state == states[0]), "seed {seed}: {states:?}");
        assert_ne!(states[0], StopState::Held, "seed {seed}: nothing holds them any more");
        assert!(
            world.open.is_empty() || states[0] == StopState::Stopped,
            "seed {seed}: {:?} is lost",
            world.open
        );
        if states[0] == StopState::Stopped {
            assert!(
                world.nodes.iter().all(|node| node.core.is_confirmed()),
                "seed {seed}: not all confirmed"
            );
        }
    }
}

// spec: STOP-4, STOP-5
#[test]
fn presser_learns_which_nodes_have_confirmed() {
    for seed in 0..SEEDS {
        let mut world = World::new(seed);
        (0..400).for_each(|_| world.tick());
        let cut = usize::try_from(seed % 3).expect("it is small");
        world.is_cut[cut] = true;
        world.tick();
        let presser = (cut + 1) % 3;
        world.handle(presser, Input::Pressed { by: person(1), reason: LeaveReason::of("a test") });
        (0..200).for_each(|_| world.tick());
        let report = world.nodes[presser].core.report();
        for node in &report.nodes {
            let is_cut = node.node == address(NODES[cut]);
            assert_eq!(node.confirmed_us.is_none(), is_cut, "seed {seed}: {report:?}");
            assert_eq!(node.note.contains("it is lost"), is_cut, "seed {seed}: {report:?}");
        }
        assert_ne!(world.nodes[cut].latch, StopState::Stopped, "it has not heard");
        // When it is back, it is stopped before anything can be armed there.
        world.is_cut[cut] = false;
        for _ in 0..400 {
            world.tick();
            assert_ne!(world.nodes[cut].latch, StopState::Released, "seed {seed}");
        }
        assert!(world.nodes[presser].core.is_confirmed(), "seed {seed}");
    }
}
