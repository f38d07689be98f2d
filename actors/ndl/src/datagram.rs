//! NDL's datagrams: one frame each, at most 1,200 bytes, with MessagePack maps as payloads.

use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr};

use bytes::BytesMut;
use rmp_serde::encode::write_named;
use serde::{Deserialize, Serialize};
use sinew_model::{
    address::{is_link_local, is_same_host, seen_from, unscoped},
    leave_reason::LeaveReason,
    limits::{FURTHER_MAX, PATHS_MAX},
    progress::Progress,
};
use sinew_runtime::{
    tid::{AppAddress, Incarnation, NodeAddress, Tid},
    time::Time,
    wire::{Flags, HEADER_LEN, Header, HeaderError, Kind, decode, encode_frame},
};
use sinew_security::node_security::SEAL_LEN;

/// Maximum length of a datagram in bytes: every network forwards it unfragmented. // spec: NDL-1
pub const DATAGRAM_MAX: usize = 1_200;

/// Maximum length of a project's or node's name in bytes.
const NAME_MAX: usize = 63;

/// Maximum number of GNCL addresses of a node: those of IPv4, and of IPv6 one on each path and one link-local
/// one on each route.
pub const GNCL_ADDRESSES_MAX: usize = 1 + FURTHER_MAX + 2 * PATHS_MAX;

