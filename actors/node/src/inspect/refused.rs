//! The reports of refused inputs and messages.

use sinew_lncl::undelivered;
use sinew_runtime::{
    lock,
    outcome::{Outcome, Rejection},
    tid::Tid,
    time::Time,
};

use super::{
    answers::micros,
    reports::{LISTED_MAX, LostEchoReport, RefusalReport, UnguardedReport, UnhandledReport},
};
use crate::NodeState;

/// Returns the inputs from outside that NDL, GNCL and the other layers refused, and the number of further causes that
/// do not fit. spec: INSPECT-3
pub(super) fn refusals(state: &NodeState, now: Time) -> (Vec<RefusalReport>, u64) {
    let refusals = [
        lock(&state.ndl.core).refusals().reports(),
        state.gncl.store.refusals.reports(),
        state.ctx.refusals.reports(),
    ];
    let mut refusals: Vec<_> = refusals.into_iter().flatten().collect();
    refusals.sort_by_key(|refusal| std::cmp::Reverse(refusal.at));
    let left_out = refusals.len().saturating_sub(LISTED_MAX) as u64;
    let reports = refusals.into_iter().take(LISTED_MAX).map(|refusal| RefusalReport {
        cause: refusal.cause.to_owned(),
        count: refusal.count,
        detail: refusal.detail,
        ago_us: micros(now.since(refusal.at)),
    });
    (reports.collect(), left_out)
}

/// Returns the types that applications of this node did not handle or could not read, and types sent by this node that
/// others did not handle.
pub(super) fn unhandled(state: &NodeState, now: Time) -> Vec<UnhandledReport> {
    let here = state.lncl.undelivered.unhandled().into_iter();
    let here = here.map(|((app, kind, why), line)| {
        (Tid::new(state.ctx.node, app), line.about, kind, why, line.count, line.last)
    });
    // Refused by other nodes: the sender's node alone knows the name of the type.
    let there = state.lncl.undelivered.unhandled_elsewhere().into_iter();
    let there = there.map(|((app, to, kind, why), line)| {
        (to, Tid::new(state.ctx.node, app), kind, why, line.count, line.last)
    });
    let reports = here.chain(there).take(LISTED_MAX).map(|(receiver, sender, kind, why, count, last)| {
        let is_malformed = why == Outcome::Rejected(Rejection::Malformed).code();
        let remedy = if is_malformed {
            "use the same type at both ends; the log of the receiver names the field".to_owned()
        } else {
            undelivered::remedy(receiver.app, kind)
        };
        UnhandledReport {
            receiver,
            sender,
            kind,
            kind_name: undelivered::kind_name(&state.lncl, kind),
            is_malformed,
            count,
            ago_us: micros(now.since(last)),
            remedy,
        }
    });
    reports.collect()
}

/// Returns the protected messages that applications of this node refused because they do not guard the sender.
pub(super) fn unguarded(state: &NodeState, now: Time) -> Vec<UnguardedReport> {
    let refused = state.lncl.undelivered.unguarded().into_iter().take(LISTED_MAX);
    let reports = refused.map(|((app, sender, kind), line)| UnguardedReport {
        receiver: Tid::new(state.ctx.node, app),
        sender,
        kind,
        kind_name: undelivered::kind_name(&state.lncl, kind),
        count: line.count,
        ago_us: micros(now.since(line.last)),
    });
    reports.collect()
}

/// Returns the echoes of this node's applications that were not delivered.
pub(super) fn lost_echoes(state: &NodeState, now: Time) -> Vec<LostEchoReport> {
    let lost = state.lncl.undelivered.lost_echoes().into_iter().take(LISTED_MAX);
    let reports = lost.map(|((app, guarded), line)| LostEchoReport {
        receiver: Tid::new(state.ctx.node, app),
        guarded,
        why: format!("{:?}", line.about),
        count: line.count,
        ago_us: micros(now.since(line.last)),
    });
    reports.collect()
}
