//! Contracts of an application: to which state it goes when another part of the system is lost, late or stopped.
//!
//! A contract is a declaration. Its executor is one that the application has anyway: the guards of its outputs
//! ([`protection`](crate::protection)), its safe state for a lost requirement, or the contract of the application that
//! commands it. The node reports contracts and outputs, and a tool checks that both fit together.

#[cfg(test)]
mod tests;

use std::{collections::BTreeSet, fmt, time::Duration};

use serde::{Deserialize, Serialize};

use crate::{
    name::{check_name, check_node_name},
    wire::Payload,
};

/// Maximum number of contracts of one application.
pub const CONTRACTS_MAX: usize = 32;
/// Maximum time of a contract: its limit, or the lateness that it tolerates.
pub const CONTRACT_TIME_MAX: Duration = Duration::from_secs(60);

/// The part of the system that a contract is about.
///
/// # Examples
///
/// ```
/// use sinew::contracts::Subject;
///
/// assert_eq!(Subject::from("gait").to_string(), "gait");
/// assert_eq!(Subject::node("central").to_string(), "node central");
/// ```
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub enum Subject {
    /// The application with this name, on any node.
    Application(String),
    /// The node with this name: all of its applications.
    Node(String),
    /// The sender of commands of the protected type with this name.
    SenderOf(String),
}

impl Subject {
    /// Returns the node called `name`.
    pub fn node(name: impl Into<String>) -> Self {
        Self::Node(name.into())
    }

    /// Returns the sender of the protected type `P`, whichever application that is.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::{prelude::*, contracts::Subject, protection::Protection, serde::{Deserialize, Serialize}};
    ///
    /// #[derive(Serialize, Deserialize)]
    /// #[serde(crate = "sinew::serde")]
    /// struct Torque { newton_metres: f32 }
    /// impl Payload for Torque {
    ///     const NAME: &'static str = "demo.torque";
    ///     const PROTECTION: Option<Protection> = Some(Protection::of_period(Duration::from_millis(5)));
    /// }
    ///
    /// assert_eq!(Subject::sender_of::<Torque>().to_string(), "the sender of demo.torque");
    /// ```
    #[must_use]
    pub fn sender_of<P: Payload>() -> Self {
        Self::SenderOf(P::NAME.to_owned())
    }

    /// Returns the error in its name, if there is one.
    fn fault(&self) -> Option<String> {
        let checked = match self {
            Self::Application(name) | Self::SenderOf(name) => check_name(name),
            Self::Node(name) => check_node_name(name),
        };
        checked.err().map(|error| error.to_string())
    }
}

impl From<&str> for Subject {
    fn from(application: &str) -> Self {
        Self::Application(application.to_owned())
    }
}

impl From<String> for Subject {
    fn from(application: String) -> Self {
        Self::Application(application)
    }
}

impl fmt::Display for Subject {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Application(name) => f.write_str(name),
            Self::Node(name) => write!(f, "node {name}"),
            Self::SenderOf(kind) => write!(f, "the sender of {kind}"),
        }
    }
}

/// The condition in which an application goes to the state of a contract.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Condition {
    /// The subject has crashed or hangs, or its node or the link to it is lost. It begins with the last command that
    /// the subject sent.
    Lost,
    /// The newest good command was sent more than this time ago. Guards notice it from `age_max` of the type on:
    /// younger commands are good.
    Late(Duration),
    /// The subject was stopped in order, or the stop of the whole system was pressed. It begins with the last command
    /// that the subject sent, or with the press at its node. A requirement is not lost by a press; the guarded outputs
    /// that its application commands are stopped by the press itself.
    Stopped,
}

impl fmt::Display for Condition {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Lost => f.write_str("lost"),
            Self::Late(time) => write!(f, "late by {time:?}"),
            Self::Stopped => f.write_str("stopped"),
        }
    }
}

/// The conditions of a contract, before its state is named.
///
/// # Examples
///
/// ```
/// use sinew::{contracts::Contract, prelude::*};
///
/// let conditions = Contract::when_lost("gait").or_late(Duration::from_millis(60)).or_stopped();
/// let contract = conditions.goes_to("damped", Duration::from_millis(100));
/// assert_eq!(contract.state(), "damped");
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
#[must_use = "a contract needs a state: `goes_to`"]
pub struct ContractConditions {
    subject: Subject,
    lost: bool,
    late: Option<Duration>,
    stopped: bool,
}

impl ContractConditions {
    const fn of(subject: Subject) -> Self {
        Self { subject, lost: false, late: None, stopped: false }
    }

    /// Adds the loss of the subject.
    pub const fn or_lost(mut self) -> Self {
        self.lost = true;
        self
    }

    /// Adds its lateness: its newest good command was sent more than `time` ago. At least `age_max` of the type, as
    /// younger commands are good; up to 60 s.
    pub const fn or_late(mut self, time: Duration) -> Self {
        self.late = Some(time);
        self
    }

    /// Adds its stop.
    pub const fn or_stopped(mut self) -> Self {
        self.stopped = true;
        self
    }

    /// Returns the contract: within this time (up to 60 s) after one of the conditions began, the application is in the
    /// state called `state`.
    #[must_use]
    pub fn goes_to(self, state: impl Into<String>, within: Duration) -> Contract {
        Contract { conditions: self, state: state.into(), within, through: None }
    }
}

