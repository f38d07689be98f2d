//! What the kernel says, and which addresses are lost with it.

use std::{
    net::{Ipv4Addr, Ipv6Addr},
    time::Duration,
};

use proptest::prelude::*;

use super::*;

const ETH0: u32 = 2;
const OURS: Ipv4Addr = Ipv4Addr::new(10, 77, 0, 1);
const OTHER: Ipv4Addr = Ipv4Addr::new(10, 77, 0, 9);

fn message(kind: u16, body: &[u8]) -> Vec<u8> {
    let mut bytes = vec![0; HEADER_LEN];
    bytes[..4].copy_from_slice(&((HEADER_LEN + body.len()) as u32).to_ne_bytes());
    bytes[4..6].copy_from_slice(&kind.to_ne_bytes());
    bytes.extend(body);
    bytes
}

fn link(kind: u16, index: u32, flags: u32) -> Vec<u8> {
    let words = [0, index, flags, 0].map(u32::to_ne_bytes);
    message(kind, words.as_flattened())
}

fn lost_of(known: &mut Known, said: &[u8]) -> Vec<SocketAddr> {
    known.hear(said).0
}

/// As a part of an answer.
fn of_a_dump(mut message: Vec<u8>) -> Vec<u8> {
    message[6..8].copy_from_slice(&OF_A_DUMP.to_ne_bytes());
    message
}

fn lost(address: Ipv4Addr) -> Vec<SocketAddr> {
    vec![(address, 0).into()]
}

/// As the kernel says it of an address of IPv6.
fn address6(kind: u16, index: u32, address: Ipv6Addr) -> Vec<u8> {
    let mut body = vec![IPV6, 64, 0, 0];
    body.extend(index.to_ne_bytes());
    body.extend(20_u16.to_ne_bytes());
    body.extend(ADDRESS.to_ne_bytes());
    body.extend(address.octets());
    message(kind, &body)
}

/// As the kernel says it of an address with a peer: the peer's first.
fn address(kind: u16, index: u32, address: Ipv4Addr) -> Vec<u8> {
    let mut body = vec![IPV4, 24, 0, 0];
    body.extend(index.to_ne_bytes());
    for (attribute, value) in [(ADDRESS, OTHER), (LOCAL, address)] {
        body.extend(8_u16.to_ne_bytes());
        body.extend(attribute.to_ne_bytes());
        body.extend(value.octets());
    }
    message(kind, &body)
}

#[test]
fn the_addresses_of_an_interface_that_goes_down_are_lost_each_time_and_no_others() {
    let mut interfaces = Known::new();
    let said = [address(NEW_ADDRESS, ETH0, OURS), address(NEW_ADDRESS, 3, OTHER)].concat();
    assert!(lost_of(&mut interfaces, &said).is_empty());
    for _ in 0..2 {
        assert!(lost_of(&mut interfaces, &link(NEW_LINK, ETH0, UP | 0x1000)).is_empty());
        assert_eq!(
            lost_of(&mut interfaces, &link(NEW_LINK, ETH0, 0x1001)),
            lost(OURS),
            "it cannot carry packets"
        );
    }
    assert_eq!(lost_of(&mut interfaces, &link(GONE_LINK, ETH0, UP)), lost(OURS));
    assert!(lost_of(&mut interfaces, &link(GONE_LINK, ETH0, UP)).is_empty());
}

#[test]
fn an_address_that_is_taken_away_is_lost() {
    let mut interfaces = Known::new();
    lost_of(&mut interfaces, &address(NEW_ADDRESS, ETH0, OURS));
    assert_eq!(lost_of(&mut interfaces, &address(GONE_ADDRESS, ETH0, OURS)), lost(OURS));
    assert!(lost_of(&mut interfaces, &link(NEW_LINK, ETH0, 0)).is_empty());
}

#[test]
fn a_link_local_address_that_two_interfaces_have_is_lost_on_one_of_them() {
    let mut interfaces = Known::new();
    let ours: Ipv6Addr = "fe80::1".parse().unwrap();
    let said = [ETH0, 3].map(|index| address6(NEW_ADDRESS, index, ours)).concat();
    assert!(lost_of(&mut interfaces, &said).is_empty());
    let of = |index: u32| vec![SocketAddr::from(SocketAddrV6::new(ours, 0, 0, index))];
    assert_eq!(lost_of(&mut interfaces, &link(NEW_LINK, 3, 0)), of(3));
    assert_eq!(lost_of(&mut interfaces, &address6(GONE_ADDRESS, ETH0, ours)), of(ETH0));
}

