//! Outcomes that wait for the socket: together in one frame if the peer supports it. spec: GNCL-17

use proptest::prelude::*;

use super::*;
use crate::{
    Window,
    outlet::outcomes::{ReportedOutcome, read},
};

const FAR: NodeAddress = NodeAddress::new(2);

/// The message with this correlation from a remote application to a local one.
fn ticket(correlation: u64) -> Ticket {
    Ticket { source: Tid::new(FAR, AppAddress::new(0x1002)), destination: tid(1), correlation }
}

/// The outcome of that message.
pub(super) fn outcome(correlation: u64) -> Message {
    Message::outcome(ticket(correlation), Outcome::Delivered)
}

/// Both kinds of frames with several outcomes.
const FRAMES: [Kind; 2] = [Kind::GNCL_OUTCOMES, Kind::GNCL_OUTCOME_RUNS];

/// An outlet to a peer that supports several in one frame of this kind, or not.
fn outlet<S: Socket>(frame: Option<Kind>) -> SocketWriter<S> {
    let gncl = |node| Tid::new(node, AppAddress::GNCL);
    let header = |kind| Header::new(kind, gncl(NodeAddress::new(1)), gncl(FAR));
    let outcomes = frame.map(header);
    let window = Window { messages: 64, bytes: PLENTY };
    let session = Session::new(1, window, header(Kind::GNCL_VOID), outcomes);
    SocketWriter::with_session(OutletLimits { payload_max: 10_000, ..LIMITS }, session)
}

/// The same, with a wire that accepts nothing yet.
pub(super) fn bench(frame: Option<Kind>, payload_max: usize) -> Bench {
    let outlet = outlet(frame);
    let wire = Arc::new(Wire::default());
    let link = outlet.connect(wire.clone(), payload_max, None);
    let bench = Bench { outlet, wire, link, outcome_log: Arc::default() };
    receive_ack(&bench, 1);
    bench
}

fn ack(next: u64) -> Ack {
    Ack { receiver_id: 1, epoch: 1, peer_epoch: 1, next, change: 0, held: Vec::new(), room: None }
}

fn receive_ack(bench: &Bench, next: u64) {
    bench.outlet.on_ack(bench.link, &ack(next), Time::now());
}

/// Returns the application, the correlation and the byte of each outcome in a frame with several.
fn each(frame: &Message) -> Vec<(u32, u64, u8)> {
    let all = read(frame.header.kind, &frame.payload).expect("whole outcomes");
    let of_run = |run: ReportedOutcome| {
        let code = run.outcome.expect("a known outcome").code();
        (0..u64::from(run.count)).map(move |at| (run.destination.bits(), run.correlation + at, code))
    };
    all.flat_map(of_run).collect()
}

/// Returns the frames on the wire: for each its number, its kind, and the correlations of its outcomes.
fn seen(bench: &Bench) -> Vec<(u16, Kind, Vec<u64>)> {
    let frames = frames(&bench.wire.bytes.lock().unwrap());
    let correlations = |frame: &Message| match frame.header.kind {
        kind if FRAMES.contains(&kind) => {
            each(frame).into_iter().map(|(_, correlation, _)| correlation).collect()
        }
        _ => vec![frame.header.correlation],
    };
    frames.iter().map(|frame| (frame.header.number, frame.header.kind, correlations(frame))).collect()
}

#[test]
fn only_waiting_outcomes_are_combined() {
    let bench = bench(Some(Kind::GNCL_OUTCOMES), usize::MAX);
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
    let bench = bench(None, usize::MAX);
    for correlation in 1..=3 {
        bench.outlet.submit_beyond(outcome(correlation)).unwrap();
    }
    bench.make_room(PLENTY);
    assert_eq!(seen(&bench), [1, 2, 3].map(|n| (n as u16, Kind::OUTCOME, vec![n])));
}

