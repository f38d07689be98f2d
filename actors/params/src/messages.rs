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
    /// The application takes part in a transaction: it holds its values until the stated time. The reply is
    /// [`ParameterOutcome::Held`], or a refusal.
    Prepare(ParameterTransaction),
    /// Asks for the outcome of a transaction in which the application took part. Changes nothing.
    Conclude(TransactionId),
}

/// The part of one application in a transaction over several ones.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ParameterTransaction {
    /// The transaction.
    pub id: TransactionId,
    /// All applications of the transaction, with the receiver of this message.
    pub participants: Vec<Participant>,
    /// The values of the receiver.
    pub values: Vec<NamedValue>,
    /// Time from the begin of the transaction to the stated time, in nanoseconds. Acceptances count in its first half.
    pub lead_ns: u64,
    /// Time from the sending of this message to the stated time, in nanoseconds.
    pub applies_after_ns: u64,
}

/// The identity of a transaction.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct TransactionId {
    /// The bits of the TID of its coordinator.
    pub coordinator: u64,
    /// When it began, in nanoseconds of the coordinator's clock.
    pub began_ns: u64,
}

/// An application in a transaction.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Participant {
    /// The bits of its TID.
    pub tid: u64,
    /// Its name, for texts.
    pub app: String,
}

/// A message from one participant of a transaction to another one.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ParameterVote {
    /// The transaction.
    pub transaction: TransactionId,
    /// The knowledge of the sender.
    pub stance: Stance,
}

/// The knowledge of a participant about a transaction.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Stance {
    /// It holds legal values, and counts acceptances still.
    Accepts,
    /// Acceptances do not count any more, and it does not know whether the transaction is agreed on.
    Doubts,
    /// All have accepted: the values apply at the stated time.
    Commits,
    /// It applies nothing: it has refused, given up, or does not know the transaction.
    Refuses,
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
    /// The values of a transaction are legal, and are held until the stated time.
    Held {
        /// The stated time, in nanoseconds of the application's clock.
        stated_ns: u64,
        /// Maximum error of the stated time, by the measured offset of the clocks; 0 on the coordinator's host.
        bound_ns: u64,
        /// Whether all participants have accepted: the values apply at the first tick at or after the stated time.
        is_agreed: bool,
    },
    /// No value was applied. None will be, except in a transaction as [`ParameterError::NotAgreed`] says.
    ///
    /// [`ParameterError::NotAgreed`]: crate::ParameterError::NotAgreed
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
