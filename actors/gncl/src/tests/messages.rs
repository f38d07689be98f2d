//! The disposition of received messages.

use std::time::Duration;

use sinew_model::clocks::{ClockDrift, ClockOffset};
use sinew_runtime::{
    outcome::{MemberReport, MemberState, Outcome, Rejection},
    tid::{AppAddress, Incarnation, NodeAddress, Tid},
    time::Time,
    wire::{Class, Flags, Kind, Message},
};
use sinew_session::Ack;

use super::bench::{ByHand, KIND, LONGEST, NINE, Node, introduction, next, pair, run, within};
use crate::core::{Introduction, read};

/// Returns a message as the handwritten peer sends it.
fn from_nine(node: &Node, payload: &[u8]) -> Message {
    let mut message = node.message(node.tid(1), payload);
    message.header.source.node = NINE;
    message
}

#[test]
fn confirmed_message_gets_its_destinations_outcome() {
    run(async {
        let (mut a, b) = pair().await;
        let mut inbox = b.app(1);
        for correlation in 1..=2 {
            a.state.ctx.router.send(a.confirmed(b.tid(1), correlation)).unwrap();
        }
        next("the first message", &mut inbox).await.settle(Outcome::Delivered);
        drop(next("the second message", &mut inbox).await);
        assert_eq!(next("the first outcome", &mut a.settled).await, (1, Outcome::Delivered));
        assert_eq!(next("the second outcome", &mut a.settled).await, (2, Outcome::Failed));

        a.state.ctx.router.send(a.confirmed(b.tid(7), 3)).unwrap();
        let rejected = Outcome::Rejected(Rejection::NoSuchApplication);
        assert_eq!(next("the third outcome", &mut a.settled).await, (3, rejected));
    });
}

#[test]
fn forged_source_is_refused_and_the_link_stays() {
    run(async {
        let mut node = Node::start(1).await;
        let mut peer = ByHand::linked_to(&mut node).await;
        let mut inbox = node.app(1);
        let mut forged = from_nine(&node, b"I am somebody else");
        forged.header.source.node = NodeAddress::new(8);
        peer.send(&forged).await;
        peer.send(&from_nine(&node, b"honest")).await;
        assert_eq!(&next("the honest message", &mut inbox).await.payload[..], b"honest");
        assert_eq!(node.state.store.refusals.of("forged source"), 1);
    });
}

#[test]
fn message_for_another_node_is_not_forwarded() {
    run(async {
        let mut node = Node::start(1).await;
        let mut peer = ByHand::linked_to(&mut node).await;
        let mut astray = from_nine(&node, b"");
        astray.header.destination.node = NodeAddress::new(8);
        astray.header.flags = Flags::CONFIRM;
        astray.header.correlation = 5;
        peer.send(&astray).await;
        let outcome = peer.receive().await;
        assert_eq!((outcome.header.kind, outcome.header.correlation), (Kind::OUTCOME, 5));
        assert_eq!(outcome.header.destination, astray.header.source);
        assert_eq!(outcome.payload[..], [Outcome::Rejected(Rejection::NoSuchNode).code()]);
    });
}

