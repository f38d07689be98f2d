//! What LNCL and its clients say to each other; byte by byte in `docs/protocol/lncl.md`.

use bytes::Bytes;
use serde::{Deserialize, Serialize, de::DeserializeOwned};
use sinew_runtime::{
    tid::{AppAddress, NodeAddress, Tid},
    wire::{Class, Header, Kind, Message, decode},
};

use crate::{nearest::NEAREST_MAX, sync::at_most};

/// Longest payload of a connection's first frame, in bytes: enough for the longest lists that are allowed.
pub(crate) const REGISTER_BYTES_MAX: usize = 24 * 1024;

/// A process asks for a transport address.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Register {
    /// Name of the application.
    #[serde(default)]
    pub(crate) name: Option<String>,
    /// The fixed address that it wants; none = a dynamic one.
    #[serde(default)]
    pub(crate) address: Option<AppAddress>,
    /// What it requires.
    #[serde(default)]
    pub(crate) requires: Vec<String>,
    /// The layers' events that it wants.
    #[serde(default)]
    pub(crate) events: Vec<Kind>,
    /// Names of the payload types that it sends or handles, so that a collision of their ids is found.
    #[serde(default)]
    pub(crate) kinds: Vec<String>,
    /// Process id as the client sees it; for people. The node believes the kernel's.
    #[serde(default)]
    pub(crate) pid: u32,
    /// Whether others of the node may be introduced to it, to send to it directly.
    #[serde(default)]
    pub(crate) direct: bool,
    /// Whether it can use rings in shared memory.
    #[serde(default)]
    pub(crate) ring: bool,
    /// The dynamic address that it had before its connection ended; given to it again if it is free.
    #[serde(default)]
    pub(crate) former: Option<AppAddress>,
    /// Whether it wants to be told what it waits for.
    #[serde(default)]
    pub(crate) waits: bool,
}

/// What a client waits for that is not registered yet.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Waiting {
    /// Nothing: it is not known yet.
    pub(crate) missing: Vec<Missing>,
}

/// One thing that is required and not ready.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Missing {
    /// Its name, or as it was required.
    pub(crate) what: String,
    /// For people.
    pub(crate) why: String,
}

/// The address that a process got.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Registered {
    /// Address of the node.
    pub(crate) node: NodeAddress,
    /// Address of the application.
    pub(crate) app: AppAddress,
    /// Name of the node.
    pub(crate) node_name: String,
    /// Longest payload that the node takes and sends, in bytes.
    pub(crate) payload_max: u32,
    /// Bytes of the ring that each side offers next; none = everything goes through the socket.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) ring: Option<u32>,
}

/// Why a registration was refused or a connection ends.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Refusal {
    /// For people.
    pub(crate) sentence: String,
    /// Whether the client may register again, since the fault is not its own.
    #[serde(default)]
    pub(crate) again: bool,
}

/// Joins or leaves a group.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Group {
    /// The group's address.
    pub(crate) group: AppAddress,
    /// Whether to be a member from now on.
    pub(crate) member: bool,
}

/// Asks for the TID of a name.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Resolve {
    /// The name.
    pub(crate) name: String,
    /// Whether similar names are wanted, where nobody has it.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub(crate) nearest: bool,
}

/// The TID of a name.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Resolved {
    /// Its 64 bits; none = nobody has the name.
    pub(crate) tid: Option<u64>,
    /// Similar names, where they were wanted and nobody has it.
    #[serde(
        default,
        skip_serializing_if = "Vec::is_empty",
        deserialize_with = "at_most::<_, _, NEAREST_MAX>"
    )]
    pub(crate) nearest: Vec<String>,
}

/// Asks for a direct link.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Introduce {
    /// 64 bits of the TID of the other side.
    pub(crate) to: u64,
}

/// Both sides of a direct link are told so: first the one that is asked for it, then the one that asks.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Introduction {
    /// 64 bits of the TID of the other side.
    pub(crate) peer: u64,
    /// The other side's process, as the kernel says.
    pub(crate) pid: u32,
    /// The link's number; it stands beside the link's socket, too.
    pub(crate) number: u64,
}

/// From here on the source sends to its peer on their link only.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Switch {
    /// 64 bits of the TID of the other side, as the source sees it.
    pub(crate) peer: u64,
    /// The link's number.
    pub(crate) number: u64,
}

/// The process at the other end of a direct link has ended, whoever else holds that end.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Gone {
    /// 64 bits of the TID of the other side.
    pub(crate) peer: u64,
    /// The link's number.
    pub(crate) number: u64,
}

/// Unconfirmed messages of the client that nobody has taken, since it was told so last.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Undelivered {
    /// One for each destination and reason; a few at most.
    pub(crate) entries: Vec<UndeliveredEntry>,
}

/// Those to one destination, for one reason.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct UndeliveredEntry {
    /// 64 bits of the destination's TID; 0: several that are not told apart any more.
    pub(crate) to: u64,
    /// Code of the outcome that each of them would have had.
    pub(crate) why: u8,
    /// How many.
    pub(crate) count: u64,
    /// When the first of them was refused: nanoseconds of the system's monotonic clock.
    pub(crate) since: u64,
    /// Type of the payload; none: several, or not known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) kind: Option<Kind>,
    /// Class of the first of them.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) class: Option<Class>,
    /// Lowest sequence of them, where it is known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) first: Option<u64>,
    /// Highest sequence of them, where it is known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) last: Option<u64>,
    /// Name of the destination.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) name: Option<String>,
}

/// The TID of the LNCL of `node`.
pub(crate) const fn lncl_of(node: NodeAddress) -> Tid {
    Tid::new(node, AppAddress::LNCL)
}

/// The frame of a layer's payload.
pub(crate) fn frame<P: Serialize>(kind: Kind, source: Tid, destination: Tid, payload: &P) -> Message {
    let bytes = rmp_serde::to_vec_named(payload).expect("these types have no map with equal keys");
    Message::new(Header::new(kind, source, destination), bytes.into())
}

/// Reads a layer's payload.
pub(crate) fn read<P: DeserializeOwned>(payload: &Bytes) -> Result<P, rmp_serde::decode::Error> {
    decode(payload)
}
