//! The watchdog's judgement of one actor, pure: from the observations of its checks to a hang.
//!
//! Time in which an actor got no CPU never counts. One part is the watchdog's own lateness: the process was
//! stopped, or the host was suspended. The other part is the time for which its thread waited for a CPU,
//! according to the kernel.

use std::time::Duration;

use super::{account::Account, processor::Sample};
use crate::{
    mailbox::Backlog,
    supervision::liveness::{Activity, ActivitySnapshot, Neighbours},
    time::Time,
};

/// Number of last checks of a budget that read the CPU account, so that the last one has an earlier one to
/// compare with.
const LAST_CHECKS: u32 = 4;

/// Minimum time for a panic: a custom panic hook may resolve a backtrace.
const PANIC_WITHIN: Duration = Duration::from_secs(1);

/// One check of an actor.
#[derive(Clone, Copy, Debug)]
pub(super) struct Check {
    pub(super) now: Time,
    /// How much later than scheduled this check is.
    pub(super) late: Duration,
    pub(super) snapshot: ActivitySnapshot,
}

/// A detected hang.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Hang {
    pub(super) since: Time,
    pub(super) lasted: Duration,
    /// The part of that time in which the thread got no CPU.
    pub(super) excused: Duration,
}

/// Detects turns that do not end.
#[derive(Debug)]
pub(super) struct TurnSuspect {
    budget: Duration,
    turn: u64,
    is_busy: bool,
    first_seen: Time,
    checks: u32,
    account: Account,
}

impl TurnSuspect {
    pub(super) fn new(budget: Duration) -> Self {
        Self {
            budget,
            turn: 0,
            is_busy: false,
            first_seen: Time::ZERO,
            checks: 0,
            account: Account::default(),
        }
    }

    /// Handles a check. `sample` reads the CPU account; it is called only if that matters.
    pub(super) fn check(
        &mut self,
        check: Check,
        period: Duration,
        sample: impl FnOnce() -> Option<Sample>,
    ) -> Option<Hang> {
        let Check { now, late, snapshot } = check;
        self.is_busy = snapshot.is_busy();
        if snapshot.turn != self.turn || !snapshot.is_busy() {
            let (account, turn) = (Account::opened(late), snapshot.turn);
            *self = Self { turn, first_seen: now, checks: 0, account, ..*self };
            return None;
        }
        self.checks = self.checks.saturating_add(1);
        self.account.late += late;
        let since = snapshot.begun.unwrap_or(self.first_seen);
        let lasted = now.since(since);
        if self.checks > 1 && lasted + period * LAST_CHECKS < self.budget {
            return None;
        }
        let waits_for_cpu = self.account.enter(sample());
        let excused = self.account.excused();
        let hangs = lasted >= self.budget_of(snapshot) + excused && !waits_for_cpu;
        hangs.then_some(Hang { since, lasted, excused })
    }

    /// Excuses time without a CPU between the start of a turn and the check that saw it first. `rested` is the time for
    /// which the thread had waited before the turn, in nanoseconds, `sample` is of now. The thread may have waited
    /// between `rested` and the turn, too; no more than the time since the start is excused.
    pub(super) fn excuse_start(&mut self, check: Check, rested: u64, sample: Option<Sample>) {
        let (Some(begun), Some(sample)) = (check.snapshot.begun, sample) else { return };
        if !self.is_busy || self.checks > 0 {
            return;
        }
        let waited = Duration::from_nanos(sample.waited.saturating_sub(rested));
        let late = self.account.late;
        self.account.late = (late + waited).min(check.now.since(begun)).max(late);
        self.account.enter(Some(sample));
    }

    /// Returns whether a turn was in progress at the last check.
    pub(super) const fn is_open(&self) -> bool {
        self.is_busy
    }

    /// Returns the time limit of a turn: a panicking actor is ending, and has more time.
    fn budget_of(&self, snapshot: ActivitySnapshot) -> Duration {
        if snapshot.activity == Activity::Panic { self.budget.max(PANIC_WITHIN) } else { self.budget }
    }

    /// Returns when the turn of the last check exceeds its limit.
    pub(super) fn deadline(&self, snapshot: ActivitySnapshot) -> Option<Time> {
        let begun = snapshot.begun.unwrap_or(self.first_seen);
        let is_same = snapshot.is_busy() && snapshot.turn == self.turn;
        is_same.then(|| begun + self.budget_of(snapshot) + self.account.excused())
    }
}

