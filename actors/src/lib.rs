//! Sinew: an actor runtime for distributed control.
//!
//! Write control logic as actors. Sinew assigns each a 64-bit address, starts it when all its requirements are ready,
//! and carries its messages to any thread, process or machine with a known outcome. It restarts an actor that fails,
//! and notifies it when the structure of the system changes.
//!
//! # The map
//!
//! The root contains the items that nearly every program uses. Everything else is in a module by topic.
//!
//! | for | look at |
//! | --- | --- |
//! | a node: start, stop, status | [`Node`], [`NodeBuilder`], [`node`], [`config`] |
//! | an application in the node's process | [`AppSpec`], [`AppContext`], [`Delivery`], [`payload!`], [`app`] |
//! | the same in a process of its own, started and restarted by the node | [`AppSpec::own_process`], [`supervision::Place`] |
//! | an application that is any program, started and restarted by the node | [`AppSpec::command`] |
//! | an application in a process that the node did not start | [`client`]: [`NodeApi`], [`Endpoint`] for a thread, [`AsyncEndpoint`] for a task |
//! | values that are tuned while an application runs | [`params!`], [`parameters`] |
//! | sending, and outcomes | [`message`], [`Outcome`] |
//! | restarts, supervisors | [`supervision`] |
//! | notifications of nodes, applications, requirements, ended actors, late inputs | [`events`] |
//! | starting in step with others | [`barrier`] |
//! | which nodes are known, and by which routes | [`discovery`] |
//! | addresses | [`Tid`], [`address`] |
//! | identities and keys | [`security`] |
//! | protected commands and safe outputs | [`protection`] |
//! | the stop of the whole system | [`stop`] |
//! | to which state an application goes when another part is lost, late or stopped | [`contracts`] |
//! | counts of every message | [`audit`] |
//! | reports for tools | [`inspect`] |
//! | the structure of payload types | [`schema`] |
//! | signals | [`signals`] |
//! | clocks, timers | [`Time`], [`time`] |
//! | applications in virtual time, on recorded inputs | [`replay`] |
//!
//! `docs/book/src/reference/guarantees.md` lists the guarantees, and the explicit non-guarantees.
//!
//! # The layers
//!
//! This package re-exports the packages below it, by topic. `sinew-lncl`, `sinew-sync`, `sinew-gncl` and
//! `sinew-ndl` are the paper's layers. Each is a pure core (bytes and events in, bytes and events out, time and
//! chance as arguments) and a thin actor around it. No layer names another one. `sinew-node` is the root that starts,
//! connects, supervises and stops them; `sinew-model` has the types that they share.

// The macro `payload!` uses the crate name as its users do.
extern crate self as sinew;

#[doc(hidden)] // The command `sinew` uses it to suggest names.
pub use sinew_model::nearest;
// Logging in the layers never blocks.
use sinew_runtime::{log, log::tracing::level_filters::LevelFilter};

/// Switches the default log off, unless `SINEW_LOG` or `RUST_LOG` is set. The command `sinew` calls it: its standard
/// error is for its own errors.
#[doc(hidden)]
pub fn silence_default_log() {
    log::set_level(LevelFilter::OFF);
}

#[cfg(test)]
mod documentation;
#[cfg(feature = "fuzzing")]
#[doc(hidden)]
pub mod fuzzing;
mod params;
mod payload;

#[doc(inline)]
pub use sinew_node::{audit, inspect, signals};
pub use sinew_runtime::name;
#[cfg(feature = "fault-points")]
pub use sinew_runtime::supervision::fault;

#[doc(no_inline)]
pub use address::{AppAddress, NodeAddress, Tid};
#[doc(no_inline)]
pub use app::{AppContext, AppSpec, Delivery};
#[doc(no_inline)]
pub use config::NodeConfig;
#[doc(no_inline)]
pub use message::{Class, MismatchPolicy, Outcome, Payload};
#[doc(no_inline)]
pub use node::{Node, NodeBuilder, NodeHandle, StartError};
pub use serde;
#[doc(no_inline)]
pub use sinew_client::{self as client, AsyncEndpoint, Endpoint, NodeApi, Registration};
pub use sinew_replay as replay;
pub use sinew_runtime::{protection, real_time};
#[doc(no_inline)]
pub use time::Time;

