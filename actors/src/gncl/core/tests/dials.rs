//! Peers that announce several addresses.

use super::*;
use crate::gncl::core::dials::{AT_ONCE_MAX, STAGGER};

/// The n-th address of the peer.
fn at(number: u16) -> SocketAddr {
    SocketAddr::from(([127, 0, 0, 1], 7_000 + number))
}

/// A core that has found a peer with so many addresses.
fn finding(count: u16) -> Core {
    let mut core = core();
    let addresses = (0..count).map(at).collect();
    core.handle(millis(0), Input::NodeFound { node: HIGH, incarnation: Incarnation(1), addresses });
    core
}

/// What is dialled in the core's orders.
fn dialled(outputs: &[Output]) -> Vec<(ConnectionId, SocketAddr)> {
    let dials = outputs.iter().filter_map(|output| {
        let Output::Dial { connection, address } = output else { return None };
        Some((*connection, *address))
    });
    dials.collect()
}

/// The one address that is dialled now.
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
fn the_addresses_of_a_peer_are_dialled_one_shortly_after_the_other_and_the_first_that_answers_stays() {
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
        "its sides go the same way"
    );
    // What was on its way from the others is nobody's.
    core.handle(later, Input::Connected(first));
    core.handle(later, Input::DialFailed { connection: third, refused: true });
    assert_eq!(outputs(&mut core), []);
}

