//! A sender that keeps a message for a full outlet is woken when the outlet has room.

use std::task::Wake;

use super::{
    outcomes::{bench as bench_of_outcomes, outcome},
    requests::session,
    *,
};

/// Counts how often its waker was woken.
#[derive(Default)]
struct WakeCounter(AtomicUsize);

impl Wake for WakeCounter {
    fn wake(self: Arc<Self>) {
        self.0.fetch_add(1, Ordering::Relaxed);
    }
}

fn waker() -> (Arc<WakeCounter>, Waker) {
    let woken = Arc::<WakeCounter>::default();
    (woken.clone(), Waker::from(woken))
}

#[test]
fn sender_is_woken_when_queue_is_half_empty() {
    let (bench, (woken, waker)) = (Bench::new(0), waker());
    (0..4).for_each(|value| bench.submit(message(Class::Bulk, value)));
    let refused = bench.outlet.offer(message(Class::Bulk, 4), Some(&waker)).unwrap_err();
    assert_eq!((refused.why, woken.0.load(Ordering::Relaxed)), (Rejection::QueueFull, 0));
    bench.make_room(PLENTY);
    assert_eq!((bench.seen().len(), woken.0.load(Ordering::Relaxed)), (4, 1));
    assert_eq!(bench.outlet.counts().refused, 0, "what is offered again is not refused");
}

#[test]
fn sender_of_confirmed_message_is_woken_by_outcomes() {
    let (bench, (woken, waker)) = (Bench::new(PLENTY), waker());
    (1..=4).for_each(|correlation| bench.submit(bench.confirmed(correlation)));
    // Nothing waits: there is room for all messages except a confirmed one.
    drop(bench.outlet.offer(bench.confirmed(5), Some(&waker)).unwrap_err());
    let after_each: Vec<_> = (1..=4)
        .map(|correlation| {
            let ticket = Ticket { source: tid(0), destination: tid(1), correlation };
            assert!(bench.outlet.confirm(ticket, Outcome::Delivered));
            woken.0.load(Ordering::Relaxed)
        })
        .collect();
    assert_eq!(after_each, [0, 1, 1, 1]);
}

#[test]
fn sender_is_woken_by_combined_outcomes() {
    // given: as many are open as may be
    let (mut bench, (woken, waker)) = (session(PLENTY), waker());
    for correlation in 1..=4 {
        let mut message = bench.confirmed(correlation);
        (message.header.sent, message.header.time_to_live_us) = (Time::now(), 3_000_000);
        bench.submit(message);
    }
    drop(bench.outlet.offer(bench.confirmed(5), Some(&waker)).unwrap_err());
    // when: none has arrived before a cut, and all have expired
    bench.outlet.disconnect(bench.link);
    bench.reconnect(PLENTY);
    let ack =
        Ack { receiver_id: 1, epoch: 1, peer_epoch: 1, next: 1, change: 1, held: Vec::new(), room: None };
    bench.outlet.on_ack(bench.link, &ack, Time::MAX);
    // then
    assert_eq!(bench.outcome_log.take().len(), 4 + 1, "the one that was kept ends here, too");
    assert_eq!(woken.0.load(Ordering::Relaxed), 1);
}

#[test]
fn sender_is_woken_when_outlet_ends() {
    let (bench, (woken, waker)) = (Bench::new(0), waker());
    (0..4).for_each(|value| bench.submit(message(Class::Bulk, value)));
    bench.outlet.offer(message(Class::Bulk, 4), Some(&waker)).unwrap_err();
    bench.outlet.close(Rejection::Closed);
    assert_eq!(woken.0.load(Ordering::Relaxed), 1);
}

#[test]
fn interrupted_value_replaces_no_waiting_one() {
    // Given: a value of which a part is written, and behind it as many others as may wait, and more.
    let mut bench = Bench::new(70);
    let value = |flow: u8| {
        let mut value = message(Class::Stream, flow);
        value.header.destination = tid(flow.into());
        value
    };
    (1..=5).for_each(|flow| bench.submit(value(flow)));
    for number in 6..=10 {
        bench.outlet.submit_beyond(message(Class::Control, number)).unwrap();
    }
    bench.outlet.disconnect(bench.link);
    bench.reconnect(PLENTY);
    let mut seen = bench.seen();
    seen.sort_unstable();
    assert_eq!(seen, (1..=10).collect::<Vec<u8>>());
    let counts = OutletCounts { sent: 10, ..OutletCounts::default() };
    assert_eq!(bench.outlet.counts(), counts);
    // And: of two values of one flow the newer one.
    let mut bench = Bench::new(70);
    bench.submit(value(1));
    bench.submit(value(1));
    bench.outlet.disconnect(bench.link);
    bench.reconnect(PLENTY);
    assert_eq!(bench.outlet.counts(), OutletCounts { sent: 1, superseded: 1, ..OutletCounts::default() });
}

