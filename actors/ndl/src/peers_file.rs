//! The file of a node's peers and their addresses. It is a text with one peer per line, replaced as a whole.
//! No content of it stops a node.
//!
//! ```text
//! sinew peers 1
//! 10.0.0.7:6911 10.0.0.7 0
//! [fd00::9]:6911 10.0.0.9 3
//! ```

use std::{
    net::{IpAddr, SocketAddr},
    path::{Path, PathBuf},
};

use sinew_model::address::unscoped;
use sinew_runtime::tid::NodeAddress;
use sinew_security::{
    files::{self, KeyFileError},
    state_files,
};

use super::core::{REMEMBERED_MAX, RememberedPeer, UNANSWERED_MAX};

/// First line of the file. Another number denotes another format.
pub(super) const FIRST_LINE: &str = "sinew peers 1";
/// Maximum file size in bytes: twice the size of 64 peers.
pub(super) const BYTES_MAX: u64 = 16 << 10;

/// Path of a node's peers file.
#[derive(Clone, Debug)]
pub(super) struct PeersFile(PathBuf);

/// The readable part of a file.
#[derive(Debug, Default, PartialEq, Eq)]
pub(super) struct Kept {
    /// The peers, ordered by the last contact, oldest first.
    pub(super) peers: Vec<RememberedPeer>,
    /// Number of unreadable lines, and the line number of the first one, from 1.
    pub(super) unreadable: Option<(usize, usize)>,
}

impl PeersFile {
    /// Returns the file of the project's node with this address. A node of another project may use the same
    /// address and directory.
    pub(super) fn of(directory: &Path, project: &str, node: NodeAddress) -> Self {
        Self(state_files::path(directory, "peers", project, node))
    }

    pub(super) fn path(&self) -> &Path {
        &self.0
    }

    /// Reads the file. Returns an empty list if it does not exist.
    ///
    /// # Errors
    /// Returns why the file cannot be read, with the remedy.
    pub(super) fn read(&self) -> Result<Kept, String> {
        let bytes = files::own(&self.0, BYTES_MAX).map_err(|why| match why {
            KeyFileError::Unreadable { cause, .. } => {
                format!("{cause}; let the node's user read it, or delete it")
            }
            KeyFileError::Other { .. } => "it is no file; move away what is there".to_owned(),
            KeyFileError::TooLong { .. } => {
                format!("it has more than {BYTES_MAX} bytes, which no such file has; delete it")
            }
            why @ (KeyFileError::ForeignOwner { .. }
            | KeyFileError::Exposed { .. }
            | KeyFileError::Writable { .. }) => why.to_string(),
        })?;
        Ok(bytes.map(|bytes| parse(&bytes)).unwrap_or_default())
    }

    /// Replaces the file with these peers. A reader gets either the old or the new content, also after a power failure.
    ///
    /// # Errors
    /// Returns why the file cannot be written, with the remedy.
    pub(super) fn write(&self, peers: &[RememberedPeer]) -> Result<(), String> {
        state_files::replace(&self.0, text(peers).as_bytes())
    }
}

pub(super) fn text(peers: &[RememberedPeer]) -> String {
    let line = |peer: &RememberedPeer| {
        let RememberedPeer { address, node, unanswered } = peer;
        format!("{address} {node} {unanswered}\n")
    };
    std::iter::once(format!("{FIRST_LINE}\n")).chain(peers.iter().map(line)).collect()
}

/// Parses the readable part of these bytes. They may be of any origin, or incomplete.
pub(super) fn parse(bytes: &[u8]) -> Kept {
    let text = String::from_utf8_lossy(bytes);
    let mut lines = text.lines();
    if lines.next() != Some(FIRST_LINE) {
        return Kept { peers: Vec::new(), unreadable: Some((text.lines().count().max(1), 1)) };
    }
    let mut kept = Kept::default();
    for (at, line) in lines.enumerate() {
        match peer(line).filter(|_| kept.peers.len() < REMEMBERED_MAX) {
            Some(peer) => kept.peers.push(peer),
            None => {
                kept.unreadable =
                    kept.unreadable.map_or(Some((1, at + 2)), |(count, first)| Some((count + 1, first)))
            }
        }
    }
    kept
}

