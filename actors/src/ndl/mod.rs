//! NDL, the Node Discovery Layer: finds nodes and watches that they exist.
//!
//! Its promise: a node that can be reached is known within milliseconds of its start; a node that is gone is known to
//! be gone within `period` times `missed_max` plus one period (those of its group, if it is in one), and at once if it said so or if its connection broke
//! and is refused; a node that is only slow is not lost, nor one of which any connection delivers; and nobody becomes a member by a forged source address.
//!
//! `docs/protocol/ndl.md` has the bytes. The rules:
//!
//! | rule | |
//! | --- | --- |
//! | NDL-1 | A datagram is one frame of at most 1,200 bytes; anything else is refused and counted. |
//! | NDL-1.1 | Its source TID is the NDL of the node that it announces. |
//! | NDL-1.2 | Datagrams of other projects, and our own that come back, are ignored. |
//! | NDL-2 | Everybody is asked, and asks. |
//! | NDL-2.1 | Each period, and at once at the start: a query to each member, each seed, each candidate, and one to the group. |
//! | NDL-2.2 | Whoever is heard for the first time is asked at once. |
//! | NDL-2.3 | So is whoever mDNS resolves. |
//! | NDL-2.4 | Members of a group of `ndl.watch` are asked at that group's pace instead. |
//! | NDL-2.5 | After a restart also who was a member before, where it answered. |
//! | NDL-3 | A query is answered at once, to where it came from; a member's query to the group is not. |
//! | NDL-3.1 | An answer counts once, if it comes from the address that was asked and quotes the query's correlation id. |
//! | NDL-3.2 | Such an answer, and nothing else, makes a member. |
//! | NDL-3.3 | A member is asked on each route to it: where it says itself that it is, and answers; elsewhere only when no route answers. |
//! | NDL-4 | A member is lost |
//! | NDL-4.1 | when it missed `missed_max` answers in a row on all routes; |
//! | NDL-4.2 | but nobody is accused in a cycle to which our own timer came late by more than half a period; where it came late by less, as long again is given to read what was answered; of four such cycles in a row the fourth counts, and three respites are given; |
//! | NDL-4.3 | when its connection broke and is refused, and it answers no question of after that: `Crashed`, until it answers a later query; |
//! | NDL-4.4 | when it says so, from its own address, in its own life: `Left`. |
//! | NDL-4.8 | or when it says so because it gave up: `GaveUp`, with its reason. |
//! | NDL-4.6 | whose host is tried from its first missed answer on: `Hung` if it accepts, `Crashed` if it refuses, else `LinkDown`. |
//! | NDL-4.7 | But not while GNCL reads of it: it lives, and is told to have an NDL that is not heard. |
//! | NDL-5 | A node has one life at a time. |
//! | NDL-5.1 | A higher incarnation replaces a lower one: `NodeRestarted`. |
//! | NDL-5.2 | A lower one is refused, also after the loss of the higher one, for 15 s. |
//! | NDL-5.3 | From another address than its own, the newcomer waits up to 100 ms for the former life to show that it lives, and shows then that it lives itself. |
//! | NDL-5.4 | If the former life does, there are two processes with one address: the newcomer is refused, names and addresses of both are logged. |
//! | NDL-5.5 | A node that finds its own address in use while it settles, `missed_max` plus one periods from its start, gives up: at once if its life is the later one, else at the end of that time if the other is still there, which gets time to give up if it settles, too. |
//! | NDL-5.6 | Of two that both live, who has settled goes before who has not, and then the elder life: whoever hears both takes that one. |
//! | NDL-5.7 | Who goes second gives up `missed_max` periods after it hears of the first; who was frozen or alone settles anew. |
//! | NDL-5.8 | Where nodes have keys, no datagram ends a life that has proven itself on a connection which stands. |
//! | NDL-6 | Each answer measures the peer's clock; the smallest bound counts, grown by the drift since then. |
//! | NDL-6.1 | Answers some time apart measure how fast that clock drifts; an offset moves on with it, ever less exactly, while nobody answers. |
//! | NDL-9 | Answers say what of the node does not get on; a change is told to applications. |
//! | NDL-9.1 | They say, too, which clients take nothing of what waits for them; of that nobody is told, it is known. |
//! | NDL-9.2 | Of a root that has not answered its own NDL three times in a row that is said, beside what it said last. |
//! | NDL-7 | All memory and all work is bounded. |
//! | NDL-7.1 | `nodes_max` members, as many candidates, as many that are gone; the oldest candidate makes room. |
//! | NDL-7.2 | 50 datagrams/s from a stranger's address, 1,000 from all of them, 500 from each member or seed. |
//! | NDL-8 | An application that wants to know hears first of every member that is there, then of each change, once; what it does not take is offered again every 10 ms, in its last form. |

mod actor;
mod address;
mod core;
mod datagram;
mod facts;
#[cfg(feature = "fuzzing")]
pub(crate) mod fuzzing;
mod interfaces;
mod mdns;
mod peers_file;
mod probe;
mod progress;
mod socket;
#[cfg(test)]
mod tests;
mod untold;

pub(crate) use actor::{NdlActor, new_core, say_goodbye};
pub(crate) use address::is_same_host;
pub(crate) use core::Core;
#[cfg(test)]
pub(crate) use core::Input;
pub use core::{IdleApp, KnownNode, KnownRoute, OwnStalls, Source, TroubledApp};
pub(crate) use core::{LostNode, SourceCounts};
pub(crate) use datagram::{FURTHER_MAX, PATHS_MAX};
pub(crate) use facts::MembershipFact;
pub use facts::{LossReason, NodeEvent, Trouble};
pub(crate) use progress::{IdleClient, Part, Progress, Told, look_period};
pub(crate) use socket::Sockets;
pub(crate) use untold::Untold;

use crate::{gncl::LinkFact, lncl::AppFact};

/// What NDL is told.
#[derive(Clone, Debug)]
pub(crate) enum Event {
    /// By GNCL: a connection came, broke, or cannot be made again.
    Link(LinkFact),
    /// By LNCL: an application that handles [`NodeEvent`] became ready, failed, went.
    App(AppFact),
}
