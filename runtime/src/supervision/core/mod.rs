//! The decisions of a supervisor, as a pure state machine: (history, now, event) to orders.
//!
//! It follows Erlang/OTP's vocabulary and rules (stdlib, module `supervisor`): restart types, strategies,
//! restart intensity over a window, ordered start, stop in reverse order, significant children, children
//! added and removed at run time. These are additions: readiness (a child is started when those before it are
//! Ready), a deadline on every wait, and exponential back-off with jitter; held children that wait for a
//! release; a bound on abandoned incarnations that have not ended. The `simple` form of one-for-one is left
//! out.
//!
//! After every [`handle`](Core::handle) the shell drains [`poll`](Core::poll), then sleeps until
//! [`next_wake`](Core::next_wake). Every event carries the generation of its child; an event of an earlier
//! generation is ignored.
//!
//! | file | content |
//! | --- | --- |
//! | `policy` | supervision policies |
//! | `event` | inputs and orders |
//! | `child` | the state of one child |
//! | `restart` | the decisions after the end of a child |
//! | `commands` | children added, terminated, restarted, deleted |
//! | `reconcile` | stops and starts, in order |
//! | `tree` | supervisors in supervisors |

mod child;
mod commands;
mod event;
mod id;
mod policy;
mod reason;
mod reconcile;
mod restart;
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
pub use event::{ChildCommandError, Command, Input, Order};
pub use id::{ChildId, ChildIds, Generation};
pub use policy::{AutoShutdown, Flags, Intensity, Policy, Restart, StartRetry, Strategy};
pub use reason::Reason;
pub use tree::{BranchView, Plan, Planned, Tree};
use window::{Chance, Window};

use crate::time::Time;

/// The state of a supervisor; see the [module](self).
#[derive(Debug)]
pub struct Core {
    flags: Flags,
    chance: Chance,
    children: Vec<Child>,
    restarts: Window,
    /// Restarts of children that lost their thread.
    losses: Window,
    /// Abandoned incarnations that have not ended yet.
    abandoned: BTreeSet<(ChildId, Generation)>,
    /// The highest generation of any child so far.
    last_generation: Generation,
    started: bool,
    /// Set once the children must end.
    ending: Option<Reason>,
    ended: bool,
    reported_all_ready: bool,
    orders: VecDeque<Order>,
}

impl Core {
    /// Creates a supervisor of these children, in the order of their start. `seed` seeds the jitter of its waits.
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
            reported_all_ready: false,
            orders: VecDeque::new(),
        };
        core.set_children(children);
        core
    }

    /// Creates the next incarnation of this supervisor, with these children. It keeps only the generations of
    /// its children, their abandoned incarnations that have not ended, and the releases since.
    #[must_use]
    pub fn renewed(&self, children: Vec<(ChildId, Policy)>) -> Self {
        let mut core = Self::new(self.flags, self.chance.seed(), Vec::new());
        core.last_generation = self.last_generation;
        core.abandoned.clone_from(&self.abandoned);
        core.set_children(children);
        for child in &mut core.children {
            child.renew(self.children.iter().find(|former| former.id == child.id));
        }
        core
    }

    fn set_children(&mut self, children: Vec<(ChildId, Policy)>) {
        let before = self.last_generation;
        self.children = children.into_iter().map(|(id, policy)| Child::new(id, policy, before)).collect();
    }

    /// Handles an event. Call [`poll`](Self::poll) afterwards until it returns `None`.
    pub fn handle(&mut self, now: Time, input: Input) {
        if self.ended {
            return self.handle_after_end(&input);
        }
        match input {
            Input::Started => self.start(),
            Input::StopOrdered => self.end(now, Reason::Shutdown),
            Input::Released(id) => self.released(id),
            Input::BecameReady(id, generation) => self.became_ready(now, id, generation),
            Input::Hung(id, generation, reason) => {
                if let Some(index) = self.live_index(id, generation) {
                    self.abandon(now, index, reason);
                }
            }
            Input::Ended(id, generation, reason) => match self.live_index(id, generation) {
                Some(index) => self.child_ended(now, index, reason),
                // Perhaps an abandoned incarnation, which has ended now.
                None => _ = self.abandoned.remove(&(id, generation)),
            },
            Input::DeadlineExtended(id, generation, until) => {
                return self.extend_deadline(id, generation, until);
            }
            Input::TimePassed => {}
            Input::AddChild(id, policy) => self.add(id, policy),
            Input::TerminateChild(id) => self.terminate(now, id),
            Input::RestartChild(id) => self.restart_terminated(id),
            Input::DeleteChild(id) => self.delete(id),
        }
        self.expire(now);
        self.reconcile(now);
    }

    /// Returns the next order, oldest first.
    pub fn poll(&mut self) -> Option<Order> {
        self.orders.pop_front()
    }

    /// Returns when [`Input::TimePassed`] is due.
    #[must_use]
    pub fn next_wake(&self) -> Option<Time> {
        self.children.iter().filter_map(|child| child.state.deadline()).min()
    }

    /// Returns the children, in the order of their start.
    pub fn children(&self) -> impl Iterator<Item = ChildId> + '_ {
        self.children.iter().map(|child| child.id)
    }

    /// Returns the state of a child.
    #[must_use]
    pub fn child(&self, id: ChildId) -> Option<ChildView> {
        let abandoned = self.abandoned.iter().filter(|(child, _)| *child == id).count();
        Some(self.children[self.position(id)?].view(abandoned))
    }

    /// Returns the policy for its children as a group.
    #[must_use]
    pub const fn flags(&self) -> &Flags {
        &self.flags
    }

    /// Returns the number of restarts in the window that ends now.
    #[must_use]
    pub fn restarts_in_window(&self, now: Time) -> usize {
        self.restarts.count(now, self.flags.intensity.window)
    }

    /// Returns the number of abandoned incarnations that have not ended.
    #[must_use]
    pub fn abandoned(&self) -> usize {
        self.abandoned.len()
    }

    /// Returns whether the supervisor stops its children, or has stopped them.
    #[must_use]
    pub const fn is_ending(&self) -> bool {
        self.ending.is_some()
    }

    /// Returns whether the supervisor has emitted its last order.
    #[must_use]
    pub const fn has_ended(&self) -> bool {
        self.ended
    }

    fn position(&self, id: ChildId) -> Option<usize> {
        self.children.iter().position(|child| child.id == id)
    }

    /// Returns the index of the child with this incarnation, if that has not ended.
    fn live_index(&self, id: ChildId, generation: Generation) -> Option<usize> {
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
        if let Some(index) = self.live_index(id, generation)
            && let ChildState::Starting(_) = self.children[index].state
        {
            self.children[index].enter(ChildState::Ready, now);
            self.children[index].ready_since = now;
            self.children[index].can_start();
            self.orders.push_back(Order::Ready(id));
        }
    }

    fn extend_deadline(&mut self, id: ChildId, generation: Generation, until: Time) {
        let Some(index) = self.live_index(id, generation) else { return };
        match &mut self.children[index].state {
            ChildState::Starting(deadline) | ChildState::Stopping(deadline) => {
                *deadline = until.max(*deadline);
            }
            ChildState::Down | ChildState::BackingOff(_) | ChildState::Ready => {}
        }
    }

    /// Handles all deadlines that have passed.
    fn expire(&mut self, now: Time) {
        let over = |child: &Child| child.state.deadline().is_some_and(|deadline| deadline <= now);
        // Terminates: each step moves the late child out of its state.
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
