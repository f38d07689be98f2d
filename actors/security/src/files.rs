//! The key files of a node. Reading a file checks whether other users may read or change it.
//!
//! ```text
//! /etc/sinew/keys/      0700   security.keys names this directory
//!   node.key            0600   the node's own key (PKCS #8, PEM); it never leaves the node
//!   node.pem            0644   its certificate
//!   ca.pem              0644   the certificate of the project's authority
//!   discovery.key       0600   the project's key for datagrams of discovery: 64 hexadecimal digits
//!   denied.txt          0644   the deny list
//! ```

use std::{
    ffi::{OsStr, OsString},
    fs::{File, OpenOptions},
    io::{self, Read},
    os::{
        fd::{AsFd, OwnedFd},
        unix::{
            ffi::OsStringExt,
            fs::{MetadataExt, OpenOptionsExt},
        },
    },
    path::{Path, PathBuf},
};

use rustix::{
    fs::{CWD, Mode, OFlags, openat, readlinkat},
    io::Errno,
};
use zeroize::Zeroizing;

/// File name of the node's own key.
pub const NODE_KEY: &str = "node.key";
/// File name of the node's certificate.
pub const NODE_CERTIFICATE: &str = "node.pem";
/// File name of the certificate of the project's authority.
pub const AUTHORITY: &str = "ca.pem";
/// File name of the project's key for discovery datagrams.
pub const DISCOVERY_KEY: &str = "discovery.key";
/// File name of the deny list.
pub const DENIED: &str = "denied.txt";

/// Maximum size of a key or certificate file in bytes. Those that `sinew keys` makes have less than 1 KiB.
const KEY_BYTES_MAX: u64 = 16 << 10;
/// Maximum size of a deny list in bytes: the maximum count of numbers, each with a comment.
const DENIED_BYTES_MAX: u64 = 8 << 20;

/// Maximum number of symbolic links in a chain from the path of an access list: more than any deliberate chain has.
const LINKS_MAX: usize = 8;

/// Flags to open a directory only to check it and to open its entries.
#[cfg(target_os = "linux")]
const DIRECTORY: OFlags = OFlags::PATH.union(OFlags::DIRECTORY).union(OFlags::CLOEXEC);
#[cfg(not(target_os = "linux"))]
const DIRECTORY: OFlags = OFlags::DIRECTORY.union(OFlags::CLOEXEC);
/// Flags to open a file without blocking on a pipe and without following a link.
const FILE: OFlags = OFlags::NOFOLLOW.union(OFlags::NONBLOCK).union(OFlags::CLOEXEC);

/// Mode bits: users other than the owner may write to the file.
const WRITABLE_BY_OTHERS: u32 = 0o022;
/// Mode bits: users other than the owner have any right to the file.
const OPEN_TO_OTHERS: u32 = 0o077;

/// The reason why a file is rejected. The environment is at fault; nothing was changed.
///
/// # Examples
///
/// ```
/// use std::path::Path;
///
/// use sinew::security::files::{self, KeyFileError};
///
/// let fault = files::directory(Path::new("/no/such/directory")).unwrap_err();
/// assert!(matches!(fault, KeyFileError::Unreadable { .. }));
/// ```
#[derive(Debug, thiserror::Error)]
pub enum KeyFileError {
    /// The file cannot be read.
    #[error(
        "{path}: {cause}; copy the node's directory there as `sinew keys` says, and start the node as its owner"
    )]
    Unreadable {
        /// Path of the file.
        path: PathBuf,
        /// Error of the system.
        cause: io::Error,
    },
    /// The path is not of the expected type.
    #[error("{path} is no {wanted}; put the one there that `sinew keys` made")]
    Other {
        /// Path of the file.
        path: PathBuf,
        /// Expected type.
        wanted: &'static str,
    },
    /// The file belongs to another user, and that user can change it.
    #[error("{path} belongs to user {owner}, this node runs as user {user}: `chown {user} {path}`")]
    ForeignOwner {
        /// Path of the file.
        path: PathBuf,
        /// Owner of the file.
        owner: u32,
        /// User of the node.
        user: u32,
    },
    /// Other users can read a secret.
    #[error(
        "{path} is a secret, and others can get at it (mode {mode:04o}): `chmod 600 {path}`; if others use this machine, \
         take it for stolen: {}",
        after_theft(path)
    )]
    Exposed {
        /// Path of the file.
        path: PathBuf,
        /// Mode of the file.
        mode: u32,
    },
    /// Other users can change the file, and so the nodes that this node trusts.
    #[error(
        "others can write to {path} (mode {mode:04o}), and so decide whom this node believes: `chmod go-w {path}`, or, where others are to write there (as in `/tmp`), move the file to a directory of its own"
    )]
    Writable {
        /// Path of the file.
        path: PathBuf,
        /// Mode of the file.
        mode: u32,
    },
    /// The file is longer than any file of its kind.
    #[error(
        "{path} has more than {bytes_max} bytes, which no such file has; put the one there that `sinew keys` made"
    )]
    TooLong {
        /// Path of the file.
        path: PathBuf,
        /// Maximum size in bytes.
        bytes_max: u64,
    },
}