#[test]
fn frame_is_limited_to_128_outcomes_and_peer_maximum() {
    for (payload_max, at_once) in [(usize::MAX, 128), (17 * 100 + 16, 100), (33, 1)] {
        let bench = bench(Some(Kind::GNCL_OUTCOMES), payload_max);
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
    let bench = bench(Some(Kind::GNCL_OUTCOMES), usize::MAX);
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
    let mut bench = bench(Some(Kind::GNCL_OUTCOMES), usize::MAX);
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

fn report(bench: &Bench, ticket: Ticket, outcome: Outcome) {
    bench.outlet.report_outcome(ticket, outcome, usize::MAX).unwrap();
}

#[test]
fn outcomes_of_consecutive_messages_wait_as_one() {
    let bench = bench(Some(Kind::GNCL_OUTCOMES), usize::MAX);
    (1..=300).for_each(|correlation| report(&bench, ticket(correlation), Outcome::Delivered));
    assert_eq!(bench.outlet.waiting(), 3);
    bench.make_room(PLENTY);
    let expected = [1..=128, 129..=256, 257..=300].map(Iterator::collect::<Vec<u64>>);
    assert_eq!(seen(&bench).into_iter().map(|(_, _, of)| of).collect::<Vec<_>>(), expected);
    receive_ack(&bench, 4);
    let (account, _) = bench.outlet.account();
    assert_eq!((account.taken, account.arrived, account.own), (3, 3, 3), "as the receiver counts them");
}

#[test]
fn run_is_one_entry_for_peers_with_runs() {
    for (frame, bytes) in FRAMES.into_iter().zip([100 * 17, 2 * 18]) {
        let bench = bench(Some(frame), usize::MAX);
        for correlation in (1..=40).chain(42..=101) {
            report(&bench, ticket(correlation), Outcome::Delivered);
        }
        assert_eq!(bench.outlet.waiting(), 2);
        bench.make_room(PLENTY);
        assert_eq!(seen(&bench), [(1, frame, (1..=40).chain(42..=101).collect::<Vec<_>>())]);
        assert_eq!(frames(&bench.wire.bytes.lock().unwrap())[0].payload.len(), bytes);
        assert_eq!(bench.outlet.counts().sent, 100, "each outcome counts");
    }
}

#[test]
fn unsupporting_peer_gets_each_reported_outcome_alone() {
    let bench = bench(None, usize::MAX);
    (1..=3).for_each(|correlation| report(&bench, ticket(correlation), Outcome::Delivered));
    assert_eq!(bench.outlet.waiting(), 3);
    bench.make_room(PLENTY);
    assert_eq!(seen(&bench), [1, 2, 3].map(|n| (n as u16, Kind::OUTCOME, vec![n])));
}

#[test]
fn waiting_outcomes_are_divided_for_a_shorter_frame() {
    for (payload_max, at_once) in [(17 * 3, 3), (17, 1)] {
        let mut bench = bench(Some(Kind::GNCL_OUTCOMES), usize::MAX);
        (1..=10).for_each(|correlation| report(&bench, ticket(correlation), Outcome::Delivered));
        bench.outlet.disconnect(bench.link);
        bench.wire = Arc::default();
        bench.link = bench.outlet.connect(bench.wire.clone(), payload_max, None);
        receive_ack(&bench, 1);
        bench.make_room(PLENTY);
        let all: Vec<u64> = (1..=10).collect();
        let expected: Vec<_> = all.chunks(at_once).map(<[u64]>::to_vec).collect();
        assert_eq!(seen(&bench).into_iter().map(|(_, _, of)| of).collect::<Vec<_>>(), expected);
        let frames = expected.len() as u64;
        receive_ack(&bench, frames + 1);
        let (account, _) = bench.outlet.account();
        assert_eq!((account.taken, account.arrived), (frames, frames), "as the receiver counts them");
    }
}

#[test]
fn failed_write_of_added_outcomes_is_reported() {
    // Given: 127 outcomes wait as one, and the drain task waits for the socket.
    let (outlet, wire) = (outlet(Some(Kind::GNCL_OUTCOME_RUNS)), Arc::<Wire>::default());
    let link = outlet.connect(Gathering::new(wire.clone(), Checksum::Crc), usize::MAX, None);
    outlet.on_ack(link, &ack(1), Time::now());
    let report = |correlation| {
        outlet.report_outcome(ticket(correlation), Outcome::Delivered, usize::MAX).unwrap();
    };
    (1..=127).for_each(report);
    assert_eq!(outlet.waiting(), 1);
    assert!(outlet.drain(link).now_or_never().is_none());
    let is_asleep = || outlet.lock().connection.is_drainer_asleep();
    assert!(is_asleep());
    // When: the next one makes its sender write them all, and the connection has ended.
    wire.fails.store(true, Ordering::Relaxed);
    report(128);
    // Then
    assert!(!is_asleep());
    assert!(outlet.drain(link).now_or_never().is_some(), "it reports the end");
}

#[test]
fn ending_outlet_takes_no_further_outcome() {
    let bench = bench(Some(Kind::GNCL_OUTCOMES), usize::MAX);
    report(&bench, ticket(1), Outcome::Delivered);
    bench.outlet.finish(message(Class::Control, 9));
    let refused = bench.outlet.report_outcome(ticket(2), Outcome::Delivered, usize::MAX).unwrap_err();
    assert_eq!(refused.why, Rejection::Closed);
}

/// A step of an outlet.
#[derive(Clone, Copy, Debug)]
enum Step {
    /// The outcome of the next message to this application, after some that have none.
    Report { app: u32, skips: u64, outcome: Outcome },
    /// Another message of class Control.
    Message,
    /// The wire accepts this number of bytes more.
    Write(usize),
}

fn steps() -> impl Strategy<Value = Vec<Step>> {
    let app = prop_oneof![19 => Just(1_u32), 1 => Just(2)];
    let skips = prop_oneof![19 => Just(0_u64), 1 => Just(1)];
    let outcome = prop_oneof![19 => Just(Outcome::Delivered), 1 => Just(Outcome::Failed)];
    let report = (app, skips, outcome).prop_map(|(app, skips, outcome)| Step::Report { app, skips, outcome });
    let step = prop_oneof![40 => report, 1 => Just(Step::Message), 1 => (0..700_usize).prop_map(Step::Write)];
    proptest::collection::vec(step, 0..500)
}

/// Returns all outcomes on the wire: the application, the correlation and the byte of each; 0 for another message.
/// Tells the outlet that all of them have arrived.
fn arrived(bench: &Bench) -> Vec<(u32, u64, u8)> {
    let mut arrived = Vec::new();
    let frames = frames(&bench.wire.bytes.lock().unwrap());
    for frame in &frames {
        let header = &frame.header;
        match header.kind {
            kind if FRAMES.contains(&kind) => arrived.extend(each(frame)),
            Kind::OUTCOME => {
                assert_eq!((header.sequence, frame.payload.len()), (0, 1), "the form on a connection");
                arrived.push((header.source.app.bits(), header.correlation, frame.payload[0]));
            }
            _ => arrived.push((0, 0, 0)),
        }
    }
    receive_ack(bench, frames.len() as u64 + 1);
    arrived
}

proptest! {
    #[test]
    fn each_outcome_arrives_once_in_its_place(
        steps in steps(),
        payload_max in prop_oneof![Just(usize::MAX), Just(17 * 5 + 1), Just(17 * 2), Just(17)],
        frame in proptest::sample::select(FRAMES.to_vec()),
    ) {
        let (bench, mut expected, mut correlations) = (bench(Some(frame), payload_max), Vec::new(), [0; 2]);
        for step in steps {
            match step {
                Step::Report { app, skips, outcome } => {
                    let correlation = &mut correlations[app as usize - 1];
                    *correlation += 1 + skips;
                    let ticket = Ticket { destination: tid(app), ..ticket(*correlation) };
                    report(&bench, ticket, outcome);
                    expected.push((tid(app).app.bits(), *correlation, outcome.code()));
                }
                Step::Message => {
                    bench.outlet.submit_beyond(message(Class::Control, 7)).unwrap();
                    expected.push((0, 0, 0));
                }
                Step::Write(room) => {
                    bench.make_room(room);
                    arrived(&bench);
                }
            }
        }
        for _ in 0..=windows(expected.len()) {
            bench.make_room(PLENTY);
            arrived(&bench);
        }
        prop_assert_eq!(arrived(&bench), expected);
        let frames = frames(&bench.wire.bytes.lock().unwrap()).len() as u64;
        let (account, _) = bench.outlet.account();
        prop_assert_eq!((account.taken, account.arrived, account.waiting), (frames, frames, 0));
        prop_assert_eq!(bench.outlet.lock().unsent.queue.outcomes(), 0);
    }
}

/// Returns how often a window of 64 messages is needed for this number of frames.
const fn windows(frames: usize) -> usize {
    frames / 64 + 1
}
