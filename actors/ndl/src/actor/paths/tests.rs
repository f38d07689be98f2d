//! The choice of addresses, and the reports about the others.

use std::net::Ipv4Addr;

use sinew_runtime::tid::Incarnation;

use super::*;
use sinew_model::config::NodeConfig;

fn v4(address: [u8; 4]) -> LocalAddress {
    Ipv4Addr::from(address).into()
}

#[test]
fn explicit_addresses_are_always_wanted() {
    let (by_address, named) = (v4([10, 9, 0, 1]), v4([10, 8, 0, 1]));
    let chosen: Interfaces = vec!["10.9.0.1".parse().unwrap(), "eth0".parse().unwrap()].into();
    let usable = |running: &[LocalAddress], there: &[LocalAddress]| Usable {
        running: running.into(),
        there: there.into(),
        ..Usable::default()
    };
    assert_eq!(wanted(&chosen, &usable(&[], &[]), &[]), [by_address], "also where the host has not got it");
    assert_eq!(wanted(&chosen, &usable(&[named], &[named, by_address]), &[]), [by_address, named]);
    assert_eq!(wanted(&chosen, &usable(&[], &[named]), &[]), [by_address], "no carrier yet");
    assert_eq!(wanted(&chosen, &usable(&[], &[named]), &[named]), [by_address, named], "no carrier any more");
    assert_eq!(wanted(&chosen, &usable(&[], &[]), &[named]), [by_address], "the address is gone");
}

#[test]
fn open_addresses_stay_and_the_excess_is_reported() {
    let many: Vec<_> = (0..20).map(|last| v4([10, 8, 1, last])).collect();
    let mut at_first = many.clone();
    assert_eq!(leave_out(&mut at_first, &[]), many[PATHS_MAX..]);
    assert_eq!(at_first, many[..PATHS_MAX]);
    // When: another one comes before the open ones
    let open = &many[1..=PATHS_MAX];
    let mut wanted = many.clone();
    assert!(leave_out(&mut wanted, open).contains(&many[0]));
    assert_eq!(wanted, open);
}

#[test]
fn excess_address_is_reported_once_while_it_lasts() {
    let state = State::for_test(NodeConfig::new("test"), Incarnation(1));
    let (paths, local) = (Paths::default(), v4([10, 8, 1, 9]));
    for _ in 0..2 {
        paths.warn_left_out(&[local]);
        paths.close_all_but(&state, &[]);
        assert!(paths.reported.borrow().contains(&(local, LEFT_OUT)));
    }
    paths.warn_left_out(&[]);
    assert!(paths.reported.borrow().is_empty(), "then it is reported again");
}

#[test]
fn each_unopenable_address_has_its_own_reason() {
    let taken = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
    let mut config = NodeConfig::new("test");
    config.ndl.port = taken.local_addr().unwrap().port();
    let state = State::for_test(config, Incarnation(1));
    // TEST-NET-1: no host has it.
    let wanted = [v4([127, 0, 0, 1]), v4([192, 0, 2, 1])];
    let (_, unopened) = Paths::default().open(&state, &wanted);
    let reasons: Vec<_> = unopened.iter().map(|(local, error)| (*local, error.kind())).collect();
    let expected = [io::ErrorKind::AddrInUse, io::ErrorKind::AddrNotAvailable];
    assert_eq!(reasons, wanted.into_iter().zip(expected).collect::<Vec<_>>());
}

#[test]
fn open_address_survives_a_duplicate_check() {
    let chosen: Interfaces = vec!["eth0".parse().unwrap()].into();
    let local = LocalAddress { ip: "fe80::1".parse().unwrap(), interface: 2 };
    let usable = |flags| Usable { in_doubt: vec![(local, flags)], ..Usable::default() };
    let asked = Ipv6Flags { is_tentative: true, ..Ipv6Flags::default() };
    let taken = Ipv6Flags { is_duplicate: true, ..Ipv6Flags::default() };
    assert!(wanted(&chosen, &usable(asked), &[]).is_empty());
    assert_eq!(wanted(&chosen, &usable(asked), &[local]), [local]);
    assert!(wanted(&chosen, &usable(taken), &[local]).is_empty());
}
