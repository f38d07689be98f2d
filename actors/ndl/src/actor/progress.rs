//! Asks this node's root for the stalled parts of the node, mostly with a wake that the core's timer needs anyway.

use std::{cell::Cell, rc::Rc, time::Duration};

use sinew_model::{events::LayerReport, progress::Progress};
use sinew_runtime::time::Time;
use tokio::sync::{Notify, oneshot};

use super::Shell;
use crate::{
    State, check_period,
    core::Input,
    progress::{CHECK_MIN, RootWatch},
};

/// Fraction of a period by which a request may be early, to share a wake. It is never late.
const EARLY_DIVISOR: u32 = 8;

/// The time of the next request, which [`keep_time`](super::keep_time) watches. The reactor's own sleeps would wake the
/// thread up to three times for one of half a second.
#[derive(Debug)]
pub(super) struct NextRequest {
    due: Cell<Option<Time>>,
    /// How much earlier a request is made if the thread is awake for the core.
    early: Duration,
    reached: Notify,
}

impl NextRequest {
    pub(super) fn new(period: Duration) -> Self {
        Self {
            due: Cell::new(None),
            early: (period / EARLY_DIVISOR).min(period.saturating_sub(CHECK_MIN)),
            reached: Notify::new(),
        }
    }

    /// Returns when the timer must fire for the request.
    pub(super) fn due(&self) -> Option<Time> {
        self.due.get()
    }

    /// Notifies the waiter if its request is due at `now`, or nearly.
    pub(super) fn time_passed(&self, now: Time) {
        if self.due.get().is_some_and(|due| due <= now + self.early) {
            self.due.set(None);
            self.reached.notify_one();
        }
    }

    /// Waits until `due`, or until the timer fires for the core shortly before.
    async fn wait_until(&self, due: Time, rewind: &Notify) {
        self.due.set(Some(due));
        rewind.notify_one();
        self.reached.notified().await;
    }
}

/// Requests this node's stalled parts from the root every period. Neither waits for the other. A missing
/// answer is reported, and no further request is sent before the answer.
pub(super) async fn watch(shell: Rc<Shell>) {
    let period = check_period(&shell.state.ctx.config.ndl);
    let (mut root, mut question) = (RootWatch::new(Time::now()), None);
    loop {
        // A pending request is checked each period.
        if question.is_none() {
            shell.next_request.wait_until(Time::now() + period, &shell.rewind).await;
        }
        // A layer that reads its event queue gets these events by itself. No event may follow if a replaced
        // instance of LNCL left some.
        shell.state.ctx.app_backlogs.offer_to_sync(&shell.state.ctx.event_queues);
        shell.state.ctx.app_backlogs.offer_to_ndl(&shell.state.ctx.event_queues);
        let report = request_progress(&shell.state, &mut root, &mut question, period).await;
        let is_current = shell.feed(|core, now| {
            if let Some(report) = report {
                core.handle(now, Input::ProgressSeen(report));
            }
        });
        if !is_current {
            return;
        }
    }
}

/// Returns the new report of this node, or `None` if the last one still applies. An unanswered request is kept.
async fn request_progress(
    state: &State,
    root: &mut RootWatch,
    question: &mut Option<oneshot::Receiver<Progress>>,
    period: Duration,
) -> Option<Progress> {
    if state.ctx.root.has_ended() {
        // The node is shutting down. Without a pending request the caller waits for a period.
        *question = None;
        return None;
    }
    root.requested(Time::now());
    if question.is_none() {
        let (answer, answered) = oneshot::channel();
        // If the root's event queue is full, the request is sent later.
        *question = state.ctx.root.report(LayerReport::RequestProgress(answer)).ok().map(|()| answered);
    }
    let answer = async {
        match question {
            Some(answered) => answered.await,
            None => std::future::pending().await,
        }
    };
    let Ok(answer) = tokio::time::timeout(period, answer).await else {
        return root.not_answered(Time::now());
    };
    *question = None;
    let report = answer.ok()?;
    root.answered(Time::now(), report.clone());
    Some(report)
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use futures_util::FutureExt;
    use sinew_model::{config::NodeConfig, context::NodeContext, notifications::testing::waits};
    use sinew_runtime::tid::Incarnation;

    use super::*;

    const PERIOD: Duration = Duration::from_millis(500);

    const fn at(ms: u64) -> Time {
        Time::from_nanos(1_000_000_000 + ms * 1_000_000)
    }

    #[test]
    fn request_shares_a_wake_shortly_before_it_is_due() {
        for (woken_at, is_made) in [(0, false), (437, false), (438, true), (500, true), (900, true)] {
            let (request, rewind) = (NextRequest::new(PERIOD), Notify::new());
            let mut waiting = std::pin::pin!(request.wait_until(at(500), &rewind));
            let woken = waits(waiting.as_mut());
            assert_eq!(request.due(), Some(at(500)), "the timer fires then at the latest");
            request.time_passed(at(woken_at));
            assert_eq!((woken.is(), request.due().is_none()), (is_made, is_made), "at {woken_at} ms");
        }
    }

    // spec: NDL-9.2
    #[test]
    fn requests_are_no_more_frequent_than_the_minimum() {
        for (period_ms, earliest) in [(100, 100), (110, 100), (112, 100), (200, 175)] {
            let (request, rewind) = (NextRequest::new(Duration::from_millis(period_ms)), Notify::new());
            let mut waiting = std::pin::pin!(request.wait_until(at(period_ms), &rewind));
            let woken = waits(waiting.as_mut());
            let reached = (0..=period_ms).find(|ms| {
                request.time_passed(at(*ms));
                woken.is()
            });
            assert_eq!(reached, Some(earliest), "of a period of {period_ms} ms");
        }
    }

    #[test]
    fn request_to_a_root_that_ends_is_not_kept() {
        let (ctx, root) = NodeContext::for_test(NodeConfig::new("test"), Incarnation(1));
        let state = State::new(ctx, Arc::default());
        let (_answer, answered) = oneshot::channel();
        let (mut watch, mut question) = (RootWatch::new(at(0)), Some(answered));
        assert!(root.close().is_empty());
        let report = request_progress(&state, &mut watch, &mut question, PERIOD).now_or_never();
        assert_eq!(report, Some(None));
        assert!(question.is_none(), "the next request waits for its time");
    }

    #[test]
    fn timer_is_set_anew_for_each_request() {
        let (request, rewind) = (NextRequest::new(PERIOD), Notify::new());
        let mut rewound = std::pin::pin!(rewind.notified());
        let woken = waits(rewound.as_mut());
        let mut waiting = std::pin::pin!(request.wait_until(at(500), &rewind));
        waits(waiting.as_mut());
        assert!(woken.is());
    }
}
