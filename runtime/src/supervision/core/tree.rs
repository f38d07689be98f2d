//! Supervisors in supervisors: what one core orders of a child that is a supervisor is told to that one's core, and what
//! becomes of it is told to its parent's. All that leaves the tree is about children that are not supervisors, and facts.
//!
//! A supervisor that gives up has stopped its children in order; for its parent that is the failure of a child. Its next life
//! begins with the children of its declaration: those added at run time too, unless they are temporary; those deleted are
//! gone. It is ready when all its children are.

use std::{
    collections::{BTreeMap, VecDeque},
    time::Duration,
};

use super::{ChildId, ChildView, Command, Core, Flags, Generation, Input, Order, Policy, Refusal};
use crate::time::Time;

/// A supervisor to be: how it treats its children, and who they are, in the order of their start.
#[derive(Clone, Debug)]
pub struct Plan {
    /// Which child of its node it is.
    pub id: ChildId,
    /// How it treats its children.
    pub flags: Flags,
    /// Its children.
    pub children: Vec<Planned>,
}

/// A child to be.
#[derive(Clone, Debug)]
pub enum Planned {
    /// An actor.
    Worker(ChildId, Policy),
    /// A supervisor with children of its own, and what its parent may do with it: its deadlines are of no effect, for it keeps
    /// those of its children.
    Supervisor(Plan, Policy),
}

/// No deadline of a supervisor: each of its children has its own. (136 years.)
const NEVER: Duration = Duration::from_secs(u32::MAX as u64);

/// What is known of a supervisor, for who asks.
#[derive(Clone, Debug)]
pub struct BranchView {
    /// Which child of its node it is.
    pub id: ChildId,
    /// How it treats its children.
    pub flags: Flags,
    /// Its restarts in the window that ends now.
    pub restarts_in_window: usize,
    /// Lives of its children that were taken and have not let go.
    pub abandoned: usize,
    /// Whether it stops its children, or has.
    pub is_ending: bool,
    /// Its children, with what they supervise.
    pub children: Vec<(ChildId, ChildView, Option<Self>)>,
}

#[derive(Debug)]
struct Branch {
    core: Core,
    /// Whom its next life begins with. Empty for the top, which has one life.
    declared: Vec<(ChildId, Policy)>,
    /// Which life of it the core is.
    life: Generation,
}

/// The decisions of a tree of supervisors.
#[derive(Debug)]
pub struct Tree {
    top: ChildId,
    branches: BTreeMap<ChildId, Branch>,
    /// Whose child each is.
    owners: BTreeMap<ChildId, ChildId>,
    orders: VecDeque<Order>,
}