/// Returns the remedy for a secret that other users may know.
fn after_theft(path: &Path) -> &'static str {
    if path.ends_with(NODE_KEY) {
        "`sinew keys revoke NODE`, and `issue` it anew"
    } else {
        // The authority's key signs new certificates, and the discovery key is the same on all nodes.
        // Revoking certificates helps against neither.
        "make the keys of all nodes anew, `sinew keys init` with --out for another directory"
    }
}

/// The required protection of a file.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Guarded {
    /// Only the owner may read or write the file.
    Secret,
    /// Only the owner may write the file.
    Public,
}

/// Reads a secret of at most 16 KiB. Only its owner may have any right to it.
///
/// # Errors
/// Returns an error if the file cannot be read, or if another user has access to it.
///
/// # Examples
///
/// ```no_run
/// use std::path::Path;
///
/// use sinew::security::files;
///
/// // Refused if others than its owner may read it.
/// let key = files::secret(&Path::new("/etc/sinew/keys").join(files::NODE_KEY))?;
/// println!("{} bytes", key.len());
/// # Ok::<(), files::KeyFileError>(())
/// ```
pub fn secret(path: &Path) -> Result<Zeroizing<Vec<u8>>, KeyFileError> {
    read(path, Guarded::Secret, KEY_BYTES_MAX)
}

/// Reads a certificate as text.
pub(super) fn certificate(path: &Path) -> Result<Zeroizing<Vec<u8>>, KeyFileError> {
    read(path, Guarded::Public, KEY_BYTES_MAX)
}

/// Reads an access list of at most `bytes_max` bytes, at a path where no other user can replace the file.
/// That holds for the directory of `path` and, if `path` is a link, for each directory along the chain of
/// links. Each directory is checked after it is opened, and the next entry is opened relative to it. So the
/// checked file is the one that is read. Users that can rename these directories are not considered.
pub fn access_list(path: &Path, bytes_max: u64) -> Result<Zeroizing<Vec<u8>>, KeyFileError> {
    let unreadable = |cause: io::Error| KeyFileError::Unreadable { path: path.to_owned(), cause };
    let mut base: Option<OwnedFd> = None;
    // `here` is the path to open, possibly relative to an open directory. `shown` is the path in messages.
    let (mut here, mut shown) = (path.to_owned(), path.to_owned());
    for _ in 0..=LINKS_MAX {
        let Some(name) = here.file_name().map(OsStr::to_owned) else {
            return Err(KeyFileError::Other { path: shown, wanted: "file" });
        };
        let from = base.as_ref().map_or(CWD, |base| base.as_fd());
        let parent = openat(from, parent_of(&here), DIRECTORY, Mode::empty());
        let parent = File::from(parent.map_err(|error| unreadable(error.into()))?);
        let about = parent.metadata().map_err(unreadable)?;
        check(parent_of(&shown), about.uid(), about.mode(), Guarded::Public)?;
        match readlinkat(&parent, &name, Vec::new()) {
            Ok(link) => {
                here = PathBuf::from(OsString::from_vec(link.into_bytes()));
                shown = parent_of(&shown).join(&here);
                base = Some(parent.into());
            }
            // The entry is not a link.
            Err(Errno::INVAL) => {
                let file = openat(&parent, &name, FILE, Mode::empty());
                let file = File::from(file.map_err(|error| unreadable(error.into()))?);
                return read_open(file, &shown, Guarded::Public, bytes_max);
            }
            Err(error) => return Err(unreadable(error.into())),
        }
    }
    Err(unreadable(Errno::LOOP.into()))
}

