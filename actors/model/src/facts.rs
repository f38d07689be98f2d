//! What the layers tell each other: of applications, of connections, of nodes.

mod app;
mod link;
mod membership;

pub use app::{AppFact, DeclaredTypes, TypeDeclaration, TypeHash, User};
pub use link::LinkFact;
pub use membership::{LossReason, MembershipFact, NodeEvent, Trouble};
