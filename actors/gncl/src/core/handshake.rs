//! The handshake frames of two nodes, and the reasons to refuse a connection.

use std::fmt;

use bytes::Bytes;
use serde::{Deserialize, Serialize, de::DeserializeOwned};
use sinew_runtime::tid::{Incarnation, NodeAddress};

/// Longest payload in bytes before the handshake is complete: an unauthenticated peer can occupy no more memory.
pub const HANDSHAKE_PAYLOAD_MAX: usize = 4_096;

/// Longest name of a node or a project, in bytes.
const NAME_MAX: usize = 63;

/// Longest sentence of a REFUSAL, in characters: any sentence of this length fits into a payload.
const SENTENCE_MAX: usize = 800;

/// Number of outcomes that a node keeps if it does not announce it: a node from before the announcement
/// existed, with its defaults.
const ANSWERS_DEFAULT: u64 = 8_192;

/// The feature of one connection per class.
pub const CLASSES: &str = "classes";

/// The feature of reading a guard of each frame's length.
pub const GUARD: &str = "guard";

/// The feature of cancelling a request that is not needed any more.
pub const CANCEL: &str = "cancel";

/// The feature of receiving several outcomes in one frame.
pub const OUTCOMES: &str = "outcomes";

/// The feature of receiving runs of outcomes.
pub const OUTCOME_RUNS: &str = "outcome-runs";

/// The feature of sending Stream values by datagram.
pub const DATAGRAMS: &str = "datagrams-2";

/// The feature of receiving reports of undelivered messages.
pub const UNDELIVERED: &str = "undelivered";

/// The messages that a connection carries: those of one class, if both nodes support [`CLASSES`]. Otherwise
/// the first connection carries all.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Lane {
    /// The first connection: the link is established and ends with it.
    #[default]
    Control,
    Stream,
    Bulk,
}

impl Lane {
    pub const ALL: [Self; 3] = [Self::Control, Self::Stream, Self::Bulk];
    /// The lanes that are connected after the first connection.
    pub const SECONDARY: [Self; 2] = [Self::Stream, Self::Bulk];

    fn is_control(&self) -> bool {
        *self == Self::Control
    }
}

/// Payload of HELLO and of WELCOME: the identity of the sender. Unknown fields are ignored.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Introduction {
    /// Project of the sender.
    pub project: String,
    /// Address of the sender.
    pub node: NodeAddress,
    /// Name of the sender, for people.
    pub name: String,
    /// Incarnation of the sender.
    pub incarnation: Incarnation,
    /// The node that the sender wants to connect to.
    pub peer: NodeAddress,
    /// HELLO: number of this dial. WELCOME: number of the sender's last dial to this peer, 0 if none. This
    /// dial and all before it are void.
    pub dial: u64,
    /// Longest payload that the sender accepts, in bytes.
    pub payload_max: u64,
    /// Number of the receiver's confirmed messages, per connection, for which the sender has room for outcomes.
    #[serde(default = "default_answers", skip_serializing_if = "is_default_answers")]
    pub answers_max: u64,
    /// Optional features of the sender. Features of both nodes may be used: [`CLASSES`], [`CANCEL`],
    /// [`GUARD`], [`OUTCOMES`], [`OUTCOME_RUNS`], [`DATAGRAMS`], [`UNDELIVERED`].
    #[serde(default)]
    pub features: Vec<String>,
    /// The lane of this connection.
    #[serde(default, skip_serializing_if = "Lane::is_control")]
    pub lane: Lane,
    /// Number of the dial that created the first connection; only for a further connection.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub link: u64,
    /// Number of discovery datagrams that the sender's incarnation has created, if it has keys. None of these
    /// is valid any more.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub datagrams_made: u64,
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde calls it with a reference")]
const fn is_zero(number: &u64) -> bool {
    *number == 0
}

const fn default_answers() -> u64 {
    ANSWERS_DEFAULT
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde calls it with a reference")]
const fn is_default_answers(answers_max: &u64) -> bool {
    *answers_max == ANSWERS_DEFAULT
}

impl Introduction {
    /// Whether the sender supports one connection per class.
    pub fn supports_classes(&self) -> bool {
        self.supports(CLASSES)
    }

    /// Whether the sender supports this feature.
    pub fn supports(&self, ability: &str) -> bool {
        self.features.iter().any(|feature| feature == ability)
    }
}

/// Payload of REFUSAL.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Refusal {
    /// One cause of the table in `docs/protocol/gncl.md`, for programs.
    pub cause: String,
    /// The reason, for people.
    pub sentence: String,
}

