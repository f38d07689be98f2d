//! Valid and invalid fates of all messages.

use std::{collections::BTreeMap, fmt};

use serde_json::{Value, json};
use sinew::{Class, Outcome};

use super::{Path, flow::Flow};

/// Maximum number of faults described in words; all are counted.
const FAULTS_TOLD: usize = 20;

/// The kinds of violations.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Fault {
    /// Not received, without any notification.
    Lost,
    /// Received twice.
    Duplicated,
    /// Received after a later one.
    Reordered,
    /// Received but never sent.
    Invented,
    /// Received with changed content.
    Damaged,
    /// Confirmed, without an outcome.
    OutcomeMissing,
    /// Confirmed, with two outcomes.
    OutcomeTwice,
    /// Reported as delivered, but not received.
    DeliveredAndNotGot,
    /// Reported as not delivered, but received.
    GotAndDenied,
    /// Reported as unknown, failed, or with a lost peer, although no node was lost since it was sent.
    UnknownWithoutLoss,
    /// The notes themselves are wrong: a number out of sequence, or an outcome of an unconfirmed message.
    WrongNote,
}

impl Fault {
    /// All variants.
    pub const ALL: [Self; 11] = [
        Self::Lost,
        Self::Duplicated,
        Self::Reordered,
        Self::Invented,
        Self::Damaged,
        Self::OutcomeMissing,
        Self::OutcomeTwice,
        Self::DeliveredAndNotGot,
        Self::GotAndDenied,
        Self::UnknownWithoutLoss,
        Self::WrongNote,
    ];
}

/// The fates of all messages.
#[derive(Clone, Debug, Default)]
pub struct Verdict {
    /// Messages that were sent.
    pub sent: u64,
    /// The number of distinct messages received.
    pub got: u64,
    /// Stream messages that were not received, but replaced by a newer one.
    pub superseded: u64,
    /// Messages not received, with a notification of their senders.
    pub told: u64,
    /// Messages not received because their node or their source was lost, which their senders know.
    pub lost_with_node: u64,
    /// Outcomes by name.
    pub outcomes: BTreeMap<&'static str, u64>,
    /// Confirmed messages.
    pub asked: u64,
    /// Confirmed messages with a sender that was killed before it received the outcome.
    pub ended_with_source: u64,
    /// Number of faults of each kind.
    pub faults: BTreeMap<Fault, u64>,
    /// The first of them in words.
    pub words: Vec<String>,
}

impl Verdict {
    /// Number of faults of this kind.
    #[must_use]
    pub fn count(&self, fault: Fault) -> u64 {
        self.faults.get(&fault).copied().unwrap_or(0)
    }

    /// Returns whether there was no fault: every message that did not arrive was reported.
    #[must_use]
    pub fn holds(&self) -> bool {
        self.faults.is_empty()
            && self.sent == self.got + self.superseded + self.told + self.lost_with_node
            && self.asked == self.outcomes.values().sum::<u64>() + self.ended_with_source
    }

    /// Returns whether there was no fault, every message arrived, and every confirmed one was reported as
    /// delivered.
    #[must_use]
    pub fn is_perfect(&self) -> bool {
        self.holds()
            && self.sent == self.got + self.superseded
            && self.asked == self.outcomes.get("delivered").copied().unwrap_or(0)
    }

    /// Machine-readable output.
    #[must_use]
    pub fn json(&self) -> Value {
        let faults: BTreeMap<String, u64> =
            Fault::ALL.into_iter().map(|fault| (format!("{fault:?}"), self.count(fault))).collect();
        json!({
            "sent": self.sent, "got": self.got, "superseded": self.superseded, "told": self.told,
            "lost_with_node": self.lost_with_node, "asked": self.asked, "outcomes": self.outcomes,
            "ended_with_source": self.ended_with_source, "faults": faults,
        })
    }
}

impl fmt::Display for Verdict {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { sent, got, superseded, told, lost_with_node, asked, outcomes, ended_with_source, .. } =
            self;
        writeln!(
            f,
            "sent {sent} = got {got} + superseded {superseded} + told {told} + lost with a node {lost_with_node}; lost {}, twice {}, \
             out of order {}",
            self.count(Fault::Lost),
            self.count(Fault::Duplicated),
            self.count(Fault::Reordered)
        )?;
        write!(f, "confirmed {asked}: {outcomes:?}, ended with their source {ended_with_source}")?;
        let others = self.faults.iter().filter(|(_, count)| **count > 0);
        for (fault, count) in others {
            write!(f, "\nFAULT {fault:?}: {count}")?;
        }
        self.words.iter().try_for_each(|words| write!(f, "\n  {words}"))
    }
}

/// Computes a verdict.
#[derive(Clone, Debug, Default)]
pub(super) struct Judge(Verdict);

