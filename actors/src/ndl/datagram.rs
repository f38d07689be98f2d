//! NDL's datagrams: one frame each, at most 1,200 bytes, their payloads MessagePack maps.

use std::net::{Ipv4Addr, SocketAddr, SocketAddrV4};

use bytes::BytesMut;
use serde::{Deserialize, Serialize};
use sinew_runtime::{
    tid::{AppAddress, Incarnation, NodeAddress, Tid},
    time::Time,
    wire::{Flags, Header, HeaderError, Kind, decode, decode_datagram, encode_frame},
};

use super::Progress;

/// Longest datagram in bytes: it passes every network unfragmented. // spec: NDL-1
pub(crate) const DATAGRAM_MAX: usize = 1_200;

/// Longest name of a project or node, in bytes.
const NAME_MAX: usize = 63;

/// Addresses of a node's GNCL at most, beside the first: with the longest names an answer has 400 bytes.
pub(crate) const FURTHER_MAX: usize = 7;

/// Addresses of a node's NDL at most, each on a path of its own.
pub(crate) const PATHS_MAX: usize = 8;

/// How a node stands to its address, in the datagram as a number: 1, 2, or not there at all.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(from = "u8", into = "u8")]
pub(crate) enum Claim {
    /// The address is its own: it has been there for so long that another process with it would have been heard.
    #[default]
    Held,
    /// It has just come, or come back, and gives the address up if another process has it.
    Settling,
    /// It gives the address up, which another process has.
    Yielded,
}

impl From<u8> for Claim {
    fn from(number: u8) -> Self {
        match number {
            1 => Self::Settling,
            2 => Self::Yielded,
            _ => Self::Held,
        }
    }
}

impl From<Claim> for u8 {
    fn from(claim: Claim) -> Self {
        match claim {
            Claim::Held => 0,
            Claim::Settling => 1,
            Claim::Yielded => 2,
        }
    }
}

impl Claim {
    const fn is_held(&self) -> bool {
        matches!(self, Self::Held)
    }
}

/// What a node says about itself in every datagram.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Announcement {
    /// Project that the node belongs to. 1 to 63 bytes.
    pub(crate) project: String,
    /// The node's address.
    pub(crate) node: NodeAddress,
    /// The node's name. 1 to 63 bytes.
    pub(crate) name: String,
    /// Which life of the node this is.
    pub(crate) incarnation: Incarnation,
    /// Drawn at random by each process: two processes with one address are told apart by it.
    pub(crate) boot_nonce: u64,
    /// IPv4 address of the node's GNCL listener, as a number: 10.0.0.7 is 0x0a000007.
    pub(crate) gncl_ip: u32,
    /// TCP port of the node's GNCL listener.
    pub(crate) gncl_port: u16,
    /// Time between two queries of the node, in microseconds.
    pub(crate) period_us: u32,
    /// Further addresses and ports of the listener, [`FURTHER_MAX`] at most: those of other interfaces.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub(crate) gncl_further: Vec<(u32, u16)>,
    /// All IPv4 addresses and ports where its NDL answers, if there are several; [`PATHS_MAX`] at most. // spec: NDL-3.3
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub(crate) ndl: Vec<(u32, u16)>,
    /// Whether the address is its own already, and still.
    #[serde(default, skip_serializing_if = "Claim::is_held")]
    pub(crate) claim: Claim,
}

impl Announcement {
    /// Where the node's GNCL listens.
    pub(crate) fn gncl(&self) -> SocketAddrV4 {
        SocketAddrV4::new(Ipv4Addr::from(self.gncl_ip), self.gncl_port)
    }

    /// All addresses where it listens, the one that it prefers first.
    pub(crate) fn gncl_addresses(&self) -> Vec<SocketAddr> {
        let further = self.gncl_further.iter().map(|(ip, port)| (Ipv4Addr::from(*ip), *port).into());
        std::iter::once(self.gncl().into()).chain(further).collect()
    }

    /// All addresses where its NDL answers, if there are several.
    pub(crate) fn ndl_addresses(&self) -> impl Iterator<Item = SocketAddr> {
        self.ndl.iter().map(|(ip, port)| (Ipv4Addr::from(*ip), *port).into())
    }

