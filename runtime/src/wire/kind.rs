//! Stable IDs of payload types.

use std::fmt;

use serde::{Deserialize, Serialize};

/// FNV-1a, 32 bits (Fowler, Noll, Vo; draft-eastlake-fnv section 2): stable in every language, in a dozen lines.
#[must_use]
pub const fn fnv1a(bytes: &[u8]) -> u32 {
    let mut hash: u32 = 0x811c_9dc5;
    let mut at = 0;
    while at < bytes.len() {
        hash = (hash ^ bytes[at] as u32).wrapping_mul(0x0100_0193);
        at += 1;
    }
    hash
}

/// The stable ID of a payload's type.
///
/// IDs below `0x8000_0000` belong to Sinew's own layers; a user's kind is the hash of its name with the top
/// bit set. Two names on one node with equal hashes are rejected when the second is registered.
///
/// # Examples
///
/// ```
/// use sinew::{Payload, message::Kind, payload};
///
/// payload!("demo.angle", Stream => struct Angle { degrees: f32 });
///
/// // The kind depends on the name alone, so that each language has the same.
/// assert_eq!(Angle::KIND, Kind::named("demo.angle"));
/// ```
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Kind(u32);

impl Kind {
    /// The outcome of a confirmed message: one byte, see [`Outcome::code`](crate::outcome::Outcome::code).
    pub const OUTCOME: Self = Self(1);
    /// Cancels the request of its correlation: the reply is no longer awaited.
    pub const CANCEL: Self = Self(2);
    /// Reports about the members of a confirmed message to many: see [`MemberReport`](crate::outcome::MemberReport).
    pub const MEMBERS: Self = Self(3);
    /// First frame of a connection between nodes.
    pub const GNCL_HELLO: Self = Self(0x10);
    /// Answer to a hello that is accepted.
    pub const GNCL_WELCOME: Self = Self(0x11);
    /// Answer to a hello that is rejected: a sentence with the reason.
    pub const GNCL_REFUSAL: Self = Self(0x12);
    /// Requests a sign of life from the peer's GNCL actor.
    pub const GNCL_PING: Self = Self(0x13);
    /// The sign of life.
    pub const GNCL_PONG: Self = Self(0x14);
    /// Orderly end of a connection.
    pub const GNCL_GOODBYE: Self = Self(0x15);
    /// The next sequence that its sender expects.
    pub const GNCL_ACK: Self = Self(0x16);
    /// Replaces a message that became obsolete before it arrived.
    pub const GNCL_VOID: Self = Self(0x17);
    /// Several outcomes of confirmed messages.
    pub const GNCL_OUTCOMES: Self = Self(0x18);
    /// The address at which its sender reads datagrams.
    pub const GNCL_DATAGRAMS: Self = Self(0x19);
    /// Unconfirmed messages of the receiver's applications that its sender rejected.
    pub const GNCL_UNDELIVERED: Self = Self(0x1a);
    /// Runs of outcomes of confirmed messages.
    pub const GNCL_OUTCOME_RUNS: Self = Self(0x1b);
    /// A query for present nodes, or whether a known node is alive.
    pub const NDL_QUERY: Self = Self(0x20);
    /// The matched answer.
    pub const NDL_ANSWER: Self = Self(0x21);
    /// An orderly departure of a node.
    pub const NDL_LEAVE: Self = Self(0x22);
    /// The names that a node's applications have, and which of them are ready.
    pub const SYNC_DIRECTORY: Self = Self(0x30);
    /// The applications of the receiver's node that the sender monitors, by incarnation.
    pub const SYNC_WATCH: Self = Self(0x31);
    /// The current incarnation of each of them, and the end reason of its last one.
    pub const SYNC_LIVES: Self = Self(0x32);
    /// The last wills of a node's applications, to be held.
    pub const SYNC_WILLS: Self = Self(0x33);
    /// A query for the state of all messages of a node.
    pub const SYNC_AUDIT_ASK: Self = Self(0x34);
    /// The answer to it.
    pub const SYNC_AUDIT: Self = Self(0x35);
    /// The waiters at run-time barriers on a node, and the open generation of each barrier.
    pub const SYNC_ARRIVALS: Self = Self(0x36);
    /// A trigger: all nodes freeze their recordings around it.
    pub const SYNC_FREEZE: Self = Self(0x37);
    /// Requests the structure of a payload type.
    pub const SYNC_SCHEMA_ASK: Self = Self(0x38);
    /// The structure of a payload type.
    pub const SYNC_SCHEMA: Self = Self(0x39);
    /// A message was of a type that its receiver declared differently.
    pub const SYNC_MISMATCH: Self = Self(0x3A);
    /// A process requests a transport address.
    pub const LNCL_REGISTER: Self = Self(0x40);
    /// The assigned address.
    pub const LNCL_REGISTERED: Self = Self(0x41);
    /// The reason why no address was assigned, or why the connection ends: a sentence.
    pub const LNCL_REFUSAL: Self = Self(0x42);
    /// A process releases its address.
    pub const LNCL_UNREGISTER: Self = Self(0x43);
    /// A process joins or leaves a group.
    pub const LNCL_GROUP: Self = Self(0x44);
    /// A process requests the TID of a name.
    pub const LNCL_RESOLVE: Self = Self(0x45);
    /// The TID of a name, or none.
    pub const LNCL_RESOLVED: Self = Self(0x46);
    /// Requests or ends reports of the messages on the direct links of a process.
    pub const LNCL_OBSERVE: Self = Self(0x47);
    /// A process requests a direct link to an application of another process.
    pub const LNCL_INTRODUCE: Self = Self(0x48);
    /// The request to that process; the link's socket is attached.
    pub const LNCL_INTRODUCTION: Self = Self(0x49);
    /// The confirmation of the other side; the link's socket is attached.
    pub const LNCL_INTRODUCED: Self = Self(0x4a);
    /// From here on a process sends to another one only on their link.
    pub const LNCL_SWITCH: Self = Self(0x4b);
    /// Reports to a process which of its unconfirmed messages were not accepted.
    pub const LNCL_UNDELIVERED: Self = Self(0x4c);
    /// Reports to a process that the peer of a direct link has ended.
    pub const LNCL_GONE: Self = Self(0x4d);
    /// Reports to a waiting client the conditions that it waits for.
    pub const LNCL_WAITING: Self = Self(0x4e);
    /// Reports a message on a direct link of a process.
    pub const LNCL_OBSERVED: Self = Self(0x4f);

