//! A destination that never sends its outcomes leaves the others room for theirs, for every size of the
//! peer's room and in every queue.

use super::*;
use crate::Window;

/// A queue that is longer than all the room of some peers.
const LONG: OutletLimits =
    OutletLimits { queue_capacity: 64, queue_bytes: 1 << 20, unconfirmed_max: 64, payload_max: 1_000 };
const NONE_HELD: &[u32] = &[];
const STUCK: u32 = 1;
const OTHER: u32 = 2;

/// An outlet with a wire of `room` bytes, and with a peer that has room for `outcome_room` answers.
fn bench(limits: OutletLimits, outcome_room: usize, room: usize) -> Bench {
    let void = Header::new(Kind::GNCL_VOID, tid(0), tid(1));
    let window = Window { messages: 64, bytes: PLENTY };
    let session = Session::new(1, window, void, None).answered_up_to(outcome_room);
    let outlet = SocketWriter::with_session(limits, session);
    let wire = Arc::new(Wire::default());
    wire.room.store(room, Ordering::Relaxed);
    let link = outlet.connect(wire.clone(), usize::MAX, None);
    let bench = Bench { outlet, wire, link, outcome_log: Arc::default() };
    receive_ack(&bench, 1, NONE_HELD);
    bench
}

/// The peer holds these.
fn receive_ack(bench: &Bench, change: u64, held: &[u32]) {
    let held = held.iter().map(|to| tid(*to).app.bits().into()).collect();
    let ack = Ack { receiver_id: 1, epoch: 1, peer_epoch: 1, next: 1, change, held, room: None };
    bench.outlet.on_ack(bench.link, &ack, Time::now());
}

fn ticket(to: u32, correlation: u64) -> Ticket {
    Ticket { source: tid(0), destination: tid(to), correlation }
}

fn confirmed(bench: &Bench, to: u32, correlation: u64) -> Message {
    let mut message = message(Class::Control, 0);
    (message.header.destination, message.header.correlation) = (tid(to), correlation);
    message.receipt = Some(Receipt::new(bench.outcome_log.clone(), ticket(to, correlation)));
    message
}

/// Sends confirmed messages, numbered from `first`, until one is refused; returns the number of accepted
/// ones.
fn fill(bench: &Bench, to: u32, first: u64) -> u64 {
    let is_refused = |taken: &u64| bench.outlet.submit(confirmed(bench, to, first + taken)).is_err();
    (0..1_000).find(is_refused).expect("it is bounded")
}

#[test]
fn silent_destination_is_limited_to_its_share() {
    // Given: a queue of 64, and a peer with room for 16 answers. Messages for the stuck destination are sent,
    // wait in the queue, or wait in its line.
    for (room, held) in [(PLENTY, NONE_HELD), (0, NONE_HELD), (PLENTY, &[STUCK])] {
        let bench = bench(LONG, 16, room);
        receive_ack(&bench, 2, held);
        // When
        assert_eq!(fill(&bench, STUCK, 0), 2, "{room} bytes, {held:?} held");
        bench.submit(confirmed(&bench, OTHER, 100));
        // Then
        bench.make_room(PLENTY);
        assert!(bench.outlet.confirm(ticket(OTHER, 100), Outcome::Delivered));
        assert!(bench.outcome_log.take().contains(&(100, Outcome::Delivered)));
        assert_eq!(bench.outlet.unconfirmed(), 2);
        assert_eq!(fill(&bench, STUCK, 200), 0, "it has its share still");
    }
}

#[test]
fn share_is_released_by_outcome_or_expiry() {
    let bench = bench(LONG, 16, 0);
    for correlation in 0..2 {
        let mut message = confirmed(&bench, STUCK, correlation);
        (message.header.sent, message.header.time_to_live_us) = (Time::now(), 60_000_000);
        bench.submit(message);
    }
    assert_eq!(fill(&bench, STUCK, 10), 0);
    bench.outlet.expire(Time::MAX);
    assert_eq!((bench.outlet.unconfirmed(), fill(&bench, STUCK, 20)), (0, 2));
    bench.make_room(PLENTY);
    assert!(bench.outlet.confirm(ticket(STUCK, 20), Outcome::Delivered));
    assert_eq!((fill(&bench, STUCK, 30), bench.outlet.unconfirmed()), (1, 2));
}

#[test]
fn large_peer_room_limits_waiting_messages_only_in_total() {
    let bench = bench(LONG, 8 * LONG.unconfirmed_max, PLENTY);
    for correlation in 0..2 {
        bench.submit(confirmed(&bench, STUCK, correlation));
    }
    bench.wire.room.store(0, Ordering::Relaxed);
    assert_eq!(fill(&bench, STUCK, 2), LONG.queue_capacity as u64, "the queue is the bound");
    bench.make_room(PLENTY);
    assert_eq!(fill(&bench, STUCK, 100), 0, "as many were sent as may be of one");
}

#[test]
fn outcomes_wake_senders_of_their_destination() {
    struct WakeCounter(AtomicUsize);
    impl std::task::Wake for WakeCounter {
        fn wake(self: Arc<Self>) {
            self.0.fetch_add(1, Ordering::Relaxed);
        }
    }
    // The share is proportional, also if the peer has less room.
    for (limits, answers, share) in [(LIMITS, 32, 4), (LONG, 32, 4)] {
        let bench = bench(limits, answers, PLENTY);
        let woken = Arc::new(WakeCounter(AtomicUsize::new(0)));
        assert_eq!((fill(&bench, STUCK, 0), fill(&bench, OTHER, 100)), (share, share));
        let waker = Waker::from(woken.clone());
        drop(bench.outlet.offer(confirmed(&bench, OTHER, 200), Some(&waker)).unwrap_err());
        let after_each: Vec<_> = (0..share)
            .map(|sent| {
                assert!(bench.outlet.confirm(ticket(OTHER, 100 + sent), Outcome::Delivered));
                woken.0.load(Ordering::Relaxed)
            })
            .collect();
        assert_eq!(after_each, [0, 1, 1, 1], "{answers} answers there");
    }
}