/// The reason why a node refuses another.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum RefusalError {
    /// The frame or its payload is invalid.
    Violation(String),
    /// The frames have another protocol version.
    Version(String),
    OtherProject {
        theirs: String,
        ours: String,
    },
    OwnAddress {
        node: NodeAddress,
        name: String,
    },
    WrongNode {
        wanted: NodeAddress,
        ours: NodeAddress,
    },
    Stale {
        theirs: Incarnation,
        known: Incarnation,
    },
    Contested {
        node: NodeAddress,
    },
    /// NDL has lost this incarnation, and not found it again.
    Lost {
        node: NodeAddress,
    },
    Duplicate,
    TooManyPeers {
        peers_max: usize,
    },
    TooManyClaims {
        strangers_max: usize,
    },
    TooLate,
    Leaving,
    /// The peer has not authenticated, or has authenticated as another node.
    Security(String),
}

impl RefusalError {
    /// Returns the name of this cause in a REFUSAL and in the counters.
    pub const fn cause(&self) -> &'static str {
        match self {
            Self::Violation(_) => "violation",
            Self::Version(_) => "version",
            Self::OtherProject { .. } => "other project",
            Self::OwnAddress { .. } => "own address",
            Self::WrongNode { .. } => "wrong node",
            Self::Stale { .. } => "stale incarnation",
            Self::Contested { .. } | Self::Lost { .. } => "contested",
            Self::Duplicate => "duplicate",
            Self::TooManyPeers { .. } | Self::TooManyClaims { .. } => "too many peers",
            Self::TooLate => "too late",
            Self::Leaving => "leaving",
            Self::Security(_) => "security",
        }
    }

    /// Returns the frame's payload. Its sentence may quote an unauthenticated peer, so it is made [`printable`].
    pub fn to_refusal(&self) -> Refusal {
        Refusal { cause: self.cause().to_owned(), sentence: printable(&self.to_string()) }
    }
}

impl fmt::Display for RefusalError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Violation(what) | Self::Version(what) | Self::Security(what) => f.write_str(what),
            Self::OtherProject { theirs, ours } => write!(
                f,
                "you belong to the project '{theirs}' and I to '{ours}'; give both the same project, or keep them on \
                 different networks"
            ),
            Self::OwnAddress { node, name } => write!(
                f,
                "the address {node} is mine and you ('{name}') use it too; give each node its own address"
            ),
            Self::WrongNode { wanted, ours } => write!(
                f,
                "you want to talk to node {wanted} and I am {ours}; an announcement is out of date or an address is \
                 given twice"
            ),
            Self::Stale { theirs, known } => write!(
                f,
                "incarnation {theirs} of your node is over, I know {known}; is an old process still running?"
            ),
            Self::Contested { node } => write!(
                f,
                "an earlier process still answers as node {node}; wait until it is found to be gone, or give each its own \
                 address"
            ),
            Self::Lost { node } => write!(
                f,
                "I have lost node {node} and not found it again; what waits for me goes on when I do, so see that its NDL answers \
                 mine (UDP)"
            ),
            Self::Duplicate => {
                f.write_str("another connection between us is made or being made; keep that one")
            }
            Self::TooManyPeers { peers_max } => {
                write!(f, "I have {peers_max} peers, which is my limit; raise `ndl.nodes_max`")
            }
            Self::TooManyClaims { strangers_max } => write!(
                f,
                "I have {strangers_max} peers of which my NDL has not told me, which is my limit; see that our nodes find each \
                 other, or raise `gncl.strangers_max`"
            ),
            Self::TooLate => f.write_str("the handshake took longer than `gncl.handshake` allows"),
            Self::Leaving => f.write_str("this node is being stopped"),
        }
    }
}

/// Checks an introduction independently of the known peers.
pub(super) fn check(theirs: &Introduction, ours: &Introduction) -> Result<(), RefusalError> {
    let long = |name: &str| name.is_empty() || name.len() > NAME_MAX;
    if long(&theirs.project) || long(&theirs.name) {
        Err(RefusalError::Violation(format!("names of projects and nodes have 1 to {NAME_MAX} bytes")))
    } else if theirs.project != ours.project {
        Err(RefusalError::OtherProject { theirs: theirs.project.clone(), ours: ours.project.clone() })
    } else if !theirs.node.is_single() {
        Err(RefusalError::Violation(format!("'{}' is not the address of one node", theirs.node)))
    } else if theirs.node == ours.node {
        Err(RefusalError::OwnAddress { node: ours.node, name: theirs.name.clone() })
    } else if theirs.peer != ours.node {
        Err(RefusalError::WrongNode { wanted: theirs.peer, ours: ours.node })
    } else {
        Ok(())
    }
}

/// Makes text that a peer may have chosen safe for a log or another node: at most a few lines, without
/// terminal control characters.
pub(super) fn printable(text: &str) -> String {
    text.chars().filter(|c| !c.is_control()).take(SENTENCE_MAX).collect()
}

