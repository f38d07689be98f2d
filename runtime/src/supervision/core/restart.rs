//! What follows when a child has ended: nothing, a restart, or the end of all.

use super::{ChildState, Core, Intensity, Order, Reason, Restart, Strategy};
use crate::time::Time;

impl Core {
    pub(super) fn child_ended(&mut self, now: Time, index: usize, reason: Reason) {
        let child = &mut self.children[index];
        let id = child.id;
        let was_asked_to = matches!(child.state, ChildState::Stopping(_));
        child.state = ChildState::Down;
        child.released = false;
        self.said_all_ready = false;
        if was_asked_to {
            self.orders.push_back(Order::Failed(id, Reason::Shutdown));
            return;
        }
        let again = match child.policy.restart {
            Restart::Permanent => true,
            Restart::Transient => reason.is_failure(),
            Restart::Temporary => false,
        };
        if !again || !child.wanted {
            child.wanted = false;
            self.orders.push_back(Order::Gone(id, reason));
            return;
        }
        self.orders.push_back(Order::Failed(id, reason.clone()));
        self.restart(now, index, &reason);
    }

    fn restart(&mut self, now: Time, index: usize, reason: &Reason) {
        self.restarts.push_back(now);
        while self.restarts.front().is_some_and(|at| now.since(*at) > self.intensity.window) {
            self.restarts.pop_front();
        }
        if self.restarts.len() > self.intensity.restarts_max {
            let Intensity { restarts_max, window } = self.intensity;
            self.end(Reason::GaveUp(format!(
                "more than {restarts_max} restarts in {} s; the last child to fail {reason}",
                window.as_secs_f32()
            )));
            return;
        }
        let wait = self.children[index].next_backoff(now, self.intensity.window);
        self.children[index].state = ChildState::BackingOff(now + wait);
        self.children[index].restarts += 1;
        let others = match self.strategy {
            Strategy::OneForOne => 0..0,
            Strategy::RestForOne => index + 1..self.children.len(),
            Strategy::OneForAll => 0..self.children.len(),
        };
        for other in others.filter(|other| *other != index) {
            self.children[other].stale = self.children[other].state.is_alive();
        }
    }

    pub(super) fn end(&mut self, why: Reason) {
        self.ending.get_or_insert(why);
        self.children.iter_mut().for_each(|child| child.wanted = false);
    }
}
