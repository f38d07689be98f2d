//! The connections for Stream and for Bulk: they end with their link, and their faults do not affect it.

use super::*;

fn side_of(link: u64, lane: Lane, dial: u64) -> Introduction {
    Introduction { lane, link, ..hello_from(HIGH, 1, dial) }
}

/// Creates a core with an established link that it dialled. Returns the dials for its further connections.
fn dialler() -> (Core, ConnectionId, Vec<ConnectionId>) {
    let mut core = core();
    core.handle(millis(0), found(1));
    let Some(Output::Dial { connection: link, .. }) = core.poll() else { panic!("it is dialled") };
    core.handle(millis(1), Input::Connected(link));
    outputs(&mut core);
    core.handle(millis(2), Input::WelcomeReceived(link, hello_from(HIGH, 1, 0)));
    let dials = dials(&mut core);
    assert_eq!(dials.len(), 2, "one for Stream and one for Bulk");
    (core, link, dials)
}

fn dials(core: &mut Core) -> Vec<ConnectionId> {
    let dials = outputs(core).into_iter().filter_map(|output| {
        let Output::Dial { connection, .. } = output else { return None };
        Some(connection)
    });
    dials.collect()
}

/// Returns the HELLO that the core sends on its dial.
fn hello_on(core: &mut Core, now: Time, connection: ConnectionId) -> Introduction {
    core.handle(now, Input::Connected(connection));
    match core.poll() {
        Some(Output::SendHello(_, hello)) => hello,
        other => panic!("{other:?} is no hello"),
    }
}

#[test]
fn broken_side_is_redialled_and_its_link_stays() {
    let (mut core, _, sides) = dialler();
    let hello = hello_on(&mut core, millis(3), sides[1]);
    assert_eq!((hello.lane, hello.link), (Lane::Bulk, millis(1).as_nanos()));
    let welcome = Introduction { lane: Lane::Bulk, link: hello.link, ..hello_from(HIGH, 1, 0) };
    core.handle(millis(4), Input::WelcomeReceived(sides[1], welcome));
    let attached = |output: &Output| matches!(output, Output::Attach(attach) if attach.lane == Lane::Bulk);
    assert!(outputs(&mut core).iter().any(attached));

    core.handle(millis(5), Input::Ended(sides[1]));
    let detached = Output::Detach { connection: sides[1], node: HIGH, lane: Lane::Bulk };
    assert_eq!(outputs(&mut core), [detached], "nothing else is told");
    core.handle(millis(17), Input::TimePassed);
    assert_eq!(dials(&mut core).len(), 1);
}

#[test]
fn side_of_a_missing_link_is_refused() {
    let mut core = core();
    let refused =
        |core: &mut Core, hello: Introduction| refusal(&greet(core, millis(1), hello).1).map(str::to_owned);
    let duplicate = Some("duplicate".to_owned());
    assert_eq!(refused(&mut core, side_of(10, Lane::Bulk, 11)), duplicate, "nobody is linked");
    greet(&mut core, millis(0), hello_from(HIGH, 1, 10));
    assert_eq!(refused(&mut core, side_of(9, Lane::Bulk, 11)), duplicate, "it belongs to a former link");
    assert_eq!(refused(&mut core, side_of(10, Lane::Bulk, 12)), None);
    assert_eq!(refused(&mut core, side_of(10, Lane::Bulk, 11)), duplicate, "it was dialled before that one");
    assert_eq!(refused(&mut core, side_of(10, Lane::Stream, 11)), None);
}

#[test]
fn ended_link_ends_its_sides_and_their_dials() {
    let (mut core, link, sides) = dialler();
    core.handle(millis(3), Input::Ended(link));
    let out = outputs(&mut core);
    for side in sides {
        assert!(out.contains(&Output::Close(side)), "{out:?}");
    }
}