/// The reaction to an actor with queued messages.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Stall {
    /// No reaction.
    None,
    /// Wake the actor, to see whether its thread reaches it.
    Probe,
    /// The actor had a turn and takes no messages: it waits for something else.
    Waits(Hang),
    /// The actor's thread did not reach it.
    ThreadIsAway(Hang),
}

/// Detects an actor that does not take its queued messages.
#[derive(Debug)]
pub(super) struct StallSuspect {
    budget: Duration,
    /// `None` before the first check.
    taken: Option<u64>,
    since: Time,
    /// Whether messages were queued at the last check, and none had been taken since the one before.
    is_open: bool,
    /// Whether messages were queued at the last check that the actor should take.
    has_waiting: bool,
    /// The actor's turn number at the probe, and the activity of the other actors on its thread.
    probed: Option<(u64, Neighbours)>,
    account: Account,
}

impl StallSuspect {
    pub(super) fn new(budget: Duration) -> Self {
        Self {
            budget,
            taken: None,
            since: Time::ZERO,
            is_open: false,
            has_waiting: false,
            probed: None,
            account: Account::default(),
        }
    }

    /// Handles a check of an actor that should take messages, and has this `backlog`. If it matters, `neighbours` reads
    /// the activity of the other actors on its thread.
    pub(super) fn check(
        &mut self,
        check: Check,
        backlog: Backlog,
        neighbours: impl FnOnce() -> Neighbours,
        sample: impl FnOnce() -> Option<Sample>,
    ) -> Stall {
        let Check { now, late, snapshot, .. } = check;
        let Backlog { waiting, taken, since } = backlog;
        self.has_waiting = waiting > 0;
        if waiting == 0 || self.taken != Some(taken) {
            // At the first check a record may be of a former incarnation.
            let recorded = since.filter(|_| waiting > 0 && self.taken.is_some());
            let (since, late) = recorded.map_or((now, Duration::ZERO), |since| (since.max(self.since), late));
            self.taken = Some(taken);
            self.count_from(since, late);
            return Stall::None;
        }
        if !std::mem::replace(&mut self.is_open, true) {
            // None was taken since the last check. The messages may have begun to wait later.
            self.since = since.map_or(self.since, |since| since.max(self.since));
        }
        self.account.late += late;
        let lasted = now.since(self.since);
        let Some((turn, before)) = self.probed else {
            if lasted < self.budget / 2 {
                return Stall::None;
            }
            self.probed = Some((snapshot.turn, neighbours()));
            self.account.enter(sample());
            return Stall::Probe;
        };
        // At each check from here on: a thread that lost its CPU waits for one now, independent of earlier samples.
        let waits_for_cpu = self.account.enter(sample());
        if lasted < self.budget + self.account.late || snapshot.is_busy() {
            // A turn in progress is judged by `TurnSuspect`.
            return Stall::None;
        }
        let hang = |excused| Hang { since: self.since, lasted, excused };
        if snapshot.turn >= turn + 2 {
            return Stall::Waits(hang(self.account.late));
        }
        let excused = self.account.excused();
        if waits_for_cpu || lasted < self.budget + excused {
            return Stall::None;
        }
        let after = neighbours();
        if after.are_busy || after != before {
            // One of them has the thread, or has just had it: they are judged themselves.
            self.count_from(now, Duration::ZERO);
            return Stall::None;
        }
        Stall::ThreadIsAway(hang(excused))
    }

    /// Handles a check of an actor that takes no messages yet, or no more: the time so far is excused.
    pub(super) fn reset(&mut self, now: Time) {
        self.has_waiting = false;
        self.count_from(now, Duration::ZERO);
    }

    /// Counts the time from `since`. For `late` of it the watchdog was late.
    fn count_from(&mut self, since: Time, late: Duration) {
        (self.since, self.is_open, self.probed, self.account) = (since, false, None, Account::opened(late));
    }

    /// Returns whether messages were left queued at the last check.
    pub(super) const fn is_open(&self) -> bool {
        self.is_open
    }

    /// Returns whether messages were queued at the last check that the actor should take.
    pub(super) const fn has_waiting(&self) -> bool {
        self.has_waiting
    }
}

#[cfg(test)]
mod tests;
