//! `sinew view`: the state of a running system as a page for people, and as metrics for Prometheus, over HTTP.
//!
//! It knows no node. A [`Source`], which the command `sinew` has, asks the nodes for a [`Snapshot`], sets parameters
//! and reads messages. The [`Server`] asks it for the state, and for parameters, at most three times a second each,
//! however many requests there are; after a set once more.
//!
//! ```text
//! browser ── GET /api/stream ──► stream: state, log ◄── cache ◄── thread `snapshots` ──► Source::snapshot
//!                                   ▲ points, tables ◄── pages ◄── thread `messages` ──► Tap::poll
//!         ── POST /api/parameters ──► answer ──► Source::set
//!         ── POST /api/stop ────────► answer ──► Source::stop
//! Foxglove ─ WebSocket ──────► foxglove ◄── thread `foxglove` ──► Live::poll
//! ```
//!
//! | module | content |
//! | --- | --- |
//! | `snapshot` | the answers of all nodes at one moment |
//! | `source` | the system as this package sees it: snapshots, parameters, messages |
//! | `nodes` | the state of each node and its label, for the metrics and the page |
//! | `metrics` | the table of all metrics, and their samples from a snapshot |
//! | `model` | the state of the system as JSON |
//! | `events` | the log of events: the differences of snapshots |
//! | `stop` | the stop of the whole system on the page |
//! | `look`, `scope` | the messages at which one page looks |
//! | `fields`, `decimate` | the numbers of a payload, and series with few points |
//! | `pages`, `stream` | the open pages, and the stream of each |
//! | `foxglove` | the server for Foxglove |
//! | `assets` | the files of the page |
//! | `auth`, `request` | the token, and which request is refused, and why |
//! | `cache` | the thread that asks, and the latest snapshot |
//! | `listed` | the latest list of parameters |
//! | `answer`, `body`, `server` | answers, connections and their limits |

mod answer;
mod assets;
mod auth;
mod body;
mod cache;
mod decimate;
mod events;
mod fields;
mod foxglove;
mod listed;
mod look;
mod metrics;
mod model;
mod nodes;
mod pages;
mod request;
mod scope;
mod server;
mod snapshot;
mod source;
mod stop;
mod stream;

pub use foxglove::{Reads, Writes};
pub use metrics::{METRICS, Metric, Shape};
pub use server::Server;
pub use snapshot::{Answers, NODES_MAX, NodeAnswers, Snapshot};
pub use source::{AppParameters, Live, LiveChannel, LiveItem, NoSystem, Sighting, Source, Tap};
pub use stop::StopAct;
