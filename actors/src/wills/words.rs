//! What a node tells another one about its applications' last wills; byte by byte in `docs/protocol/sync.md`.

use serde::{Deserialize, Serialize};
use serde_bytes::ByteBuf;
use sinew_runtime::{
    app::{Heir, Will},
    tid::{AppAddress, Incarnation, Tid},
    wire::{Class, Kind},
};

use crate::sync::{Name, at_most};

/// Wills of one node that others hold at most.
pub(super) const WILLS_MAX: usize = 256;
/// Longest payload of a will that others hold, in bytes.
pub(super) const PAYLOAD_MAX: usize = 1_024;

/// The wills of a node's applications that are ready. It replaces what was said before.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Testament {
    /// Which life of the node this is about.
    pub(super) incarnation: Incarnation,
    /// Counts up with each one.
    pub(super) version: u64,
    #[serde(deserialize_with = "at_most::<_, _, WILLS_MAX>")]
    pub(super) wills: Vec<HeldWill>,
}

/// One will.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct HeldWill {
    /// Whose.
    pub(super) app: AppAddress,
    /// Whom it is for, if that is a name.
    #[serde(default)]
    name: Option<Name>,
    /// Whom it is for, if that is a TID: its 64 bits.
    #[serde(default)]
    tid: Option<u64>,
    pub(super) kind: Kind,
    /// 0 Control, 1 Stream, 2 Bulk.
    class: u8,
    payload: ByteBuf,
}

impl HeldWill {
    /// The will as others hold it; `None` if it stays at home. spec: WILL-4
    pub(super) fn new(app: AppAddress, will: &Will) -> Option<Self> {
        if will.payload.len() > PAYLOAD_MAX {
            return None;
        }
        let (name, tid) = match &will.heir {
            Heir::Name(name) => (Some(Name::try_from(name.clone()).ok()?), None),
            Heir::Tid(tid) => (None, Some(tid.bits())),
        };
        let payload = ByteBuf::from(will.payload.to_vec());
        Some(Self { app, name, tid, kind: will.kind, class: will.class as u8, payload })
    }

    /// Whom it is for; `None`: it says nothing that can be used.
    pub(super) fn heir(&self) -> Option<Heir> {
        match (&self.name, self.tid) {
            (Some(name), None) => Some(Heir::Name(name.to_string())),
            (None, Some(bits)) => Some(Heir::Tid(Tid::from_bits(bits))),
            (Some(_), Some(_)) | (None, None) => None,
        }
    }

    /// Bytes of it in a list, at most: a map of six fields, four numbers, two texts.
    pub(super) fn bytes_max(&self) -> usize {
        /// All of it but name and payload.
        const FRAME: usize = 72;
        FRAME + self.name.as_ref().map_or(0, |name| name.len()) + self.payload.len()
    }

    pub(super) fn class(&self) -> Option<Class> {
        Class::ALL.get(usize::from(self.class)).copied()
    }

    pub(super) fn payload(&self) -> bytes::Bytes {
        bytes::Bytes::copy_from_slice(&self.payload)
    }

    /// Whether another node may say so. A will is a message of a user's, to an application.
    pub(super) fn is_legal(&self) -> bool {
        let is_app = self.app.is_fixed() || self.app.is_dynamic();
        is_app && self.kind.is_user() && self.payload.len() <= PAYLOAD_MAX && self.class().is_some()
    }
}
