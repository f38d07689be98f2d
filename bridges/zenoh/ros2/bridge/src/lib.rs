//! The parts of the program `sinew-ros2`: a client of one node on one side, a session with a Zenoh router on the other.
//!
//! ```text
//! journal of the node ──► thread `topics` ──► puts
//! puts ──► callbacks: rules ──► thread `commands` ──► applications
//! requests ──► thread `parameters`, thread `stop` ──► applications, the stop of the system
//! ```
//!
//! | module | content |
//! | --- | --- |
//! | `load` | the mapping file, and the definitions of messages beside it |
//! | `run` | all parts, and their threads |
//! | `graph` | tokens by which ROS 2 sees nodes, topics and services |
//! | `topics` | topics that are published |
//! | `commands` | topics with commands |
//! | `service` | requests and replies |
//! | `parameters`, `stop` | the services |
//! | `counts` | counts of published, sent and refused messages; the log of refusals; `/diagnostics` |
//! | `clock` | the clocks of the host |

mod clock;
mod commands;
mod counts;
mod graph;
pub mod load;
mod parameters;
pub mod run;
mod service;
mod stop;
mod topics;
