//! NDL's datagrams: one frame each, at most 1,200 bytes, their payloads MessagePack maps.

use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr};

use bytes::BytesMut;
use rmp_serde::encode::write_named;
use serde::{Deserialize, Serialize};
use sinew_runtime::{
    tid::{AppAddress, Incarnation, NodeAddress, Tid},
    time::Time,
    wire::{Flags, HEADER_LEN, Header, HeaderError, Kind, decode, encode_frame},
};

use super::{
    Progress,
    address::{is_link_local, is_same_host, seen_from, unscoped},
};
use crate::{last_words::LastWords, secured::SEAL_LEN};

/// Longest datagram in bytes: it passes every network unfragmented. // spec: NDL-1
pub(crate) const DATAGRAM_MAX: usize = 1_200;

/// Longest name of a project or node, in bytes.
const NAME_MAX: usize = 63;

/// Addresses of a node's GNCL at most, beside the first: with the longest names an answer has 400 bytes.
pub(crate) const FURTHER_MAX: usize = 7;

/// Addresses of a node's NDL at most, each on a path of its own.
pub(crate) const PATHS_MAX: usize = 8;

/// Addresses of a node's GNCL at most: those of IPv4, and of IPv6 one on each path and one link-local one on each route.
pub(crate) const GNCL_ADDRESSES_MAX: usize = 1 + FURTHER_MAX + 2 * PATHS_MAX;

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
    /// IPv4 address of the node's GNCL listener, as a number: 10.0.0.7 is 0x0a000007; 0: it has none.
    pub(crate) gncl_ip: u32,
    /// TCP port of the node's GNCL listener; 0: there is none at IPv4.
    pub(crate) gncl_port: u16,
    /// Time between two queries of the node, in microseconds.
    pub(crate) period_us: u32,
    /// Further addresses and ports of the listener, [`FURTHER_MAX`] at most: those of other interfaces.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub(crate) gncl_further: Vec<(u32, u16)>,
    /// All IPv4 addresses and ports where its NDL answers, if there are several; [`PATHS_MAX`] at most. // spec: NDL-3.3
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub(crate) ndl: Vec<(u32, u16)>,
    /// All IPv6 addresses and ports where its NDL answers, [`PATHS_MAX`] at most with those of IPv4: each as its upper and its lower 64 bits. A
    /// link-local one is meant on the link on which this is heard. // spec: NDL-3.5
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub(crate) ndl6: Vec<(u64, u64, u16)>,
    /// TCP port of its GNCL listener at those addresses; 0: there is none.
    #[serde(default, skip_serializing_if = "is_nothing")]
    pub(crate) gncl_port6: u16,
    /// Whether the address is its own already, and still.
    #[serde(default, skip_serializing_if = "Claim::is_held")]
    pub(crate) claim: Claim,
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde passes a field so")]
const fn is_nothing(port: &u16) -> bool {
    *port == 0
}

impl Announcement {
    /// All addresses where its GNCL listens, [`GNCL_ADDRESSES_MAX`] at most: the one that it prefers first, then the one at which it was
    /// `met`, then the families by turns. Of the link-local ones that at which its NDL is seen from each of `routes`, [`PATHS_MAX`] at most:
    /// from one of our addresses to one of its. // spec: NDL-3.5
    pub(crate) fn gncl_addresses(
        &self,
        met: Option<SocketAddr>,
        routes: impl IntoIterator<Item = (SocketAddr, SocketAddr)>,
    ) -> Vec<SocketAddr> {
        let first = Some((self.gncl_ip, self.gncl_port)).filter(|(_, port)| *port != 0);
        let further = first.iter().chain(&self.gncl_further);
        let mut all: Vec<SocketAddr> =
            further.map(|(ip, port)| (Ipv4Addr::from(*ip), *port).into()).collect();
        if self.gncl_port6 == 0 {
            return all;
        }
        let is_on_hosts = |at: &SocketAddr| !at.ip().is_loopback();
        let elsewhere = self.ndl6_addresses().filter(|at| !is_link_local(at.ip()));
        let by_link =
            routes.into_iter().filter(|(_, there)| is_link_local(there.ip()) && self.has_ndl_at(*there));
        let by_link = by_link.map(|(here, there)| seen_from(here, there)).take(PATHS_MAX);
        let mut ipv6: Vec<_> = by_link.chain(elsewhere).collect();
        ipv6.iter_mut().for_each(|at| at.set_port(self.gncl_port6));
        // Other hosts would find themselves at a loopback address.
        if all.iter().chain(&ipv6).any(is_on_hosts) {
            ipv6.retain(is_on_hosts);
        }
        for at in ipv6 {
            if !all.contains(&at) {
                all.push(at);
            }
        }
        debug_assert!(
            all.len() <= GNCL_ADDRESSES_MAX,
            "an announcement is checked before it is believed: {self:?}"
        );
        by_turns(all, met)
    }

    /// All addresses where its NDL answers, if it says them.
    pub(crate) fn ndl_addresses(&self) -> impl Iterator<Item = SocketAddr> {
        let ipv4 = self.ndl.iter().map(|(ip, port)| (Ipv4Addr::from(*ip), *port).into());
        ipv4.chain(self.ndl6_addresses())
    }