/// A node's claim to its address. In a datagram it is a number, 1 or 2, or omitted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(from = "u8", into = "u8")]
pub enum Claim {
    /// The node owns the address: it has been present for so long that another process with it would have
    /// been received.
    #[default]
    Held,
    /// The node has just started, or returned, and gives the address up if another process has it.
    Settling,
    /// The node gives the address up, which another process has.
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

/// The announcement of a node, which each datagram contains.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Announcement {
    /// Project of the node. 1 to 63 bytes.
    pub project: String,
    /// The node's address.
    pub node: NodeAddress,
    /// The node's name. 1 to 63 bytes.
    pub name: String,
    /// Incarnation of the node.
    pub incarnation: Incarnation,
    /// Random number of the process. It distinguishes two processes with one address.
    pub boot_nonce: u64,
    /// IPv4 address of the node's GNCL listener, as a number: 10.0.0.7 is 0x0a000007; 0: it has none.
    pub gncl_ip: u32,
    /// TCP port of the node's GNCL listener; 0: none on IPv4.
    pub gncl_port: u16,
    /// Time between two queries of the node, in microseconds.
    pub period_us: u32,
    /// Further addresses and ports of the listener, [`FURTHER_MAX`] at most: those of other interfaces.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub gncl_further: Vec<(u32, u16)>,
    /// All IPv4 addresses and ports at which its NDL answers, if there are several; [`PATHS_MAX`] at most.
    /// spec: NDL-3.3
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub ndl: Vec<(u32, u16)>,
    /// All IPv6 addresses and ports at which its NDL answers, [`PATHS_MAX`] at most together with those of
    /// IPv4. Each address is its upper and its lower 64 bits. A link-local one belongs to the link on which
    /// the datagram is received. // spec: NDL-3.5
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub ndl6: Vec<(u64, u64, u16)>,
    /// TCP port of its GNCL listener at those addresses; 0: there is none.
    #[serde(default, skip_serializing_if = "is_nothing")]
    pub gncl_port6: u16,
    /// The claim of the node to its address.
    #[serde(default, skip_serializing_if = "Claim::is_held")]
    pub claim: Claim,
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde passes a field so")]
const fn is_nothing(port: &u16) -> bool {
    *port == 0
}

impl Announcement {
    /// Returns all addresses at which its GNCL listens, [`GNCL_ADDRESSES_MAX`] at most. The preferred one is
    /// first, then the one at which the node was `met`, then the address families alternate. Link-local
    /// addresses are those at which its NDL is seen from each of `routes`, [`PATHS_MAX`] at most. A route
    /// leads from a local address to a remote one. // spec: NDL-3.5
    pub fn gncl_addresses(
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
        // Nodes of other hosts would reach themselves at a loopback address.
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

    /// Returns all addresses at which its NDL answers, as far as it announces them.
    pub fn ndl_addresses(&self) -> impl Iterator<Item = SocketAddr> {
        let ipv4 = self.ndl.iter().map(|(ip, port)| (Ipv4Addr::from(*ip), *port).into());
        ipv4.chain(self.ndl6_addresses())
    }

    fn ndl6_addresses(&self) -> impl Iterator<Item = SocketAddr> {
        let ip = |upper: u64, lower: u64| Ipv6Addr::from_bits(u128::from(upper) << 64 | u128::from(lower));
        self.ndl6.iter().map(move |(upper, lower, port)| (ip(*upper, *lower), *port).into())
    }

    /// Returns whether it announces that its NDL answers there, on any local link.
    pub fn has_ndl_at(&self, there: SocketAddr) -> bool {
        self.ndl_addresses().any(|address| address == unscoped(there))
    }

    /// Sets the addresses at which its NDL answers. A single IPv4 address is omitted, since each node that
    /// queries it knows it. IPv6 addresses are always announced, because its GNCL listens there, too.
    pub fn announce_ndl(&mut self, paths: &[SocketAddr]) {
        (self.ndl, self.ndl6) = (Vec::new(), Vec::new());
        for path in paths {
            match path {
                SocketAddr::V4(path) if paths.len() > 1 => self.ndl.push((path.ip().to_bits(), path.port())),
                // The only path.
                SocketAddr::V4(_) => {}
                SocketAddr::V6(path) => {
                    let (bits, low) = (path.ip().to_bits(), u128::from(u64::MAX));
                    let half = |bits: u128| u64::try_from(bits & low).unwrap_or(u64::MAX);
                    self.ndl6.push((half(bits >> 64), half(bits), path.port()));
                }
            }
        }
    }

    /// Takes over the addresses in a later announcement of the same incarnation. Returns whether the NDL
    /// addresses differ.
    pub fn note_addresses(&mut self, received: &Self) -> bool {
        let is_elsewhere = self.ndl != received.ndl || self.ndl6 != received.ndl6;
        (self.gncl_ip, self.gncl_port, self.gncl_port6) =
            (received.gncl_ip, received.gncl_port, received.gncl_port6);
        self.gncl_further.clone_from(&received.gncl_further);
        self.ndl.clone_from(&received.ndl);
        self.ndl6.clone_from(&received.ndl6);
        is_elsewhere
    }

    /// Returns whether both are from one process.
    pub fn is_same_incarnation(&self, other: &Self) -> bool {
        self.incarnation == other.incarnation && self.boot_nonce == other.boot_nonce
    }

    /// Returns whether the node address belongs to this process and not to `other`'s, if both are alive. A
    /// settled process precedes a settling one, and then the earlier incarnation the later one.
    /// spec: NDL-5.6
    pub fn precedes(&self, other: &Self) -> bool {
        let rank = |of: &Self| (of.claim != Claim::Held, of.incarnation, of.boot_nonce);
        rank(self) < rank(other)
    }

    fn check(self) -> Result<Self, DatagramError> {
        let name_is_fit =
            |name: &str| (1..=NAME_MAX).contains(&name.len()) && !name.contains(char::is_control);
        let leads_nowhere = |address: SocketAddr| {
            let is_a_host = match address.ip() {
                IpAddr::V4(ip) => !(ip.is_unspecified() || ip.is_multicast() || ip.is_broadcast()),
                // An IPv4-mapped IPv6 address would bypass the limits on queries to the IPv4 address.
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
            "an address of its NDL cannot be queried"
        } else if !(has_gncl4 || has_gncl6) || gncl4.any(leads_nowhere) {
            "an address of its GNCL cannot be reached"
        } else {
            return Ok(self);
        };
        Err(DatagramError::Announcement(fault))
    }
}

/// Sorts addresses for connection attempts. The first one stays first. The next one is the address at which
/// the node was `met`, as that one is known to be reachable. Then the families alternate (RFC 8305, section
/// 4), so that an unreachable family delays the other one by one address at a time.
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
pub struct Answer {
    /// The answering node.
    pub announcement: Announcement,
    /// Send time in the query's header, in nanoseconds of the querying node's clock.
    pub query_sent_ns: u64,
    /// Receive time of the query, in nanoseconds of the answering node's clock.
    pub query_received_ns: u64,
    /// The stalled parts of the node.
    #[serde(default, skip_serializing_if = "Progress::is_nothing")]
    pub progress: Progress,
}

/// The payload of a leave: an announcement, and one more field if the node gave up. // spec: NDL-4.8
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Leave {
    /// The node that stops.
    #[serde(flatten)]
    pub announcement: Announcement,
    /// Reason why the node gave up; `None`: it stops in order.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub gave_up: Option<LeaveReason>,
}

impl From<Announcement> for Leave {
    /// The leave of a node that stops in order.
    fn from(announcement: Announcement) -> Self {
        Self { announcement, gave_up: None }
    }
}

/// The additional field of a leave. It is parsed separately, so that the announcement is parsed as in any
/// other datagram.
#[derive(Deserialize)]
struct LeaveWords {
    #[serde(default)]
    gave_up: Option<LeaveReason>,
}

/// A valid datagram.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Datagram {
    /// Correlation id of a query and its answer.
    pub correlation: u64,
    /// Send time, in the sender's clock.
    pub sent: Time,
    pub body: Body,
}

/// The content of a datagram.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Body {
    /// A request for an announcement.
    Query(Announcement),
    /// The answer to a query.
    Answer(Answer),
    /// The notification that a node stops.
    Leave(Leave),
}

/// The reason why bytes are no datagram of NDL. The sender or the network is at fault; nothing changed.
#[derive(Debug, thiserror::Error)]
pub enum DatagramError {
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
    /// Returns the cause under which the rejection is counted.
    pub const fn cause(&self) -> &'static str {
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

/// Returns the correlation id of `bytes` if they look like an answer. The check is cheap, and nothing else is checked.
pub fn peek_answer(bytes: &[u8]) -> Option<u64> {
    let kind = u32::from_le_bytes(bytes.get(8..12)?.try_into().ok()?);
    let correlation = u64::from_le_bytes(bytes.get(40..48)?.try_into().ok()?);
    (kind == Kind::NDL_ANSWER.bits()).then_some(correlation)
}

/// Parses a datagram received by the node at `here`. // spec: NDL-1
pub fn parse(here: NodeAddress, bytes: &[u8]) -> Result<Datagram, DatagramError> {
    match read(here, bytes) {
        // A node with keys has already removed the seal of an accepted datagram.
        Err(DatagramError::TooLong | DatagramError::Header(HeaderError::Length { .. }))
            if is_sealed(bytes) =>
        {
            Err(DatagramError::Sealed)
        }
        read => read,
    }
}

/// Returns whether the bytes are a whole frame with any content.
pub fn is_frame(bytes: &[u8]) -> bool {
    let parts = bytes.split_first_chunk::<HEADER_LEN>();
    parts.is_some_and(|(head, payload)| Header::decode(head, payload).is_ok())
}

/// Returns whether the bytes are a whole frame followed by as many bytes as a seal has.
fn is_sealed(bytes: &[u8]) -> bool {
    bytes.split_last_chunk::<SEAL_LEN>().is_some_and(|(frame, _)| is_frame(frame))
}

fn read(here: NodeAddress, bytes: &[u8]) -> Result<Datagram, DatagramError> {
    if bytes.len() > DATAGRAM_MAX {
        return Err(DatagramError::TooLong);
    }
    // The datagram is parsed in place: no byte of it is kept.
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
                return Err(DatagramError::Announcement("its report of stalled parts is invalid"));
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
    /// Returns the announcement of the sender.
    pub const fn announcement(&self) -> &Announcement {
        match self {
            Self::Query(announcement) => announcement,
            Self::Answer(answer) => &answer.announcement,
            Self::Leave(leave) => &leave.announcement,
        }
    }
}

/// Returns the bytes of a datagram to `to`.
pub fn encode(datagram: &Datagram, to: NodeAddress) -> BytesMut {
    let source = Tid::new(datagram.body.announcement().node, AppAddress::NDL);
    // Reserves the maximum capacity at once: each growth step would copy the buffer.
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

/// Returns the node that claims to have made a datagram by its NDL, before any verification. A datagram without such a
/// claim is not worth the check of its seal.
pub fn maker_of(bytes: &[u8]) -> Option<NodeAddress> {
    const SOURCE_AT: usize = 16;
    let source = bytes.get(SOURCE_AT..)?.first_chunk()?;
    let source = Tid::from_bits(u64::from_le_bytes(*source));
    (source.app == AppAddress::NDL).then_some(source.node)
}

#[cfg(test)]
mod tests;
