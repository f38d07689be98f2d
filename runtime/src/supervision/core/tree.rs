//! Nested supervisors. An order of a core for a child that is a supervisor goes to that child's core, and its
//! result goes to the parent's core. The orders that leave the tree are those for children that are not
//! supervisors, and facts.
//!
//! A supervisor that gives up has stopped its children in order; its parent handles that as the failure of a
//! child. Its next incarnation starts with its declared children and those added at run time, except
//! temporary ones and deleted ones. It is ready when all its children are.

use std::{
    collections::{BTreeMap, VecDeque},
    time::Duration,
};

use super::{ChildCommandError, ChildId, ChildView, Command, Core, Flags, Generation, Input, Order, Policy};
use crate::time::Time;

/// The declaration of a supervisor: its group policy and its children, in the order of their start.
#[derive(Clone, Debug)]
pub struct Plan {
    /// The ID of the supervisor in its node.
    pub id: ChildId,
    /// The policy for its children as a group.
    pub flags: Flags,
    /// Its children.
    pub children: Vec<Planned>,
}

/// The declaration of a child.
#[derive(Clone, Debug)]
pub enum Planned {
    /// An actor.
    Worker(ChildId, Policy),
    /// A supervisor with children of its own, and its parent's policy for it. The deadlines of that policy
    /// have no effect, as each child has its own.
    Supervisor(Plan, Policy),
}

/// The deadline of a supervisor, which is none: each of its children has its own. (136 years.)
const NEVER: Duration = Duration::from_secs(u32::MAX as u64);

/// The state of a supervisor, for queries.
#[derive(Clone, Debug)]
pub struct BranchView {
    /// The ID of the supervisor in its node.
    pub id: ChildId,
    /// The policy for its children as a group.
    pub flags: Flags,
    /// The number of restarts in the window that ends now.
    pub restarts_in_window: usize,
    /// The number of its children's abandoned incarnations that have not ended.
    pub abandoned: usize,
    /// Whether it stops its children, or has stopped them.
    pub is_ending: bool,
    /// Its children, with their own children.
    pub children: Vec<(ChildId, ChildView, Option<Self>)>,
}

#[derive(Debug)]
struct Branch {
    core: Core,
    /// The children of its next incarnation. Empty for the top, which has one incarnation.
    declared: Vec<(ChildId, Policy)>,
    /// The incarnation of the core.
    generation: Generation,
}

/// The decisions of a tree of supervisors.
#[derive(Debug)]
pub struct Tree {
    top: ChildId,
    branches: BTreeMap<ChildId, Branch>,
    /// The supervisor of each child.
    owners: BTreeMap<ChildId, ChildId>,
    orders: VecDeque<Order>,
}

impl Tree {
    /// Creates a tree that has not started yet. `seed` seeds the jitter of its waits.
    #[must_use]
    pub fn new(plan: Plan, seed: u64) -> Self {
        let top = plan.id;
        let mut tree =
            Self { top, branches: BTreeMap::new(), owners: BTreeMap::new(), orders: VecDeque::new() };
        tree.plant(plan, seed);
        if let Some(top) = tree.branches.get_mut(&top) {
            top.declared.clear();
        }
        tree
    }

    fn plant(&mut self, plan: Plan, seed: u64) {
        let mut children = Vec::new();
        for (place, planned) in (1_u64..).zip(plan.children) {
            let (id, policy) = match planned {
                Planned::Worker(id, policy) => (id, policy),
                Planned::Supervisor(below, policy) => {
                    let id = below.id;
                    self.plant(below, seed.wrapping_add(place).rotate_left(17));
                    (id, Policy { start_within: NEVER, stop_within: NEVER, held: false, ..policy })
                }
            };
            self.owners.insert(id, plan.id);
            children.push((id, policy));
        }
        let core = Core::new(plan.flags, seed, children.clone());
        self.branches.insert(plan.id, Branch { core, declared: children, generation: 0 });
    }