#[test]
fn node_has_left_when_all_connections_are_drained() {
    let mut core = core();
    let (link, _) = greet(&mut core, millis(0), hello_from(HIGH, 1, 10));
    let (stream, _) = greet(&mut core, millis(1), side_of(10, Lane::Stream, 11));
    let (bulk, _) = greet(&mut core, millis(1), side_of(10, Lane::Bulk, 12));
    let left = Output::Fact(LinkFact::PeerLeft { node: HIGH, incarnation: Incarnation(1), gave_up: None });
    for connection in [bulk, link] {
        core.handle(millis(2), Input::GoodbyeReceived(connection));
        let out = outputs(&mut core);
        assert!(!out.contains(&left), "there may be more on the third: {out:?}");
    }
    core.handle(millis(3), Input::GoodbyeReceived(stream));
    assert!(outputs(&mut core).contains(&left));
    assert_eq!(core.next_wake(), None);
}

#[test]
fn close_after_goodbye_completes_the_leave() {
    let mut core = core();
    let (link, _) = greet(&mut core, millis(0), hello_from(HIGH, 1, 10));
    greet(&mut core, millis(1), side_of(10, Lane::Bulk, 12));
    core.handle(millis(2), Input::GoodbyeReceived(link));
    core.handle(millis(3), Input::Ended(link));
    let left = Output::Fact(LinkFact::PeerLeft { node: HIGH, incarnation: Incarnation(1), gave_up: None });
    assert!(outputs(&mut core).contains(&left));
    assert_eq!(core.next_wake(), None);
}

// spec: GNCL-10
#[test]
fn side_broken_during_leave_is_redialled_until_drained() {
    let (mut core, link, sides) = dialler();
    let welcomed = |core: &mut Core, at: u64, connection: ConnectionId| {
        let Introduction { lane, link, .. } = hello_on(core, millis(at), connection);
        let welcome = Introduction { lane, link, ..hello_from(HIGH, 1, 0) };
        core.handle(millis(at), Input::WelcomeReceived(connection, welcome));
        outputs(core);
    };
    for side in &sides {
        welcomed(&mut core, 3, *side);
    }
    let left = Output::Fact(LinkFact::PeerLeft { node: HIGH, incarnation: Incarnation(1), gave_up: None });
    for connection in [link, sides[0]] {
        core.handle(millis(4), Input::GoodbyeReceived(connection));
    }
    core.handle(millis(5), Input::Ended(sides[1]));
    assert!(!outputs(&mut core).contains(&left), "what it keeps for Bulk has not come");
    core.handle(millis(17), Input::TimePassed);
    let again = dials(&mut core);
    assert_eq!(again.len(), 1);
    welcomed(&mut core, 18, again[0]);
    core.handle(millis(19), Input::GoodbyeReceived(again[0]));
    assert!(outputs(&mut core).contains(&left));
    assert_eq!(core.next_wake(), None);
}

#[test]
fn silent_side_is_broken_alone() {
    let mut core = core();
    let (link, _) = greet(&mut core, millis(0), hello_from(HIGH, 1, 10));
    let (bulk, _) = greet(&mut core, millis(0), side_of(10, Lane::Bulk, 12));
    for second in 1..=3 {
        core.handle(millis(second * 1_000), Input::TimePassed);
        assert!(outputs(&mut core).contains(&Output::SendPing(HIGH, Lane::Bulk)));
        core.handle(millis(second * 1_000), Input::FramesReceived(link, millis(second * 1_000)));
    }
    core.handle(millis(4_000), Input::TimePassed);
    let out = outputs(&mut core);
    assert!(out.contains(&Output::Close(bulk)), "{out:?}");
    assert!(!out.contains(&Output::Close(link)), "{out:?}");
}

// spec: GNCL-14
#[test]
fn side_with_recent_traffic_is_not_idle() {
    for sign in [Input::PingReceived, Input::PongReceived] {
        let mut core = core();
        let (link, _) = greet(&mut core, millis(0), hello_from(HIGH, 1, 10));
        let (bulk, _) = greet(&mut core, millis(0), side_of(10, Lane::Bulk, 12));
        core.handle(millis(950), Input::FramesReceived(bulk, millis(950)));
        core.handle(millis(1_000), sign(bulk));
        outputs(&mut core);
        assert_eq!(pinged(&mut core, [link, bulk], 60, false), [2, 3, 4]);
    }
}

