//! The functions of one drive: torque law, admission of inputs, limits, safe state, and its state machine.

pub mod admission;
pub mod drive;
pub mod faults;
pub mod ramp;
pub mod torque_law;
