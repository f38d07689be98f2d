//! Two cores on a wire of virtual time: one link remains in any order of dials, accepts and losses.

use proptest::prelude::*;

use super::*;

mod authenticated;
mod dials;
mod lane_connections;
mod lost;
mod starved;
mod virtual_wire;

use virtual_wire::{Mishap, World, millis};

fn any_mishap() -> impl Strategy<Value = Mishap> {
    prop_oneof![
        4 => any::<u64>().prop_map(Mishap::CutOne),
        2 => (0usize..2).prop_map(Mishap::LayerRestarts),
        2 => (0usize..2).prop_map(Mishap::NodeRestarts),
        2 => (0usize..2).prop_map(Mishap::NodeLostAndFound),
        1 => any::<u64>().prop_map(Mishap::HalfOpen),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 400, ..ProptestConfig::default() })]

    #[test]
    fn simultaneous_discovery_makes_one_unbroken_link(
        seed: u64, first in 0u64..60, second in 0u64..60, delay_max_us in 1u64..40_000,
    ) {
        let mut world = World::new(seed, delay_max_us);
        world.find_each_other_at([millis(first), millis(second)]);
        // Accept or connect, HELLO, WELCOME: three delays. Neither node has to dial a second time.
        let delays = Duration::from_micros(delay_max_us) * 3;
        world.run_until(millis(first.max(second)) + delays);
        prop_assert!(world.is_linked(), "{}", world.story());
        world.run_until(millis(20_000));
        prop_assert_eq!(world.agreed_link(), Ok(()), "{}", world.story());
        for node in &world.nodes {
            let facts: Vec<_> = node.facts.iter().map(|fact| matches!(fact, LinkFact::LinkUp { .. })).collect();
            prop_assert_eq!(facts, [true], "one LinkUp and nothing else; {}", world.story());
        }
    }

    #[test]
    fn any_faults_end_with_one_common_link(
        seed: u64, delay_max_us in 1u64..40_000,
        mishaps in proptest::collection::vec((0u64..4_000, any_mishap()), 0..12),
        dead_before in 0u16..3, dead_after in 0u16..3,
    ) {
        let mut world = World::new(seed, delay_max_us);
        let dead = |number: u16| SocketAddr::from(([192, 0, 2, 1], number + 1));
        world.addresses = (0..dead_before).map(dead).chain([address()]).chain((5..5 + dead_after).map(dead)).collect();
        world.find_each_other_at([millis(0), millis(3)]);
        let mut mishaps = mishaps;
        mishaps.sort_by_key(|(at, _)| *at);
        for (at, mishap) in mishaps {
            world.run_until(millis(at));
            world.strike(mishap);
        }
        world.run_until(millis(40_000));
        prop_assert_eq!(world.agreed_link(), Ok(()), "{}", world.story());
    }
}

/// The source of accepted connections where it does not matter.
const SOMEWHERE: IpAddr = IpAddr::V4(std::net::Ipv4Addr::new(10, 9, 9, 9));
const LOW: NodeAddress = NodeAddress::new(1);
const HIGH: NodeAddress = NodeAddress::new(2);

fn settings(node: NodeAddress, incarnation: u64) -> Settings {
    Settings {
        ours: Introduction {
            project: "exo".to_owned(),
            node,
            name: format!("node-{node}"),
            incarnation: Incarnation(incarnation),
            peer: NodeAddress::HERE,
            dial: 0,
            payload_max: 1 << 20,
            answers_max: 8_192,
            features: vec![CLASSES.to_owned()],
            lane: Lane::Control,
            link: 0,
            datagrams_made: 0,
        },
        handshake: Duration::from_secs(2),
        redial_min: Duration::from_millis(10),
        redial_max: Duration::from_secs(1),
        strangers_max: 3,
        peers_max: 2,
        ping_period: Duration::from_secs(1),
        idle_ping_delay: Duration::from_secs(10),
        pings_missed_max: 3,
        healthy: Duration::from_secs(5),
        orphan: Duration::from_secs(5),
        connections_authenticate: false,
    }
}

fn core() -> Core {
    Core::new(settings(LOW, 1), 7)
}

fn outputs(core: &mut Core) -> Vec<Output> {
    std::iter::from_fn(|| core.poll()).collect()
}

fn hello_from(node: NodeAddress, incarnation: u64, dial: u64) -> Introduction {
    Introduction { peer: LOW, dial, ..settings(node, incarnation).ours }
}