#[test]
fn broadcast_reaches_all_applications_and_each_confirms() {
    run(async {
        let mut node = Node::start(1).await;
        let mut peer = ByHand::linked_to(&mut node).await;
        let mut inboxes = [node.app(1), node.app(2)];
        let mut broadcast = from_nine(&node, b"all");
        broadcast.header.destination = Tid::BROADCAST;
        peer.send(&broadcast).await;
        for inbox in &mut inboxes {
            assert_eq!(&next("the broadcast", inbox).await.payload[..], b"all");
        }
        broadcast.header.flags = Flags::CONFIRM;
        broadcast.header.correlation = 7;
        peer.send(&broadcast).await;
        // spec: GNCL-12: the members with a copy, the end of that list, and the outcome of each member
        let here = node.state.ctx.node;
        let members = [1, 2].map(|number| Tid::new(here, AppAddress::new(0x1000 + number)));
        let mut said = vec![peer.receive().await];
        for inbox in &mut inboxes {
            let mut message = next("the confirmed one", inbox).await;
            assert_eq!(message.header.destination, Tid::BROADCAST);
            message.settle(Outcome::Delivered);
        }
        for _ in 0..3 {
            said.push(peer.receive().await);
        }
        assert!(said.iter().all(|frame| frame.header.source == Tid::new(here, AppAddress::ALL)));
        assert!(
            said.iter().all(|frame| frame.header.correlation == 7 && frame.header.flags.has(Flags::OUTCOME))
        );
        let last = said.pop().expect("there are four");
        assert_eq!((last.header.kind, &last.payload[..]), (Kind::OUTCOME, &[Outcome::Delivered.code()][..]));
        let reports: Vec<_> =
            said.iter().flat_map(|frame| MemberReport::decode(&frame.payload).expect("reports")).collect();
        let of = |state| members.map(|tid| MemberReport::of_member(tid, state));
        let listed = MemberReport::of_node(here, MemberState::Listed);
        let settled = of(MemberState::Settled(Outcome::Delivered));
        assert_eq!(reports, [&of(MemberState::Pending)[..], &[listed], &settled].concat());
    });
}

#[test]
fn times_are_local_and_old_arrivals_have_expired() {
    run(async {
        let mut node = Node::start(1).await;
        let mut peer = ByHand::linked_to(&mut node).await;
        let mut inbox = node.app(1);
        let hour = 3_600_000_000_000;
        let (at, drift) = (Time::now(), ClockDrift { ppb: 0, bound_ppb: 0 });
        let offset = ClockOffset { theirs_minus_ours_ns: hour, bound: Duration::from_millis(1), at, drift };
        node.state.ctx.clocks.set(NINE, Incarnation(1), offset);
        let sent = Time::now() - Duration::from_secs(1);

        let mut fresh = from_nine(&node, b"fresh");
        fresh.header.sent = sent.shifted(hour);
        fresh.header.time_to_live_us = 60_000_000;
        peer.send(&fresh).await;
        let fresh = next("the fresh message", &mut inbox).await.header;
        assert_eq!(fresh.sent, sent);
        // The clock's error, plus the drift of two clocks in the second for which it was in flight.
        assert!(fresh.sent_error().is_some_and(|error| error >= Duration::from_micros(1_200)), "{fresh:?}");

        let mut old = from_nine(&node, b"old");
        old.header.sent = sent.shifted(hour);
        old.header.time_to_live_us = 500_000;
        old.header.flags = Flags::CONFIRM;
        peer.send(&old).await;
        assert_eq!(peer.receive().await.payload[..], [Outcome::Expired.code()]);
    });
}

#[test]
fn age_gets_less_exact_without_clock_measurements() {
    run(async {
        let mut node = Node::start(1).await;
        let mut peer = ByHand::linked_to(&mut node).await;
        let mut inbox = node.app(1);
        let drift = ClockDrift { ppb: 50_000, bound_ppb: 5_000 };
        let at = Time::now() - Duration::from_secs(60);
        let measured = ClockOffset { theirs_minus_ours_ns: 0, bound: Duration::from_micros(50), at, drift };
        node.state.ctx.clocks.set(NINE, Incarnation(1), measured);

        // Its clock is 3 ms ahead by now.
        let sent = Time::now() - Duration::from_secs(1);
        let mut message = from_nine(&node, b"");
        message.header.sent = sent.shifted(3_000_000);
        peer.send(&message).await;
        let came = next("the message", &mut inbox).await.header;
        assert!(came.sent.since(sent).max(sent.since(came.sent)) < Duration::from_micros(500), "{came:?}");
        let error = came.sent_error().expect("its clock was measured");
        assert!(
            error > Duration::from_micros(500),
            "half a round trip, and what it may have wandered in a minute: {came:?}"
        );
    });
}