/// Returns the directory of `path`.
fn parent_of(path: &Path) -> &Path {
    path.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or_else(|| Path::new("."))
}

/// Reads the deny list.
pub(super) fn denied(path: &Path) -> Result<Zeroizing<Vec<u8>>, KeyFileError> {
    read(path, Guarded::Public, DENIED_BYTES_MAX)
}

/// Reads a file of at most `bytes_max` bytes that no other user can write, though others may read it. Returns
/// `None` if the file does not exist.
///
/// # Errors
/// Returns an error if the file cannot be read, or if another user can write it.
pub fn own(path: &Path, bytes_max: u64) -> Result<Option<Zeroizing<Vec<u8>>>, KeyFileError> {
    match read(path, Guarded::Public, bytes_max) {
        Err(KeyFileError::Unreadable { cause, .. }) if cause.kind() == io::ErrorKind::NotFound => Ok(None),
        read => read.map(Some),
    }
}

/// Checks that `path` is a directory in which no other user can replace a file.
///
/// # Errors
/// Returns an error if it is not a directory, or if another user can replace its files.
///
/// # Examples
///
/// ```no_run
/// use std::path::Path;
///
/// use sinew::security::files;
///
/// if let Err(fault) = files::directory(Path::new("/etc/sinew/keys")) {
///     eprintln!("{fault}"); // with what to do
/// }
/// ```
pub fn directory(path: &Path) -> Result<(), KeyFileError> {
    let unreadable = |cause| KeyFileError::Unreadable { path: path.to_owned(), cause };
    let about = std::fs::metadata(path).map_err(unreadable)?;
    if !about.is_dir() {
        return Err(KeyFileError::Other { path: path.to_owned(), wanted: "directory" });
    }
    check(path, about.uid(), about.mode(), Guarded::Public)
}

/// Reads a file. It is checked after it is opened, so the checked file is the one that is read.
fn read(path: &Path, guarded: Guarded, bytes_max: u64) -> Result<Zeroizing<Vec<u8>>, KeyFileError> {
    let unreadable = |cause| KeyFileError::Unreadable { path: path.to_owned(), cause };
    // Without this flag, a pipe at this path would block the node forever.
    let no_wait = OFlags::NONBLOCK.bits().cast_signed();
    let file = OpenOptions::new().read(true).custom_flags(no_wait).open(path).map_err(unreadable)?;
    read_open(file, path, guarded, bytes_max)
}

/// Reads the open `file` at `path`.
fn read_open(
    file: File,
    path: &Path,
    guarded: Guarded,
    bytes_max: u64,
) -> Result<Zeroizing<Vec<u8>>, KeyFileError> {
    let unreadable = |cause| KeyFileError::Unreadable { path: path.to_owned(), cause };
    let about = file.metadata().map_err(unreadable)?;
    if !about.is_file() {
        return Err(KeyFileError::Other { path: path.to_owned(), wanted: "file" });
    }
    check(path, about.uid(), about.mode(), guarded)?;
    let too_long = || KeyFileError::TooLong { path: path.to_owned(), bytes_max };
    if about.len() > bytes_max {
        return Err(too_long());
    }
    // Reserves the full capacity at once: a buffer that grows leaves copies of the secret behind.
    let room = usize::try_from(about.len()).map_err(|_| too_long())? + 1;
    let mut bytes = Zeroizing::new(Vec::with_capacity(room));
    file.take(bytes_max + 1).read_to_end(&mut bytes).map_err(unreadable)?;
    if bytes.len() as u64 > bytes_max {
        return Err(too_long());
    }
    Ok(bytes)
}

fn check(path: &Path, owner: u32, mode: u32, guarded: Guarded) -> Result<(), KeyFileError> {
    let (path, mode) = (path.to_owned(), mode & 0o7777);
    let user = rustix::process::geteuid().as_raw();
    // A file of root is accepted: only root can change it, and root can change everything.
    if owner != user && owner != 0 {
        return Err(KeyFileError::ForeignOwner { path, owner, user });
    }
    if guarded == Guarded::Secret && mode & OPEN_TO_OTHERS != 0 {
        return Err(KeyFileError::Exposed { path, mode });
    }
    if mode & WRITABLE_BY_OTHERS != 0 {
        return Err(KeyFileError::Writable { path, mode });
    }
    Ok(())
}
