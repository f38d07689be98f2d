//! The list of this node, and the times at which it is sent to each peer.

use std::{collections::BTreeMap, time::Duration};

use bytes::Bytes;
use sinew_runtime::{
    tid::{AppAddress, Incarnation, NodeAddress},
    time::Time,
};

use super::{Output, apps::Apps, outputs::Outputs, peers::Peers, retry::RETRY};
use crate::list::{ENTRIES_MAX, List, Omitted, Published};

/// Time between two lists to a peer when nothing changed. The repetition replaces a lost list.
pub const REPEAT: Duration = Duration::from_secs(2);
/// Minimum time after a long list to a peer. A burst of changes costs 200 lists a second, not one for each
/// change.
const SPACING_LONG: Duration = Duration::from_millis(5);
/// Minimum time after a short list. An application that waits for the change must not wait longer for the
/// list than for the network and its processors.
pub(super) const SPACING: Duration = Duration::from_millis(1);
/// Maximum size of a short list in bytes. Writing, sending and reading 1,000 of them a second costs no more
/// than 200 lists of 20 KiB.
const SHORT: usize = 4 * 1024;

/// Returns the minimum time from a list of `bytes` bytes to the next one. // spec: SYNC-2
const fn spacing(bytes: usize) -> Duration {
    if bytes <= SHORT { SPACING } else { SPACING_LONG }
}

/// The list that this node publishes.
#[derive(Debug)]
pub(super) struct OwnList {
    incarnation: Incarnation,
    bytes_max: usize,
    version: u64,
    groups: Vec<AppAddress>,
    /// How many of `groups`, from the first, have a member among the robot's own.
    own_groups: usize,
    /// The current encoded list, once it is needed.
    encoded: Option<Bytes>,
    /// The minimum time from the last encoded list to the next one.
    spacing: Duration,
    schedule: BTreeMap<NodeAddress, Schedule>,
}

/// When this node's list was sent to a peer, and when it is sent there next.
#[derive(Debug)]
struct Schedule {
    sent: Option<Time>,
    due: Time,
}

impl OwnList {
    /// Returns an empty list. It has at most `bytes_max` bytes.
    pub(super) const fn new(incarnation: Incarnation, bytes_max: usize) -> Self {
        Self {
            incarnation,
            bytes_max,
            version: 1,
            groups: Vec::new(),
            own_groups: 0,
            encoded: None,
            spacing: Duration::ZERO,
            schedule: BTreeMap::new(),
        }
    }

    /// Sets the groups that have members on this node. Returns whether they are others than before.
    pub(super) fn set_groups(&mut self, published: Published) -> bool {
        let Published { mut groups, own, .. } = published;
        let own = groups.iter().take(own).filter(|group| group.is_group()).count();
        groups.retain(|group| group.is_group());
        let is_changed = (self.own_groups, &self.groups) != (own, &groups);
        (self.own_groups, self.groups) = (own, groups);
        is_changed
    }

    /// Returns the groups of the list.
    pub(super) fn groups(&self) -> &[AppAddress] {
        &self.groups
    }

    /// Schedules the list to `node`, which is linked now.
    pub(super) fn link_up(&mut self, now: Time, node: NodeAddress) {
        self.schedule.entry(node).or_insert(Schedule { sent: None, due: now }).due = now;
    }

    /// Records a change of the list, and schedules it to every peer, at the earliest the minimum time after
    /// the last one. spec: SYNC-2
    pub(super) fn changed(&mut self, now: Time) {
        self.version += 1;
        self.encoded = None;
        for Schedule { sent, due } in self.schedule.values_mut() {
            let earliest = sent.map_or(now, |sent| now.max(sent + self.spacing));
            *due = earliest.min(*due);
        }
    }

    /// Schedules a rejected list to `node` again. That node sees no local application as ready before it
    /// receives the list. // spec: SYNC-2
    pub(super) fn rejected(&mut self, now: Time, node: NodeAddress) {
        if let Some(schedule) = self.schedule.get_mut(&node) {
            schedule.due = now + RETRY;
        }
    }

    /// Sends the list to each linked node for which it is due. spec: SYNC-2
    pub(super) fn publish(&mut self, now: Time, apps: &Apps, peers: &Peers, outputs: &mut Outputs) {
        self.schedule.retain(|node, _| peers.contains(*node));
        let due = |(node, schedule): (&NodeAddress, &mut Schedule)| {
            let is_due = peers.linked(*node).is_some() && schedule.due <= now;
            is_due.then(|| {
                *schedule = Schedule { sent: Some(now), due: now + REPEAT };
                *node
            })
        };
        let due: Vec<NodeAddress> = self.schedule.iter_mut().filter_map(due).collect();
        for to in due {
            let list = self.encoded(apps, outputs);
            outputs.push(Output::Publish { to, list });
        }
    }

    /// Returns the time at which the list is sent to a linked node next.
    pub(super) fn next_wake(&self, peers: &Peers) -> Option<Time> {
        let linked = self.schedule.iter().filter(|(node, _)| peers.linked(**node).is_some());
        linked.map(|(_, schedule)| schedule.due).min()
    }

    fn encoded(&mut self, apps: &Apps, outputs: &mut Outputs) -> Bytes {
        if let Some(bytes) = &self.encoded {
            return bytes.clone();
        }
        let list = List {
            incarnation: self.incarnation,
            version: self.version,
            entries: apps.entries(),
            groups: self.groups.clone(),
        };
        let (bytes, Omitted { elements: left_out, types_of }) =
            list.encode_within(self.bytes_max, self.own_groups);
        let limit = self.bytes_max;
        if types_of > 0 {
            let detail = format!(
                "the payload types of {types_of} applications are not in this node's directory, which has at most \
                 {limit} bytes: other nodes do not compare them; raise `node.payload_max` or use more nodes"
            );
            outputs.refuse("directory full", detail);
        }
        if left_out > 0 {
            let detail = format!(
                "{left_out} applications and groups are not in this node's directory, which has at most {ENTRIES_MAX} \
                 applications and {limit} bytes: other nodes cannot find them; raise `node.payload_max` or use more nodes"
            );
            outputs.refuse("directory full", detail);
        }
        (self.encoded, self.spacing) = (Some(bytes.clone()), spacing(bytes.len()));
        bytes
    }
}
