//! The latest value of each group, sender and type with [`Payload::RETAINED`](crate::wire::Payload::RETAINED), which
//! a member gets that joins later.
//!
//! The lock of the retained values is held while such a value is stored and submitted to its members, and while a
//! member joins and gets the stored ones. So a member gets each value once, and no older one after a newer one. The
//! writers' lock is taken inside of it, never the other way round. Messages of other types take no lock.
//!
//! | rule | |
//! | --- | --- |
//! | FRAME-8 | The sender's node retains a value with KEEP, and hands it over to a node with a first member. |
//! | FRAME-8.1 | A node with members retains the values with KEEP that arrive, and hands them over to later members. |
//! | FRAME-8.2 | A value with RETAINED that the node has retained already reaches no member. |
//! | FRAME-8.3 | An empty payload with KEEP removes the value and reaches no member. |

mod store;
#[cfg(test)]
mod tests;

use std::collections::{BTreeMap, BTreeSet};

use bytes::Bytes;

use self::store::{Key, Store};
use super::{Copies, Judge, MessageSink, Router, Snapshot, SubmitError};
use crate::{
    lock,
    outcome::{Outcome, Rejection},
    tid::{AppAddress, NodeAddress, Tid},
    time::Time,
    wire::{Class, Flags, Header, Message},
};

/// Maximum number of values and removals that wait for room at other nodes. Further ones are not sent.
const UNSENT_MAX: usize = 4_096;

/// The retained values of a node, and the nodes that have not got all of them.
#[derive(Debug, Default)]
pub(super) struct Retained {
    store: Store,
    /// The values, or their removals, that the queue to a node had no room for, with their classes.
    unsent: BTreeMap<(NodeAddress, Key), Class>,
    /// The memberships of incarnations that have ended: application and group. The next incarnation gets the values
    /// when it joins again. At most as many as there are memberships.
    rejoining: BTreeSet<(AppAddress, AppAddress)>,
    not_kept: u64,
    not_handed_over: u64,
}

/// The number of retained values of a node, and of those that did not fit.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct RetainedCounts {
    /// Number of values that are retained, at most 256 of each node, and 2,048 of all other nodes.
    pub values: usize,
    /// Bytes of these values, at most 1 MiB of each node, and 8 MiB of all other nodes.
    pub bytes: usize,
    /// Number of sent or received values that were beyond a bound.
    pub not_kept: u64,
    /// Number of values that a member or node had no room for when they were handed over.
    pub not_handed_over: u64,
}

impl Retained {
    /// Retains the value, or removes the former one. Returns whether it is retained.
    fn keep(&mut self, own: NodeAddress, now: Time, message: &Message) -> bool {
        let Err(error) = self.store.keep(own, now, message) else { return true };
        self.not_kept += 1;
        if self.not_kept == 1 {
            let Header { kind, source, .. } = message.header;
            crate::log::warn!(
                "a value of type {kind} from {source} is not retained for later members of its group: {error}; \
                 further values that are not retained are counted only"
            );
        }
        false
    }

    /// Records that a node had no room for the present state of this key.
    fn is_behind(&mut self, node: NodeAddress, header: &Header) {
        if self.unsent.len() < UNSENT_MAX {
            self.unsent.insert((node, Key::of(header)), header.class);
        } else {
            self.missed();
        }
    }

    fn missed(&mut self) {
        self.not_handed_over += 1;
        if self.not_handed_over == 1 {
            crate::log::warn!(
                "a retained value was not handed over to a member that joined its group: the member's queue has no room, \
                 or the value is longer than `payload_max` of its node; raise one of them; further ones are counted only"
            );
        }
    }
}

impl Router {
    /// Returns the number of retained values of this node.
    #[must_use]
    pub fn retained(&self) -> RetainedCounts {
        let Retained { store, not_kept, not_handed_over, .. } = &*lock(&self.retained);
        RetainedCounts {
            values: store.len(),
            bytes: store.bytes(),
            not_kept: *not_kept,
            not_handed_over: *not_handed_over,
        }
    }

    /// Sends a message to many that has KEEP, or ASK, which is rejected. spec: FRAME-8
    pub(super) fn send_flagged(&self, mut message: Message) -> Result<(), SubmitError> {
        if message.header.flags.has(Flags::ASK) {
            return Err(SubmitError::new(message, Rejection::Unsupported));
        }
        let retained = &mut *lock(&self.retained);
        // Read again under the lock: a member may have joined since.
        let snapshot = &*self.snapshot.load();
        // Only this node marks a value as handed over.
        message.header.flags = message.header.flags.without(Flags::RETAINED);
        let header = message.header;
        if is_clear(&message) {
            retained.store.remove(Key::of(&header));
            self.clear_elsewhere(retained, snapshot, &header);
            message.settle(Outcome::Delivered);
            return Ok(());
        }
        // The value of an application that has ended meanwhile would stay.
        let is_present = snapshot.table.local.contains_key(&header.source.app);
        let is_kept =
            is_present && is_retainable(&header) && retained.keep(self.node, self.clock.now(), &message);
        if !is_kept {
            message.header.flags = header.flags.without(Flags::KEEP);
            if retained.store.remove(Key::of(&header)).is_some() {
                self.clear_elsewhere(retained, snapshot, &header);
            }
        }
        let mut behind = Vec::new();
        let result = self.send_to_many(snapshot, message, &mut behind);
        // Otherwise the former value there would be the latest one for later members.
        behind.into_iter().for_each(|node| retained.is_behind(node, &header));
        result
    }

