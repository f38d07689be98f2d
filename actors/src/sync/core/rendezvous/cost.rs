//! What it costs a node that many applications meet: `docs/TESTING.md` has the command.

use std::time::Instant;

use super::super::*;
use crate::{
    config::NodeConfig,
    sync::{
        arrivals::{Arrival, Arrivals, BarrierSaid},
        list::Name,
        words::{ArriveAtBarrier, BarrierAnswer, BarrierKind, OnPartyLoss},
    },
};

/// Applications that meet.
const APPLICATIONS: u32 = 1_000;
/// What a count beside 63 names may take: 1,024 together.
const BESIDE_NAMES: u32 = 1_024 - 63;
/// Rounds that are measured.
const ROUNDS: u64 = 5;

fn address(node: u32) -> NodeAddress {
    NodeAddress::new(0x7f00_0001 + node)
}

fn name(node: u32, app: u32) -> Name {
    Name::try_from(format!("n{node}.app{app}")).unwrap()
}

/// One node of `nodes`, on which as many applications of those wait as on each other one, hears of one arrival after the other,
/// each in a word of its own. Returns the mean time of a word, and of a round, in microseconds.
fn round(nodes: u32, parties: &[String]) -> (f64, f64) {
    let each = APPLICATIONS / nodes;
    let mut core = Core::new(&NodeConfig::new("n"), address(0), Incarnation(1));
    let now = Time::from_nanos(1);
    let drain = |core: &mut Core| std::iter::from_fn(|| core.poll()).collect::<Vec<_>>();
    for app in 0..each {
        let (address, name) = (AppAddress::fixed(app).unwrap(), Some(name(0, app).to_string()));
        core.handle(now, Input::AppChanged(AppFact::own_registered(address, name, Vec::new())));
        core.handle(now, Input::AppChanged(AppFact::Ready { app: address }));
    }
    for node in 1..nodes {
        let fact = LinkFact::LinkUp { node: address(node), incarnation: Incarnation(1) };
        core.handle(now, Input::LinkChanged(fact));
        let list = crate::sync::list::List {
            incarnation: Incarnation(1),
            version: 1,
            entries: Vec::new(),
            groups: Vec::new(),
        };
        core.handle(now, Input::ListReceived { from: address(node), payload: list.encode(usize::MAX).0 });
    }
    drain(&mut core);
    let mut read: Vec<sinew_runtime::app::Requirement> =
        parties.iter().map(|party| party.parse().unwrap()).collect();
    read.sort_by(|a, b| a.as_str().cmp(b.as_str()));
    let (mut words, mut taken) = (0u32, Duration::ZERO);
    for generation in 0..ROUNDS {
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
        let mut opened = 0;
        for node in 1..nodes {
            let mut arrivals = Vec::new();
            for app in 0..each {
                let (address_of_app, name) = (AppAddress::fixed(app).unwrap(), Some(name(node, app)));
                let party = u64::from(app) + 1;
                arrivals.push(Arrival { party, app: address_of_app, name, after: generation });
                let said = BarrierSaid {
                    name: Name::try_from("all".to_owned()).unwrap(),
                    parties: read.clone(),
                    generation,
                    members: Vec::new(),
                    earlier: Vec::new(),
                    arrivals: arrivals.clone(),
                };
                let version = 1 + generation * u64::from(each) + u64::from(app);
                let payload =
                    Arrivals { incarnation: Incarnation(1), version, barriers: vec![said] }.encode();
                let begun = Instant::now();
                core.handle(now, Input::ArrivalsReceived { from: address(node), payload });
                let outputs = drain(&mut core);
                taken += begun.elapsed();
                words += 1;
                let is_opened = |output: &&Output| {
                    matches!(output, Output::AnswerBarrier { answer: BarrierAnswer::Opened { .. }, .. })
                };
                opened += outputs.iter().filter(is_opened).count();
            }
        }
        assert_eq!(opened, each as usize, "all of this node go on");
    }
    let micros = taken.as_secs_f64() * 1e6;
    (micros / f64::from(words), micros / ROUNDS as f64)
}

#[test]
#[ignore = "it measures: 10 s without optimization"]
fn what_a_round_of_a_thousand_applications_costs_each_node() {
    let by_count = vec![format!("{APPLICATIONS} of *")];
    for nodes in [2, 10, 100] {
        let by_name: Vec<String> = (0..64)
            .map(|party| name(party % nodes, party / nodes))
            .map(|name| name.to_string())
            .take(63)
            .chain([format!("{BESIDE_NAMES} of *")])
            .collect();
        for (what, parties) in [("count", &by_count), ("63 names and a count", &by_name)] {
            let (word, round) = round(nodes, parties);
            println!(
                "{nodes} nodes, {APPLICATIONS} applications, {what}: {word:.1} us a word, {round:.0} us a round"
            );
        }
    }
}
