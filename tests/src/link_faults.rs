//! The claim: whatever happens to the link between two nodes, every message between them arrives once and in order, or its sender
//! is told.
//!
//! A program that proves it is its own cast: it starts itself again, with `--role`, for each of the two nodes.
//!
//! | file | what it is |
//! | --- | --- |
//! | `node` | the role of a node: one application that sends at a rate and takes what comes |
//! | `pacer` | the thread that sends, and keeps what became of each confirmed message |
//! | `clerk` | writes down what was sent and got, in rows |
//! | `pair` | both nodes with the faulty network between them, as their director sees them |
//! | `progress` | what is said while it goes on |
//! | `trouble` | what can happen to a link, and how it is healed |
//! | `wall_clock` | a wall clock of each node's own, which can be set |
//! | `report` | what was seen, as a table and as JSON |

mod clerk;
mod node;
mod pacer;
mod pair;
mod progress;
mod report;
mod trouble;
mod wall_clock;

use std::{
    path::PathBuf,
    time::{Duration, Instant},
};

use sinew::Class;

use self::{
    pair::Pair,
    report::{Gap, Gaps},
};
pub use self::{report::Report, trouble::Trouble};
use crate::dice::Dice;

/// All of them, in the order of their numbers.
const CLASSES: [Class; 3] = [Class::Control, Class::Stream, Class::Bulk];

/// What is to be done.
#[derive(Clone, Debug)]
pub struct Plan {
    /// A program whose `main` calls [`play`] first.
    pub program: PathBuf,
    /// Messages from the first node to the second, a second.
    pub rate: u64,
    /// Messages the other way, a second.
    pub back_rate: u64,
    /// Bytes of each message besides its numbers.
    pub filling: usize,
    /// What happens, each in turn.
    pub troubles: Vec<Trouble>,
    /// How often something happens, over all.
    pub faults: u64,
    /// From one fault to the next, at least. By chance up to half of it more.
    pub spacing: Duration,
    /// How long a fault lasts that lasts.
    pub hold: Duration,
    /// One bit of so many bytes is flipped all the time.
    pub one_flip_in: Option<u32>,
    /// What all chance comes from.
    pub seed: u64,
}

/// Plays the role that this process was started for; `None` if it is the director.
#[must_use]
pub fn play() -> Option<std::process::ExitCode> {
    let mut arguments = std::env::args().skip(1);
    if arguments.next().as_deref() != Some("--role") {
        return None;
    }
    node::play(&arguments.skip(1).collect::<Vec<_>>());
    Some(std::process::ExitCode::SUCCESS)
}

/// Lets things happen to the link and says what became of the messages. While it waits it says on standard error each 10 s how far it is.
///
/// # Panics
/// If a node does not start, or messages do not flow again after a fault has ended.
#[must_use]
pub fn run(plan: &Plan) -> Report {
    let mut pair = Pair::start(plan);
    let mut dice = Dice::new(plan.seed);
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
        // A new receiver does not know when its former life got the last one.
        gaps.note(trouble, if trouble == Trouble::KillReceiver { Gap::of_all(flows) } else { pair.gaps() });
        let pause = plan.spacing + dice.time_below(plan.spacing / 2);
        std::thread::sleep(pause.saturating_sub(struck.elapsed()));
    }
    let seconds = began.elapsed();
    let (verdict, network, audit) = pair.finish();
    Report { plan: plan.clone(), seconds: seconds.as_secs_f64(), verdict, network, gaps, audit }
}
