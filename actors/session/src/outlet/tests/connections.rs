//! Messages across the end of a connection or of the outlet: they move to the next one, or are settled.

use super::*;

#[test]
fn unsent_messages_move_to_next_connection_in_order() {
    let mut bench = Bench::new(74 + 30);
    for correlation in 1..=4 {
        bench.submit(bench.confirmed(correlation));
    }
    assert!(!bench.outlet.disconnect(bench.link), "the second frame was cut");
    assert_eq!(bench.outcome_log.take(), [(1, Outcome::Unknown)]);
    bench.reconnect(PLENTY);
    assert_eq!(bench.seen(), [2, 3, 4], "the frame that was cut goes first, whole");
    assert_eq!(bench.outlet.unconfirmed(), 3);
}

#[test]
fn cut_stream_value_is_superseded_by_waiting_one() {
    let mut bench = Bench::new(30);
    bench.submit(message(Class::Stream, 1));
    bench.submit(message(Class::Stream, 2));
    bench.outlet.disconnect(bench.link);
    bench.reconnect(PLENTY);
    assert_eq!(bench.seen(), [2]);
    assert_eq!(bench.outlet.counts().superseded, 1);
}

#[test]
fn preface_is_first_frame_of_its_connection_only() {
    let mut bench = Bench::new(0);
    bench.submit(message(Class::Control, 1));
    let preface = |value| Some(message(Class::Control, value));
    bench.wire.room.store(10, Ordering::Relaxed);
    bench.link = bench.outlet.connect(bench.wire.clone(), usize::MAX, preface(100));
    bench.drain();
    bench.wire = Arc::default();
    bench.wire.room.store(PLENTY, Ordering::Relaxed);
    bench.link = bench.outlet.connect(bench.wire.clone(), usize::MAX, preface(200));
    bench.drain();
    assert_eq!(bench.seen(), [200, 1]);
}

#[test]
fn last_frame_follows_queue_and_closes_it() {
    let bench = Bench::new(0);
    for (class, value) in [(Class::Bulk, 3), (Class::Control, 1), (Class::Stream, 2)] {
        bench.submit(message(class, value));
    }
    bench.outlet.finish(message(Class::Control, 100));
    assert_eq!(bench.outlet.submit(message(Class::Control, 4)).unwrap_err().why, Rejection::Closed);
    bench.make_room(PLENTY);
    assert_eq!(bench.seen(), [1, 2, 3, 100]);
    let idle = Bench::new(PLENTY);
    idle.outlet.finish(message(Class::Control, 100));
    assert_eq!(idle.seen(), [100], "at once, if nothing waits");
}

#[test]
fn last_frame_is_repeated_after_connection_end() {
    let mut bench = Bench::new(PLENTY);
    bench.outlet.finish(message(Class::Control, 100));
    assert_eq!(bench.seen(), [100]);
    bench.wire = Arc::default();
    bench.wire.room.store(PLENTY, Ordering::Relaxed);
    bench.link = bench.outlet.connect(bench.wire.clone(), usize::MAX, None);
    bench.drain();
    assert_eq!(bench.seen(), [100]);
    bench.drain();
    assert_eq!(bench.seen(), [100], "and once on each");
}

#[test]
fn closed_outlet_rejects_waiting_and_new_messages() {
    let bench = Bench::new(74 + 30);
    for correlation in 1..=3 {
        bench.submit(bench.confirmed(correlation));
    }
    bench.submit(message(Class::Stream, 4));
    bench.outlet.close(Rejection::NoSuchNode);
    let mut settled = bench.outcome_log.take();
    settled.sort_by_key(|(correlation, _)| *correlation);
    assert_eq!(settled, [(1, Outcome::Unknown), (2, Outcome::PeerLost), (3, Outcome::PeerLost)]);
    assert_eq!(bench.outlet.counts(), OutletCounts { sent: 1, lost: 3, ..OutletCounts::default() });
    assert_eq!(bench.outlet.submit(message(Class::Bulk, 1)).unwrap_err().why, Rejection::NoSuchNode);
    assert!(bench.drain().is_some(), "there is nothing to drain any more");
}

#[test]
fn failed_write_ends_connection_without_loss() {
    let mut bench = Bench::new(PLENTY);
    bench.wire.fails.store(true, Ordering::Relaxed);
    bench.submit(bench.confirmed(1));
    assert_eq!(bench.drain().map(|error| error.kind()), Some(io::ErrorKind::BrokenPipe));
    bench.outlet.disconnect(bench.link);
    bench.reconnect(PLENTY);
    assert_eq!((bench.seen(), bench.outcome_log.take()), (vec![1], vec![]));
}

#[test]
fn drainer_of_former_connection_ends() {
    let mut bench = Bench::new(PLENTY);
    let former = bench.link;
    bench.reconnect(PLENTY);
    assert!(bench.outlet.drain(former).now_or_never().is_some());
    assert!(bench.outlet.drain(bench.link).now_or_never().is_none());
}
