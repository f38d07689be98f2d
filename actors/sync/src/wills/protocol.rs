//! The frame in which a node sends its applications' last wills to another one; `docs/protocol/sync.md` has
//! its bytes.

use serde::{Deserialize, Serialize};
use serde_bytes::ByteBuf;
use sinew_model::bounded::at_most;
use sinew_runtime::{
    app::{Will, WillRecipient},
    tid::{AppAddress, Incarnation, Tid},
    wire::{Class, Kind},
};

use crate::Name;

/// Maximum number of wills of one node that others hold.
pub(super) const WILLS_MAX: usize = 256;
/// Maximum payload of a will that others hold, in bytes.
pub(super) const PAYLOAD_MAX: usize = 1_024;

/// The wills of a node's ready applications. It replaces the previous list.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Testament {
    /// The incarnation of the node.
    pub(super) incarnation: Incarnation,
    /// Counter that increases with each list.
    pub(super) version: u64,
    #[serde(deserialize_with = "at_most::<_, _, WILLS_MAX>")]
    pub(super) wills: Vec<HeldWill>,
}

/// One will.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct HeldWill {
    /// The application that leaves the will.
    pub(super) app: AppAddress,
    /// The name of the recipient, if the will has one.
    #[serde(default)]
    name: Option<Name>,
    /// The 64 bits of the recipient's TID, if the will has one.
    #[serde(default)]
    tid: Option<u64>,
    pub(super) kind: Kind,
    /// The message class: 0 Control, 1 Stream, 2 Bulk.
    class: u8,
    payload: ByteBuf,
}

impl HeldWill {
    /// Returns the will as other nodes hold it, or `None` if they do not hold it. spec: WILL-4
    pub(super) fn new(app: AppAddress, will: &Will) -> Option<Self> {
        if will.payload.len() > PAYLOAD_MAX {
            return None;
        }
        let (name, tid) = match &will.recipient {
            WillRecipient::Name(name) => (Some(Name::try_from(name.clone()).ok()?), None),
            WillRecipient::Tid(tid) => (None, Some(tid.bits())),
        };
        let payload = ByteBuf::from(will.payload.to_vec());
        Some(Self { app, name, tid, kind: will.kind, class: will.class as u8, payload })
    }

    /// Returns the recipient. Returns `None` unless the will has exactly one of name and TID.
    pub(super) fn recipient(&self) -> Option<WillRecipient> {
        match (&self.name, self.tid) {
            (Some(name), None) => Some(WillRecipient::Name(name.to_string())),
            (None, Some(bits)) => Some(WillRecipient::Tid(Tid::from_bits(bits))),
            (Some(_), Some(_)) | (None, None) => None,
        }
    }

    /// Returns the maximum size of the will in a list, in bytes: a map of six fields, four numbers, two
    /// texts.
    pub(super) fn bytes_max(&self) -> usize {
        /// Size of the will without name and payload.
        const FRAME: usize = 72;
        FRAME + self.name.as_ref().map_or(0, |name| name.len()) + self.payload.len()
    }

    pub(super) fn class(&self) -> Option<Class> {
        Class::ALL.get(usize::from(self.class)).copied()
    }

    pub(super) fn payload(&self) -> bytes::Bytes {
        bytes::Bytes::copy_from_slice(&self.payload)
    }

    /// Returns whether another node may send this will. A will is a user message from an application.
    pub(super) fn is_legal(&self) -> bool {
        let is_app = self.app.is_fixed() || self.app.is_dynamic();
        is_app && self.kind.is_user() && self.payload.len() <= PAYLOAD_MAX && self.class().is_some()
    }
}