/// Addresses of nodes and applications.
pub mod address {
    pub use sinew_runtime::tid::{AppAddress, Incarnation, NodeAddress, Tid};
}

/// Applications: how to declare one, the context of each message, and the calls available in it.
pub mod app {
    pub use sinew_runtime::app::{
        AppContext, AppSpec, COMMAND_WORDS_MAX, CommandReadiness, Delivery, DownPolicy, GroupOutcome,
        LastWill, Program, Raw, Requirement, RequirementPolicy, SendOutcome,
    };
}

/// Barriers: several applications continue at the same moment.
pub mod barrier {
    pub use sinew_client::{Barrier, BarrierError, Meet, Meeting};
    pub use sinew_model::barrier::{
        ArriveAtBarrier, BarrierAnswer, BarrierKind, BarrierStatus, LeaveBarrier, OnPartyLoss,
    };
    pub use sinew_model::directory::{Absence, Waiting};
}

/// Configuration of a node: one struct per layer, safe defaults, all faults reported together.
///
/// It comes from code ([`NodeConfig::new`]) or from TOML ([`NodeConfig::from_toml`](config::NodeConfig::from_toml),
/// [`NodeConfig::from_file`](config::NodeConfig::from_file)). The same check validates both.
pub mod config {
    #[doc(inline)]
    pub use sinew_model::config::{
        AppSettings, CommandConfig, ConfigError, ConfigFault, ContractsConfig, Families, GnclConfig,
        Interface, InterfaceError, Interfaces, LnclConfig, LogConfig, LogLevel, NdlConfig, NodeConfig,
        RecordCompression, RecordConfig, RtConfig, SecurityConfig, Seed, SeedError, StopConfig,
        SupervisionConfig, SyncConfig, TimePolicy, WatchGroup,
    };
}

/// Contracts: to which state an application goes when another part of the system is lost, late or stopped, and within
/// which time. An application declares them by [`AppSpec::contract`](crate::AppSpec::contract). `sinew contracts` shows
/// and checks those of the whole system.
pub mod contracts {
    pub use sinew_model::contracts::{
        AskContracts, CONTRACTS_LISTED_MAX, Closure, CommandedOutput, ContractReport, ContractRow,
        ContractsReport, Gap,
    };
    pub use sinew_runtime::app::{
        CONTRACT_TIME_MAX, CONTRACTS_MAX, Condition, Contract, ContractConditions, Subject,
    };
}

/// Which nodes are known, from where, and by which routes.
pub mod discovery {
    pub use sinew_ndl::{KnownNode, KnownRoute, OwnStalls, Source};
}

/// Notifications that an application can subscribe to or request: of nodes, of applications and their requirements, of
/// actors that ended, of inputs that are late, of messages that were not delivered.
pub mod events {
    pub use sinew_runtime::{
        app::{InputCriterion, InputTimeout, RequirementEvent},
        monitor::{Down, DownClass, MonitorError, MonitorId},
        undelivered::Undelivered,
    };

    pub use sinew_model::directory::{DirectoryEntry, DirectoryEvent};
    pub use sinew_model::facts::{LossReason, NodeEvent, Trouble};
    pub use sinew_ndl::{IdleApp, TroubledApp};
}

/// A node: start, stop, status.
pub mod node {
    #[doc(inline)]
    pub use sinew_node::{
        AccessError, AccessSummary, AuditError, CommandError, DenyListError, DenyListSummary, LifeState,
        MailboxState, MessageAges, Node, NodeBuilder, NodeEnd, NodeHandle, OutletCounts, RegisterError,
        StartError, Supervised, Supervises, SupervisionTree, Traffic,
    };
}

