//! The questions about the structures of payload types, and their answers.

use serde::{Deserialize, Serialize};
use sinew_model::bounded::at_most;
use sinew_runtime::{
    tid::Tid,
    wire::{Kind, Payload, SchemaHash},
};

use super::{Report, Shortened, halve};

/// Maximum number of structures of one type in one answer.
const SCHEMAS_MAX: usize = 64;
/// Maximum number of applications with one structure in one answer.
const USERS_MAX: usize = 256;
/// Maximum number of disagreements in one answer: those of this node's receivers, and those of its senders.
const MISMATCHES_MAX: usize = 512;
/// Maximum number of differences of one type, as the comparison has it.
const DIFFERENCES_MAX: usize = 16;

/// Asks for the structures of a payload type that the directory names. [`SchemasReport`] answers.
///
/// # Examples
///
/// ```
/// use sinew::{
///     AppAddress, Endpoint, Tid, client::ApiError, inspect::{AskSchemas, SchemasReport}, message::Kind, prelude::*,
/// };
///
/// /// Whether all applications have one version of a type, as far as their versions are known.
/// fn agree(endpoint: &mut Endpoint, name: &str) -> Result<bool, ApiError> {
///     let inspect = Tid::new(endpoint.tid().node, AppAddress::INSPECT);
///     let question = AskSchemas { kind: Kind::named(name) };
///     let report: SchemasReport = endpoint.message(inspect, &question).ask(Duration::from_secs(1))?;
///     Ok(report.schemas.len() <= 1)
/// }
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct AskSchemas {
    /// The type.
    pub kind: Kind,
}

impl Payload for AskSchemas {
    const NAME: &'static str = "sinew.inspect.schemas";
}

/// The structures of a payload type on all nodes, as one node knows them.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct SchemasReport {
    /// The name of the type, if the node knows it.
    pub name: Option<String>,
    /// Its structures, in the order of their hashes.
    #[serde(deserialize_with = "at_most::<_, _, SCHEMAS_MAX>")]
    pub schemas: Vec<SchemaReport>,
    /// The applications that handle the type with an unknown structure.
    #[serde(deserialize_with = "at_most::<_, _, USERS_MAX>")]
    pub unknown: Vec<TypeUser>,
    /// Number of structures and applications that did not fit.
    pub left_out: u64,
}

impl Payload for SchemasReport {
    const NAME: &'static str = "sinew.inspect.schemas_report";
}

/// A structure, and the applications that have it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct SchemaReport {
    /// Its hash.
    pub hash: SchemaHash,
    /// Its canonical bytes, if this node has it. `Schema::parse` of `sinew::schema` reads them.
    #[serde(with = "serde_bytes")]
    pub schema: Option<Vec<u8>>,
    /// The applications that handle the type with this structure.
    #[serde(deserialize_with = "at_most::<_, _, USERS_MAX>")]
    pub handled_by: Vec<TypeUser>,
    /// The applications that have sent the type with this structure, or declared that they send it.
    #[serde(deserialize_with = "at_most::<_, _, USERS_MAX>")]
    pub sent_by: Vec<TypeUser>,
}

/// An application that handles or sends a type.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct TypeUser {
    /// Its address.
    pub tid: Tid,
    /// Its name.
    pub name: String,
}

/// Asks for the types that a sender and a receiver have in different versions, if one of them is on the asked node and
/// the other on another node or in another process. [`MismatchesReport`] answers.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct AskMismatches {}

impl Payload for AskMismatches {
    const NAME: &'static str = "sinew.inspect.mismatches";
}

/// The types that two nodes have in different versions.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct MismatchesReport {
    /// One for each sender, receiver and type. Those of receivers on this node come first.
    #[serde(deserialize_with = "at_most::<_, _, MISMATCHES_MAX>")]
    pub mismatches: Vec<MismatchReport>,
    /// Number of further ones that did not fit.
    pub left_out: u64,
}

impl Payload for MismatchesReport {
    const NAME: &'static str = "sinew.inspect.mismatches_report";
}

/// A type that a sender and a receiver have in different versions.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct MismatchReport {
    /// The sender.
    pub source: TypeUser,
    /// The receiver.
    pub target: TypeUser,
    /// The type.
    pub kind: Kind,
    /// The name of the type, if the node knows it.
    pub name: Option<String>,
    /// The policy of the receiver's type: `refuse`, `warn` or `accept-additions`.
    pub policy: String,
    /// What happens to the messages: `accepted`, `warned` or `refused`.
    pub treatment: String,
    /// The differences in words, each a sentence without its end.
    #[serde(deserialize_with = "at_most::<_, _, DIFFERENCES_MAX>")]
    pub differences: Vec<String>,
    /// Number of messages so far.
    pub seen: u64,
}

impl SchemasReport {
    /// Shortens the lists to the maxima of an answer.
    pub(crate) fn shortened(mut self) -> Self {
        let Self { schemas, unknown, left_out, .. } = &mut self;
        truncate(schemas, SCHEMAS_MAX, left_out);
        for SchemaReport { handled_by, sent_by, .. } in schemas {
            truncate(handled_by, USERS_MAX, left_out);
            truncate(sent_by, USERS_MAX, left_out);
        }
        truncate(unknown, USERS_MAX, left_out);
        self
    }
}

impl MismatchesReport {
    /// Shortens the list to the maximum of an answer.
    pub(crate) fn shortened(mut self) -> Self {
        truncate(&mut self.mismatches, MISMATCHES_MAX, &mut self.left_out);
        self
    }
}

fn truncate<T>(list: &mut Vec<T>, max: usize, left_out: &mut u64) {
    *left_out += list.len().saturating_sub(max) as u64;
    list.truncate(max);
}

impl Report for SchemasReport {
    /// Halves the longest list, in bytes.
    fn halve(&mut self) -> bool {
        let [mut own, mut users] = [0, 0];
        let is_long = {
            let mut lists: [&mut dyn Shortened; 2] =
                [&mut (&mut self.schemas, &mut own), &mut (&mut self.unknown, &mut users)];
            lists.iter_mut().max_by_key(|list| list.bytes()).is_some_and(|list| list.halve())
        };
        self.left_out += own + users;
        is_long
    }
}

impl Report for MismatchesReport {
    fn halve(&mut self) -> bool {
        halve(&mut self.mismatches, &mut self.left_out)
    }
}
