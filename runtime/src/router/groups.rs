//! The members of groups, as senders read them: an immutable tree that is copied on change.
//!
//! A change copies the members of its group and the path to them, and shares all other parts with the
//! previous tree. It copies at most seven branches of 16 parts and one leaf of 16 groups, for any number of
//! groups and any addresses. The router swaps the root.

use std::{
    collections::{BTreeMap, BTreeSet},
    mem,
    sync::Arc,
};

use crate::tid::AppAddress;

/// Bits of an address per branch level.
const BITS: u32 = 4;
/// Parts of a branch. A leaf has at most as many groups: below the last branch there are no more addresses.
const WIDTH: usize = 1 << BITS;
/// A branch with at most this many groups becomes a leaf again, so that removed groups leave no branches.
const FEW: usize = WIDTH / 2;

/// The members of each group that has any: applications of this node, or nodes.
#[derive(Clone)]
pub(super) struct Groups<M>(Arc<Part<M>>);

/// A group with its members in order, at least one.
type Group<M> = (AppAddress, Arc<[M]>);

/// The groups with addresses that begin with the same bits.
#[derive(Clone)]
enum Part<M> {
    /// In the order of their addresses.
    Leaf(Vec<Group<M>>),
    /// Indexed by the next bits of their addresses.
    Branch([Option<Arc<Self>>; WIDTH]),
}

impl<M> Default for Groups<M> {
    fn default() -> Self {
        Self(Arc::default())
    }
}

impl<M> Default for Part<M> {
    fn default() -> Self {
        Self::Leaf(Vec::new())
    }
}

impl<M: Copy + Ord> Groups<M> {
    /// Returns the members of `group`, in order.
    pub(super) fn members(&self, group: AppAddress) -> &[M] {
        let (mut part, mut depth) = (&*self.0, 0);
        loop {
            match part {
                Part::Leaf(groups) => {
                    return match position(groups, group) {
                        Ok(at) => &groups[at].1,
                        Err(_) => &[],
                    };
                }
                Part::Branch(parts) => {
                    let Some(next) = &parts[slot(group, depth)] else { return &[] };
                    part = next;
                    depth += 1;
                }
            }
        }
    }

    /// Returns every group and its members, in the order of the groups' addresses.
    pub(super) fn all(&self) -> Vec<(AppAddress, Arc<[M]>)> {
        let mut all = Vec::new();
        self.0.put_into(&mut all);
        all
    }

    /// Adds `member` to `group`; it must not be a member.
    pub(super) fn join(&mut self, group: AppAddress, member: M) {
        let root = Arc::make_mut(&mut self.0);
        match root.members_mut(group, 0) {
            Some(members) => *members = with(members, member),
            None => root.add((group, Arc::new([member])), 0),
        }
    }

    /// Removes `member` from `group`; it must be a member.
    pub(super) fn leave(&mut self, group: AppAddress, member: M) {
        let root = Arc::make_mut(&mut self.0);
        let Some(members) = root.members_mut(group, 0) else { return };
        let left = without(members, member);
        // Endless joins and leaves of new groups must not fill the table with empty ones.
        if left.is_empty() {
            root.remove(group, 0);
        } else {
            *members = left;
        }
    }
}

impl<M: Copy + Ord> Part<M> {
    fn put_into(&self, all: &mut Vec<Group<M>>) {
        match self {
            Self::Leaf(groups) => all.extend_from_slice(groups),
            Self::Branch(parts) => parts.iter().flatten().for_each(|part| part.put_into(all)),
        }
    }

    /// Returns the members of `group` for replacement. Copies the parts of the path that other references share.
    fn members_mut(&mut self, group: AppAddress, depth: u32) -> Option<&mut Arc<[M]>> {
        match self {
            Self::Leaf(groups) => {
                let at = position(groups, group).ok()?;
                Some(&mut groups[at].1)
            }
            Self::Branch(parts) => {
                let part = parts[slot(group, depth)].as_mut()?;
                Arc::make_mut(part).members_mut(group, depth + 1)
            }
        }
    }

    /// Adds a group that does not exist.
    fn add(&mut self, group: Group<M>, depth: u32) {
        match self {
            Self::Leaf(groups) => {
                let at = groups.partition_point(|other| other.0 < group.0);
                groups.insert(at, group);
                if groups.len() > WIDTH {
                    let groups = mem::take(groups);
                    *self = Self::Branch(Default::default());
                    groups.into_iter().for_each(|group| self.add(group, depth));
                }
            }
            Self::Branch(parts) => {
                let part = parts[slot(group.0, depth)].get_or_insert_default();
                Arc::make_mut(part).add(group, depth + 1);
            }
        }
    }

