//! One child of a supervisor, as its shell holds it.

use super::{ChildSpec, ChildState, DropQueue, actor_handle::ActorHandle, watchdog::DeadlineExtension};
use crate::time::Time;

/// The declaration of a child, and the handle of its current incarnation.
pub(super) struct Child {
    pub(super) spec: ChildSpec,
    pub(super) handle: Option<ActorHandle>,
    /// The extension of its deadline to start or to stop.
    pub(super) extension: Option<DeadlineExtension>,
    /// Whether the end of this incarnation is not reported yet.
    pub(super) has_unreported_end: bool,
    /// The logged reason why it could not start, until it starts.
    pub(super) cannot_start: Option<String>,
}

impl Child {
    pub(super) const fn new(spec: ChildSpec) -> Self {
        Self { spec, handle: None, extension: None, has_unreported_end: false, cannot_start: None }
    }

    /// Drops the factory, which is user code and must not be dropped on this thread. Returns the handle of
    /// its incarnation, if there is one.
    pub(super) fn discard(self, drop_queue: &DropQueue) -> Option<ActorHandle> {
        drop_queue.push(self.spec.name, self.spec.launch);
        self.handle
    }

    /// Returns the extended deadline, if the current one has passed.
    pub(super) fn extended_deadline(&mut self, state: ChildState, now: Time) -> Option<Time> {
        let liveness = self.handle.as_ref()?.liveness();
        let (deadline, is_done) = match state {
            ChildState::Starting(deadline) => (deadline, liveness.is_ready() || liveness.is_ending()),
            ChildState::Stopping(deadline) => (deadline, liveness.is_ending()),
            ChildState::Down | ChildState::BackingOff(_) | ChildState::Ready => return None,
        };
        let is_over = deadline <= now;
        self.extension.as_mut().filter(|_| is_over)?.until(deadline, now, is_done)
    }
}
