//! A new epoch of a session: nothing of it is sent before the peer is notified.

use std::future::Future;

use super::*;
use crate::Window;

const EPOCH: u64 = 7;

/// Returns a connection after an ACK of a peer with this `receiver_id`, which expects the first message next.
fn bench(receiver_id: u64) -> Bench {
    let window = Window { messages: 64, bytes: PLENTY };
    let void = message(Class::Control, 0).header;
    let outlet = SocketWriter::with_session(LIMITS, Session::new(EPOCH, window, void, None));
    let wire = Arc::new(Wire::default());
    wire.room.store(PLENTY, Ordering::Relaxed);
    let link = outlet.connect(wire.clone(), usize::MAX, None);
    let bench = Bench { outlet, wire, link, outcome_log: Arc::default() };
    assert!(!bench.receive_ack(receiver_id), "nothing was sent yet");
    bench
}

impl Bench {
    /// Returns whether a new epoch has begun.
    fn receive_ack(&self, receiver_id: u64) -> bool {
        let ack =
            Ack { receiver_id, epoch: 1, peer_epoch: 0, next: 1, change: 0, held: Vec::new(), room: None };
        self.outlet.on_ack(self.link, &ack, Time::now())
    }

    fn acknowledge(&self, epoch: u64) -> bool {
        let mut ack = message(Class::Control, epoch as u8);
        ack.header.kind = Kind::GNCL_ACK;
        self.outlet.acknowledge(ack, self.link.number(), epoch)
    }
}

/// Returns a bench with one sent message, which the peer has lost by the next connection.
fn bench_after_loss() -> Bench {
    let mut bench = bench(1);
    bench.submit(message(Class::Bulk, 100));
    assert_eq!(bench.seen(), [100]);
    bench.reconnect(PLENTY);
    assert!(bench.receive_ack(2), "the peer has lost that message");
    bench
}

/// Counts how often it was woken.
#[derive(Default)]
struct WakeCounter(AtomicUsize);

impl std::task::Wake for WakeCounter {
    fn wake(self: Arc<Self>) {
        self.0.fetch_add(1, Ordering::Relaxed);
    }
}

/// If the socket is full, the drainer sends the acknowledgement once the socket is writable again.
#[test]
fn blocked_acknowledgement_wakes_the_drainer() {
    let bench = bench(1);
    let woken = Arc::new(WakeCounter::default());
    let waker = Waker::from(woken.clone());
    let mut drained = std::pin::pin!(bench.outlet.drain(bench.link));
    assert!(drained.as_mut().poll(&mut Context::from_waker(&waker)).is_pending());
    bench.wire.room.store(0, Ordering::Relaxed);
    assert!(bench.acknowledge(EPOCH));
    assert_eq!(woken.0.load(Ordering::Relaxed), 1);
    bench.wire.room.store(PLENTY, Ordering::Relaxed);
    for _ in 0..2 {
        assert!(drained.as_mut().poll(&mut Context::from_waker(&waker)).is_pending());
    }
    assert_eq!(bench.seen(), [EPOCH as u8]);
}

// spec: SESSION-5
#[test]
fn messages_wait_for_announcement_of_epoch() {
    let bench = bench_after_loss();
    bench.submit(message(Class::Bulk, 101));
    bench.drain();
    assert_eq!(bench.seen(), [0; 0], "the peer would count it in the ended epoch, and accept it twice");
    assert!(bench.acknowledge(EPOCH + 1));
    bench.drain();
    assert_eq!(bench.seen(), [EPOCH as u8 + 1, 101]);
}

#[test]
fn outdated_announcement_is_not_sent() {
    let bench = bench_after_loss();
    bench.submit(message(Class::Bulk, 101));
    assert!(!bench.acknowledge(EPOCH), "a new one is required");
    bench.drain();
    assert_eq!(bench.seen(), [0; 0]);
}

#[test]
fn ack_of_former_epoch_releases_nothing() {
    let bench = bench_after_loss();
    bench.submit(message(Class::Bulk, 101));
    assert!(!bench.receive_ack(2), "it changes nothing");
    bench.drain();
    assert_eq!(bench.seen(), [0; 0]);
}

#[test]
fn next_connection_needs_no_separate_announcement() {
    let mut bench = bench_after_loss();
    bench.submit(message(Class::Bulk, 101));
    bench.reconnect(PLENTY);
    assert!(!bench.receive_ack(2));
    bench.drain();
    assert_eq!(bench.seen(), [101]);
}
