//! Messages of the kernel, and the addresses that are known and lost with them.

use std::net::{Ipv4Addr, Ipv6Addr};

use netlink_packet_core::{NLM_F_MULTIPART, NLMSG_DONE, NetlinkBuffer, NetlinkMessage};
use netlink_packet_route::{
    AddressFamily, RouteNetlinkMessage,
    address::{AddressAttribute, AddressHeaderFlags, AddressMessage},
    link::{LinkAttribute, LinkFlags, LinkMessage},
};
use proptest::prelude::*;

use super::*;

const ETH0: u32 = 2;
const OURS: Ipv4Addr = Ipv4Addr::new(10, 77, 0, 1);
const OTHER: Ipv4Addr = Ipv4Addr::new(10, 77, 0, 9);
const RUNNING: LinkFlags = LinkFlags::Up.union(LinkFlags::Running);

fn bytes_of(message: RouteNetlinkMessage) -> Vec<u8> {
    let mut message = NetlinkMessage::from(message);
    message.finalize();
    let mut bytes = vec![0; message.buffer_len()];
    message.serialize(&mut bytes);
    bytes
}

fn link_message(index: u32, flags: LinkFlags) -> LinkMessage {
    let mut link = LinkMessage::default();
    (link.header.index, link.header.flags) = (index, flags);
    link.attributes = vec![LinkAttribute::Mtu(1_500), LinkAttribute::IfName(format!("eth{}", index - ETH0))];
    link
}

fn link(index: u32, flags: LinkFlags) -> Vec<u8> {
    bytes_of(RouteNetlinkMessage::NewLink(link_message(index, flags)))
}

fn removed_link(index: u32) -> Vec<u8> {
    bytes_of(RouteNetlinkMessage::DelLink(link_message(index, RUNNING)))
}

/// Returns a message as the kernel sends it about an IPv4 address with a peer, or about an IPv6 address.
fn address_message(index: u32, ip: IpAddr) -> AddressMessage {
    let mut address = AddressMessage::default();
    address.header.index = index;
    if ip.is_ipv4() {
        address.header.family = AddressFamily::Inet;
        address.attributes = vec![AddressAttribute::Address(OTHER.into()), AddressAttribute::Local(ip)];
    } else {
        address.header.family = AddressFamily::Inet6;
        address.attributes = vec![AddressAttribute::Address(ip)];
    }
    address
}

pub(crate) fn address(index: u32, ip: impl Into<IpAddr>) -> Vec<u8> {
    bytes_of(RouteNetlinkMessage::NewAddress(address_message(index, ip.into())))
}

fn removed_address(index: u32, ip: impl Into<IpAddr>) -> Vec<u8> {
    bytes_of(RouteNetlinkMessage::DelAddress(address_message(index, ip.into())))
}

/// Makes the message part of the answer to a dump.
fn of_a_dump(mut message: Vec<u8>) -> Vec<u8> {
    NetlinkBuffer::new(&mut message).set_flags(NLM_F_MULTIPART);
    message
}

fn done() -> Vec<u8> {
    let mut bytes = vec![0; 16];
    let mut message = NetlinkBuffer::new(&mut bytes);
    message.set_length(16);
    message.set_message_type(NLMSG_DONE);
    bytes
}

/// Returns the lost addresses, and the list to request.
fn hears(table: &mut Table, bytes: &[u8]) -> (Vec<SocketAddr>, Option<Dump>) {
    let received = table.receive(bytes);
    (received.lost, received.request)
}

fn lost_of(table: &mut Table, bytes: &[u8]) -> Vec<SocketAddr> {
    hears(table, bytes).0
}

fn lost(address: Ipv4Addr) -> Vec<SocketAddr> {
    vec![(address, 0).into()]
}

/// Creates a table that lists the addresses.
fn listing() -> Table {
    let mut table = Table::default();
    assert_eq!(table.begin(), Dump::Addresses);
    table
}

