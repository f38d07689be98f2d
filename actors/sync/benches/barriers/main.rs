//! Cost of a barrier of 1,000 applications, for one of its nodes.
//!
//! `cargo bench -p sinew-sync --bench barriers [-- WORD...]`: the applications are on 2, 10 or 100 nodes, and the
//! barrier names its parties by a count, or by 63 names and a count. The node receives one arrival after the other,
//! each in a frame of its own. Figures: the time of a frame, and of all frames of a round. One JSON line for each
//! figure on the standard output, a table on the standard error. Nothing here asserts a time.

#![expect(clippy::unwrap_used, reason = "a bench says what failed by failing")]

use std::{
    iter,
    time::{Duration, Instant},
};

use sinew_figures::{Alone, Asked, Figures, head};
use sinew_model::{
    barrier::{ArriveAtBarrier, BarrierAnswer, BarrierKind, OnPartyLoss},
    config::NodeConfig,
    facts::{AppFact, LinkFact},
};
use sinew_runtime::{
    app::Requirement,
    tid::{AppAddress, Incarnation, NodeAddress},
    time::Time,
};
use sinew_sync::{
    arrivals::{Arrival, Arrivals, PublishedBarrier},
    core::{Core, Input, Output},
    list::{List, Name},
};

/// Applications that meet.
const APPLICATIONS: u32 = 1_000;
/// The largest count beside 63 names: 1,024 together.
const BESIDE_NAMES: u32 = 1_024 - 63;
/// Rounds that are measured.
const ROUNDS: u64 = 5;

/// The parties of the barrier.
#[derive(Clone, Copy, Debug)]
enum Parties {
    Count,
    NamesAndCount,
}

fn main() {
    let cases =
        [2, 10, 100].into_iter().flat_map(|nodes| [(nodes, Parties::Count), (nodes, Parties::NamesAndCount)]);
    let name = |(nodes, parties): &(u32, Parties)| match parties {
        Parties::Count => format!("{nodes}_nodes_by_count"),
        Parties::NamesAndCount => format!("{nodes}_nodes_by_names_and_count"),
    };
    let wanted = Asked::read(include_str!("main.rs"), &[]).wanted(cases, name);
    head();
    for case in wanted {
        let (frames, rounds) = measure(case.0, &texts(case));
        let case = name(&case);
        let report = |figure, seen| {
            Alone { bench: "barriers", case: &case, figure, seen, counts: &[] }.report();
        };
        report("a frame with one more arrival", &frames);
        report("all frames of a round", &rounds);
    }
}

fn texts((nodes, parties): (u32, Parties)) -> Vec<String> {
    match parties {
        Parties::Count => vec![format!("{APPLICATIONS} of *")],
        Parties::NamesAndCount => (0..63)
            .map(|party| name(party % nodes, party / nodes).to_string())
            .chain([format!("{BESIDE_NAMES} of *")])
            .collect(),
    }
}

fn address(node: u32) -> NodeAddress {
    NodeAddress::new(0x7f00_0001 + node)
}

fn name(node: u32, app: u32) -> Name {
    Name::try_from(format!("n{node}.app{app}")).unwrap()
}

fn drain(core: &mut Core) -> Vec<Output> {
    iter::from_fn(|| core.poll()).collect()
}

/// Measures one node of `nodes` with an equal share of waiting applications on each. Returns the times of frames and
/// of rounds.
fn measure(nodes: u32, parties: &[String]) -> (Figures, Figures) {
    let each = APPLICATIONS / nodes;
    let now = Time::from_nanos(1);
    let mut core = linked_core(now, nodes, each);
    let (mut frames, mut rounds) = (Figures::new(), Figures::new());
    for generation in 0..ROUNDS {
        arrive_here(&mut core, now, (each, generation), parties);
        let (mut opened, mut of_round) = (0, Duration::ZERO);
        for node in 1..nodes {
            for payload in frames_of(node, (each, generation), parties) {
                let start = Instant::now();
                core.handle(now, Input::ArrivalsReceived { from: address(node), payload });
                let outputs = drain(&mut core);
                let taken = start.elapsed();
                frames.record(taken);
                of_round += taken;
                let is_opened = |output: &&Output| {
                    matches!(output, Output::AnswerBarrier { answer: BarrierAnswer::Opened { .. }, .. })
                };
                opened += outputs.iter().filter(is_opened).count();
            }
        }
        assert_eq!(opened, each as usize, "all of this node pass");
        rounds.record(of_round);
    }
    (frames, rounds)
}

/// Returns the core of node 0 with its ready applications and links to all other nodes.
fn linked_core(now: Time, nodes: u32, each: u32) -> Core {
    let mut core = Core::new(&NodeConfig::new("n"), address(0), Incarnation(1));
    for app in 0..each {
        let (address, name) = (AppAddress::fixed(app).unwrap(), Some(name(0, app).to_string()));
        core.handle(now, Input::AppChanged(AppFact::own_registered(address, name, Vec::new())));
        core.handle(now, Input::AppChanged(AppFact::Ready { app: address }));
    }
    for node in 1..nodes {
        let fact = LinkFact::LinkUp { node: address(node), incarnation: Incarnation(1) };
        core.handle(now, Input::LinkChanged(fact));
        let list = List { incarnation: Incarnation(1), version: 1, entries: Vec::new(), groups: Vec::new() };
        let payload = list.encode_within(usize::MAX, 0).0;
        core.handle(now, Input::ListReceived { from: address(node), payload });
    }
    drain(&mut core);
    core
}

fn arrive_here(core: &mut Core, now: Time, (each, generation): (u32, u64), parties: &[String]) {
    for app in 0..each {
        let asked = ArriveAtBarrier {
            barrier: "all".to_owned(),
            parties: parties.to_vec(),
            within_ms: 60_000,
            on_loss: OnPartyLoss::Wait,
            kind: BarrierKind::Meeting,
        };
        let app = AppAddress::fixed(app).unwrap();
        core.handle(now, Input::Arrived { app, correlation: generation, asked });
    }
}

/// Returns the frames of a node: each has one more arrival than the one before.
fn frames_of(node: u32, (each, generation): (u32, u64), parties: &[String]) -> Vec<bytes::Bytes> {
    let mut read: Vec<Requirement> = parties.iter().map(|party| party.parse().unwrap()).collect();
    read.sort_by(|a, b| a.as_str().cmp(b.as_str()));
    let mut arrivals = Vec::new();
    let frame = |app: u32| {
        let (address, name) = (AppAddress::fixed(app).unwrap(), Some(name(node, app)));
        arrivals.push(Arrival { party: u64::from(app) + 1, app: address, name, after: generation });
        let published = PublishedBarrier {
            name: Name::try_from("all".to_owned()).unwrap(),
            parties: read.clone(),
            generation,
            members: Vec::new(),
            earlier: Vec::new(),
            arrivals: arrivals.clone(),
        };
        let version = 1 + generation * u64::from(each) + u64::from(app);
        Arrivals { incarnation: Incarnation(1), version, barriers: vec![published] }.encode()
    };
    (0..each).map(frame).collect()
}