#[test]
fn without_a_measured_clock_lifetime_starts_at_arrival() {
    run(async {
        let mut node = Node::start(1).await;
        let mut peer = ByHand::linked_to(&mut node).await;
        let mut inbox = node.app(1);
        let before = Time::now();
        let mut message = from_nine(&node, b"");
        message.header.sent = Time::from_nanos(1);
        message.header.time_to_live_us = 1_000_000;
        peer.send(&message).await;
        let came = next("the message", &mut inbox).await.header;
        assert!(before <= came.sent && came.sent <= Time::now());
        assert_eq!((came.sent_error(), came.known_sent()), (None, None));
    });
}

// spec: GNCL-11
#[test]
fn former_incarnations_clock_does_not_age_new_messages() {
    run(async {
        // Given: the previous incarnation was on a host with an hour more of uptime, and the clock of this one has not
        // been measured.
        let mut node = Node::start(1).await;
        let mut peer = ByHand::linked_to(&mut node).await;
        let mut inbox = node.app(1);
        let incarnation = node.state.store.peer(NINE).expect("it is linked").incarnation;
        let (at, drift) = (Time::now(), ClockDrift { ppb: 0, bound_ppb: 0 });
        let (theirs_minus_ours_ns, bound) = (3_600_000_000_000, Duration::from_micros(50));
        let offset = ClockOffset { theirs_minus_ours_ns, bound, at, drift };
        node.state.ctx.clocks.set(NINE, Incarnation(incarnation.0 - 1), offset);
        // When
        let before = Time::now();
        let mut message = from_nine(&node, b"");
        message.header.time_to_live_us = 60_000_000;
        peer.send(&message).await;
        // Then: it is not considered an hour old
        let came = next("the message", &mut inbox).await.header;
        assert!(before <= came.sent && came.sent <= Time::now());
        assert_eq!((came.sent_error(), came.known_sent()), (None, None));
    });
}

#[test]
fn requests_and_replies_are_messages_with_kept_marks() {
    run(async {
        let (a, b) = pair().await;
        let mut inbox = b.app(1);
        let mut ask = a.message(b.tid(1), b"?");
        ask.header.flags = Flags::ASK;
        ask.header.correlation = 12;
        ask.header.class = Class::Bulk;
        a.state.ctx.router.send(ask).unwrap();
        let there = next("the question", &mut inbox).await.header;
        assert_eq!((there.flags, there.correlation, there.class), (Flags::ASK, 12, Class::Bulk));
    });
}

#[test]
fn large_message_arrives_whole_among_small_ones() {
    run(async {
        let (a, b) = pair().await;
        let mut inbox = b.app(1);
        let large: Vec<u8> = (0..1_000_000u32).map(|n| n as u8).collect();
        for payload in [&b"before"[..], &large, b"after"] {
            a.send(b.tid(1), payload);
        }
        for payload in [&b"before"[..], &large, b"after"] {
            assert!(next("a message", &mut inbox).await.payload[..] == *payload);
        }
        let too_long = a.message(b.tid(1), &vec![0; (1 << 20) + 1]);
        assert_eq!(a.state.ctx.router.send(too_long), Err(Rejection::TooLong));
    });
}

/// The peer is written from the documentation alone, in another language.
#[test]
fn documented_peer_survives_two_breaks_without_loss_or_reorder() {
    const PAGE: &str = include_str!("../../../../docs/protocol/gncl.md");
    let Some(mut python) = sinew_figures::documentation::python(PAGE, "## A whole node") else { return };
    run(async {
        let mut node = Node::start(1).await;
        // It holds the Python peer back.
        let mut inbox = node.app_of(1, 2);
        let address = node.listens_at();
        let words = [address.port().to_string(), node.tid(1).bits().to_string(), KIND.bits().to_string()];
        python.arg(address.ip().to_string()).args(words).stdout(std::process::Stdio::piped());
        let python = python.spawn().expect("it was there a moment ago");
        node.up().await;
        for number in 1..=10u64 {
            let message = next("a message from Python", &mut inbox).await;
            assert_eq!(message.payload[..], number.to_le_bytes());
            message.receipt.expect("it is to be confirmed").settle(Outcome::Delivered);
        }
        let output = tokio::task::spawn_blocking(|| python.wait_with_output());
        let output =
            within("the end of the program", output).await.expect("it is waited for").expect("it ends");
        assert!(output.status.success(), "{output:?}");
        let said = String::from_utf8(output.stdout).expect("it writes text");
        let expected: String = (1..=10).map(|number| format!("outcome {number} 0\n")).collect();
        assert_eq!(said, expected);
    });
}

