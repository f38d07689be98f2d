//! Applications: actix actors that get typed messages, exact periods and input watchdogs.
//!
//! An application is any `Actor<Context = AppContext<Self>>`. It says in its [`AppSpec`] which payloads it handles, and
//! has a `Handler<Delivery<P>>` for each. Everything that actix gives an actor (spawned futures, `run_later`, an
//! `Addr`) works as usual.

mod context;
mod delivery;
mod down_policy;
mod drive;
mod input_watch;
mod required;
mod requirement;
mod send_outcome;
mod spec;

pub use context::{AppContext, WatchId};
pub use delivery::{Delivery, Raw};
pub use down_policy::{Absence, DownPolicy, Heir, LastWill, WILLS_MAX, Will};
pub use input_watch::{InputCriterion, InputTimeout};
pub use required::{
    ALTERNATIVES_MAX, REQUIREMENT_BYTES_MAX, Requirement, RequirementError, is_pattern, is_phase, matches,
};
pub use requirement::{RequirementEvent, RequirementPolicy};
pub use send_outcome::{GroupOutcome, SendOutcome, Tagged};
pub use spec::{AppSpec, AppWiring, DynApp};
