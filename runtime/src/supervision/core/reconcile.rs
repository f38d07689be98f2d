//! Brings the children nearer to what is wanted.

use super::{Child, ChildState, Core, Order, Strategy};
use crate::time::Time;

impl Core {
    /// Brings the children nearer to what is wanted: stops first, then starts.
    pub(super) fn reconcile(&mut self, now: Time) {
        if self.stop_the_last_unwanted(now) {
            return;
        }
        if let Some(why) = self.ending.clone() {
            self.ended = true;
            self.orders.push_back(Order::Ended(why));
            return;
        }
        self.start_in_order(now);
        let settled =
            |child: &Child| !child.wanted || child.state == ChildState::Ready || child.waits_for_release();
        if !self.said_all_ready && self.children.iter().any(|c| c.wanted) && self.children.iter().all(settled)
        {
            self.said_all_ready = true;
            self.orders.push_back(Order::AllReady);
        }
    }

    /// Stops one child at a time, last first. Returns whether one is still alive that should not be.
    fn stop_the_last_unwanted(&mut self, now: Time) -> bool {
        let unwanted = |child: &Child| child.state.is_alive() && (child.stale || !child.wanted);
        let Some(index) = self.children.iter().rposition(unwanted) else {
            // Stale children whose life ended are replaced by their next start.
            self.children.iter_mut().for_each(|child| child.stale = false);
            return false;
        };
        let child = &mut self.children[index];
        if !matches!(child.state, ChildState::Stopping(_)) {
            child.state = ChildState::Stopping(now + child.policy.stop_within);
            self.orders.push_back(Order::Stop(child.id, child.generation));
        }
        true
    }

    /// Starts whom it can: in order where the strategy ties children to those before them, else all at once.
    fn start_in_order(&mut self, now: Time) {
        let ordered = self.strategy != Strategy::OneForOne;
        for index in 0..self.children.len() {
            let child = &mut self.children[index];
            if child.wanted && child.state == ChildState::Down && !child.waits_for_release() {
                child.generation += 1;
                child.state = ChildState::Starting(now + child.policy.start_within);
                self.orders.push_back(Order::Spawn(child.id, child.generation));
            }
            if ordered && child.wanted && child.state != ChildState::Ready {
                return;
            }
        }
    }
}