#[test]
fn group_and_broadcast_cross_once_and_share_their_payload() {
    run(async {
        let (a, b) = pair().await;
        let group = AppAddress::group("listeners");
        let mut members: Vec<_> = (1..=5).map(|number| b.app(number)).collect();
        for number in 1..=5 {
            assert!(b.state.ctx.router.set_member(group, b.tid(number).app, true));
        }
        a.state.ctx.router.set_remote_groups(b.address(), &[group]);
        let peer = a.state.store.peer(b.address()).expect("it is linked");
        for (copies, app) in [(1, group), (2, AppAddress::ALL)] {
            a.send(Tid::new(NodeAddress::ALL, app), &[7; 1_000]);
            let mut payloads = Vec::new();
            for member in &mut members {
                payloads.push(next("a copy", member).await.payload);
            }
            assert!(payloads.iter().all(|payload| payload.as_ptr() == payloads[0].as_ptr()), "one payload");
            assert_eq!(peer.counts().sent, copies, "one message on the wire for all of them");
        }
    });
}

// spec: GNCL-11
#[test]
fn layer_only_kinds_from_a_peer_reach_no_application() {
    run(async {
        let mut node = Node::start(1).await;
        let mut peer = ByHand::linked_to(&mut node).await;
        let mut inbox = node.app(1);
        for kind in [Kind::LNCL_REFUSAL, Kind::LNCL_GONE, Kind::LNCL_UNDELIVERED] {
            let mut forged = from_nine(&node, b"I am your LNCL");
            forged.header.kind = kind;
            peer.send(&forged).await;
        }
        peer.send(&from_nine(&node, b"honest")).await;
        let mut came = Vec::new();
        loop {
            let message = next("a message", &mut inbox).await;
            if message.header.kind == KIND {
                break;
            }
            came.push(message.header.kind);
        }
        assert!(came.is_empty(), "an application got {came:x?} from another node");
    });
}

#[test]
fn slow_peer_finally_receives_all_acknowledgements() {
    run(async {
        const COUNT: u64 = 1_500;
        // Given: a peer that does not read, and a node with a full connection to it.
        let mut node = Node::start_with(1, |config| config.payload_max = LONGEST).await;
        let hello = Introduction { payload_max: LONGEST as u64, ..introduction(node.address()) };
        let mut peer = ByHand::greeting(&node, &hello).await;
        node.up().await;
        let outlet = |node: &Node| node.state.store.peer(NINE).expect("it is linked");
        while outlet(&node).waiting() == 0 {
            node.send(Tid::new(NINE, AppAddress::new(0x1001)), &vec![0; LONGEST]);
        }
        // When: it sends more than fits into the maximum number of queued frames.
        let mut inbox = node.app(1);
        for _ in 0..COUNT {
            peer.send(&from_nine(&node, b"")).await;
        }
        for _ in 0..COUNT {
            next("its message", &mut inbox).await;
        }
        // Then: as soon as it reads, it receives that all of them were accepted.
        let mut received = 0;
        while received <= COUNT {
            let message = peer.try_receive_any().await.expect("the node has a word about the rest");
            if message.header.kind == Kind::GNCL_ACK {
                received = read::<Ack>(&message.payload).expect("an ACK has a payload").next;
            }
        }
        assert_eq!(received, COUNT + 1);
    });
}
