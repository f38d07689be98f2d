//! NDL, the Node Discovery Layer: finds nodes and watches that they exist.

mod facts;

pub(crate) use facts::MembershipFact;
pub use facts::{LossReason, NodeEvent};

use crate::gncl::LinkFact;

/// What NDL is told.
#[derive(Debug)]
pub(crate) enum Event {
    /// By GNCL: a connection came, broke, or cannot be made again.
    Link(LinkFact),
}
