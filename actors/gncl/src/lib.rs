//! GNCL, the Global Node Communication Layer: moves messages between nodes over TCP, in order, and values of
//! class Stream by UDP.
//!
//! A message to an application of another node arrives once, in the order of submission of its class. This
//! holds over any number of connections and restarts of this layer. A confirmed message has exactly one
//! outcome, even after failures. `docs/protocol/gncl.md` defines the encoding. The rules, cited in the code:
//!
//! | rule | meaning |
//! | --- | --- |
//! | GNCL-1 | A node that NDL finds is dialled at once; both sides may dial, one link remains. |
//! | GNCL-2 | The dialler's first frame is HELLO, answered by WELCOME or REFUSAL, all within the handshake time. |
//! | GNCL-3 | A refusal states its reason, is counted on both sides, and closes that connection only. |
//! | GNCL-4 | A HELLO that meets a local HELLO in flight is refused by the lower node address and accepted by the higher, which drops its own. |
//! | GNCL-5 | A HELLO from a linked peer replaces the link: the peer knows better that the old one is dead. |
//! | GNCL-6 | Dials are numbered; a WELCOME voids its sender's dials so far, and a void HELLO is refused. |
//! | GNCL-7 | A newer incarnation ends an older one's state; older ones are refused. With keys, one known by datagrams yields to one that connects. |
//! | GNCL-8 | After a break both dial again: waits double from `redial_min` to `redial_max`, 20 % jitter, until NodeLost; messages reset them. |
//! | GNCL-9 | A silent link is pinged every second; after 3 unanswered pings it is broken. A lost local address breaks it at once. |
//! | GNCL-10 | GOODBYE is a leaving node's last frame, behind all queued messages; it is not dialled again until it is found again. |
//! | GNCL-11 | A frame's source must be on the peer's node and its destination on this one; times are converted to the local clock. |
//! | GNCL-12 | CONFIRM is answered by OUTCOME on the peer's present connection; to many by MEMBERS before it (FRAME-7). |
//! | GNCL-14 | If both know `classes`, the dialler of a link also dials a connection for Stream and one for Bulk, pinged every 10 s at rest. |
//! | GNCL-15 | A requester that stops waiting for a reply sends CANCEL, to a peer that knows it: a request that still waits ends as `Expired`. |
//! | GNCL-16 | All addresses that a peer announces are dialled, 20 ms apart; the first that is reached stays, the others are closed. |
//! | GNCL-17 | Queued outcomes are sent several in one frame, to a peer that knows `outcomes`, or as runs to one that knows `outcome-runs`. |
//! | GNCL-19 | If long packets do not arrive at a peer, connections to it use segments that do. |
//! | GNCL-20 | Unconfirmed messages that were refused are reported to their sender's node, if it knows `undelivered`: at most one frame in 100 ms. |
//! | GNCL-13 | When a connection ends, nothing is lost (package `sinew-session`); when the node is lost, sent messages are `Unknown`, waiting ones `PeerLost`. |
//!
//! | file | content |
//! | --- | --- |
//! | `core/` | which nodes are dialled or refused, and which link stays: no socket, no clock |
//! | `peer.rs` | a peer for its senders: its sessions, which outlive connections and this layer's restarts |
//! | `peer_session.rs` | one of these sessions, with its outlet |
//! | `outstanding.rs` | the destinations that may still get messages of an ended peer |
//! | `link_status.rs` | the status of connections, for queries |
//! | `link.rs` | the reading half of a connection |
//! | `authenticator.rs` | the TLS handshake of a connection |
//! | `task.rs` | the tasks that read and write a link, one each |
//! | `bulk.rs` | the thread of those of Bulk |
//! | `yield_policy.rs` | when that thread yields its CPU |
//! | `connection_events.rs` | the events of all connections for the shell, as one stream |
//! | `receive_counters.rs` | counters of the dispositions of received messages |
//! | `inbound.rs` | the checks before a frame becomes a message of this node |
//! | `link_events.rs` | link events for a layer with a full event queue |
//! | `authenticated.rs` | the certificate with which each node was last linked |
//! | `stream_transport.rs` | how much of class Stream is sent by datagram, for queries |
//! | `datagrams/` | values of class Stream by UDP, if they get through |
//! | `datagram_reader.rs` | the receiving of these datagrams, and the timer of all peers |
//! | `frame.rs` | frames from GNCL itself to that of a peer |
//! | `interfaces.rs` | which of this host's addresses are lost, as the kernel reports |
//! | `spin.rs` | how long the IO thread polls before it sleeps |
//! | `qos.rs` | the network marks of each class |
//! | `listener.rs` | the accepting socket |
//! | `shared_socket.rs` | sockets that outlive this layer's instances |
//! | `node_down_events.rs` | node-down events that follow the last messages of their nodes |
//! | `state.rs` | the state that outlives this layer's actor |
//! | `ports.rs` | the implementation of the port for other layers |
//! | `actor.rs`, `actor/` | the shell that connects them; how it ends |

#![allow(
    missing_docs,
    rustdoc::private_intra_doc_links,
    reason = "the public face is the package `sinew`; all that is public here is for the node alone"
)]

pub mod accounts;
mod actor;
mod authenticated;
mod authenticator;
mod bulk;
mod connection_events;
/// The core alone, for simulations of several layers.
#[doc(hidden)]
pub mod core;
mod datagram_reader;
/// The core of the values by datagram, for its simulation.
#[doc(hidden)]
pub mod datagrams;
mod frame;
#[cfg(feature = "fuzzing")]
pub mod fuzzing;
mod inbound;
#[cfg(target_os = "linux")]
mod interfaces;
mod link;
mod link_events;
mod link_status;
mod listener;
mod node_down_events;
mod outstanding;
mod peer;
mod peer_session;
mod ports;
mod qos;
mod receive_counters;
mod segments;
mod shared_socket;
mod spin;
mod state;
mod stream_transport;
mod task;
#[cfg(test)]
mod tests;
mod transport;
mod yield_policy;

#[doc(hidden)]
pub use actor::settings;
pub use actor::{Gncl, LINGER};
pub use link_events::LinkEvents;
pub use peer::{Peer, Store};
pub use peer_session::SessionAccount;
pub use state::State;
pub use stream_transport::{DatagramShare, datagram_share};

pub use sinew_model::events::GnclEvent as Event;