/// Lets `core` accept a connection with `hello`.
fn greet(core: &mut Core, now: Time, hello: Introduction) -> (ConnectionId, Vec<Output>) {
    let connection = core.open();
    core.handle(now, Input::Accepted(connection, SOMEWHERE));
    core.handle(now, Input::HelloReceived(connection, hello));
    (connection, outputs(core))
}

fn refusal(outputs: &[Output]) -> Option<&str> {
    outputs.iter().find_map(|output| {
        let Output::Refuse(_, refusal) = output else { return None };
        Some(refusal.cause.as_str())
    })
}

fn address() -> SocketAddr {
    SocketAddr::from(([127, 0, 0, 1], 7_000))
}

fn found(incarnation: u64) -> Input {
    Input::NodeFound { node: HIGH, incarnation: Incarnation(incarnation), addresses: vec![address()] }
}

#[test]
fn newer_incarnation_replaces_an_older_one() {
    let mut core = core();
    let (old, up) = greet(&mut core, millis(0), hello_from(HIGH, 5, 1));
    assert!(up.contains(&Output::Fact(LinkFact::LinkUp { node: HIGH, incarnation: Incarnation(5) })));

    let (_, stale) = greet(&mut core, millis(1), hello_from(HIGH, 4, 9));
    assert_eq!(refusal(&stale), Some("stale incarnation"));

    let (_, newer) = greet(&mut core, millis(2), hello_from(HIGH, 6, 1));
    let at =
        |wanted: &Output| newer.iter().position(|output| output == wanted).expect("is among the outputs");
    let detached = at(&Output::Detach { connection: old, node: HIGH, lane: Lane::Control });
    let forgotten = at(&Output::Forget(HIGH));
    let up = at(&Output::Fact(LinkFact::LinkUp { node: HIGH, incarnation: Incarnation(6) }));
    assert!(detached < forgotten && forgotten < up);
}

#[test]
fn new_hello_of_a_linked_peer_replaces_the_link() {
    let mut core = core();
    let (old, _) = greet(&mut core, millis(0), hello_from(HIGH, 1, 10));
    let (_, again) = greet(&mut core, millis(1), hello_from(HIGH, 1, 11));
    assert!(again.contains(&Output::Close(old)));
    let (_, void) = greet(&mut core, millis(2), hello_from(HIGH, 1, 10));
    assert_eq!(refusal(&void), Some("duplicate"));
}

#[test]
fn redial_intervals_double_within_bounds_with_20_percent_jitter() {
    let mut core = core();
    core.handle(millis(0), found(1));
    let mut expected = Duration::from_millis(10);
    let mut now = millis(0);
    for _ in 0..12 {
        let dial = outputs(&mut core).into_iter().find_map(|output| {
            let Output::Dial { connection, .. } = output else { return None };
            Some(connection)
        });
        core.handle(now, Input::DialFailed { connection: dial.expect("dials again"), refused: false });
        let next = core.next_wake().expect("a dial is planned");
        let wait = next.since(now);
        assert!(wait >= expected.mul_f64(0.8) && wait <= expected.mul_f64(1.2), "{wait:?} for {expected:?}");
        expected = (expected * 2).min(Duration::from_secs(1));
        now = next;
        core.handle(now, Input::TimePassed);
    }
}

#[test]
fn links_that_carried_messages_are_redialled_sooner() {
    for carries in [true, false] {
        let mut core = core();
        core.handle(millis(0), found(1));
        let mut now = millis(0);
        let waits: Vec<_> = (0..6)
            .map(|dial| {
                now = now + Duration::from_millis(30);
                let (link, _) = greet(&mut core, now, hello_from(HIGH, 1, dial + 1));
                if carries {
                    core.handle(now, Input::TrafficSeen(link));
                }
                core.handle(now, Input::Ended(link));
                core.next_wake().expect("a dial is planned").since(now)
            })
            .collect();
        let longest = waits.into_iter().max().expect("there are six");
        assert_eq!(longest <= Duration::from_millis(12), carries, "{longest:?}");
    }
}

#[test]
fn refused_dial_is_reported_and_loss_ends_dialling() {
    let mut core = core();
    core.handle(millis(0), found(1));
    let Some(Output::Dial { connection, .. }) = core.poll() else {
        panic!("a found node is dialled at once")
    };
    core.handle(millis(1), Input::DialFailed { connection, refused: true });
    let fact = LinkFact::DialRefused { node: HIGH, incarnation: Incarnation(1) };
    assert!(outputs(&mut core).contains(&Output::Fact(fact)));
    core.handle(millis(2), Input::NodeLost { node: HIGH, incarnation: Incarnation(1) });
    assert!(outputs(&mut core).contains(&Output::Forget(HIGH)));
    assert_eq!(core.next_wake(), None);
}

