//! The contracts of a whole system: the report of each node, and the check that they close. Pure.
//!
//! | file | content |
//! | --- | --- |
//! | `closure` | whether each output has a contract for each of its commanders, and each contract holds its time |
//! | `sum` | the parts of a worst time, and the advice where they are too long |

mod closure;
mod sum;
#[cfg(test)]
mod tests;

use std::time::Duration;

use serde::{Deserialize, Serialize};
use sinew_runtime::{
    app::{Condition, Contract, Subject},
    tid::{NodeAddress, Tid},
    wire::Payload,
};

pub use self::closure::{Closure, ContractRow, Gap};
use crate::bounded::at_most;

/// Maximum number of contracts, and of outputs, in the report of one node.
pub const CONTRACTS_LISTED_MAX: usize = 256;

/// Asks a node for the contracts of its applications, and for the outputs that these guard. [`ContractsReport`]
/// answers.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct AskContracts {}

impl Payload for AskContracts {
    const NAME: &'static str = "sinew.inspect.contracts";
}

/// The contracts of a node's applications, and the outputs that these guard in the node's process.
///
/// # Examples
///
/// ```
/// use sinew::{AppAddress, Endpoint, Tid, client::ApiError, contracts::{AskContracts, Closure, ContractsReport}, prelude::*};
///
/// /// Whether the contracts of a system of one node close.
/// fn closes(endpoint: &mut Endpoint) -> Result<bool, ApiError> {
///     let inspect = Tid::new(endpoint.tid().node, AppAddress::INSPECT);
///     let report: ContractsReport = endpoint.message(inspect, &AskContracts {}).ask(Duration::from_secs(1))?;
///     Ok(Closure::of(&[report]).closes())
/// }
/// ```
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ContractsReport {
    /// The node.
    pub node: NodeAddress,
    /// Its name.
    pub name: String,
    /// Its `contracts.slack_ms`, in microseconds.
    pub slack_us: u64,
    /// Time within which it notices the loss of another node, in microseconds.
    pub detection_us: u64,
    /// Whether its outputs are measured by dry runs.
    pub dry_run: bool,
    /// The contracts, in the order of the applications' addresses.
    #[serde(deserialize_with = "at_most::<_, _, CONTRACTS_LISTED_MAX>")]
    pub contracts: Vec<ContractReport>,
    /// Number of further ones that did not fit.
    pub contracts_left_out: u64,
    /// The outputs, in the order of their creation.
    #[serde(deserialize_with = "at_most::<_, _, CONTRACTS_LISTED_MAX>")]
    pub outputs: Vec<CommandedOutput>,
    /// Number of further ones that did not fit.
    pub outputs_left_out: u64,
}

impl Payload for ContractsReport {
    const NAME: &'static str = "sinew.inspect.contracts_report";
}

/// A contract of an application.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ContractReport {
    /// The application.
    pub app: Tid,
    /// Its name.
    pub app_name: String,
    /// The part of the system that the contract is about.
    pub subject: Subject,
    /// Whether it is about the loss of that part.
    pub lost: bool,
    /// The lateness that it is about, in microseconds, if it is about one.
    pub late_us: Option<u64>,
    /// Whether it is about the stop of that part.
    pub stopped: bool,
    /// The name of the state.
    pub state: String,
    /// Time within which the application is in that state, in microseconds.
    pub within_us: u64,
    /// The application that executes the first part, if there is one.
    pub through: Option<String>,
    /// Longest turn of the application, in microseconds, if it requires the subject and has a safe state for its loss.
    pub turn_us: Option<u64>,
    /// Whether the application runs in a process of its own; the node does not see its outputs.
    pub own_process: bool,
}

impl ContractReport {
    /// Returns the report of a contract of the application `app` with this name.
    #[must_use]
    pub fn new(app: Tid, app_name: &str, contract: &Contract) -> Self {
        let mut report = Self {
            app,
            app_name: app_name.to_owned(),
            subject: contract.subject().clone(),
            lost: false,
            late_us: None,
            stopped: false,
            state: contract.state().to_owned(),
            within_us: micros(contract.within()),
            through: contract.executor().map(str::to_owned),
            turn_us: None,
            own_process: false,
        };
        for condition in contract.conditions() {
            match condition {
                Condition::Lost => report.lost = true,
                Condition::Late(time) => report.late_us = Some(micros(time)),
                Condition::Stopped => report.stopped = true,
            }
        }
        report
    }

    /// Returns its conditions.
    pub fn conditions(&self) -> impl Iterator<Item = Condition> {
        let late = self.late_us.map(|time| Condition::Late(Duration::from_micros(time)));
        let lost = self.lost.then_some(Condition::Lost);
        lost.into_iter().chain(late).chain(self.stopped.then_some(Condition::Stopped))
    }
}

/// An output of an application, and the sender of its commands.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct CommandedOutput {
    /// The application that has the output.
    pub receiver: Tid,
    /// Its name, if the node knows it.
    pub receiver_name: Option<String>,
    /// The sender of its commands.
    pub sender: Tid,
    /// Its name, if the node knows it.
    pub sender_name: Option<String>,
    /// The name of the sender's node, if the node knows it.
    pub sender_node: Option<String>,
    /// The type of its commands.
    pub kind_name: String,
    /// Maximum time from one good command to the next, in microseconds.
    pub within_us: u64,
    /// Maximum age of a command, in microseconds.
    pub age_max_us: u64,
    /// Time from the last command until the output was safe in a dry run, in microseconds; `None`: it had none.
    pub measured_us: Option<u64>,
}

/// Returns a time in microseconds, as reports have it.
#[must_use]
pub fn micros(time: Duration) -> u64 {
    u64::try_from(time.as_micros()).unwrap_or(u64::MAX)
}
