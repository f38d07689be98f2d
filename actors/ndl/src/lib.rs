//! NDL, the Node Discovery Layer: finds nodes and monitors their liveness.
//!
//! Its guarantees: A reachable node is found within milliseconds of its start. A lost node is detected within
//! `period` times `missed_max` plus one period (with the values of its group, if it is in one). The loss is
//! detected at once if the node announced its leave, or if its connection broke and is refused. A node that
//! is only slow is not lost, nor is one of which any connection delivers. No node becomes a member by a
//! forged source address.
//!
//! `docs/protocol/ndl.md` specifies the bytes. The rules:
//!
//! | rule | |
//! | --- | --- |
//! | NDL-1 | A datagram is one frame of at most 1,200 bytes; anything else is refused and counted. |
//! | NDL-1.1 | Its source TID is the NDL of the node that it announces. |
//! | NDL-1.2 | Datagrams of other projects, and the node's own echo, are ignored. |
//! | NDL-2 | Each node queries all known addresses, and is queried by others. |
//! | NDL-2.1 | Each period, and at once at the start: a query to each member, each seed, each candidate, and one to the group. |
//! | NDL-2.2 | An address from which a datagram is received for the first time is queried at once. |
//! | NDL-2.3 | So is an address that mDNS resolves. |
//! | NDL-2.4 | Members of a group of `ndl.watch` are queried at that group's pace instead. |
//! | NDL-2.5 | After a restart, former members are also queried where they answered. |
//! | NDL-3 | A query is answered at once, to its source address; a member's query to the group is not. |
//! | NDL-3.1 | An answer counts once, if it comes from the queried address and quotes the query's correlation id. |
//! | NDL-3.2 | Only such an answer makes a member. |
//! | NDL-3.3 | A member is queried on each route to it: where it announces itself, and answers; elsewhere only when no route answers. |
//! | NDL-4 | A member is lost |
//! | NDL-4.1 | when it missed `missed_max` answers in a row on all routes; |
//! | NDL-4.2 | but not in a cycle in which the local timer was late by more than half a period; |
//! | | of four such cycles in a row the fourth counts; |
//! | | after a smaller delay, a grace period as long as the delay is given to read the answers, three times in a row at most; |
//! | NDL-4.3 | when its connection broke and is refused, and it answers no query sent after that: `Crashed`, until it answers a later query; |
//! | NDL-4.4 | when it announces that, from its own address, in its own incarnation: `Left`. |
//! | NDL-4.8 | or when it announces that it gave up: `GaveUp`, with its reason. |
//! | NDL-4.6 | The host is probed from the first missed answer on: `Hung` if it accepts, `Crashed` if it refuses, else `LinkDown`. |
//! | NDL-4.7 | While GNCL still receives from the node, it is not lost. It is alive, and its NDL is reported as unheard. |
//! | NDL-5 | A node has one incarnation at a time. |
//! | NDL-5.1 | A higher incarnation replaces a lower one: `NodeRestarted`. |
//! | NDL-5.2 | A lower one is rejected, also after the loss of the higher one, for 15 s. |
//! | NDL-5.3 | From another address, a newcomer waits up to 100 ms for a sign of life of the former incarnation, then gives one itself. |
//! | NDL-5.4 | If the former incarnation gives one, two processes have one address: the newcomer is rejected, both names and addresses are logged. |
//! | NDL-5.5 | A node settles for `missed_max` plus one periods from its start. If it finds its own address in use meanwhile, it gives up: |
//! | | at once if its incarnation is the later one, else at the end of that time if the other is still present. |
//! | | Another node that settles, too, gets time to give up. |
//! | NDL-5.6 | Of two live processes, a settled one precedes a settling one, then the earlier incarnation the later: others accept that one. |
//! | NDL-5.7 | The second gives up `missed_max` periods after it receives from the first; a node that was frozen or alone settles again. |
//! | NDL-5.8 | Where nodes have keys, no datagram ends an incarnation that is authenticated on an established connection. |
//! | NDL-6 | Each answer measures the peer's clock; the smallest bound counts, grown by the drift since then. |
//! | NDL-6.1 | Answers some time apart measure the drift of that clock; without answers, it extrapolates the offset with a growing error. |
//! | NDL-9 | Answers report the stalled parts of the node; applications are notified of a change. |
//! | NDL-9.1 | They also report the clients that do not read their pending messages; this is shown, but not sent as an event. |
//! | NDL-9.2 | A root that has not answered its own NDL three times in a row is reported so, beside its last report. |
//! | NDL-7 | All memory and all work is bounded. |
//! | NDL-7.1 | `nodes_max` members, as many candidates, as many departed nodes; the oldest candidate is evicted. |
//! | NDL-7.2 | 50 datagrams/s from a stranger's address, 1,000 from all of them, 500 from each member or seed. |
//! | NDL-8 | A subscriber first receives each present member, then each change, once. Rejected events are sent as soon as there is room, in their last form. |

#![allow(
    missing_docs,
    rustdoc::private_intra_doc_links,
    reason = "the public face is the package `sinew`; all that is public here is for the node alone"
)]

mod actor;
/// The core alone, for simulations.
#[doc(hidden)]
pub mod core;
/// The encoding of its datagrams.
#[doc(hidden)]
pub mod datagram;
#[cfg(feature = "fuzzing")]
pub mod fuzzing;
mod grid;
mod interfaces;
mod mdns;
mod member_events;
mod node_events;
mod peers_file;
mod ports;
mod probe;
mod progress;
mod socket;
mod state;
#[cfg(test)]
mod tests;

pub use actor::{NdlActor, new_core, send_leaves};
pub use core::Core;
pub use core::{IdleApp, KnownNode, KnownRoute, OwnStalls, Source, TroubledApp};
pub use core::{Input, LostNode, SourceCounts};
pub use member_events::MemberEvents;
pub use node_events::NodeEvents;
pub use progress::check_period;
pub use socket::Sockets;
pub use state::State;

pub use sinew_model::events::NdlEvent as Event;
