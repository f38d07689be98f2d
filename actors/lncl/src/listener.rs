//! The socket file: created, protected against a second node, and removed again.

use std::{
    fs::{self, DirBuilder, File, Permissions},
    io,
    os::{
        fd::OwnedFd,
        unix::{
            fs::{DirBuilderExt, FileTypeExt, MetadataExt, PermissionsExt},
            net::UnixListener,
        },
    },
    path::{Path, PathBuf},
    thread,
    time::{Duration, Instant},
};

use rustix::fs::FlockOperation;
use sinew_shm::Descriptors;
use socket2::{Domain, SockAddr, Socket, Type};

/// Maximum length of the path in bytes. Linux has a limit of 107; other platforms have less.
const PATH_MAX: usize = 100;
/// The users that may open the socket. The node serves only those that it admits. spec: LNCL-2
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SocketAccess {
    /// The node's user and its group.
    Own,
    /// Every user of the host: the access list admits some of them.
    AnyUser,
}

impl SocketAccess {
    const fn mode(self) -> u32 {
        match self {
            Self::Own => 0o660,
            Self::AnyUser => 0o666,
        }
    }
}

const DIRECTORY_MODE: u32 = 0o750;
/// Maximum number of connections that wait to be accepted; later ones wait in their `connect`.
const BACKLOG: i32 = 1_024;

/// Longest wait for other nodes that open a socket in the same directory, and the interval of the retries.
const LOCK_TIMEOUT: Duration = Duration::from_millis(500);
const LOCK_RETRY: Duration = Duration::from_millis(1);

/// Reason why LNCL cannot listen. The environment or the configuration is at fault; nothing changed.
#[derive(Debug, thiserror::Error)]
pub enum ListenError {
    #[error("the path {0:?} is longer than {PATH_MAX} bytes; set a shorter `lncl.socket`")]
    TooLong(PathBuf),
    #[error("{0:?} is there and is not a socket; remove it, or set another `lncl.socket`")]
    NotASocket(PathBuf),
    #[error("another node listens at {0:?}; stop it, or set another `lncl.socket`")]
    InUse(PathBuf),
    #[error(
        "another process has locked the directory of {0:?} for {LOCK_TIMEOUT:?}; find that process, or set another `lncl.socket`"
    )]
    Contended(PathBuf),
    #[error("cannot {doing} {path:?}: {cause}; see to the permissions there, or set another `lncl.socket`")]
    System { doing: &'static str, path: PathBuf, cause: io::Error },
}

/// A socket file of this node. Dropping it removes the file.
#[derive(Debug)]
pub(crate) struct SocketFile {
    path: PathBuf,
    /// Device and inode: a file of another node at this path must not be removed.
    identity: (u64, u64),
}

impl SocketFile {
    /// Returns whether the file still exists at its path.
    pub(super) fn is_there(&self) -> bool {
        identity_of(&self.path).is_ok_and(|found| found == self.identity)
    }
}

impl Drop for SocketFile {
    fn drop(&mut self) {
        if self.is_there()
            && let Err(cause) = fs::remove_file(&self.path)
        {
            sinew_runtime::log::warn!(path = ?self.path, %cause, "the socket file is left behind; the next start replaces it");
        }
    }
}

/// Listens at `path`. Replaces the file of a dead node, but not that of a living one.
///
/// # Errors
/// The cause, and its remedy.
pub(crate) fn listen(path: &Path, access: SocketAccess) -> Result<(UnixListener, SocketFile), ListenError> {
    if path.as_os_str().len() > PATH_MAX {
        return Err(ListenError::TooLong(path.to_owned()));
    }
    let directory =
        path.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or_else(|| Path::new("."));
    DirBuilder::new()
        .recursive(true)
        .mode(DIRECTORY_MODE)
        .create(directory)
        .map_err(system("create the directory", directory))?;
    // Held during the check and the bind: two nodes that start at once must not both find a dead file and replace it.
    let _lock = lock_directory(directory, path)?;
    remove_if_dead(path)?;
    let listener = bind(path, access)?;
    let identity = identity_of(path).map_err(system("look at", path))?;
    Ok((listener, SocketFile { path: path.to_owned(), identity }))
}

fn lock_directory(directory: &Path, path: &Path) -> Result<File, ListenError> {
    let file = File::open(directory).map_err(system("open", directory))?;
    let until = Instant::now() + LOCK_TIMEOUT;
    loop {
        match rustix::fs::flock(&file, FlockOperation::NonBlockingLockExclusive) {
            Ok(()) => return Ok(file),
            // Usually held by a node with another socket in the same directory, and released within moments.
            Err(rustix::io::Errno::WOULDBLOCK) if Instant::now() < until => thread::sleep(LOCK_RETRY),
            Err(rustix::io::Errno::WOULDBLOCK) => return Err(ListenError::Contended(path.to_owned())),
            Err(cause) => return Err(system("lock", directory)(cause.into())),
        }
    }
}