    /// Handles an event. Call [`poll`](Self::poll) afterwards. A child is added by [`add`](Self::add),
    /// because the event has no supervisor.
    pub fn handle(&mut self, now: Time, input: Input) {
        match &input {
            Input::Started | Input::StopOrdered => self.dispatch(now, self.top, input),
            Input::TimePassed => {
                let is_due = |branch: &Branch| branch.core.next_wake().is_some_and(|wake| wake <= now);
                let due: Vec<_> =
                    self.branches.iter().filter(|(_, b)| is_due(b)).map(|(id, _)| *id).collect();
                due.into_iter().for_each(|id| self.dispatch(now, id, Input::TimePassed));
            }
            // The state of a supervisor is reported only by its own core.
            Input::BecameReady(id, _)
            | Input::Hung(id, ..)
            | Input::Ended(id, ..)
            | Input::DeadlineExtended(id, ..)
                if self.branches.contains_key(id) => {}
            Input::Released(id)
            | Input::BecameReady(id, _)
            | Input::Hung(id, ..)
            | Input::Ended(id, ..)
            | Input::DeadlineExtended(id, ..)
            | Input::AddChild(id, _)
            | Input::TerminateChild(id)
            | Input::RestartChild(id)
            | Input::DeleteChild(id) => match self.owners.get(id) {
                _ if self.has_ended() => self.refuse(&input, ChildCommandError::Ending),
                Some(owner) => self.dispatch(now, *owner, input),
                None => self.refuse(&input, ChildCommandError::Unknown),
            },
        }
    }

    /// Adds a child, as the last one of the supervisor `under`.
    pub fn add(&mut self, now: Time, under: ChildId, id: ChildId, policy: Policy) {
        if let Some(refusal) = self.why_not_added(under, id) {
            return self.orders.push_back(Order::Refused(Command::Add, id, refusal));
        }
        self.owners.insert(id, under);
        self.dispatch(now, under, Input::AddChild(id, policy.clone()));
        let is_top = under == self.top;
        let taken = self.branches.get_mut(&under).filter(|branch| branch.core.child(id).is_some());
        match taken {
            Some(branch) if !is_top && policy.restart != super::Restart::Temporary => {
                branch.declared.push((id, policy));
            }
            Some(_) => {}
            None => _ = self.owners.remove(&id),
        }
    }

    fn why_not_added(&self, under: ChildId, id: ChildId) -> Option<ChildCommandError> {
        if self.has_ended() {
            return Some(ChildCommandError::Ending);
        }
        if self.owners.contains_key(&id) {
            return Some(ChildCommandError::Present);
        }
        (!self.branches.contains_key(&under)).then_some(ChildCommandError::Unknown)
    }

    /// Returns the next order, oldest first.
    pub fn poll(&mut self) -> Option<Order> {
        self.orders.pop_front()
    }

    /// Returns when [`Input::TimePassed`] is due.
    #[must_use]
    pub fn next_wake(&self) -> Option<Time> {
        self.branches.values().filter_map(|branch| branch.core.next_wake()).min()
    }

    /// Returns the top supervisor.
    #[must_use]
    pub const fn top(&self) -> ChildId {
        self.top
    }

    /// Returns the supervisor of a child.
    #[must_use]
    pub fn owner(&self, id: ChildId) -> Option<ChildId> {
        self.owners.get(&id).copied()
    }

    /// Returns the state of a child.
    #[must_use]
    pub fn child(&self, id: ChildId) -> Option<ChildView> {
        self.branches.get(self.owners.get(&id)?)?.core.child(id)
    }

    /// Returns the state of the whole tree.
    #[must_use]
    pub fn view(&self, now: Time) -> BranchView {
        self.view_of(now, self.top, &self.branches[&self.top])
    }

    fn view_of(&self, now: Time, id: ChildId, branch: &Branch) -> BranchView {
        let below = |child: ChildId| self.branches.get(&child).map(|below| self.view_of(now, child, below));
        let core = &branch.core;
        BranchView {
            id,
            flags: *core.flags(),
            restarts_in_window: core.restarts_in_window(now),
            abandoned: core.abandoned(),
            is_ending: core.is_ending(),
            children: core.children().filter_map(|id| Some((id, core.child(id)?, below(id)))).collect(),
        }
    }