fn peer(line: &str) -> Option<RememberedPeer> {
    let mut words = line.split(' ');
    let (address, node, unanswered) = (words.next()?, words.next()?, words.next()?);
    let address = unscoped(address.parse().ok()?);
    let node: NodeAddress = node.parse().ok()?;
    let unanswered: u32 = unanswered.parse().ok()?;
    let is_fit =
        words.next().is_none() && is_of_a_host(address) && node.is_single() && unanswered < UNANSWERED_MAX;
    is_fit.then_some(RememberedPeer { address, node, unanswered })
}

fn is_of_a_host(address: SocketAddr) -> bool {
    let is_one = match address.ip() {
        IpAddr::V4(ip) => !ip.is_unspecified() && !ip.is_multicast() && !ip.is_broadcast(),
        IpAddr::V6(ip) => !ip.is_unspecified() && !ip.is_multicast() && ip.to_ipv4_mapped().is_none(),
    };
    is_one && address.port() != 0
}

#[cfg(test)]
mod tests {
    use std::{
        fs::DirBuilder,
        os::unix::fs::{DirBuilderExt as _, MetadataExt as _, PermissionsExt as _},
    };

    use proptest::prelude::*;

    use super::*;

    /// A directory of the test's own, removed with it.
    struct Own(PathBuf);

    impl Own {
        fn new(name: &str) -> Self {
            let path = std::env::temp_dir().join(format!("sinew-peers-{name}-{}", std::process::id()));
            let _ = std::fs::remove_dir_all(&path);
            DirBuilder::new().mode(0o700).create(&path).unwrap();
            Self(path)
        }

        fn file(&self) -> PeersFile {
            PeersFile::of(&self.0.join("state"), "sinew", NodeAddress::from([10, 0, 0, 1]))
        }
    }

    impl Drop for Own {
        fn drop(&mut self) {
            let _ = std::fs::remove_dir_all(&self.0);
        }
    }

    fn some() -> Vec<RememberedPeer> {
        let peer = |address: &str, last, unanswered| RememberedPeer {
            address: address.parse().unwrap(),
            node: NodeAddress::from([10, 0, 0, last]),
            unanswered,
        };
        vec![peer("10.0.0.7:6911", 7, 0), peer("[fd00::9]:6911", 9, 3), peer("[fe80::9]:1", 9, 7)]
    }

    #[test]
    fn written_file_is_read_back_and_is_as_documented() {
        let own = Own::new("again");
        let file = own.file();
        assert_eq!(file.read().unwrap(), Kept::default(), "there is none yet");
        file.write(&some()).unwrap();
        assert_eq!(file.read().unwrap(), Kept { peers: some(), unreadable: None });
        let text = std::fs::read_to_string(file.path()).unwrap();
        let expected =
            "sinew peers 1\n10.0.0.7:6911 10.0.0.7 0\n[fd00::9]:6911 10.0.0.9 3\n[fe80::9]:1 10.0.0.9 7\n";
        assert_eq!(text, expected);
    }

    #[test]
    fn file_is_replaced_atomically_and_private_to_its_owner() {
        let own = Own::new("whole");
        let file = own.file();
        file.write(&some()).unwrap();
        let first = std::fs::metadata(file.path()).unwrap();
        // A temporary file left by a killed process.
        let left = file.path().with_file_name(".peers-sinew-10.0.0.1.new");
        std::fs::write(left, "half").unwrap();
        file.write(&some()[..1]).unwrap();
        let second = std::fs::metadata(file.path()).unwrap();
        assert_ne!(first.ino(), second.ino(), "it is another file under the same name");
        assert_eq!((second.mode() & 0o7777, first.mode() & 0o7777), (0o600, 0o600));
        let directory = file.path().parent().unwrap();
        assert_eq!(std::fs::metadata(directory).unwrap().mode() & 0o7777, 0o700);
        assert_eq!(std::fs::read_dir(directory).unwrap().count(), 1);
        assert_eq!(file.read().unwrap().peers.len(), 1);
    }

