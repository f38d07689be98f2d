//! The stalled parts of a live member.

use std::{collections::BTreeMap, time::Duration};

use sinew_model::{
    facts::{NodeEvent, Trouble},
    progress::{Part, Progress, TroubleCode},
};
use sinew_runtime::tid::{AppAddress, Tid};

use super::Member;
use crate::datagram::Announcement;

/// Maximum number of parts of one member that are reported as stalled.
const REPORTED_MAX: usize = 64;

/// Returns the event that a part of this node is stalled.
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

/// Returns the event that a part of this node runs again.
fn resumed(of: &Announcement, part: &Part) -> NodeEvent {
    NodeEvent::AppResumed {
        node: of.node,
        name: of.name.clone(),
        app: Tid::new(of.node, part.app),
        app_name: part.name.clone(),
    }
}

/// The parts of a member that were reported as stalled, and not as running again since.
#[derive(Debug, Default)]
pub(super) struct Troubles(BTreeMap<AppAddress, Part>);

impl Troubles {
    /// Returns the parts in the order of their addresses.
    pub(super) fn parts(&self) -> impl Iterator<Item = &Part> {
        self.0.values()
    }

    /// Returns the member's NDL, if it was reported as unheard.
    pub(super) fn unheard(&self) -> Option<&Part> {
        self.0.get(&AppAddress::NDL).filter(|part| part.trouble.0 == Trouble::Unheard)
    }

    /// Records that the live member has not answered for this long. Returns the event for that, once.
    pub(super) fn does_not_answer(&mut self, of: &Announcement, since: Duration) -> Option<NodeEvent> {
        if self.unheard().is_some() {
            return None;
        }
        let part = Part {
            app: AppAddress::NDL,
            name: "NDL".to_owned(),
            trouble: TroubleCode(Trouble::Unheard),
            since_ms: u32::try_from(since.as_millis()).unwrap_or(u32::MAX),
        };
        let event = stalled(of, &part);
        self.0.insert(part.app, part);
        Some(event)
    }

    /// Records that the member answers. Returns the event for that, if one is due.
    pub(super) fn answers(&mut self, of: &Announcement) -> Option<NodeEvent> {
        self.unheard()?;
        self.0.remove(&AppAddress::NDL).map(|part| resumed(of, &part))
    }

    /// Returns the events for the changes in `report`, the member's last report.
    fn changes(&mut self, of: &Announcement, report: &Progress) -> Vec<NodeEvent> {
        let mut events = Vec::new();
        // If not all parts are named, a missing part may only have made room for others. It is kept until all
        // are named again.
        if report.is_whole() {
            self.0.retain(|app, part| {
                let is_named = report.part(*app).is_some();
                if !is_named {
                    events.push(resumed(of, part));
                }
                is_named
            });
        }
        for part in &report.parts {
            let known = self.0.get(&part.app);
            let is_reported = known.is_some_and(|known| known.trouble == part.trouble);
            // A part without room is reported later, when there is room and it is still named.
            if !is_reported && (known.is_some() || self.0.len() < REPORTED_MAX) {
                events.push(stalled(of, part));
                self.0.insert(part.app, part.clone());
            }
        }
        events
    }
}

impl Member {
    /// Handles a report of its parts, in an answer. Returns the events for the changes, each once. // spec: NDL-9
    pub(super) fn reports(&mut self, progress: Progress) -> Vec<NodeEvent> {
        let events = self.troubles.changes(&self.announcement, &progress);
        self.progress = progress;
        events
    }
}