#[test]
fn all_senders_are_woken_together() {
    let (bench, senders) = (Bench::new(PLENTY), [waker(), waker()]);
    let times = || senders.iter().map(|(woken, _)| woken.0.load(Ordering::Relaxed)).collect::<Vec<_>>();
    // Both bounds: that of messages without an outcome, and that of the queue.
    (1..=4).for_each(|correlation| bench.submit(bench.confirmed(correlation)));
    for (_, waker) in &senders {
        drop(bench.outlet.offer(bench.confirmed(5), Some(waker)).unwrap_err());
    }
    for correlation in 1..=4 {
        bench.outlet.confirm(Ticket { source: tid(0), destination: tid(1), correlation }, Outcome::Delivered);
    }
    assert_eq!(times(), [1; 2]);
    bench.wire.room.store(0, Ordering::Relaxed);
    (0..4).for_each(|value| bench.submit(message(Class::Bulk, value)));
    for (_, waker) in &senders {
        bench.outlet.offer(message(Class::Bulk, 4), Some(waker)).unwrap_err();
    }
    bench.make_room(PLENTY);
    assert_eq!(times(), [2; 2]);
}

#[test]
fn sender_is_woken_when_queued_messages_expire() {
    let (bench, (woken, waker)) = (Bench::new(0), waker());
    (0..4).for_each(|value| bench.submit(expiring(Class::Bulk, value)));
    bench.outlet.offer(message(Class::Bulk, 4), Some(&waker)).unwrap_err();
    bench.outlet.expire(Time::now() + Duration::from_secs(61));
    assert_eq!(woken.0.load(Ordering::Relaxed), 1);
}

#[test]
fn sender_is_woken_when_combined_outcomes_leave_the_queue() {
    // Given: a queue that outcomes have filled, which leave together. Without the first one it is not half empty.
    let (bench, (woken, waker)) = (bench_of_outcomes(Some(Kind::GNCL_OUTCOMES), usize::MAX), waker());
    (1..=4).for_each(|correlation| bench.submit(outcome(correlation)));
    let refused = bench.outlet.offer(message(Class::Control, 5), Some(&waker)).unwrap_err();
    assert_eq!((refused.why, woken.0.load(Ordering::Relaxed)), (Rejection::QueueFull, 0));
    // When, then
    bench.make_room(PLENTY);
    assert_eq!(frames(&bench.wire.bytes.lock().unwrap()).len(), 1);
    assert_eq!(woken.0.load(Ordering::Relaxed), 1);
}

/// Receives the peer's announcement, of this number, that these destinations are held.
fn hold(bench: &Bench, change: u64, held: Vec<u64>) {
    let ack = Ack { receiver_id: 1, epoch: 1, peer_epoch: 1, next: 1, change, held, room: None };
    bench.outlet.on_ack(bench.link, &ack, Time::now());
}

// spec: CREDIT-3
#[test]
fn sender_for_a_held_destination_waits_for_its_release() {
    // Given: a held destination with as many messages as may wait for it. The queue itself is empty.
    let (bench, (woken, waker)) = (session(PLENTY), waker());
    let key = backlog_key(&message(Class::Bulk, 0).header).expect("it is for a mailbox");
    hold(&bench, 2, vec![key]);
    let taken = (0..=u8::MAX).take_while(|value| bench.outlet.submit(message(Class::Bulk, *value)).is_ok());
    assert_eq!(taken.count(), bench.outlet.in_backlog());
    // When, then: the sender waits, also after an announcement without a change.
    let refused = bench.outlet.offer(message(Class::Bulk, 0), Some(&waker)).unwrap_err();
    hold(&bench, 2, vec![key]);
    assert_eq!((refused.why, woken.0.load(Ordering::Relaxed)), (Rejection::QueueFull, 0));
    hold(&bench, 3, Vec::new());
    assert_eq!(woken.0.load(Ordering::Relaxed), 1);
    // And: the released messages fill the queue until they are written.
    let refused = bench.outlet.offer(refused.message, Some(&waker)).unwrap_err();
    assert_eq!((refused.why, woken.0.load(Ordering::Relaxed)), (Rejection::QueueFull, 1));
    bench.drain();
    assert_eq!(woken.0.load(Ordering::Relaxed), 2);
    bench.outlet.offer(refused.message, Some(&waker)).expect("it has room");
}