impl Judge {
    pub(super) fn add(&mut self, path: Path, noted: Result<(), (Fault, u64)>) {
        if let Err((fault, number)) = noted {
            self.fault(path, fault, number, String::new());
        }
    }

    fn fault(&mut self, path: Path, fault: Fault, number: u64, more: String) {
        *self.0.faults.entry(fault).or_default() += 1;
        if self.0.words.len() < FAULTS_TOLD {
            let Path { from, to, class } = path;
            let from = format!("{} in incarnation {}", from.station, from.incarnation);
            self.0.words.push(format!("{fault:?}: {class:?} {number} from {from} to {to} {more}"));
        }
    }

    /// Evaluates a flow. The source was killed or not, and the destination was killed up to incarnation
    /// `last_killed`.
    pub(super) fn judge(&mut self, path: Path, flow: &Flow, source_was_killed: bool, last_killed: u32) {
        let end = if source_was_killed { flow.sent.max(flow.last_got()) } else { flow.sent };
        for number in end + 1..=flow.last_got() {
            if flow.has_come(number) {
                self.fault(path, Fault::Invented, number, String::new());
            }
        }
        self.0.sent += end;
        self.0.got += (1..=end).filter(|number| flow.has_come(*number)).count() as u64;
        self.0.told += flow.asked.keys().filter(|n| flow.is_told(**n) && !flow.has_come(**n)).count() as u64;
        self.judge_holes((path, flow), end, source_was_killed, last_killed);
        for (number, outcome) in &flow.asked {
            self.0.asked += 1;
            match outcome {
                Some(outcome) => {
                    // A killed source may have received a loss notification without noting it.
                    let could_be_lost = flow.could_be_lost(*number) || source_was_killed && last_killed > 0;
                    self.judge_outcome(path, (*number, *outcome), flow.has_come(*number), could_be_lost);
                }
                None if source_was_killed => self.0.ended_with_source += 1,
                None => self.fault(path, Fault::OutcomeMissing, *number, String::new()),
            }
        }
    }

    /// Evaluates the messages that were not received. The excuses are:
    ///
    /// - The end of each incarnation of the destination excuses one range, between the last message of that
    ///   incarnation and the first of the next one.
    /// - Every other loss of the destination's node that the source was notified of excuses one range that
    ///   starts before it.
    /// - Each loss of the source's node that the destination was notified of excuses one range after the last
    ///   message received by then.
    /// - The end of the source excuses the last range.
    fn judge_holes(
        &mut self,
        (path, flow): (Path, &Flow),
        end: u64,
        source_was_killed: bool,
        last_killed: u32,
    ) {
        let (mut excuses, holes) = (flow.excuses(last_killed), flow.holes(end));
        let had = format!("{excuses:?}");
        for &(first, last) in &holes {
            let count = (first..=last).filter(|n| !flow.has_come(*n) && !flow.is_told(*n)).count() as u64;
            if path.class == Class::Stream && flow.last_got() > last {
                self.0.superseded += count;
            } else if source_was_killed && last == end || excuses.take(flow, first) {
                self.0.lost_with_node += count;
            } else {
                let more = format!(
                    "to {last}; {count} in a row of {end}; {excuses:?} left of {had} for the rows {holes:?}"
                );
                self.fault(path, Fault::Lost, first, more);
                *self.0.faults.entry(Fault::Lost).or_default() += count - 1;
            }
        }
    }

    fn judge_outcome(
        &mut self,
        path: Path,
        (number, outcome): (u64, Outcome),
        has_come: bool,
        could_be_lost: bool,
    ) {
        let name = match outcome {
            Outcome::Delivered => "delivered",
            Outcome::Rejected(_) => "rejected",
            Outcome::Expired => "expired",
            Outcome::Failed => "failed",
            Outcome::PeerLost => "peer lost",
            Outcome::Unknown => "unknown",
        };
        *self.0.outcomes.entry(name).or_default() += 1;
        let fault = match outcome {
            Outcome::Delivered if !has_come => Fault::DeliveredAndNotGot,
            Outcome::Rejected(_) | Outcome::Expired | Outcome::PeerLost if has_come => Fault::GotAndDenied,
            Outcome::Unknown | Outcome::Failed | Outcome::PeerLost if !could_be_lost => {
                Fault::UnknownWithoutLoss
            }
            Outcome::Delivered
            | Outcome::Rejected(_)
            | Outcome::Expired
            | Outcome::PeerLost
            | Outcome::Unknown
            | Outcome::Failed => return,
        };
        self.fault(path, fault, number, format!("said to be {outcome:?}"));
    }

    pub(super) fn into_verdict(self) -> Verdict {
        self.0
    }
}
