//! Applications in processes of their own: the same code as in a thread, killed in every way, and its node none the worse.

mod death;
mod fence;
mod groups;
mod placement;
mod scenario;
mod stalls;
mod trees;
mod undelivered;
