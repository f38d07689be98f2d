//! Peers that announce several addresses.

use super::*;
use crate::core::dials::{LATER, SILENT, STAGGER};

/// Returns the n-th address of the peer.
fn at(number: u16) -> SocketAddr {
    SocketAddr::from(([127, 0, 0, 1], 7_000 + number))
}

/// Creates a core that has found a peer with this many addresses.
fn finding(count: u16) -> Core {
    let mut core = core();
    let addresses = (0..count).map(at).collect();
    core.handle(millis(0), Input::NodeFound { node: HIGH, incarnation: Incarnation(1), addresses });
    core
}

/// Returns the dialled addresses in the core's outputs.
fn dialled(outputs: &[Output]) -> Vec<(ConnectionId, SocketAddr)> {
    let dials = outputs.iter().filter_map(|output| {
        let Output::Dial { connection, address } = output else { return None };
        Some((*connection, *address))
    });
    dials.collect()
}

/// Returns the only address that is dialled now.
fn next_dial(core: &mut Core) -> (ConnectionId, SocketAddr) {
    let outputs = outputs(core);
    let [dial] = dialled(&outputs)[..] else { panic!("one address is dialled: {outputs:?}") };
    dial
}

/// Lets time pass up to the core's next wake.
fn wait(core: &mut Core) -> Time {
    let at = core.next_wake().expect("it waits for something");
    core.handle(at, Input::TimePassed);
    at
}

fn welcome_for(hello: &Introduction) -> Introduction {
    Introduction { dial: 0, lane: hello.lane, link: hello.link, ..hello_from(HIGH, 1, 0) }
}

fn hello_in(outputs: &[Output]) -> (ConnectionId, Introduction) {
    let hello = outputs.iter().find_map(|output| {
        let Output::SendHello(connection, hello) = output else { return None };
        Some((*connection, hello.clone()))
    });
    hello.expect("a hello is sent")
}

fn has_refusal(outputs: &[Output]) -> bool {
    outputs.contains(&Output::Fact(LinkFact::DialRefused { node: HIGH, incarnation: Incarnation(1) }))
}

#[test]
fn addresses_are_dialled_until_one_is_reached() {
    // Given
    let mut core = finding(4);
    let (first, to) = next_dial(&mut core);
    assert_eq!(to, at(0));
    assert_eq!(wait(&mut core), millis(0) + STAGGER);
    let (second, to) = next_dial(&mut core);
    assert_eq!(to, at(1));
    let later = wait(&mut core);
    let (third, to) = next_dial(&mut core);
    assert_eq!(to, at(2));
    // When
    core.handle(later, Input::Connected(second));
    // Then
    let out = outputs(&mut core);
    assert!(out.contains(&Output::Close(first)) && out.contains(&Output::Close(third)), "{out:?}");
    let (connection, hello) = hello_in(&out);
    assert_eq!((connection, dialled(&out)), (second, Vec::new()));
    core.handle(later, Input::WelcomeReceived(second, welcome_for(&hello)));
    let sides = dialled(&outputs(&mut core));
    assert_eq!(
        sides.iter().map(|(_, to)| *to).collect::<Vec<_>>(),
        [at(1), at(1)],
        "its further connections use the same address"
    );
    // Data in flight from the others is ignored.
    core.handle(later, Input::Connected(first));
    core.handle(later, Input::DialFailed { connection: third, refused: true });
    assert_eq!(outputs(&mut core), []);
}

#[test]
fn only_refusal_by_all_addresses_is_reported() {
    for (refusals, is_told) in [([true, true, true], true), ([true, false, true], false)] {
        let mut core = finding(3);
        for (number, refused) in refusals.into_iter().enumerate() {
            let out = outputs(&mut core);
            assert!(!has_refusal(&out), "not before the last one has");
            let [(connection, to)] = dialled(&out)[..] else { panic!("one is dialled: {out:?}") };
            assert_eq!(to, at(number as u16));
            core.handle(millis(1), Input::DialFailed { connection, refused });
        }
        assert_eq!(has_refusal(&outputs(&mut core)), is_told);
        let again = wait(&mut core);
        assert!(again >= millis(9) && again < millis(14), "{again:?}");
        assert_eq!(next_dial(&mut core).1, at(0), "the preferred one comes first again");
    }
}

// spec: GNCL-16
#[test]
fn last_silent_address_is_dialled_within_a_second() {
    // Given: the maximum number of addresses that a node can announce.
    let mut core = finding(23);
    let (_, to) = next_dial(&mut core);
    assert_eq!(to, at(0));
    // When
    let mut gaps = Vec::new();
    let mut before = millis(0);
    for number in 1..23 {
        let now = wait(&mut core);
        assert_eq!(next_dial(&mut core).1, at(number));
        gaps.push(now.since(before));
        before = now;
    }
    // Then
    let (quick, later) = gaps.split_at(SILENT - 1);
    assert!(quick.iter().all(|gap| *gap == STAGGER) && later.iter().all(|gap| *gap == LATER), "{gaps:?}");
    assert!(before.since(millis(0)) < Duration::from_secs(1));
}

#[test]
fn silent_reached_address_has_the_next_one_dialled_first() {
    let mut core = finding(2);
    let (first, _) = next_dial(&mut core);
    core.handle(millis(0), Input::Connected(first));
    outputs(&mut core);
    let over = wait(&mut core);
    assert_eq!(over, millis(2_000), "the handshake's time");
    core.handle(over, Input::Ended(first));
    outputs(&mut core);
    wait(&mut core);
    assert_eq!(next_dial(&mut core).1, at(1));
}

#[test]
fn broken_link_is_redialled_at_all_addresses() {
    let mut core = finding(2);
    let (first, _) = next_dial(&mut core);
    core.handle(millis(0), Input::Connected(first));
    let (_, hello) = hello_in(&outputs(&mut core));
    core.handle(millis(0), Input::WelcomeReceived(first, welcome_for(&hello)));
    outputs(&mut core);
    core.handle(millis(1), Input::Ended(first));
    outputs(&mut core);
    wait(&mut core);
    assert_eq!(next_dial(&mut core).1, at(0));
    wait(&mut core);
    assert_eq!(next_dial(&mut core).1, at(1));
}

#[test]
fn lost_node_is_dialled_at_no_address() {
    let mut core = finding(3);
    let (first, _) = next_dial(&mut core);
    wait(&mut core);
    let (second, _) = next_dial(&mut core);
    core.handle(millis(30), Input::NodeLost { node: HIGH, incarnation: Incarnation(1) });
    let out = outputs(&mut core);
    assert!(out.contains(&Output::Close(first)) && out.contains(&Output::Close(second)), "{out:?}");
    assert_eq!(core.next_wake(), None);
}

#[test]
fn peer_restored_during_a_dial_is_not_dialled_twice() {
    let mut core = core();
    core.handle(millis(0), found(5));
    core.handle(millis(1), Input::Restored { node: HIGH, incarnation: Incarnation(4) });
    let dials =
        |outputs: &[Output]| outputs.iter().filter(|output| matches!(output, Output::Dial { .. })).count();
    assert_eq!(dials(&outputs(&mut core)), 1);
    for at in [50, 1_900] {
        core.handle(millis(at), Input::TimePassed);
        assert_eq!(dials(&outputs(&mut core)), 0, "its dial is on its way");
    }
}
