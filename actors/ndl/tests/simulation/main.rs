//! Simulates many cores of NDL on a bad network in virtual time, on the kit `sinew-sim`. The [`judge`] must find no
//! violation, in any scenario.
//!
//! A number, the seed, decides everything: the number of nodes, their settings, clocks and addresses, the treatment of
//! each datagram by the network, and each stall, death, leave and restart. The judge knows the network and the truth,
//! and of the core only its datagrams and outputs. Most planted [`faults`] change inputs and outputs of the core. The
//! others change its private state, by methods that the feature `testing` adds to the core.
//!
//! | file | contents |
//! | --- | --- |
//! | `plan` | the plan of a seed |
//! | `world` | virtual time, the events of a run, and processes |
//! | `network` | the networks between the nodes |
//! | `judge` | the rules that must hold, in any scenario |
//! | `listeners` | the events for applications |
//! | `faults` | faults in the core's behaviour that the judge must find |
//! | `cost` | the cost of a node among 10, 100 and 1,000 |

mod cost;
mod faults;
mod judge;
mod listeners;
mod network;
mod plan;
mod world;

use sinew_sim::{Coverage, History, Hunt, Seeds, number};

use self::{
    faults::Fault,
    plan::Plan,
    world::{Outcome, World},
};

/// The seeds of an ordinary run; without optimization a fifth of them takes as long.
/// `docs/book/src/contributing/testing.md` has the commands.
const SEEDS: Seeds = Seeds {
    variable: "SINEW_NDL_SEED",
    package: "sinew-ndl",
    target: "--test simulation",
    test: "a_seed_is_replayed",
    count: if cfg!(debug_assertions) { 60 } else { 300 },
};
/// Crowds of 100 in an ordinary run. Without optimization one takes as long as all other seeds.
const CROWDS: Seeds = Seeds {
    variable: "SINEW_NDL_CROWD_SEED",
    test: "a_hundred_nodes",
    count: if cfg!(debug_assertions) { 1 } else { 3 },
    ..SEEDS
};
/// One larger crowd: with a thousand nodes there are 6 million datagrams in each of its 8 s or more.
const LARGER_CROWDS: Seeds = Seeds { test: "more_nodes", count: 1, ..CROWDS };
/// Sets the maximum number of nodes: for the cost of 10, 100 and so on, and for recovery from faults if more than 100.
const CROWD_VARIABLE: &str = "SINEW_NDL_CROWD";
/// Seeds within which each planted fault must be found.
const SEEDS_FOR_A_FAULT: u64 = 300;

/// The situations that the seeds of an ordinary run must reach: one for 20 seeds.
const SITUATIONS: [&str; 12] = [
    "datagrams",
    "datagrams lost",
    "found",
    "crashed",
    "hung",
    "link down",
    "left",
    "restarted",
    "stalls",
    "liveness hints",
    "restart events",
    "stall events",
];

/// Runs a seed.
fn play(seed: u64, fault: Option<Fault>, history: &History) -> Result<Outcome, String> {
    World::new(Plan::of(seed), fault, history).run()
}

#[test]
fn judge_finds_no_violation_in_any_seed() {
    let (mut coverage, seeds) = (Coverage::default(), SEEDS.numbers().count() as u64);
    SEEDS.run(|seed, history| {
        coverage.merge(&play(seed, None, history)?.coverage);
        Ok(())
    });
    println!("{seeds} seeds: {coverage:?}");
    if SEEDS.only().is_none() {
        coverage.require(&SITUATIONS, seeds / 20);
        // Datagrams alone are rarely lost for that long.
        coverage.require(&["events of silent layers"], (seeds / 20).div_ceil(5));
    }
}

#[test]
fn a_seed_is_replayed_the_same_each_time() {
    let seed = SEEDS.only().unwrap_or(7);
    let history = if SEEDS.only().is_some() { History::printed() } else { History::off() };
    let first = play(seed, None, &history);
    assert!(first.is_ok(), "{first:?}\n{}", SEEDS.seed(seed));
    assert_eq!(first, play(seed, None, &History::off()));
}

/// Runs crowds of this many nodes. The error names the number of nodes.
fn crowds_get_over_faults(seeds: Seeds, nodes: usize) {
    let mut coverage = Coverage::default();
    seeds.run(|seed, history| {
        let outcome = World::new(Plan::crowd(seed, nodes), None, history).run_with_progress();
        coverage.merge(&outcome.map_err(|words| format!("{CROWD_VARIABLE}={nodes}: {words}"))?.coverage);
        Ok(())
    });
    println!("{nodes} nodes: {coverage:?}");
}

#[test]
fn a_hundred_nodes_recover_from_faults() {
    crowds_get_over_faults(CROWDS, 100);
}

#[test]
fn more_nodes_recover_from_faults_on_request() {
    if let Some(nodes) = number(CROWD_VARIABLE).filter(|nodes| *nodes > 100) {
        println!("a replay needs {CROWD_VARIABLE}={nodes}, too");
        crowds_get_over_faults(LARGER_CROWDS, usize::try_from(nodes).expect("a small number"));
    }
}

#[test]
fn each_planted_fault_is_found() {
    // A fault that few seeds find is searched first at the seed that found it last.
    let found_last = [(Fault::LossPostponedForever, 61)];
    let (faults, within) = (&Fault::ALL, SEEDS_FOR_A_FAULT);
    let hunt = Hunt { seeds: &SEEDS, faults, within, found_last: &found_last };
    hunt.run(|seed, fault, history| play(seed, fault, history).map(drop));
}
