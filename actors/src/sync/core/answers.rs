//! Answers about barriers for which an application had no room: they are offered again.

use sinew_runtime::{tid::AppAddress, time::Time};

use super::{Core, Output, barrier::RETRY};
use crate::sync::words::BarrierAnswer;

/// So many are kept for one application at most: as many as barriers at which it waits at once.
const ANSWERS_PER_APP_MAX: usize = 16;

/// The answers that were not taken, with their applications and the correlations of the requests.
#[derive(Debug, Default)]
pub(super) struct Undelivered {
    answers: Vec<(AppAddress, u64, BarrierAnswer)>,
    retry: Option<Time>,
}

impl Undelivered {
    /// The life of `app` that asked is over.
    pub(super) fn forget(&mut self, app: AppAddress) {
        self.answers.retain(|(other, ..)| *other != app);
    }

    pub(super) const fn next_wake(&self) -> Option<Time> {
        self.retry
    }
}

impl Core {
    /// Keeps an answer for which its application had no room.
    pub(super) fn answer_not_taken(
        &mut self,
        now: Time,
        app: AppAddress,
        correlation: u64,
        answer: BarrierAnswer,
    ) {
        let kept = self.undelivered.answers.iter().filter(|(other, ..)| *other == app).count();
        if kept >= ANSWERS_PER_APP_MAX {
            let detail =
                format!("{app} has not taken {kept} answers about barriers; it does not get another one");
            return self.refuse("barriers", detail);
        }
        self.undelivered.answers.push((app, correlation, answer));
        self.undelivered.retry.get_or_insert(now + RETRY);
    }

    /// Offers again what was not taken. spec: SYNC-10
    pub(super) fn answer_again(&mut self, now: Time) {
        if self.undelivered.retry.is_none_or(|retry| now < retry) {
            return;
        }
        self.undelivered.retry = None;
        for (app, correlation, answer) in std::mem::take(&mut self.undelivered.answers) {
            self.outputs.push_back(Output::AnswerBarrier { app, correlation, answer });
        }
    }
}