/// Encodes a payload of this layer as MessagePack.
pub fn write<T: Serialize>(value: &T) -> Bytes {
    // The structs of strings and numbers can always be encoded. An acknowledgement is one of them, and is
    // sent at least each 32 messages: the memory is reused.
    sinew_runtime::wire::encode(value)
}

/// Decodes a payload of this layer.
pub fn read<T: DeserializeOwned>(payload: &[u8]) -> Result<T, RefusalError> {
    sinew_runtime::wire::decode(payload)
        .map_err(|cause| RefusalError::Violation(format!("a payload of GNCL is wrong: {cause}")))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    pub(crate) fn introduction() -> Introduction {
        Introduction {
            project: "exo".to_owned(),
            node: NodeAddress::new(2),
            name: "knee".to_owned(),
            incarnation: Incarnation(1),
            peer: NodeAddress::new(1),
            dial: 1,
            payload_max: 1 << 20,
            answers_max: ANSWERS_DEFAULT,
            features: Vec::new(),
            lane: Lane::Control,
            link: 0,
            datagrams_made: 0,
        }
    }

    fn ours() -> Introduction {
        Introduction { node: NodeAddress::new(1), peer: NodeAddress::new(2), ..introduction() }
    }

    #[test]
    fn each_fault_of_a_hello_has_its_own_text() {
        let cases = [
            (Introduction { project: "arm".to_owned(), ..introduction() }, "other project"),
            (Introduction { node: NodeAddress::new(1), ..introduction() }, "own address"),
            (Introduction { peer: NodeAddress::new(7), ..introduction() }, "wrong node"),
            (Introduction { node: NodeAddress::ALL, ..introduction() }, "violation"),
            (Introduction { name: String::new(), ..introduction() }, "violation"),
            (Introduction { project: "x".repeat(64), ..introduction() }, "violation"),
        ];
        for (hello, cause) in cases {
            assert_eq!(check(&hello, &ours()).unwrap_err().cause(), cause, "{hello:?}");
        }
        assert_eq!(check(&introduction(), &ours()), Ok(()));
    }

    #[test]
    fn documentation_shows_the_bytes_of_a_hello() {
        let hello = Introduction {
            project: "exo".to_owned(),
            node: NodeAddress::new(0x0a00_0007),
            name: "knee".to_owned(),
            incarnation: Incarnation(7),
            peer: NodeAddress::new(0x0a00_0008),
            dial: 1_000_000,
            payload_max: 1 << 20,
            answers_max: ANSWERS_DEFAULT,
            features: Vec::new(),
            lane: Lane::Control,
            link: 0,
            datagrams_made: 0,
        };
        let page = include_str!("../../../../docs/protocol/gncl.md");
        let shown = page.split("```text").nth(1).and_then(|rest| rest.split("```").next()).unwrap();
        // Each line has bytes, then at least two spaces, then their meaning.
        let bytes = shown.lines().map(|line| line.trim_start().split("  ").next().unwrap_or_default());
        let bytes: Vec<&str> = bytes.flat_map(str::split_whitespace).collect();
        let written: Vec<_> = write(&hello).iter().map(|byte| format!("{byte:02x}")).collect();
        assert_eq!(bytes, written);
    }

    #[test]
    fn fields_of_a_later_version_are_ignored() {
        let mut map = std::collections::BTreeMap::from([("colour".to_owned(), serde_json::json!("red"))]);
        let serde_json::Value::Object(known) = serde_json::to_value(introduction()).unwrap() else {
            unreachable!()
        };
        map.extend(known);
        assert_eq!(read::<Introduction>(&rmp_serde::to_vec_named(&map).unwrap()), Ok(introduction()));
    }

    #[test]
    fn refusal_text_is_bounded_and_free_of_control_characters() {
        let mut strange = serde_json::to_value(introduction()).unwrap();
        strange["lane"] = "\u{1b}[2J\u{1f980}".repeat(450).into();
        let strange = rmp_serde::to_vec_named(&strange).unwrap();
        assert!(strange.len() <= HANDSHAKE_PAYLOAD_MAX, "{} bytes are taken", strange.len());
        let refusal = read::<Introduction>(&strange).unwrap_err().to_refusal();
        assert!(refusal.sentence.contains("[2J"), "it quotes what is wrong: {}", refusal.sentence);
        assert!(!refusal.sentence.contains(char::is_control), "{:?}", refusal.sentence);
        let length = write(&refusal).len();
        assert!(length <= HANDSHAKE_PAYLOAD_MAX, "{length} bytes");
    }

    proptest! {
        #[test]
        fn any_bytes_are_an_introduction_or_a_violation(bytes: Vec<u8>) {
            if let Err(decline) = read::<Introduction>(&bytes) {
                prop_assert_eq!(decline.cause(), "violation");
            }
        }
    }
}
