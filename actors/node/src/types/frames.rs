//! The frames between nodes about the structures of types. This module bounds the bytes from another node.
//! `docs/protocol/sync.md` has the fields.

use bytes::Bytes;
use serde::{Deserialize, Serialize, de::DeserializeOwned};
use sinew_runtime::{
    tid::{AppAddress, NodeAddress},
    wire::{Kind, Message, MismatchPolicy, SchemaHash, decode},
};
use sinew_schema::SCHEMA_BYTES_MAX;

/// Maximum bytes of a frame: a structure, and the other fields.
const FRAME_BYTES_MAX: usize = SCHEMA_BYTES_MAX + 512;

/// Requests a structure.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct SchemaQuestion {
    pub(super) kind: Kind,
    pub(super) hash: SchemaHash,
}

/// A structure.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct SchemaAnswer {
    pub(super) kind: Kind,
    pub(super) hash: SchemaHash,
    /// Its canonical bytes.
    #[serde(with = "serde_bytes")]
    pub(super) schema: Vec<u8>,
}

/// Reports to the sender's node that its message was of a type that the receiver declared differently.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct MismatchReport {
    /// The sender.
    pub(super) source: AppAddress,
    /// The receiver.
    pub(super) target: AppAddress,
    pub(super) kind: Kind,
    /// The hash of the receiver's structure.
    pub(super) hash: SchemaHash,
    /// The word of the receiver's policy.
    pub(super) policy: String,
    /// Whether the messages are refused.
    pub(super) refused: bool,
    /// The number of messages so far.
    pub(super) seen: u64,
    /// The canonical bytes of the receiver's structure.
    #[serde(with = "serde_bytes")]
    pub(super) schema: Vec<u8>,
}

impl MismatchReport {
    /// Returns the receiver's policy. An unknown word is of another version of Sinew, and stands for the default.
    pub(super) fn policy(&self) -> MismatchPolicy {
        MismatchPolicy::of_word(&self.policy).unwrap_or_default()
    }
}

/// A frame of another node.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Frame {
    Question(SchemaQuestion),
    Answer(SchemaAnswer),
    Report(MismatchReport),
}

impl Frame {
    /// Decodes the frame that `from` sent.
    ///
    /// # Errors
    /// Returns the fault if the bytes are invalid.
    pub(super) fn parse(from: NodeAddress, message: &Message) -> Result<Self, String> {
        let Message { header, payload, .. } = message;
        if payload.len() > FRAME_BYTES_MAX {
            return Err(format!("from {from}, {} bytes; {FRAME_BYTES_MAX} are read at most", payload.len()));
        }
        match header.kind {
            Kind::SYNC_SCHEMA_ASK => read(from, payload).map(Self::Question),
            Kind::SYNC_SCHEMA => read(from, payload).map(Self::Answer),
            Kind::SYNC_MISMATCH => read(from, payload).map(Self::Report),
            kind => Err(format!("from {from}, of kind {kind}, which is not about types")),
        }
    }
}

fn read<T: DeserializeOwned>(from: NodeAddress, payload: &Bytes) -> Result<T, String> {
    decode(payload).map_err(|fault| format!("from {from}, no frame about types: {fault}"))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use sinew_runtime::{
        tid::Tid,
        wire::{Header, encode},
    };

    use super::*;

    const FROM: NodeAddress = NodeAddress::new(2);
    const KIND: Kind = Kind::named("demo.gains");

    fn message(kind: Kind, payload: Bytes) -> Message {
        Message::new(Header::new(kind, Tid::NONE, Tid::NONE), payload)
    }

    fn report() -> MismatchReport {
        MismatchReport {
            source: AppAddress::new(0x1000),
            target: AppAddress::new(0x1001),
            kind: KIND,
            hash: SchemaHash(7),
            policy: "refuse".to_owned(),
            refused: true,
            seen: 3,
            schema: vec![0; SCHEMA_BYTES_MAX],
        }
    }

    #[test]
    fn longest_legal_frames_are_read() {
        let question = SchemaQuestion { kind: KIND, hash: SchemaHash(u64::MAX) };
        let parsed = Frame::parse(FROM, &message(Kind::SYNC_SCHEMA_ASK, encode(&question)));
        assert_eq!(parsed, Ok(Frame::Question(question)));
        let answer = SchemaAnswer { kind: KIND, hash: SchemaHash(1), schema: vec![1; SCHEMA_BYTES_MAX] };
        let parsed = Frame::parse(FROM, &message(Kind::SYNC_SCHEMA, encode(&answer)));
        assert_eq!(parsed, Ok(Frame::Answer(answer)));
        let parsed = Frame::parse(FROM, &message(Kind::SYNC_MISMATCH, encode(&report())));
        assert_eq!(parsed, Ok(Frame::Report(report())));
        assert_eq!(report().policy(), MismatchPolicy::Refuse);
        let later = MismatchReport { policy: "of a later version".to_owned(), ..report() };
        assert_eq!(later.policy(), MismatchPolicy::AcceptAdditions);
    }

    #[test]
    fn longer_frames_are_refused_unread() {
        let long = SchemaAnswer { kind: KIND, hash: SchemaHash(1), schema: vec![1; FRAME_BYTES_MAX] };
        let refused = Frame::parse(FROM, &message(Kind::SYNC_SCHEMA, encode(&long)));
        assert!(refused.is_err_and(|why| why.contains("are read at most")));
        assert!(Frame::parse(FROM, &message(Kind::SYNC_AUDIT, Bytes::new())).is_err());
    }

    proptest! {
        #[test]
        fn any_bytes_are_a_frame_or_an_error(bytes: Vec<u8>) {
            for kind in [Kind::SYNC_SCHEMA_ASK, Kind::SYNC_SCHEMA, Kind::SYNC_MISMATCH] {
                let _ = Frame::parse(FROM, &message(kind, bytes.clone().into()));
            }
        }
    }
}