#[test]
fn addresses_of_a_downed_interface_are_lost() {
    let mut table = listing();
    let both = [address(ETH0, OURS), address(3, OTHER)].concat();
    assert!(lost_of(&mut table, &both).is_empty());
    for _ in 0..2 {
        assert!(lost_of(&mut table, &link(ETH0, RUNNING | LinkFlags::Multicast)).is_empty());
        let down = link(ETH0, LinkFlags::Up | LinkFlags::Multicast);
        assert_eq!(lost_of(&mut table, &down), lost(OURS), "it cannot carry packets");
    }
    assert_eq!(lost_of(&mut table, &removed_link(ETH0)), lost(OURS));
    assert!(lost_of(&mut table, &removed_link(ETH0)).is_empty());
}

#[test]
fn removed_address_is_lost() {
    let mut table = listing();
    lost_of(&mut table, &address(ETH0, OURS));
    assert_eq!(lost_of(&mut table, &removed_address(ETH0, OURS)), lost(OURS));
    assert!(lost_of(&mut table, &link(ETH0, LinkFlags::empty())).is_empty());
}

#[test]
fn shared_link_local_address_is_lost_on_one_interface() {
    let mut table = listing();
    let ours: Ipv6Addr = "fe80::1".parse().unwrap();
    let both = [ETH0, 3].map(|index| address(index, ours)).concat();
    assert!(lost_of(&mut table, &both).is_empty());
    let of = |index: u32| vec![SocketAddr::from(SocketAddrV6::new(ours, 0, 0, index))];
    assert_eq!(lost_of(&mut table, &link(3, LinkFlags::empty())), of(3));
    assert_eq!(lost_of(&mut table, &removed_address(ETH0, ours)), of(ETH0));
}

#[test]
fn port_that_leaves_a_bridge_is_still_an_interface() {
    let mut table = listing();
    lost_of(&mut table, &address(ETH0, OURS));
    let mut port = link_message(ETH0, LinkFlags::empty());
    port.header.interface_family = AddressFamily::Bridge;
    assert!(lost_of(&mut table, &bytes_of(RouteNetlinkMessage::DelLink(port))).is_empty());
    assert_eq!(lost_of(&mut table, &removed_link(ETH0)), lost(OURS));
}

#[test]
fn addresses_beyond_the_limit_are_unknown() {
    let mut table = listing();
    for number in 0..2 * ADDRESSES_MAX as u32 {
        lost_of(&mut table, &address(ETH0, Ipv4Addr::from(number)));
    }
    assert_eq!(lost_of(&mut table, &link(ETH0, LinkFlags::empty())).len(), ADDRESSES_MAX);
}

#[test]
fn missed_losses_are_found_by_a_new_dump() {
    let mut table = listing();
    let there = [(ETH0, OURS), (3, OTHER), (4, Ipv4Addr::LOCALHOST)];
    let first = there.map(|(index, ip)| of_a_dump(address(index, ip))).concat();
    assert_eq!(hears(&mut table, &[first, done()].concat()), (vec![], None));
    // When: the first address is removed, and the interface of the second goes down.
    assert_eq!(table.on_missed_reports(), Some(Dump::Addresses));
    let left = there[1..].iter().flat_map(|(index, ip)| of_a_dump(address(*index, *ip)));
    let left: Vec<u8> = left.collect();
    // More is missed meanwhile: the answers may be old.
    assert_eq!(table.on_missed_reports(), None);
    assert_eq!(hears(&mut table, &[&left[..], &done()].concat()), (vec![], Some(Dump::Addresses)));
    assert_eq!(hears(&mut table, &[&left[..], &done()].concat()), (vec![], Some(Dump::Links)));
    let links = [(ETH0, RUNNING), (3, LinkFlags::Up), (4, RUNNING)];
    let links = links.map(|(index, flags)| of_a_dump(link(index, flags)));
    // Then
    let told = hears(&mut table, &[&links.concat()[..], &done()].concat());
    assert_eq!(told, ([lost(OTHER), lost(OURS)].concat(), None));
    let known = table.addresses().into_iter().map(|known| (known.name, known.ip, known.is_running));
    let expected = [("eth1", OTHER, false), ("eth2", Ipv4Addr::LOCALHOST, true)];
    let expected = expected.map(|(name, ip, is_running)| (name.to_owned(), ip.into(), is_running));
    assert_eq!(known.collect::<Vec<_>>(), expected);
    assert_eq!(table.on_missed_reports(), Some(Dump::Addresses), "it can be asked again");
}

