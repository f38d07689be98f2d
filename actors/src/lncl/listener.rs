//! The socket file: made, guarded against a second node, removed again.

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

/// Longest path in bytes; the system's limit is 107, and another platform's less.
const PATH_MAX: usize = 100;
/// Who may open the socket. Of those who do, only whom the node admits is served. spec: LNCL-2
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Openers {
    /// The node's user and its group.
    Own,
    /// Every user of the host: the access list admits some of them.
    Everybody,
}

impl Openers {
    const fn mode(self) -> u32 {
        match self {
            Self::Own => 0o660,
            Self::Everybody => 0o666,
        }
    }
}

const DIRECTORY_MODE: u32 = 0o750;
/// Connections that wait to be accepted; one that comes after that waits in its `connect`.
const BACKLOG: i32 = 1_024;

/// Longest wait for others that open a socket in the same directory, and how often it is looked whether they are done.
const TURN_WITHIN: Duration = Duration::from_millis(500);
const TURN_LOOK: Duration = Duration::from_millis(1);

/// Why LNCL cannot listen. The environment or the configuration is at fault; nothing changed.
#[derive(Debug, thiserror::Error)]
pub(crate) enum ListenError {
    #[error("the path {0:?} is longer than {PATH_MAX} bytes; set a shorter `lncl.socket`")]
    TooLong(PathBuf),
    #[error("{0:?} is there and is not a socket; remove it, or set another `lncl.socket`")]
    NotASocket(PathBuf),
    #[error("another node listens at {0:?}; stop it, or set another `lncl.socket`")]
    InUse(PathBuf),
    #[error(
        "somebody has locked the directory of {0:?} for {TURN_WITHIN:?}; see who that is, or set another `lncl.socket`"
    )]
    Contended(PathBuf),
    #[error("cannot {doing} {path:?}: {cause}; see to the permissions there, or set another `lncl.socket`")]
    System { doing: &'static str, path: PathBuf, cause: io::Error },
}

/// A socket file that is ours; dropping it removes it.
#[derive(Debug)]
pub(crate) struct SocketFile {
    path: PathBuf,
    /// Device and inode: what another node has put in its place is not ours to remove.
    identity: (u64, u64),
}

impl SocketFile {
    /// Whether it still lies where it was made.
    pub(super) fn is_there(&self) -> bool {
        identity_of(&self.path).is_ok_and(|found| found == self.identity)
    }
}

impl Drop for SocketFile {
    fn drop(&mut self) {
        if self.is_there()
            && let Err(cause) = fs::remove_file(&self.path)
        {
            crate::log::warn!(path = ?self.path, %cause, "the socket file is left behind; the next start replaces it");
        }
    }
}

/// Listens at `path`. A file that a killed node left is replaced; one that a living node listens at is not.
///
/// # Errors
/// Why not, with what to do about it.
pub(crate) fn listen(path: &Path, openers: Openers) -> Result<(UnixListener, SocketFile), ListenError> {
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
    // Held while we look and bind: two nodes that start at once must not both find a dead file and replace it.
    let _turn = take_turn(directory, path)?;
    remove_if_dead(path)?;
    let listener = bind(path, openers)?;
    let identity = identity_of(path).map_err(system("look at", path))?;
    Ok((listener, SocketFile { path: path.to_owned(), identity }))
}

fn take_turn(directory: &Path, path: &Path) -> Result<File, ListenError> {
    let file = File::open(directory).map_err(system("open", directory))?;
    let until = Instant::now() + TURN_WITHIN;
    loop {
        match rustix::fs::flock(&file, FlockOperation::NonBlockingLockExclusive) {
            Ok(()) => return Ok(file),
            // Most often a node with another socket in the same directory, which is done in a moment.
            Err(rustix::io::Errno::WOULDBLOCK) if Instant::now() < until => thread::sleep(TURN_LOOK),
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
            crate::log::info!(?path, "replacing the socket file that a killed node left");
            fs::remove_file(path).map_err(system("remove", path))
        }
        // `WouldBlock`: somebody listens, and its queue of connections is full.
        Ok(()) => Err(ListenError::InUse(path.to_owned())),
        Err(cause) if cause.kind() == io::ErrorKind::WouldBlock => Err(ListenError::InUse(path.to_owned())),
        Err(cause) => Err(system("connect to", path)(cause)),
    }
}

