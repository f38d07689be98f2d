//! The parts of the program `sinew-zenoh-bridge`. It decides nothing: the rules are in `sinew-zenoh-rules`.
//!
//! ```text
//!  Zenoh's threads          queues with a bound           one thread of tokio
//!  puts        --------------> puts ------------------> main client ----> node
//!  queries     --------------> requests ---------------> clients for requests
//!              <-- a thread for each class <- zenoh_sender <-- main client, programs
//! ```
//!
//! | module | content |
//! | --- | --- |
//! | [`bridge`] | start, run, end |
//! | `inlet` | puts and queries of Zenoh, as they arrive |
//! | `zenoh_sender` | puts, queries and replies to Zenoh |
//! | `forward` | a message of Sinew as a put or a query |
//! | `main_client` | groups and broadcasts of Sinew; unconfirmed and protected messages into Sinew |
//! | `requests` | requests and confirmed messages into Sinew |
//! | `programs` | the names of Zenoh programs at the node |
//! | `liveness` | liveliness tokens of nodes and applications |
//! | `types` | the structures and the protection of types |
//! | `shared` | state of all parts: rules, counters, the log of refusals |
//!
//! No call of zenoh runs on the thread of tokio: zenoh would have to wait there.

pub mod bridge;
mod forward;
mod inlet;
mod liveness;
mod main_client;
mod programs;
mod requests;
mod shared;
mod types;
mod zenoh_sender;
