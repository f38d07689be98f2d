//! What of a member does not get on, though the member lives.

use sinew_runtime::tid::{NodeAddress, Tid};

use super::Core;
use crate::ndl::{NodeEvent, Part, Progress, datagram::Announcement};

/// The event that a part of this node does not get on.
pub(super) fn stalled(of: &Announcement, part: &Part) -> NodeEvent {
    NodeEvent::AppStalled {
        node: of.node,
        name: of.name.clone(),
        app: Tid::new(of.node, part.app),
        app_name: part.name.clone(),
        trouble: part.trouble.0,
        since_us: u64::from(part.since_ms) * 1_000,
    }
}

impl Core {
    /// A member said how it gets on: what has changed is told, once. // spec: NDL-9
    pub(super) fn note_progress(&mut self, node: NodeAddress, progress: Progress) {
        let Some(member) = self.members.get_mut(&node) else { return };
        let announcement = &member.announcement;
        let is_same = |part: &Part, known: &Progress| {
            known.part(part.app).is_some_and(|other| other.trouble == part.trouble)
        };
        let mut events = Vec::new();
        // Who is not named any more where not all are may have made room for others only.
        if progress.is_whole() {
            let over = member.progress.parts.iter().filter(|part| progress.part(part.app).is_none());
            events.extend(over.map(|part| NodeEvent::AppResumed {
                node,
                name: announcement.name.clone(),
                app: Tid::new(node, part.app),
                app_name: part.name.clone(),
            }));
        }
        let new = progress.parts.iter().filter(|part| !is_same(part, &member.progress));
        events.extend(new.map(|part| stalled(announcement, part)));
        member.progress = progress;
        for event in events {
            self.publish(event);
        }
    }
}
