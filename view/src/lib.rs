//! `sinew view`: the state of a running system for other programs, as metrics for Prometheus over HTTP.
//!
//! It knows no node. A [`Source`], which the command `sinew` has, asks the nodes for a [`Snapshot`]. The [`Server`]
//! asks it at most once a second, however many requests there are, and answers `GET /metrics` and `GET /`.
//!
//! | module | content |
//! | --- | --- |
//! | `snapshot` | the answers of all nodes at one moment |
//! | `nodes` | the state of each node and its label, for the metrics and the page |
//! | `metrics` | the table of all metrics, and their samples from a snapshot |
//! | `page` | the page at `/` |
//! | `request` | which request is refused, and why |
//! | `cache` | the thread that asks, and the latest snapshot |
//! | `server` | connections and their limits |

mod cache;
mod metrics;
mod nodes;
mod page;
mod request;
mod server;
mod snapshot;

pub use cache::Source;
pub use metrics::{METRICS, Metric, Shape};
pub use server::Server;
pub use snapshot::{Answers, NODES_MAX, NodeAnswers, Snapshot};
