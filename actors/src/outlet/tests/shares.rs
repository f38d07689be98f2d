//! One destination that owes outcomes for ever leaves the others room for theirs, however small the peer's is and wherever they wait.

use super::*;
use crate::session::Window;

/// A queue that is longer than all the room of some peers.
const LONG: OutletLimits =
    OutletLimits { queue_capacity: 64, queue_bytes: 1 << 20, unconfirmed_max: 64, payload_max: 1_000 };
const NOBODY: &[u32] = &[];
const STUCK: u32 = 1;
const OTHER: u32 = 2;

/// An outlet whose wire takes `room` bytes, and whose peer has room for so many answers.
fn bench(limits: OutletLimits, answers_there: usize, room: usize) -> Bench {
    let void = Header::new(Kind::GNCL_VOID, tid(0), tid(1));
    let window = Window { messages: 64, bytes: PLENTY };
    let session = Session::new(1, window, void, None).answered_up_to(answers_there);
    let outlet = StreamOutlet::with_session(limits, session);
    let wire = Arc::new(Wire::default());
    wire.room.store(room, Ordering::Relaxed);
    let link = outlet.connect(wire.clone(), usize::MAX, None);
    let bench = Bench { outlet, wire, link, ledger: Arc::default() };
    hear(&bench, 1, NOBODY);
    bench
}

/// The peer holds these.
fn hear(bench: &Bench, change: u64, held: &[u32]) {
    let held = held.iter().map(|to| tid(*to).app.bits().into()).collect();
    let ack = Ack { memory: 1, epoch: 1, of: 1, next: 1, change, held, room: None };
    bench.outlet.heard(bench.link, &ack, Time::now());
}

fn ticket(to: u32, correlation: u64) -> Ticket {
    Ticket { source: tid(0), destination: tid(to), correlation }
}

fn confirmed(bench: &Bench, to: u32, correlation: u64) -> Message {
    let mut message = message(Class::Control, 0);
    (message.header.destination, message.header.correlation) = (tid(to), correlation);
    message.receipt = Some(Receipt::new(bench.ledger.clone(), ticket(to, correlation)));
    message
}

/// Sends confirmed messages, numbered from `first`, until one is refused; returns how many were taken.
fn fill(bench: &Bench, to: u32, first: u64) -> u64 {
    let is_refused = |taken: &u64| bench.outlet.submit(confirmed(bench, to, first + taken)).is_err();
    (0..1_000).find(is_refused).expect("it is bounded")
}

#[test]
fn one_that_never_answers_has_its_share_of_a_small_peers_room_and_another_one_its_outcome() {
    // Given a queue of 64, and a peer with room for 16 answers. What is for the stuck one is sent, waits in the queue, or in its line.
    for (room, held) in [(PLENTY, NOBODY), (0, NOBODY), (PLENTY, &[STUCK])] {
        let bench = bench(LONG, 16, room);
        hear(&bench, 2, held);
        // When
        assert_eq!(fill(&bench, STUCK, 0), 2, "{room} bytes, {held:?} held");
        bench.submit(confirmed(&bench, OTHER, 100));
        // Then
        bench.make_room(PLENTY);
        assert!(bench.outlet.confirm(ticket(OTHER, 100), Outcome::Delivered));
        assert!(bench.ledger.take().contains(&(100, Outcome::Delivered)));
        assert_eq!(bench.outlet.unconfirmed(), 2);
        assert_eq!(fill(&bench, STUCK, 200), 0, "it has its share still");
    }
}

#[test]
fn what_waited_leaves_its_place_in_the_share_when_it_is_sent_and_answered_or_expires() {
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
fn where_the_peer_has_room_for_eight_times_the_bound_what_waits_counts_for_all_alone() {
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
fn who_keeps_a_message_for_one_is_woken_by_that_ones_outcomes_though_another_never_answers() {
    struct Woken(AtomicUsize);
    impl std::task::Wake for Woken {
        fn wake(self: Arc<Self>) {
            self.0.fetch_add(1, Ordering::Relaxed);
        }
    }
    // In proportion, and where the peer has less room than that.
    for (limits, answers, share) in [(LIMITS, 32, 4), (LONG, 32, 4)] {
        let bench = bench(limits, answers, PLENTY);
        let woken = Arc::new(Woken(AtomicUsize::new(0)));
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
