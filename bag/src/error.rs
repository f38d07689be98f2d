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

/// The remedy for each kind of cause.
const REMEDIES: [(io::ErrorKind, &str); 7] = [
    (io::ErrorKind::StorageFull, "free space on this disk, or record to another one"),
    (io::ErrorKind::QuotaExceeded, "free space within this user's quota, or record to another disk"),
    (io::ErrorKind::FileTooLarge, "split the recording into parts"),
    (io::ErrorKind::ReadOnlyFilesystem, "record to a folder in which this user may write"),
    (io::ErrorKind::PermissionDenied, "record to a folder in which this user may write"),
    (io::ErrorKind::AlreadyExists, "choose another name, or move this file: none is overwritten"),
    (io::ErrorKind::NotFound, "make the folder first"),
];

fn remedy(cause: &io::Error) -> &'static str {
    let known = REMEDIES.iter().find(|(kind, _)| *kind == cause.kind());
    known.map_or("check the disk, or record to another one", |(_, remedy)| remedy)
}

/// Maximum damaged records of one file that are named.
const DAMAGE_MAX: usize = 1_000;

/// The damaged records of a file: the first ones are named, the others are counted.
#[derive(Debug, Default)]
pub(crate) struct DamageList {
    named: Vec<String>,
    further: u64,
}

impl DamageList {
    pub(crate) fn add(&mut self, damage: &BagError) {
        if self.named.len() < DAMAGE_MAX {
            self.named.push(damage.to_string());
        } else {
            self.further += 1;
        }
    }

    /// Returns a line for each named record, and one with the number of the others.
    pub(crate) fn into_lines(mut self, path: &Path) -> Vec<String> {
        if self.further > 0 {
            self.named.push(format!("{}: {} further records are damaged", path.display(), self.further));
        }
        self.named
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn damage_beyond_the_limit_is_counted() {
        let (mut damage, path) = (DamageList::default(), Path::new("walk.mcap"));
        for _ in 0..DAMAGE_MAX + 500 {
            damage.add(&BagError::Unfit("damaged".to_owned()));
        }
        let lines = damage.into_lines(path);
        assert_eq!(lines.len(), DAMAGE_MAX + 1);
        assert_eq!(lines[DAMAGE_MAX], "walk.mcap: 500 further records are damaged");
    }
}
