//! Many cores on a bad network in virtual time: whatever happens, the [`judge`] finds nothing to say against them.
//!
//! A number, the seed, decides all: how many nodes, their settings, clocks and addresses, what the network does to each
//! datagram, who stalls, dies, leaves and comes again when. The judge knows the network and the truth, and nothing of
//! the core but what it sends and says. It stands here, among the core's tests, because no other part of the core than
//! what shells use is needed to run it, and because [`planted`] faults change what is private.
//!
//! | file | what is in it |
//! | --- | --- |
//! | `plan` | what a seed says |
//! | `world` | virtual time, one queue of events, processes |
//! | `network` | what becomes of a datagram |
//! | `judge` | what must hold, apart from all scenarios |
//! | `listeners` | what applications are told |
//! | `planted` | faults in the core's behaviour that the judge must find |
//! | `cost` | what a node costs among 10, 100 and 1,000 |

mod chance;
mod cost;
mod judge;
mod listeners;
mod network;
mod plan;
mod planted;
mod world;

pub(super) use self::chance::Chance;
use self::{
    plan::Plan,
    planted::Fault,
    world::{Outcome, World},
};
use crate::seeded::{Seed, number};

/// Seeds in an ordinary run; without optimization a fifth of them takes as long.
const SEEDS: u64 = if cfg!(debug_assertions) { 60 } else { 300 };
/// How many instead; `docs/TESTING.md` has the command.
pub(super) const SEEDS_VARIABLE: &str = "SINEW_NDL_SEEDS";
/// The most nodes that are looked at: what they cost at 10, 100 and so on, how they get over faults if there are more than 100.
const CROWD_VARIABLE: &str = "SINEW_NDL_CROWD";
/// The one crowd that is to be replayed.
const CROWD_SEED_VARIABLE: &str = "SINEW_NDL_CROWD_SEED";
/// Crowds of 100 in an ordinary run. Without optimization one takes as long as all other seeds.
const CROWDS: u64 = if cfg!(debug_assertions) { 1 } else { 3 };
/// The one seed that is to be replayed.
pub(super) const SEED_VARIABLE: &str = "SINEW_NDL_SEED";
/// Seeds within which each planted fault must be found.
const SEEDS_FOR_A_FAULT: u64 = 300;

fn seed(number: u64) -> Seed {
    let test = "ndl::core::simulation::a_seed_is_replayed";
    Seed { number, variable: SEED_VARIABLE, package: "sinew", test }
}

fn run(number: u64, fault: Option<Fault>) -> Outcome {
    seed(number).run(|| World::new(Plan::of(number), fault).run())
}

fn words(number: u64, outcome: &Outcome) -> String {
    format!("{}\n{}", outcome.violations.join("\n"), seed(number))
}

#[test]
fn whatever_happens_the_judge_finds_nothing() {
    let seeds = number(SEEDS_VARIABLE).unwrap_or(SEEDS);
    let mut seen = world::Seen::default();
    for seed in 0..seeds {
        let outcome = run(seed, None);
        assert!(outcome.violations.is_empty(), "{}", words(seed, &outcome));
        seen.add(&outcome.seen);
    }
    println!("{seeds} seeds: {seen:?}");
    seen.must_cover_everything(seeds);
}

#[test]
fn a_seed_is_replayed_the_same_each_time() {
    let asked_for = number(SEED_VARIABLE);
    let replayed = asked_for.unwrap_or(7);
    let traced = || World::new(Plan::of(replayed), None).traced(asked_for.is_some()).run();
    let outcome = seed(replayed).run(traced);
    assert!(outcome.violations.is_empty(), "{}", words(replayed, &outcome));
    let again = run(replayed, None);
    assert_eq!((outcome.seen, outcome.digest), (again.seen, again.digest));
}

/// Plays so many crowds, or the one that is asked for; `test` replays one, with `variable`.
fn crowds_get_over_faults(nodes: usize, crowds: u64, variable: &'static str, test: &'static str) {
    let only = number(CROWD_SEED_VARIABLE);
    let mut seen = world::Seen::default();
    for number in only.map_or(0..crowds, |only| only..only + 1) {
        let seed = Seed { number, variable, package: "sinew", test };
        let outcome = seed.run(|| World::new(Plan::crowd(number, nodes), None).run_and_tell());
        assert!(outcome.violations.is_empty(), "{nodes} nodes: {}\n{seed}", outcome.violations.join("\n"));
        seen.add(&outcome.seen);
    }
    println!("{nodes} nodes: {seen:?}");
}

#[test]
fn a_hundred_nodes_get_over_faults() {
    crowds_get_over_faults(100, CROWDS, CROWD_SEED_VARIABLE, "ndl::core::simulation::a_hundred_nodes");
}

/// One crowd: a thousand are 6 million datagrams in each of its 8 s or more.
#[test]
fn more_nodes_get_over_faults_where_they_are_asked_for() {
    if let Some(nodes) = number(CROWD_VARIABLE).filter(|nodes| *nodes > 100) {
        let variable = format!("{CROWD_VARIABLE}={nodes} {CROWD_SEED_VARIABLE}").leak();
        let nodes = usize::try_from(nodes).expect("a small number");
        crowds_get_over_faults(nodes, 1, variable, "ndl::core::simulation::more_nodes");
    }
}

#[test]
fn each_planted_fault_is_found() {
    for fault in Fault::ALL {
        let found = (0..SEEDS_FOR_A_FAULT).find_map(|seed| {
            let outcome = run(seed, Some(fault));
            outcome.violations.into_iter().next().map(|violation| (seed, violation))
        });
        let Some((seed, violation)) = found else {
            panic!("{fault:?} is not found in {SEEDS_FOR_A_FAULT} seeds");
        };
        println!("{fault:?}: seed {seed}: {violation}");
    }
}