/// A contract: when another part of the system is lost, late or stopped, the application goes to a state within a time.
///
/// It is declared by [`AppSpec::contract`](crate::app::AppSpec::contract), and `sinew contracts` shows and checks all
/// of the system.
///
/// # Examples
///
/// ```
/// use sinew::{contracts::{Contract, Subject}, prelude::*};
///
/// const MS: Duration = Duration::from_millis(1);
///
/// // The knee obeys the gait.
/// let of_gait = Contract::when_lost("gait").or_late(60 * MS).or_stopped().goes_to("damped", 100 * MS);
/// // The gait obeys the operator's panel, and sends no command without it. So the knee is damped then, too.
/// let of_panel = Contract::when_lost("panel").goes_to("damped", 700 * MS).through("gait");
/// let of_node = Contract::when_stopped(Subject::node("central")).goes_to("damped", 100 * MS);
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Contract {
    conditions: ContractConditions,
    state: String,
    within: Duration,
    through: Option<String>,
}

impl Contract {
    /// Begins a contract for the loss of `subject`: an application by its name, or a [`Subject`].
    pub fn when_lost(subject: impl Into<Subject>) -> ContractConditions {
        ContractConditions::of(subject.into()).or_lost()
    }

    /// Begins a contract for the case that the newest good command of `subject` was sent more than `time` ago. At least
    /// `age_max` of the type, as younger commands are good; up to 60 s.
    pub fn when_late(subject: impl Into<Subject>, time: Duration) -> ContractConditions {
        ContractConditions::of(subject.into()).or_late(time)
    }

    /// Begins a contract for the stop of `subject`.
    pub fn when_stopped(subject: impl Into<Subject>) -> ContractConditions {
        ContractConditions::of(subject.into()).or_stopped()
    }

    /// States that the application called `application` executes the first part: it has a contract about the same
    /// subject, and sends no commands in that state. This application needs one about that application being stopped.
    /// The times of both have to add up to this contract's.
    #[must_use]
    pub fn through(mut self, application: impl Into<String>) -> Self {
        self.through = Some(application.into());
        self
    }

    /// Returns the part of the system that it is about.
    #[must_use]
    pub const fn subject(&self) -> &Subject {
        &self.conditions.subject
    }

    /// Returns its conditions.
    pub fn conditions(&self) -> impl Iterator<Item = Condition> {
        let ContractConditions { lost, late, stopped, .. } = self.conditions;
        let lost = lost.then_some(Condition::Lost);
        lost.into_iter().chain(late.map(Condition::Late)).chain(stopped.then_some(Condition::Stopped))
    }

    /// Returns the name of the state.
    #[must_use]
    pub fn state(&self) -> &str {
        &self.state
    }

    /// Returns the time within which the application is in that state.
    #[must_use]
    pub const fn within(&self) -> Duration {
        self.within
    }

    /// Returns the application that executes the first part, if there is one.
    #[must_use]
    pub fn executor(&self) -> Option<&str> {
        self.through.as_deref()
    }

    /// Returns the error in the declaration of the application `own`, if there is one.
    fn fault(&self, own: &str) -> Option<String> {
        let subject = self.subject();
        if let Some(why) = subject.fault() {
            return Some(format!("the contract about '{subject}' has no valid name: {why}"));
        }
        if let Err(why) = check_name(&self.state) {
            return Some(format!("the state '{}' of the contract about '{subject}': {why}", self.state));
        }
        if *subject == Subject::from(own) || self.executor() == Some(own) {
            return Some(format!(
                "the contract about '{subject}' names the application itself: name another part"
            ));
        }
        if let Some(Err(why)) = self.executor().map(check_name) {
            return Some(format!("`through` of the contract about '{subject}': {why}"));
        }
        let late = self.conditions.late.into_iter();
        let mut times = late.chain([self.within]);
        let is_time = |time: &Duration| !time.is_zero() && *time <= CONTRACT_TIME_MAX;
        times.find(|time| !is_time(time)).map(|time| {
            format!("the contract about '{subject}' has a time of {time:?}: more than 0, and at most {CONTRACT_TIME_MAX:?}")
        })
    }
}

/// Returns the error in the contracts of the application `own`, if there is one.
pub(super) fn fault(own: &str, contracts: &[Contract]) -> Option<String> {
    if contracts.len() > CONTRACTS_MAX {
        return Some(format!(
            "{} contracts are more than the {CONTRACTS_MAX} that it may have",
            contracts.len()
        ));
    }
    if let Some(why) = contracts.iter().find_map(|contract| contract.fault(own)) {
        return Some(why);
    }
    let mut seen = BTreeSet::new();
    for contract in contracts {
        for condition in contract.conditions() {
            // One time for each condition: the checks would not know which one holds.
            let kind = match condition {
                Condition::Lost => "lost",
                Condition::Late(_) => "late",
                Condition::Stopped => "stopped",
            };
            if !seen.insert((contract.subject(), kind)) {
                let subject = contract.subject();
                return Some(format!("two of its contracts are about '{subject}' being {kind}: keep one"));
            }
        }
    }
    None
}
