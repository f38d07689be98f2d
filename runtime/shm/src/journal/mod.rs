//! A journal: the newest records of many threads, in a file that outlives its process.
//!
//! A journal is a ring in a memory-mapped file. Any thread of its process writes a record with one atomic addition and
//! one copy, and never waits: the newest bytes replace the oldest ones. Readers, in the same process or in others,
//! read the file and are not known to the writer. A reader that is too slow counts the records that it missed, by
//! the numbers that each channel gives to its messages.
//!
//! ```
//! use sinew_shm::journal::{ChannelKey, Journal, JournalReader, Options, Start};
//!
//! # let path = std::env::temp_dir().join(format!("sinew-journal-doc-{}", std::process::id()));
//! # #[cfg(target_os = "linux")] {
//! let journal = Journal::create(&path, &Options { ring_bytes: 1 << 20, ..Options::default() })?;
//! let knee = ChannelKey([1, 2, 3]);
//! journal.write(knee, 1_000, &[b"torque ", b"12 Nm"]);
//!
//! let mut reader = JournalReader::open(&path, Start::Oldest)?;
//! let mut payload = Vec::new();
//! let record = reader.next(2_000, &mut payload)?.expect("it was written");
//! assert_eq!((record.number, record.time, &payload[..]), (1, 1_000, &b"torque 12 Nm"[..]));
//! assert_eq!(reader.channels()?[0].key, Some(knee));
//! # std::fs::remove_file(&path)?;
//! # }
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! The file must lie in memory (`/dev/shm`, `/run`) where real-time threads write: on a disk the system may stop a
//! writer while it stores a page. The reasons are in `docs/decisions/0041-recording.md`.

#[cfg(not(loom))]
mod copy;
mod core;
mod error;
mod layout;
#[cfg(all(target_os = "linux", not(loom)))]
#[path = "file.rs"]
mod platform;
#[cfg(not(any(target_os = "linux", loom)))]
#[path = "elsewhere.rs"]
mod platform;
#[cfg(not(loom))]
mod reader;
#[cfg(all(test, target_os = "linux", not(any(loom, miri))))]
mod tests;
#[cfg(not(loom))]
mod writer;

#[cfg(not(loom))]
pub use self::{
    copy::{Copied, copy_joined, copy_span, each_record},
    reader::{Channel, JournalReader, Record, Start, Tally},
    writer::{Journal, Options},
};
pub use self::{
    core::{channels::ChannelKey, reader::ReaderCounts},
    error::{CopyJournalError, CreateJournalError, JournalHeaderError, ReadJournalError},
    layout::IDENTITY_MAX,
};
