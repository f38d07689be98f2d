//! What one drive does: torque law, admission of inputs, limits, safe state, and the state machine of it all.

pub mod admission;
pub mod drive;
pub mod faults;
pub mod ramp;
pub mod torque_law;