#[test]
fn pings_of_many_links_are_due_together() {
    let mut core = Core::new(Settings { strangers_max: 100, peers_max: 100, ..settings(LOW, 1) }, 7);
    let mut wakes = std::collections::BTreeSet::new();
    for node in 0..15_u32 {
        let hello = Introduction { node: NodeAddress::new(1_000 + node), ..hello_from(HIGH, 1, 10) };
        greet(&mut core, millis(3 * u64::from(node)), hello);
    }
    while let Some(at) = core.next_wake().filter(|at| *at < millis(4_000)) {
        wakes.insert(at);
        core.handle(at, Input::TimePassed);
        outputs(&mut core);
    }
    assert_eq!(wakes.into_iter().collect::<Vec<_>>(), [1_000, 2_000, 3_000].map(millis));
}

/// Returns the seconds at which the side is pinged up to `end`. The peer answers on its link, and on the side if
/// `answers`.
fn pinged(core: &mut Core, [link, bulk]: [ConnectionId; 2], end: u64, answers: bool) -> Vec<u64> {
    let mut pinged = Vec::new();
    while let Some(at) = core.next_wake().filter(|at| *at <= millis(end * 1_000)) {
        core.handle(at, Input::TimePassed);
        for output in outputs(core) {
            if output == Output::Close(bulk) {
                return pinged;
            }
            let Output::SendPing(_, lane) = output else { continue };
            if lane == Lane::Control {
                core.handle(at, Input::PongReceived(link));
                continue;
            }
            pinged.push(at.as_nanos() / 1_000_000_000);
            if answers {
                core.handle(at, Input::PongReceived(bulk));
            }
        }
    }
    pinged
}

// spec: GNCL-14
#[test]
fn idle_side_is_pinged_seldom_a_silent_one_soon() {
    let mut core = core();
    let (link, _) = greet(&mut core, millis(0), hello_from(HIGH, 1, 10));
    let (bulk, _) = greet(&mut core, millis(0), side_of(10, Lane::Bulk, 12));
    let both = [link, bulk];
    assert_eq!(pinged(&mut core, both, 25, true), [1, 11, 21], "nothing goes over it");
    core.handle(millis(25_000), Input::FramesReceived(bulk, millis(25_000)));
    assert_eq!(pinged(&mut core, both, 30, true), [26], "a message came, and then nothing");
    core.handle(millis(30_000), Input::PingReceived(bulk));
    outputs(&mut core);
    assert_eq!(pinged(&mut core, both, 39, true), [0; 0], "the peer asks as well");
    assert_eq!(pinged(&mut core, both, 60, false), [40, 41, 42], "and then it is broken");
    assert_eq!(core.stage(bulk), None);
}

#[test]
fn leaving_node_accepts_missing_connections_only() {
    let mut core = core();
    let (_, up) = greet(&mut core, millis(0), hello_from(HIGH, 1, 1));
    assert!(up.iter().any(|output| matches!(output, Output::Attach(_))));
    core.handle(millis(1), Input::LeaveRequested { undelivered_to: Vec::new() });
    outputs(&mut core);
    for (dial, lane) in [(2, Lane::Stream), (3, Lane::Bulk)] {
        let (_, taken) = greet(&mut core, millis(2), side_of(1, lane, dial));
        assert!(taken.iter().any(|output| matches!(output, Output::Attach(_))), "{taken:?}");
    }
    // An established side may break, and the peer that redials it may detect that first.
    let (_, again) = greet(&mut core, millis(3), side_of(1, Lane::Bulk, 4));
    assert!(again.iter().any(|output| matches!(output, Output::Attach(_))), "{again:?}");
    let (_, other) = greet(&mut core, millis(4), hello_from(NodeAddress::new(HIGH.bits() + 1), 1, 1));
    assert_eq!(refusal(&other), Some("leaving"));
}
