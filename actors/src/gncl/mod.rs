//! GNCL, the Global Node Communication Layer: moves messages between nodes over TCP, in order, and values of class Stream by UDP.
//!
//! Its promise: a message to an application of another node arrives once, in the order in which its class was submitted,
//! through any number of connections and restarts of this layer; and a confirmed message has exactly one outcome,
//! whatever breaks. `docs/protocol/gncl.md` has every byte. The rules, cited in the code:
//!
//! | rule | what it says |
//! | --- | --- |
//! | GNCL-1 | Whoever NDL finds is dialled at once; both sides may dial, one link remains. |
//! | GNCL-2 | The dialler's first frame is HELLO, answered by WELCOME or REFUSAL, all within the handshake time. |
//! | GNCL-3 | What is refused is refused in words, on both sides, counted, and closes that connection only. |
//! | GNCL-4 | A HELLO that meets an own HELLO on its way is refused by the lower node address and taken by the higher, which drops its own. |
//! | GNCL-5 | A HELLO from a linked peer replaces the link: the peer knows better that the old one is dead. |
//! | GNCL-6 | Dials are numbered; a WELCOME voids its sender's dials so far, and a void HELLO is refused. |
//! | GNCL-7 | A newer incarnation ends all that belongs to the older; an older one is refused. Where nodes have keys, a life that only datagrams tell of gives way to one that connects. |
//! | GNCL-8 | After a break both dial again: waits double from `redial_min` to `redial_max`, 20 % jitter, until NodeLost; from the least again once messages pass. |
//! | GNCL-9 | A link on which nothing comes is pinged every second; after 3 unanswered pings it is broken. One whose own address is lost is so at once. |
//! | GNCL-10 | GOODBYE is the last frame of a node that leaves, behind all that waits; it is not dialled again until it is found again. |
//! | GNCL-11 | A frame's source must be on the peer's node and its destination on this one; times are turned into our clock. |
//! | GNCL-12 | CONFIRM is answered by OUTCOME on the peer's present connection; to many by MEMBERS before it (FRAME-7). |
//! | GNCL-14 | Where both know `classes`, whoever dialled a link dials a connection each for Stream and for Bulk as well. At rest they are pinged every 10 s. |
//! | GNCL-15 | Who waits no more for a reply says CANCEL, to a peer that knows it: a request that still waits is taken out as `Expired`. |
//! | GNCL-16 | All addresses that a peer announces are dialled, 20 ms apart; the first that is reached stays, the others are closed. |
//! | GNCL-17 | Outcomes that wait go several in one frame, to a peer that knows `outcomes`. |
//! | GNCL-19 | Where long packets do not arrive at a peer, connections to it have segments that do. |
//! | GNCL-20 | Unconfirmed messages that were refused are reported to their sender's node, to a peer that knows `undelivered`: one frame in 100 ms at most. |
//! | GNCL-13 | When a connection ends, nothing is lost (`session/`); when the node is, what was sent is `Unknown`, what waited `PeerLost`. |
//!
//! | file | what it is |
//! | --- | --- |
//! | `core/` | who dials, who is refused, which link stays: no socket, no clock |
//! | `peer.rs` | what a peer is to senders: its sessions, which outlive connections and this layer's restarts |
//! | `way.rs` | one of these sessions, with its outlet |
//! | `link.rs` | the reading half of a connection |
//! | `task.rs` | the tasks that read and write a link, one each |
//! | `bulk.rs` | the thread of those of Bulk |
//! | `courtesy.rs` | when that thread gives its CPU away |
//! | `crowd.rs` | what all connections have to say to the shell, as one stream |
//! | `arrivals.rs` | what became of what came, counted |
//! | `inbound.rs` | what is checked before a frame becomes a message of this node |
//! | `untold.rs` | what other layers have not been told of links, because their posts were full |
//! | `proofs.rs` | with which certificate each node was linked last |
//! | `stream_way.rs` | how much of class Stream goes by datagram, for whoever asks |
//! | `datagrams/` | values of class Stream by UDP, where they get through |
//! | `interfaces.rs` | which of this host's addresses are lost, as the kernel says |
//! | `spin.rs` | how long the IO thread looks before it sleeps |
//! | `ticks.rs` | looks at what has a time, only as long as there is something |
//! | `marks.rs` | what the network is told about a class |
//! | `listener.rs` | the accepting socket |
//! | `lent.rs` | sockets that outlive this layer, as one life of it waits for them |
//! | `pace.rs` | how fast it accepts |
//! | `actor.rs`, `actor/` | the shell that ties them together; how it ends |

mod actor;
mod arrivals;
mod bulk;
mod core;
mod courtesy;
mod crowd;
mod datagrams;
mod facts;
#[cfg(feature = "fuzzing")]
pub(crate) mod fuzzing;
mod inbound;
#[cfg(target_os = "linux")]
mod interfaces;
mod lent;
mod link;
mod listener;
mod marks;
mod notes;
mod owed;
mod peer;
mod proofs;
mod secure;
mod segments;
mod spin;
mod stream_way;
mod task;
#[cfg(test)]
mod tests;
mod ticks;
mod transport;
mod untold;
mod way;

pub(crate) use actor::{Gncl, LINGER};
pub(crate) use facts::LinkFact;
pub(crate) use peer::{Peer, Store};
pub(crate) use proofs::{is_revoked, proven_life};
pub(crate) use stream_way::{ByDatagram, by_datagram};
pub(crate) use untold::Untold;
pub(crate) use way::{Arrived, WayAccount};

use std::net::SocketAddr;

use sinew_runtime::tid::{Incarnation, NodeAddress};

use crate::ndl::MembershipFact;

/// What GNCL is told.
#[derive(Clone, Debug)]
pub(crate) enum Event {
    /// By NDL: who is there.
    Membership(MembershipFact),
    /// By NDL: this life of a node listens at these addresses now.
    Moved { node: NodeAddress, incarnation: Incarnation, gncl: Vec<SocketAddr> },
    /// By NDL: that this life of a node was there bars no other.
    Forgotten { node: NodeAddress, incarnation: Incarnation },
    /// By whoever had the deny list read again: another one is in force.
    DenyListChanged,
}
