//! The supervisor's decisions, as a pure state machine: (history, now, event) to orders.
//!
//! Erlang/OTP's vocabulary and rules (stdlib, module `supervisor`): restart types, strategies, restart intensity over a
//! window, ordered start, stop in reverse order. Added to them: readiness (a child is started when those before it have
//! said Ready), a deadline on every wait, exponential back-off, and children that are held until they are released.
//!
//! After every [`handle`](Core::handle) the shell drains [`poll`](Core::poll) until nothing is left, then sleeps until
//! [`next_wake`](Core::next_wake). Every event carries the generation of the child that it speaks of; an event of an
//! earlier generation is ignored.

mod child;
mod event;
mod id;
mod policy;
mod reason;
mod reconcile;
mod restart;
#[cfg(test)]
mod tests;

use std::collections::VecDeque;

use child::Child;
pub use child::ChildState;
pub use event::{Input, Order};
pub use id::{ChildId, ChildIds, Generation};
pub use policy::{Intensity, Policy, Restart, Strategy};
pub use reason::Reason;

use crate::time::Time;

/// A supervisor's memory; see the [module](self).
#[derive(Debug)]
pub struct Core {
    strategy: Strategy,
    intensity: Intensity,
    children: Vec<Child>,
    restarts: VecDeque<Time>,
    /// Set once the children are to end.
    ending: Option<Reason>,
    ended: bool,
    said_all_ready: bool,
    orders: VecDeque<Order>,
}

impl Core {
    /// A supervisor of these children, in the order of their start.
    #[must_use]
    pub fn new(strategy: Strategy, intensity: Intensity, children: Vec<(ChildId, Policy)>) -> Self {
        let children = children.into_iter().map(|(id, policy)| Child::new(id, policy)).collect();
        Self {
            strategy,
            intensity,
            children,
            restarts: VecDeque::new(),
            ending: None,
            ended: false,
            said_all_ready: false,
            orders: VecDeque::new(),
        }
    }

    /// Takes an event. Then drain [`poll`](Self::poll).
    pub fn handle(&mut self, now: Time, input: Input) {
        if self.ended {
            return;
        }
        match input {
            Input::Started => self.children.iter_mut().for_each(|child| child.wanted = true),
            Input::StopOrdered => self.end(Reason::Shutdown),
            Input::Released(id) => self.released(id),
            Input::BecameReady(id, generation) => self.became_ready(now, id, generation),
            Input::Hung(id, generation, reason) => {
                if let Some(index) = self.alive(id, generation) {
                    self.orders.push_back(Order::Abandon(id, generation));
                    self.child_ended(now, index, reason);
                }
            }
            Input::Ended(id, generation, reason) => {
                if let Some(index) = self.alive(id, generation) {
                    self.child_ended(now, index, reason);
                }
            }
            Input::TimePassed => {}
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

    /// Where a child is in its life, which life it is, and how often it was restarted.
    #[must_use]
    pub fn child(&self, id: ChildId) -> Option<(ChildState, Generation, u64)> {
        let child = &self.children[self.position(id)?];
        Some((child.state, child.generation, child.restarts))
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

    fn released(&mut self, id: ChildId) {
        if let Some(index) = self.position(id) {
            self.children[index].released = true;
        }
    }

    fn became_ready(&mut self, now: Time, id: ChildId, generation: Generation) {
        if let Some(index) = self.alive(id, generation)
            && let ChildState::Starting(_) = self.children[index].state
        {
            self.children[index].state = ChildState::Ready;
            self.children[index].ready_since = now;
            self.orders.push_back(Order::Ready(id));
        }
    }

    /// Lets every wait end whose time is over.
    fn expire(&mut self, now: Time) {
        for index in 0..self.children.len() {
            let Child { id, state, generation, .. } = self.children[index];
            match state {
                ChildState::BackingOff(at) if at <= now => self.children[index].state = ChildState::Down,
                ChildState::Starting(until) if until <= now => {
                    self.orders.push_back(Order::Abandon(id, generation));
                    self.child_ended(now, index, Reason::StartTimeout);
                }
                ChildState::Stopping(until) if until <= now => {
                    self.orders.push_back(Order::Abandon(id, generation));
                    self.child_ended(now, index, Reason::Killed);
                }
                ChildState::BackingOff(_)
                | ChildState::Starting(_)
                | ChildState::Stopping(_)
                | ChildState::Down
                | ChildState::Ready => {}
            }
        }
    }
}