    /// Delivers a message with KEEP from another node to the members here. spec: FRAME-8.1
    pub(super) fn deliver_kept(&self, judge: Judge<'_>, mut message: Message) -> Result<(), SubmitError> {
        let retained = &mut *lock(&self.retained);
        let snapshot = &*self.snapshot.load();
        let key = Key::of(&message.header);
        if is_clear(&message) {
            // spec: FRAME-8.3
            retained.store.remove(key);
            message.settle(Outcome::Delivered);
            return Ok(());
        }
        if message.header.flags.has(Flags::RETAINED) && retained.store.is_known(&message) {
            // spec: FRAME-8.2
            message.settle(Outcome::Delivered);
            return Ok(());
        }
        let has_members = !snapshot.members.here.members(key.group).is_empty();
        let is_wanted = has_members || retained.store.contains(key);
        // The value of a node that was lost meanwhile would stay.
        let is_linked = snapshot.table.peers.contains_key(&key.source.node);
        let is_retainable = is_linked && is_retainable(&message.header);
        if is_wanted && !(is_retainable && retained.keep(self.node, self.clock.now(), &message)) {
            retained.store.remove(key);
        }
        self.deliver_to_many(snapshot, judge, message)
    }

    /// Adds `app` to `group`, or removes it, and hands the retained values of the group over to a new member.
    pub(super) fn set_member_here(&self, group: AppAddress, app: AppAddress, member: bool) -> bool {
        let retained = &mut *lock(&self.retained);
        let is_changed = self.regroup(&mut lock(&self.writing), |writing, members| {
            if member {
                writing.here.join(group, app, &mut members.here)
            } else {
                writing.here.leave(group, app, &mut members.here)
            }
        });
        let is_rejoining = retained.rejoining.remove(&(app, group));
        if member && (is_changed || is_rejoining) {
            self.hand_over_here(retained, group, app);
        }
        is_changed
    }

    fn hand_over_here(&self, retained: &mut Retained, group: AppAddress, app: AppAddress) {
        let snapshot = &*self.snapshot.load();
        let Some(route) = snapshot.table.local.get(&app) else { return };
        let member = Tid::new(self.node, app);
        let mut missed = 0;
        for message in retained.store.of_group(group, self.clock.now()) {
            if message.header.source == member {
                continue;
            }
            let mut copies = Copies::default();
            copies.note(self.copy_to_member(snapshot, snapshot.table.judge(), (app, &route.sink), &message));
            missed += copies.without_room().map(|(_, count)| count).sum::<u64>();
            self.count(&copies, &message.header);
        }
        (0..missed).for_each(|_| retained.missed());
    }

    /// Sets the groups that have members on another node, and hands the retained values of this node's applications
    /// over to it for the groups that are new. spec: FRAME-8
    pub(super) fn set_groups_of(&self, node: NodeAddress, groups: &[AppAddress]) {
        let retained = &mut *lock(&self.retained);
        let mut joined = retained.store.groups_from(self.node);
        let former = self.snapshot.load();
        joined.retain(|group| groups.contains(group) && !has_member(&former, *group, node));
        self.regroup(&mut lock(&self.writing), |writing, members| {
            writing.elsewhere.set(node, groups.iter().copied().collect(), &mut members.elsewhere)
        });
        self.hand_over_to(retained, node, &joined);
    }

    /// Hands the retained values of this node's applications over to a node that is linked again: it may have removed
    /// them meanwhile. The node ignores those that it has.
    pub fn linked_again(&self, node: NodeAddress) {
        let retained = &mut *lock(&self.retained);
        let mut joined = retained.store.groups_from(self.node);
        let snapshot = self.snapshot.load();
        joined.retain(|group| has_member(&snapshot, *group, node));
        self.hand_over_to(retained, node, &joined);
    }

    fn hand_over_to(&self, retained: &mut Retained, node: NodeAddress, groups: &[AppAddress]) {
        let snapshot = self.snapshot.load();
        let Some(peer) = snapshot.table.peers.get(&node) else { return };
        let now = self.clock.now();
        let values = groups.iter().flat_map(|group| retained.store.of_group(*group, now));
        let own: Vec<Message> = values.filter(|message| message.header.source.node == self.node).collect();
        own.into_iter().for_each(|message| update(retained, node, &**peer, message));
    }

