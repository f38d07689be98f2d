//! Applications in processes of their own: the same code as in a thread, killed in every way, and its node none the worse.

#[path = "processes/death.rs"]
mod death;
#[path = "processes/fence.rs"]
mod fence;
#[path = "processes/groups.rs"]
mod groups;
#[path = "processes/placement.rs"]
mod placement;
#[path = "processes/scenario.rs"]
mod scenario;
#[path = "processes/stalls.rs"]
mod stalls;
#[path = "processes/trees.rs"]
mod trees;
