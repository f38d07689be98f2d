//! The declaration of a supervisor and of its children.

use std::sync::Arc;

use crate::{
    supervision::{
        Place, ReadyGate, RunningActor,
        core::{ChildId, Flags, Policy},
    },
    tid::Tid,
};

/// Creates an instance of a child, on the child's thread. A panic in it is a failed start.
pub type Launch = Arc<dyn Fn(ReadyGate) -> Box<dyn RunningActor> + Send + Sync>;

/// One child of a supervisor.
pub struct ChildSpec {
    /// The ID of the child in its node.
    pub id: ChildId,
    /// The name of the child, for people.
    pub name: String,
    /// The address of the child, if it has one; for people, too.
    pub tid: Option<Tid>,
    /// The supervision policy of the child.
    pub policy: Policy,
    /// The place of the child.
    pub place: Place,
    /// The function that creates the child.
    pub launch: Launch,
}

/// The declaration of a supervisor.
pub struct SupervisorPlan {
    /// The ID of the supervisor in its node.
    pub id: ChildId,
    /// The name of the supervisor, for people.
    pub name: String,
    /// The policy for its children as a group.
    pub flags: Flags,
    /// Its children, in the order of their start.
    pub children: Vec<PlannedChild>,
}

/// The declaration of a child.
pub enum PlannedChild {
    /// An actor.
    Worker(ChildSpec),
    /// A supervisor, and its parent's policy for it; its deadlines are those of its children.
    Supervisor(SupervisorPlan, Policy),
}
