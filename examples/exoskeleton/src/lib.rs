//! A powered leg: hip, knee and ankle drives, a central unit, and a plant that stands for person and hardware.
//!
//! This is the domain half: every core here is a pure state machine. Time comes in as an argument, chance as a seed,
//! and nothing touches a clock, a socket or a thread. The nodes of the robot wrap these cores as applications;
//! [`lockstep`] runs the same cores in one thread on virtual time.
//!
//! It is a simulation and claims nothing clinical; the software e-stop is not a safety function.

#![warn(clippy::print_stdout, clippy::print_stderr)] // `output` prints: the macros panic where a pipe is closed or a disk is full.

pub mod central;
pub mod chance;
pub mod control;
pub mod gait;
pub mod intention;
pub mod joint;
pub mod leg;
pub mod lockstep;
pub mod message;
pub mod metrics;
pub mod output;
pub mod part;
pub mod phase;
pub mod plant;
pub mod plot;
pub mod record;
pub mod report;
pub mod robot;
pub mod run_folder;
pub mod sensor;
