//! A powered leg: hip, knee and ankle drives, a central unit, and a plant that simulates person and hardware.
//!
//! Their cores are pure state machines in the package `exoskeleton-model`. The nodes of the robot in [`robot`]
//! wrap these cores as applications; [`exoskeleton_model::lockstep`] runs the same cores in one thread on
//! virtual time.
//!
//! It is a simulation and claims nothing clinical; the software e-stop is not a safety function.

#![warn(clippy::print_stdout, clippy::print_stderr)] // `output` prints: the macros panic if a pipe is closed or a disk is full.

pub mod output;
pub mod report;
pub mod robot;
pub mod run_folder;
