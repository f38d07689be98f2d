//! Supervision: every layer and every application is a supervised actor.
//!
//! | file | content |
//! | --- | --- |
//! | [`core`] | the decisions, pure |
//! | `supervisor` | the actix actor that executes the decisions |
//! | `child` | one child, as its supervisor's shell holds it |
//! | `guard` | the future around each actor: catches its panics, executes its stop order, reports its end |
//! | `unsupervised` | one actor with a guard and without a supervisor |
//! | `deferred_drop` | the drop of user values that are no longer needed |
//! | `orphans` | the stop of the children of a failed supervisor |
//! | `supervisor_handle` | the handle of a supervisor, for its owner: its children and its commands |
//! | `ready` | readiness of an actor |
//! | `restarts` | the observers of restarts |
//! | `place` | the thread or process of an actor |
//! | `threads` | the threads of actors |
//! | `own_system` | an actix system per thread, so that an actor that stops its system does not stop the node |
//! | `actor_handle` | one incarnation of an actor, as its supervisor, its thread and the watchdog hold it |
//! | `liveness` | the liveness state of an incarnation, and its fence |
//! | `watchdog` | the detection of hung actors |
//! | `panics` | the location of a panic, and its report |
//! | `frames` | the stack frames of a panic in the program's own code |
//! | `fault` | injected faults, with the feature `fault-points` only |

mod actor_handle;
mod child;
pub mod core;
mod deferred_drop;
#[cfg(feature = "fault-points")]
pub mod fault;
mod frames;
mod guard;
pub(crate) mod liveness;
mod orphans;
mod own_system;
mod panics;
mod place;
mod ready;
mod restarts;
mod supervisor;
mod supervisor_handle;
mod threads;
mod unsupervised;
mod watchdog;

pub(crate) use self::place::{realtime_priority, request_priority, set_highest_priority};
pub use self::{
    core::{
        AutoShutdown, BranchView, ChildCommandError, ChildId, ChildIds, ChildState, ChildView, Command,
        Flags, Generation, Input, Intensity, Policy, Reason, Restart, StartRetry, Strategy,
    },
    deferred_drop::DropQueue,
    guard::{RunningActor, running_actor},
    liveness::{at_fence, is_fenced},
    own_system::{detach_threads, log_system_stop},
    panics::UNWINDS,
    place::{Owner, Place, request_stop_priority},
    ready::{ReadyGate, ReadyPart},
    restarts::{ActorRestart, RestartObserver, observe_restarts},
    supervisor::{ChildSpec, Launch, PlannedChild, Supervisor, SupervisorFact, SupervisorPlan},
    supervisor_handle::{ChildInfo, SupervisorHandle},
    threads::{Threads, Turn},
    unsupervised::{
        PolledActor, Unsupervised, UnsupervisedHandle, WatchdogHandle, overseen, run_unsupervised,
    },
};
pub use crate::thread::set_normal_schedule;
