//! A child of the model: what becomes of it, as OTP and Sinew have it.

use std::time::Duration;

use super::super::{ChildId, Generation, Policy, Restart};
use crate::time::Time;

/// OTP's `pid()`, `undefined` and `restarting`, with the wishes that Sinew adds.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Pid {
    /// Terminated, or ended by itself.
    Undefined,
    /// To be started when its turn comes.
    Due,
    /// Failed; not to be started before.
    Restarting(Time),
    /// Lives: which life, until when it has to be ready.
    Starting(Generation, Time),
    Up(Generation),
    /// Was told to stop; until when.
    Stopping(Generation, Time),
}

#[derive(Clone, Debug)]
pub(super) struct Child {
    pub(super) id: ChildId,
    pub(super) policy: Policy,
    pub(super) pid: Pid,
    pub(super) lives: Generation,
    pub(super) released: bool,
    /// What is to become of it once its present life has ended. `None`: what its restart type says.
    pub(super) fate: Option<Fate>,
    pub(super) asked: usize,
    pub(super) in_a_row: u32,
    pub(super) up_since: Option<Time>,
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Fate {
    /// Its group is restarted.
    StartAgain,
    /// A command said so, or the end of all.
    StayDown,
}

impl Child {
    pub(super) fn alive(&self) -> Option<Generation> {
        match self.pid {
            Pid::Starting(life, _) | Pid::Up(life) | Pid::Stopping(life, _) => Some(life),
            Pid::Undefined | Pid::Due | Pid::Restarting(_) => None,
        }
    }

    /// Sinew: a held child waits for its release, and those after it, where they are started in order, with it.
    pub(super) fn held_back(&self) -> bool {
        self.pid == Pid::Due && self.policy.held && !self.released
    }

    /// Is one whose end counts as the end of work: lives for itself, or will.
    pub(super) fn works(&self) -> bool {
        self.pid != Pid::Undefined && self.fate != Some(Fate::StayDown)
    }

    pub(super) fn go_with_the_group(&mut self) {
        let temporary = self.policy.restart == Restart::Temporary;
        match (self.pid, temporary) {
            // "the child process can later be restarted by the supervisor"
            (Pid::Undefined, false) => self.pid = Pid::Due,
            (Pid::Undefined | Pid::Due | Pid::Restarting(_), _) => {}
            (Pid::Starting(..) | Pid::Up(_) | Pid::Stopping(..), true) => self.fate = Some(Fate::StayDown),
            (Pid::Starting(..) | Pid::Up(_) | Pid::Stopping(..), false) => self.fate = Some(Fate::StartAgain),
        }
    }

    /// Sinew: doubled by each failure in a row, forgotten after a life of more than a window.
    pub(super) fn longest_wait(&mut self, now: Time, window: Duration) -> Duration {
        if self.up_since.is_some_and(|since| now.since(since) > window) {
            self.in_a_row = 0;
        }
        let wait = (0..self.in_a_row).fold(self.policy.backoff_min, |wait, _| wait.saturating_mul(2));
        self.in_a_row += 1;
        wait.min(self.policy.backoff_max)
    }
}

pub(super) fn child_is_significant(child: &Child) -> bool {
    child.policy.significant
}
