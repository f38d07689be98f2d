//! Many cores that exchange lists over links that break, nodes that restart, applications that come and go in any
//! order: nobody starts before what it requires has run; after quiet, everybody whose requirements can be met runs, who waits is told why, and
//! all nodes say the same. Faults that are planted into what cores are told, and what becomes of their orders, must be found.
//!
//! A number, the seed, decides all: how many nodes there are, mostly 3 to 8 and now and then up to 30, and what happens to them.
//!
//! | file | what is in it |
//! | --- | --- |
//! | `plan` | what a seed says |
//! | `world` | the cores, and what becomes of what they order |
//! | `apps` | applications: what they require and were told, how they start and go |
//! | `links` | links that break, one end after the other, nodes that are lost, paused, restarted and leave |
//! | `judge` | what must hold after quiet, apart from all that happened |

mod apps;
mod judge;
mod links;
mod plan;
mod world;

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use sinew_runtime::app::{Requirement, RequirementEvent};

use self::{
    plan::{Clock, Come, Ends, Loss, Plan, Step, Wanted},
    world::{Seen, World},
};
use super::*;
use crate::{
    ndl::LossReason,
    seeded::{Seed, number},
};

/// Each node may have these applications; names are `node.app`.
const APPS: usize = 3;
/// And one more, whose name other nodes give, too.
const SHARED: usize = APPS;
/// All that a node may have.
const SLOTS: usize = APPS + 1;
/// An application of each node that watches the directory.
const WATCHER: usize = 99;
/// The one phase that applications reach.
const PHASE: &str = "homed";
/// The longest wait for what can be done without, in milliseconds.
const PATIENCE_MAX: u64 = 80;

/// Seeds in an ordinary run.
const SEEDS: u64 = 250;
/// How many instead; `docs/TESTING.md` has the command.
const SEEDS_VARIABLE: &str = "SINEW_DIRECTORY_SEEDS";
/// So many nodes, whatever the seed says.
const NODES_VARIABLE: &str = "SINEW_DIRECTORY_NODES";
/// The one seed that is to be replayed.
const SEED_VARIABLE: &str = "SINEW_DIRECTORY_SEED";
/// Seeds within which each planted fault must be found.
const SEEDS_FOR_A_FAULT: u64 = 1_000;
/// Seeds that do not find a fault where there are too few nodes for it.
const SEEDS_WITHOUT_A_FAULT: u64 = 50;

/// A fault in what a core is told, or in what becomes of what it orders.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Fault {
    /// An application is told to be ready when it is registered.
    ReadyTooEarly,
    /// That an application failed is not told.
    FailureNotTold,
    /// That an application is not to be there any more is not told.
    EndNotTold,
    /// A list that says what was said before is not sent: nothing makes good for one that was lost.
    RepeatsLost,
    /// One release in three is not carried out.
    ReleaseLost,
    /// An application is released as soon as it is registered.
    ReleasedAtOnce,
    /// Watchers of the directory are not told who has gone.
    GoneNotTold,
    /// Who waits is given no reason.
    ReasonsKept,
    /// The versions of all nodes' lists are compared as if one node had sent them: right between two.
    OneVersionForAll,
    /// Of the lists of one turn two are sent: right among three.
    TwoListsATurn,
    /// What the successor of an actor that failed is handed again is taken in again.
    HandledAgain,
    /// One broken link in three is not told.
    BreakNotTold,
    /// One lost node in three is not told.
    LossNotTold,
    /// One loss of a requirement in three is not told to whom it concerns.
    LackNotTold,
    /// One requirement in three that is met again is not told.
    MetNotTold,
    /// Who can do without something is released as if it were there.
    NotWaitedFor,
    /// A list of before is told as if it had come over the link that is up again.
    FormerListTold,
}

impl Fault {
    const ALL: [Self; 17] = [
        Self::ReadyTooEarly,
        Self::FailureNotTold,
        Self::EndNotTold,
        Self::RepeatsLost,
        Self::ReleaseLost,
        Self::ReleasedAtOnce,
        Self::GoneNotTold,
        Self::ReasonsKept,
        Self::OneVersionForAll,
        Self::TwoListsATurn,
        Self::HandledAgain,
        Self::BreakNotTold,
        Self::LossNotTold,
        Self::LackNotTold,
        Self::MetNotTold,
        Self::NotWaitedFor,
        Self::FormerListTold,
    ];
}

fn address(node: usize) -> NodeAddress {
    NodeAddress::new(0x7f00_0001 + node as u32)
}

/// Of the application in a slot of a node; all are counted through.
fn name(index: usize) -> String {
    if index % SLOTS == SHARED { "shared".to_owned() } else { format!("{}.{}", index / SLOTS, index % SLOTS) }
}

