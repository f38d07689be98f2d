//! The log of a supervisor: one entry for each change of a child.

use super::Supervisor;
use crate::{
    incident::{self, IncidentKind},
    supervision::{
        Reason,
        core::ChildId,
        restarts::{ActorRestart, show},
        supervisor_handle::ChildRecord,
    },
    time::Time,
};

impl Supervisor {
    /// Logs one event for each change.
    pub(super) fn note(&self, id: ChildId, what: &'static str) {
        let ChildRecord { supervisor, generation, restarts } = self.own_handle.record(id);
        let (child, tid, waiting) = (self.own_handle.name(id), self.tid_of(id), self.waiting(id));
        crate::log::debug!(supervisor, child, tid, generation, restarts, waiting, "{what}");
    }

    /// Shows a restart to its observers. Another try of a start that has failed is none.
    pub(super) fn note_restart(&self, id: ChildId) {
        let last = self.own_handle.tree.borrow().child(id).and_then(|child| child.last_reason);
        let Some(why) = last.filter(|why| !matches!(why, Reason::StartFailed(_))) else { return };
        let ChildRecord { supervisor, restarts, .. } = self.own_handle.record(id);
        let (name, why) = (self.own_handle.name(id), self.own_handle.name_children(why).to_string());
        let tid = self.children.get(&id).and_then(|child| child.spec.tid);
        show(&ActorRestart { name: &name, supervisor: &supervisor, tid, restarts, why: &why });
    }

    pub(super) fn note_end(&mut self, id: ChildId, reason: &Reason) {
        if let Reason::StartFailed(why) = reason
            && let Some(child) = self.children.get_mut(&id)
            && child.cannot_start.replace(why.clone()).as_ref() == Some(why)
        {
            // The same reason was logged at an earlier failure.
            return self.note(id, "cannot start yet");
        }
        let ChildRecord { supervisor, generation, restarts } = self.own_handle.record(id);
        let (child, tid, waiting) = (self.own_handle.name(id), self.tid_of(id), self.waiting(id));
        if let Reason::StartFailed(why) = reason {
            return crate::log::warn!(
                supervisor,
                child,
                tid,
                generation,
                waiting,
                "{child} cannot start: {why}. It is tried again, and this is logged again when the reason changes"
            );
        }
        if *reason == Reason::Shutdown {
            return crate::log::debug!(supervisor, child, tid, generation, restarts, waiting, %reason, "a child ended");
        }
        if !reason.is_failure() {
            return crate::log::info!(supervisor, child, tid, generation, restarts, waiting, %reason, "a child ended");
        }
        // The panic hook has already logged the message.
        let place = if let Reason::Panic(words) = reason { words.rsplit_once(" at ") } else { None };
        let reason = place.map_or_else(|| reason.to_string(), |(_, place)| format!("a panic at {place}"));
        incident::report(Time::now(), IncidentKind::Failure, format_args!("{child} failed: {reason}"));
        crate::log::error!(supervisor, child, tid, generation, restarts, waiting, reason, "a child failed");
    }

    /// Returns the number of queued messages; `None` if it is unknown here, or the mailbox is locked.
    fn waiting(&self, id: ChildId) -> Option<usize> {
        let handle = self.children.get(&id)?.handle.as_ref()?;
        handle.liveness().backlog().map(|backlog| backlog.waiting)
    }

    pub(super) fn tid_of(&self, id: ChildId) -> Option<String> {
        self.children.get(&id).and_then(|child| child.spec.tid).map(|tid| tid.to_string())
    }
}
