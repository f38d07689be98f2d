//! Many transactions of parameters: four nodes on hosts of their own, each with one application, of which one is killed
//! or cut off in any phase of the transaction.
//!
//! The processes share the clock of the machine, so the ticks at which they apply their values are compared on one
//! clock.

mod node;
mod report;
mod robot;

use std::time::Duration;

use sinew_testkit::random::SeededRandom;

pub(crate) use node::run as run_node;
pub use report::Report;
use robot::{Answer, Robot, Verdict};

/// Number of nodes.
pub const NODES: usize = 4;
/// Time from the begin of a transaction to its stated time.
const LEAD: Duration = Duration::from_millis(250);
/// How long after it the coordinator waits for outcomes, and repairs.
const WITHIN: Duration = Duration::from_secs(10);
/// The first milliseconds, in which the nodes accept.
const ACCEPTED_WITHIN: Duration = Duration::from_millis(12);
/// Longest time beyond the stated time at which a node is killed or cut off.
const AFTER: Duration = Duration::from_millis(50);
/// Time after the stated time at which the living nodes are judged: many ticks, also of a loop that was delayed.
const JUDGED_AFTER: Duration = Duration::from_millis(200);
/// Longest time from the first to the last tick at which living nodes apply a transaction. A loop may be delayed, but a
/// node that did not know the result in time is later.
const SPREAD_MAX: Duration = Duration::from_millis(100);
/// Longest cut. It ends before the doubts of the applications do.
const CUT_MAX: Duration = Duration::from_secs(3);

/// The parameters of a run.
#[derive(Clone, Copy, Debug)]
pub struct Plan {
    /// Number of transactions with a fault.
    pub rounds: u32,
    /// One node of so many is cut off instead of killed; 0: none.
    pub cut_every: u32,
    /// The seed of all random decisions.
    pub seed: u64,
}

/// One transaction, and its fault.
#[derive(Clone, Copy, Debug)]
struct Round {
    coordinator: usize,
    victim: usize,
    /// When the fault comes after the order.
    after: Duration,
    is_cut: bool,
    /// The value of all nodes before, and after it.
    former: u64,
    value: u64,
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
    let mut robot = Robot::start()?;
    let mut report = Report::new(plan.seed);
    for number in 0..plan.rounds {
        let former = u64::from(number) * 2 + 1;
        // Half of the faults come while the nodes accept, the others at any time until shortly after the stated time.
        let latest = if random.below(2) == 0 { ACCEPTED_WITHIN } else { LEAD + AFTER };
        let round = Round {
            coordinator: random.below(NODES as u32) as usize,
            victim: random.below(NODES as u32) as usize,
            after: random.time_below(latest),
            is_cut: plan.cut_every > 0 && number % plan.cut_every == plan.cut_every - 1,
            former,
            value: former + 1,
        };
        robot.set_all(round.coordinator, former);
        if round.is_cut {
            play_cut(&mut robot, round, random.time_below(CUT_MAX), &mut report);
        } else {
            play_kill(&mut robot, round, &mut report);
        }
    }
    Ok(report)
}

/// Kills the victim during the transaction, and starts it again.
fn play_kill(robot: &mut Robot, round: Round, report: &mut Report) {
    let Round { coordinator, victim, after, value, .. } = round;
    robot.order(coordinator, value, LEAD, WITHIN);
    std::thread::sleep(after);
    robot.kill(victim);
    report.rounds += 1;
    std::thread::sleep((LEAD + JUDGED_AFTER).saturating_sub(after));
    let is_new = judge_living(robot, round, report);
    robot.start_node(victim);
    if coordinator == victim {
        // No coordinator is left to repair: the node begins with the value that it has kept.
        report.coordinators_killed += 1;
        let restarted = robot.look(victim).value;
        let has_new = restarted == value;
        report.claim(is_new != Some(false) || !has_new, || {
            format!("the restarted node {victim} has kept {restarted}, which no other node has: {round:?}")
        });
        if is_new == Some(true) {
            let count = if has_new { &mut report.kept } else { &mut report.behind };
            *count += 1;
        }
        return;
    }
    let answer = robot.answer(coordinator);
    let restarted = robot.look(victim).value;
    match answer.verdict {
        Verdict::None => {
            report.without_effect += 1;
            report.claim(is_new == Some(false) && restarted != value, || {
                format!(
                    "{answer:?}, but the restarted node {victim} has {restarted}, the others new: {is_new:?}"
                )
            });
        }
        Verdict::All => {
            report.complete += 1;
            report.claim(is_new == Some(true), || {
                format!("{answer:?}, but the others have new values: {is_new:?}")
            });
        }
        Verdict::Repaired => {
            report.repaired += 1;
            // The outcome is sent at the tick, just before the loop reads the value.
            let common = robot.wait_until_equal();
            let is_true = is_new == Some(true) && common == Some(value) && answer.repaired == [victim];
            report.claim(is_true, || {
                format!("{answer:?}, but the nodes have {common:?}, the others new: {is_new:?}")
            });
        }
        Verdict::Mixed => report.claim(false, || format!("{answer:?} after {after:?}")),
    }
}

/// Judges the nodes that were not killed: all have the new value, since about the same time, or none has. Returns
/// which; `None` if they differ.
fn judge_living(robot: &mut Robot, round: Round, report: &mut Report) -> Option<bool> {
    let living = (0..NODES).filter(|node| *node != round.victim);
    let seen: Vec<_> = living.map(|node| robot.look(node)).collect();
    let have_new = seen.iter().filter(|seen| seen.value == round.value).count();
    let have_former = seen.iter().filter(|seen| seen.value == round.former).count();
    if have_new == seen.len() {
        let since = seen.iter().map(|seen| seen.since_ns);
        let (first, last) = (since.clone().min().unwrap_or(0), since.max().unwrap_or(0));
        let spread = Duration::from_nanos(last - first);
        report.spread.note(spread);
        report.claim(spread <= SPREAD_MAX, || format!("living nodes were mixed for {spread:?}: {round:?}"));
        return Some(true);
    }
    report.claim(have_former == seen.len(), || format!("living nodes are mixed: {round:?}, {seen:?}"));
    (have_former == seen.len()).then_some(false)
}

/// Cuts the victim off during the transaction: at the end all have the same value.
fn play_cut(robot: &mut Robot, round: Round, cut: Duration, report: &mut Report) {
    let Round { coordinator, victim, after, former, value, .. } = round;
    robot.order(coordinator, value, LEAD, WITHIN);
    std::thread::sleep(after);
    robot.cut(victim);
    std::thread::sleep(cut);
    robot.join(victim);
    let answer: Answer = robot.answer(coordinator);
    report.rounds += 1;
    report.cuts += 1;
    let seen = robot.wait_until_equal();
    report.claim(seen == Some(value) || seen == Some(former), || {
        format!(
            "node {victim} was cut off for {cut:?} after {after:?}, and the nodes have {seen:?}: {answer:?}"
        )
    });
    let is_true = match answer.verdict {
        Verdict::None => true, // A node that was cut off alone may have agreed; the others have followed.
        Verdict::All | Verdict::Repaired => seen == Some(value),
        Verdict::Mixed => false,
    };
    report.claim(is_true, || format!("{answer:?}, but the nodes have {seen:?}"));
}
