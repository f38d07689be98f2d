//! Simulates many cores that exchange lists. Links break, nodes restart, and applications come and go in any
//! order.
//!
//! Checked rules:
//! - No application starts before its requirements have run.
//! - After quiet, each application with requirements that can be met runs.
//! - Each waiting application is given the reason.
//! - All nodes report the same.
//!
//! Planted faults in the inputs of cores and in the execution of their outputs must be found.
//!
//! A number, the seed, decides everything: the number of nodes, mostly 3 to 8 and sometimes up to 30, and the
//! events.
//!
//! | file | contents |
//! | --- | --- |
//! | `plan` | the plan of a seed |
//! | `world` | the cores, and the execution of their outputs |
//! | `apps` | applications: requirements, notifications, start and end |
//! | `links` | links that break, one end after the other, nodes that are lost, paused, restarted and leave |
//! | `judge` | rules that must hold after quiet, regardless of all events before |

mod apps;
mod judge;
mod links;
mod plan;
mod world;

use std::{
    collections::{BTreeMap, BTreeSet},
    time::Duration,
};

use bytes::Bytes;
use sinew_model::{
    barrier::ArriveAtBarrier,
    config::NodeConfig,
    directory::DirectoryEvent,
    facts::{AppFact, LinkFact, LossReason, MembershipFact},
};
use sinew_runtime::{
    app::{Requirement, RequirementEvent},
    tid::{AppAddress, Incarnation, NodeAddress, Tid},
    time::Time,
};
use sinew_sim::{Coverage, History, Hunt, Pipe, Seeds, number};
use sinew_sync::core::{Core, Input, Output, REPEAT, RETRY, UNREACHABLE_MAX};

use self::{
    plan::{AppState, Clock, Ends, Loss, Plan, Step, Wanted},
    world::{SITUATIONS, World},
};

/// Applications per node; their names are `node.app`.
const APPS: usize = 3;
/// One more application, with a name that other nodes use, too.
const SHARED: usize = APPS;
/// The maximum number of applications per node.
const SLOTS: usize = APPS + 1;
/// An application of each node that subscribes to the directory.
const WATCHER: usize = 99;
/// The one phase that applications reach.
const PHASE: &str = "homed";
/// The longest wait for an optional requirement, in milliseconds.
const WAIT_LIMIT_MAX: u64 = 80;

/// The seeds of an ordinary run; `docs/book/src/contributing/testing.md` has the commands.
const SEEDS: Seeds = Seeds {
    variable: "SINEW_DIRECTORY_SEED",
    package: "sinew-sync",
    target: "--test simulation",
    test: "directory::after_quiet",
    count: 250,
};
/// Sets the number of nodes, regardless of the seed.
const NODES_VARIABLE: &str = "SINEW_DIRECTORY_NODES";
/// Seeds within which each planted fault must be found.
const SEEDS_FOR_A_FAULT: u64 = 1_000;
/// Seeds that must not find a fault, with too few nodes for it.
const SEEDS_WITHOUT_A_FAULT: u64 = 50;

/// A fault in the inputs of a core, or in the execution of its outputs.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Fault {
    /// An application is reported ready when it is registered.
    ReadyTooEarly,
    /// The failure of an application is not reported.
    FailureNotReported,
    /// The end of an application's registration is not reported.
    EndNotReported,
    /// An unchanged list is not sent: a lost one is never repeated.
    RepeatsLost,
    /// One release in three is not executed.
    ReleaseLost,
    /// An application is released as soon as it is registered.
    ReleasedAtOnce,
    /// Subscribers of the directory are not notified of removed applications.
    RemovalNotReported,
    /// Waiting applications are given no reason.
    ReasonsKept,
    /// The versions of all nodes' lists are compared as if one node had sent them: correct with two nodes.
    OneVersionForAll,
    /// Only two of the lists of one turn are sent: correct with three nodes.
    TwoListsATurn,
    /// The successor of a failed actor handles an event again that its predecessor has handled.
    HandledAgain,
    /// One broken link in three is not reported.
    BreakNotReported,
    /// One lost node in three is not reported.
    LossNotReported,
    /// One loss of a requirement in three is not reported to the application.
    LackNotReported,
    /// One requirement in three that is met again is not reported.
    MetNotReported,
    /// An application with an optional requirement is released as if the requirement were met.
    NotWaitedFor,
    /// An earlier list is delivered as if it had come over the restored link.
    FormerListDelivered,
}

impl Fault {
    /// The faults that random plans find.
    const BY_SEEDS: [Self; 16] = [
        Self::ReadyTooEarly,
        Self::FailureNotReported,
        Self::EndNotReported,
        Self::RepeatsLost,
        Self::ReleaseLost,
        Self::ReleasedAtOnce,
        Self::RemovalNotReported,
        Self::ReasonsKept,
        Self::OneVersionForAll,
        Self::TwoListsATurn,
        Self::HandledAgain,
        Self::BreakNotReported,
        Self::LossNotReported,
        Self::LackNotReported,
        Self::MetNotReported,
        Self::NotWaitedFor,
    ];
}

fn address(node: usize) -> NodeAddress {
    NodeAddress::new(0x7f00_0001 + node as u32)
}