    fn ndl6_addresses(&self) -> impl Iterator<Item = SocketAddr> {
        let ip = |upper: u64, lower: u64| Ipv6Addr::from_bits(u128::from(upper) << 64 | u128::from(lower));
        self.ndl6.iter().map(move |(upper, lower, port)| (ip(*upper, *lower), *port).into())
    }

    /// Whether it says that its NDL answers there, on whichever of our links that is.
    pub(crate) fn has_ndl_at(&self, there: SocketAddr) -> bool {
        self.ndl_addresses().any(|address| address == unscoped(there))
    }

    /// Its NDL answers there. Where there is one address alone, whoever asks it knows it; of IPv6 it says where its GNCL is, too.
    pub(crate) fn announce_ndl(&mut self, paths: &[SocketAddr]) {
        (self.ndl, self.ndl6) = (Vec::new(), Vec::new());
        for path in paths {
            match path {
                SocketAddr::V4(path) if paths.len() > 1 => self.ndl.push((path.ip().to_bits(), path.port())),
                // Its only path.
                SocketAddr::V4(_) => {}
                SocketAddr::V6(path) => {
                    let (bits, low) = (path.ip().to_bits(), u128::from(u64::MAX));
                    let half = |bits: u128| u64::try_from(bits & low).unwrap_or(u64::MAX);
                    self.ndl6.push((half(bits >> 64), half(bits), path.port()));
                }
            }
        }
    }

    /// Takes over from what the same life says later where it is; returns whether its NDL is elsewhere than before.
    pub(crate) fn note_addresses(&mut self, said: &Self) -> bool {
        let is_elsewhere = self.ndl != said.ndl || self.ndl6 != said.ndl6;
        (self.gncl_ip, self.gncl_port, self.gncl_port6) = (said.gncl_ip, said.gncl_port, said.gncl_port6);
        self.gncl_further.clone_from(&said.gncl_further);
        self.ndl.clone_from(&said.ndl);
        self.ndl6.clone_from(&said.ndl6);
        is_elsewhere
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
            let is_a_host = match address.ip() {
                IpAddr::V4(ip) => !(ip.is_unspecified() || ip.is_multicast() || ip.is_broadcast()),
                // One of IPv4 in the guise of one of IPv6 would be asked past what is said of it elsewhere.
                IpAddr::V6(ip) => {
                    !(ip.is_unspecified() || ip.is_multicast()) && ip.to_ipv4_mapped().is_none()
                }
            };
            address.port() == 0 || !is_a_host
        };
        let has_gncl4 = self.gncl_ip != 0 || self.gncl_port != 0;
        let gncl4 =
            self.gncl_further.iter().copied().chain(has_gncl4.then_some((self.gncl_ip, self.gncl_port)));
        let mut gncl4 = gncl4.map(|(ip, port)| SocketAddr::from((Ipv4Addr::from(ip), port)));
        let has_gncl6 = self.gncl_port6 != 0 && !self.ndl6.is_empty();
        let fault = if !name_is_fit(&self.project) || !name_is_fit(&self.name) {
            "a name is empty, longer than 63 bytes, or has control characters"
        } else if !self.node.is_single() {
            "its node address names no single node"
        } else if self.gncl_further.len() > FURTHER_MAX {
            "its GNCL has too many addresses"
        } else if self.ndl.len() + self.ndl6.len() > PATHS_MAX {
            "its NDL has too many addresses"
        } else if self.ndl_addresses().any(leads_nowhere) {
            "nobody can be asked at an address of its NDL"
        } else if !(has_gncl4 || has_gncl6) || gncl4.any(leads_nowhere) {
            "nobody can be reached at an address of its GNCL"
        } else {
            return Ok(self);
        };
        Err(DatagramError::Announcement(fault))
    }
}

