//! Answers about barriers that a full mailbox rejected: they are sent again.

use sinew_model::barrier::BarrierAnswer;
use sinew_runtime::{tid::AppAddress, time::Time};

use crate::core::{Output, outputs::Outputs, retry::RetryTimer};

/// Maximum number of stored answers for one application: the number of barriers at which it waits at once.
const ANSWERS_PER_APP_MAX: usize = 16;

/// The answer to one request of an application, which has this correlation.
pub(in crate::core) type Answer = (AppAddress, u64, BarrierAnswer);

/// The rejected answers.
#[derive(Debug, Default)]
pub(super) struct RejectedAnswers {
    answers: Vec<Answer>,
    retry: RetryTimer,
}

impl RejectedAnswers {
    /// Removes the answers to `app`, after its life has ended.
    pub(super) fn forget(&mut self, app: AppAddress) {
        self.answers.retain(|(other, ..)| *other != app);
    }

    /// Stores an answer that the application's mailbox rejected.
    pub(super) fn add(&mut self, now: Time, answer: Answer, outputs: &mut Outputs) {
        let app = answer.0;
        let kept = self.answers.iter().filter(|(other, ..)| *other == app).count();
        if kept >= ANSWERS_PER_APP_MAX {
            let detail =
                format!("the mailbox of {app} has rejected {kept} barrier answers; a further one is dropped");
            return outputs.refuse("barriers", detail);
        }
        self.answers.push(answer);
        self.retry.start(now);
    }

    /// Sends the rejected answers again. spec: SYNC-10
    pub(super) fn offer_again(&mut self, now: Time, outputs: &mut Outputs) {
        if self.retry.take_expired(now) {
            let answers = std::mem::take(&mut self.answers).into_iter();
            outputs.extend(answers.map(|(app, correlation, answer)| Output::AnswerBarrier {
                app,
                correlation,
                answer,
            }));
        }
    }

    /// Returns the time at which the answers are sent again.
    pub(super) const fn next_wake(&self) -> Option<Time> {
        self.retry.next_wake()
    }
}
