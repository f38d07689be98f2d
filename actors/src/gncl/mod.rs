//! GNCL, the Global Node Communication Layer: moves messages between nodes over TCP, in order.

mod facts;

pub(crate) use facts::LinkFact;

use crate::ndl::MembershipFact;

/// What GNCL is told.
#[derive(Debug)]
pub(crate) enum Event {
    /// By NDL: who is there.
    Membership(MembershipFact),
}
