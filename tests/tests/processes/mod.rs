//! Applications in processes of their own: the same code as in a thread, killed in every way, without harm to
//! their node.

mod commands;
mod death;
mod fence;
mod groups;
mod layers;
mod missing_calls;
mod placement;
mod scenario;
mod stalls;
mod trees;
mod undelivered;
