//! The comparison of payload types between nodes.
//!
//! Each application's types are published in the directory by the hashes of their structures. A node compares the types
//! that applications of other nodes send with those that its own applications handle. It fetches a structure only where
//! two hashes of one type differ. An application in another process of this node declares its structures, and they are
//! compared with those of the node's other applications, too. The verdicts are in the routing table, which refuses
//! messages, or counts them. The first message of a type that differs is logged on both nodes, in words.
//!
//! All of it runs on one thread of low priority. A message that arrives before the verdict is decoded as usual, unless
//! the policy of its type is `Refuse`. The routing table drops the verdicts on a node when its route changes.
//!
//! | file | content |
//! | --- | --- |
//! | `app_type.rs` | one type of an application: a Rust type of this process, or a declaration |
//! | `declared.rs` | the types of this node's applications |
//! | `judgement.rs` | the comparison of two structures, the policy, and the words for both |
//! | `verdicts.rs` | all types that differ: which are missing, refused and logged |
//! | `reported.rs` | reports of other nodes on the messages of this node |
//! | `frames.rs` | the frames between nodes |
//! | `thread.rs` | the thread that does it |

mod app_type;
mod declared;
mod frames;
#[cfg(feature = "fuzzing")]
#[doc(hidden)]
pub mod fuzzing;
mod judgement;
mod reported;
mod thread;
mod verdicts;

use std::{
    collections::VecDeque,
    sync::{
        Arc, Mutex, Weak,
        atomic::{AtomicBool, Ordering},
    },
};

use sinew_model::{
    facts::{TypeDeclaration, User},
    ports::AppTypes,
};
use sinew_runtime::{
    lock,
    tid::{AppAddress, NodeAddress},
    wire::{Kind, Message, PayloadType, SchemaHash},
};
use sinew_sync::FrameHandler;
use tokio::sync::Notify;

use self::{declared::Declared, frames::Frame};
pub(crate) use self::{
    reported::{Report, Reported},
    thread::begin,
    verdicts::{Disagreement, Verdicts},
};
use crate::NodeState;

/// Maximum number of frames of other nodes that wait for the thread. A further one is refused, and counted.
const FRAMES_MAX: usize = 96;
/// Maximum number of them of one node: its questions, answers and reports of two steps.
const FRAMES_OF_NODE_MAX: usize = 24;

/// The payload types of the node's applications, and the verdicts on those of other nodes.
#[derive(Default)]
pub(crate) struct Types {
    declared: Declared,
    frames: Mutex<VecDeque<(NodeAddress, Frame)>>,
    /// The verdicts on messages to this node.
    pub(crate) verdicts: Mutex<Verdicts>,
    /// The reports of other nodes on messages from this one.
    pub(crate) reported: Mutex<Reported>,
    /// Wakes the thread.
    wake: Arc<Notify>,
    is_closed: AtomicBool,
}

impl Types {
    /// Records the types of an application that was registered.
    pub(crate) fn register(&self, app: AppAddress, handles: &[PayloadType], sends: &[PayloadType]) {
        self.declared.register(app, handles, sends);
        self.wake.notify_one();
    }

    /// Records that an application sends a type. It is called on the sending thread, once for each type.
    pub(crate) fn sends(&self, app: AppAddress, sent: PayloadType) {
        if self.declared.sends(app, sent) {
            self.wake.notify_one();
        }
    }

    /// Returns the canonical bytes of the structure with this hash that an application of this node has. The first call
    /// for a type takes up to some milliseconds.
    pub(crate) fn schema_of_hash(&self, kind: Kind, hash: SchemaHash) -> Option<Vec<u8>> {
        if let Some(own) = kind.schema_of_hash(hash) {
            return Some(own.schema().encode());
        }
        self.declared.schema_of_hash(kind, hash).map(|structure| structure.encode())
    }

    /// Returns the canonical bytes of the structure that a type has in this process, or else in another process of this
    /// node and its user. The first call for a type takes up to some milliseconds.
    pub(crate) fn schema_of(&self, kind: Kind) -> Option<Vec<u8>> {
        if let Some(Ok(own)) = kind.schema() {
            return Some(own.schema().encode());
        }
        self.declared.schema_of(kind).map(|structure| structure.encode())
    }

    /// Ends the thread.
    pub(crate) fn close(&self) {
        // SYNC: Release, and Acquire in the thread, although no other data depends on it.
        self.is_closed.store(true, Ordering::Release);
        self.wake.notify_one();
    }

    fn pop_frame(&self) -> Option<(NodeAddress, Frame)> {
        lock(&self.frames).pop_front()
    }
}

impl AppTypes for NodeState {
    fn declare(&self, app: AppAddress, user: User, declaration: TypeDeclaration) -> Result<(), String> {
        self.types.declared.declare(app, user, declaration)?;
        self.types.wake.notify_one();
        Ok(())
    }

    fn forget(&self, app: AppAddress) {
        self.types.declared.forget(app);
    }
}

/// The frames about types, which travel to the sync manager's TID.
pub(crate) struct Frames(pub(crate) Weak<NodeState>);

impl FrameHandler for Frames {
    fn receive(&self, from: NodeAddress, message: &Message) -> Result<(), String> {
        let Some(state) = self.0.upgrade() else { return Ok(()) };
        let frame = Frame::parse(from, message)?;
        let mut frames = lock(&state.types.frames);
        if frames.len() >= FRAMES_MAX {
            return Err(format!("from {from}, a frame about types behind {FRAMES_MAX} that wait"));
        }
        if frames.iter().filter(|(of, _)| *of == from).count() >= FRAMES_OF_NODE_MAX {
            return Err(format!(
                "from {from}, a frame about types behind {FRAMES_OF_NODE_MAX} of it that wait"
            ));
        }
        frames.push_back((from, frame));
        drop(frames);
        state.types.wake.notify_one();
        Ok(())
    }
}