    /// Records that `groups` have members on this node by the list that `node` has been sent. `node` sends no values of
    /// other groups from now on, so those of its applications are removed, unless a member has joined since: then
    /// `node` will hand them over again. Also sends the values and removals that `node` had no room for.
    pub fn groups_listed(&self, node: NodeAddress, groups: &[AppAddress]) {
        let retained = &mut *lock(&self.retained);
        let snapshot = self.snapshot.load();
        retained.store.forget(|header| {
            let group = header.destination.app;
            header.source.node == node
                && !groups.contains(&group)
                && snapshot.members.here.members(group).is_empty()
        });
        let unsent = retained.unsent.range((node, Key::MIN)..=(node, Key::MAX));
        let unsent: Vec<(Key, Class)> = unsent.map(|((_, key), class)| (*key, *class)).collect();
        let Some(peer) = snapshot.table.peers.get(&node) else { return };
        for (key, class) in unsent {
            retained.unsent.remove(&(node, key));
            match retained.store.of_key(key, self.clock.now()) {
                Some(value) if has_member(&snapshot, key.group, node) => {
                    update(retained, node, &**peer, value);
                }
                // It gets the value when it lists the group again.
                Some(_) => {}
                None => update(retained, node, &**peer, removal(key, class)),
            }
        }
    }

    /// Removes the retained values of an application of this node after the end of its incarnation. If it is still a
    /// member of groups, its next incarnation gets their values when it joins again.
    pub fn forget_retained(&self, app: AppAddress) {
        let retained = &mut *lock(&self.retained);
        retained.rejoining.retain(|(of, _)| *of != app);
        retained.rejoining.extend(lock(&self.writing).here.of(app).map(|group| (app, group)));
        let own = Tid::new(self.node, app);
        let over = retained.store.forget(|header| header.source == own);
        let snapshot = self.snapshot.load();
        over.iter().for_each(|header| self.clear_elsewhere(retained, &snapshot, header));
    }

    /// Removes the retained values of another node's applications: it is lost, or another incarnation is linked.
    pub(super) fn forget_retained_of(&self, node: NodeAddress) {
        let retained = &mut *lock(&self.retained);
        retained.store.forget(|header| header.source.node == node);
        retained.unsent.retain(|(behind, _), _| *behind != node);
    }

    /// Removes a value at all other nodes: one that does not list the group may still have it, since an application
    /// there may have left the group and joined it again.
    fn clear_elsewhere(&self, retained: &mut Retained, snapshot: &Snapshot, header: &Header) {
        for (node, peer) in &snapshot.table.peers {
            update(retained, *node, &**peer, removal(Key::of(header), header.class));
        }
    }
}

/// Returns whether a node lacks the value with this header: its queue had no room, or it takes shorter ones only.
pub(super) fn is_behind(header: &Header, refused: Option<Rejection>) -> bool {
    matches!(refused, Some(Rejection::QueueFull | Rejection::TooLong)) && header.flags.has(Flags::KEEP)
}

/// Submits a value or its removal to a node, and records if the node has no room for it.
fn update(retained: &mut Retained, node: NodeAddress, peer: &dyn MessageSink, message: Message) {
    match peer.submit(message) {
        Ok(()) => {}
        Err(SubmitError { message, why: Rejection::QueueFull }) => retained.is_behind(node, &message.header),
        Err(SubmitError { message, why: Rejection::TooLong }) => {
            retained.missed();
            if !message.payload.is_empty() {
                // The node must not take the former value for the latest. A removal is never too long.
                update(retained, node, peer, removal(Key::of(&message.header), message.header.class));
            }
        }
        // The node is not linked: it gets the values when it is linked again.
        Err(_) => {}
    }
}

/// Returns the message that removes the value of a key at another node.
fn removal(key: Key, class: Class) -> Message {
    let mut header = Header::new(key.kind, key.source, Tid::new(NodeAddress::ALL, key.group));
    (header.class, header.flags) = (class, Flags::KEEP);
    Message::new(header, Bytes::new())
}

/// Returns whether `node` has a member of `group`.
fn has_member(snapshot: &Snapshot, group: AppAddress, node: NodeAddress) -> bool {
    snapshot.members.elsewhere.members(group).binary_search(&node).is_ok()
}

/// Returns whether a value with this header can be retained. Values of class Stream replace each other on their way, so
/// that the removal of one would, too.
fn is_retainable(header: &Header) -> bool {
    header.destination.node == NodeAddress::ALL
        && header.destination.app.is_group()
        && header.class != Class::Stream
}

/// Returns whether the message removes a retained value.
fn is_clear(message: &Message) -> bool {
    message.payload.is_empty() && is_retainable(&message.header)
}
