//! The records of a walk: traces of each process, recordings of all messages, the replay of the drives, a picture.
//!
//! - [`trace`]: rows in CSV files, written by each process itself.
//! - [`recorder`]: the messages of each node as MCAP, and all of them in one file.
//! - [`flight`]: the messages around faults, as the nodes have frozen them.
//! - [`replay`]: the drives computed again from a recording, torque by torque.
//! - [`plot`]: the picture of a run.

pub mod flight;
pub mod plot;
pub mod recorder;
pub mod replay;
pub mod trace;
