//! The decisions after the end of a child: nothing, a restart, or the end of all children.

use super::{AutoShutdown, ChildState, Core, Intensity, Order, Reason, Restart, Strategy};
use crate::time::Time;

impl Core {
    /// Abandons a child that does not respond. If more incarnations are abandoned than allowed, the
    /// supervisor gives up.
    pub(super) fn abandon(&mut self, now: Time, index: usize, reason: Reason) {
        let (id, generation) = (self.children[index].id, self.children[index].generation);
        self.orders.push_back(Order::Abandon(id, generation));
        self.abandoned.insert((id, generation));
        self.child_ended(now, index, reason);
        let (count, max) = (self.abandoned.len(), self.flags.abandoned_max);
        if count > max {
            let why =
                format!("{count} abandoned incarnations have not let go of their threads; at most {max} may");
            self.end(now, Reason::GaveUp(why));
        }
    }

    pub(super) fn child_ended(&mut self, now: Time, index: usize, reason: Reason) {
        let child = &mut self.children[index];
        let was_to_end = child.stale || !child.wanted || matches!(child.state, ChildState::Stopping(_));
        child.note_start(now, &reason);
        child.enter(ChildState::Down, now);
        child.released = false;
        child.stale = false;
        // A child that was ordered to stop ends in order: that was not its own decision.
        let is_order = was_to_end && reason == Reason::Normal;
        child.last_reason = Some(if is_order { Reason::Shutdown } else { reason.clone() });
        self.reported_all_ready = false;
        if was_to_end {
            self.ended_as_ordered(index, reason);
        } else {
            self.ended_by_itself(now, index, reason);
        }
    }

    /// Handles an end that was ordered by a command, with the child's group, or with all children.
    fn ended_as_ordered(&mut self, index: usize, reason: Reason) {
        let child = &mut self.children[index];
        let (id, terminations) = (child.id, std::mem::take(&mut child.terminations));
        let (wanted, forget) = (child.wanted, child.is_temporary() && self.ending.is_none());
        let reason = if reason == Reason::Normal { Reason::Shutdown } else { reason };
        if wanted || self.ending.is_some() {
            self.orders.push_back(Order::Failed(id, reason));
        } else {
            self.orders.push_back(Order::Gone(id, reason));
        }
        if forget {
            self.forget(index);
        }
        self.answer_terminations(id, terminations);
    }

    fn ended_by_itself(&mut self, now: Time, index: usize, reason: Reason) {
        let child = &mut self.children[index];
        if let Reason::RequirementLost(_) = reason {
            // The child waits for its release again, with any restart type: it did not fail, and has not finished.
            self.orders.push_back(Order::Failed(child.id, reason));
            return;
        }
        let again = match child.policy.restart {
            Restart::Permanent => true,
            Restart::Transient => reason.is_failure(),
            Restart::Temporary => false,
        };
        if again {
            self.orders.push_back(Order::Failed(child.id, reason.clone()));
            self.restart(now, index, &reason);
            return;
        }
        child.wanted = false;
        let (significant, forget) = (child.policy.significant, child.is_temporary());
        self.orders.push_back(Order::Gone(child.id, reason));
        if forget {
            self.forget(index);
        }
        if significant {
            self.significant_ended(now);
        }
    }

    /// Ends all children if the end of a significant child requires it.
    fn significant_ended(&mut self, now: Time) {
        let ends = match self.flags.auto_shutdown {
            AutoShutdown::Never => false,
            AutoShutdown::AnySignificant => true,
            AutoShutdown::AllSignificant => {
                let works = |child: &super::Child| child.policy.significant && child.wanted;
                !self.children.iter().any(works)
            }
        };
        if ends {
            self.end(now, Reason::Shutdown);
        }
    }

    fn restart(&mut self, now: Time, index: usize, reason: &Reason) {
        if let Some(wait) = self.children[index].start_retry(now) {
            // The start failed before another child depended on it, so neither the restart intensity nor its
            // group is affected.
            let wait = self.chance.jitter(wait);
            self.children[index].enter(ChildState::BackingOff(now + wait), now);
            return;
        }
        let Intensity { restarts_max, losses_max, window } = self.flags.intensity;
        let lost_its_thread = *reason == Reason::ThreadEnded;
        let (counted, max, what) = match lost_its_thread {
            true => (&mut self.losses, losses_max, "lost threads"),
            false => (&mut self.restarts, restarts_max, "restarts"),
        };
        if counted.add(now, max, window) {
            let (seconds, id) = (window.as_secs_f32(), self.children[index].id);
            let why = format!("more than {max} {what} in {seconds} s, the last by {id}, which {reason}");
            self.end(now, Reason::GaveUp(why));
            return;
        }
        let wait = self.children[index].next_backoff(now, window);
        let wait = self.chance.jitter(wait);
        self.children[index].enter(ChildState::BackingOff(now + wait), now);
        self.restart_group_of(index);
    }

    /// Restarts the group of a restarted child: its members are stopped, then started in order. As in OTP,
    /// the group includes terminated children and excludes temporary ones.
    fn restart_group_of(&mut self, index: usize) {
        let others = match self.flags.strategy {
            Strategy::OneForOne => return,
            Strategy::RestForOne => index + 1..self.children.len(),
            Strategy::OneForAll => 0..self.children.len(),
        };
        for other in others.filter(|other| *other != index) {
            let child = &mut self.children[other];
            child.stale = child.state.is_alive();
            // A temporary child is finished when its group is stopped, unless it still waits for its first start.
            child.wanted = if child.is_temporary() { child.wanted && !child.stale } else { true };
        }
    }

    /// Ends all children. The first reason is kept.
    pub(super) fn end(&mut self, now: Time, why: Reason) {
        self.ending.get_or_insert(why);
        for child in &mut self.children {
            child.wanted = false;
            if let ChildState::BackingOff(_) = child.state {
                child.enter(ChildState::Down, now);
            }
        }
    }
}
