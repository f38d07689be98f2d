//! Writes the records of a node's journal into the file of a recording.
//!
//! ```text
//! journal (sinew-shm) ──► Recorder: order, names, counters ──► BagWriter (sinew-bag) ──► walk.mcap
//!                            ▲
//! node ◄── Connection ── Session: renewals, structures of payload types, the end
//! ```
//!
//! - [`Recording`] is a recording of a program, on a thread of its own.
//! - [`Session`] is the same on the thread of its owner, as `sinew record` uses it. It asks the node through a
//!   [`Connection`], such as an endpoint of NodeAPI.
//! - [`Recorder`] takes a reader of the journal and a writer of the file. Its owner calls [`Recorder::pump`] every few
//!   milliseconds. It knows no node, no socket and no clock: names and times are arguments.
//! - [`Follower`] hands over the messages of a node as they pass, for programs that show them.
//! - [`LiveViews`] hands over the same channels and views as a recording has, as they come and without a file.
//! - [`FrozenRing`] is a journal that nothing writes any more: a frozen span, or the ring of a dead node.

mod channels;
mod error;
mod facts;
mod file_name;
mod follower;
mod frozen;
mod live;
mod names;
mod order;
mod recorder;
mod recording;
mod session;
mod setup;
mod sink;
mod span;
#[cfg(test)]
mod tests;

pub use error::RecordingError;
pub use follower::{Follower, Seen};
pub use frozen::{FrozenFile, FrozenRing, RingOrigin};
pub use live::LiveViews;
pub use names::Names;
pub use order::WINDOW;
pub use recorder::Recorder;
pub use recording::Recording;
pub use session::{Connection, End, RecordingOptions, Session, Summary};
pub use setup::Setup;
pub use sinew_bag::{BagError, Compression, Options as FileOptions, Totals, ViewChannel, ViewItem};
pub use sinew_record::{
    Selection,
    files::{Owners, is_own, read_facts},
};
pub use sinew_shm::journal::{JournalReader, ReadJournalError, Start};
pub use span::Span;