    fn remove(&mut self, group: AppAddress, depth: u32) {
        match self {
            Self::Leaf(groups) => groups.retain(|other| other.0 != group),
            Self::Branch(parts) => {
                if let Some(part) = &mut parts[slot(group, depth)] {
                    Arc::make_mut(part).remove(group, depth + 1);
                }
                if parts.iter().flatten().map(|part| part.count_few()).sum::<usize>() <= FEW {
                    let mut left = Vec::new();
                    self.put_into(&mut left);
                    *self = Self::Leaf(left);
                }
            }
        }
    }

    /// Returns the number of groups in a leaf; a branch has more than [`FEW`].
    const fn count_few(&self) -> usize {
        match self {
            Self::Leaf(groups) => groups.len(),
            Self::Branch(_) => FEW + 1,
        }
    }
}

/// Returns the part of a branch at this depth that `group` is in: the highest bits come first.
const fn slot(group: AppAddress, depth: u32) -> usize {
    (group.bits() << (BITS * depth) >> (u32::BITS - BITS)) as usize
}

fn position<M>(groups: &[Group<M>], group: AppAddress) -> Result<usize, usize> {
    groups.binary_search_by_key(&group, |other| other.0)
}

fn with<M: Copy + Ord>(members: &[M], member: M) -> Arc<[M]> {
    let (before, after) = members.split_at(members.partition_point(|other| *other < member));
    before.iter().copied().chain([member]).chain(after.iter().copied()).collect()
}

fn without<M: Copy + Ord>(members: &[M], member: M) -> Arc<[M]> {
    members.iter().copied().filter(|other| *other != member).collect()
}

/// The reverse index: the groups of each member. Only writers have it.
pub(super) struct Joined<M> {
    by_member: BTreeMap<M, BTreeSet<AppAddress>>,
    memberships: usize,
}

impl<M> Default for Joined<M> {
    fn default() -> Self {
        Self { by_member: BTreeMap::new(), memberships: 0 }
    }
}

impl<M: Copy + Ord> Joined<M> {
    /// Returns the number of memberships, of all members in all groups.
    pub(super) const fn memberships(&self) -> usize {
        self.memberships
    }

    /// Makes `member` a member of exactly these groups; existing memberships among them are not touched.
    /// Returns whether anything changed.
    pub(super) fn set(&mut self, member: M, wanted: BTreeSet<AppAddress>, groups: &mut Groups<M>) -> bool {
        let before = self.by_member.remove(&member).unwrap_or_default();
        before.difference(&wanted).for_each(|group| groups.leave(*group, member));
        wanted.difference(&before).for_each(|group| groups.join(*group, member));
        let changed = before != wanted;
        self.memberships = self.memberships - before.len() + wanted.len();
        if !wanted.is_empty() {
            self.by_member.insert(member, wanted);
        }
        changed
    }

    /// Returns the groups of `member`.
    pub(super) fn of(&self, member: M) -> impl Iterator<Item = AppAddress> {
        self.by_member.get(&member).into_iter().flatten().copied()
    }

    /// Adds `member` to `group`. Returns whether anything changed.
    pub(super) fn join(&mut self, group: AppAddress, member: M, groups: &mut Groups<M>) -> bool {
        let joins = self.by_member.entry(member).or_default().insert(group);
        if joins {
            self.memberships += 1;
            groups.join(group, member);
        }
        joins
    }

