//! The questions about the access list and their answers.

use serde::{Deserialize, Serialize};
use sinew_model::bounded::at_most;
use sinew_runtime::{
    tid::Tid,
    wire::{Class, Payload},
};

use super::Report;

/// The number of classes.
pub(super) const CLASSES: usize = Class::ALL.len();

/// Asks whether this application may send to that one of the asked node. [`AccessReport`] answers.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub struct AskAccess {
    /// The sender.
    pub source: Tid,
    /// The receiver: an application of the asked node.
    pub target: Tid,
}

impl Payload for AskAccess {
    const NAME: &'static str = "sinew.inspect.access";
}

/// The verdicts of a node's access list on messages from one application to another.
///
/// # Examples
///
/// ```
/// use sinew::{AppAddress, Endpoint, Tid, client::ApiError, inspect::{AccessReport, AskAccess}, prelude::*};
///
/// fn explain(endpoint: &mut Endpoint, source: Tid, target: Tid) -> Result<(), ApiError> {
///     let inspect = Tid::new(target.node, AppAddress::INSPECT);
///     let question = AskAccess { source, target };
///     let report: AccessReport = endpoint.message(inspect, &question).ask(Duration::from_secs(1))?;
///     report.verdicts.iter().for_each(|verdict| println!("{:?}: {}", verdict.class, verdict.why));
///     Ok(())
/// }
/// ```
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct AccessReport {
    /// Whether the node has a list; without one everything is allowed.
    pub is_given: bool,
    /// The verdict on each class, if there is a list.
    #[serde(deserialize_with = "at_most::<_, _, CLASSES>")]
    pub verdicts: Vec<AccessVerdict>,
    /// The path of the list's file, if there is a list and room for the path.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub path: Option<String>,
}

impl Payload for AccessReport {
    const NAME: &'static str = "sinew.inspect.access_report";
}

/// The verdict on messages of one class.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct AccessVerdict {
    /// The class.
    pub class: Class,
    /// Whether messages are allowed.
    pub is_allowed: bool,
    /// The deciding rule, or that there is none, and the names that were looked up.
    pub why: String,
}

/// Asks the node to read its access list and its deny list again. Accepted only from a program on the node's own
/// host. [`ReloadReport`] answers.
#[derive(Clone, Copy, Debug, Default, Serialize, Deserialize)]
pub struct AskReload {}

impl Payload for AskReload {
    const NAME: &'static str = "sinew.inspect.reload";
}

/// The lists that are in force now.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ReloadReport {
    /// Rules of the access list for messages.
    pub rules: u64,
    /// Rules of the access list for users of the node's host.
    pub clients: u64,
    /// Whether the node has an access list: without one everything is allowed.
    #[serde(default = "has_list")]
    pub has_list: bool,
    /// Number of certificates on the deny list that is in force; `None` for a node without keys.
    #[serde(default)]
    pub denied: Option<u64>,
    /// Number of certificates that were on the previous deny list and are not any more: they are valid again.
    #[serde(default)]
    pub readmitted: u64,
    /// Why a list was not replaced, or is missing, or the remaining steps; as text, one fault per line.
    pub refused: Option<String>,
}

impl Payload for ReloadReport {
    const NAME: &'static str = "sinew.inspect.reload_report";
}

/// Nodes of versions before this field answer only if they have a list.
const fn has_list() -> bool {
    true
}

/// Its list is short. The path may be longer than an answer.
impl Report for AccessReport {
    fn halve(&mut self) -> bool {
        self.path.take().is_some()
    }
}

impl Report for ReloadReport {
    fn halve(&mut self) -> bool {
        let Some(words) = &mut self.refused else { return false };
        let kept: String = words.chars().take(words.chars().count() / 2).collect();
        let had_any = kept.len() < words.len();
        *words = kept;
        had_any
    }
}
