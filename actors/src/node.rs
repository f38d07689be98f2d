//! The root of a node: starts its layers in order, then its applications, and stops all of it again.

use sinew_runtime::tid::AppAddress;

/// What the root is told.
#[derive(Debug)]
pub(crate) enum RootEvent {
    /// By the sync manager: all that this application requires is ready.
    Release { app: AppAddress },
    /// By the sync manager: these names require each other in a circle, the first one again at the end. It has logged
    /// so; none of these applications is released.
    RequirementCycle { names: Vec<String> },
}
