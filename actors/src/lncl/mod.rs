//! LNCL, the Local Node Communication Layer: moves messages between the applications of one node, in one process or
//! many.

mod facts;

pub(crate) use facts::AppFact;

/// What LNCL is told.
#[derive(Debug)]
pub(crate) enum Event {}

/// Who is registered on this node.
#[derive(Debug, Default)]
pub(crate) struct Registry;
