//! The root of a node: starts its layers in order, then its applications, and stops all of it again.
//!
//! ```text
//! root thread   Root (actix actor)
//!                 |- layers: rest-for-one   LNCL, sync manager, GNCL, NDL   (the paper's order)
//!                 `- applications: one-for-one, each held until its requirements are ready
//!                      |- supervisors that the user declares, with applications and supervisors below them
//!                      `- applications
//! ```
//!
//! The stop runs backwards: applications are notified first and can bring their outputs to a safe value, then
//! the layers stop.

mod apps;
pub mod audit;
mod audits;
mod builder;
mod commands;
mod directory;
mod down_policies;
#[cfg(feature = "fault-points")]
mod faults;
mod handle;
pub mod inspect;
mod kept_parameters;
mod layers;
mod log_ring;
#[cfg(test)]
mod log_tests;
mod node;
mod play_check;
mod process;
mod progress;
mod real_time;
mod recording;
mod reply_waiters;
mod root;
mod security_setup;
mod shutdown;
pub mod signals;
#[cfg(test)]
mod standstill_tests;
mod state;
mod stop;
mod supervisor_spec;
mod systemd;
mod thread_placement;
mod traffic;
mod tree;
mod types;

/// Doors for fuzzers.
#[cfg(feature = "fuzzing")]
#[doc(hidden)]
pub mod fuzzing {
    pub use crate::{audit::fuzzing as audit, process::fuzzing as process, types::fuzzing as types};
}

pub use audits::AuditError;
pub use builder::{NodeBuilder, StartError};
pub use commands::CommandError;
#[cfg(feature = "fault-points")]
pub(crate) use faults::arm_alone;
pub use handle::NodeHandle;
pub(crate) use handle::OrderStatus;
pub use node::{Node, NodeEnd};
pub(crate) use progress::Stalls;
pub(crate) use root::{RootEvent, WAITS_MAX};
pub use sinew_lncl::RegisterError;
pub use sinew_runtime::mailbox::MessageAges;
pub use sinew_security::{
    access::{AccessError, AccessSummary},
    node_security::{DenyListError, DenyListSummary},
};
pub use sinew_session::outlet::OutletCounts;
pub(crate) use state::NodeState;
pub use supervisor_spec::SupervisorSpec;
pub use traffic::Traffic;
pub use tree::{LifeState, MailboxState, Supervised, Supervises, SupervisionTree};
