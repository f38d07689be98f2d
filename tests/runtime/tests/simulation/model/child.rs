//! A child of the model: its states, as in OTP and Sinew.

use std::time::Duration;

use sinew_runtime::{
    supervision::core::{ChildId, Generation, Policy, Restart},
    time::Time,
};

/// OTP's `pid()`, `undefined` and `restarting`, with the additional states of Sinew.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Pid {
    /// Terminated, or ended by itself.
    Undefined,
    /// To be started in its turn.
    Due,
    /// Failed; not to be started before this time.
    Restarting(Time),
    /// Started: its incarnation, and its deadline to become ready.
    Starting(Generation, Time),
    Up(Generation),
    /// Ordered to stop; its incarnation, and its deadline.
    Stopping(Generation, Time),
}

#[derive(Clone, Debug)]
pub(super) struct Child {
    pub(super) id: ChildId,
    pub(super) policy: Policy,
    pub(super) pid: Pid,
    pub(super) generation: Generation,
    pub(super) released: bool,
    /// The next state once its current incarnation has ended. `None`: as its restart type requires.
    pub(super) fate: Option<Fate>,
    pub(super) asked: usize,
    pub(super) in_a_row: u32,
    pub(super) up_since: Option<Time>,
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Fate {
    /// Its group is restarted.
    StartAgain,
    /// By a command, or by the end of all.
    StayDown,
}

impl Child {
    pub(super) fn alive(&self) -> Option<Generation> {
        match self.pid {
            Pid::Starting(generation, _) | Pid::Up(generation) | Pid::Stopping(generation, _) => {
                Some(generation)
            }
            Pid::Undefined | Pid::Due | Pid::Restarting(_) => None,
        }
    }

    /// Sinew: a held child waits for its release, and in ordered groups the later children wait with it.
    pub(super) fn held_back(&self) -> bool {
        self.pid == Pid::Due && self.policy.held && !self.released
    }

    /// Whether its end counts as the end of work: it runs on its own account, or will.
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

    /// Sinew: doubled by each consecutive failure, reset after an incarnation of more than a window.
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
