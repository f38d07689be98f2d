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
//! | `planted` | faults in the core's behaviour that the judge must find |
//! | `cost` | what a node costs among 10, 100 and 1,000 |

mod chance;
mod cost;
mod judge;
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

/// Seeds in an ordinary run.
const SEEDS: u64 = 300;
/// How many instead; `docs/TESTING.md` has the command.
const SEEDS_VARIABLE: &str = "SINEW_NDL_SEEDS";
/// The one seed that is to be replayed.
const SEED_VARIABLE: &str = "SINEW_NDL_SEED";
/// Seeds within which each planted fault must be found.
const SEEDS_FOR_A_FAULT: u64 = 300;

fn number(variable: &str) -> Option<u64> {
    std::env::var(variable).ok().map(|text| text.parse().expect("a number"))
}

fn run(seed: u64, fault: Option<Fault>) -> Outcome {
    World::new(Plan::of(seed), fault).run()
}

fn words(seed: u64, outcome: &Outcome) -> String {
    format!(
        "seed {seed}: {}\nreplay it with a trace: {SEED_VARIABLE}={seed} cargo test -p sinew --lib \
         ndl::core::simulation::a_seed_is_replayed -- --nocapture",
        outcome.violations.join("\n")
    )
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
    let seed = number(SEED_VARIABLE);
    let trace = seed.is_some();
    let replay = || World::new(Plan::of(seed.unwrap_or(7)), None).traced(trace).run();
    let outcome = replay();
    assert!(outcome.violations.is_empty(), "{}", words(seed.unwrap_or(7), &outcome));
    let again = World::new(Plan::of(seed.unwrap_or(7)), None).run();
    assert_eq!((outcome.seen, outcome.digest), (again.seen, again.digest));
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
