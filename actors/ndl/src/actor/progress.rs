//! Asks this node's root for the stalled parts of the node.

use std::{rc::Rc, time::Duration};

use sinew_model::{events::LayerReport, progress::Progress};
use sinew_runtime::time::Time;
use tokio::sync::oneshot;

use super::Shell;
use crate::{State, check_period, core::Input, progress::RootWatch};

/// Requests this node's stalled parts from the root every period. Neither waits for the other. A missing
/// answer is reported, and no further request is sent before the answer.
pub(super) async fn watch(shell: Rc<Shell>) {
    let period = check_period(&shell.state.ctx.config.ndl);
    let (mut root, mut question) = (RootWatch::new(Time::now()), None);
    loop {
        // A pending request is checked each period.
        if question.is_none() {
            tokio::time::sleep(period).await;
        }
        // A layer that reads its event queue gets these events by itself. No event may follow if a replaced
        // instance of LNCL left some.
        shell.state.ctx.app_backlogs.offer_to_sync(&shell.state.ctx.posts);
        shell.state.ctx.app_backlogs.offer_to_ndl(&shell.state.ctx.posts);
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
        // The node is shutting down.
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