/// Returns the name of the application with this index; indices count through all slots of all nodes.
fn name(index: usize) -> String {
    if index % SLOTS == SHARED { "shared".to_owned() } else { format!("{}.{}", index / SLOTS, index % SLOTS) }
}

fn app_address(slot: usize) -> AppAddress {
    AppAddress::fixed(slot as u32).unwrap()
}

/// Returns the index of the application with this TID.
fn index_of(tid: Tid) -> usize {
    let node = (tid.node.bits() - address(0).bits()) as usize;
    let slot = (0..SLOTS).find(|slot| app_address(*slot) == tid.app).expect("only these have names");
    node * SLOTS + slot
}

/// Returns the number of nodes in each seed, if it is set.
fn nodes() -> Option<usize> {
    let nodes = number(NODES_VARIABLE).map(|nodes| usize::try_from(nodes).expect("a small number"));
    assert!(nodes.is_none_or(|nodes| nodes > 1), "{NODES_VARIABLE}: two and more");
    nodes
}

/// Runs a plan. Returns the counts of its situations.
fn play(plan: Plan, fault: Option<Fault>, history: &History) -> Result<Coverage, String> {
    World::new(&plan, fault, history).run(plan.steps)
}

/// Runs the plan of a seed. The error names the number of nodes, if it is set.
fn run(seed: u64, fault: Option<Fault>, history: &History) -> Result<Coverage, String> {
    let nodes = nodes();
    let set = nodes.map(|nodes| format!("{NODES_VARIABLE}={nodes}: ")).unwrap_or_default();
    play(Plan::of(seed, nodes), fault, history).map_err(|violations| set + &violations)
}

#[test]
fn after_quiet_all_possible_applications_run_and_nodes_agree() {
    let (mut coverage, seeds) = (Coverage::default(), SEEDS.numbers().count() as u64);
    let mut played = 0;
    SEEDS.run(|seed, history| {
        coverage.merge(&run(seed, None, history)?);
        played += 1;
        if played % seeds.div_ceil(10) == 0 {
            println!("{played} of {seeds} seeds: {coverage:?}");
        }
        Ok(())
    });
    if seeds >= SEEDS.count {
        coverage.require(&SITUATIONS, 3);
    }
}

#[test]
fn same_seed_gives_the_same_run() {
    let again = || run(7, None, &History::off());
    assert_eq!(again(), again());
}

#[test]
fn each_planted_fault_is_found() {
    let found_last = [
        (Fault::RepeatsLost, 134),
        (Fault::HandledAgain, 132),
        (Fault::LackNotReported, 684),
        (Fault::MetNotReported, 241),
    ];
    let (faults, within) = (&Fault::BY_SEEDS, SEEDS_FOR_A_FAULT);
    let hunt = Hunt { seeds: &SEEDS, faults, within, found_last: &found_last };
    hunt.run(|seed, fault, history| run(seed, fault, history).map(drop));
}

/// Few nodes cannot reveal these faults: that is why other seeds have more.
#[test]
fn faults_of_many_nodes_are_not_found_with_few() {
    for (fault, few) in [(Fault::OneVersionForAll, 2), (Fault::TwoListsATurn, 3)] {
        for number in 0..SEEDS_WITHOUT_A_FAULT {
            let found = play(Plan::of(number, Some(few)), Some(fault), &History::off()).err();
            assert_eq!(found, None, "{fault:?} among {few}");
        }
    }
}

fn registers(node: usize, slot: usize) -> Step {
    Step::Register { node, slot, requires: Vec::new() }
}

/// Random plans almost never register an application between the end of a link and its return.
#[test]
fn former_list_on_a_restored_link_is_found() {
    let (ends, of) = ((0, 1), BTreeSet::from([0]));
    let steps = vec![
        registers(0, 0),
        Step::Pass { millis: 10 },
        Step::Start { node: 0, slot: 0 },
        Step::Restore { ends },
        Step::Deliver { ends, count: 3 },
        Step::Cut { ends, loss: Loss::None },
        Step::ReportBreaks { node: 0 },
        Step::ReportBreaks { node: 1 },
        Step::Register { node: 1, slot: 0, requires: vec![Wanted::AtLeast { count: 1, of }] },
        Step::Restore { ends },
    ];
    let plan = Plan { seed: 0, nodes: 2, steps };
    assert_eq!(play(plan.clone(), None, &History::off()).err(), None);
    let found =
        play(plan, Some(Fault::FormerListDelivered), &History::off()).expect_err("it is released early");
    assert!(found.contains("is not met, by the inputs of its node"), "{found}");
}

#[test]
fn reason_is_reported_for_a_never_seen_name() {
    let of = BTreeSet::from([0, 1]);
    let requires = vec![Wanted::AtLeast { count: 2, of }];
    let steps = vec![registers(1, 0), Step::Register { node: 2, slot: 0, requires }, registers(0, 0)];
    assert_eq!(play(Plan { seed: 0, nodes: 3, steps }, None, &History::off()).err(), None);
}

#[test]
fn reregistered_and_removed_application_is_in_no_directory() {
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
    assert_eq!(play(Plan { seed: 0, nodes: 3, steps }, None, &History::off()).err(), None);
}