    #[test]
    fn each_project_has_its_own_file() {
        let name = |project: &str| {
            let file = PeersFile::of(Path::new("/s"), project, NodeAddress::from([10, 0, 0, 1]));
            assert_eq!(file.path().parent(), Some(Path::new("/s")));
            file.path().file_name().unwrap().to_str().unwrap().to_owned()
        };
        assert_eq!(name("arm-2"), "peers-arm-2-10.0.0.1");
        assert_eq!(name("../ä%"), "peers-%2e%2e%2f%c3%a4%25-10.0.0.1");
        assert!(name(&"\u{1}".repeat(63)).len() < 255 - ".".len() - ".new".len());
    }

    #[test]
    fn invalid_lines_are_left_out_and_counted() {
        let kept = parse(
            b"sinew peers 1\n10.0.0.7:6911 10.0.0.7 0\nrubbish\n\xff\xfe\n10.0.0.8:0 10.0.0.8 0\n0.0.0.0:1 10.0.0.8 0\n\
              224.0.0.1:1 10.0.0.8 0\n10.0.0.8:1 * 0\n10.0.0.8:1 10.0.0.8 8\n10.0.0.8:1 10.0.0.8 0 0\n[::ffff:10.0.0.8]:1 10.0.0.8 0\n\
              10.0.0.9:1 10.0.0.9 7\n",
        );
        assert_eq!(kept.unreadable, Some((9, 3)));
        assert_eq!(
            kept.peers.iter().map(|peer| peer.address.to_string()).collect::<Vec<_>>(),
            ["10.0.0.7:6911", "10.0.0.9:1"]
        );
        for other in [&b""[..], b"sinew peers 2\n10.0.0.7:6911 10.0.0.7 0\n", b"\0\0\0\0"] {
            let kept = parse(other);
            assert!(
                kept.peers.is_empty() && kept.unreadable.is_some_and(|(_, first)| first == 1),
                "{kept:?}"
            );
        }
        let many = (1..=80).map(|last| format!("10.0.0.{last}:1 10.0.0.{last} 0\n")).collect::<String>();
        let kept = parse(format!("{FIRST_LINE}\n{many}").as_bytes());
        assert_eq!((kept.peers.len(), kept.unreadable), (REMEMBERED_MAX, Some((16, 66))));
    }

    #[test]
    fn unusable_file_is_reported_with_a_remedy() {
        let own = Own::new("trust");
        let file = own.file();
        file.write(&some()).unwrap();
        let set = |path: &Path, mode| {
            std::fs::set_permissions(path, std::fs::Permissions::from_mode(mode)).unwrap();
        };
        set(file.path(), 0o622);
        let error = file.read().unwrap_err();
        assert!(error.contains("chmod go-w"), "{error}");
        std::fs::write(file.path(), vec![b'x'; 20 << 10]).unwrap();
        set(file.path(), 0o600);
        let error = file.read().unwrap_err();
        assert!(error.contains("delete it"), "{error}");
        std::fs::remove_file(file.path()).unwrap();
        std::fs::create_dir(file.path()).unwrap();
        let error = file.read().unwrap_err();
        assert!(error.contains("no file"), "{error}");
        // A directory in which others can replace the file.
        let directory = file.path().parent().unwrap();
        set(directory, 0o777);
        let error = file.write(&some()).unwrap_err();
        assert!(error.contains("chmod go-w"), "{error}");
        let error = PeersFile::of(Path::new("/proc/none/such"), "sinew", NodeAddress::from([10, 0, 0, 1]))
            .write(&[])
            .unwrap_err();
        assert!(error.contains("`node.state`"), "{error}");
    }

    proptest! {
        #[test]
        fn any_bytes_are_bounded_peers(
            bytes in proptest::collection::vec(any::<u8>(), 0..400),
            lines in r"([0-9.:\[\]a-f]{1,20} [0-9.*]{1,12} [0-9]{1,3}\n|\PC{0,30}\n){0,90}",
        ) {
            parse(&bytes);
            let kept = parse(format!("{FIRST_LINE}\n{lines}").as_bytes());
            prop_assert!(kept.peers.len() <= REMEMBERED_MAX);
            let again = parse(text(&kept.peers).as_bytes());
            prop_assert_eq!(again, Kept { peers: kept.peers, unreadable: None });
        }
    }
}