/// Lets time pass in `core` without input, until it waits for nothing more or `end` is reached.
fn silence(core: &mut Core, end: Time) -> Vec<(Time, Output)> {
    let mut seen = Vec::new();
    while let Some(at) = core.next_wake().filter(|at| *at <= end) {
        core.handle(at, Input::TimePassed);
        seen.extend(outputs(core).into_iter().map(|output| (at, output)));
    }
    seen
}

#[test]
fn silent_link_is_pinged_three_times_then_broken() {
    let mut core = core();
    greet(&mut core, millis(0), hello_from(HIGH, 1, 1));
    let seen = silence(&mut core, millis(4_000));
    let pings: Vec<_> =
        seen.iter().filter(|(_, o)| *o == Output::SendPing(HIGH, Lane::Control)).map(|(at, _)| *at).collect();
    assert_eq!(pings, [millis(1_000), millis(2_000), millis(3_000)]);
    let broken = Output::Fact(LinkFact::LinkBroken { node: HIGH, incarnation: Incarnation(1) });
    assert!(seen.contains(&(millis(4_000), broken)));
}

#[test]
fn stalled_node_does_not_call_its_peer_silent() {
    let mut core = core();
    greet(&mut core, millis(0), hello_from(HIGH, 1, 1));
    core.handle(millis(60_000), Input::TimePassed);
    assert_eq!(outputs(&mut core), [Output::SendPing(HIGH, Lane::Control)]);
}

#[test]
fn strangers_are_limited_in_number_and_time() {
    let mut core = core();
    let strangers: Vec<_> = (0..4).map(|_| core.open()).collect();
    for stranger in &strangers {
        core.handle(millis(0), Input::Accepted(*stranger, SOMEWHERE));
    }
    assert!(outputs(&mut core).contains(&Output::Close(strangers[0])), "with the fourth the oldest goes");
    core.handle(millis(2_000), Input::TimePassed);
    let refused = outputs(&mut core).iter().filter(|output| matches!(output, Output::Refuse(..))).count();
    assert_eq!(refused, 3);
    core.handle(millis(4_000), Input::TimePassed);
    assert_eq!(outputs(&mut core).len(), 3, "who does not go is closed");
    assert_eq!(core.next_wake(), None);
}

/// Accepts a connection from this address. Returns it with the connections closed for it.
fn accept_from(core: &mut Core, from: impl Into<IpAddr>) -> (ConnectionId, Vec<Output>) {
    let stranger = core.open();
    core.handle(millis(0), Input::Accepted(stranger, from.into()));
    let closed = outputs(core).into_iter().filter(|output| matches!(output, Output::Close(_)));
    (stranger, closed.collect())
}

#[test]
fn frequent_reconnects_close_their_own_connections_only() {
    let mut core = core();
    let (other, _) = accept_from(&mut core, [10, 0, 0, 7]);
    let mut his: Vec<_> = (0..2).map(|_| accept_from(&mut core, [10, 0, 0, 8]).0).collect();
    for _ in 0..100 {
        let (one_more, closed) = accept_from(&mut core, [10, 0, 0, 8]);
        his.push(one_more);
        assert_eq!(closed, [Output::Close(his.remove(0))], "his oldest");
    }
    core.handle(millis(1), Input::HelloReceived(other, hello_from(HIGH, 1, 1)));
    assert!(core.linked(other).is_some(), "the other one comes in, however long it took");
}

#[test]
fn strangers_from_a_known_nodes_address_are_closed_last() {
    let mut core = core();
    core.handle(millis(0), found(1));
    outputs(&mut core);
    let (peer, _) = accept_from(&mut core, address().ip());
    for last in 1..100 {
        let (_, closed) = accept_from(&mut core, [10, 1, 0, last]);
        assert!(!closed.contains(&Output::Close(peer)), "as many addresses as there may be say nothing");
    }
}

#[test]
fn known_nodes_address_cannot_take_all_slots_either() {
    let mut core = core();
    core.handle(millis(0), found(1));
    outputs(&mut core);
    for _ in 0..3 {
        accept_from(&mut core, address().ip());
    }
    let (newcomer, closed) = accept_from(&mut core, [10, 1, 0, 1]);
    assert_eq!(closed.len(), 1, "one of the many");
    for _ in 0..100 {
        let (_, closed) = accept_from(&mut core, address().ip());
        assert!(!closed.contains(&Output::Close(newcomer)));
    }
}

