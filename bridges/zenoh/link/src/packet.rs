//! The fields of an IPv4 packet by which the link decides.

use std::{fmt, net::Ipv4Addr};

/// Length of an IPv4 header without options, in bytes.
const IPV4_HEADER: usize = 20;
/// Minimum length of a TCP header (RFC 9293) and of a UDP header (RFC 768), in bytes.
const TCP_HEADER: usize = 20;
const UDP_HEADER: usize = 8;
/// The fragment offset, and the flag "more fragments", of the field at byte 6 (RFC 791).
const FRAGMENT: u16 = 0x3fff;

/// A transport protocol that the link carries.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Protocol {
    /// TCP.
    Tcp,
    /// UDP.
    Udp,
}

/// The class of a packet, from its DSCP mark. Nodes mark their packets unless `gncl.marks` is off.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Class {
    /// Discovery: CS6 (DSCP 48).
    Discovery,
    /// Messages of class Control: EF (46).
    Control,
    /// Messages of class Stream: AF41 (34).
    Stream,
    /// Messages of class Bulk: AF11 (10).
    Bulk,
    /// Any other mark.
    Unmarked,
}

impl Class {
    // spec: ZLINK-5
    const fn of_code_point(code_point: u8) -> Self {
        match code_point {
            48 => Self::Discovery,
            46 => Self::Control,
            34 => Self::Stream,
            10 => Self::Bulk,
            _ => Self::Unmarked,
        }
    }
}

/// The cause for which a packet is not carried.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum PacketError {
    /// It is not IPv4. IPv6 packets of the kernel itself are among them.
    NotIpv4,
    /// Its header is incomplete, or names another length.
    Length,
    /// It is a fragment. Packets of nodes fit the device's MTU.
    Fragment,
    /// It is neither TCP nor UDP.
    OtherProtocol,
}

impl fmt::Display for PacketError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::NotIpv4 => "packets that are not IPv4",
            Self::Length => "packets of a wrong length",
            Self::Fragment => "fragments: the devices have different MTUs",
            Self::OtherProtocol => "packets that are neither TCP nor UDP",
        })
    }
}

impl std::error::Error for PacketError {}

/// The fields of a packet.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Header {
    /// Source address.
    pub source: Ipv4Addr,
    /// Destination address.
    pub target: Ipv4Addr,
    /// Transport protocol.
    pub protocol: Protocol,
    /// Source port.
    pub source_port: u16,
    /// Destination port.
    pub target_port: u16,
    /// Class of its DSCP mark.
    pub class: Class,
}

