//! The changes of the routing table, and the lists of its groups and their members.

use std::{collections::BTreeSet, sync::Arc};

use super::{
    LocalRoute, Members, MessageSink, Router, Snapshot, Table, Writing, for_each_here,
    guard::{Guard, ParameterRight},
    mismatches::{Mismatches, TypedPath},
    tap::{self, Passage, Tap, TapOf},
};
use crate::{
    lock,
    tid::{AppAddress, NodeAddress, Tid},
};

impl Router {
    fn change(&self, edit: impl FnOnce(&mut Table)) {
        let _turn = lock(&self.writing);
        let mut snapshot = Snapshot::clone(&self.snapshot.load());
        edit(Arc::make_mut(&mut snapshot.table));
        self.snapshot.store(Arc::new(snapshot));
    }

    /// Replaces the group members, if `edit` returns that anything changed; the caller holds the writers' lock.
    pub(super) fn regroup(
        &self,
        writing: &mut Writing,
        edit: impl FnOnce(&mut Writing, &mut Members) -> bool,
    ) -> bool {
        let mut snapshot = Snapshot::clone(&self.snapshot.load());
        let changed = edit(writing, &mut snapshot.members);
        if changed {
            self.snapshot.store(Arc::new(snapshot));
        }
        changed
    }

    /// Adds or replaces the route to an application of this node.
    pub fn set_local(&self, app: AppAddress, route: LocalRoute) {
        self.change(|table| {
            table.local.insert(app, route);
        });
    }

    /// Removes an application, its memberships, its retained values, and the types that it declared differently.
    pub fn remove_local(&self, app: AppAddress) {
        let mut writing = lock(&self.writing);
        let mut snapshot = Snapshot::clone(&self.snapshot.load());
        let table = Arc::make_mut(&mut snapshot.table);
        table.local.remove(&app);
        writing.route_changes += 1;
        let own = Tid::new(self.node, app);
        let dropped = drop_mismatches(table, |path| path.target == app || path.source == own);
        writing.here.set(app, BTreeSet::new(), &mut snapshot.members.here);
        self.snapshot.store(Arc::new(snapshot));
        drop(writing);
        // After its route is removed: no later value of it is retained.
        self.forget_retained(app);
        if let Some(former) = dropped {
            former.notify();
        }
    }

    /// Adds `app` to `group`, or removes it. Returns whether anything changed. A new member gets the retained values
    /// of the group. The cost depends on the number of these and of the group's members, and not on the number of
    /// applications and groups.
    pub fn set_member(&self, group: AppAddress, app: AppAddress, member: bool) -> bool {
        self.set_member_here(group, app, member)
    }

    /// Returns whether `app` is a member of `group`.
    #[must_use]
    pub fn is_member(&self, group: AppAddress, app: AppAddress) -> bool {
        self.snapshot.load().members.here.members(group).binary_search(&app).is_ok()
    }

    /// Returns the applications of this node that a message to many reaches, in the order of their addresses:
    /// the members of a group, all applications, or the one with this address. The sender may be in the list,
    /// although it gets no copy.
    #[must_use]
    pub fn members(&self, of: AppAddress) -> Vec<AppAddress> {
        let mut reached = Vec::new();
        for_each_here(&self.snapshot.load(), of, |app, _| reached.push(app));
        reached
    }

    /// Returns the number of memberships of all applications of this node in all groups.
    #[must_use]
    pub fn memberships(&self) -> usize {
        lock(&self.writing).here.memberships()
    }

    /// Returns the number of changes of the routes to other nodes and of removals of applications, for
    /// [`set_mismatches`](Self::set_mismatches).
    #[must_use]
    pub fn route_changes(&self) -> u64 {
        lock(&self.writing).route_changes
    }

    /// Sets the types that their senders and the applications of this node declared differently; `None`: none. Returns
    /// whether they are set: not if a route to another node has changed, or an application was removed, since the
    /// caller read `route_changes`. Then a sender or receiver may be another incarnation, with other types.
    #[must_use]
    pub fn set_mismatches(&self, mismatches: Option<Mismatches>, route_changes: u64) -> bool {
        let mismatches = mismatches.map(Arc::new);
        let writing = lock(&self.writing);
        if writing.route_changes != route_changes {
            return false;
        }
        let mut snapshot = Snapshot::clone(&self.snapshot.load());
        Arc::make_mut(&mut snapshot.table).mismatches = mismatches;
        self.snapshot.store(Arc::new(snapshot));
        true
    }

    /// Returns whether messages of some type between these two applications of this node are refused, or arrive without
    /// their value, because the two declared that type differently.
    #[must_use]
    pub fn refuses_types_between(&self, one: Tid, other: Tid) -> bool {
        let snapshot = self.snapshot.load();
        snapshot.table.mismatches.as_ref().is_some_and(|mismatches| {
            mismatches.refuses_some(one, other.app) || mismatches.refuses_some(other, one.app)
        })
    }

