//! Time that three nodes with 32 applications need to start all of them, or to continue, once the last one
//! has arrived.

use std::{
    sync::mpsc::{Receiver, SyncSender, sync_channel},
    time::Duration,
};

use sinew::{
    barrier::{Barrier, Meet},
    prelude::*,
    supervision::ReadyGate,
};

use sinew_testkit::report::Times;
use sinew_testkit::{DEADLINE, Loopback, all_run, sees, until};

const NODES: usize = 3;
const APPLICATIONS: usize = 32;

/// The measurements, each from the last arrival or Ready.
#[derive(Debug, Default)]
pub struct Figures {
    /// Time until the last one continues.
    pub release: Times,
    /// Time between the first and the last one to continue.
    pub skew: Times,
}

impl Figures {
    fn note(&mut self, begun: Time, ends: &[Time]) {
        let (Some(first), Some(last)) = (ends.iter().min(), ends.iter().max()) else { return };
        self.release.note(last.since(begun));
        self.skew.note(last.since(*first));
    }
}

/// Becomes ready on command.
struct Gate(SyncSender<Option<ReadyGate>>);

impl Actor for Gate {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        self.0.send(context.hold_ready()).expect("the trial listens");
    }
}

/// Reports the time of its start.
struct Starter(SyncSender<Time>);

impl Actor for Starter {
    type Context = AppContext<Self>;

    fn started(&mut self, _: &mut Self::Context) {
        self.0.send(Time::now()).expect("the trial listens");
    }
}

fn receive<T>(from: &Receiver<T>, what: &str) -> T {
    from.recv_timeout(DEADLINE).unwrap_or_else(|_| panic!("waited {DEADLINE:?} for {what}"))
}

/// Uses new nodes for each trial: 32 applications on three nodes require one gate on each node; the last gate
/// opens.
#[must_use]
pub fn start_up(trials: usize) -> Figures {
    let mut figures = Figures::default();
    for _ in 0..trials {
        let loopback = Loopback::new();
        let (open, gates) = sync_channel(NODES);
        let (starts, started) = sync_channel(APPLICATIONS);
        let nodes: Vec<Node> = (0..NODES)
            .map(|node| {
                let open = open.clone();
                let gate =
                    AppSpec::new(format!("gate.{node}"), move || Gate(open.clone())).start_within(DEADLINE);
                let builder = loopback.node(&format!("n{node}")).app(gate);
                let of_node = (0..APPLICATIONS).filter(|index| index % NODES == node);
                let builder = of_node.fold(builder, |builder, index| {
                    let starts = starts.clone();
                    let name = format!("app.{index}");
                    builder.app(AppSpec::new(name, move || Starter(starts.clone())).requires(["3 of gate.*"]))
                });
                builder.start().expect("it starts")
            })
            .collect();
        meet_each_other(&nodes);
        let mut gates: Vec<ReadyGate> = (0..NODES).filter_map(|_| receive(&gates, "a gate")).collect();
        let last = gates.pop().expect("three of them");
        gates.into_iter().for_each(ReadyGate::reached);
        // All nodes know that these two are ready before the last one opens.
        until("two gates are ready everywhere", || {
            let ready = |node: &Node| node.handle().directory().iter().filter(|entry| entry.ready).count();
            nodes.iter().all(|node| ready(node) == NODES - 1).then_some(())
        });
        let begun = Time::now();
        last.reached();
        let ends: Vec<Time> = (0..APPLICATIONS).map(|_| receive(&started, "a start")).collect();
        figures.note(begun, &ends);
    }
    figures
}

fn meet_each_other(nodes: &[Node]) {
    for node in nodes {
        for other in nodes.iter().filter(|other| other.handle().address() != node.handle().address()) {
            sees(&node.handle(), other.handle().address());
        }
    }
}

/// Arrives once all but the last are waiting.
struct Party {
    barrier: Barrier,
    arrived: SyncSender<Time>,
    passed: SyncSender<(u64, Time)>,
}

impl Actor for Party {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        self.arrive(context);
    }
}

impl Party {
    fn arrive(&mut self, context: &mut AppContext<Self>) {
        // The times of a finished trial have no reader.
        let _ = self.arrived.send(Time::now());
        let meeting = context.meet(&self.barrier).into_actor(self);
        context.spawn(meeting.map(|met, this, context| {
            let Ok(generation) = met else { return };
            let _ = this.passed.send((generation, Time::now()));
            context.run_later(Duration::from_millis(20), Self::arrive);
        }));
    }
}

/// Lets 32 applications on three nodes meet repeatedly.
#[must_use]
pub fn run_time(rounds: usize) -> Figures {
    let loopback = Loopback::new();
    let barrier = Barrier::of(APPLICATIONS, "round").within(DEADLINE);
    let (arrive, arrived) = sync_channel(4 * APPLICATIONS);
    let (pass, passed) = sync_channel(4 * APPLICATIONS);
    let nodes: Vec<Node> = (0..NODES)
        .map(|node| {
            let of_node = (0..APPLICATIONS).filter(|index| index % NODES == node);
            let builder = of_node.fold(loopback.node(&format!("n{node}")), |builder, index| {
                let (barrier, arrived, passed) = (barrier.clone(), arrive.clone(), pass.clone());
                let make = move || Party {
                    barrier: barrier.clone(),
                    arrived: arrived.clone(),
                    passed: passed.clone(),
                };
                builder.app(AppSpec::new(format!("app.{index}"), make))
            });
            builder.start().expect("it starts")
        })
        .collect();
    all_run(&nodes.iter().collect::<Vec<_>>());
    let mut figures = Figures::default();
    for round in 0..rounds {
        let begun: Vec<Time> = (0..APPLICATIONS).map(|_| receive(&arrived, "an arrival")).collect();
        let ends: Vec<(u64, Time)> = (0..APPLICATIONS).map(|_| receive(&passed, "a pass")).collect();
        assert!(
            ends.iter().all(|(generation, _)| *generation == round as u64 + 1),
            "generations are mixed: {ends:?}"
        );
        let last = begun.into_iter().max().expect("32 of them");
        figures.note(last, &ends.into_iter().map(|(_, at)| at).collect::<Vec<_>>());
    }
    figures
}
