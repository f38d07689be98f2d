//! The messages of one source to one destination in one class.

use std::collections::BTreeMap;

use sinew::Outcome;

use super::verdict::Fault;
use crate::numbers::Numbers;

/// Messages at most that a source sends to a node of whose loss it has been told, before its own node does not take them any more.
const SENT_ON: u64 = 1_000;

/// What is known of them. A fault comes with the number of its message.
#[derive(Debug, Default)]
pub(super) struct Flow {
    /// The last number that was sent.
    pub(super) sent: u64,
    /// Those whose sender waits, and what it was told.
    pub(super) asked: BTreeMap<u64, Option<Outcome>>,
    got: Numbers,
    last_got: u64,
    /// How many came, each counted once.
    pub(super) unique: u64,
    /// Which life of the destination has got something last; 0: none yet.
    life: u32,
    /// The last number that former lives of the destination had got, each time the next life got its first.
    changes: Vec<u64>,
    /// Where the source was each time it was told that the destination's node is lost.
    pub(super) losses: Vec<u64>,
    /// The last number that had come each time the destination was told that the source's node is lost: it forgets then what was under
    /// way. A source that was frozen meanwhile is not told.
    forgotten: Vec<u64>,
}

impl Flow {
    pub(super) fn sent(&mut self, first: u64, count: u64, asked: bool) -> Result<(), (Fault, u64)> {
        if first != self.sent + 1 {
            return Err((Fault::WrongNote, first));
        }
        self.sent += count;
        if asked {
            self.asked.extend((first..first + count).map(|number| (number, None)));
        }
        Ok(())
    }

    pub(super) fn ended(&mut self, number: u64, outcome: Outcome) -> Result<(), (Fault, u64)> {
        match self.asked.get_mut(&number) {
            Some(told @ None) => *told = Some(outcome),
            Some(Some(_)) => return Err((Fault::OutcomeTwice, number)),
            None => return Err((Fault::WrongNote, number)),
        }
        Ok(())
    }

    /// This life of the destination has got this number.
    pub(super) fn got(&mut self, life: u32, number: u64) -> Result<(), (Fault, u64)> {
        let before = std::mem::replace(&mut self.life, life);
        if before != life && life > 1 {
            self.changes.push(self.last_got);
        }
        if !self.got.insert(number) {
            return Err((Fault::Duplicated, number));
        }
        self.unique += 1;
        let before = self.last_got;
        self.last_got = before.max(number);
        if number < before { Err((Fault::Reordered, number)) } else { Ok(()) }
    }

    pub(super) fn peer_lost(&mut self, upto: u64) {
        self.losses.push(upto);
    }

    pub(super) fn forgotten(&mut self) {
        self.forgotten.push(self.last_got);
    }

    /// Whether nobody may be able to say what became of this message: a node was lost after it was sent.
    pub(super) fn could_be_lost(&self, number: u64) -> bool {
        !self.forgotten.is_empty() || self.losses.iter().any(|upto| number <= *upto + SENT_ON)
    }

    /// What excuses rows that are missing; of the destination, this life and all before it were killed.
    pub(super) fn excuses(&self, last_killed: u32) -> Excuses {
        let mut changes = self.changes.clone();
        // A life that had got nothing may have ended before this source began.
        let ends_told = changes.iter().filter(|last| **last > 0).count();
        if last_killed > 0 && self.life <= last_killed {
            // The life that got something last is over, and the next one has got nothing yet.
            changes.push(self.last_got);
        }
        let (mut losses, mut forgotten) = (self.losses.clone(), self.forgotten.clone());
        losses.sort_unstable();
        forgotten.sort_unstable();
        let losses_left = losses.len().saturating_sub(ends_told);
        Excuses { changes, losses, losses_left, forgotten }
    }

    /// Whether nothing came between these two.
    fn is_empty_between(&self, after: u64, before: u64) -> bool {
        (after + 1..before).all(|number| !self.got.has(number))
    }

    pub(super) const fn last_got(&self) -> u64 {
        self.last_got
    }

    pub(super) fn has_come(&self, number: u64) -> bool {
        self.got.has(number)
    }

    /// Rows of numbers up to `end` that did not come, and whose sender was not told that they would not.
    pub(super) fn holes(&self, end: u64) -> Vec<(u64, u64)> {
        let mut holes = Vec::new();
        let mut hole: Option<(u64, u64)> = None;
        for number in 1..=end {
            if self.got.has(number) {
                holes.extend(hole.take());
            } else if !self.is_told(number) {
                hole = Some(hole.map_or((number, number), |(first, _)| (first, number)));
            }
        }
        holes.extend(hole);
        holes
    }

    /// Whether its sender was told that it did not arrive.
    pub(super) fn is_told(&self, number: u64) -> bool {
        match self.asked.get(&number) {
            Some(Some(Outcome::Rejected(_) | Outcome::Expired | Outcome::PeerLost)) => true,
            Some(Some(Outcome::Delivered | Outcome::Failed | Outcome::Unknown) | None) | None => false,
        }
    }
}

/// What may have taken messages away, each of them one row.
#[derive(Debug)]
pub(super) struct Excuses {
    /// A life of the destination ended, and had got this number last.
    changes: Vec<u64>,
    /// The source was told of a loss, and had sent up to this.
    losses: Vec<u64>,
    /// So many of them are not the ends of these lives.
    losses_left: usize,
    /// The destination gave the source up, and had got this number last.
    forgotten: Vec<u64>,
}

impl Excuses {
    /// Uses what excuses that the row from `first` is missing; `false` if nothing does.
    pub(super) fn take(&mut self, flow: &Flow, first: u64) -> bool {
        let is_behind = |last: &u64| *last < first && flow.is_empty_between(*last, first);
        if let Some(at) = self.changes.iter().position(is_behind) {
            self.changes.swap_remove(at);
            return true;
        }
        let loss = self.losses.iter().position(|upto| first <= *upto).filter(|_| self.losses_left > 0);
        if let Some(at) = loss {
            self.losses_left -= 1;
            self.losses.remove(at);
            return true;
        }
        // The latest first: an earlier one excuses more.
        let forgotten = self.forgotten.iter().rposition(|last| *last < first);
        forgotten.map(|at| self.forgotten.remove(at)).is_some()
    }
}
