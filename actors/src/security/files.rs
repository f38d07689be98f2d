//! The files of a node: what they are called, and reading them with a look at who else may read or change them.
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

/// The node's own key.
pub const NODE_KEY: &str = "node.key";
/// The node's certificate.
pub const NODE_CERTIFICATE: &str = "node.pem";
/// The certificate of the project's authority.
pub const AUTHORITY: &str = "ca.pem";
/// The project's key for datagrams of discovery.
pub const DISCOVERY_KEY: &str = "discovery.key";
/// The deny list.
pub const DENIED: &str = "denied.txt";

/// Longest file of a key or a certificate in bytes: those that `sinew keys` makes have less than 1 KiB.
const KEY_BYTES_MAX: u64 = 16 << 10;
/// Longest deny list in bytes: every number with a comment.
const DENIED_BYTES_MAX: u64 = 8 << 20;

/// Links from one to the next behind the path of an access list: more than any that was made on purpose.
const LINKS_MAX: usize = 8;

/// A directory, only to look at it and to open what is in it.
#[cfg(target_os = "linux")]
const DIRECTORY: OFlags = OFlags::PATH.union(OFlags::DIRECTORY).union(OFlags::CLOEXEC);
#[cfg(not(target_os = "linux"))]
const DIRECTORY: OFlags = OFlags::DIRECTORY.union(OFlags::CLOEXEC);
/// A file: a pipe in its place would hold the node up for ever, and a link is another place.
const FILE: OFlags = OFlags::NOFOLLOW.union(OFlags::NONBLOCK).union(OFlags::CLOEXEC);

/// Bits of a file's mode: others than its owner may write to it.
const WRITABLE_BY_OTHERS: u32 = 0o022;
/// Others than its owner may do anything with it.
const OPEN_TO_OTHERS: u32 = 0o077;

/// Why a file is not taken. The environment is at fault; nothing was changed.
///
/// # Examples
///
/// ```
/// use std::path::Path;
///
/// use sinew::security::files::{self, FileFault};
///
/// let fault = files::directory(Path::new("/no/such/directory")).unwrap_err();
/// assert!(matches!(fault, FileFault::Unreadable { .. }));
/// ```
#[derive(Debug, thiserror::Error)]
pub enum FileFault {
    /// It cannot be read.
    #[error(
        "{path}: {cause}; copy the node's directory there as `sinew keys` says, and start the node as its owner"
    )]
    Unreadable {
        /// Which.
        path: PathBuf,
        /// What the system says.
        cause: io::Error,
    },
    /// It is something else.
    #[error("{path} is no {wanted}; put the one there that `sinew keys` made")]
    Other {
        /// Which.
        path: PathBuf,
        /// What it is to be.
        wanted: &'static str,
    },
    /// It belongs to somebody else, who can change it.
    #[error("{path} belongs to user {owner}, this node runs as user {user}: `chown {user} {path}`")]
    ForeignOwner {
        /// Which.
        path: PathBuf,
        /// Its owner.
        owner: u32,
        /// The node's user.
        user: u32,
    },
    /// Others can read a secret.
    #[error(
        "{path} is a secret, and others can get at it (mode {mode:04o}): `chmod 600 {path}`; if others use this machine, \
         take it for stolen: {}",
        after_theft(path)
    )]
    Exposed {
        /// Which.
        path: PathBuf,
        /// Its mode.
        mode: u32,
    },
    /// Others can change what the node believes.
    #[error(
        "others can write to {path} (mode {mode:04o}), and so decide whom this node believes: `chmod go-w {path}`, or, where others are to write there (as in `/tmp`), move the file to a directory of its own"
    )]
    Writable {
        /// Which.
        path: PathBuf,
        /// Its mode.
        mode: u32,
    },
    /// It is longer than any such file.
    #[error(
        "{path} has more than {bytes_max} bytes, which no such file has; put the one there that `sinew keys` made"
    )]
    TooLong {
        /// Which.
        path: PathBuf,
        /// Longest in bytes.
        bytes_max: u64,
    },
}

/// What to do when a secret may be known to others.
fn after_theft(path: &Path) -> &'static str {
    if path.ends_with(NODE_KEY) {
        "`sinew keys revoke NODE`, and `issue` it anew"
    } else {
        // The authority's key makes nodes, the discovery key is the same in all: to revoke some helps against neither.
        "make the keys of all nodes anew, `sinew keys init` with --out for another directory"
    }
}

/// Who may do what with a file.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Guarded {
    /// Only its owner, anything.
    Secret,
    /// Only its owner, write.
    Public,
}

/// Reads a secret of at most 16 KiB; only its owner may have any right to it.
///
/// # Errors
/// It cannot be had, or somebody else can have it, too.
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
/// # Ok::<(), files::FileFault>(())
/// ```
pub fn secret(path: &Path) -> Result<Zeroizing<Vec<u8>>, FileFault> {
    read(path, Guarded::Secret, KEY_BYTES_MAX)
}

