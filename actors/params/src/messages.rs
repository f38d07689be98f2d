//! The messages by which parameters are listed and set.

use serde::{Deserialize, Serialize};

use crate::value::Value;

/// Asks an application for its parameters; [`ParameterList`] is the reply.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct AskParameters {}

/// Sets parameters of an application, all of these or none; [`ParameterOutcome`] is the reply.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum SetParameters {
    /// These parameters get these values.
    Values(Vec<NamedValue>),
    /// The parameters of the last set that was applied and not undone get their former values.
    Undo,
}

/// A parameter's name and a value.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct NamedValue {
    /// The name of the parameter.
    pub name: String,
    /// The value.
    pub value: Value,
}

/// The outcome of a [`SetParameters`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum ParameterOutcome {
    /// All values were applied at the begin of a tick.
    Applied {
        /// The number of the tick since the application's start; 0 if the application has no periodic timer, so that
        /// they were applied between two messages.
        tick: u64,
        /// When, in nanoseconds of the application's clock.
        at_ns: u64,
        /// The values. A parameter with a slope begins to move to its value.
        values: Vec<NamedValue>,
    },
    /// No value was applied, and none will be.
    Refused {
        /// The reason: the parameter, the value and its range.
        why: String,
    },
}

/// The parameters of an application.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ParameterList {
    /// Each parameter, in the order of its declaration.
    pub parameters: Vec<ParameterReport>,
    /// Whether the application has a periodic timer. Sets are applied at its ticks.
    pub has_ticks: bool,
    /// Number of sets that can be undone.
    pub undoable: u32,
}

/// One parameter of an application.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ParameterReport {
    /// The name.
    pub name: String,
    /// The description, on one line.
    pub description: String,
    /// The unit; "1" for a share or a count, "" for a flag.
    pub unit: String,
    /// The current value.
    pub value: Value,
    /// The value to which it moves; equal to `value` if it does not move.
    pub target: Value,
    /// The value at the start.
    pub default: Value,
    /// The least legal value; `None` for a flag.
    pub min: Option<Value>,
    /// The greatest legal value; `None` for a flag.
    pub max: Option<Value>,
    /// Maximum change in a second, in the parameter's unit; `None`: a new value applies at once.
    pub slope_per_s: Option<f64>,
    /// Whether the value survives a restart of its application.
    pub keep: bool,
}
