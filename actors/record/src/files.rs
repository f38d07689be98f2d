//! The files of recordings, in a folder that other users of the host may write into, such as `/dev/shm`.

use std::{
    fs::{File, Metadata},
    io::{self, Read as _},
    os::unix::fs::MetadataExt as _,
    path::Path,
};

use rustix::{
    fs::{Mode, OFlags},
    process::geteuid,
};
use sinew_runtime::wire;

use crate::frozen::FrozenFacts;

/// Maximum bytes of a file with facts. What follows is not read.
const FACTS_BYTES_MAX: u64 = 4 << 20;

/// The owners of files that are read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Owners {
    /// The user of this process alone.
    ThisUser,
    /// The user of this process; for root, all users.
    AllForRoot,
}

impl Owners {
    fn has(self, metadata: &Metadata) -> bool {
        let own = geteuid().as_raw();
        metadata.is_file() && (metadata.uid() == own || (self == Self::AllForRoot && own == 0))
    }
}

/// Returns whether it is an ordinary file of these users: no link, and no pipe.
///
/// # Examples
///
/// ```
/// use sinew_record::files::{Owners, is_own};
///
/// assert!(!is_own(&std::env::temp_dir(), Owners::ThisUser), "a folder is no file");
/// ```
#[must_use]
pub fn is_own(path: &Path, owners: Owners) -> bool {
    path.symlink_metadata().is_ok_and(|metadata| owners.has(&metadata))
}

/// Opens an ordinary file of these users for reading. It follows no link, and waits for no writer of a pipe.
///
/// # Errors
/// It cannot be opened, or is no ordinary file of these users.
pub fn open_own(path: &Path, owners: Owners) -> io::Result<File> {
    let flags = OFlags::RDONLY | OFlags::NOFOLLOW | OFlags::NONBLOCK | OFlags::CLOEXEC;
    let file = File::from(rustix::fs::open(path, flags, Mode::empty())?);
    // The file that is open: the name may mean another one by now.
    if owners.has(&file.metadata()?) {
        Ok(file)
    } else {
        Err(io::Error::new(io::ErrorKind::PermissionDenied, "it is no ordinary file of this user"))
    }
}

/// Reads the facts beside a journal: at most 4 MiB.
///
/// # Errors
/// As [`open_own`]; or it cannot be read, or has no facts.
pub fn read_facts(path: &Path, owners: Owners) -> io::Result<FrozenFacts> {
    let mut bytes = Vec::new();
    open_own(path, owners)?.take(FACTS_BYTES_MAX).read_to_end(&mut bytes)?;
    wire::decode(&bytes).map_err(|why| io::Error::new(io::ErrorKind::InvalidData, why.to_string()))
}

#[cfg(test)]
mod tests {
    use std::{fs, os::unix::fs::symlink};

    use super::*;

    #[test]
    fn only_ordinary_files_are_read() {
        let folder = std::env::temp_dir().join(format!("sinew-record-files-{}", std::process::id()));
        fs::create_dir_all(&folder).unwrap();
        let [facts, link] = ["knee.facts", "link.facts"].map(|name| folder.join(name));
        let written = FrozenFacts::default();
        fs::write(&facts, wire::encode(&written)).unwrap();
        symlink(&facts, &link).unwrap();
        for owners in [Owners::ThisUser, Owners::AllForRoot] {
            assert_eq!(read_facts(&facts, owners).unwrap(), written);
            // A link may name a file of another user, which root could read.
            assert!(!is_own(&link, owners) && read_facts(&link, owners).is_err());
            assert!(!is_own(&folder, owners) && read_facts(&folder, owners).is_err());
        }
        fs::write(&facts, b"no facts").unwrap();
        assert_eq!(read_facts(&facts, Owners::ThisUser).unwrap_err().kind(), io::ErrorKind::InvalidData);
        fs::remove_dir_all(&folder).unwrap();
    }

    #[test]
    fn file_of_another_user_is_refused() {
        // A file of root that everybody may read, or, for root, one that is given away.
        let path = std::env::temp_dir().join(format!("sinew-record-owner-{}", std::process::id()));
        let is_root = geteuid().is_root();
        let other = if is_root {
            fs::write(&path, b"").unwrap();
            std::os::unix::fs::chown(&path, Some(65_534), None).unwrap();
            path.clone()
        } else {
            Path::new("/etc/passwd").to_owned()
        };
        assert!(!is_own(&other, Owners::ThisUser));
        assert_eq!(open_own(&other, Owners::ThisUser).unwrap_err().kind(), io::ErrorKind::PermissionDenied);
        assert_eq!(is_own(&other, Owners::AllForRoot), is_root);
        if is_root {
            fs::remove_file(&path).unwrap();
        }
    }
}
