//! Sinew: an actor runtime for distributed control.
//!
//! Write control logic as actors. Sinew gives each a 64-bit address, starts it when everything that it needs is ready,
//! carries its messages to any thread, process or machine with a known outcome, restarts it when it fails, and tells it
//! when the structure of the system changes.
//!
//! # The map
//!
//! | for | look at |
//! | --- | --- |
//! | a node and its life | [`Node`], [`NodeBuilder`], [`config`] |
//! | an application in the node's process | [`AppSpec`], [`AppContext`], [`Delivery`], [`payload!`] |
//! | the same in a process of its own, started and restarted by the node | [`AppSpec::own_process`], [`Place::process`] |
//! | an application in a process that the node did not start | [`NodeApi`], [`Endpoint`] for a thread, [`AsyncEndpoint`] for a task |
//! | sending | `send`, `reply` and `message` of [`AppContext`], [`Sender`], [`Endpoint`] and [`AsyncEndpoint`]; [`Outcome`] |
//! | who another node is, proven | [`security`] |
//! | events | [`NodeEvent`] (who is there), [`DirectoryEvent`] (which applications are, and what they handle), [`RequirementEvent`] (what is ready), [`Down`] (who ended, and why) |
//!
//! `docs/SEMANTICS.md` says on one page what is promised and what is not.
//!
//! # The layers
//!
//! `lncl/`, `sync/`, `gncl/`, `ndl/` are the paper's layers. Each is a pure core (bytes and events in, bytes and events
//! out, time and chance as arguments) and a thin actor around it. `node/` is the root that starts, supervises and stops
//! them; `stores.rs` is the state that outlives them.

// The macro `payload!` names this crate as its users do.
extern crate self as sinew;

// What the layers log stops nobody.
use sinew_runtime::log;

mod accept_pace;
mod access;
mod aftermath;
pub mod api;
pub mod audit;
mod bind_error;
mod clocks;
pub mod config;

#[cfg(test)]
mod documentation;
#[cfg(feature = "fuzzing")]
#[doc(hidden)]
pub mod fuzzing;
mod gncl;
pub mod inspect;
mod last_words;
#[cfg(all(test, target_os = "linux"))]
mod lingering;
mod lncl;
mod log_quotas;
mod monitors;
mod ndl;
mod nicer;
mod node;
mod outlet;
mod payload;
mod process;
mod refusals;
mod ring;
mod secured;
// One file for both packages, which share nothing else in tests.
pub mod security;
#[cfg(test)]
#[path = "../../runtime/src/seeded.rs"]
mod seeded;
mod session;
pub mod signals;
mod stores;
mod sync;
mod takeover;
mod undelivered;
mod wills;

#[cfg(feature = "fault-points")]
pub use sinew_runtime::{name, supervision::fault};

pub use access::{AccessError, AccessSummary};
pub use api::{
    ApiError, AsyncEndpoint, Barrier, BarrierError, Endpoint, LoanedMessage, Meet, Meeting, NodeApi,
    Received, Registration, Transport,
};
pub use audit::{Audit, NodeAudit};
pub use clocks::{ClockDrift, ClockOffset};
pub use config::{ConfigFaults, NodeConfig};
pub use lncl::RegisterError;
pub use ndl::{
    IdleApp, KnownNode, KnownRoute, LossReason, NodeEvent, OwnStalls, Source, Trouble, TroubledApp,
};
pub use node::{
    AuditError, CommandError, LifeState, MailboxState, Node, NodeBuilder, NodeEnd, NodeHandle, StartError,
    Supervised, Supervises, SupervisionTree, SupervisorSpec, Traffic,
};
pub use outlet::OutletCounts;
pub use secured::{DenyListError, DenyListSummary};
pub use serde;
pub use sinew_runtime::{
    app::{
        AppContext, AppSpec, Delivery, DownPolicy, InputTimeout, LastWill, Raw, Requirement,
        RequirementEvent, RequirementPolicy, SendOutcome,
    },
    monitor::{Down, DownClass, MonitorError, MonitorId},
    outcome::{Outcome, Rejection},
    protection,
    schedule::{Tick, TimerId},
    sender::{AskError, Confirmation, Destination, Reply, SendError, Sender},
    supervision::{AutoShutdown, Place, ReadyGate, Reason, Refusal, Restart, StartRetry, Strategy},
    tid::{AppAddress, Incarnation, NodeAddress, Tid},
    time::Time,
    undelivered::Undelivered,
    wire::{Class, Kind, MessageBuffer, Payload, TIME_TO_LIVE_MAX},
};
pub use sinew_shm::Spin;
pub use sync::{
    Absence, ArriveAtBarrier, BarrierAnswer, BarrierKind, BarrierStatus, DirectoryEntry, DirectoryEvent,
    LeaveBarrier, OnPartyLoss, Waiting,
};

/// Everything that an ordinary program needs, in one line: `use sinew::prelude::*;`
pub mod prelude {
    pub use std::time::Duration;

    pub use actix::{Actor, ActorContext, ActorFutureExt, AsyncContext, Handler, Running, fut::WrapFuture};

    pub use crate::{
        AppAddress, AppContext, AppSpec, AutoShutdown, Class, Delivery, Down, DownPolicy, InputTimeout,
        LastWill, Node, NodeAddress, NodeBuilder, NodeConfig, NodeEvent, Outcome, Payload, Place,
        RequirementEvent, RequirementPolicy, Restart, SendOutcome, StartError, Strategy, SupervisorSpec,
        Tick, Tid, Time, Undelivered, payload,
    };
}

/// The README's program compiles and runs.
#[cfg(doctest)]
#[doc = include_str!("../../README.md")]
struct Readme;
