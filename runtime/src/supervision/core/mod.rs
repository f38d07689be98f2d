//! The supervisor's decisions, as a pure state machine: (history, now, event) to orders.
//!
//! Erlang/OTP's vocabulary and rules (stdlib, module `supervisor`): restart types, strategies, restart intensity over a
//! window, ordered start, stop in reverse order, significant children, children added and removed at run time. Added to
//! them: readiness (a child is started when those before it have said Ready), a deadline on every wait, exponential
//! back-off with jitter, children that are held until they are released, and a bound on lives that were taken and did not
//! let go. Left out: one-for-one's `simple` form.
//!
//! After every [`handle`](Core::handle) the shell drains [`poll`](Core::poll) until nothing is left, then sleeps until
//! [`next_wake`](Core::next_wake). Every event carries the generation of the child that it speaks of; an event of an
//! earlier generation is ignored.
//!
//! | file | what it is |
//! | --- | --- |
//! | `policy` | what the supervisor may do |
//! | `event` | what it is told, what it orders |
//! | `child` | what it remembers of one child |
//! | `restart` | what follows when a child has ended |
//! | `commands` | children added, terminated, restarted, deleted |
//! | `reconcile` | stops and starts, in order |
//! | `tree` | supervisors in supervisors |

mod child;
mod commands;
mod event;
mod id;
#[cfg(test)]
mod model;
mod policy;
mod reason;
mod reconcile;
mod restart;
#[cfg(test)]
mod simulation;
#[cfg(test)]
mod table;
#[cfg(test)]
mod tests;
mod tree;
#[cfg(test)]
mod tree_tests;
mod window;

use std::collections::{BTreeSet, VecDeque};

use child::Child;
pub use child::{ChildState, ChildView};
pub use event::{Command, Input, Order, Refusal};
pub use id::{ChildId, ChildIds, Generation};
pub use policy::{AutoShutdown, Flags, Intensity, Policy, Restart, StartRetry, Strategy};
pub use reason::Reason;
pub use tree::{BranchView, Plan, Planned, Tree};
use window::{Chance, Window};

use crate::time::Time;

/// A supervisor's memory; see the [module](self).
#[derive(Debug)]
pub struct Core {
    flags: Flags,
    chance: Chance,
    children: Vec<Child>,
    restarts: Window,
    /// Restarts because a child lost its thread.
    losses: Window,
    /// Lives that were taken and have not ended yet.
    abandoned: BTreeSet<(ChildId, Generation)>,
    /// The highest generation that any child had.
    last_generation: Generation,
    started: bool,
    /// Set once the children are to end.
    ending: Option<Reason>,
    ended: bool,
    said_all_ready: bool,
    orders: VecDeque<Order>,
}

impl Core {
    /// A supervisor of these children, in the order of their start. `seed` makes the chance in its waits.
    #[must_use]
    pub fn new(flags: Flags, seed: u64, children: Vec<(ChildId, Policy)>) -> Self {
        let mut core = Self {
            flags,
            chance: Chance::new(seed),
            children: Vec::new(),
            restarts: Window::default(),
            losses: Window::default(),
            abandoned: BTreeSet::new(),
            last_generation: 0,
            started: false,
            ending: None,
            ended: false,
            said_all_ready: false,
            orders: VecDeque::new(),
        };
        core.take_in(children);
        core
    }

    /// The same supervisor in its next life, with these children. It has forgotten everything but which lives of theirs were
    /// before, which of those have not let go, and who was released since.
    #[must_use]
    pub fn renewed(&self, children: Vec<(ChildId, Policy)>) -> Self {
        let mut core = Self::new(self.flags, self.chance.seed(), Vec::new());
        core.last_generation = self.last_generation;
        core.abandoned.clone_from(&self.abandoned);
        core.take_in(children);
        for child in &mut core.children {
            child.renew(self.children.iter().find(|former| former.id == child.id));
        }
        core
    }

    fn take_in(&mut self, children: Vec<(ChildId, Policy)>) {
        let before = self.last_generation;
        self.children = children.into_iter().map(|(id, policy)| Child::new(id, policy, before)).collect();
    }