#[test]
fn more_addresses_than_are_kept_are_not_known() {
    let mut interfaces = Known::new();
    for number in 0..2 * ADDRESSES_MAX as u32 {
        lost_of(&mut interfaces, &address(NEW_ADDRESS, ETH0, Ipv4Addr::from(number)));
    }
    assert_eq!(lost_of(&mut interfaces, &link(NEW_LINK, ETH0, 0)).len(), ADDRESSES_MAX);
}

#[test]
fn what_was_lost_unheard_is_lost_when_all_is_asked_for_again() {
    let mut known = Known::new();
    let there = [(ETH0, OURS), (3, OTHER), (4, Ipv4Addr::LOCALHOST)];
    let first = there.map(|(index, ip)| of_a_dump(address(NEW_ADDRESS, index, ip))).concat();
    assert_eq!(known.hear(&[first, message(DONE, &[])].concat()), (vec![], None));
    // When: the first one is taken away, and the second one's interface goes down.
    assert_eq!(known.missed(), Some(Asked::Addresses));
    let left = there[1..].iter().flat_map(|(index, ip)| of_a_dump(address(NEW_ADDRESS, *index, *ip)));
    let left: Vec<u8> = left.collect();
    // More is missed meanwhile: what was answered may be old.
    assert_eq!(known.missed(), None);
    let done = message(DONE, &[]);
    assert_eq!(known.hear(&[&left[..], &done].concat()), (vec![], Some(Asked::Addresses)));
    assert_eq!(known.hear(&[&left[..], &done].concat()), (vec![], Some(Asked::Links)));
    let links = [(ETH0, UP), (3, 1), (4, UP)].map(|(index, flags)| of_a_dump(link(NEW_LINK, index, flags)));
    let (told, asks) = known.hear(&[&links.concat()[..], &done].concat());
    // Then
    assert_eq!((told, asks), ([lost(OTHER), lost(OURS)].concat(), None));
    assert_eq!(known.interfaces.count(), 2);
    assert_eq!(known.missed(), Some(Asked::Addresses), "it can be asked again");
}

#[test]
fn what_goes_while_all_is_asked_for_is_not_there_afterwards() {
    let mut known = Known::new();
    let said = [
        of_a_dump(address(NEW_ADDRESS, ETH0, OURS)),
        address(GONE_ADDRESS, ETH0, OURS),
        address(NEW_ADDRESS, 3, OTHER),
        message(DONE, &[]),
    ];
    assert_eq!(known.hear(&said.concat()), (lost(OURS), None));
    assert_eq!(known.hear(&link(NEW_LINK, 3, 0)).0, lost(OTHER));
}

#[tokio::test(flavor = "current_thread")]
async fn an_address_that_the_kernel_does_not_know_any_more_is_told_when_something_was_missed() {
    let mut watch = Watch::begin().expect("any process may listen");
    let told = async {
        while watch.known.survey.is_some() {
            watch.hear().await.expect("the kernel speaks");
        }
        watch.known.interfaces.0.entry(1).or_default().insert(OURS.into());
        let asks = watch.known.missed();
        watch.ask(asks).expect("it can be asked");
        while !watch.hear().await.expect("the kernel speaks").contains(&(OURS, 0).into()) {}
    };
    tokio::time::timeout(Duration::from_secs(10), told).await.expect("it is told within 10 s");
}

proptest! {
    #[test]
    fn any_bytes_are_survived(bytes: Vec<u8>, cut in 0usize..60, word in 0usize..60, value: u8) {
        let mut interfaces = Known::new();
        lost_of(&mut interfaces, &bytes);
        let mut said = if value % 2 == 0 {
            address(NEW_ADDRESS, ETH0, OURS)
        } else {
            address6(NEW_ADDRESS, ETH0, Ipv6Addr::LOCALHOST)
        };
        said.truncate(cut);
        if let Some(byte) = said.get_mut(word) {
            *byte = value;
        }
        lost_of(&mut interfaces, &said);
    }
}

#[tokio::test(flavor = "current_thread")]
async fn the_kernel_says_which_addresses_there_are() {
    let mut watch = Watch::begin().expect("any process may listen");
    let known = async {
        while !watch.known.interfaces.0.values().flatten().any(|address| address.is_loopback()) {
            watch.hear().await.expect("the kernel speaks");
        }
    };
    tokio::time::timeout(Duration::from_secs(10), known)
        .await
        .expect("the loopback address is told within 10 s");
}
