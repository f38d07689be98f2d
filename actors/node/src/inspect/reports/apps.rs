//! The question about the applications of a node and the barriers at which they wait, and its answer.

use serde::{Deserialize, Serialize};
use sinew_model::bounded::at_most;
use sinew_runtime::{
    tid::Tid,
    wire::{Kind, Payload},
};

use super::{GROUPS_OF_APPS_MAX, GroupReport, LISTED_MAX, MISSING_MAX, Report, Shortened};

/// Maximum number of applications in one answer.
pub const APPS_MAX: usize = 1_024;
/// Maximum number of payload types listed per application: the maximum in the directory.
const KINDS_MAX: usize = 64;

/// Asks for the node's applications and their missing requirements. [`AppsReport`] answers.
#[derive(Clone, Copy, Debug, Default, Serialize, Deserialize)]
pub struct AskApps {}

impl Payload for AskApps {
    const NAME: &'static str = "sinew.inspect.apps";
}

/// The applications of a node.
///
/// # Examples
///
/// ```
/// use sinew::{AppAddress, Endpoint, Tid, client::ApiError, inspect::{AppsReport, AskApps}, prelude::*};
///
/// /// The applications of a node that are not ready.
/// fn not_ready(endpoint: &mut Endpoint, node: NodeAddress) -> Result<Vec<Tid>, ApiError> {
///     let inspect = Tid::new(node, AppAddress::INSPECT);
///     let report: AppsReport = endpoint.message(inspect, &AskApps {}).ask(Duration::from_secs(1))?;
///     Ok(report.apps.iter().filter(|app| !app.ready).map(|app| app.tid).collect())
/// }
/// ```
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct AppsReport {
    /// The node's name.
    pub name: String,
    /// Its applications, in the order of their addresses.
    #[serde(deserialize_with = "at_most::<_, _, APPS_MAX>")]
    pub apps: Vec<AppReport>,
    /// Number of further ones that did not fit.
    pub left_out: u64,
    /// The run-time barriers at which applications of this node wait.
    #[serde(default, deserialize_with = "at_most::<_, _, LISTED_MAX>")]
    pub barriers: Vec<BarrierReport>,
    /// Number of further ones that did not fit.
    #[serde(default)]
    pub barriers_left_out: u64,
    /// The groups with members on this node, in the order of their addresses.
    #[serde(
        default,
        skip_serializing_if = "Vec::is_empty",
        deserialize_with = "at_most::<_, _, GROUPS_OF_APPS_MAX>"
    )]
    pub groups: Vec<GroupReport>,
    /// Number of further ones that did not fit.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub groups_left_out: u64,
}

impl Payload for AppsReport {
    const NAME: &'static str = "sinew.inspect.apps_report";
}

/// An application, in the node's process or another.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct AppReport {
    /// Its address.
    pub tid: Tid,
    /// Its name, if it has one.
    pub name: Option<String>,
    /// Whether it has started and accepts messages.
    pub ready: bool,
    /// How long it has waited at the start-up barrier or at a phase, if it waits there.
    pub waits_us: Option<u64>,
    /// Its missing requirements: before its start those it waits for, later those it lost.
    #[serde(deserialize_with = "at_most::<_, _, MISSING_MAX>")]
    pub missing: Vec<Missing>,
    /// Number of further ones that did not fit.
    #[serde(default)]
    pub missing_left_out: u64,
    /// How its previous incarnation ended, while this one is not ready.
    pub ended: Option<String>,
    /// The payload types that it handles, as far as known: for an application in a process of its own, those that it
    /// named at registration.
    #[serde(default, deserialize_with = "at_most::<_, _, KINDS_MAX>")]
    pub kinds: Vec<KindReport>,
    /// Number of further ones that did not fit.
    #[serde(default)]
    pub kinds_left_out: u64,
}

/// A type of payload.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct KindReport {
    /// Its kind.
    pub kind: Kind,
    /// Its name, if the node knows it.
    pub name: Option<String>,
}

/// A run-time barrier at which applications wait.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct BarrierReport {
    /// The barrier's name.
    pub name: String,
    /// Its parties.
    #[serde(deserialize_with = "at_most::<_, _, MISSING_MAX>")]
    pub parties: Vec<String>,
    /// Whether it is a phase.
    #[serde(default)]
    pub is_phase: bool,
    /// How often it has opened, as far as the node knows; 0 for a phase.
    pub generation: u64,
    /// Applications of the node that wait there.
    #[serde(deserialize_with = "at_most::<_, _, MISSING_MAX>")]
    pub waiting: Vec<WaitReport>,
    /// Number of further ones that did not fit.
    #[serde(default)]
    pub waiting_left_out: u64,
    /// The missing parties.
    #[serde(deserialize_with = "at_most::<_, _, MISSING_MAX>")]
    pub missing: Vec<Missing>,
    /// Number of further ones that did not fit.
    #[serde(default)]
    pub missing_left_out: u64,
}

/// An application that waits at a run-time barrier.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct WaitReport {
    /// Its name, or its address.
    pub name: String,
    /// Duration of the wait.
    pub waits_us: u64,
}

/// A required name that is not ready.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Missing {
    /// The name.
    pub name: String,
    /// The last known reason.
    pub why: String,
    /// How long the node has known that it is missing; at most as long as an application there has waited for it, or
    /// lacks it.
    #[serde(default)]
    pub since_us: Option<u64>,
}

/// Returns whether a count is left out of an answer: the shortest one that can be configured has no room for it.
#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde passes the field so")]
const fn is_zero(count: &u64) -> bool {
    *count == 0
}

impl Report for AppsReport {
    /// Drops first the payload types of the applications. Then it halves the longest list, in bytes, so that no list
    /// displaces the others.
    fn halve(&mut self) -> bool {
        let mut had_kinds = false;
        for app in &mut self.apps {
            had_kinds |= !app.kinds.is_empty();
            app.kinds_left_out += app.kinds.len() as u64;
            app.kinds.clear();
        }
        if had_kinds {
            return true;
        }
        let mut lists: [&mut dyn Shortened; 3] = [
            &mut (&mut self.groups, &mut self.groups_left_out),
            &mut (&mut self.barriers, &mut self.barriers_left_out),
            &mut (&mut self.apps, &mut self.left_out),
        ];
        lists.iter_mut().max_by_key(|list| list.bytes()).is_some_and(|list| list.halve())
    }
}
