//! Commands that add, terminate, restart and delete children at run time, with OTP's semantics. Each command
//! has one reply.

use super::{Child, ChildCommandError, ChildId, ChildState, Command, Core, Input, Order, Policy, Reason};
use crate::time::Time;

impl Core {
    pub(super) fn add(&mut self, id: ChildId, policy: Policy) {
        if self.ending.is_some() {
            return self.refuse(Command::Add, id, ChildCommandError::Ending);
        }
        if self.position(id).is_some() {
            return self.refuse(Command::Add, id, ChildCommandError::Present);
        }
        let mut child = Child::new(id, policy, 0);
        child.wanted = self.started;
        self.children.push(child);
        self.reported_all_ready = false;
        self.orders.push_back(Order::Done(Command::Add, id));
    }

    pub(super) fn terminate(&mut self, now: Time, id: ChildId) {
        let Some(index) = self.commanded(Command::Terminate, id) else { return };
        let child = &mut self.children[index];
        child.terminations += 1;
        if child.state.is_alive() {
            // The reply follows when it has stopped. A failure of its group before that starts it again.
            child.wanted = false;
            return;
        }
        let was_wanted = std::mem::replace(&mut child.wanted, false);
        child.enter(ChildState::Down, now);
        if was_wanted {
            child.last_reason = Some(Reason::Shutdown);
            self.orders.push_back(Order::Gone(id, Reason::Shutdown));
        }
        let terminations = std::mem::take(&mut self.children[index].terminations);
        if self.children[index].is_temporary() {
            self.forget(index);
        }
        self.answer_terminations(id, terminations);
    }

    pub(super) fn restart_terminated(&mut self, id: ChildId) {
        let Some(index) = self.commanded(Command::Restart, id) else { return };
        match self.why_not_terminated(index) {
            Some(refusal) => self.refuse(Command::Restart, id, refusal),
            None => {
                self.children[index].wanted = true;
                self.reported_all_ready = false;
                self.orders.push_back(Order::Done(Command::Restart, id));
            }
        }
    }

    pub(super) fn delete(&mut self, id: ChildId) {
        let Some(index) = self.commanded(Command::Delete, id) else { return };
        match self.why_not_terminated(index) {
            Some(refusal) => self.refuse(Command::Delete, id, refusal),
            None => {
                self.forget(index);
                self.orders.push_back(Order::Done(Command::Delete, id));
            }
        }
    }

    /// Returns the index of the command's child; refuses a command for an unknown one.
    fn commanded(&mut self, command: Command, id: ChildId) -> Option<usize> {
        if self.ending.is_some() {
            self.refuse(command, id, ChildCommandError::Ending);
            return None;
        }
        let index = self.position(id);
        if index.is_none() {
            self.refuse(command, id, ChildCommandError::Unknown);
        }
        index
    }

    fn why_not_terminated(&self, index: usize) -> Option<ChildCommandError> {
        let child = &self.children[index];
        match child.state {
            ChildState::BackingOff(_) => Some(ChildCommandError::Restarting),
            ChildState::Down if !child.wanted => None,
            ChildState::Down | ChildState::Starting(_) | ChildState::Ready | ChildState::Stopping(_) => {
                Some(ChildCommandError::Running)
            }
        }
    }

    pub(super) fn forget(&mut self, index: usize) {
        let child = self.children.remove(index);
        self.orders.push_back(Order::Deleted(child.id));
    }

    pub(super) fn answer_terminations(&mut self, id: ChildId, how_many: u32) {
        let answers = (0..how_many).map(|_| Order::Done(Command::Terminate, id));
        self.orders.extend(answers);
    }

    fn refuse(&mut self, command: Command, id: ChildId, refusal: ChildCommandError) {
        self.orders.push_back(Order::Refused(command, id, refusal));
    }

    /// Handles an input after the end: a command is too late, and a release is kept for the next incarnation.
    pub(super) fn handle_after_end(&mut self, input: &Input) {
        if let Input::Released(id) = input {
            self.released(*id);
        }
        if let Some((command, id)) = input.command() {
            self.refuse(command, id, ChildCommandError::Ending);
        }
    }
}
