//! Layers that fail under load: two nodes with local and inter-node traffic, while layers are killed
//! repeatedly.
//!
//! | file | content |
//! | --- | --- |
//! | `pacer` | sends at a rate, and records the outcome of each confirmed message |
//! | `record` | the histories of all messages, and the application that receives them |
//! | `report` | the results, as a table and as JSON |

mod pacer;
mod record;
mod report;

use sinew_testkit::report::Times;
use std::time::Duration;

use sinew::{NodeHandle, Time, fault::Fault, prelude::*};

pub use self::report::{LayerReport, Report};
use self::{
    pacer::{Pacer, Sent},
    record::{Record, Sink},
};
use sinew_testkit::{DEADLINE, Loopback, all_run, ready_for, scripted::sender_app, sees};

/// The layers, in the order of their start.
pub const LAYERS: [&str; 4] = ["LNCL", "sync", "GNCL", "NDL"];

/// The parameters of a run.
#[derive(Clone, Copy, Debug)]
pub struct Plan {
    /// Number of kills. The layers are killed in turn, on either node.
    pub panics: u64,
    /// Messages per second within the one node.
    pub in_process: u64,
    /// Messages per second from the other node to it.
    pub between_nodes: u64,
    /// Minimum interval between two kills.
    pub spacing: Duration,
}

/// The positions of the flows when the node had recovered from a kill. A message missing before belongs to
/// that kill or an earlier one.
#[derive(Clone, Copy, Debug)]
struct Healed {
    layer: usize,
    upto: [u64; 2],
}

/// Makes layers fail under load, and returns the results.
///
/// # Panics
/// If a node does not start, or a layer does not recover.
#[must_use]
pub fn run(plan: Plan) -> Report {
    let loopback = Loopback::new();
    let node = |name: &str| {
        loopback.node(name).configure(|config| {
            config.mailbox_capacity = 65_536;
            config.gncl.queue_capacity = 65_536;
            config.supervision.layer_restarts_max = 1_000_000;
            // Short: a layer that lived for this long is restarted at once.
            config.supervision.layer_window = Duration::from_millis(10);
        })
    };
    let record = Record::default();
    let sink = record.clone();
    let sink = AppSpec::new("sink", move || Sink(sink.clone()))
        .handles::<sinew_testkit::scripted::Job>()
        .handles::<sinew_testkit::scripted::Order>()
        .own_thread();
    let ((near, near_key), (far, far_key)) = (sender_app("near"), sender_app("far"));
    let here = node("home").app(sink).app(near).start().expect("a node");
    let there = node("there").app(far).start().expect("a node");
    all_run(&[&here, &there]);
    sees(&here.handle(), there.address());
    sees(&there.handle(), here.address());

    let began = Time::now();
    let inside = Pacer::start(near_key.sender(), plan.in_process, (here.address(), &record));
    let between = Pacer::start(far_key.sender(), plan.between_nodes, (there.address(), &record));
    [&here, &there].into_iter().for_each(|node| record.wait_for_next(node.address(), [0, 0]));
    let nodes = [here.handle(), there.handle()];
    let mut layers: [Times; 4] = Default::default();
    let mut gaps = Times::default();
    let mut healed = Vec::new();
    for panic in 0..plan.panics {
        let layer = usize::try_from(panic % 4).expect("below four");
        let node = &nodes[usize::from(panic / 4 % 2 == 1)];
        let killed = Time::now();
        layers[layer].note(kill(node, layer));
        record.wait_for_next(there.address(), between.sent_so_far());
        gaps.note(Time::now().since(killed));
        healed.push(Healed { layer, upto: between.sent_so_far() });
        std::thread::sleep(plan.spacing.saturating_sub(Time::now().since(killed)));
    }
    let (inside, between) = (inside.finish(), between.finish());
    let seconds = Time::now().since(began).as_secs_f64();
    let restarted =
        ["sink", "near"].iter().map(|name| here.handle().lives(name)).chain([there.handle().lives("far")]);
    let restarted = restarted.map(|lives| lives.expect("it is there").starts - 1).sum();
    record.wait_for_the_last(here.address(), inside.upto);
    record.wait_for_the_last(there.address(), between.upto);
    report(plan, seconds, restarted, &record, (&here, &inside), (&there, &between), (layers, gaps, &healed))
}

/// Makes a layer panic. Returns the time until it is ready again.
fn kill(node: &NodeHandle, layer: usize) -> Duration {
    let lives = |layer: usize| node.lives(LAYERS[layer]).expect("every node has it");
    let before: Vec<_> = (0..LAYERS.len()).map(|layer| lives(layer).readies).collect();
    node.inject(LAYERS[layer], Fault::panic()).expect("every node has it");
    for index in layer..LAYERS.len() {
        ready_for(node, LAYERS[index], before[index] + 1);
    }
    let lives = lives(layer);
    lives.ready.expect("it is ready").since(lives.struck.expect("it was struck"))
}

/// Makes a layer panic when a line of the standard input has its name. Prints when it and the layers after it
/// are ready again.
pub(crate) fn panic_on_command(node: &NodeHandle) {
    for name in std::io::stdin().lines().map_while(Result::ok) {
        kill(node, LAYERS.iter().position(|layer| *layer == name).expect("the name of a layer"));
        println!("{name} is ready again");
    }
}

#[expect(clippy::too_many_arguments, reason = "each is one thing that was measured, used once")]
fn report(
    plan: Plan,
    seconds: f64,
    restarted: u64,
    record: &Record,
    (here, inside): (&Node, &Sent),
    (there, between): (&Node, &Sent),
    (layers, gaps, healed): ([Times; 4], Times, &[Healed]),
) -> Report {
    let missing = record.missing(there.address());
    let lost_by = |layer: usize| {
        let mut from = [0, 0];
        let mut lost = 0;
        for healed in healed {
            if healed.layer == layer {
                let in_it = |(class, number): &&(usize, u64)| {
                    from[*class] < *number && *number <= healed.upto[*class]
                };
                lost += missing.iter().filter(in_it).count() as u64;
            }
            from = healed.upto;
        }
        lost
    };
    let layers = layers.into_iter().enumerate();
    let layers =
        layers.map(|(layer, ready)| LayerReport { name: LAYERS[layer], ready, lost: lost_by(layer) });
    Report {
        panics: plan.panics,
        seconds,
        restarted,
        in_process: record.verdict(here.address()),
        between_nodes: record.verdict(there.address()),
        again: [inside.again, between.again],
        layers: layers.collect(),
        gaps,
    }
}

/// Maximum wait of a run for one event.
const PATIENCE: Duration = DEADLINE;
