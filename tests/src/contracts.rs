//! Contracts across nodes: the sender of two outputs is lost, hangs or is stopped many times, and the time until each
//! output is safe is compared with the contract's.
//!
//! The processes share the monotonic clock of the machine, so one clock measures the time from the last command, or
//! from the order to stop, to a safe output. The times are upper bounds: the last command before a kill or a pause was
//! sent up to one period earlier, and that period is added. Commands become late when the echoes that they quote
//! do: the time counts from the first echo that is held back.

mod node;
mod report;
mod system;

use std::time::Duration;

use sinew::Time;

pub(crate) use node::run as run_node;
pub use node::{PERIOD, WATCHDOG};
pub use report::Report;
use system::System;

/// The names of the nodes. The first one commands the outputs of the others.
pub const NODES: [&str; 3] = ["central", "left", "right"];
/// Those with an output.
const DRIVES: [&str; 2] = [NODES[1], NODES[2]];
/// Time that the contracts allow for late threads: a test machine has many processes and few processors.
pub const SLACK: Duration = Duration::from_millis(30);
/// The time of the contracts.
pub const WITHIN: Duration = WATCHDOG.saturating_add(SLACK);
/// How long a press waits for confirmations.
const PRESS_WITHIN: Duration = Duration::from_millis(500);

/// The parameters of a run.
#[derive(Clone, Copy, Debug)]
pub struct Plan {
    /// Number of injected conditions.
    pub rounds: u32,
}

/// A condition, and how it is injected.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Injection {
    /// The process of the sender is killed.
    Kill,
    /// The process of the sender is paused.
    Pause,
    /// The echoes to the sender are held back, so that its commands are late.
    Delay,
    /// The node of the sender stops in order.
    Leave,
    /// The stop of the whole system is pressed.
    Press,
}

impl Injection {
    const ALL: [Self; 5] = [Self::Kill, Self::Pause, Self::Delay, Self::Leave, Self::Press];

    const fn of_round(round: u32) -> Self {
        Self::ALL[round as usize % Self::ALL.len()]
    }

    /// Returns how long before its injection the condition may have begun.
    const fn began_before(self) -> Duration {
        match self {
            // With the last command.
            Self::Kill | Self::Pause => PERIOD,
            // Good commands are sent later, too: until the order is executed, or the newest echo is too old.
            Self::Delay | Self::Leave | Self::Press => Duration::ZERO,
        }
    }
}

/// Runs the scenario.
///
/// # Panics
/// A node does not start, or something does not come true in time.
#[must_use]
pub fn run(plan: Plan) -> Report {
    let mut system = System::start();
    let mut report = Report::default();
    system.wait_until_outputs_are_live();
    report.dry_run = Some(system.wait_until_contracts_close());
    for round in 0..plan.rounds {
        play(&mut system, Injection::of_round(round), &mut report);
    }
    report
}

/// Waits until all outputs are live, injects a condition, and ends it.
fn play(system: &mut System, injection: Injection, report: &mut Report) {
    system.wait_until_outputs_are_live();
    let began = Time::now();
    match injection {
        Injection::Kill => system.kill_central(),
        Injection::Pause => system.pause_central(),
        Injection::Delay => system.delay_central(),
        Injection::Leave => system.order_central_to_leave(),
        Injection::Press => system.press(PRESS_WITHIN),
    }
    report.rounds += 1;
    for (drive, node) in DRIVES.into_iter().enumerate() {
        let safe_ns = system.wait_until_safe(node);
        // An output that a late command had made safe before has no such time.
        if let Some(took) = safe_ns.checked_sub(began.as_nanos()) {
            let took = Duration::from_nanos(took) + injection.began_before();
            report.claim(took <= WITHIN, || {
                format!("{node} was safe {took:?} after {injection:?}, not within {WITHIN:?}")
            });
            report.times[injection as usize][drive].note(took);
        }
    }
    match injection {
        Injection::Kill | Injection::Leave => system.start_central(),
        Injection::Pause => system.resume_central(),
        Injection::Delay => system.end_delay(),
        Injection::Press => system.release(),
    }
}
