//! The sync manager: nobody starts before what it needs is ready.
//!
//! Every node's sync manager publishes the list of its node's applications to those of all linked nodes, and holds
//! each application of its own node at the barrier until all names that it requires are ready, wherever they are. No
//! node is a master: each decides for its own applications, from what the others say about theirs.
//!
//! | rule | |
//! | --- | --- |
//! | SYNC-1 | A list replaces what its node said before. The newest version of the newest incarnation wins; an older one is ignored. A list about another life than the linked one is refused. |
//! | SYNC-2 | The whole list goes to a peer when its link comes up, at each change (not sooner than 1 ms after the one before, 5 ms if that had more than 4 KiB), and again every 2 s. |
//! | SYNC-3 | An entry counts as ready while its list says so, its node's link is up, a list has come since it came up, and the node is not lost. When a node is linked in another life, or found in another that is not linked, what the former one said is over. |
//! | SYNC-4 | A list has at most 1,024 entries of at most 64 requirements, and 1,024 groups; names have 1 to 63 bytes and no control characters; nothing stands in it twice. Another one is refused whole, counted and logged. |
//! | SYNC-5 | An application is released once in each of its lives, when all that it requires is met. A life begins when it registers (not so again) and when it fails. |
//! | SYNC-6 | A name belongs to the application of this node, ready or not; else to one that is ready; else to that of a linked node; else to that of a node whose link is down. Of several nodes the lowest address wins. Any application of the name satisfies a requirement. |
//! | SYNC-7 | Applications that require each other in a circle are not released, whoever came first; the circle is spelled out. Those that run already are not stopped. Patterns, names that nobody has, what can be done without, and counts for which too few are known are ways out. |
//! | SYNC-8 | A released application is told when a requirement is lost and when it is met again, each once, in that order, as far as its mailbox takes it; what it does not take is offered again every 10 ms in its last form. That nobody can hear of a requirement (its link is down, or up without a list, and its node neither lost nor restarted) is told after 50 ms. |
//! | SYNC-9 | A wait that reaches its deadline is reported with what is missing, since when and why; again each time that the deadline passes. The wait goes on. |
//! | SYNC-10 | An application waits at a barrier of its own node: a name, and parties that are requirements of those who wait there. It must be one of them. It waits until the barrier opens, its deadline, its leave or its end. |
//! | SYNC-11 | What a node knows of barriers goes to each linked node when the link comes up, at each change (not sooner than 1 ms after the one before), and every 2 s. A node that has somebody waiting opens a barrier when all parties wait behind the generation that it knows as the last one; of other nodes that counts which can be heard. The opening is one generation more, and those who waited are its members. |
//! | SYNC-12 | Who hears of a generation that is higher than the known one takes it over, with its members; of the same one the members are put together. Whoever waits behind an earlier one passes if it is a member, and waits for the next one if not. |
//! | SYNC-13 | A named party that is missing and has failed, was stopped, or whose node is lost, for 50 ms, ends the wait of those who do not want to wait for it. |
//! | SYNC-14 | An application that subscribed to it is told of every entry of the directory when it is ready, then of each change, until its life ends. What its mailbox does not take is told 10 ms later, as it is then. |
//! | SYNC-15 | What an application says it has reached, a phase, counts until its life ends, and goes to all nodes in its node's list. It waits there until all parties have reached the phase in their present lives, its deadline, its leave or its end; a lost party ends the wait as in SYNC-13. A requirement on a phase is met by whoever has reached it, ready or not. |
//! | SYNC-16 | As long as something waits in its post, and where its own timer was late by more than 10 ms, a node tells nobody that something is lost, over or overdue before it has read that, or has had as long to read what waits for it, 50 ms at most; three times in a row at most. |

mod actor;
#[cfg(test)]
mod actor_tests;
mod arrivals;
mod core;
mod discovery;
mod facts;
#[cfg(feature = "fuzzing")]
pub(crate) mod fuzzing;
mod list;
mod words;

pub(crate) use actor::SyncManager;
pub(crate) use core::{Core, circle_of};
#[cfg(test)]
pub(crate) use core::{Input, Output};
pub(crate) use facts::OwnApp;
pub use facts::{Absence, DirectoryEntry, DirectoryEvent, Waiting};
pub(crate) use list::{NAME_BYTES_MAX, Name, at_most};
pub use words::{ArriveAtBarrier, BarrierAnswer, BarrierKind, BarrierStatus, LeaveBarrier, OnPartyLoss};

use sinew_runtime::wire::Message;

use crate::{gncl::LinkFact, lncl::AppFact, ndl::MembershipFact};

/// What the sync manager is told.
#[derive(Debug)]
pub(crate) enum Event {
    /// By LNCL: an application came, became ready, failed, went.
    App(AppFact),
    /// By NDL: who is there.
    Membership(MembershipFact),
    /// By GNCL: whom messages can reach.
    Link(LinkFact),
    /// By whoever changed a monitor or a life: there are orders to carry out, or a time to set.
    Monitors,
    /// A message for the sync manager's TID, from another node's.
    Message(Message),
}

impl Event {
    /// The same event; of a message without its receipt, which is never shared.
    fn copy(&self) -> Self {
        match self {
            Self::App(fact) => Self::App(fact.clone()),
            Self::Membership(fact) => Self::Membership(fact.clone()),
            Self::Link(fact) => Self::Link(fact.clone()),
            Self::Monitors => Self::Monitors,
            Self::Message(message) => Self::Message(Message::new(message.header, message.payload.clone())),
        }
    }
}
