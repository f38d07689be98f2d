//! Many presses of the stop of the whole system: four nodes on hosts of their own, under load, of which one is cut off
//! or killed at times.
//!
//! The processes share the clock of the machine, so the time from a press to each safe output is measured on one clock.

mod node;
mod report;
mod robot;

use std::time::Duration;

use sinew_testkit::random::SeededRandom;

pub(crate) use node::run as run_node;
pub use report::Report;
use robot::{Answer, Robot};

/// Number of nodes. The first one commands the outputs of all.
pub const NODES: usize = 4;
/// How long a press waits for confirmations.
const WITHIN: Duration = Duration::from_millis(500);
/// Longest time from a cut to a press: the nodes do not know of each other's loss yet.
const CUT_BEFORE: Duration = Duration::from_millis(30);
/// Longest time from the order to press to a kill.
const KILLED_AFTER: Duration = Duration::from_millis(3);
/// Time in which nothing may move after a release.
const LOOKED_AT: Duration = Duration::from_millis(100);

/// The parameters of a run.
#[derive(Clone, Copy, Debug)]
pub struct Plan {
    /// Number of presses.
    pub presses: u32,
    /// One press of so many is made while a node is cut off; 0: none.
    pub cut_every: u32,
    /// One press of so many is made while a node is killed; 0: none.
    pub kill_every: u32,
    /// Messages that each node sends to the next one in a millisecond, beside the commands.
    pub load: u32,
    /// The seed of all random decisions.
    pub seed: u64,
}

/// The fault that accompanies a press. Never of the first node: it commands its own output, so that no bound is known
/// without it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Fault {
    None,
    Cut(usize),
    Kill(usize),
}

impl Fault {
    fn of_round(plan: &Plan, round: u32, random: &mut SeededRandom) -> Self {
        let is_due = |every: u32| every > 0 && round % every == every - 1;
        let victim = 1 + random.below(NODES as u32 - 1) as usize;
        match (is_due(plan.kill_every), is_due(plan.cut_every)) {
            (true, _) => Self::Kill(victim),
            (false, true) => Self::Cut(victim),
            (false, false) => Self::None,
        }
    }

    const fn victim(self) -> Option<usize> {
        match self {
            Self::None => None,
            Self::Cut(victim) | Self::Kill(victim) => Some(victim),
        }
    }
}

/// Runs the scenario.
///
/// # Errors
/// Why hosts cannot be made here: no root, or no `ip`.
///
/// # Panics
/// A node does not start, or something does not come true in time.
pub fn run(plan: &Plan) -> Result<Report, String> {
    let mut random = SeededRandom::new(plan.seed);
    let mut robot = Robot::start(plan.load)?;
    let mut report = Report::new(plan.seed);
    for round in 0..plan.presses {
        let fault = Fault::of_round(plan, round, &mut random);
        play(&mut robot, fault, &mut random, &mut report);
    }
    Ok(report)
}

/// Lets all outputs move, presses the stop, and releases it.
fn play(robot: &mut Robot, fault: Fault, random: &mut SeededRandom, report: &mut Report) {
    robot.move_all();
    let others: Vec<usize> = (0..NODES).filter(|node| Some(*node) != fault.victim()).collect();
    let presser = others[random.below(others.len() as u32) as usize];
    let answer = press(robot, presser, fault, random);
    report.presses += 1;
    judge_reached(robot, &others, &answer, report);
    match fault {
        Fault::None => {}
        Fault::Cut(victim) => {
            judge_cut(robot, victim, &answer, report);
            robot.join(victim);
        }
        Fault::Kill(victim) => {
            robot.start_node(victim);
            // It learns of the stop before its output can be armed.
            report.claim(!robot.output(victim).is_live, || format!("node {victim} moves after its restart"));
        }
    }
    robot.wait_until_confirmed(presser);
    for node in 0..NODES {
        report.claim(!robot.output(node).is_live, || format!("node {node} moves during the stop"));
    }
    let releaser = others[random.below(others.len() as u32) as usize];
    robot.release(releaser);
    let moved = |robot: &mut Robot| (0..NODES).map(|node| robot.output(node).moved).collect::<Vec<_>>();
    let before = moved(robot);
    std::thread::sleep(LOOKED_AT);
    report.claim(moved(robot) == before, || "an output moves after the release".to_owned());
}

/// Presses at this node, with the fault.
fn press(robot: &mut Robot, presser: usize, fault: Fault, random: &mut SeededRandom) -> Answer {
    if let Fault::Cut(victim) = fault {
        robot.cut(victim);
        std::thread::sleep(random.time_below(CUT_BEFORE));
    }
    robot.order_press(presser, WITHIN);
    if let Fault::Kill(victim) = fault {
        std::thread::sleep(random.time_below(KILLED_AFTER));
        robot.kill(victim);
    }
    robot.answer(presser)
}

/// Judges the nodes that the press can reach: each has confirmed, and its output is safe.
fn judge_reached(robot: &mut Robot, others: &[usize], answer: &Answer, report: &mut Report) {
    for node in others.iter().copied() {
        let row = answer.row(node);
        let confirmed = row.and_then(|row| row.confirmed);
        report.claim(confirmed.is_some(), || format!("node {node} has not confirmed: {row:?}"));
        if let Some(time) = confirmed {
            report.confirmed[node].note(time);
        }
        let output = robot.output(node);
        report.claim(!output.is_live, || format!("node {node} moves after the press"));
        // An output that a late command had made safe before has no such time.
        if let Some(time) = output.safe_ns.checked_sub(answer.pressed_ns) {
            report.safe[node].note(Duration::from_nanos(time));
        }
    }
}

/// Judges a node that is cut off: it is named as one that has not confirmed, and is safe within the stated time.
fn judge_cut(robot: &mut Robot, victim: usize, answer: &Answer, report: &mut Report) {
    let row = answer.row(victim);
    let is_named = row.is_some_and(|row| row.confirmed.is_none());
    report.claim(is_named, || format!("node {victim} is cut off, and not named: {row:?}"));
    let bound = row.and_then(|row| row.bound);
    report.claim(bound.is_some(), || format!("node {victim} is cut off, and has no bound: {row:?}"));
    let safe_ns = robot.wait_until_safe(victim);
    // It may have been safe before the press.
    let took = Duration::from_nanos(safe_ns.saturating_sub(answer.pressed_ns));
    report.cut_off.note(took);
    if let Some(bound) = bound {
        report.bounds.note(bound);
        report
            .claim(took <= bound, || format!("node {victim} was safe after {took:?}, not within {bound:?}"));
    }
}