    /// Sets the tap that observes messages from now on for this purpose; `None` removes it.
    pub fn set_tap(&self, of: TapOf, tap: Option<Arc<dyn Tap>>) {
        let mut writing = lock(&self.writing);
        writing.taps[of as usize] = tap;
        let mut snapshot = Snapshot::clone(&self.snapshot.load());
        Arc::make_mut(&mut snapshot.table).tap = tap::joined(&writing.taps);
        self.snapshot.store(Arc::new(snapshot));
    }

    /// Returns whether a tap observes messages from or to this application.
    #[must_use]
    pub fn is_observed(&self, app: Tid) -> bool {
        self.snapshot.load().table.tap.as_ref().is_some_and(|tap| tap.watches(app))
    }

    /// Reports a message of an application to the tap that did not pass through this table, and how many others are not
    /// reported.
    pub fn observe(&self, app: Tid, passage: &Passage<'_>, missed: u64) {
        let snapshot = self.snapshot.load();
        let Some(tap) = snapshot.table.tap.as_ref().filter(|tap| tap.watches(app)) else { return };
        if missed > 0 {
            tap.missed(app, missed);
        }
        tap.saw(app, passage);
    }

    /// Reports to the tap how many messages of an application are not reported.
    pub fn observe_missed(&self, app: Tid, missed: u64) {
        let snapshot = self.snapshot.load();
        if let Some(tap) = snapshot.table.tap.as_ref().filter(|tap| missed > 0 && tap.watches(app)) {
            tap.missed(app, missed);
        }
    }

    /// Sets the guard that checks messages to the applications of this node from now on.
    pub fn set_guard(&self, guard: Arc<dyn Guard>) {
        self.change(|table| table.guard = Some(guard));
    }

    /// Sets the senders that may set parameters of the applications of this node from now on.
    pub fn set_parameter_right(&self, right: ParameterRight) {
        self.change(|table| table.parameters = right);
    }

    /// Returns the groups that have a member on this node, in the order of their addresses.
    #[must_use]
    pub fn groups(&self) -> Vec<AppAddress> {
        self.groups_with_members().into_iter().map(|(group, _)| group).collect()
    }

    /// Same as [`groups`](Self::groups), with their members.
    #[must_use]
    pub fn groups_with_members(&self) -> Vec<(AppAddress, Arc<[AppAddress]>)> {
        self.snapshot.load().members.here.all()
    }

    /// Adds or replaces the route to another node. Another sink is another incarnation: the types that the former one
    /// declared differently are forgotten.
    pub fn set_peer(&self, node: NodeAddress, sink: Arc<dyn MessageSink>) {
        self.change_peer(node, Some(sink));
    }

    /// Removes the route to another node, and the types that it declared differently.
    pub fn remove_peer(&self, node: NodeAddress) {
        self.change_peer(node, None);
    }

    fn change_peer(&self, node: NodeAddress, sink: Option<Arc<dyn MessageSink>>) {
        let mut writing = lock(&self.writing);
        let mut snapshot = Snapshot::clone(&self.snapshot.load());
        let is_same = match (snapshot.table.peers.get(&node), &sink) {
            (Some(former), Some(sink)) => Arc::ptr_eq(former, sink),
            (None, None) => true,
            (Some(_), None) | (None, Some(_)) => false,
        };
        if is_same {
            return;
        }
        writing.route_changes += 1;
        let table = Arc::make_mut(&mut snapshot.table);
        match sink {
            Some(sink) => table.peers.insert(node, sink),
            None => table.peers.remove(&node),
        };
        let dropped = drop_mismatches(table, |path| path.source.node == node);
        self.snapshot.store(Arc::new(snapshot));
        drop(writing);
        self.forget_retained_of(node);
        if let Some(former) = dropped {
            former.notify();
        }
    }

    /// Sets the groups that have members on another node. Only the paths to the groups that changed are copied.
    /// The node gets the retained values of this node's applications for the groups that are new.
    pub fn set_remote_groups(&self, node: NodeAddress, groups: &[AppAddress]) {
        self.set_groups_of(node, groups);
    }
}

/// Removes the paths that are over. Returns the former table if there were any: its owner is to compare anew.
fn drop_mismatches(table: &mut Table, is_over: impl Fn(&TypedPath) -> bool) -> Option<Arc<Mismatches>> {
    let former = table.mismatches.clone()?;
    let others = former.without(is_over)?;
    table.mismatches = Some(others).filter(|others| !others.is_empty()).map(Arc::new);
    Some(former)
}