    /// Removes `member` from `group`. Returns whether anything changed.
    pub(super) fn leave(&mut self, group: AppAddress, member: M, groups: &mut Groups<M>) -> bool {
        let Some(own) = self.by_member.get_mut(&member) else { return false };
        let leaves = own.remove(&group);
        if own.is_empty() {
            self.by_member.remove(&member);
        }
        if leaves {
            self.memberships -= 1;
            groups.leave(group, member);
        }
        leaves
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const APP: AppAddress = AppAddress::new(0x1000);
    /// The longest path to a group: branches and the leaf.
    const WAY_MAX: usize = 8;
    type Change = fn(&mut Groups<AppAddress>, AppAddress, AppAddress);

    fn group(number: u32) -> AppAddress {
        AppAddress::new(0xf000_0000 + number)
    }

    /// Memory addresses of the parts, and of the member lists.
    #[derive(Default)]
    struct Places {
        parts: BTreeSet<usize>,
        members: BTreeSet<usize>,
    }

    impl Places {
        fn of(groups: &Groups<AppAddress>) -> Self {
            let mut places = Self::default();
            places.look(&groups.0);
            places
        }

        fn look(&mut self, part: &Arc<Part<AppAddress>>) {
            self.parts.insert(Arc::as_ptr(part) as usize);
            match &**part {
                Part::Leaf(groups) => {
                    self.members.extend(groups.iter().map(|(_, members)| members.as_ptr() as usize));
                }
                Part::Branch(parts) => parts.iter().flatten().for_each(|part| self.look(part)),
            }
        }

        /// Counts the parts, and the member lists, that the tree before does not have.
        fn copied_since(&self, before: &Self) -> (usize, usize) {
            let parts = self.parts.difference(&before.parts).count();
            (parts, self.members.difference(&before.members).count())
        }
    }

    #[test]
    fn change_copies_only_the_path_to_its_group() {
        // Given: many groups, with scattered or consecutive addresses
        let strewn = (0..4_096).map(|number| AppAddress::group(&format!("group {number}")));
        for addresses in [strewn.collect::<BTreeSet<_>>(), (0..4_096).map(group).collect()] {
            let mut groups = Groups::default();
            addresses.iter().for_each(|group| groups.join(*group, APP));
            for changed in addresses.iter().step_by(397) {
                let (before, other) = (groups.clone(), AppAddress::new(0x1001));
                // When: an application joins and leaves an existing group, and a group is added and removed
                let changes: [(&str, Change); 3] = [
                    ("join", |groups, group, other| groups.join(group, other)),
                    ("leave", |groups, group, other| groups.leave(group, other)),
                    ("end", |groups, group, _| groups.leave(group, APP)),
                ];
                for (change, make) in changes {
                    let places = Places::of(&groups);
                    let read = groups.clone();
                    make(&mut groups, *changed, other);
                    // Then
                    let (parts, members) = Places::of(&groups).copied_since(&places);
                    assert!(parts <= WAY_MAX && members <= 1, "{change}: {parts} parts, {members} groups");
                    drop(read);
                }
                assert_eq!(before.members(*changed), [APP], "who reads the tree before sees no change");
                groups.join(*changed, APP);
            }
        }
    }

    #[test]
    fn removed_groups_leave_no_branches() {
        let mut groups = Groups::default();
        (0..1_000).for_each(|number| groups.join(group(number), APP));
        (1..1_000).for_each(|number| groups.leave(group(number), APP));
        assert_eq!(Places::of(&groups).parts.len(), 1);
        groups.leave(group(0), APP);
        assert!(groups.all().is_empty());
    }

    #[test]
    fn members_and_groups_are_in_order() {
        let mut groups = Groups::default();
        for number in [40, 3, 7, 39, 3_000_000] {
            for app in [0x1002, 0x1000, 0x1001] {
                groups.join(group(number), AppAddress::new(app));
            }
        }
        let members = [0x1000, 0x1001, 0x1002].map(AppAddress::new);
        assert_eq!(groups.members(group(7)), members);
        assert!(groups.members(group(8)).is_empty());
        let all: Vec<_> = groups.all().into_iter().map(|(group, _)| group).collect();
        assert_eq!(all, [3, 7, 39, 40, 3_000_000].map(group));
    }

    /// A few addresses that share their first bits, a few that do not.
    fn some_group() -> impl Strategy<Value = AppAddress> {
        prop_oneof![(0..64_u32).prop_map(group), any::<u32>().prop_map(AppAddress::new)]
    }

    proptest! {
        #[test]
        fn tree_agrees_with_a_plain_table(steps in prop::collection::vec((some_group(), 0..4_u32, any::<bool>()), 0..600)) {
            let (mut groups, mut joined) = (Groups::default(), Joined::default());
            let mut plain = BTreeSet::new();
            for (group, app, joins) in steps {
                let app = AppAddress::new(0x1000 + app);
                let changed = if joins {
                    joined.join(group, app, &mut groups)
                } else {
                    joined.leave(group, app, &mut groups)
                };
                let expected = if joins { plain.insert((group, app)) } else { plain.remove(&(group, app)) };
                prop_assert_eq!(changed, expected);
            }
            prop_assert_eq!(joined.memberships(), plain.len());
            let all = groups.all();
            let told = all.iter().flat_map(|(group, members)| members.iter().map(|app| (*group, *app)));
            prop_assert_eq!(told.collect::<BTreeSet<_>>(), plain.clone());
            // An application that leaves is in no group any more.
            joined.set(APP, BTreeSet::new(), &mut groups);
            plain.retain(|(_, app)| *app != APP);
            prop_assert_eq!(joined.memberships(), plain.len());
            prop_assert!(all.iter().all(|(group, _)| !groups.members(*group).contains(&APP)));
        }
    }
}
