//! The messages of one source to one destination in one class.

use std::collections::BTreeMap;

use sinew::Outcome;

use super::verdict::Fault;
use crate::numbers::Numbers;

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
    /// Where the source was each time it was told that the destination's node is lost.
    pub(super) losses: Vec<u64>,
    /// How often the destination was told that the source's node is lost: it forgets then what was under way. A source that
    /// was frozen meanwhile is not told.
    pub(super) forgotten: usize,
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

    pub(super) fn got(&mut self, number: u64) -> Result<(), (Fault, u64)> {
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
