//! The parameters of an application: values that are tuned while it runs.
//!
//! A set of parameters is a struct of [`Param`]s, which the macro `params!` of the package `sinew` declares. A control
//! loop reads each one by [`Param::get`], a single load. A [`Tuner`] is the only writer: it takes sets of values,
//! checks each as a whole, and applies it between two ticks of the loop.
//!
//! This crate knows no message, no actor and no clock: times are arguments, counted from the origin of the caller's
//! clock. `sinew-runtime` connects it with the mailbox and the timers of an application.
//!
//! | module | content |
//! | --- | --- |
//! | `descriptor` | the declaration of a parameter: name, unit, default, range, slope |
//! | `param` | a parameter that a loop reads without a lock |
//! | `value` | a value of any of the three types |
//! | `agreement` | one participant's part in the agreement on a transaction |
//! | `coordinator` | the begin, the outcome and the repair of a transaction |
//! | `tuner` | staging, application at a tick, slopes, undo |
//! | `kept` | values that survive a restart of the node |
//! | [`mod@file`] | values as TOML |
//! | `messages` | the messages between tools and applications |

mod agreement;
mod coordinator;
mod descriptor;
pub mod file;
mod kept;
mod messages;
mod param;
mod tuner;
mod value;

pub use self::{
    agreement::{DOUBT_WITHIN, LEAD, LEAD_MAX, LEAD_MIN, PARTICIPANTS_MAX},
    coordinator::{
        Coordinator, PartOutcome, PartReport, Step, TransactionError, TransactionReport, TransactionVerdict,
    },
    descriptor::{Descriptor, Domain, NAME_BYTES_MAX, PARAMETERS_MAX, check},
    kept::{kept_values, restore},
    messages::{
        AskParameters, NamedValue, ParameterList, ParameterOutcome, ParameterReport, ParameterTransaction,
        ParameterVote, Participant, SetParameters, Stance, TransactionId,
    },
    param::{Cell, Param, ParamType, Parameters},
    tuner::{OwnPart, ParameterError, STAGED_MAX, TICK_WITHIN, Tuner, UNDO_MAX},
    value::{Value, ValueError},
};
