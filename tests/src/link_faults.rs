//! The claim: despite any fault of the link between two nodes, every message between them arrives once and in
//! order, or its sender is notified.
//!
//! | file | content |
//! | --- | --- |
//! | `node` | the role of a node: one application that sends at a rate and receives |
//! | `pacer` | the thread that sends, and records the outcome of each confirmed message |
//! | `clerk` | notes sent and received messages, in ranges |
//! | `pair` | both nodes with the faulty network between them, as their scenario sees them |
//! | `progress` | the progress messages of a run |
//! | `trouble` | the kinds of link faults, and their repair |
//! | `wall_clock` | a settable wall clock for each node |
//! | `report` | the results, as a table and as JSON |

mod clerk;
mod node;
mod pacer;
mod pair;
mod progress;
mod report;
mod trouble;
mod wall_clock;

use std::time::{Duration, Instant};

use sinew::Class;

use self::{
    pair::Pair,
    report::{Gap, Gaps},
};
pub use self::{report::Report, trouble::Trouble};
use sinew_testkit::random::SeededRandom;

/// All classes, in the order of their numbers.
const CLASSES: [Class; 3] = [Class::Control, Class::Stream, Class::Bulk];

/// The parameters of a run.
#[derive(Clone, Debug)]
pub struct Plan {
    /// Messages per second from the first node to the second.
    pub rate: u64,
    /// Messages per second in the other direction.
    pub back_rate: u64,
    /// Filler bytes of each message.
    pub filling: usize,
    /// The kinds of faults, used in turn.
    pub troubles: Vec<Trouble>,
    /// Total number of faults.
    pub faults: u64,
    /// Minimum interval between two faults, randomly extended by up to a half.
    pub spacing: Duration,
    /// Duration of lasting faults.
    pub hold: Duration,
    /// Flips one bit in this many bytes, all the time.
    pub one_flip_in: Option<u32>,
    /// Random seed.
    pub seed: u64,
}

/// Runs the role of a node.
pub(crate) fn run_node(arguments: &[String]) {
    node::run(arguments);
}

/// Injects faults into the link, and accounts for the messages. While it waits, it prints its progress to
/// standard error every 10 s.
///
/// # Panics
/// If a node does not start, or messages do not flow again after a fault has ended.
#[must_use]
pub fn run(plan: &Plan) -> Report {
    let mut pair = Pair::start(plan);
    let mut random = SeededRandom::new(plan.seed);
    let mut gaps = Gaps::default();
    let began = Instant::now();
    for fault in 0..plan.faults {
        let trouble = plan.troubles[fault as usize % plan.troubles.len()];
        let _ = pair.gaps();
        pair.strikes(trouble);
        let struck = Instant::now();
        pair.suffer(trouble, plan.hold);
        pair.wait_for_flow();
        let flows = struck.elapsed();
        // A new receiver does not know when its former incarnation received the last message.
        gaps.note(trouble, if trouble == Trouble::KillReceiver { Gap::of_all(flows) } else { pair.gaps() });
        let pause = plan.spacing + random.time_below(plan.spacing / 2);
        std::thread::sleep(pause.saturating_sub(struck.elapsed()));
    }
    let seconds = began.elapsed();
    let (verdict, network, audit) = pair.finish();
    Report { plan: plan.clone(), seconds: seconds.as_secs_f64(), verdict, network, gaps, audit }
}
