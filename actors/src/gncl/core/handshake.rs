//! What two nodes say to each other first, and why one may refuse the other.

use std::fmt;

use bytes::Bytes;
use serde::{Deserialize, Serialize, de::DeserializeOwned};
use sinew_runtime::tid::{Incarnation, NodeAddress};

/// Longest payload in bytes before the handshake is over: a stranger can make us hold no more.
pub(crate) const HANDSHAKE_PAYLOAD_MAX: usize = 4_096;

/// Longest name of a node or a project, in bytes.
const NAME_MAX: usize = 63;

/// Longest words of a REFUSAL, in characters: whatever they are, they have room in a payload.
const WORDS_MAX: usize = 800;

/// How many answers a node keeps that does not say it: one from before it was said, with its defaults.
const ANSWERS_UNSAID: u64 = 8_192;

/// The ability to have a connection for each class.
pub(crate) const CLASSES: &str = "classes";

/// The ability to read a guard of each frame's length.
pub(crate) const GUARD: &str = "guard";

/// The ability to take a request back that nobody waits for any more.
pub(crate) const CANCEL: &str = "cancel";

/// The ability to take several outcomes in one frame.
pub(crate) const OUTCOMES: &str = "outcomes";

/// The ability to have values of class Stream by datagram.
pub(crate) const DATAGRAMS: &str = "datagrams-2";

/// The ability to take reports of messages that were not delivered.
pub(crate) const UNDELIVERED: &str = "undelivered";

/// Whose messages a connection carries: those of one class, where both nodes know [`CLASSES`]. Where one does not, the first
/// carries all.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(crate) enum Lane {
    /// The first connection: the link stands and falls with it.
    #[default]
    Control,
    Stream,
    Bulk,
}

impl Lane {
    pub(crate) const ALL: [Self; 3] = [Self::Control, Self::Stream, Self::Bulk];
    /// Those that are made when the first connection stands.
    pub(crate) const SIDES: [Self; 2] = [Self::Stream, Self::Bulk];

    fn is_control(&self) -> bool {
        *self == Self::Control
    }
}

/// Payload of HELLO and of WELCOME: who the sender is. Fields that are not known are ignored.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Introduction {
    /// Project of the sender.
    pub(crate) project: String,
    /// Address of the sender.
    pub(crate) node: NodeAddress,
    /// Name of the sender, for people.
    pub(crate) name: String,
    /// Which life of the sender this is.
    pub(crate) incarnation: Incarnation,
    /// Whom the sender wants to talk to.
    pub(crate) peer: NodeAddress,
    /// HELLO: number of this dial. WELCOME: number of the sender's last dial to this peer, 0 if none; void are this
    /// one and all before it.
    pub(crate) dial: u64,
    /// Longest payload that the sender takes, in bytes.
    pub(crate) payload_max: u64,
    /// Confirmed messages of the receiver, of each connection, for whose outcomes the sender has room.
    #[serde(default = "unsaid", skip_serializing_if = "is_unsaid")]
    pub(crate) answers_max: u64,
    /// Optional abilities of the sender; what both have may be used: [`CLASSES`], [`CANCEL`], [`GUARD`], [`OUTCOMES`],
    /// [`DATAGRAMS`], [`UNDELIVERED`].
    #[serde(default)]
    pub(crate) features: Vec<String>,
    /// What travels on this connection.
    #[serde(default, skip_serializing_if = "Lane::is_control")]
    pub(crate) lane: Lane,
    /// Of a further connection: number of the dial that made the first one.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub(crate) link: u64,
    /// Where it has keys: how many datagrams of discovery its life has made. None of them counts any more.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub(crate) datagrams_made: u64,
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde calls it with a reference")]
const fn is_zero(number: &u64) -> bool {
    *number == 0
}

