//! Layers that fail under load: two nodes with traffic inside one and between them, a layer killed again and again.
//!
//! | file | what it is |
//! | --- | --- |
//! | `pacer` | sends at a rate, and keeps what became of each confirmed message |
//! | `sink` | takes what is sent, and knows what is missing, double or out of order |
//! | `report` | what was seen, as a table and as JSON |

mod pacer;
mod report;
mod sink;

use std::time::Duration;

use sinew::{NodeHandle, Time, fault::Fault, prelude::*};

pub use self::report::{Account, LayerReport, Report, Times};
use self::{
    pacer::{Pacer, Sent},
    sink::{Sink, Tracks},
};
use crate::{DEADLINE, Ground, all_run, puppet::desk, ready_for, sees};

/// The layers, in the order of their start.
pub const LAYERS: [&str; 4] = ["LNCL", "sync", "GNCL", "NDL"];

/// What is to be done.
#[derive(Clone, Copy, Debug)]
pub struct Plan {
    /// Layers that are killed, each in turn, on either node.
    pub panics: u64,
    /// Messages within the one node, a second.
    pub in_process: u64,
    /// Messages from the other node to it, a second.
    pub between_nodes: u64,
    /// Least time between two kills.
    pub spacing: Duration,
}

/// Where the messages were when a kill had healed: what is missing before belongs to that kill or an earlier one.
#[derive(Clone, Copy, Debug)]
struct Healed {
    layer: usize,
    upto: [u64; 2],
}

/// Lets layers fail under load and says what was seen.
///
/// # Panics
/// If a node does not start, or a layer does not come back.
#[must_use]
pub fn run(plan: Plan) -> Report {
    let ground = Ground::new();
    let node = |name: &str| {
        ground.node(name).configure(|config| {
            config.mailbox_capacity = 65_536;
            config.gncl.queue_capacity = 65_536;
            config.supervision.layer_restarts_max = 1_000_000;
            // Short: a layer that lived for this long is restarted at once.
            config.supervision.layer_window = Duration::from_millis(10);
        })
    };
    let tracks = Tracks::default();
    let sink = tracks.clone();
    let sink = AppSpec::new("sink", move || Sink::new(sink.clone()))
        .handles::<crate::puppet::Job>()
        .handles::<crate::puppet::Order>()
        .own_thread();
    let ((near, near_key), (far, far_key)) = (desk("near"), desk("far"));
    let here = node("home").app(sink).app(near).start().expect("a node");
    let there = node("there").app(far).start().expect("a node");
    all_run(&[&here, &there]);
    sees(&here.handle(), there.address());
    sees(&there.handle(), here.address());

    let began = Time::now();
    let inside = Pacer::start(near_key.sender(), plan.in_process);
    let between = Pacer::start(far_key.sender(), plan.between_nodes);
    tracks.wait_for_traffic(here.address(), there.address());
    let nodes = [here.handle(), there.handle()];
    let mut layers: [Times; 4] = Default::default();
    let mut gaps = Times::default();
    let mut healed = Vec::new();
    for panic in 0..plan.panics {
        let layer = usize::try_from(panic % 4).expect("below four");
        let node = &nodes[usize::from(panic / 4 % 2 == 1)];
        let killed = Time::now();
        layers[layer].note(kill(node, layer));
        tracks.wait_for_next(there.address(), between.sent_so_far());
        gaps.note(Time::now().since(killed));
        healed.push(Healed { layer, upto: between.sent_so_far() });
        std::thread::sleep(plan.spacing.saturating_sub(Time::now().since(killed)));
    }
    let (inside, between) = (inside.finish(), between.finish());
    let seconds = Time::now().since(began).as_secs_f64();
    let restarted =
        ["sink", "near"].iter().map(|name| here.handle().lives(name)).chain([there.handle().lives("far")]);
    let restarted = restarted.map(|lives| lives.expect("it is there").starts - 1).sum();
    tracks.wait_for_the_last(here.address(), inside.upto);
    tracks.wait_for_the_last(there.address(), between.upto);
    report(plan, seconds, restarted, &tracks, (&here, &inside), (&there, &between), (layers, gaps, &healed))
}

/// A layer panics; returns the time until it was ready again.
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

#[expect(clippy::too_many_arguments, reason = "each is one thing that was measured, used once")]
fn report(
    plan: Plan,
    seconds: f64,
    restarted: u64,
    tracks: &Tracks,
    (here, inside): (&Node, &Sent),
    (there, between): (&Node, &Sent),
    (layers, gaps, healed): ([Times; 4], Times, &[Healed]),
) -> Report {
    let missing = tracks.missing(there.address(), between.upto);
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
        in_process: tracks.account(here.address(), inside),
        between_nodes: tracks.account(there.address(), between),
        layers: layers.collect(),
        gaps,
    }
}

/// No run waits longer than this for one thing.
const PATIENCE: Duration = DEADLINE;
