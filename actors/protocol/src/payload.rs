//! The payloads of the protocol between LNCL and its clients; `docs/protocol/lncl.md` specifies the bytes.

use bytes::Bytes;
use serde::{Deserialize, Serialize, de::DeserializeOwned};
pub use sinew_model::facts::TypeDeclaration;
use sinew_model::{bounded::at_most, nearest::NEAREST_MAX};
use sinew_runtime::{
    tid::{AppAddress, NodeAddress, Tid},
    wire::{Class, Header, Kind, Message, decode},
};

/// Maximum payload of a connection's first frame, in bytes: enough for the longest lists that are allowed.
pub const REGISTER_BYTES_MAX: usize = 24 * 1024;

/// A process requests a transport address.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Register {
    /// Name of the application.
    #[serde(default)]
    pub name: Option<String>,
    /// The fixed address that it requests; none = a dynamic one.
    #[serde(default)]
    pub address: Option<AppAddress>,
    /// The applications that it requires.
    #[serde(default)]
    pub requires: Vec<String>,
    /// The layers' events that it subscribes to.
    #[serde(default)]
    pub events: Vec<Kind>,
    /// Names of the payload types that it sends or handles, so that a collision of their ids is found.
    #[serde(default)]
    pub kinds: Vec<String>,
    /// Process id as the client sees it; for display. The node trusts the kernel's.
    #[serde(default)]
    pub pid: u32,
    /// Whether other clients of the node may have direct links to it.
    #[serde(default)]
    pub direct: bool,
    /// Whether it can use rings in shared memory.
    #[serde(default)]
    pub ring: bool,
    /// The dynamic address that it had before its connection ended. It gets the address again if that is free.
    #[serde(default)]
    pub former: Option<AppAddress>,
    /// Whether it wants to be notified of the applications that it waits for.
    #[serde(default)]
    pub waits: bool,
}

/// The applications that a waiting client still requires.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Waiting {
    /// Empty if they are not known yet.
    pub missing: Vec<Missing>,
}

/// One requirement that is not ready.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Missing {
    /// Its name, or the text of the requirement.
    pub what: String,
    /// For display.
    pub why: String,
}

/// The address that a process was given.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Registered {
    /// Address of the node.
    pub node: NodeAddress,
    /// Address of the application.
    pub app: AppAddress,
    /// Name of the node.
    pub node_name: String,
    /// Maximum payload that the node sends and receives, in bytes.
    pub payload_max: u32,
    /// Size in bytes of the ring that each side offers next; none = all messages use the socket.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ring: Option<u32>,
    /// Whether the node reads declarations of types. One of a former version does not.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub types: bool,
    /// Whether the node waits for [`Kind::LNCL_READY`].
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub ready: bool,
}

/// Reason for a refused registration or for the end of a connection.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Refusal {
    /// For display.
    pub sentence: String,
    /// Whether the client may register again, since the fault is not its own.
    #[serde(default)]
    pub again: bool,
}

/// Joins or leaves a group.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Group {
    /// The group's address.
    pub group: AppAddress,
    /// Whether to be a member from now on.
    pub member: bool,
}

/// Requests the TID of a name.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Resolve {
    /// The name.
    pub name: String,
    /// Whether similar names are requested, if the name is unused.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub nearest: bool,
}

/// The TID of a name.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Resolved {
    /// Its 64 bits; none = the name is unused.
    pub tid: Option<u64>,
    /// Similar names, if they were requested and the name is unused.
    #[serde(
        default,
        skip_serializing_if = "Vec::is_empty",
        deserialize_with = "at_most::<_, _, NEAREST_MAX>"
    )]
    pub nearest: Vec<String>,
}

/// Requests a direct link.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Introduce {
    /// 64 bits of the TID of the other side.
    pub to: u64,
}

/// Notifies both sides of a direct link: first the target, then the requester.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Introduction {
    /// 64 bits of the TID of the other side.
    pub peer: u64,
    /// The other side's process, as the kernel reports it.
    pub pid: u32,
    /// The link's number; it also accompanies the link's socket.
    pub number: u64,
}

/// From this frame on, the source sends to its peer only on their link.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Switch {
    /// 64 bits of the TID of the other side, as the source sees it.
    pub peer: u64,
    /// The link's number.
    pub number: u64,
}

/// The process at the other end of a direct link has ended, even if another process holds that end.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Gone {
    /// 64 bits of the TID of the other side.
    pub peer: u64,
    /// The link's number.
    pub number: u64,
}

/// Requests reports of the messages on the direct links of a client, or ends them.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Observe {
    /// Whether the client reports from now on.
    pub on: bool,
}

/// Unconfirmed messages of the client that were not delivered, since the last report.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Undelivered {
    /// One for each destination and reason; a few at most.
    pub entries: Vec<UndeliveredEntry>,
}

/// Undelivered messages to one destination, for one reason.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct UndeliveredEntry {
    /// 64 bits of the destination's TID; 0: several that are combined.
    pub to: u64,
    /// Code of the outcome that each of them would have had.
    pub why: u8,
    /// Number of messages.
    pub count: u64,
    /// Time of the first rejection: nanoseconds of the system's monotonic clock.
    pub since: u64,
    /// Type of the payload; none: several, or unknown.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub kind: Option<Kind>,
    /// Class of the first of them.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub class: Option<Class>,
    /// Lowest sequence of them, if known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub first: Option<u64>,
    /// Highest sequence of them, if known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub last: Option<u64>,
    /// Name of the destination.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub name: Option<String>,
}

/// Returns the TID of the LNCL of `node`.
pub const fn lncl_of(node: NodeAddress) -> Tid {
    Tid::new(node, AppAddress::LNCL)
}

/// Returns the frame of a layer's payload.
pub fn frame<P: Serialize>(kind: Kind, source: Tid, destination: Tid, payload: &P) -> Message {
    let bytes = rmp_serde::to_vec_named(payload).expect("these types have no map with equal keys");
    Message::new(Header::new(kind, source, destination), bytes.into())
}

/// Parses a layer's payload.
pub fn read<P: DeserializeOwned>(payload: &Bytes) -> Result<P, rmp_serde::decode::Error> {
    decode(payload)
}