    /// The first frame from a node to the process that it started for an application: the application's identity.
    pub const HOST_WELCOME: Self = Self(0x50);
    /// The application in that process is ready.
    pub const HOST_READY: Self = Self(0x51);
    /// The application has finished one message and takes the next.
    pub const HOST_TURN: Self = Self(0x52);
    /// The node orders the application to stop.
    pub const HOST_STOP: Self = Self(0x53);
    /// The application has ended, with the reason; its process ends next.
    pub const HOST_ENDED: Self = Self(0x54);
    /// A sign of life.
    pub const HOST_BEAT: Self = Self(0x55);
    /// The application exceeded its progress budget, with its activity.
    pub const HOST_HUNG: Self = Self(0x56);
    /// The application looks up a name, and subscribes to its changes.
    pub const HOST_LOOK: Self = Self(0x57);
    /// The current TIDs of some names.
    pub const HOST_NAMES: Self = Self(0x58);

    /// A client declares the structure of a payload type that it handles or sends. The range of the other frames of
    /// LNCL is full.
    pub const LNCL_TYPE: Self = Self(0x60);
    /// The program of a command is ready.
    pub const LNCL_READY: Self = Self(0x61);

    /// The presses and releases of the stop that a node knows, and whether its outputs are safe.
    pub const STOP_STATE: Self = Self(0x70);

    /// Requests a sign of life: confirmed, it ends as `Delivered` once its destination has handled it.
    pub const PING: Self = Self::named("sinew.ping");

    /// Returns whether this is used only between a node and a process that it started.
    #[must_use]
    pub const fn is_host(self) -> bool {
        matches!(self.0, 0x50..0x60)
    }

    /// Returns the ID of the user's payload type called `name`.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::message::Kind;
    ///
    /// /// Raw samples of a force plate: bytes that no Rust type describes.
    /// const SAMPLES: Kind = Kind::named("plate.samples");
    /// assert!(SAMPLES.is_user());
    /// ```
    #[must_use]
    pub const fn named(name: &str) -> Self {
        Self(fnv1a(name.as_bytes()) | 0x8000_0000)
    }

    /// Returns the ID with these 32 bits.
    #[must_use]
    pub const fn from_bits(bits: u32) -> Self {
        Self(bits)
    }

    /// Returns the 32 bits of this ID.
    #[must_use]
    pub const fn bits(self) -> u32 {
        self.0
    }

    /// Returns whether this belongs to a user's type, not to a layer.
    #[must_use]
    pub const fn is_user(self) -> bool {
        self.0 >= 0x8000_0000
    }
}

impl fmt::Display for Kind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:08x}", self.0)
    }
}

impl fmt::Debug for Kind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Test vectors of draft-eastlake-fnv, appendix C.
    #[test]
    fn hash_agrees_with_the_published_vectors() {
        assert_eq!(fnv1a(b""), 0x811c_9dc5);
        assert_eq!(fnv1a(b"a"), 0xe40c_292c);
        assert_eq!(fnv1a(b"foobar"), 0xbf9c_f968);
    }

    #[test]
    fn named_kinds_never_equal_layer_kinds() {
        assert!(Kind::named("exo.joint_sample").is_user());
        assert!(!Kind::NDL_QUERY.is_user());
    }
}
