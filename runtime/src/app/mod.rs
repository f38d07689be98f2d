//! Applications: actix actors that get typed messages, exact periods and input watchdogs.
//!
//! An application is any `Actor<Context = AppContext<Self>>`. It says in its [`AppSpec`] which payloads it handles, and
//! has a `Handler<Delivery<P>>` for each. Everything that actix gives an actor (spawned futures, `run_later`, an
//! `Addr`) works as usual.

mod away;
mod context;
mod delivery;
mod drive;
mod required;
mod requirement;
mod spec;
mod told;

pub use away::{Absence, Away, Heir, LastWill, WILLS_MAX, Will};
pub use context::{AppContext, Silence, WatchId};
pub use delivery::{Delivery, Raw};
pub use required::{
    ALTERNATIVES_MAX, REQUIREMENT_BYTES_MAX, Requirement, RequirementError, is_pattern, is_phase, matches,
};
pub use requirement::{RequirementEvent, RequirementPolicy};
pub use spec::{AppSpec, AppWiring, DynApp};
pub use told::Told;
