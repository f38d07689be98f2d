//! Observers of restarts in this process: nodes that record.

use std::sync::Arc;

use crate::{observers::Observers, tid::Tid};

/// A restart of an actor or of a supervisor that is a child.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ActorRestart<'a> {
    /// The name of the child.
    pub name: &'a str,
    /// The name of its supervisor.
    pub supervisor: &'a str,
    /// The address of the child, if it is an application.
    pub tid: Option<Tid>,
    /// The number of its restarts, with this one.
    pub restarts: u64,
    /// How its last incarnation ended.
    pub why: &'a str,
}

/// An observer of restarts. It is called on the supervisor's thread, so it must not wait.
pub trait RestartObserver: Send + Sync {
    /// Receives a restart, before the new incarnation starts.
    fn restarted(&self, restart: &ActorRestart<'_>);
}

static OBSERVERS: Observers<dyn RestartObserver> = Observers::new();

/// Adds an observer for as long as it lives. Returns `false` if there are too many.
pub fn observe_restarts(observer: &Arc<dyn RestartObserver>) -> bool {
    OBSERVERS.add(observer, None)
}

/// Shows a restart to all observers.
pub(super) fn show(restart: &ActorRestart<'_>) {
    OBSERVERS.each(|observer| observer.restarted(restart));
}
