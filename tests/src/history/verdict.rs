//! What is right and what is wrong with what became of all messages.

use std::{collections::BTreeMap, fmt};

use serde_json::{Value, json};
use sinew::{Class, Outcome};

use super::{Path, flow::Flow};

/// Faults that are told in words; the others are counted.
const FAULTS_TOLD: usize = 20;

/// What can be wrong with a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Fault {
    /// It did not come, and nobody was told.
    Lost,
    /// It came twice.
    Duplicated,
    /// It came after a later one.
    Reordered,
    /// It came and was never sent.
    Invented,
    /// It came and was not what was sent.
    Damaged,
    /// Its sender waits and was told nothing.
    OutcomeMissing,
    /// Its sender was told twice.
    OutcomeTwice,
    /// Its sender was told that it was handled, and it did not come.
    DeliveredAndNotGot,
    /// Its sender was told that it would not be handled, and it came.
    GotAndDenied,
    /// Its sender was told that nobody knows, that its destination failed or that its node is lost, and no node was lost since it was sent.
    UnknownWithoutLoss,
    /// The notes themselves are wrong: a number out of its row, an outcome of what nobody asked for.
    WrongNote,
}

impl Fault {
    /// All of them.
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

/// What became of all messages.
#[derive(Clone, Debug, Default)]
pub struct Verdict {
    /// Messages that were sent.
    pub sent: u64,
    /// Of these, how many came, each counted once.
    pub got: u64,
    /// Stream messages that did not come, and a newer one did.
    pub superseded: u64,
    /// Did not come, and their senders were told so.
    pub told: u64,
    /// Did not come: their node, or their source, was lost, which senders were told.
    pub lost_with_node: u64,
    /// Outcomes by their name.
    pub outcomes: BTreeMap<&'static str, u64>,
    /// Messages whose senders waited for an outcome.
    pub asked: u64,
    /// Of these, whose sender was killed before it was told.
    pub ended_with_source: u64,
    /// How often each thing was wrong.
    pub faults: BTreeMap<Fault, u64>,
    /// The first of them in words.
    pub words: Vec<String>,
}

impl Verdict {
    /// How often this was wrong.
    #[must_use]
    pub fn count(&self, fault: Fault) -> u64 {
        self.faults.get(&fault).copied().unwrap_or(0)
    }

    /// Nothing was wrong: whatever did not arrive, somebody was told.
    #[must_use]
    pub fn holds(&self) -> bool {
        self.faults.is_empty()
            && self.sent == self.got + self.superseded + self.told + self.lost_with_node
            && self.asked == self.outcomes.values().sum::<u64>() + self.ended_with_source
    }

    /// Nothing was wrong, everything arrived, and everybody who waited was told so.
    #[must_use]
    pub fn is_perfect(&self) -> bool {
        self.holds()
            && self.sent == self.got + self.superseded
            && self.asked == self.outcomes.get("delivered").copied().unwrap_or(0)
    }

    /// For other programs.
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

/// Comes to a verdict.
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
            let from = format!("{} in life {}", from.station, from.life);
            self.0.words.push(format!("{fault:?}: {class:?} {number} from {from} to {to} {more}"));
        }
    }

    /// Looks at a flow whose source was killed or not, and whose destination was killed up to this life.
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
                    // A source that was killed may have been told of a loss, and not have written that down.
                    let could_be_lost = flow.could_be_lost(*number) || source_was_killed && last_killed > 0;
                    self.judge_outcome(path, (*number, *outcome), flow.has_come(*number), could_be_lost);
                }
                None if source_was_killed => self.0.ended_with_source += 1,
                None => self.fault(path, Fault::OutcomeMissing, *number, String::new()),
            }
        }
    }

    /// What did not come. The end of each life of the destination excuses one row, between what that life and the next one have got;
    /// every other loss of its node that the source was told of, one row that begins before that; each loss of the source's node that
    /// the destination was told of, one row behind what had come by then; and the source's own end excuses the last one.
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
