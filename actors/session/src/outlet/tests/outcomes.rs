//! Outcomes that wait for the socket: together in one frame if the peer supports it. spec: GNCL-17

use super::*;
use crate::{Window, outlet::outcomes::read};

const FAR: NodeAddress = NodeAddress::new(2);

/// The outcome of the message with this correlation from a remote application to a local one.
fn outcome(correlation: u64) -> Message {
    let source = Tid::new(FAR, AppAddress::new(0x1002));
    Message::outcome(Ticket { source, destination: tid(1), correlation }, Outcome::Delivered)
}

/// An outlet with a peer that supports several in one frame, or does not; its wire accepts nothing yet.
fn bench(takes_outcomes: bool, payload_max: usize) -> Bench {
    let gncl = |node| Tid::new(node, AppAddress::GNCL);
    let header = |kind| Header::new(kind, gncl(NodeAddress::new(1)), gncl(FAR));
    let outcomes = takes_outcomes.then(|| header(Kind::GNCL_OUTCOMES));
    let window = Window { messages: 64, bytes: PLENTY };
    let session = Session::new(1, window, header(Kind::GNCL_VOID), outcomes);
    let outlet = SocketWriter::with_session(OutletLimits { payload_max: 10_000, ..LIMITS }, session);
    let wire = Arc::new(Wire::default());
    let link = outlet.connect(wire.clone(), payload_max, None);
    let bench = Bench { outlet, wire, link, outcome_log: Arc::default() };
    receive_ack(&bench, 1);
    bench
}

fn receive_ack(bench: &Bench, next: u64) {
    let ack = Ack { receiver_id: 1, epoch: 1, peer_epoch: 1, next, change: 0, held: Vec::new(), room: None };
    bench.outlet.on_ack(bench.link, &ack, Time::now());
}

/// Returns the frames on the wire: for each its number, its kind, and the correlations of its outcomes.
fn seen(bench: &Bench) -> Vec<(u16, Kind, Vec<u64>)> {
    let frames = frames(&bench.wire.bytes.lock().unwrap());
    let correlations = |frame: &Message| match frame.header.kind {
        Kind::GNCL_OUTCOMES => {
            read(&frame.payload).expect("whole outcomes").map(|reported| reported.correlation).collect()
        }
        _ => vec![frame.header.correlation],
    };
    frames.iter().map(|frame| (frame.header.number, frame.header.kind, correlations(frame))).collect()
}

#[test]
fn only_waiting_outcomes_are_combined() {
    let bench = bench(true, usize::MAX);
    bench.wire.room.store(65, Ordering::Relaxed);
    for correlation in 1..=4 {
        bench.outlet.submit_beyond(outcome(correlation)).unwrap();
    }
    bench.submit(message(Class::Control, 42));
    bench.outlet.submit_beyond(outcome(5)).unwrap();
    bench.submit(message(Class::Bulk, 43));
    bench.outlet.submit_beyond(outcome(6)).unwrap();
    bench.make_room(PLENTY);
    let user = Kind::named("test");
    let expected = [
        (1, Kind::OUTCOME, vec![1]),
        (2, Kind::GNCL_OUTCOMES, vec![2, 3, 4]),
        (3, user, vec![0]),
        (4, Kind::GNCL_OUTCOMES, vec![5, 6]),
        (5, user, vec![0]),
    ];
    assert_eq!(seen(&bench), expected);
    assert_eq!(bench.outlet.counts(), OutletCounts { sent: 8, ..OutletCounts::default() });
    receive_ack(&bench, 6);
    let (account, _) = bench.outlet.account();
    assert_eq!((account.taken, account.arrived, account.own), (5, 5, 3), "as the receiver counts them");
}

#[test]
fn unsupporting_peer_gets_single_outcomes() {
    let bench = bench(false, usize::MAX);
    for correlation in 1..=3 {
        bench.outlet.submit_beyond(outcome(correlation)).unwrap();
    }
    bench.make_room(PLENTY);
    assert_eq!(seen(&bench), [1, 2, 3].map(|n| (n as u16, Kind::OUTCOME, vec![n])));
}

#[test]
fn frame_is_limited_to_128_outcomes_and_peer_maximum() {
    for (payload_max, at_once) in [(usize::MAX, 128), (17 * 100 + 16, 100), (33, 1)] {
        let bench = bench(true, payload_max);
        for correlation in 1..=300 {
            bench.outlet.submit_beyond(outcome(correlation)).unwrap();
        }
        for _ in 0..10 {
            bench.make_room(PLENTY);
            let last = seen(&bench).last().map_or(0, |(number, ..)| u64::from(*number));
            receive_ack(&bench, last + 1);
        }
        let seen = seen(&bench);
        assert_eq!(seen.iter().map(|(_, _, of)| of.len()).max(), Some(at_once));
        let all: Vec<u64> = seen.into_iter().flat_map(|(_, _, of)| of).collect();
        assert_eq!(all, (1..=300).collect::<Vec<_>>());
    }
}

#[test]
fn outcome_for_third_node_is_sent_alone() {
    let bench = bench(true, usize::MAX);
    let mut astray = outcome(2);
    astray.header.source.node = NodeAddress::new(7);
    for message in [outcome(1), astray, outcome(3)] {
        bench.outlet.submit_beyond(message).unwrap();
    }
    bench.make_room(PLENTY);
    assert_eq!(seen(&bench), [1, 2, 3].map(|n| (n as u16, Kind::OUTCOME, vec![n])));
}

#[test]
fn combined_outcomes_are_resent_unchanged() {
    let mut bench = bench(true, usize::MAX);
    for correlation in 1..=3 {
        bench.outlet.submit_beyond(outcome(correlation)).unwrap();
    }
    bench.make_room(80);
    bench.outlet.disconnect(bench.link);
    bench.reconnect(PLENTY);
    bench.outlet.submit_beyond(outcome(4)).unwrap();
    receive_ack(&bench, 1);
    bench.drain();
    assert_eq!(seen(&bench), [(1, Kind::GNCL_OUTCOMES, vec![1, 2, 3]), (2, Kind::OUTCOME, vec![4])]);
}
