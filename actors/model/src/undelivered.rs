//! Unconfirmed messages that another node rejected, as it reports them.

use serde::{Deserialize, Serialize};
use sinew_runtime::{
    tid::AppAddress,
    wire::{Class, Kind},
};

use crate::bounded::at_most;

/// Maximum number of entries in a report from another node: those with a destination, and as many without one.
pub const REPORTED_MAX: usize = 32;

/// Payload of GNCL_UNDELIVERED: messages of the receiver's applications that applications of the sender's node
/// rejected. spec: GNCL-20
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Report {
    /// At most [`REPORTED_MAX`].
    #[serde(deserialize_with = "at_most::<_, _, REPORTED_MAX>")]
    pub entries: Vec<Reported>,
}

/// Rejected messages of one source to one destination, of one type, for one reason.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[expect(missing_docs, reason = "each field is what its name says")]
pub struct Reported {
    /// The application of the receiver's node that sent them.
    pub from: AppAddress,
    /// 64 bits of the destination's TID; 0: several.
    pub to: u64,
    /// Code of the outcome that each of them would have had.
    pub why: u8,
    pub count: u64,
    #[serde(default)]
    pub kind: Option<Kind>,
    #[serde(default)]
    pub class: Option<Class>,
    #[serde(default)]
    pub first: Option<u64>,
    #[serde(default)]
    pub last: Option<u64>,
}
