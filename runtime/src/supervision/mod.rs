//! Supervision: every layer and every application is a supervised actor.
//!
//! | file | what it is |
//! | --- | --- |
//! | [`core`] | the decisions, pure |
//! | `supervisor` | the actix actor that carries them out |
//! | `child` | one child as its supervisor's shell holds it |
//! | `guard` | the future around each actor: catches its panics, takes its stop order, reports its end |
//! | `alone` | one actor under a guard and under no supervisor |
//! | `burial` | where the user's values are dropped that nobody needs any more |
//! | `orphans` | what becomes of the children of a supervisor that fails itself |
//! | `roster` | who is supervised, for the supervisor's owner |
//! | `ready` | when an actor may say that it is ready |
//! | `place` | where an actor is to run |
//! | `threads` | where actors live |
//! | `own_system` | what an actor stops that stops actix's system: nothing of the node's |
//! | `tenant` | one life of an actor, as its supervisor, its thread and the watchdog hold it |
//! | `vitals` | its signs of life, and its fence |
//! | `watchdog` | who does not come back |
//! | `panics` | where a panic was, and who is told of it |
//! | `frames` | the frames of a panic that are the program's own |
//! | `linux`, `elsewhere` | what the system does for a thread |
//! | `fault` | faults on purpose, with the feature `fault-points` only |

mod alone;
mod burial;
mod child;
pub mod core;
#[cfg(not(target_os = "linux"))]
mod elsewhere;
#[cfg(feature = "fault-points")]
pub mod fault;
mod frames;
mod guard;
#[cfg(target_os = "linux")]
mod linux;
mod orphans;
mod own_system;
mod panics;
mod place;
mod ready;
mod roster;
mod supervisor;
mod tenant;
mod threads;
pub(crate) mod vitals;
mod watchdog;

#[cfg(not(target_os = "linux"))]
use self::elsewhere as system;
#[cfg(target_os = "linux")]
use self::linux as system;
pub use self::{
    alone::{Alone, AloneHandle, Watcher, alone, overseen},
    burial::Burials,
    core::{
        AutoShutdown, BranchView, ChildId, ChildIds, ChildState, ChildView, Command, Flags, Generation,
        Input, Intensity, Policy, Reason, Refusal, Restart, StartRetry, Strategy,
    },
    guard::{Life, life},
    own_system::{part_from_threads, tell_of_a_stop},
    panics::UNWINDS,
    place::{Owner, Place, make_ordinary},
    ready::{ReadyGate, ReadyPart},
    roster::{Listed, Roster},
    supervisor::{ChildSpec, Launch, PlannedChild, Supervisor, SupervisorFact, SupervisorPlan},
    threads::{Threads, Turn},
    vitals::{at_fence, is_fenced},
};
pub(crate) use self::{
    panics::writes_the_log,
    place::{make_foremost, make_like_any_other, realtime_priority},
};
