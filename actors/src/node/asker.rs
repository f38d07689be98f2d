//! Who waits to hear that all applications run.

use std::sync::{
    Arc, Weak,
    mpsc::{Receiver, SyncSender, sync_channel},
};

use super::StartError;

/// What the root answers.
pub(super) type Answer = Result<(), StartError>;

/// The root's end of a question.
#[derive(Debug)]
pub(crate) struct Asker {
    say: SyncSender<Answer>,
    waits: Weak<()>,
}

/// The end of the one who asks. He has stopped waiting when it is dropped.
#[derive(Debug)]
pub(super) struct Question {
    pub(super) heard: Receiver<Answer>,
    _waits: Arc<()>,
}

impl Asker {
    pub(super) fn new() -> (Self, Question) {
        let ((say, heard), waits) = (sync_channel(1), Arc::new(()));
        (Self { say, waits: Arc::downgrade(&waits) }, Question { heard, _waits: waits })
    }

    /// Nobody hears it who has stopped waiting.
    pub(super) fn answer(self, answer: Answer) {
        let _ = self.say.try_send(answer);
    }

    /// Joins those who wait. Those who have stopped waiting leave: whoever asks again and again is in there once.
    pub(super) fn join(self, others: &mut Vec<Self>) {
        others.retain(|other| other.waits.strong_count() > 0);
        others.push(self);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn who_asks_again_and_again_and_waits_for_no_answer_takes_no_memory() {
        let mut all = Vec::new();
        let (patient, question) = Asker::new();
        patient.join(&mut all);
        for _ in 0..1_000 {
            Asker::new().0.join(&mut all);
        }
        assert_eq!(all.len(), 2, "the patient one, and the last of the others");
        all.into_iter().for_each(|asker| asker.answer(Ok(())));
        assert!(matches!(question.heard.try_recv(), Ok(Ok(()))));
    }
}
