//! What of a member does not get on, though the member lives.

use std::{collections::BTreeMap, time::Duration};

use sinew_runtime::tid::{AppAddress, NodeAddress, Tid};

use super::Core;
use crate::ndl::{NodeEvent, Part, Progress, Told, Trouble, datagram::Announcement};

/// Parts of one member that are told not to get on, at most.
const TOLD_MAX: usize = 64;

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

/// That this part of it gets on again.
fn resumed(of: &Announcement, part: &Part) -> NodeEvent {
    NodeEvent::AppResumed {
        node: of.node,
        name: of.name.clone(),
        app: Tid::new(of.node, part.app),
        app_name: part.name.clone(),
    }
}

/// What of a member was told not to get on, and was not told to get on again since.
#[derive(Debug, Default)]
pub(super) struct Troubles(BTreeMap<AppAddress, Part>);

impl Troubles {
    /// In the order of their addresses.
    pub(super) fn parts(&self) -> impl Iterator<Item = &Part> {
        self.0.values()
    }

    /// Its NDL, if that is told not to be heard.
    pub(super) fn unheard(&self) -> Option<&Part> {
        self.0.get(&AppAddress::NDL).filter(|part| part.trouble.0 == Trouble::Unheard)
    }

    /// The member has not answered for this long, and lives. What is to be told of that, once.
    pub(super) fn does_not_answer(&mut self, of: &Announcement, since: Duration) -> Option<NodeEvent> {
        if self.unheard().is_some() {
            return None;
        }
        let part = Part {
            app: AppAddress::NDL,
            name: "NDL".to_owned(),
            trouble: Told(Trouble::Unheard),
            since_ms: u32::try_from(since.as_millis()).unwrap_or(u32::MAX),
        };
        let event = stalled(of, &part);
        self.0.insert(part.app, part);
        Some(event)
    }

    /// The member answers. What is to be told of that.
    pub(super) fn answers(&mut self, of: &Announcement) -> Option<NodeEvent> {
        self.unheard()?;
        self.0.remove(&AppAddress::NDL).map(|part| resumed(of, &part))
    }

    /// What has changed with `said`, the member's last word.
    fn changes(&mut self, of: &Announcement, said: &Progress) -> Vec<NodeEvent> {
        let mut events = Vec::new();
        // Who is not named any more where not all are may have made room for others only: it is kept until all are named again.
        if said.is_whole() {
            self.0.retain(|app, part| {
                let is_named = said.part(*app).is_some();
                if !is_named {
                    events.push(resumed(of, part));
                }
                is_named
            });
        }
        for part in &said.parts {
            let known = self.0.get(&part.app);
            let is_told = known.is_some_and(|known| known.trouble == part.trouble);
            // One that finds no room is told when there is some, if it is named then.
            if !is_told && (known.is_some() || self.0.len() < TOLD_MAX) {
                events.push(stalled(of, part));
                self.0.insert(part.app, part.clone());
            }
        }
        events
    }
}

impl Core {
    /// A member said how it gets on: what has changed is told, once. // spec: NDL-9
    pub(super) fn note_progress(&mut self, node: NodeAddress, progress: Progress) {
        let Some(member) = self.members.get_mut(&node) else { return };
        let events = member.troubles.changes(&member.announcement, &progress);
        member.progress = progress;
        events.iter().for_each(|event| self.publish(event));
    }
}