fn app_address(slot: usize) -> AppAddress {
    AppAddress::fixed(slot as u32).unwrap()
}

/// Which application has this TID.
fn index_of(tid: Tid) -> usize {
    let node = (tid.node.bits() - address(0).bits()) as usize;
    let slot = (0..SLOTS).find(|slot| app_address(*slot) == tid.app).expect("only these have names");
    node * SLOTS + slot
}

/// How many nodes there are in each seed, if that is asked for.
fn nodes() -> Option<usize> {
    let nodes = number(NODES_VARIABLE).map(|nodes| usize::try_from(nodes).expect("a small number"));
    assert!(nodes.is_none_or(|nodes| nodes > 1), "{NODES_VARIABLE}: two and more");
    nodes
}

fn seed(number: u64) -> Seed {
    let test = "sync::core::simulation::a_seed_is_replayed";
    let variable =
        nodes().map_or(SEED_VARIABLE, |nodes| format!("{NODES_VARIABLE}={nodes} {SEED_VARIABLE}").leak());
    Seed { number, variable, package: "sinew", test }
}

/// What happens; what is found to be wrong.
fn play(plan: Plan, fault: Option<Fault>, is_traced: bool) -> (Vec<String>, Seen) {
    World::new(&plan, fault, is_traced).run(plan.steps)
}

fn run(number: u64, fault: Option<Fault>, is_traced: bool) -> (Vec<String>, Seen) {
    seed(number).run(|| play(Plan::of(number, nodes()), fault, is_traced))
}

#[test]
fn after_quiet_all_who_can_run_do_and_all_nodes_agree() {
    let seeds = number(SEEDS_VARIABLE).unwrap_or(SEEDS);
    let mut seen = Seen::default();
    for number in 0..seeds {
        let (violations, of_seed) = run(number, None, false);
        assert!(violations.is_empty(), "{}\n{}", violations.join("\n"), seed(number));
        seen.add(&of_seed);
        if (number + 1).is_multiple_of(seeds.div_ceil(10)) {
            println!("{} of {seeds} seeds: {seen:?}", number + 1);
        }
    }
    if seeds >= SEEDS {
        seen.must_cover_everything();
    }
}

#[test]
fn a_seed_is_replayed() {
    let asked_for = number(SEED_VARIABLE);
    let replayed = asked_for.unwrap_or(7);
    let (violations, seen) = run(replayed, None, asked_for.is_some());
    assert!(violations.is_empty(), "{}\n{}", violations.join("\n"), seed(replayed));
    assert_eq!(run(replayed, None, false).1, seen);
}

#[test]
fn each_planted_fault_is_found() {
    for fault in Fault::ALL {
        let found = (0..SEEDS_FOR_A_FAULT)
            .find_map(|number| Some((number, run(number, Some(fault), false).0.into_iter().next()?)));
        let Some((number, words)) = found else {
            panic!("{fault:?} is not found in {SEEDS_FOR_A_FAULT} seeds");
        };
        println!("{fault:?}: seed {number}: {words}");
    }
}

/// What is right among few is wrong among more: that is why there are more here.
#[test]
fn faults_of_many_are_not_found_among_few() {
    for (fault, few) in [(Fault::OneVersionForAll, 2), (Fault::TwoListsATurn, 3)] {
        for number in 0..SEEDS_WITHOUT_A_FAULT {
            let (violations, _) = play(Plan::of(number, Some(few)), Some(fault), false);
            assert!(violations.is_empty(), "{fault:?} among {few}: {}", violations.join("\n"));
        }
    }
}

fn registers(node: usize, slot: usize) -> Step {
    Step::Register { node, slot, requires: Vec::new() }
}

#[test]
fn who_waits_for_two_of_whom_one_never_was_there_is_told_so() {
    let of = BTreeSet::from([0, 1]);
    let requires = vec![Wanted::AtLeast { count: 2, of }];
    let steps = vec![registers(1, 0), Step::Register { node: 2, slot: 0, requires }, registers(0, 0)];
    assert_eq!(play(Plan { seed: 0, nodes: 3, steps }, None, false).0, [""; 0]);
}

#[test]
fn who_registers_again_starts_and_goes_is_in_no_directory() {
    let (node, slot, ends) = (1, 2, (1, 2));
    let steps = vec![
        registers(0, 0),
        registers(node, slot),
        Step::Restore { ends },
        Step::Deliver { ends, count: 1 },
        Step::Pass { millis: 10 },
        registers(2, 0),
        registers(node, slot),
        Step::Start { node, slot },
        Step::Unregister { node, slot },
    ];
    assert_eq!(play(Plan { seed: 0, nodes: 3, steps }, None, false).0, [""; 0]);
}
