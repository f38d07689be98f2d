//! Errors of journals.

use std::{io, path::PathBuf};

use thiserror::Error;

/// Why a journal was not created. Nothing has changed at its path.
#[derive(Debug, Error)]
pub enum CreateJournalError {
    /// The size is none that a ring has.
    #[error(
        "a journal of {0} bytes cannot be made: choose 65536 to 4294967296 bytes; it is rounded up to a power of two"
    )]
    Size(u64),
    /// The identity is too long.
    #[error("the identity of a journal has at most 1024 bytes, and this one has {0}")]
    Identity(usize),
    /// The path has no file name, or others may replace files in its folder.
    #[error("a journal cannot be made at {}: {why}", path.display())]
    Folder {
        /// The path of the journal.
        path: PathBuf,
        /// The reason.
        why: &'static str,
    },
    /// Another user has a file of this name in a folder in which nobody else may replace it, such as `/dev/shm`.
    #[error(
        "a journal cannot be made: {} is a file of the user with the number {owner}, and this process has the number {own}; choose a folder of this user alone, or have that file removed",
        path.display()
    )]
    Taken {
        /// The file of the other user.
        path: PathBuf,
        /// The number of its user.
        owner: u32,
        /// The number of the user of this process.
        own: u32,
    },
    /// A call of the system failed: a full disk, missing permission, lack of memory.
    #[error("a journal cannot be made at {}: {step}: {cause}", path.display())]
    System {
        /// The path of the journal.
        path: PathBuf,
        /// The step that failed.
        step: &'static str,
        /// The system's reason.
        cause: io::Error,
    },
    /// This platform has no journals.
    #[error("journals need Linux")]
    Unsupported,
}

/// Why a file's first page is that of no journal.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Error)]
pub enum JournalHeaderError {
    /// The first bytes are others.
    #[error("it is not a journal of Sinew")]
    Magic,
    /// It was written by another version.
    #[error("it is a journal of version {0}, and this program reads version {VERSION}", VERSION = super::layout::VERSION)]
    Version(u32),
    /// Bytes of the page have changed.
    #[error("the checksum of its first page is wrong: the file was damaged")]
    Checksum,
    /// The sizes in it are none that a writer chooses.
    #[error("the sizes in its first page are wrong: the file was damaged")]
    Sizes,
}

/// Why a journal cannot be read.
#[derive(Debug, Error)]
pub enum ReadJournalError {
    /// The file cannot be opened or read.
    #[error("the journal {} cannot be read: {cause}", path.display())]
    System {
        /// The path of the journal.
        path: PathBuf,
        /// The system's reason.
        cause: io::Error,
    },
    /// It is no file.
    #[error("the journal {} cannot be read: it is no ordinary file", .0.display())]
    Kind(PathBuf),
    /// The first page is that of no journal.
    #[error("the journal {} cannot be read: {why}", path.display())]
    Header {
        /// The path of the journal.
        path: PathBuf,
        /// The fault of its first page.
        why: JournalHeaderError,
    },
    /// The file is shorter than its first page says.
    #[error("the journal {} has {found} bytes where its first page says {stated}: it was cut", path.display())]
    Length {
        /// The path of the journal.
        path: PathBuf,
        /// The length of the file.
        found: u64,
        /// The length that its first page states.
        stated: u64,
    },
    /// So much of the ring is damaged that reading was given up.
    #[error("the journal {} is damaged at byte {position} of its records, and so is what follows", path.display())]
    Damaged {
        /// The path of the journal.
        path: PathBuf,
        /// The position in the journal.
        position: u64,
    },
}

/// Why a span of a journal was not copied. There is no new file.
#[derive(Debug, Error)]
pub enum CopyJournalError {
    /// The source cannot be read.
    #[error(transparent)]
    Read(#[from] ReadJournalError),
    /// The copy cannot be created or written.
    #[error(transparent)]
    Create(#[from] CreateJournalError),
}