/// Connects without waiting, to see whether anybody listens.
fn probe(path: &Path) -> io::Result<()> {
    let socket = Socket::new(Domain::UNIX, Type::STREAM, None)?;
    socket.set_nonblocking(true)?;
    socket.connect(&SockAddr::unix(path)?)
}

fn bind(path: &Path, openers: Openers) -> Result<UnixListener, ListenError> {
    let socket = Socket::new(Domain::UNIX, Type::STREAM, None).map_err(system("make a socket for", path))?;
    let address = SockAddr::unix(path).map_err(system("bind", path))?;
    socket.bind(&address).map_err(system("bind", path))?;
    // A connection inherits it. Where the system does not know it (Linux before 6.16), whoever reads looks first.
    let _ = sinew_shm::set_descriptors(&socket, Descriptors::Refused);
    // Before it listens, so that nobody connects under wider permissions.
    fs::set_permissions(path, Permissions::from_mode(openers.mode()))
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
    use crate::lncl::testing::TestDirectory;

    #[test]
    fn a_socket_file_has_narrow_permissions_and_goes_with_its_owner() {
        let directory = TestDirectory::new();
        let path = directory.path().join("made/node.sock");
        let (_listener, file) = listen(&path, Openers::Own).unwrap();
        let mode = |path: &Path| fs::metadata(path).unwrap().permissions().mode() & 0o777;
        assert_eq!(mode(&path), 0o660);
        assert_eq!(mode(path.parent().unwrap()) & !DIRECTORY_MODE, 0);
        drop(file);
        assert!(!path.exists());
    }

    #[test]
    fn a_file_that_a_killed_node_left_is_replaced() {
        let directory = TestDirectory::new();
        let path = directory.path().join("node.sock");
        let (listener, file) = listen(&path, Openers::Own).unwrap();
        std::mem::forget(file);
        drop(listener);
        assert!(path.exists());
        listen(&path, Openers::Own).unwrap();
    }

    #[test]
    fn the_place_of_a_living_node_is_not_taken() {
        let directory = TestDirectory::new();
        let path = directory.path().join("node.sock");
        let (_listener, _file) = listen(&path, Openers::Own).unwrap();
        let refusal = listen(&path, Openers::Own).unwrap_err();
        assert!(refusal.to_string().contains("another node listens"), "{refusal}");
        assert!(path.exists(), "the living node keeps its file");
    }

    #[test]
    fn nodes_that_start_at_once_with_sockets_in_one_directory_all_start() {
        let directory = TestDirectory::new();
        // Longer than any of them takes, shorter than they wait.
        let turn = take_turn(directory.path(), directory.path()).unwrap();
        thread::scope(|scope| {
            let nodes: Vec<_> = (0..4)
                .map(|node| directory.path().join(format!("{node}.sock")))
                .map(|path| scope.spawn(move || listen(&path, Openers::Own).map(|(_, file)| file.is_there())))
                .collect();
            thread::sleep(20 * TURN_LOOK);
            drop(turn);
            for node in nodes {
                assert!(matches!(node.join().unwrap(), Ok(true)));
            }
        });
    }

    #[test]
    fn what_is_not_a_socket_is_not_removed() {
        let directory = TestDirectory::new();
        let path = directory.path().join("notes.txt");
        fs::write(&path, "precious").unwrap();
        assert!(matches!(listen(&path, Openers::Own), Err(ListenError::NotASocket(_))));
        assert_eq!(fs::read_to_string(&path).unwrap(), "precious");
    }

    #[test]
    fn a_successors_file_is_not_removed() {
        let directory = TestDirectory::new();
        let path = directory.path().join("node.sock");
        let (_first_listener, first) = listen(&path, Openers::Own).unwrap();
        fs::remove_file(&path).unwrap();
        let (_second_listener, _second) = listen(&path, Openers::Own).unwrap();
        drop(first);
        assert!(path.exists());
    }

    #[test]
    fn a_path_that_is_too_long_is_refused_in_words() {
        let refusal = listen(Path::new(&format!("/tmp/{}", "x".repeat(200))), Openers::Own).unwrap_err();
        assert!(refusal.to_string().contains("lncl.socket"));
    }
}
