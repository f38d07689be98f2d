//! Decodes one message of the kernel.
//!
//! Only the headers and a few attributes are decoded, each on its own: a newer kernel may send attributes
//! that the crates cannot decode, and the loss of an address must not be missed because of one.

use std::net::IpAddr;

use netlink_packet_core::{
    NLM_F_DUMP, NLM_F_DUMP_INTR, NLM_F_MULTIPART, NLM_F_REQUEST, NLMSG_ALIGNTO, NLMSG_DONE, NLMSG_ERROR,
    NetlinkBuffer, NetlinkMessage, NlasIterator, Parseable, parse_i32,
};
use netlink_packet_route::{
    AddressFamily, RouteNetlinkMessage,
    address::{AddressAttribute, AddressHeader, AddressHeaderFlags, AddressMessage, AddressMessageBuffer},
    link::{LinkFlags, LinkHeader, LinkMessage, LinkMessageBuffer},
};

/// The flags that decide whether an IPv6 address is used.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Ipv6Flags {
    /// The kernel is performing duplicate address detection (RFC 4862, section 5.4), and rejects a bind.
    pub is_tentative: bool,
    /// Another host has the address, and it cannot be used here.
    pub is_duplicate: bool,
    /// The host changes the address now and then (RFC 8981), or deprecates it soon (RFC 4862, section 5.5.4).
    pub is_temporary: bool,
}

impl Ipv6Flags {
    const fn of(flags: AddressHeaderFlags) -> Self {
        /// `IFA_F_TEMPORARY` (`linux/if_addr.h`): for IPv4 the same bit is `IFA_F_SECONDARY`.
        const TEMPORARY: AddressHeaderFlags = AddressHeaderFlags::Secondary;
        let is_duplicate = flags.contains(AddressHeaderFlags::Dadfailed);
        // An optimistic address may be bound (RFC 4429).
        let is_tentative = flags.contains(AddressHeaderFlags::Tentative)
            && !flags.contains(AddressHeaderFlags::Optimistic)
            && !is_duplicate;
        let is_temporary = flags.contains(TEMPORARY) || flags.contains(AddressHeaderFlags::Deprecated);
        Self { is_tentative, is_duplicate, is_temporary }
    }
}

/// The state of an interface.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Link {
    pub(crate) index: u32,
    pub(crate) name: String,
    /// Whether the interface is administratively up, and has carrier.
    pub(crate) is_running: bool,
}

/// An address of an interface.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Address {
    pub(crate) index: u32,
    pub(crate) ip: IpAddr,
    /// The name of an IPv4 address, if it differs from its interface's (`ip address add ... label`).
    pub(crate) label: Option<String>,
    /// None of them is set for IPv4.
    pub(crate) flags: Ipv6Flags,
}

/// The content of a message.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Report {
    Link(Link),
    LinkRemoved {
        index: u32,
    },
    Address(Address),
    AddressRemoved {
        index: u32,
        ip: IpAddr,
    },
    /// A dump is complete.
    Done,
    /// A request is refused, with this error number of the system.
    Refused(i32),
}

/// A message of the kernel.
#[derive(Debug)]
pub(crate) struct Message {
    /// `None`: it is about something else.
    pub(crate) report: Option<Report>,
    /// Whether it is part of the answer to a [`Dump`].
    pub(crate) is_from_dump: bool,
    /// Whether something changed during that dump, so that it may be inconsistent.
    pub(crate) is_inconsistent: bool,
}

/// Returns the messages in received bytes, up to the first one that is truncated.
pub(crate) fn messages(mut bytes: &[u8]) -> impl Iterator<Item = Message> {
    std::iter::from_fn(move || {
        let message = NetlinkBuffer::new_checked(bytes).ok()?;
        let length = (message.length() as usize).next_multiple_of(NLMSG_ALIGNTO.into());
        bytes = bytes.get(length..).unwrap_or_default();
        Some(Message {
            report: report(message.message_type(), message.payload()),
            is_from_dump: message.flags() & NLM_F_MULTIPART != 0,
            is_inconsistent: message.flags() & NLM_F_DUMP_INTR != 0,
        })
    })
}

fn report(kind: u16, payload: &[u8]) -> Option<Report> {
    match kind {
        NLMSG_DONE => Some(Report::Done),
        NLMSG_ERROR => Some(Report::Refused(-parse_i32(payload.get(..4)?).ok()?)),
        libc::RTM_NEWLINK => link(payload).map(Report::Link),
        libc::RTM_DELLINK => link(payload).map(|link| Report::LinkRemoved { index: link.index }),
        libc::RTM_NEWADDR => address(payload).map(Report::Address),
        libc::RTM_DELADDR => {
            address(payload).map(|Address { index, ip, .. }| Report::AddressRemoved { index, ip })
        }
        _ => None,
    }
}

fn link(payload: &[u8]) -> Option<Link> {
    let header = LinkHeader::parse(payload).ok()?;
    // A bridge reports its ports in the same way: a removed port is still an interface.
    if header.interface_family != AddressFamily::Unspec {
        return None;
    }
    let attributes = NlasIterator::new(payload.get(size_of::<LinkMessageBuffer>()..)?).filter_map(Result::ok);
    let name = attributes.filter(|attribute| attribute.kind() == libc::IFLA_IFNAME).map(|attribute| {
        let name = attribute.value();
        String::from_utf8_lossy(name.strip_suffix(&[0]).unwrap_or(name)).into_owned()
    });
    let is_running = header.flags.contains(LinkFlags::Up | LinkFlags::Running);
    Some(Link { index: header.index, name: name.last().unwrap_or_default(), is_running })
}

fn address(payload: &[u8]) -> Option<Address> {
    let header = AddressHeader::parse(payload).ok()?;
    let attributes =
        NlasIterator::new(payload.get(size_of::<AddressMessageBuffer>()..)?).filter_map(Result::ok);
    let (mut local, mut address, mut label) = (None, None, None);
    for attribute in attributes.filter_map(|attribute| AddressAttribute::parse(&attribute).ok()) {
        // On a point-to-point interface `Address` is the peer's. No other attribute is needed.
        if let AddressAttribute::Local(ip) = attribute {
            local = Some(ip);
        } else if let AddressAttribute::Address(ip) = attribute {
            address = Some(ip);
        } else if let AddressAttribute::Label(name) = attribute {
            label = Some(name);
        }
    }
    let ip = local.or(address)?;
    let (family, flags) = match ip {
        IpAddr::V4(_) => (AddressFamily::Inet, Ipv6Flags::default()),
        IpAddr::V6(_) => (AddressFamily::Inet6, Ipv6Flags::of(header.flags)),
    };
    if header.family != family {
        return None;
    }
    Some(Address { index: header.index, ip, label, flags })
}

/// A list that the kernel is asked for. Each one ends before the next one is requested.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Dump {
    /// The addresses of all families.
    Addresses,
    /// The interfaces with their state.
    Links,
}

impl Dump {
    /// Returns the bytes of the request.
    pub(crate) fn request(self) -> Vec<u8> {
        let mut request = NetlinkMessage::from(match self {
            Self::Addresses => RouteNetlinkMessage::GetAddress(AddressMessage::default()),
            Self::Links => RouteNetlinkMessage::GetLink(LinkMessage::default()),
        });
        request.header.flags = NLM_F_REQUEST | NLM_F_DUMP;
        request.finalize();
        let mut bytes = vec![0; request.buffer_len()];
        request.serialize(&mut bytes);
        bytes
    }
}