#[test]
fn ipv6_network_with_many_addresses_closes_its_own_connections() {
    let mut core = core();
    let from = |ip: &str| ip.parse::<IpAddr>().unwrap();
    let (honest, _) = accept_from(&mut core, from("fd00:0:0:1::7"));
    let (first, _) = accept_from(&mut core, from("fd00:0:0:2::1"));
    let (second, _) = accept_from(&mut core, from("fd00:0:0:2::2"));
    let (_, closed) = accept_from(&mut core, from("fd00:0:0:2::3"));
    assert_eq!(closed, [Output::Close(first)], "not {honest:?}, though that is older");
    // In one network it is the most frequent address.
    let (_, closed) = accept_from(&mut core, from("fd00:0:0:2::3"));
    assert_eq!(closed, [Output::Close(second)], "two are as old as each other's addresses");
    let (other, _) = accept_from(&mut core, from("fd00:0:0:2::4"));
    let (_, closed) = accept_from(&mut core, from("fd00:0:0:2::3"));
    assert!(
        !closed.contains(&Output::Close(other)) && !closed.contains(&Output::Close(honest)),
        "{closed:?}"
    );
}

#[test]
fn refused_connection_counts_for_its_source() {
    let mut core = core();
    let from = [10, 0, 0, 8];
    let (refused, _) = accept_from(&mut core, from);
    let strange = Introduction { project: "another".to_owned(), ..hello_from(HIGH, 1, 1) };
    core.handle(millis(1), Input::HelloReceived(refused, strange));
    assert!(refusal(&outputs(&mut core)).is_some());
    let (other, _) = accept_from(&mut core, [10, 0, 0, 7]);
    accept_from(&mut core, from);
    let (_, closed) = accept_from(&mut core, from);
    assert_eq!(
        closed,
        [Output::Close(refused)],
        "two came from there, and it is the older one, not {other:?}"
    );
}

#[test]
fn refused_dial_gets_its_reason_despite_full_stranger_slots() {
    // Given: a dial, and as many strangers as there are slots
    let mut core = core();
    core.handle(millis(0), found(1));
    let Some(Output::Dial { connection: dialled, .. }) = core.poll() else {
        panic!("a found node is dialled at once")
    };
    core.handle(millis(0), Input::Connected(dialled));
    let strangers = [(); 3].map(|()| accept_from(&mut core, [10, 0, 0, 7]).0);
    // When: the dialled node answers with an invalid introduction
    let strange = Introduction { project: "another".to_owned(), ..hello_from(HIGH, 1, 1) };
    core.handle(millis(1), Input::WelcomeReceived(dialled, strange));
    // Then
    let outputs = outputs(&mut core);
    assert!(refusal(&outputs).is_some(), "{outputs:?}");
    let closed = outputs.iter().filter(|output| matches!(output, Output::Close(_))).collect::<Vec<_>>();
    assert_eq!(closed, [&Output::Close(strangers[0])], "the oldest of those who say nothing");
}

#[test]
fn full_table_refuses_newcomers_unless_a_peer_is_idle() {
    let mut core = core();
    greet(&mut core, millis(0), hello_from(HIGH, 1, 1));
    greet(&mut core, millis(0), hello_from(NodeAddress::new(3), 1, 1));
    let (_, refused) = greet(&mut core, millis(1), hello_from(NodeAddress::new(4), 1, 1));
    assert_eq!(refusal(&refused), Some("too many peers"));
    core.handle(millis(2), Input::NodeLost { node: HIGH, incarnation: Incarnation(1) });
    let (_, taken) = greet(&mut core, millis(3), hello_from(NodeAddress::new(4), 1, 1));
    assert_eq!(refusal(&taken), None);
}

#[test]
fn peers_known_by_hello_only_are_limited_like_strangers() {
    let mut core = Core::new(Settings { peers_max: 10, ..settings(LOW, 1) }, 7);
    let node = |number| NodeAddress::new(HIGH.bits() + number);
    for number in 0..3 {
        let (_, taken) = greet(&mut core, millis(0), hello_from(node(number), 1, 1));
        assert_eq!(refusal(&taken), None);
    }
    let (_, refused) = greet(&mut core, millis(1), hello_from(node(3), 1, 1));
    assert_eq!(refusal(&refused), Some("too many peers"));
    let (_, again) = greet(&mut core, millis(2), hello_from(node(0), 1, 2));
    assert_eq!(refusal(&again), None, "it is one of them");
    core.handle(millis(3), found(1));
    outputs(&mut core);
    let (_, taken) = greet(&mut core, millis(4), hello_from(node(3), 1, 2));
    assert_eq!(refusal(&taken), None, "NDL has found one of the others");
}