/// Messages: their types and classes, how they are sent, and their outcomes.
pub mod message {
    pub use sinew_runtime::{
        outcome::{MemberOutcome, Outcome, Rejection},
        sender::{
            AskError, ConfirmWhenRoom, Confirmation, Destination, GroupConfirmation, Reply, SendError,
            SendWhenRoom, Sender, StalledError, StalledQueue, UnknownNameError,
        },
        wire::{Class, Kind, MessageBuffer, MismatchPolicy, Payload, TIME_TO_LIVE_MAX},
    };
}

/// The structure of payload types: which fields, variants and numbers they have on the wire, and the differences
/// between two versions of a type.
pub mod schema {
    pub use sinew_runtime::wire::{TypeSchema, schema_of};
    pub use sinew_schema::{
        Comparison, Difference, Field, SCHEMA_BYTES_MAX, Schema, SchemaError, SchemaHash, Shape, TraceError,
        Variant, compare,
    };
}

/// Parameters: values of an application that are tuned while it runs. [`params!`](crate::params!) declares them.
pub mod parameters {
    pub use sinew_client::SetTogetherError;
    pub use sinew_params::{
        AskParameters, Cell, Coordinator, DOUBT_WITHIN, Descriptor, Domain, LEAD, LEAD_MAX, LEAD_MIN,
        NAME_BYTES_MAX, NamedValue, PARAMETERS_MAX, PARTICIPANTS_MAX, Param, ParamType, ParameterError,
        ParameterList, ParameterOutcome, ParameterReport, ParameterTransaction, ParameterVote, Parameters,
        PartOutcome, PartReport, Participant, STAGED_MAX, SetParameters, Stance, Step, TICK_WITHIN,
        TransactionError, TransactionId, TransactionReport, TransactionVerdict, UNDO_MAX, Value, ValueError,
        check, file,
    };
}

/// Security between nodes: identities, certificates and keys. `sinew keys` makes all of the files.
pub mod security {
    #[doc(inline)]
    pub use sinew_security::{
        Certificate, Checker, CredentialError, Credentials, CredentialsError, DenyList, DenyListEntryError,
        DiscoveryKey, Identity, Judged, MalformedCertificateError, PROTOCOL, Peer, PeerError, Sealer, Serial,
        Stamp, Tag, TimePolicy, Tls, UnixTime, Validity, ValidityError, Verdict, date, files, project_of,
        project_uri, rustls, words,
    };
}

/// The stop of the whole system: every guarded output becomes safe, and the one that pressed learns which nodes
/// confirmed. An application presses it by [`AppContext::press_stop`](crate::AppContext::press_stop), a client by
/// [`Endpoint::press_stop`](crate::Endpoint::press_stop), a person by `sinew stop press`. It is no safety function.
pub mod stop {
    pub use sinew_runtime::stop::{
        AcknowledgeStop, AskStop, PressStop, ReleaseStop, StopNode, StopPress, StopReport, StopState,
    };
}

/// Supervision: where an actor runs, when it is restarted, and how failures escalate if restarts do not help.
pub mod supervision {
    pub use sinew_runtime::supervision::{
        AutoShutdown, ChildCommandError, Place, ReadyGate, Reason, Restart, StartRetry, Strategy,
    };

    pub use sinew_node::SupervisorSpec;
}

/// Time, timers, and the clocks of other nodes.
pub mod time {
    pub use sinew_runtime::{
        clock::{Clock, Sleep},
        schedule::{Tick, TimerId},
        time::Time,
    };

    pub use sinew_model::clocks::{ClockDrift, ClockOffset};
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
        params, payload,
        supervision::{AutoShutdown, Place, Restart, Strategy, SupervisorSpec},
        time::Tick,
    };
}

/// The README's program compiles and runs.
#[cfg(doctest)]
#[doc = include_str!("../../README.md")]
struct Readme;