/// Reads a certificate, as text.
pub(super) fn certificate(path: &Path) -> Result<Zeroizing<Vec<u8>>, FileFault> {
    read(path, Guarded::Public, KEY_BYTES_MAX)
}

/// Reads an access list of at most `bytes_max` bytes, which stands where nobody else can put another file in its place: neither in the
/// directory of `path` nor, if that is a link, in the one where that leads to, and so on. Each of these directories is looked at after it is
/// open, and the next thing opened in it: what is checked is what is read. Who can rename those directories is not looked at.
pub(crate) fn access_list(path: &Path, bytes_max: u64) -> Result<Zeroizing<Vec<u8>>, FileFault> {
    let unreadable = |cause: io::Error| FileFault::Unreadable { path: path.to_owned(), cause };
    let mut base: Option<OwnedFd> = None;
    // As it is opened, which may be from a directory that is open, and as it is shown.
    let (mut here, mut shown) = (path.to_owned(), path.to_owned());
    for _ in 0..=LINKS_MAX {
        let Some(name) = here.file_name().map(OsStr::to_owned) else {
            return Err(FileFault::Other { path: shown, wanted: "file" });
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
            // It is no link.
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

/// The directory of what is at `path`.
fn parent_of(path: &Path) -> &Path {
    path.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or_else(|| Path::new("."))
}

/// Reads the deny list.
pub(super) fn denied(path: &Path) -> Result<Zeroizing<Vec<u8>>, FileFault> {
    read(path, Guarded::Public, DENIED_BYTES_MAX)
}

/// Reads a file of at most `bytes_max` bytes in which nobody else can have written, whoever may read it; `None` if there is none.
///
/// # Errors
/// It cannot be had, or somebody else can write there.
pub(crate) fn own(path: &Path, bytes_max: u64) -> Result<Option<Zeroizing<Vec<u8>>>, FileFault> {
    match read(path, Guarded::Public, bytes_max) {
        Err(FileFault::Unreadable { cause, .. }) if cause.kind() == io::ErrorKind::NotFound => Ok(None),
        read => read.map(Some),
    }
}

/// Whether `path` is a directory in which nobody else can put another file in the place of one.
///
/// # Errors
/// It is none, or somebody else can.
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
pub fn directory(path: &Path) -> Result<(), FileFault> {
    let unreadable = |cause| FileFault::Unreadable { path: path.to_owned(), cause };
    let about = std::fs::metadata(path).map_err(unreadable)?;
    if !about.is_dir() {
        return Err(FileFault::Other { path: path.to_owned(), wanted: "directory" });
    }
    check(path, about.uid(), about.mode(), Guarded::Public)
}

/// What is checked is what is read: the file is looked at after it is open.
fn read(path: &Path, guarded: Guarded, bytes_max: u64) -> Result<Zeroizing<Vec<u8>>, FileFault> {
    let unreadable = |cause| FileFault::Unreadable { path: path.to_owned(), cause };
    // A pipe in its place would hold the node up for ever.
    let no_wait = OFlags::NONBLOCK.bits().cast_signed();
    let file = OpenOptions::new().read(true).custom_flags(no_wait).open(path).map_err(unreadable)?;
    read_open(file, path, guarded, bytes_max)
}

/// Reads what is open as `file`, and called `path`.
fn read_open(
    file: File,
    path: &Path,
    guarded: Guarded,
    bytes_max: u64,
) -> Result<Zeroizing<Vec<u8>>, FileFault> {
    let unreadable = |cause| FileFault::Unreadable { path: path.to_owned(), cause };
    let about = file.metadata().map_err(unreadable)?;
    if !about.is_file() {
        return Err(FileFault::Other { path: path.to_owned(), wanted: "file" });
    }
    check(path, about.uid(), about.mode(), guarded)?;
    let too_long = || FileFault::TooLong { path: path.to_owned(), bytes_max };
    if about.len() > bytes_max {
        return Err(too_long());
    }
    // Room for all of it at once: a buffer that grows leaves copies of the secret behind.
    let room = usize::try_from(about.len()).map_err(|_| too_long())? + 1;
    let mut bytes = Zeroizing::new(Vec::with_capacity(room));
    file.take(bytes_max + 1).read_to_end(&mut bytes).map_err(unreadable)?;
    if bytes.len() as u64 > bytes_max {
        return Err(too_long());
    }
    Ok(bytes)
}

fn check(path: &Path, owner: u32, mode: u32, guarded: Guarded) -> Result<(), FileFault> {
    let (path, mode) = (path.to_owned(), mode & 0o7777);
    let user = rustix::process::geteuid().as_raw();
    // What root owns only root can change, who can change everything.
    if owner != user && owner != 0 {
        return Err(FileFault::ForeignOwner { path, owner, user });
    }
    if guarded == Guarded::Secret && mode & OPEN_TO_OTHERS != 0 {
        return Err(FileFault::Exposed { path, mode });
    }
    if mode & WRITABLE_BY_OTHERS != 0 {
        return Err(FileFault::Writable { path, mode });
    }
    Ok(())
}
