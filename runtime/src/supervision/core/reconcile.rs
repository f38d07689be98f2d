//! Moves the children towards their wanted states: stops, then starts.

use super::{Child, ChildState, Core, Order};
use crate::time::Time;

impl Core {
    pub(super) fn reconcile(&mut self, now: Time) {
        if self.stop_the_unwanted(now) {
            return;
        }
        if let Some(why) = self.ending.clone() {
            self.ended = true;
            self.orders.push_back(Order::Ended(why));
            return;
        }
        if !self.started {
            return;
        }
        self.start_in_order(now);
        let settled = |child: &Child| !child.wanted || child.state == ChildState::Ready;
        if !self.reported_all_ready && self.children.iter().all(settled) {
            self.reported_all_ready = true;
            self.orders.push_back(Order::AllReady);
        }
    }

    /// Stops unwanted children. Returns whether no child may be started until they have ended.
    fn stop_the_unwanted(&mut self, now: Time) -> bool {
        if self.flags.strategy.is_ordered() || self.ending.is_some() {
            return self.stop_the_last_unwanted(now);
        }
        // The children are independent: a slow stop of one does not delay the others.
        for index in (0..self.children.len()).rev() {
            if self.children[index].is_unwanted() {
                self.stop(index, now);
            }
        }
        false
    }

    /// Stops one child at a time, last first.
    fn stop_the_last_unwanted(&mut self, now: Time) -> bool {
        let last = self.children.iter().rposition(Child::is_unwanted);
        if let Some(index) = last {
            self.stop(index, now);
        }
        last.is_some()
    }

    fn stop(&mut self, index: usize, now: Time) {
        let child = &mut self.children[index];
        if !matches!(child.state, ChildState::Stopping(_)) {
            child.enter(ChildState::Stopping(now + child.policy.stop_within), now);
            self.orders.push_back(Order::Stop(child.id, child.generation));
        }
    }

    /// Starts children: in order if the strategy ties them to those before them, otherwise all at once.
    fn start_in_order(&mut self, now: Time) {
        let ordered = self.flags.strategy.is_ordered();
        for child in &mut self.children {
            if child.wanted && child.state == ChildState::Down && !child.waits_for_release() {
                child.generation += 1;
                child.starts += 1;
                child.enter(ChildState::Starting(now + child.policy.start_within), now);
                self.last_generation = self.last_generation.max(child.generation);
                self.orders.push_back(Order::Spawn(child.id, child.generation));
            }
            if ordered && child.wanted && child.state != ChildState::Ready {
                return;
            }
        }
    }
}

impl Child {
    /// Returns whether the child is alive and should not be, or has a stale incarnation.
    fn is_unwanted(&self) -> bool {
        self.state.is_alive() && (self.stale || !self.wanted)
    }
}
