//! Applications: actix actors with typed messages, exact periods and input watchdogs.
//!
//! An application is any `Actor<Context = AppContext<Self>>`. Its [`AppSpec`] declares the payloads that it
//! handles, and it has a `Handler<Delivery<P>>` for each. All features of an actix actor (spawned futures,
//! `run_later`, an `Addr`) work as usual.

mod context;
mod contract;
mod delivery;
mod down_policy;
mod drive;
mod input_watch;
mod required;
mod requirement;
mod send_outcome;
mod spec;

pub use context::{AppContext, WatchId};
pub use contract::{CONTRACT_TIME_MAX, CONTRACTS_MAX, Condition, Contract, ContractConditions, Subject};
pub use delivery::{Delivery, Raw};
pub use down_policy::{DownPolicy, DownState, LastWill, WILLS_MAX, Will, WillRecipient};
pub use input_watch::{InputCriterion, InputTimeout};
pub use required::{
    ALTERNATIVES_MAX, REQUIREMENT_BYTES_MAX, Requirement, RequirementError, is_pattern, is_phase, matches,
};
pub use requirement::{RequirementEvent, RequirementPolicy};
pub use send_outcome::{GroupOutcome, SendOutcome, Tagged};
pub use spec::{AppSpec, AppWiring, COMMAND_WORDS_MAX, CommandLine, CommandReadiness, DynApp, Program};
