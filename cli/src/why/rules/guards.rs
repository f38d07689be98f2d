//! Checks whether an application guards the sender of the protected messages that it receives.

use sinew::{
    inspect::{LostEchoReport, UnguardedReport},
    message::Rejection,
};

use super::{super::facts::TrafficEnd, RECENT_US, Steps};
use crate::table::time;

/// Maximum number of guarded senders that are named in one step.
const GUARDED_SHOWN: usize = 4;

impl Steps {
    /// Adds the protected messages of `from` that `to` refused because it does not guard `from`.
    pub(super) fn guarded(&mut self, from: &TrafficEnd, to: &TrafficEnd) {
        let Some((sender, receiver)) = from.app_tid().zip(to.app_tid()) else { return };
        let unguarded = to.report.iter().flat_map(|report| &report.unguarded);
        for report in unguarded.filter(|report| (report.sender, report.receiver) == (sender, receiver)) {
            let what = format!("{} guards {}", to.label(), from.label());
            let guarded = guarded_by(to);
            let detail = detail(report, from.label(), to.label(), &guarded);
            let fix = fix(report, from.label(), to.label(), &guarded);
            if report.ago_us < RECENT_US {
                self.blocked(what, detail, fix)
            } else {
                self.note(what, detail, fix)
            }
        }
    }
}

/// Returns the senders that an application guards and that its echoes do not reach, as far as its node knows.
fn guarded_by(to: &TrafficEnd) -> Vec<&LostEchoReport> {
    let lost = to.report.iter().flat_map(|report| &report.lost_echoes);
    // A guard sends echoes all the time, so those of a former one are older.
    let of_it = lost.filter(|lost| to.app_tid() == Some(lost.receiver) && lost.ago_us < RECENT_US);
    of_it.take(GUARDED_SHOWN).collect()
}

/// Returns whether the list of the node of `to` refused echoes of `from` recently: then the protected messages of `to`
/// need a rule for them.
pub(super) fn are_echoes_refused(from: &TrafficEnd, to: &TrafficEnd) -> bool {
    let Some(ends) = from.app_tid().zip(to.app_tid()) else { return false };
    let by_list = format!("{:?}", Rejection::NotAllowed);
    let mut lost = from.report.iter().flat_map(|report| &report.lost_echoes);
    lost.any(|lost| (lost.receiver, lost.guarded) == ends && lost.why == by_list && lost.ago_us < RECENT_US)
}

fn detail(report: &UnguardedReport, sender: &str, receiver: &str, guarded: &[&LostEchoReport]) -> String {
    let UnguardedReport { sender: tid, kind, kind_name, count, ago_us, .. } = report;
    let kind = kind_name.clone().unwrap_or_else(|| format!("kind {kind}"));
    let ago = time(*ago_us);
    let refused = format!("{count} messages of {kind} were refused, the last one {ago} ago");
    if guarded.is_empty() {
        return format!("{receiver} guards no {kind} of {sender}, which is {tid}: {refused}");
    }
    let guarded: Vec<_> = guarded.iter().map(|lost| lost.guarded.to_string()).collect();
    format!("{receiver} guards messages of {}; {sender} is {tid}: {refused}", guarded.join(", "))
}

fn fix(report: &UnguardedReport, sender: &str, receiver: &str, guarded: &[&LostEchoReport]) -> String {
    let UnguardedReport { sender: tid, .. } = report;
    // A guard for another node's application is not mended by an address on this one.
    let meant = guarded.iter().map(|lost| lost.guarded).find(|guarded| guarded.node == tid.node);
    match meant {
        Some(meant) => format!(
            "give {sender} `.address(AppAddress::new(0x{:x}))`, or have {receiver} guard for its address",
            meant.app.bits()
        ),
        None if tid.app.is_dynamic() => format!(
            "have {receiver} guard for {sender} (`ctx.guard`); {tid} changes with each start, so give {sender} a fixed one with `.address(..)`"
        ),
        None => format!("have {receiver} guard for {tid} (`ctx.guard`)"),
    }
}
