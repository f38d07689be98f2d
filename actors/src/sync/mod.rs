//! The sync manager: nobody starts before what it needs is ready.

mod facts;

pub use facts::{RequirementEvent, Waiting};

use sinew_runtime::wire::Message;

use crate::{gncl::LinkFact, lncl::AppFact, ndl::MembershipFact};

/// What the sync manager is told.
#[derive(Debug)]
pub(crate) enum Event {
    /// By LNCL: an application came, became ready, failed, went.
    App(AppFact),
    /// By NDL: who is there.
    Membership(MembershipFact),
    /// By GNCL: whom messages can reach.
    Link(LinkFact),
    /// A message for the sync manager's TID, from another node's.
    Message(Message),
}

/// Who is known on other nodes, and what waits for whom.
#[derive(Debug, Default)]
pub(crate) struct Core;

impl Core {
    /// The TID of the application called `name`, on any node.
    pub(crate) fn resolve(&self, _name: &str) -> Option<sinew_runtime::tid::Tid> {
        None
    }
}
