//! The messages of one source to one destination in one class.

use std::collections::BTreeMap;

use sinew::Outcome;

use super::numbers::Numbers;
use super::verdict::Fault;

/// Maximum number of messages that a source sends to a lost node after the notification, before its own node
/// rejects them.
const SENT_ON: u64 = 1_000;

/// The state of a flow. A fault is reported with the number of its message.
#[derive(Debug, Default)]
pub(super) struct Flow {
    /// The last number that was sent.
    pub(super) sent: u64,
    /// Confirmed messages, and their outcomes.
    pub(super) asked: BTreeMap<u64, Option<Outcome>>,
    got: Numbers,
    last_got: u64,
    /// Number of distinct messages received.
    pub(super) unique: u64,
    /// The incarnation of the destination that received the last message; 0: none yet.
    incarnation: u32,
    /// The last number received by former incarnations of the destination, at each first message of the next
    /// incarnation.
    changes: Vec<u64>,
    /// The number last sent at each notification of the source that the destination's node is lost.
    pub(super) losses: Vec<u64>,
    /// The last number received at each notification of the destination that the source's node is lost. The
    /// destination then drops messages in flight. A source that was frozen meanwhile receives no
    /// notification.
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
            Some(reported @ None) => *reported = Some(outcome),
            Some(Some(_)) => return Err((Fault::OutcomeTwice, number)),
            None => return Err((Fault::WrongNote, number)),
        }
        Ok(())
    }

    /// Records that this incarnation of the destination has received this number.
    pub(super) fn got(&mut self, incarnation: u32, number: u64) -> Result<(), (Fault, u64)> {
        let before = std::mem::replace(&mut self.incarnation, incarnation);
        if before != incarnation && incarnation > 1 {
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

    /// Returns whether the fate of this message may be unknown: a node was lost after it was sent.
    pub(super) fn could_be_lost(&self, number: u64) -> bool {
        !self.forgotten.is_empty() || self.losses.iter().any(|upto| number <= *upto + SENT_ON)
    }

    /// The excuses for missing ranges. This incarnation of the destination and all before it were killed.
    pub(super) fn excuses(&self, last_killed: u32) -> Excuses {
        let mut changes = self.changes.clone();
        // An incarnation without any message may have ended before this source started.
        let ends_told = changes.iter().filter(|last| **last > 0).count();
        if last_killed > 0 && self.incarnation <= last_killed {
            // The incarnation with the last message is over, and the next one has not received anything yet.
            changes.push(self.last_got);
        }
        let (mut losses, mut forgotten) = (self.losses.clone(), self.forgotten.clone());
        losses.sort_unstable();
        forgotten.sort_unstable();
        let losses_left = losses.len().saturating_sub(ends_told);
        Excuses { changes, losses, losses_left, forgotten }
    }

    /// Returns whether no message between these two was received.
    fn is_empty_between(&self, after: u64, before: u64) -> bool {
        (after + 1..before).all(|number| !self.got.has(number))
    }

    pub(super) const fn last_got(&self) -> u64 {
        self.last_got
    }

    pub(super) fn has_come(&self, number: u64) -> bool {
        self.got.has(number)
    }

    /// Ranges of numbers up to `end` that were not received, and have no negative outcome.
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

    /// Returns whether the sender was notified that the message was not delivered.
    pub(super) fn is_told(&self, number: u64) -> bool {
        match self.asked.get(&number) {
            Some(Some(Outcome::Rejected(_) | Outcome::Expired | Outcome::PeerLost)) => true,
            Some(Some(Outcome::Delivered | Outcome::Failed | Outcome::Unknown) | None) | None => false,
        }
    }
}

/// Events that may have removed messages, one range each.
#[derive(Debug)]
pub(super) struct Excuses {
    /// An incarnation of the destination ended, and this was the last number that it received.
    changes: Vec<u64>,
    /// The source was notified of a loss, and this was the last number that it had sent.
    losses: Vec<u64>,
    /// The number of these losses that are not the ends of the incarnations above.
    losses_left: usize,
    /// The destination declared the source lost, and this was the last number received from it.
    forgotten: Vec<u64>,
}

impl Excuses {
    /// Consumes an excuse for the missing range that starts at `first`; `false` if there is none.
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
        // The latest first, because an earlier one excuses more.
        let forgotten = self.forgotten.iter().rposition(|last| *last < first);
        forgotten.map(|at| self.forgotten.remove(at)).is_some()
    }
}
