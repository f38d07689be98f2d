//! The wire format: one fixed header before every payload, and the rules by which bytes become messages.
//!
//! The same frame (header, then payload) is used on unix sockets, on TCP and in datagrams;
//! `docs/protocol/frame.md` specifies it byte by byte. No length from a peer is trusted for an allocation:
//! lengths are checked first.

mod age;
mod codec;
mod header;
mod kind;
mod long;
mod memory;
mod message;
mod mismatch;
mod protection;
mod read;
mod strict;
mod type_names;
mod type_schema;

pub use age::may_be_older;
pub use codec::{Checksum, FrameCodec, FrameError, decode_datagram, encode_frame};
pub use header::{Class, Flags, HEADER_LEN, Header, HeaderError, MAGIC, TIME_TO_LIVE_MAX, VERSION};
pub use kind::{Kind, fnv1a};
pub use memory::zeroed;
pub(crate) use message::decode_as;
pub use message::{DecodeError, Message, MessageBuffer, Payload, encode};
pub use mismatch::MismatchPolicy;
pub use protection::Protection;
pub use read::decode;
pub use sinew_schema::SchemaHash;
pub(crate) use type_names::{PLACES, remember};
pub use type_names::{PayloadType, known_types};
pub use type_schema::{TypeSchema, schema_of};