    /// Its NDL answers there. Where there is one address alone, whoever asks it knows it.
    pub(crate) fn announce_ndl(&mut self, paths: &[SocketAddr]) {
        let number = |path: &SocketAddr| match path {
            SocketAddr::V4(path) => Some((path.ip().to_bits(), path.port())),
            SocketAddr::V6(_) => None,
        };
        self.ndl = if paths.len() > 1 { paths.iter().filter_map(number).collect() } else { Vec::new() };
    }

    /// Whether both are from one process.
    pub(crate) fn is_same_life(&self, other: &Self) -> bool {
        self.incarnation == other.incarnation && self.boot_nonce == other.boot_nonce
    }

    /// Whether the node address is this process's rather than `other`'s, if both live: who has settled goes before who settles, and
    /// then the elder life before the later one. // spec: NDL-5.6
    pub(crate) fn precedes(&self, other: &Self) -> bool {
        let rank = |of: &Self| (of.claim != Claim::Held, of.incarnation, of.boot_nonce);
        rank(self) < rank(other)
    }

    fn check(self) -> Result<Self, DatagramError> {
        let name_is_fit =
            |name: &str| (1..=NAME_MAX).contains(&name.len()) && !name.contains(char::is_control);
        let leads_nowhere = |address: SocketAddr| {
            let SocketAddr::V4(address) = address else { return true };
            let ip = address.ip();
            address.port() == 0 || ip.is_unspecified() || ip.is_multicast() || ip.is_broadcast()
        };
        let fault = if !name_is_fit(&self.project) || !name_is_fit(&self.name) {
            "a name is empty, longer than 63 bytes, or has control characters"
        } else if !self.node.is_single() {
            "its node address names no single node"
        } else if self.gncl_further.len() > FURTHER_MAX {
            "its GNCL has too many addresses"
        } else if self.ndl.len() > PATHS_MAX {
            "its NDL has too many addresses"
        } else if self.ndl_addresses().any(leads_nowhere) {
            "nobody can be asked at an address of its NDL"
        } else if self.gncl_addresses().into_iter().any(leads_nowhere) {
            "nobody can be reached at an address of its GNCL"
        } else {
            return Ok(self);
        };
        Err(DatagramError::Announcement(fault))
    }
}

/// The payload of an answer.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Answer {
    /// Who answers.
    pub(crate) announcement: Announcement,
    /// Send time of the query, in nanoseconds of the asking node's clock, as it stood in the query's header.
    pub(crate) query_sent_ns: u64,
    /// When the query arrived, in nanoseconds of the answering node's clock.
    pub(crate) query_received_ns: u64,
    /// What of the node does not get on.
    #[serde(default, skip_serializing_if = "Progress::is_nothing")]
    pub(crate) progress: Progress,
}

/// A datagram that keeps the rules of its form.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Datagram {
    /// Ties an answer to its query.
    pub(crate) correlation: u64,
    /// Send time, in the sender's clock.
    pub(crate) sent: Time,
    pub(crate) body: Body,
}

/// What a datagram says.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Body {
    /// Who is there? Are you?
    Query(Announcement),
    /// I am.
    Answer(Answer),
    /// I stop, in order.
    Leave(Announcement),
}