    fn has_ended(&self) -> bool {
        self.branches.get(&self.top).is_none_or(|top| top.core.has_ended())
    }

    fn refuse(&mut self, input: &Input, why: ChildCommandError) {
        if let Some((command, id)) = input.command() {
            self.orders.push_back(Order::Refused(command, id, why));
        }
    }

    fn dispatch(&mut self, now: Time, supervisor: ChildId, input: Input) {
        let Some(branch) = self.branches.get_mut(&supervisor) else { return };
        branch.core.handle(now, input);
        while let Some(order) = self.branches.get_mut(&supervisor).and_then(|branch| branch.core.poll()) {
            self.route(now, supervisor, order);
        }
    }

    fn notify_parent(&mut self, now: Time, of: ChildId, what: impl FnOnce(Generation) -> Input) {
        if let (Some(parent), Some(branch)) = (self.owners.get(&of), self.branches.get(&of)) {
            self.dispatch(now, *parent, what(branch.generation));
        }
    }

    /// Routes an order of the core of `supervisor`.
    fn route(&mut self, now: Time, supervisor: ChildId, order: Order) {
        match order {
            Order::Spawn(id, generation) if self.branches.contains_key(&id) => {
                self.begin(now, id, generation)
            }
            Order::Stop(id, _) if self.branches.contains_key(&id) => {
                self.dispatch(now, id, Input::StopOrdered)
            }
            Order::AllReady if supervisor != self.top => {
                self.notify_parent(now, supervisor, |generation| Input::BecameReady(supervisor, generation));
            }
            Order::Ended(reason) if supervisor != self.top => {
                self.notify_parent(now, supervisor, |generation| {
                    Input::Ended(supervisor, generation, reason)
                });
            }
            Order::Deleted(id) if self.is_declared(supervisor, id) => {
                // Either a temporary child, which the next incarnation of its supervisor starts again, or a
                // child that a later command deletes.
            }
            Order::Deleted(id) => self.forget(supervisor, id),
            Order::Done(Command::Delete, id)
            | Order::Refused(Command::Delete, id, ChildCommandError::Unknown) => {
                if self.owners.contains_key(&id) {
                    self.forget(supervisor, id);
                }
                self.orders.push_back(Order::Done(Command::Delete, id));
            }
            Order::Spawn(..)
            | Order::Stop(..)
            | Order::Abandon(..)
            | Order::Failed(..)
            | Order::Ready(_)
            | Order::Gone(..)
            | Order::AllReady
            | Order::Done(..)
            | Order::Refused(..)
            | Order::Ended(_) => self.orders.push_back(order),
        }
    }

    /// Starts a new incarnation of a supervisor.
    fn begin(&mut self, now: Time, supervisor: ChildId, generation: Generation) {
        if let Some(branch) = self.branches.get_mut(&supervisor) {
            if branch.generation > 0 {
                branch.core = branch.core.renewed(branch.declared.clone());
            }
            branch.generation = generation;
            self.dispatch(now, supervisor, Input::Started);
        }
    }

    fn is_declared(&self, supervisor: ChildId, id: ChildId) -> bool {
        self.branches
            .get(&supervisor)
            .is_some_and(|branch| branch.declared.iter().any(|(child, _)| *child == id))
    }

    /// Removes a child, and all children below it.
    fn forget(&mut self, supervisor: ChildId, id: ChildId) {
        if let Some(branch) = self.branches.get_mut(&supervisor) {
            branch.declared.retain(|(child, _)| *child != id);
        }
        if self.branches.remove(&id).is_some() {
            let of_it = |(_, owner): &(&ChildId, &ChildId)| **owner == id;
            let below: Vec<_> = self.owners.iter().filter(of_it).map(|(child, _)| *child).collect();
            below.into_iter().for_each(|child| self.forget(id, child));
        }
        self.owners.remove(&id);
        self.orders.push_back(Order::Deleted(id));
    }
}