fn remove_if_dead(path: &Path) -> Result<(), ListenError> {
    let found = match fs::symlink_metadata(path) {
        Err(cause) if cause.kind() == io::ErrorKind::NotFound => return Ok(()),
        other => other.map_err(system("look at", path))?,
    };
    if !found.file_type().is_socket() {
        return Err(ListenError::NotASocket(path.to_owned()));
    }
    match probe(path) {
        Err(cause) if cause.kind() == io::ErrorKind::ConnectionRefused => {
            sinew_runtime::log::info!(?path, "replacing the socket file that a killed node left");
            fs::remove_file(path).map_err(system("remove", path))
        }
        // `WouldBlock`: a process listens, and its backlog is full.
        Ok(()) => Err(ListenError::InUse(path.to_owned())),
        Err(cause) if cause.kind() == io::ErrorKind::WouldBlock => Err(ListenError::InUse(path.to_owned())),
        Err(cause) => Err(system("connect to", path)(cause)),
    }
}

/// Connects without waiting, to check whether a process listens.
fn probe(path: &Path) -> io::Result<()> {
    let socket = Socket::new(Domain::UNIX, Type::STREAM, None)?;
    socket.set_nonblocking(true)?;
    socket.connect(&SockAddr::unix(path)?)
}

fn bind(path: &Path, access: SocketAccess) -> Result<UnixListener, ListenError> {
    let socket = Socket::new(Domain::UNIX, Type::STREAM, None).map_err(system("make a socket for", path))?;
    let address = SockAddr::unix(path).map_err(system("bind", path))?;
    socket.bind(&address).map_err(system("bind", path))?;
    // Connections inherit this option. If the kernel lacks it (Linux before 6.16), readers check before each read.
    let _ = sinew_shm::set_descriptors(&socket, Descriptors::Refused);
    // Before `listen`, so that no process connects under wider permissions.
    fs::set_permissions(path, Permissions::from_mode(access.mode()))
        .map_err(system("set permissions of", path))?;
    socket.listen(BACKLOG).map_err(system("listen at", path))?;
    socket.set_nonblocking(true).map_err(system("listen at", path))?;
    Ok(UnixListener::from(OwnedFd::from(socket)))
}

fn identity_of(path: &Path) -> io::Result<(u64, u64)> {
    fs::symlink_metadata(path).map(|found| (found.dev(), found.ino()))
}

fn system(doing: &'static str, path: &Path) -> impl Fn(io::Error) -> ListenError {
    move |cause| ListenError::System { doing, path: path.to_owned(), cause }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::TestDirectory;

    #[test]
    fn socket_file_is_private_and_removed_with_its_owner() {
        let directory = TestDirectory::new();
        let path = directory.path().join("made/node.sock");
        let (_listener, file) = listen(&path, SocketAccess::Own).unwrap();
        let mode = |path: &Path| fs::metadata(path).unwrap().permissions().mode() & 0o777;
        assert_eq!(mode(&path), 0o660);
        assert_eq!(mode(path.parent().unwrap()) & !DIRECTORY_MODE, 0);
        drop(file);
        assert!(!path.exists());
    }

    #[test]
    fn file_of_a_killed_node_is_replaced() {
        let directory = TestDirectory::new();
        let path = directory.path().join("node.sock");
        let (listener, file) = listen(&path, SocketAccess::Own).unwrap();
        std::mem::forget(file);
        drop(listener);
        assert!(path.exists());
        listen(&path, SocketAccess::Own).unwrap();
    }

    #[test]
    fn socket_of_a_living_node_is_not_taken() {
        let directory = TestDirectory::new();
        let path = directory.path().join("node.sock");
        let (_listener, _file) = listen(&path, SocketAccess::Own).unwrap();
        let refusal = listen(&path, SocketAccess::Own).unwrap_err();
        assert!(refusal.to_string().contains("another node listens"), "{refusal}");
        assert!(path.exists(), "the living node keeps its file");
    }

    #[test]
    fn simultaneous_starts_in_one_directory_all_succeed() {
        let directory = TestDirectory::new();
        // Longer than the turn of any of them, shorter than their wait.
        let lock = lock_directory(directory.path(), directory.path()).unwrap();
        thread::scope(|scope| {
            let nodes: Vec<_> = (0..4)
                .map(|node| directory.path().join(format!("{node}.sock")))
                .map(|path| {
                    scope.spawn(move || listen(&path, SocketAccess::Own).map(|(_, file)| file.is_there()))
                })
                .collect();
            thread::sleep(20 * LOCK_RETRY);
            drop(lock);
            for node in nodes {
                assert!(matches!(node.join().unwrap(), Ok(true)));
            }
        });
    }

    #[test]
    fn file_that_is_no_socket_is_not_removed() {
        let directory = TestDirectory::new();
        let path = directory.path().join("notes.txt");
        fs::write(&path, "precious").unwrap();
        assert!(matches!(listen(&path, SocketAccess::Own), Err(ListenError::NotASocket(_))));
        assert_eq!(fs::read_to_string(&path).unwrap(), "precious");
    }

    #[test]
    fn successors_file_is_not_removed() {
        let directory = TestDirectory::new();
        let path = directory.path().join("node.sock");
        let (_first_listener, first) = listen(&path, SocketAccess::Own).unwrap();
        fs::remove_file(&path).unwrap();
        let (_second_listener, _second) = listen(&path, SocketAccess::Own).unwrap();
        drop(first);
        assert!(path.exists());
    }

    #[test]
    fn too_long_path_is_refused_with_a_reason() {
        let refusal = listen(Path::new(&format!("/tmp/{}", "x".repeat(200))), SocketAccess::Own).unwrap_err();
        assert!(refusal.to_string().contains("lncl.socket"));
    }
}