/// Why bytes are no datagram of NDL. The sender is at fault, or the network; nothing changed.
#[derive(Debug, thiserror::Error)]
pub(crate) enum DatagramError {
    #[error("it is longer than {DATAGRAM_MAX} bytes")]
    TooLong,
    #[error(transparent)]
    Header(#[from] HeaderError),
    #[error("its kind {0} is none of NDL's")]
    Kind(Kind),
    #[error("it is for {0}, not for this node's NDL")]
    Misdirected(Tid),
    #[error("its payload cannot be read: {0}")]
    Payload(#[from] rmp_serde::decode::Error),
    #[error("its announcement cannot be used: {0}")]
    Announcement(&'static str),
    #[error("its source {source_tid} is not the NDL of {announced}, which it announces")]
    Forged { source_tid: Tid, announced: NodeAddress },
}

impl DatagramError {
    /// The cause under which the refusal is counted.
    pub(crate) const fn cause(&self) -> &'static str {
        match self {
            Self::TooLong => "NDL datagram is too long",
            Self::Header(HeaderError::Version { .. }) => "NDL datagram of another protocol version",
            Self::Header(_) => "NDL datagram is not a frame",
            Self::Kind(_) => "NDL datagram of a foreign kind",
            Self::Misdirected(_) => "NDL datagram for somebody else",
            Self::Payload(_) | Self::Announcement(_) => "NDL datagram with a bad payload",
            Self::Forged { .. } => "NDL datagram with a forged source",
        }
    }
}

/// The correlation id of `bytes` if they look like an answer: cheap, nothing else is checked.
pub(crate) fn peek_answer(bytes: &[u8]) -> Option<u64> {
    let kind = u32::from_le_bytes(bytes.get(8..12)?.try_into().ok()?);
    let correlation = u64::from_le_bytes(bytes.get(40..48)?.try_into().ok()?);
    (kind == Kind::NDL_ANSWER.bits()).then_some(correlation)
}

/// Reads a datagram that reached the node at `here`. // spec: NDL-1
pub(crate) fn parse(here: NodeAddress, bytes: &[u8]) -> Result<Datagram, DatagramError> {
    if bytes.len() > DATAGRAM_MAX {
        return Err(DatagramError::TooLong);
    }
    let message = decode_datagram(bytes)?;
    let Header { kind, source, destination, correlation, sent, .. } = message.header;
    let is_for_us =
        destination.app == AppAddress::NDL && [here, NodeAddress::ALL].contains(&destination.node);
    if !is_for_us {
        return Err(DatagramError::Misdirected(destination));
    }
    let body = match kind {
        Kind::NDL_QUERY => Body::Query(announcement(&message.payload)?),
        Kind::NDL_ANSWER => {
            let answer: Answer = decode(&message.payload)?;
            if !answer.progress.is_fit() {
                return Err(DatagramError::Announcement("what it says does not get on cannot be so"));
            }
            Body::Answer(Answer { announcement: answer.announcement.check()?, ..answer })
        }
        Kind::NDL_LEAVE => Body::Leave(announcement(&message.payload)?),
        other => return Err(DatagramError::Kind(other)),
    };
    let announced = body.announcement().node;
    if source != Tid::new(announced, AppAddress::NDL) {
        return Err(DatagramError::Forged { source_tid: source, announced });
    }
    Ok(Datagram { correlation, sent, body })
}

fn announcement(payload: &[u8]) -> Result<Announcement, DatagramError> {
    decode::<Announcement>(payload)?.check()
}

impl Body {
    /// Who speaks.
    pub(crate) const fn announcement(&self) -> &Announcement {
        match self {
            Self::Query(announcement) | Self::Leave(announcement) => announcement,
            Self::Answer(answer) => &answer.announcement,
        }
    }
}

/// The bytes of a datagram to `to`.
pub(crate) fn encode(datagram: &Datagram, to: NodeAddress) -> BytesMut {
    let source = Tid::new(datagram.body.announcement().node, AppAddress::NDL);
    let (kind, flags, payload) = match &datagram.body {
        Body::Query(announcement) => (Kind::NDL_QUERY, Flags::ASK, rmp_serde::to_vec_named(announcement)),
        Body::Answer(answer) => (Kind::NDL_ANSWER, Flags::REPLY, rmp_serde::to_vec_named(answer)),
        Body::Leave(announcement) => (Kind::NDL_LEAVE, Flags::NONE, rmp_serde::to_vec_named(announcement)),
    };
    let payload = payload.expect("strings and numbers can be written as MessagePack");
    let mut header = Header::new(kind, source, Tid::new(to, AppAddress::NDL));
    header.flags = flags;
    header.correlation = datagram.correlation;
    header.sent = datagram.sent;
    let mut bytes = BytesMut::with_capacity(DATAGRAM_MAX);
    encode_frame(&header, &payload, &mut bytes);
    bytes
}

/// Which node says that it made a datagram, of which nothing else is believed yet.
pub(crate) fn maker_of(bytes: &[u8]) -> Option<NodeAddress> {
    const SOURCE_AT: usize = 16;
    let source = bytes.get(SOURCE_AT..)?.first_chunk()?;
    Some(Tid::from_bits(u64::from_le_bytes(*source)).node)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::ndl::{Part, Told, Trouble};

    fn any_announcement() -> impl Strategy<Value = Announcement> {
        let names = ("[a-zäöü ]{1,30}", "[a-z.-]{1,63}");
        let place = || (1..0xe000_0000_u32, 1..u16::MAX);
        let further = proptest::collection::vec(place(), 0..=FURTHER_MAX);
        let ndl = proptest::collection::vec(place(), 0..=PATHS_MAX);
        (names, 1..u32::MAX, any::<[u64; 2]>(), place(), further, ndl, any::<u32>(), 0..3u8).prop_map(
            |(
                (name, project),
                node,
                [incarnation, boot_nonce],
                (gncl_ip, gncl_port),
                gncl_further,
                ndl,
                period_us,
                claim,
            )| {
                Announcement {
                    project,
                    node: NodeAddress::new(node),
                    name,
                    incarnation: Incarnation(incarnation),
                    boot_nonce,
                    gncl_ip,
                    gncl_port,
                    period_us,
                    gncl_further,
                    ndl,
                    claim: Claim::from(claim),
                }
            },
        )
    }

    /// As many parts as `number` says, with the longest names.
    fn any_progress(number: u64) -> Progress {
        let part = |at| Part {
            app: AppAddress::new(0xffff_0000 + at),
            name: "x".repeat(63),
            trouble: Told(Trouble::GivenUp),
            since_ms: u32::MAX,
        };
        Progress::of((0..(number % 7) as u32).map(part).collect())
    }

    fn any_datagram() -> impl Strategy<Value = Datagram> {
        (any_announcement(), 0..3, any::<[u64; 4]>()).prop_map(
            |(announcement, kind, [correlation, sent, a, b])| {
                let body = match kind {
                    0 => Body::Query(announcement),
                    1 => Body::Leave(announcement),
                    _ => Body::Answer(Answer {
                        announcement,
                        query_sent_ns: a,
                        query_received_ns: b,
                        progress: any_progress(a),
                    }),
                };
                Datagram { correlation, sent: Time::from_nanos(sent), body }
            },
        )
    }

    const HERE: NodeAddress = NodeAddress::new(7);

    proptest! {
        #[test]
        fn what_is_written_is_read_back_and_fits(datagram in any_datagram(), to_all: bool) {
            let bytes = encode(&datagram, if to_all { NodeAddress::ALL } else { HERE });
            prop_assert!(bytes.len() <= DATAGRAM_MAX);
            prop_assert_eq!(parse(HERE, &bytes).unwrap(), datagram);
        }

        #[test]
        fn any_bytes_are_a_datagram_or_an_error(bytes in proptest::collection::vec(any::<u8>(), 0..1_400)) {
            prop_assert!(parse(HERE, &bytes).is_err());
            let _ = peek_answer(&bytes);
        }

        #[test]
        fn any_payload_behind_a_good_header_is_a_datagram_or_an_error(
            payload in proptest::collection::vec(any::<u8>(), 0..1_100),
            kind in 0x20u32..0x24,
        ) {
            let _ = parse(HERE, &frame(Kind::from_bits(kind), &payload));
        }

        #[test]
        fn a_cut_or_flipped_datagram_is_refused(datagram in any_datagram(), keep in 0.0f64..1.0, bit in 0usize..800) {
            let whole = encode(&datagram, HERE);
            prop_assert!(parse(HERE, &whole[..(whole.len() as f64 * keep) as usize]).is_err());
            let mut flipped = whole.clone();
            flipped[bit / 8] ^= 1 << (bit % 8);
            prop_assert!(parse(HERE, &flipped).is_err());
        }

        #[test]
        fn a_datagram_for_another_node_is_refused(datagram in any_datagram(), other in 8..u32::MAX) {
            let error = parse(HERE, &encode(&datagram, NodeAddress::new(other))).unwrap_err();
            prop_assert!(matches!(error, DatagramError::Misdirected(_)));
        }
    }

    fn frame(kind: Kind, payload: &[u8]) -> BytesMut {
        let mut bytes = BytesMut::new();
        let ndl = |node| Tid::new(NodeAddress::new(node), AppAddress::NDL);
        encode_frame(&Header::new(kind, ndl(9), ndl(7)), payload, &mut bytes);
        bytes
    }

    fn sound() -> Announcement {
        Announcement {
            project: "p".to_owned(),
            node: NodeAddress::new(9),
            name: "knee".to_owned(),
            incarnation: Incarnation(1),
            boot_nonce: 2,
            gncl_ip: 0x7f00_0001,
            gncl_port: 4,
            period_us: 5,
            gncl_further: Vec::new(),
            ndl: Vec::new(),
            claim: Claim::Held,
        }
    }

    fn refusal(announcement: &Announcement) -> DatagramError {
        let payload = rmp_serde::to_vec_named(announcement).unwrap();
        parse(HERE, &frame(Kind::NDL_QUERY, &payload)).unwrap_err()
    }

    #[test]
    fn an_announcement_that_cannot_be_used_is_refused() {
        let unfit = [
            Announcement { name: String::new(), ..sound() },
            Announcement { name: "x".repeat(64), ..sound() },
            Announcement { project: "two\nlines".to_owned(), ..sound() },
            Announcement { node: NodeAddress::ALL, ..sound() },
            Announcement { gncl_port: 0, ..sound() },
            Announcement { gncl_ip: 0xe000_0001, ..sound() },
            Announcement { gncl_further: vec![(0x7f00_0002, 4), (0x7f00_0003, 0)], ..sound() },
            Announcement { gncl_further: vec![(0, 4)], ..sound() },
            Announcement { gncl_further: vec![(0x7f00_0002, 4); FURTHER_MAX + 1], ..sound() },
            Announcement { ndl: vec![(0x7f00_0002, 4); PATHS_MAX + 1], ..sound() },
            Announcement { ndl: vec![(0x7f00_0002, 0)], ..sound() },
            Announcement { ndl: vec![(0xe000_0001, 4)], ..sound() },
        ];
        for announcement in unfit {
            assert!(matches!(refusal(&announcement), DatagramError::Announcement(_)), "{announcement:?}");
        }
    }

    #[test]
    fn a_source_that_is_not_the_announced_node_is_refused() {
        let forged = refusal(&Announcement { node: NodeAddress::new(10), ..sound() });
        assert!(matches!(forged, DatagramError::Forged { .. }));
    }

    #[test]
    fn deep_nesting_ends_in_an_error_and_not_in_the_stack() {
        let nested = [0x91; 1_100];
        assert!(matches!(parse(HERE, &frame(Kind::NDL_QUERY, &nested)), Err(DatagramError::Payload(_))));
        // A field that nobody knows is skipped, however deep it goes.
        let mut unknown = vec![0x81, 0xa1, b'x'];
        unknown.extend([0x91; 1_090]);
        assert!(matches!(parse(HERE, &frame(Kind::NDL_QUERY, &unknown)), Err(DatagramError::Payload(_))));
    }

    #[test]
    fn another_version_is_refused_in_words() {
        let mut bytes = frame(Kind::NDL_QUERY, &[]);
        bytes[2] = 2;
        let error = parse(HERE, &bytes).unwrap_err();
        assert_eq!(error.cause(), "NDL datagram of another protocol version");
        assert!(error.to_string().contains("speaks version 2"), "{error}");
    }

    /// The example of `docs/protocol/ndl.md`.
    #[test]
    fn the_documented_example_is_what_is_sent() {
        let query =
            Datagram { correlation: 0x1122, sent: Time::from_nanos(0x3344), body: Body::Query(sound()) };
        let bytes = encode(&query, NodeAddress::ALL);
        let hex: Vec<String> = bytes.iter().map(|byte| format!("{byte:02x}")).collect();
        let example: Vec<&str> = include_str!("../../../docs/protocol/ndl.md")
            .split("```hex")
            .nth(1)
            .and_then(|rest| rest.split("```").next())
            .unwrap()
            .split_whitespace()
            .collect();
        assert_eq!(hex, example);
    }
}
