//! The watchdog's judgement of one actor, pure: what was seen at each look, to who hangs.
//!
//! Nobody is accused for time in which he was given no CPU: neither for the watchdog's own lateness (the process was
//! stopped, the host stood still) nor for what the kernel says his thread waited for its turn.

use std::time::Duration;

use super::{account::Account, processor::Sample};
use crate::{
    supervision::vitals::{Doing, Neighbours, Sight},
    time::Time,
};

/// Looks before the end of a budget at which the CPU's account is read, so that the last of them has one to compare with.
const LAST_LOOKS: u32 = 4;

/// Time for a panic at least: a hook of the program's own may look up a backtrace.
const PANIC_WITHIN: Duration = Duration::from_secs(1);

/// One look at an actor.
#[derive(Clone, Copy, Debug)]
pub(super) struct Look {
    pub(super) now: Time,
    /// How much later than intended this look is.
    pub(super) late: Duration,
    pub(super) sight: Sight,
}

/// Who does not come back.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Hang {
    pub(super) since: Time,
    pub(super) lasted: Duration,
    /// Of that, time that it was not given.
    pub(super) excused: Duration,
}

/// Watches one turn after the other.
#[derive(Debug)]
pub(super) struct TurnSuspect {
    budget: Duration,
    turn: u64,
    is_busy: bool,
    first_seen: Time,
    looks: u32,
    account: Account,
}

impl TurnSuspect {
    pub(super) fn new(budget: Duration) -> Self {
        Self {
            budget,
            turn: 0,
            is_busy: false,
            first_seen: Time::ZERO,
            looks: 0,
            account: Account::default(),
        }
    }

    /// Takes a look. `sample` reads the CPU's account; it is called only when that matters.
    pub(super) fn look(
        &mut self,
        look: Look,
        period: Duration,
        sample: impl FnOnce() -> Option<Sample>,
    ) -> Option<Hang> {
        let Look { now, late, sight } = look;
        self.is_busy = sight.is_busy();
        if sight.turn != self.turn || !sight.is_busy() {
            let (account, turn) = (Account::opened(late), sight.turn);
            *self = Self { turn, first_seen: now, looks: 0, account, ..*self };
            return None;
        }
        self.looks = self.looks.saturating_add(1);
        self.account.late += late;
        let since = sight.begun.unwrap_or(self.first_seen);
        let lasted = now.since(since);
        if self.looks > 1 && lasted + period * LAST_LOOKS < self.budget {
            return None;
        }
        let waits_for_cpu = self.account.enter(sample());
        let excused = self.account.excused();
        let hangs = lasted >= self.budget_of(sight) + excused && !waits_for_cpu;
        hangs.then_some(Hang { since, lasted, excused })
    }

    /// Whether it was in the middle of a turn at the last look.
    pub(super) const fn is_open(&self) -> bool {
        self.is_busy
    }

    /// One that panicked is on its way out, and has time for it.
    fn budget_of(&self, sight: Sight) -> Duration {
        if sight.doing == Doing::Panic { self.budget.max(PANIC_WITHIN) } else { self.budget }
    }

    /// When the turn that was seen last is too long.
    pub(super) fn deadline(&self, sight: Sight) -> Option<Time> {
        let begun = sight.begun.unwrap_or(self.first_seen);
        let is_same = sight.is_busy() && sight.turn == self.turn;
        is_same.then(|| begun + self.budget_of(sight) + self.account.excused())
    }
}

/// What the watchdog does about an actor for which messages wait.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Stall {
    /// Nothing.
    None,
    /// Wakes it, to see whether its thread comes to it.
    Probe,
    /// It had its turn and takes nothing: it waits for something else. So many messages wait since then.
    Waits(Hang),
    /// Its thread did not come to it.
    ThreadIsAway(Hang),
}

/// Watches whether an actor for which messages wait takes any.
#[derive(Debug)]
pub(super) struct StallSuspect {
    budget: Duration,
    /// `None` before the first look.
    taken: Option<u64>,
    since: Time,
    /// Messages waited at the last look, and none had been taken since the one before.
    is_open: bool,
    /// The turn that it had when it was probed, and what the others of its thread did.
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
            probed: None,
            account: Account::default(),
        }
    }

    /// Takes a look at an actor that should take messages; of its backlog so many wait, and so many were taken so far. Where it
    /// matters it asks what the `neighbours` do, the others of its thread.
    pub(super) fn look(
        &mut self,
        look: Look,
        (waiting, taken): (usize, u64),
        neighbours: impl FnOnce() -> Neighbours,
        sample: impl FnOnce() -> Option<Sample>,
    ) -> Stall {
        let Look { now, late, sight, .. } = look;
        if waiting == 0 || self.taken != Some(taken) {
            self.taken = Some(taken);
            self.calm(now);
            return Stall::None;
        }
        self.is_open = true;
        self.account.late += late;
        let lasted = now.since(self.since);
        let Some((turn, before)) = self.probed else {
            if lasted < self.budget / 2 {
                return Stall::None;
            }
            self.probed = Some((sight.turn, neighbours()));
            self.account.enter(sample());
            return Stall::Probe;
        };
        // At each look from here on: whoever gets a CPU and loses it again waits for it now, whatever he had before.
        let waits_for_cpu = self.account.enter(sample());
        if lasted < self.budget + self.account.late || sight.is_busy() {
            // A turn that does not end is judged as such.
            return Stall::None;
        }
        let hang = |excused| Hang { since: self.since, lasted, excused };
        if sight.turn >= turn + 2 {
            return Stall::Waits(hang(self.account.late));
        }
        let excused = self.account.excused();
        if waits_for_cpu || lasted < self.budget + excused {
            return Stall::None;
        }
        let after = neighbours();
        if after.are_busy || after != before {
            // One of them has the thread, or has just had it: they are judged themselves.
            self.calm(now);
            return Stall::None;
        }
        Stall::ThreadIsAway(hang(excused))
    }

    /// Begins anew: whatever there was has an excuse.
    pub(super) fn calm(&mut self, now: Time) {
        (self.since, self.is_open, self.probed, self.account) = (now, false, None, Account::default());
    }

    /// Whether it let messages wait at the last look.
    pub(super) const fn is_open(&self) -> bool {
        self.is_open
    }
}

#[cfg(test)]
mod tests;