#[test]
fn an_address_that_fails_has_the_next_one_dialled_at_once_and_a_refusal_is_told_only_if_all_refuse() {
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

/// Where the host refuses, as NDL is told before all addresses have said something.
fn refused_in(outputs: &[Output]) -> Option<Vec<SocketAddr>> {
    outputs.iter().find_map(|output| {
        let Output::RefusedWhereLinked { node: HIGH, incarnation: Incarnation(1), at } = output else {
            return None;
        };
        Some(at.clone())
    })
}

/// A core whose link to a peer with so many addresses, dialled at the n-th one, has just broken.
fn broken_at(number: u16, count: u16) -> Core {
    let mut core = finding(count);
    for _ in 0..number {
        next_dial(&mut core);
        wait(&mut core);
    }
    let (connection, to) = next_dial(&mut core);
    assert_eq!(to, at(number));
    core.handle(millis(90), Input::Connected(connection));
    let (_, hello) = hello_in(&outputs(&mut core));
    core.handle(millis(90), Input::WelcomeReceived(connection, welcome_for(&hello)));
    core.handle(millis(91), Input::Ended(connection));
    outputs(&mut core);
    wait(&mut core);
    core
}

// spec: GNCL-16
#[test]
fn a_refusal_where_the_peer_was_linked_is_told_when_the_other_addresses_say_nothing() {
    // Given a peer that was linked at its first address
    let mut core = broken_at(0, 3);
    let (first, _) = next_dial(&mut core);
    // When that one refuses, and the others say nothing
    core.handle(millis(120), Input::DialFailed { connection: first, refused: true });
    next_dial(&mut core);
    wait(&mut core);
    let out = outputs(&mut core);
    assert_eq!((dialled(&out).len(), refused_in(&out)), (1, None), "the last one has its time, too");
    wait(&mut core);
    // Then
    let out = outputs(&mut core);
    assert_eq!(refused_in(&out), Some(vec![at(0)]));
    assert!(!has_refusal(&out), "nobody says that all of them refuse");
}

#[test]
fn a_refusal_somewhere_is_not_told_while_an_address_where_the_peer_was_linked_has_not_refused() {
    // Given a peer that was linked at its second address
    let mut core = broken_at(1, 3);
    let (first, _) = next_dial(&mut core);
    core.handle(millis(120), Input::DialFailed { connection: first, refused: true });
    let (second, _) = next_dial(&mut core);
    // When that one says nothing
    wait(&mut core);
    let (third, _) = next_dial(&mut core);
    wait(&mut core);
    assert_eq!(refused_in(&outputs(&mut core)), None);
    // When another one cannot be reached at all
    core.handle(millis(170), Input::DialFailed { connection: third, refused: false });
    assert_eq!(refused_in(&outputs(&mut core)), None);
    // When it refuses too
    core.handle(millis(180), Input::DialFailed { connection: second, refused: true });
    let out = outputs(&mut core);
    assert_eq!((refused_in(&out), has_refusal(&out)), (Some(vec![at(0), at(1)]), false));
}

#[test]
fn a_peer_that_dialled_itself_was_where_it_came_from_and_another_life_of_it_was_nowhere() {
    // By `from` the peer was linked when it broke; then its first address refuses, and its second one cannot be reached.
    let refused_after = |from: &[[u8; 4]], life: u64| {
        let mut core = finding(2);
        let mut dials = dialled(&outputs(&mut core));
        for (number, from) in from.iter().enumerate() {
            let connection = core.open();
            core.handle(millis(1), Input::Accepted(connection, (*from).into()));
            let hello = hello_from(HIGH, 1, number as u64 + 1);
            core.handle(millis(1), Input::HelloReceived(connection, hello));
            core.handle(millis(2), Input::Ended(connection));
        }
        if life > 1 {
            let addresses = vec![at(0), at(1)];
            let incarnation = Incarnation(life);
            core.handle(millis(3), Input::NodeFound { node: HIGH, incarnation, addresses });
        }
        if !from.is_empty() {
            // Its own dial took the place of that one.
            dials = dialled(&outputs(&mut core));
        }
        while dials.is_empty() {
            wait(&mut core);
            dials = dialled(&outputs(&mut core));
        }
        core.handle(millis(20), Input::DialFailed { connection: dials[0].0, refused: true });
        let (second, _) = next_dial(&mut core);
        core.handle(millis(21), Input::DialFailed { connection: second, refused: false });
        outputs(&mut core).iter().any(|output| matches!(output, Output::RefusedWhereLinked { .. }))
    };
    assert!(refused_after(&[[127, 0, 0, 1]], 1));
    assert!(!refused_after(&[[127, 0, 0, 1], [10, 0, 0, 9]], 1), "where it was, too, and may listen");
    assert!(!refused_after(&[], 1), "it was never linked");
    assert!(!refused_after(&[[127, 0, 0, 1]], 2), "that was the former life");
}

// spec: GNCL-16
#[test]
fn of_many_addresses_that_say_nothing_a_few_are_dialled_at_once_and_the_others_in_their_turn() {
    // Given
    let many = 2 * AT_ONCE_MAX as u16 + 3;
    let mut core = finding(many);
    let (mut first, mut under_way) = (Vec::new(), AT_ONCE_MAX);
    for number in 0..AT_ONCE_MAX as u16 {
        let (connection, to) = next_dial(&mut core);
        assert_eq!(to, at(number));
        first.push(connection);
        if usize::from(number) + 1 < AT_ONCE_MAX {
            wait(&mut core);
        }
    }
    // When one fails, then the next one is dialled in its place.
    core.handle(millis(500), Input::DialFailed { connection: first[3], refused: false });
    assert_eq!(next_dial(&mut core).1, at(AT_ONCE_MAX as u16));
    // When the others have had their time, then as many others have theirs.
    let mut dialled_in_all = AT_ONCE_MAX + 1;
    while core.next_wake().is_some() && dialled_in_all < usize::from(many) {
        wait(&mut core);
        let out = outputs(&mut core);
        let closed = out.iter().filter(|output| matches!(output, Output::Close(_))).count();
        dialled_in_all += dialled(&out).len();
        under_way = under_way + dialled(&out).len() - closed;
        assert!(under_way <= AT_ONCE_MAX, "{out:?}");
    }
    assert_eq!(dialled_in_all, usize::from(many));
}

#[test]
fn one_that_is_reached_and_says_nothing_has_the_next_one_dialled_first() {
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
fn a_link_that_breaks_is_dialled_again_at_all_addresses() {
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
fn a_node_that_is_lost_has_none_of_its_addresses_dialled_any_more() {
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
fn a_peer_that_is_restored_while_it_is_dialled_is_not_dialled_twice() {
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