impl Header {
    /// Reads the header of a whole packet. Checksums are not verified: the receiver's kernel does that.
    ///
    /// # Errors
    /// Returns the cause for which the link does not carry it.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew_zenoh_link::{Header, PacketError};
    ///
    /// assert_eq!(Header::parse(&[0x60; 40]), Err(PacketError::NotIpv4));
    /// ```
    // spec: ZLINK-1
    pub fn parse(bytes: &[u8]) -> Result<Self, PacketError> {
        let first = *bytes.first().ok_or(PacketError::Length)?;
        if first >> 4 != 4 {
            return Err(PacketError::NotIpv4);
        }
        let header: &[u8; IPV4_HEADER] = bytes.first_chunk().ok_or(PacketError::Length)?;
        let word = |at: usize| u16::from_be_bytes([header[at], header[at + 1]]);
        let header_bytes = usize::from(first & 15) * 4;
        if header_bytes < IPV4_HEADER || usize::from(word(2)) != bytes.len() {
            return Err(PacketError::Length);
        }
        if word(6) & FRAGMENT != 0 {
            return Err(PacketError::Fragment);
        }
        let (protocol, least) = match header[9] {
            6 => (Protocol::Tcp, TCP_HEADER),
            17 => (Protocol::Udp, UDP_HEADER),
            _ => return Err(PacketError::OtherProtocol),
        };
        let inner = bytes.get(header_bytes..).filter(|inner| inner.len() >= least);
        let [source_high, source_low, target_high, target_low, ..] = *inner.ok_or(PacketError::Length)?
        else {
            return Err(PacketError::Length);
        };
        let address = |at: usize| Ipv4Addr::new(header[at], header[at + 1], header[at + 2], header[at + 3]);
        Ok(Self {
            source: address(12),
            target: address(16),
            protocol,
            source_port: u16::from_be_bytes([source_high, source_low]),
            target_port: u16::from_be_bytes([target_high, target_low]),
            class: Class::of_code_point(header[1] >> 2),
        })
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use proptest::prelude::*;

    use super::*;

    /// Builds a packet with this header and payload.
    pub(crate) fn packet(of: Header, payload: &[u8]) -> Vec<u8> {
        let (number, inner) = match of.protocol {
            Protocol::Tcp => (6, TCP_HEADER),
            Protocol::Udp => (17, UDP_HEADER),
        };
        let code_point = match of.class {
            Class::Discovery => 48,
            Class::Control => 46,
            Class::Stream => 34,
            Class::Bulk => 10,
            Class::Unmarked => 0,
        };
        let length = u16::try_from(IPV4_HEADER + inner + payload.len()).expect("a packet is that short");
        let mut bytes = vec![0; IPV4_HEADER + inner];
        (bytes[0], bytes[1], bytes[9]) = (0x45, code_point << 2, number);
        bytes[2..4].copy_from_slice(&length.to_be_bytes());
        bytes[12..16].copy_from_slice(&of.source.octets());
        bytes[16..20].copy_from_slice(&of.target.octets());
        bytes[20..22].copy_from_slice(&of.source_port.to_be_bytes());
        bytes[22..24].copy_from_slice(&of.target_port.to_be_bytes());
        bytes.extend_from_slice(payload);
        bytes
    }

    fn header(protocol: Protocol, class: Class) -> Header {
        Header {
            source: Ipv4Addr::new(10, 99, 0, 1),
            target: Ipv4Addr::new(10, 99, 0, 2),
            protocol,
            source_port: 6_911,
            target_port: 40_000,
            class,
        }
    }

    #[test]
    fn parsed_header_is_the_built_one() {
        for protocol in [Protocol::Tcp, Protocol::Udp] {
            for class in [Class::Discovery, Class::Control, Class::Stream, Class::Bulk, Class::Unmarked] {
                let of = header(protocol, class);
                assert_eq!(Header::parse(&packet(of, b"payload")), Ok(of));
            }
        }
    }

    #[test]
    fn unfit_packets_are_refused_by_their_cause() {
        let good = packet(header(Protocol::Udp, Class::Discovery), b"query");
        let with = |at: usize, byte: u8| {
            let mut changed = good.clone();
            changed[at] = byte;
            Header::parse(&changed)
        };
        assert_eq!(with(0, 0x65), Err(PacketError::NotIpv4));
        assert_eq!(with(0, 0x44), Err(PacketError::Length), "a header of 16 bytes");
        assert_eq!(with(0, 0x4f), Err(PacketError::Length), "options beyond the end");
        assert_eq!(with(3, 200), Err(PacketError::Length));
        assert_eq!(with(6, 0x20), Err(PacketError::Fragment), "more fragments follow");
        assert_eq!(with(7, 1), Err(PacketError::Fragment), "a later fragment");
        assert!(with(6, 0x40).is_ok(), "a packet that must not be fragmented is whole");
        assert_eq!(with(9, 1), Err(PacketError::OtherProtocol));
        assert_eq!(Header::parse(&[]), Err(PacketError::Length));
    }

    proptest! {
        #[test]
        fn no_bytes_make_the_parser_panic(bytes in proptest::collection::vec(any::<u8>(), 0..80)) {
            let _ = Header::parse(&bytes);
        }

        #[test]
        fn cut_packet_is_refused(cut in 0_usize..33) {
            let whole = packet(header(Protocol::Udp, Class::Control), b"query");
            prop_assume!(cut < whole.len());
            prop_assert!(Header::parse(&whole[..cut]).is_err());
        }
    }
}