#[test]
fn address_removed_during_a_dump_is_absent_afterwards() {
    let mut table = listing();
    let messages =
        [of_a_dump(address(ETH0, OURS)), removed_address(ETH0, OURS), address(3, OTHER), done()].concat();
    assert_eq!(hears(&mut table, &messages), (lost(OURS), None));
    assert_eq!(lost_of(&mut table, &link(3, LinkFlags::empty())), lost(OTHER));
}

#[test]
fn addresses_have_their_names_and_the_kernels_order() {
    let mut table = listing();
    assert!(table.receive(&link(ETH0, RUNNING)).has_changed);
    let mut labelled = address_message(ETH0, OURS.into());
    labelled.attributes.push(AddressAttribute::Label("eth0:1".to_owned()));
    let all = [
        of_a_dump(address(ETH0, OTHER)),
        of_a_dump(bytes_of(RouteNetlinkMessage::NewAddress(labelled))),
        of_a_dump(link(ETH0, RUNNING)),
        of_a_dump(address(9, OTHER)),
        done(),
    ];
    assert!(!table.receive(&all.concat()).has_changed);
    let known = table.addresses().into_iter().map(|known| (known.name, known.ip));
    let expected = [("eth0", OTHER), ("eth0:1", OURS)].map(|(name, ip)| (name.to_owned(), IpAddr::from(ip)));
    assert_eq!(known.collect::<Vec<_>>(), expected, "an unknown interface has no name");
}

#[test]
fn kernels_flags_give_the_state_of_an_ipv6_address() {
    let none = Ipv6Flags::default();
    let tentative = Ipv6Flags { is_tentative: true, ..none };
    let duplicate = Ipv6Flags { is_duplicate: true, ..none };
    let temporary = Ipv6Flags { is_temporary: true, ..none };
    // As in `linux/if_addr.h`. One that is tentative and optimistic may be bound.
    let all = [
        (0x80, none),
        (0xc0, tentative),
        (0x48, duplicate),
        (0x01, temporary),
        (0x20, temporary),
        (0x44, none),
    ];
    for (bits, expected) in all {
        let flags_of = |ip: IpAddr| {
            let mut message = address_message(ETH0, ip);
            message.header.flags = AddressHeaderFlags::from_bits_retain(bits);
            let mut table = listing();
            table
                .receive(&[bytes_of(RouteNetlinkMessage::NewAddress(message)), link(ETH0, RUNNING)].concat());
            table.addresses()[0].flags
        };
        assert_eq!(flags_of(Ipv6Addr::LOCALHOST.into()), expected, "{bits:#x}");
        assert_eq!(flags_of(OURS.into()), none, "{bits:#x} of IPv4");
    }
}

proptest! {
    #[test]
    fn any_bytes_are_survived(
        bytes: Vec<u8>,
        message in 0usize..3,
        cut in 0usize..80,
        word in 0usize..80,
        value: u8,
    ) {
        let mut table = listing();
        lost_of(&mut table, &bytes);
        let mut messages = match message {
            0 => address(ETH0, OURS),
            1 => address(ETH0, Ipv6Addr::LOCALHOST),
            _ => link(ETH0, RUNNING),
        };
        messages.truncate(cut);
        if let Some(byte) = messages.get_mut(word) {
            *byte = value;
        }
        lost_of(&mut table, &messages);
    }
}
