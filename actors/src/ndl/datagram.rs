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
mod tests;