/// The first stays first. Behind it is the address at which somebody was `met`, as that one is known to be in reach; then the families take
/// turns (RFC 8305, section 4), so that one that leads nowhere holds the other one up by one address at a time.
fn by_turns(mut all: Vec<SocketAddr>, met: Option<SocketAddr>) -> Vec<SocketAddr> {
    if all.is_empty() {
        return all;
    }
    let mut last = all.remove(0);
    let mut ordered = vec![last];
    if let Some(at) = met.and_then(|met| all.iter().position(|at| is_same_host(*at, met))) {
        last = all.remove(at);
        ordered.push(last);
    }
    let (same, other): (Vec<_>, Vec<_>) = all.into_iter().partition(|at| at.is_ipv4() == last.is_ipv4());
    let (mut next, mut then) = (other.into_iter(), same.into_iter());
    while let Some(at) = next.next().or_else(|| then.next()) {
        ordered.push(at);
        std::mem::swap(&mut next, &mut then);
    }
    ordered
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

/// The payload of a leave: an announcement, and one field more where the node gave up. // spec: NDL-4.8
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub(crate) struct Leave {
    /// The node that stops.
    #[serde(flatten)]
    pub(crate) announcement: Announcement,
    /// Why it gave up; `None`: it stops in order.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) gave_up: Option<LastWords>,
}

impl From<Announcement> for Leave {
    /// Of a node that stops in order.
    fn from(announcement: Announcement) -> Self {
        Self { announcement, gave_up: None }
    }
}

/// The further field of a leave, which is read by itself: the announcement is read as in any other datagram.
#[derive(Deserialize)]
struct LeaveWords {
    #[serde(default)]
    gave_up: Option<LastWords>,
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
    /// I stop.
    Leave(Leave),
}

/// Why bytes are no datagram of NDL. The sender is at fault, or the network; nothing changed.
#[derive(Debug, thiserror::Error)]
pub(crate) enum DatagramError {
    #[error("it is longer than {DATAGRAM_MAX} bytes")]
    TooLong,
    #[error(
        "it is sealed, and this node has no keys: give it some of that one's project (`sinew keys issue`, security.keys), or take \
         security.keys from that one's configuration"
    )]
    Sealed,
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
            Self::Sealed => "sealed NDL datagram at a node without keys",
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
    match read(here, bytes) {
        // Of a node with keys that took it the seal is gone here.
        Err(DatagramError::TooLong | DatagramError::Header(HeaderError::Length { .. }))
            if is_sealed(bytes) =>
        {
            Err(DatagramError::Sealed)
        }
        read => read,
    }
}

/// Whether these are a whole frame, whatever is in it.
pub(crate) fn is_frame(bytes: &[u8]) -> bool {
    let parts = bytes.split_first_chunk::<HEADER_LEN>();
    parts.is_some_and(|(head, payload)| Header::decode(head, payload).is_ok())
}

/// Whether these are a whole frame and as many bytes behind it as a seal has.
fn is_sealed(bytes: &[u8]) -> bool {
    bytes.split_last_chunk::<SEAL_LEN>().is_some_and(|(frame, _)| is_frame(frame))
}

fn read(here: NodeAddress, bytes: &[u8]) -> Result<Datagram, DatagramError> {
    if bytes.len() > DATAGRAM_MAX {
        return Err(DatagramError::TooLong);
    }
    // It is read where it lies: no byte of it is kept.
    let head = bytes.first_chunk::<HEADER_LEN>().ok_or(HeaderError::NotAFrame)?;
    let payload = &bytes[HEADER_LEN..];
    let Header { kind, source, destination, correlation, sent, .. } = Header::decode(head, payload)?;
    let is_for_us =
        destination.app == AppAddress::NDL && [here, NodeAddress::ALL].contains(&destination.node);
    if !is_for_us {
        return Err(DatagramError::Misdirected(destination));
    }
    let body = match kind {
        Kind::NDL_QUERY => Body::Query(announcement(payload)?),
        Kind::NDL_ANSWER => {
            let answer: Answer = decode(payload)?;
            if !answer.progress.is_fit() {
                return Err(DatagramError::Announcement("what it says does not get on cannot be so"));
            }
            Body::Answer(Answer { announcement: answer.announcement.check()?, ..answer })
        }
        Kind::NDL_LEAVE => {
            let LeaveWords { gave_up } = decode(payload)?;
            Body::Leave(Leave { announcement: announcement(payload)?, gave_up })
        }
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
            Self::Query(announcement) => announcement,
            Self::Answer(answer) => &answer.announcement,
            Self::Leave(leave) => &leave.announcement,
        }
    }
}

/// The bytes of a datagram to `to`.
pub(crate) fn encode(datagram: &Datagram, to: NodeAddress) -> BytesMut {
    let source = Tid::new(datagram.body.announcement().node, AppAddress::NDL);
    // With all the room that it may need: what grows step by step is copied at each.
    let mut payload = Vec::with_capacity(DATAGRAM_MAX);
    let (kind, flags, written) = match &datagram.body {
        Body::Query(announcement) => (Kind::NDL_QUERY, Flags::ASK, write_named(&mut payload, announcement)),
        Body::Answer(answer) => (Kind::NDL_ANSWER, Flags::REPLY, write_named(&mut payload, answer)),
        Body::Leave(leave) => (Kind::NDL_LEAVE, Flags::NONE, write_named(&mut payload, leave)),
    };
    written.expect("strings and numbers can be written as MessagePack");
    let mut header = Header::new(kind, source, Tid::new(to, AppAddress::NDL));
    header.flags = flags;
    header.correlation = datagram.correlation;
    header.sent = datagram.sent;
    let mut bytes = BytesMut::with_capacity(DATAGRAM_MAX);
    encode_frame(&header, &payload, &mut bytes);
    bytes
}

/// Which node's NDL says that it made a datagram, of which nothing else is believed yet. What says nothing like it is not worth the time that it takes to look
/// at a seal.
pub(crate) fn maker_of(bytes: &[u8]) -> Option<NodeAddress> {
    const SOURCE_AT: usize = 16;
    let source = bytes.get(SOURCE_AT..)?.first_chunk()?;
    let source = Tid::from_bits(u64::from_le_bytes(*source));
    (source.app == AppAddress::NDL).then_some(source.node)
}

#[cfg(test)]
mod tests;
