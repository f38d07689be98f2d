//! The facts that LNCL reports to the sync manager.

use serde::{Deserialize, Serialize};
use sinew_runtime::{
    tid::AppAddress,
    wire::{Kind, SchemaHash},
};

/// A payload type and the hash of its structure.
pub type TypeHash = (Kind, SchemaHash);

/// The payload types of an application, as far as their structures are known.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct DeclaredTypes {
    /// The types that it handles.
    pub handles: Vec<TypeHash>,
    /// The types that it has sent, or declared to send.
    pub sends: Vec<TypeHash>,
}

impl DeclaredTypes {
    /// Returns whether there is none.
    pub const fn is_empty(&self) -> bool {
        self.handles.is_empty() && self.sends.is_empty()
    }
}

/// The structure of a payload type that an application in another process handles or sends. Its bytes come from that
/// process and are not checked yet.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct TypeDeclaration {
    /// The type.
    pub kind: Kind,
    /// Whether the application handles it.
    #[serde(default)]
    pub handles: bool,
    /// Whether the application sends it.
    #[serde(default)]
    pub sends: bool,
    /// The word of the receiver's policy for messages of another version of the type. An unknown word stands for the
    /// default.
    #[serde(default)]
    pub policy: String,
    /// Whether messages of the type have end-to-end protection.
    #[serde(default)]
    pub protected: bool,
    /// The canonical bytes of the structure.
    #[serde(with = "serde_bytes")]
    pub schema: Vec<u8>,
}

/// The user that an application runs as.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum User {
    /// The node's own user or root: the application is one of the robot's own.
    Own,
    /// This user, which the access list admits.
    Guest(u32),
}

impl User {
    /// Returns the kind of user of a process of `uid`, at a node that runs as `own`.
    pub const fn of(uid: u32, own: u32) -> Self {
        if uid == own || uid == 0 { Self::Own } else { Self::Guest(uid) }
    }
}

/// A change of an application of this node.
#[derive(Clone, Debug, PartialEq, Eq)]
#[expect(missing_docs, reason = "each field is what its name says")]
pub enum AppFact {
    /// It has an address. The fact contains its name, if any, the names that it requires, and its user. One fact
    /// contains all of them, so that no receiver takes a guest for one of the node's own applications in between.
    Registered { app: AppAddress, name: Option<String>, requires: Vec<String>, user: User },
    /// The payloads that a registered application handles, if it reports them.
    Handles { app: AppAddress, kinds: Vec<Kind> },
    /// The structures of the types of a registered application: all that are known, each time.
    Types { app: AppAddress, types: DeclaredTypes },
    /// It has started, and receives messages.
    Ready { app: AppAddress },
    /// It receives no messages: it has failed, and is not restarted yet.
    Down { app: AppAddress },
    /// It receives no messages: it was stopped, or has ended normally.
    Stopped { app: AppAddress },
    /// It is unregistered.
    Unregistered { app: AppAddress },
    /// The groups with members on this node changed.
    GroupsChanged,
}

impl AppFact {
    /// Returns the fact of a registered application of the node's own user.
    pub fn own_registered(app: AppAddress, name: Option<String>, requires: Vec<String>) -> Self {
        Self::Registered { app, name, requires, user: User::Own }
    }
}
