//! The robot in real time: five processes that walk a leg at 1 kHz.
//!
//! ```text
//!              central                                       hip, knee, ankle, each
//!   +-----------------------------+   JointSample    +---------------------------------+
//!   | central.gait  1 kHz         | <--------------- | X.sensor  1 kHz                 |
//!   |   requires the sensors      |   FootLoad       |   requires nothing;             |
//!   |                             |                  |   ready at its first reading    |
//!   |                             |                  |      | JointSample              |
//!   |                             |  GaitState, Arm  |      v                          |
//!   |                             | ---------------> | X.drive   1 kHz                 |
//!   |                             |    (protected)   |   requires the three sensors    |
//!   | central.coordinator         |                  |   and central.gait              |
//!   |   requires the drives,      | <--------------- |                                 |
//!   |   then releases             | DriveStatus, Shut|                                 |
//!   +-----------------------------+  exo.status      +---------------------------------+
//!             | NodeAPI                                   ^ readings   | torque   (UDP)
//!             v                                           |            v
//!        status screen                               plant: the leg, its person, three motors
//! ```
//!
//! Reading order: [`topology`] (the places of all parts), [`device`] (the hardware
//! interface), [`sensor`], [`drive`], [`gait`], [`coordinator`], [`watch`] (the applications: thin shells
//! around the cores), [`node`] (a process with some of them), [`plant`] (the process that simulates hardware
//! and person), [`launch`] (all five on this host). [`trace`] is the record of each. `slots` has the place of each
//! loop in the millisecond.

pub mod coordinator;
pub mod device;
pub mod drive;
pub mod edges;
pub mod figures;
pub mod gait;
pub mod launch;
pub mod node;
pub mod plant;
pub mod role;
pub mod sensor;
pub mod slots;
pub mod topology;
pub mod watch;

use std::time::Duration;

pub use exoskeleton_recording::trace;

/// Period of every control loop.
pub const PERIOD: Duration = Duration::from_millis(1);
