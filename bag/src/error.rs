//! The failures of recordings, each with its path and its remedy.

use std::{
    io,
    path::{Path, PathBuf},
};

use thiserror::Error;

/// A recording cannot be written or read.
#[derive(Debug, Error)]
pub enum BagError {
    /// The disk or the folder refused. Nothing is written until there is room again.
    #[error("{path}: {cause}; {}", remedy(cause), path = path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// The cause, as the system names it.
        #[source]
        cause: io::Error,
    },
    /// The file cannot be opened or read.
    #[error("{path}: {cause}; check the path and its permissions", path = path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// The cause, as the system names it.
        #[source]
        cause: io::Error,
    },
    /// The recording has reached [`Options::size_max`](crate::Options::size_max).
    #[error("{path}: the recording has {bytes} bytes, its limit; raise the limit or record fewer channels", path = path.display())]
    Full {
        /// The last file.
        path: PathBuf,
        /// Bytes of all parts.
        bytes: u64,
    },
    /// There are as many channels as a recording may have.
    #[error("{path}: the recording has {limit} channels, the maximum; record fewer applications or types", path = path.display())]
    Channels {
        /// The file.
        path: PathBuf,
        /// The maximum.
        limit: usize,
    },
    /// The file is no recording, or it is damaged.
    #[error("{path}: {fault}, at byte {at}; {remedy}", path = path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// The fault.
        fault: String,
        /// Position in the file, in bytes.
        at: u64,
        /// The suggestion for the user.
        remedy: &'static str,
    },
    /// The files do not go together.
    #[error("{0}")]
    Unfit(String),
}

impl BagError {
    pub(crate) fn write(path: &Path, cause: io::Error) -> Self {
        Self::Write { path: path.to_owned(), cause }
    }

    pub(crate) fn read(path: &Path, cause: io::Error) -> Self {
        Self::Read { path: path.to_owned(), cause }
    }
}

fn remedy(cause: &io::Error) -> &'static str {
    match cause.kind() {
        io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded | io::ErrorKind::FileTooLarge => {
            "free space on this disk, or record to another one"
        }
        io::ErrorKind::ReadOnlyFilesystem | io::ErrorKind::PermissionDenied => {
            "record to a folder in which this user may write"
        }
        io::ErrorKind::AlreadyExists => "choose another name, or move this file: none is overwritten",
        io::ErrorKind::NotFound => "make the folder first",
        _ => "check the disk, or record to another one",
    }
}