impl Tree {
    /// A tree that has not started yet. `seed` makes the chance in its waits.
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
        self.branches.insert(plan.id, Branch { core, declared: children, life: 0 });
    }

    /// Takes an event. Then drain [`poll`](Self::poll). A child is added by [`add`](Self::add): here nobody knows under whom.
    pub fn handle(&mut self, now: Time, input: Input) {
        match &input {
            Input::Started | Input::StopOrdered => self.tell(now, self.top, input),
            Input::TimePassed => {
                let is_due = |branch: &Branch| branch.core.next_wake().is_some_and(|wake| wake <= now);
                let due: Vec<_> =
                    self.branches.iter().filter(|(_, b)| is_due(b)).map(|(id, _)| *id).collect();
                due.into_iter().for_each(|id| self.tell(now, id, Input::TimePassed));
            }
            // How a supervisor is, its own core says and nobody else.
            Input::BecameReady(id, _)
            | Input::Hung(id, ..)
            | Input::Ended(id, ..)
            | Input::Reprieved(id, ..)
                if self.branches.contains_key(id) => {}
            Input::Released(id)
            | Input::BecameReady(id, _)
            | Input::Hung(id, ..)
            | Input::Ended(id, ..)
            | Input::Reprieved(id, ..)
            | Input::AddChild(id, _)
            | Input::TerminateChild(id)
            | Input::RestartChild(id)
            | Input::DeleteChild(id) => match self.owners.get(id) {
                _ if self.has_ended() => self.refuse(&input, Refusal::Ending),
                Some(owner) => self.tell(now, *owner, input),
                None => self.refuse(&input, Refusal::Unknown),
            },
        }
    }

    /// Takes a child in, as the last one of the supervisor `under`.
    pub fn add(&mut self, now: Time, under: ChildId, id: ChildId, policy: Policy) {
        if let Some(refusal) = self.why_not_added(under, id) {
            return self.orders.push_back(Order::Refused(Command::Add, id, refusal));
        }
        self.owners.insert(id, under);
        self.tell(now, under, Input::AddChild(id, policy.clone()));
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

    fn why_not_added(&self, under: ChildId, id: ChildId) -> Option<Refusal> {
        if self.has_ended() {
            return Some(Refusal::Ending);
        }
        if self.owners.contains_key(&id) {
            return Some(Refusal::Present);
        }
        (!self.branches.contains_key(&under)).then_some(Refusal::Unknown)
    }

    /// The next order, oldest first.
    pub fn poll(&mut self) -> Option<Order> {
        self.orders.pop_front()
    }

    /// When [`Input::TimePassed`] is due.
    #[must_use]
    pub fn next_wake(&self) -> Option<Time> {
        self.branches.values().filter_map(|branch| branch.core.next_wake()).min()
    }

    /// The supervisor of all.
    #[must_use]
    pub const fn top(&self) -> ChildId {
        self.top
    }

    /// Whose child it is.
    #[must_use]
    pub fn owner(&self, id: ChildId) -> Option<ChildId> {
        self.owners.get(&id).copied()
    }

    /// What is known of a child.
    #[must_use]
    pub fn child(&self, id: ChildId) -> Option<ChildView> {
        self.branches.get(self.owners.get(&id)?)?.core.child(id)
    }

    /// What is known of all.
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

    fn refuse(&mut self, input: &Input, why: Refusal) {
        if let Some((command, id)) = input.command() {
            self.orders.push_back(Order::Refused(command, id, why));
        }
    }

    fn tell(&mut self, now: Time, supervisor: ChildId, input: Input) {
        let Some(branch) = self.branches.get_mut(&supervisor) else { return };
        branch.core.handle(now, input);
        while let Some(order) = self.branches.get_mut(&supervisor).and_then(|branch| branch.core.poll()) {
            self.carry(now, supervisor, order);
        }
    }

    fn tell_parent(&mut self, now: Time, of: ChildId, what: impl FnOnce(Generation) -> Input) {
        if let (Some(parent), Some(branch)) = (self.owners.get(&of), self.branches.get(&of)) {
            self.tell(now, *parent, what(branch.life));
        }
    }

    /// Carries an order of the core of `supervisor` to whom it is for.
    fn carry(&mut self, now: Time, supervisor: ChildId, order: Order) {
        match order {
            Order::Spawn(id, generation) if self.branches.contains_key(&id) => {
                self.begin(now, id, generation)
            }
            Order::Stop(id, _) if self.branches.contains_key(&id) => self.tell(now, id, Input::StopOrdered),
            Order::AllReady if supervisor != self.top => {
                self.tell_parent(now, supervisor, |life| Input::BecameReady(supervisor, life));
            }
            Order::Ended(reason) if supervisor != self.top => {
                self.tell_parent(now, supervisor, |life| Input::Ended(supervisor, life, reason));
            }
            Order::Deleted(id) if self.is_declared(supervisor, id) => {
                // A temporary one: the next life of its supervisor begins with it again. Or else a command follows.
            }
            Order::Deleted(id) => self.forget(supervisor, id),
            Order::Done(Command::Delete, id) | Order::Refused(Command::Delete, id, Refusal::Unknown) => {
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

    /// A new life of a supervisor.
    fn begin(&mut self, now: Time, supervisor: ChildId, life: Generation) {
        if let Some(branch) = self.branches.get_mut(&supervisor) {
            if branch.life > 0 {
                branch.core = branch.core.renewed(branch.declared.clone());
            }
            branch.life = life;
            self.tell(now, supervisor, Input::Started);
        }
    }

    fn is_declared(&self, supervisor: ChildId, id: ChildId) -> bool {
        self.branches
            .get(&supervisor)
            .is_some_and(|branch| branch.declared.iter().any(|(child, _)| *child == id))
    }

    /// Forgets a child, and all that it supervised.
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
