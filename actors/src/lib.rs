//! Sinew: an actor runtime for distributed control.
//!
//! Write control logic as actors. Sinew gives each a 64-bit address, starts it when everything that it needs is ready,
//! carries its messages to any thread, process or machine with a known outcome, restarts it when it fails, and tells it
//! when the structure of the system changes.
//!
//! # The map
//!
//! The root has what nearly every program names. All else is in a module by topic.
//!
//! | for | look at |
//! | --- | --- |
//! | a node: start, stop, status | [`Node`], [`NodeBuilder`], [`node`], [`config`] |
//! | an application in the node's process | [`AppSpec`], [`AppContext`], [`Delivery`], [`payload!`], [`app`] |
//! | the same in a process of its own, started and restarted by the node | [`AppSpec::own_process`], [`supervision::Place`] |
//! | an application in a process that the node did not start | [`client`]: [`NodeApi`], [`Endpoint`] for a thread, [`AsyncEndpoint`] for a task |
//! | sending, and what became of it | [`message`], [`Outcome`] |
//! | restarts, supervisors | [`supervision`] |
//! | notifications of nodes, applications, requirements, ended actors, late inputs | [`events`] |
//! | starting in step with others | [`barrier`] |
//! | which nodes are known, and by which routes | [`discovery`] |
//! | addresses | [`Tid`], [`address`] |
//! | identities and keys | [`security`] |
//! | protected commands and safe outputs | [`protection`] |
//! | counts of every message | [`audit`] |
//! | reports for tools | [`inspect`] |
//! | signals | [`signals`] |
//! | clocks, timers | [`Time`], [`time`] |
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
pub mod audit;
pub mod client;
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
mod nearest;
mod nicer;
pub mod node;
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

pub use sinew_runtime::name;
#[cfg(feature = "fault-points")]
pub use sinew_runtime::supervision::fault;

#[doc(no_inline)]
pub use address::{AppAddress, NodeAddress, Tid};
#[doc(no_inline)]
pub use app::{AppContext, AppSpec, Delivery};
#[doc(no_inline)]
pub use client::{AsyncEndpoint, Endpoint, NodeApi, Registration};
#[doc(no_inline)]
pub use config::NodeConfig;
#[doc(no_inline)]
pub use message::{Class, Outcome, Payload};
#[doc(no_inline)]
pub use node::{Node, NodeBuilder, NodeHandle, StartError};
pub use serde;
pub use sinew_runtime::protection;
#[doc(no_inline)]
pub use time::Time;

/// Addresses of nodes and applications.
pub mod address {
    pub use sinew_runtime::tid::{AppAddress, Incarnation, NodeAddress, Tid};
}

/// Applications: how one is declared, what it gets with each message, and what it may do.
pub mod app {
    pub use sinew_runtime::app::{
        AppContext, AppSpec, Delivery, DownPolicy, GroupOutcome, LastWill, Raw, Requirement,
        RequirementPolicy, SendOutcome,
    };
}

/// Barriers: several applications go on at the same moment.
pub mod barrier {
    pub use crate::{
        client::{Barrier, BarrierError, Meet, Meeting},
        sync::{
            Absence, ArriveAtBarrier, BarrierAnswer, BarrierKind, BarrierStatus, LeaveBarrier, OnPartyLoss,
            Waiting,
        },
    };
}

/// Which nodes are known, from where, and by which routes.
pub mod discovery {
    pub use crate::ndl::{KnownNode, KnownRoute, OwnStalls, Source};
}

/// Notifications that an application can subscribe to or ask for: of nodes, of applications and what they require, of actors that ended, of
/// inputs that are late, of messages that were not delivered.
pub mod events {
    pub use sinew_runtime::{
        app::{InputCriterion, InputTimeout, RequirementEvent},
        monitor::{Down, DownClass, MonitorError, MonitorId},
        undelivered::Undelivered,
    };

    pub use crate::{
        ndl::{IdleApp, LossReason, NodeEvent, Trouble, TroubledApp},
        sync::{DirectoryEntry, DirectoryEvent},
    };
}

/// Messages: their types and classes, how they are sent, and what becomes of them.
pub mod message {
    pub use sinew_runtime::{
        outcome::{MemberOutcome, Outcome, Rejection},
        sender::{
            AskError, Confirmation, Destination, GroupConfirmation, Reply, SendError, Sender,
            UnknownNameError,
        },
        wire::{Class, Kind, MessageBuffer, Payload, TIME_TO_LIVE_MAX},
    };
}

/// Supervision: where an actor runs, when it is restarted, and what happens when that does not help.
pub mod supervision {
    pub use sinew_runtime::supervision::{
        AutoShutdown, Place, ReadyGate, Reason, Refusal, Restart, StartRetry, Strategy,
    };

    pub use crate::node::SupervisorSpec;
}

/// Time, timers, and the clocks of other nodes.
pub mod time {
    pub use sinew_runtime::{
        schedule::{Tick, TimerId},
        time::Time,
    };

    pub use crate::clocks::{ClockDrift, ClockOffset};
}

/// Everything that an ordinary program needs, in one line: `use sinew::prelude::*;`
pub mod prelude {
    pub use std::time::Duration;

    pub use actix::{Actor, ActorContext, ActorFutureExt, AsyncContext, Handler, Running, fut::WrapFuture};

    pub use crate::{
        AppAddress, AppContext, AppSpec, Class, Delivery, Node, NodeAddress, NodeBuilder, NodeConfig,
        Outcome, Payload, StartError, Tid, Time,
        app::{DownPolicy, LastWill, RequirementPolicy, SendOutcome},
        events::{Down, InputTimeout, NodeEvent, RequirementEvent, Undelivered},
        payload,
        supervision::{AutoShutdown, Place, Restart, Strategy, SupervisorSpec},
        time::Tick,
    };
}

/// The README's program compiles and runs.
#[cfg(doctest)]
#[doc = include_str!("../../README.md")]
struct Readme;