const fn unsaid() -> u64 {
    ANSWERS_UNSAID
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde calls it with a reference")]
const fn is_unsaid(answers_max: &u64) -> bool {
    *answers_max == ANSWERS_UNSAID
}

impl Introduction {
    /// Whether the sender can have a connection for each class.
    pub(crate) fn knows_classes(&self) -> bool {
        self.knows(CLASSES)
    }

    /// Whether the sender has this ability.
    pub(crate) fn knows(&self, ability: &str) -> bool {
        self.features.iter().any(|feature| feature == ability)
    }
}

/// Payload of REFUSAL.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Refusal {
    /// One word of the table in `docs/protocol/gncl.md`, for programs.
    pub(crate) cause: String,
    /// Why, for people.
    pub(crate) sentence: String,
}

/// Why a node does not take another one's word.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Decline {
    /// The frame or its payload is not what it should be.
    Violation(String),
    /// The frames are of another version of the protocol.
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
    /// NDL has lost this life, and not found it again.
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
    /// It has not proven who it is, or has proven to be another one.
    Security(String),
}

impl Decline {
    /// The word that names this cause in a REFUSAL and among the counters.
    pub(crate) const fn cause(&self) -> &'static str {
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

    /// The frame's payload. Its sentence may quote what a stranger has said: it is [`printable`].
    pub(crate) fn to_refusal(&self) -> Refusal {
        Refusal { cause: self.cause().to_owned(), sentence: printable(&self.to_string()) }
    }
}

impl fmt::Display for Decline {
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

/// Checks what does not depend on who is known already.
pub(crate) fn check(theirs: &Introduction, ours: &Introduction) -> Result<(), Decline> {
    let long = |name: &str| name.is_empty() || name.len() > NAME_MAX;
    if long(&theirs.project) || long(&theirs.name) {
        Err(Decline::Violation(format!("names of projects and nodes have 1 to {NAME_MAX} bytes")))
    } else if theirs.project != ours.project {
        Err(Decline::OtherProject { theirs: theirs.project.clone(), ours: ours.project.clone() })
    } else if !theirs.node.is_single() {
        Err(Decline::Violation(format!("'{}' is not the address of one node", theirs.node)))
    } else if theirs.node == ours.node {
        Err(Decline::OwnAddress { node: ours.node, name: theirs.name.clone() })
    } else if theirs.peer != ours.node {
        Err(Decline::WrongNode { wanted: theirs.peer, ours: ours.node })
    } else {
        Ok(())
    }
}

/// Words that a peer may have chosen, for a log or for another node: at most a few lines, and nothing that a terminal would obey.
pub(super) fn printable(words: &str) -> String {
    words.chars().filter(|c| !c.is_control()).take(WORDS_MAX).collect()
}

/// The MessagePack form of a payload of this layer.
pub(crate) fn write<T: Serialize>(value: &T) -> Bytes {
    // Structs of strings and numbers, which can be written. An acknowledgement is one, and each 32 messages at most have one: in memory that
    // is used again.
    sinew_runtime::wire::encode(value)
}

/// Reads a payload of this layer.
pub(crate) fn read<T: DeserializeOwned>(payload: &[u8]) -> Result<T, Decline> {
    sinew_runtime::wire::decode(payload)
        .map_err(|cause| Decline::Violation(format!("a payload of GNCL is wrong: {cause}")))
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
            answers_max: ANSWERS_UNSAID,
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
    fn each_fault_of_a_hello_has_its_own_words() {
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
    fn the_documentation_shows_the_bytes_of_a_hello() {
        let hello = Introduction {
            project: "exo".to_owned(),
            node: NodeAddress::new(0x0a00_0007),
            name: "knee".to_owned(),
            incarnation: Incarnation(7),
            peer: NodeAddress::new(0x0a00_0008),
            dial: 1_000_000,
            payload_max: 1 << 20,
            answers_max: ANSWERS_UNSAID,
            features: Vec::new(),
            lane: Lane::Control,
            link: 0,
            datagrams_made: 0,
        };
        let page = include_str!("../../../../docs/protocol/gncl.md");
        let shown = page.split("```text").nth(1).and_then(|rest| rest.split("```").next()).unwrap();
        // Each line has bytes, then at least two spaces, then what they mean.
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
    fn the_words_of_a_refusal_have_room_and_no_controls_whatever_the_stranger_has_said() {
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