    /// Takes an event. Then drain [`poll`](Self::poll).
    pub fn handle(&mut self, now: Time, input: Input) {
        if self.ended {
            return self.hear_after_the_end(&input);
        }
        match input {
            Input::Started => self.start(),
            Input::StopOrdered => self.end(now, Reason::Shutdown),
            Input::Released(id) => self.released(id),
            Input::BecameReady(id, generation) => self.became_ready(now, id, generation),
            Input::Hung(id, generation, reason) => {
                if let Some(index) = self.alive(id, generation) {
                    self.abandon(now, index, reason);
                }
            }
            Input::Ended(id, generation, reason) => match self.alive(id, generation) {
                Some(index) => self.child_ended(now, index, reason),
                // Perhaps one whose life was taken: it has let go at last.
                None => _ = self.abandoned.remove(&(id, generation)),
            },
            Input::Reprieved(id, generation, until) => return self.reprieve(id, generation, until),
            Input::TimePassed => {}
            Input::AddChild(id, policy) => self.add(id, policy),
            Input::TerminateChild(id) => self.terminate(now, id),
            Input::RestartChild(id) => self.restart_terminated(id),
            Input::DeleteChild(id) => self.delete(id),
        }
        self.expire(now);
        self.reconcile(now);
    }

    /// The next order, oldest first.
    pub fn poll(&mut self) -> Option<Order> {
        self.orders.pop_front()
    }

    /// When [`Input::TimePassed`] is due.
    #[must_use]
    pub fn next_wake(&self) -> Option<Time> {
        self.children.iter().filter_map(|child| child.state.deadline()).min()
    }

    /// The children, in the order of their start.
    pub fn children(&self) -> impl Iterator<Item = ChildId> + '_ {
        self.children.iter().map(|child| child.id)
    }

    /// What is known of a child.
    #[must_use]
    pub fn child(&self, id: ChildId) -> Option<ChildView> {
        let abandoned = self.abandoned.iter().filter(|(child, _)| *child == id).count();
        Some(self.children[self.position(id)?].view(abandoned))
    }

    /// How it treats its children.
    #[must_use]
    pub const fn flags(&self) -> &Flags {
        &self.flags
    }

    /// Restarts in the window that ends now.
    #[must_use]
    pub fn restarts_in_window(&self, now: Time) -> usize {
        self.restarts.count(now, self.flags.intensity.window)
    }

    /// Lives that were taken and have not let go.
    #[must_use]
    pub fn abandoned(&self) -> usize {
        self.abandoned.len()
    }

    /// Whether it stops its children, or has.
    #[must_use]
    pub const fn is_ending(&self) -> bool {
        self.ending.is_some()
    }

    /// Whether it has said its last word.
    #[must_use]
    pub const fn has_ended(&self) -> bool {
        self.ended
    }

    fn position(&self, id: ChildId) -> Option<usize> {
        self.children.iter().position(|child| child.id == id)
    }

    /// Where this life is among the children, if it has not ended.
    fn alive(&self, id: ChildId, generation: Generation) -> Option<usize> {
        let index = self.position(id)?;
        let child = &self.children[index];
        (child.generation == generation && child.state.is_alive()).then_some(index)
    }

    fn start(&mut self) {
        if !std::mem::replace(&mut self.started, true) && self.ending.is_none() {
            self.children.iter_mut().for_each(|child| child.wanted = true);
        }
    }

    fn released(&mut self, id: ChildId) {
        if let Some(index) = self.position(id) {
            self.children[index].released = true;
        }
    }

    fn became_ready(&mut self, now: Time, id: ChildId, generation: Generation) {
        if let Some(index) = self.alive(id, generation)
            && let ChildState::Starting(_) = self.children[index].state
        {
            self.children[index].enter(ChildState::Ready, now);
            self.children[index].ready_since = now;
            self.children[index].can_start();
            self.orders.push_back(Order::Ready(id));
        }
    }

    fn reprieve(&mut self, id: ChildId, generation: Generation, until: Time) {
        let Some(index) = self.alive(id, generation) else { return };
        match &mut self.children[index].state {
            ChildState::Starting(deadline) | ChildState::Stopping(deadline) => {
                *deadline = until.max(*deadline);
            }
            ChildState::Down | ChildState::BackingOff(_) | ChildState::Ready => {}
        }
    }

    /// Lets every wait end whose time is over.
    fn expire(&mut self, now: Time) {
        let over = |child: &Child| child.state.deadline().is_some_and(|deadline| deadline <= now);
        // Ends: what is done with a child takes it out of the state whose time was over.
        while let Some(index) = self.children.iter().position(over) {
            match self.children[index].state {
                ChildState::Starting(_) => self.abandon(now, index, Reason::StartTimeout),
                ChildState::Stopping(_) => self.abandon(now, index, Reason::Killed),
                ChildState::BackingOff(_) | ChildState::Down | ChildState::Ready => {
                    self.children[index].enter(ChildState::Down, now);
                }
            }
        }
    }
}
