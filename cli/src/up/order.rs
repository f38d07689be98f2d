//! All that a host needs to run a node. Two orders that are equal need no new start.

use std::{
    collections::BTreeMap,
    fmt,
    fs::File,
    io::{self, Read},
    net::SocketAddr,
    path::Path,
};

use ring::digest::{Context, SHA256};
use serde::{Deserialize, Serialize};

use super::robot::Limits;

/// The order to run a node on a host.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct NodeOrder {
    pub(super) name: String,
    pub(super) program: ProgramOrder,
    pub(super) arguments: Vec<String>,
    pub(super) environment: BTreeMap<String, String>,
    /// The files in the node's folder, its configuration and keys among them.
    pub(super) files: Vec<PlacedFile>,
    /// The client socket, relative to the node's folder unless it is absolute.
    pub(super) socket: Option<String>,
    /// The ports that the configuration fixes.
    pub(super) ports: Vec<Port>,
    pub(super) limits: Limits,
}

/// The program of a node.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) enum ProgramOrder {
    /// A copied file.
    Copied { name: String, hash: Hash },
    /// A file that is on the host already.
    Installed(String),
}

/// A file in a node's folder.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct PlacedFile {
    /// Relative path: a file name, or one below `keys`.
    pub(super) path: String,
    pub(super) hash: Hash,
}

/// A port that a node opens.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Port {
    /// The key that sets it.
    pub(super) key: String,
    pub(super) is_udp: bool,
    pub(super) address: SocketAddr,
}

/// The SHA-256 of a content, in hexadecimal digits.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub(super) struct Hash(String);

/// Digits of a hash.
const HASH_DIGITS: usize = 64;
/// Bytes that are read at once.
const BLOCK: usize = 64 << 10;

impl Hash {
    /// Reads a content to its end, and returns its hash and its length in bytes.
    pub(super) fn of(mut content: impl Read) -> io::Result<(Self, u64)> {
        let (mut context, mut block, mut bytes) = (Context::new(&SHA256), vec![0; BLOCK], 0);
        loop {
            let read = content.read(&mut block)?;
            if read == 0 {
                break;
            }
            context.update(&block[..read]);
            bytes += read as u64;
        }
        let digits = context.finish().as_ref().iter().map(|byte| format!("{byte:02x}")).collect();
        Ok((Self(digits), bytes))
    }

    /// Returns the hash of a file, and its length in bytes.
    pub(super) fn of_file(path: &Path) -> io::Result<(Self, u64)> {
        Self::of(File::open(path)?)
    }
}

impl fmt::Display for Hash {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

/// A text that is no hash.
#[derive(Debug, thiserror::Error)]
#[error("this is no SHA-256 of {HASH_DIGITS} hexadecimal digits; both programs have to be of one version")]
pub(super) struct HashError;

impl TryFrom<String> for Hash {
    type Error = HashError;

    fn try_from(text: String) -> Result<Self, HashError> {
        // It becomes a file name.
        let is_hash = text.len() == HASH_DIGITS && text.bytes().all(|byte| byte.is_ascii_hexdigit());
        if is_hash { Ok(Self(text)) } else { Err(HashError) }
    }
}

impl From<Hash> for String {
    fn from(hash: Hash) -> Self {
        hash.0
    }
}

impl NodeOrder {
    /// Returns the contents that the host needs.
    pub(super) fn hashes(&self) -> impl Iterator<Item = &Hash> {
        let program = match &self.program {
            ProgramOrder::Copied { hash, .. } => Some(hash),
            ProgramOrder::Installed(_) => None,
        };
        program.into_iter().chain(self.files.iter().map(|file| &file.hash))
    }

    /// Returns the parts in which a new order differs from this one, as text; empty if a start changes nothing.
    pub(super) fn changes(&self, new: &Self) -> Vec<String> {
        let mut changes = Vec::new();
        let mut note = |has_changed: bool, part: &str| {
            if has_changed {
                changes.push(part.to_owned());
            }
        };
        note(self.program != new.program, "its program");
        let is_key = |file: &&PlacedFile| file.path.starts_with(KEYS_PREFIX);
        let keys = |order: &Self| order.files.iter().filter(is_key).cloned().collect::<Vec<_>>();
        note(keys(self) != keys(new), "its keys");
        for file in new.files.iter().filter(|file| !is_key(file)) {
            note(!self.files.contains(file), &file.path);
        }
        let has = |file: &PlacedFile| new.files.iter().any(|new| new.path == file.path);
        for file in self.files.iter().filter(|file| !is_key(file) && !has(file)) {
            note(true, &format!("{}, which is not wanted any more,", file.path));
        }
        note(self.arguments != new.arguments, "its arguments");
        note(self.environment != new.environment, "its environment");
        note(self.limits != new.limits, "its limits");
        // The configuration may be the same, and the robot file may set another socket.
        note(changes_socket(self, new), "its socket");
        changes
    }
}

fn changes_socket(old: &NodeOrder, new: &NodeOrder) -> bool {
    old.socket != new.socket && old.files == new.files
}

/// The folder of a node's keys, in its own folder.
pub(super) const KEYS_PREFIX: &str = "keys/";

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    /// An order with this hash digit for its program.
    pub(in crate::up) fn order(name: &str, digit: u8) -> NodeOrder {
        let hash = Hash::of(&[digit][..]).expect("memory is readable").0;
        NodeOrder {
            name: name.to_owned(),
            program: ProgramOrder::Copied { name: "knee".to_owned(), hash },
            arguments: vec!["knee.toml".to_owned()],
            environment: BTreeMap::new(),
            files: Vec::new(),
            socket: None,
            ports: Vec::new(),
            limits: Limits::default(),
        }
    }

    #[test]
    fn hash_is_sha256_of_the_content() {
        let (hash, bytes) = Hash::of(&b"abc"[..]).expect("memory is readable");
        let known = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad";
        assert_eq!((hash.to_string().as_str(), bytes), (known, 3));
        assert!(Hash::try_from(known.to_owned()).is_ok());
        assert!(Hash::try_from(format!("../{}", &known[3..])).is_err());
    }

    #[test]
    fn each_changed_part_is_named() {
        let file = |path: &str, digit: u8| PlacedFile {
            path: path.to_owned(),
            hash: Hash::of(&[digit][..]).expect("memory is readable").0,
        };
        let files = vec![file("knee.toml", 1), file("keys/node.key", 2), file("map.bin", 3)];
        let old = NodeOrder { files, ..order("knee", 1) };
        assert_eq!(old.changes(&old), [""; 0]);
        let files = vec![file("knee.toml", 9), file("keys/node.key", 9)];
        let new = NodeOrder { files, arguments: Vec::new(), ..order("knee", 2) };
        let named = [
            "its program",
            "its keys",
            "knee.toml",
            "map.bin, which is not wanted any more,",
            "its arguments",
        ];
        assert_eq!(old.changes(&new), named);
    }

    #[test]
    fn equal_changes_and_equal_orders_agree() {
        let old = order("knee", 1);
        let limits = Limits { nice: 1, ..Limits::default() };
        for new in [
            NodeOrder { limits, ..old.clone() },
            NodeOrder { socket: Some("other.sock".to_owned()), ..old.clone() },
            NodeOrder { environment: BTreeMap::from([("A".to_owned(), "b".to_owned())]), ..old.clone() },
        ] {
            assert_eq!(old.changes(&new).len(), 1, "{new:?}");
        }
    }
}
