//! The thread `audit`, which runs as long as questions of other nodes are pending. An answer of a node with
//! 1,000 applications takes longer than the sync manager may be blocked, because the sync manager reports
//! lost requirements and open barriers.
//!
//! The thread has a lower priority than the threads that share its locks, and keeps it: raising the priority
//! again needs a privilege. So it holds each lock only for a copy of bounded length: the counters of one
//! place, or the pointers of a list. It never walks through messages under a lock, except the few events of a
//! layer in one mailbox. Its answer of at most 256 KiB is queued for the asking node and written by the
//! thread that drains that queue. So no thread that settles an outcome or sends Control on the same outlet
//! waits for a low-priority thread that writes.

use std::{collections::VecDeque, sync::Arc, thread};

use sinew_model::thread_priority::lower_priority;
use sinew_runtime::{
    lock,
    remedy::{Wanted, remedy},
    tid::NodeAddress,
    time::Time,
};

use super::questions::answer;
use crate::NodeState;

/// Maximum number of pending questions. A further question is not answered, and counted.
const WAITING_MAX: usize = 64;

/// Questions of other nodes that wait for their answers.
#[derive(Default)]
pub(super) struct PendingAnswer {
    /// The node that asks, and the number of the question.
    questions: VecDeque<(NodeAddress, u64)>,
    /// Whether a thread is running that answers them.
    is_running: bool,
}

/// Queues a question, which is answered later.
///
/// # Errors
/// Returns why the question is not answered: too many are pending, or the system grants no thread.
pub(super) fn queue_question(state: &Arc<NodeState>, to: NodeAddress, number: u64) -> Result<(), String> {
    {
        let mut waiting = lock(&state.questions.waiting);
        if waiting.questions.len() >= WAITING_MAX {
            return Err(format!("from {to}, a question for an audit behind {WAITING_MAX} that wait"));
        }
        waiting.questions.push_back((to, number));
        if std::mem::replace(&mut waiting.is_running, true) {
            return Ok(());
        }
    }
    let answerer = AnswerThread { state: state.clone(), is_active: true };
    let started = thread::Builder::new().name("audit".to_owned()).spawn(move || answerer.run());
    started.map(drop).map_err(|cause| {
        format!("from {to}, and no thread answers it: {cause}; {}", remedy(Wanted::Thread, &cause))
    })
}

/// The thread's record that it answers questions. If the thread ends for any reason, the next question starts
/// another one, which also answers the pending questions.
struct AnswerThread {
    state: Arc<NodeState>,
    is_active: bool,
}

impl AnswerThread {
    fn run(mut self) {
        lower_priority();
        while let Some((to, number)) = self.next() {
            if let Err(fault) = answer(&self.state, to, number) {
                self.state.ctx.refusals.count(Time::now(), "audit", &fault);
            }
        }
    }

    /// Returns the next question. If none is left, this thread takes no further one.
    fn next(&mut self) -> Option<(NodeAddress, u64)> {
        let mut waiting = lock(&self.state.questions.waiting);
        let next = waiting.questions.pop_front();
        self.is_active = next.is_some();
        waiting.is_running = self.is_active;
        next
    }
}

impl Drop for AnswerThread {
    fn drop(&mut self) {
        // If this thread takes no more questions, another one may.
        if self.is_active {
            lock(&self.state.questions.waiting).is_running = false;
        }
    }
}

#[cfg(test)]
mod tests {
    use std::time::{Duration, Instant};

    use sinew_model::config::NodeConfig;
    use sinew_runtime::tid::Incarnation;

    use super::*;

    const OTHER: NodeAddress = NodeAddress::new(2);

    fn state() -> Arc<NodeState> {
        NodeState::for_test(NodeConfig::new("test"), Incarnation(1))
    }

    /// Waits until the thread has ended.
    fn wait(state: &NodeState) {
        let began = Instant::now();
        while lock(&state.questions.waiting).is_running {
            assert!(began.elapsed() < Duration::from_secs(60), "the thread `audit` does not end");
            thread::yield_now();
        }
    }

    fn counted(state: &NodeState) -> u64 {
        state
            .ctx
            .refusals
            .by_cause()
            .into_iter()
            .find(|(cause, _)| *cause == "audit")
            .map_or(0, |(_, count)| count)
    }

    #[test]
    fn thread_answers_every_question_and_then_ends() {
        let state = state();
        for round in 1..=3 {
            for number in 0..10 {
                queue_question(&state, OTHER, number).expect("there is room, and a thread");
            }
            wait(&state);
            // No node is linked, so the answers go nowhere.
            assert_eq!(counted(&state), 10 * round);
        }
    }

    #[test]
    fn waiting_questions_are_bounded_and_outlive_their_thread() {
        let state = state();
        lock(&state.questions.waiting).is_running = true;
        let answerer = AnswerThread { state: state.clone(), is_active: true };
        for number in 0..WAITING_MAX as u64 {
            queue_question(&state, OTHER, number).expect("there is room");
        }
        assert!(queue_question(&state, OTHER, 99).is_err());
        // It ends before its time, as at a panic.
        drop(answerer);
        lock(&state.questions.waiting).questions.pop_back();
        queue_question(&state, OTHER, 100).expect("there is room for one, and a thread");
        wait(&state);
        assert_eq!(counted(&state), WAITING_MAX as u64);
    }
}
