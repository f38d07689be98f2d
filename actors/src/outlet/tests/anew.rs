//! A session begun anew: nothing of it goes out before the peer was told.

use std::future::Future;

use super::*;
use crate::session::Window;

const EPOCH: u64 = 7;

/// A connection on which a peer with this memory has said that it takes the first message next.
fn bench(memory: u64) -> Bench {
    let window = Window { messages: 64, bytes: PLENTY };
    let void = message(Class::Control, 0).header;
    let outlet = StreamOutlet::with_session(LIMITS, Session::new(EPOCH, window, void, None));
    let wire = Arc::new(Wire::default());
    wire.room.store(PLENTY, Ordering::Relaxed);
    let link = outlet.connect(wire.clone(), usize::MAX, None);
    let bench = Bench { outlet, wire, link, ledger: Arc::default() };
    assert!(!bench.hears(memory), "nothing was sent yet");
    bench
}

impl Bench {
    /// Returns whether a new epoch has begun.
    fn hears(&self, memory: u64) -> bool {
        let ack = Ack { memory, epoch: 1, of: 0, next: 1, change: 0, held: Vec::new(), room: None };
        self.outlet.heard(self.link, &ack, Time::now())
    }

    fn tells(&self, epoch: u64) -> bool {
        let mut ack = message(Class::Control, epoch as u8);
        ack.header.kind = Kind::GNCL_ACK;
        self.outlet.acknowledge(ack, self.link.number(), epoch)
    }
}

/// One message was sent to a peer that has forgotten it by the next connection.
fn forgotten() -> Bench {
    let mut bench = bench(1);
    bench.submit(message(Class::Bulk, 100));
    assert_eq!(bench.seen(), [100]);
    bench.reconnect(PLENTY);
    assert!(bench.hears(2), "it knows nothing of that message");
    bench
}

/// Counts how often it was woken.
#[derive(Default)]
struct Woken(AtomicUsize);

impl std::task::Wake for Woken {
    fn wake(self: Arc<Self>) {
        self.0.fetch_add(1, Ordering::Relaxed);
    }
}

/// An acknowledgement that finds the socket full goes out when it takes something again, in the drainer's hand.
#[test]
fn an_acknowledgement_that_the_socket_does_not_take_wakes_the_drainer() {
    let bench = bench(1);
    let woken = Arc::new(Woken::default());
    let waker = Waker::from(woken.clone());
    let mut drained = std::pin::pin!(bench.outlet.drain(bench.link));
    assert!(drained.as_mut().poll(&mut Context::from_waker(&waker)).is_pending());
    bench.wire.room.store(0, Ordering::Relaxed);
    assert!(bench.tells(EPOCH));
    assert_eq!(woken.0.load(Ordering::Relaxed), 1);
    bench.wire.room.store(PLENTY, Ordering::Relaxed);
    for _ in 0..2 {
        assert!(drained.as_mut().poll(&mut Context::from_waker(&waker)).is_pending());
    }
    assert_eq!(bench.seen(), [EPOCH as u8]);
}

// spec: SESSION-5
#[test]
fn what_is_sent_before_the_peer_is_told_waits_and_follows_the_word() {
    let bench = forgotten();
    bench.submit(message(Class::Bulk, 101));
    bench.drain();
    assert_eq!(bench.seen(), [0; 0], "the peer would count it in the epoch that is over, and take it again");
    assert!(bench.tells(EPOCH + 1));
    bench.drain();
    assert_eq!(bench.seen(), [EPOCH as u8 + 1, 101]);
}

#[test]
fn a_word_that_was_made_before_is_not_said() {
    let bench = forgotten();
    bench.submit(message(Class::Bulk, 101));
    assert!(!bench.tells(EPOCH), "another one is to be made");
    bench.drain();
    assert_eq!(bench.seen(), [0; 0]);
}

#[test]
fn nor_does_what_the_peer_says_of_the_former_epoch_let_anything_out() {
    let bench = forgotten();
    bench.submit(message(Class::Bulk, 101));
    assert!(!bench.hears(2), "it is no news");
    bench.drain();
    assert_eq!(bench.seen(), [0; 0]);
}

#[test]
fn the_next_connection_begins_with_the_epoch_and_needs_no_further_word() {
    let mut bench = forgotten();
    bench.submit(message(Class::Bulk, 101));
    bench.reconnect(PLENTY);
    assert!(!bench.hears(2));
    bench.drain();
    assert_eq!(bench.seen(), [101]);
}