#[test]
fn peer_that_sent_goodbye_is_not_dialled() {
    let mut core = core();
    core.handle(millis(0), found(1));
    let one_for_all = Introduction { features: Vec::new(), ..hello_from(HIGH, 1, 1) };
    let (link, _) = greet(&mut core, millis(0), one_for_all);
    core.handle(millis(1), Input::GoodbyeReceived(link));
    let left = Output::Fact(LinkFact::PeerLeft { node: HIGH, incarnation: Incarnation(1), gave_up: None });
    assert!(outputs(&mut core).contains(&left));
    assert_eq!(core.next_wake(), None);
}

#[test]
fn leaving_node_sends_goodbye_and_accepts_no_peer() {
    let mut core = core();
    let one_for_all = Introduction { features: Vec::new(), ..hello_from(HIGH, 1, 1) };
    greet(&mut core, millis(0), one_for_all);
    core.handle(millis(1), Input::LeaveRequested { undelivered_to: Vec::new() });
    assert!(outputs(&mut core).contains(&Output::SendGoodbye(HIGH)));
    let connection = core.open();
    core.handle(millis(2), Input::Accepted(connection, SOMEWHERE));
    assert!(outputs(&mut core).contains(&Output::Close(connection)));
}

#[test]
fn unannounced_peer_is_forgotten_after_its_link_broke() {
    let mut core = core();
    let (link, _) = greet(&mut core, millis(0), hello_from(HIGH, 1, 1));
    core.handle(millis(10), Input::Ended(link));
    outputs(&mut core);
    assert_eq!(silence(&mut core, Time::MAX), [(millis(5_010), Output::Forget(HIGH))]);
}

#[test]
fn second_process_does_not_replace_a_linked_member() {
    let mut core = core();
    core.handle(millis(0), found(5));
    outputs(&mut core);
    let (_, up) = greet(&mut core, millis(1), hello_from(HIGH, 5, 1));
    assert!(up.contains(&Output::Fact(LinkFact::LinkUp { node: HIGH, incarnation: Incarnation(5) })));

    let (_, second) = greet(&mut core, millis(2), hello_from(HIGH, 6, 1));
    assert_eq!(refusal(&second), Some("contested"));
    assert!(!second.iter().any(|output| matches!(output, Output::Detach { .. })), "{second:?}");

    // After NDL has found that the former incarnation is over, the later one is accepted.
    core.handle(millis(3), Input::NodeLost { node: HIGH, incarnation: Incarnation(5) });
    outputs(&mut core);
    let (_, later) = greet(&mut core, millis(4), hello_from(HIGH, 6, 2));
    assert!(later.contains(&Output::Fact(LinkFact::LinkUp { node: HIGH, incarnation: Incarnation(6) })));
}

#[test]
fn elder_is_accepted_once_the_later_was_another_process() {
    let mut core = core();
    core.handle(millis(0), found(6));
    let (impostor, _) = greet(&mut core, millis(1), hello_from(HIGH, 6, 1));
    core.handle(millis(2), Input::NodeDisowned { node: HIGH, incarnation: Incarnation(6) });
    let out = outputs(&mut core);
    assert!(out.contains(&Output::Close(impostor)) && out.contains(&Output::Forget(HIGH)), "{out:?}");
    core.handle(millis(3), found(5));
    outputs(&mut core);
    let (_, elder) = greet(&mut core, millis(4), hello_from(HIGH, 5, 1));
    assert!(elder.contains(&Output::Fact(LinkFact::LinkUp { node: HIGH, incarnation: Incarnation(5) })));
}

#[test]
fn incarnation_found_by_ndl_replaces_one_known_by_hello() {
    let mut core = core();
    let (impostor, _) = greet(&mut core, millis(0), hello_from(HIGH, 6, 1));
    core.handle(millis(1), found(5));
    let out = outputs(&mut core);
    assert!(out.contains(&Output::Close(impostor)), "{out:?}");
    assert!(out.iter().any(|output| matches!(output, Output::Dial { .. })), "{out:?}");
    let (_, real) = greet(&mut core, millis(2), hello_from(HIGH, 5, 1));
    assert!(real.contains(&Output::Fact(LinkFact::LinkUp { node: HIGH, incarnation: Incarnation(5) })));
}
