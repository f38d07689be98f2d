//! A peer that holds many destinations, all at once or one after the other, with senders that fill all
//! queues. The waiting messages are bounded in total, accepted ones are sent once and in order, and messages
//! to other destinations are always accepted. spec: CREDIT-4

use std::collections::BTreeMap;

use super::*;
use crate::Window;

const MANY: OutletLimits =
    OutletLimits { queue_capacity: 200, queue_bytes: 1 << 20, unconfirmed_max: 4, payload_max: 10_000 };
const WINDOW: Window = Window { messages: 200, bytes: PLENTY };
/// Maximum number of waiting messages: the contents of the lines, three times a queue's maximum, and two
/// messages that started within their bounds. Each of 256 lines adds the minimum that a queue accepts in any
/// case.
const MESSAGES: usize = WINDOW.messages + 3 * MANY.queue_capacity + 256;
const BYTES: usize = (4 << 20) + 3 * MANY.queue_bytes + 256 * (4 << 10) + 2 * MANY.payload_max;
/// An application that is never held.
const OTHER: u32 = 0;

struct World {
    bench: Bench,
    change: u64,
    submitted: u64,
    /// The accepted messages for each application, in this order.
    taken: BTreeMap<u32, Vec<u64>>,
}

impl World {
    fn new() -> Self {
        let void = message(Class::Control, 0).header;
        let outlet = SocketWriter::with_session(MANY, Session::new(1, WINDOW, void, None));
        let wire = Arc::new(Wire::default());
        let link = outlet.connect(wire.clone(), usize::MAX, None);
        let bench = Bench { outlet, wire, link, outcome_log: Arc::default() };
        let mut world = Self { bench, change: 0, submitted: 0, taken: BTreeMap::new() };
        world.hold([]);
        world
    }

    /// Sends; returns whether it was taken.
    fn send(&mut self, to: u32, payload: &Bytes) -> bool {
        self.submitted += 1;
        let mut header = message(Class::Control, 0).header;
        (header.destination, header.sequence) = (tid(to), self.submitted);
        match self.bench.outlet.submit(Message::new(header, payload.clone())) {
            Ok(()) => self.taken.entry(to).or_default().push(self.submitted),
            Err(refused) => assert_eq!(refused.why, Rejection::QueueFull),
        }
        self.taken.get(&to).and_then(|taken| taken.last()) == Some(&self.submitted)
    }

    /// Sends until no more is taken.
    fn fill(&mut self, to: u32, payload: &Bytes) {
        while self.send(to, payload) {}
        let waiting = self.bench.outlet.waiting();
        assert!(waiting <= MESSAGES, "{waiting} messages wait at application {to}");
        let bytes = waiting * payload.len();
        assert!(bytes <= BYTES, "{bytes} bytes wait at application {to}");
    }

    /// The peer has taken all that was written, and holds these.
    fn hold(&mut self, held: impl IntoIterator<Item = u32>) {
        self.change += 1;
        let held = held.into_iter().map(|to| tid(to).app.bits().into()).collect();
        let next = 1 + self.bench.outlet.counts().sent;
        let ack =
            Ack { receiver_id: 1, epoch: 1, peer_epoch: 1, next, change: self.change, held, room: None };
        self.bench.outlet.on_ack(self.bench.link, &ack, Time::now());
    }

    /// The wire accepts for a moment all messages that may be sent.
    fn write(&self) {
        self.bench.make_room(PLENTY);
        self.bench.wire.room.store(0, Ordering::Relaxed);
    }

    /// No destination is held any more, and all accepted messages are sent.
    fn end(mut self) {
        while self.bench.outlet.waiting() > 0 {
            let before = self.bench.outlet.waiting();
            self.hold([]);
            self.write();
            assert!(self.bench.outlet.waiting() < before, "{before} wait forever");
        }
        let mut seen = BTreeMap::<u32, Vec<u64>>::new();
        for Message { header, .. } in frames(&self.bench.wire.bytes.lock().unwrap()) {
            let to = header.destination.app.bits() - tid(0).app.bits();
            seen.entry(to).or_default().push(header.sequence);
        }
        assert_eq!(seen, self.taken);
    }
}

/// Short ones use the messages up, long ones the bytes.
fn payloads() -> [Bytes; 2] {
    [10, MANY.payload_max].map(|length| vec![7; length].into())
}

#[test]
fn full_held_destinations_share_one_bound() {
    for payload in payloads() {
        let mut world = World::new();
        for number in 1..=256 {
            world.fill(number, &payload);
            world.hold(1..=number);
            assert!(world.send(OTHER, &payloads()[0]), "{number} are held, and another one is not sent to");
            world.write();
        }
        assert_eq!(world.taken[&OTHER].len(), 256);
        world.end();
    }
}

#[test]
fn reader_gets_long_messages_beside_many_held_ones() {
    let long = &payloads()[1];
    let mut world = World::new();
    for number in 1..=64 {
        world.fill(number, long);
        world.hold(1..=number);
        assert!(world.send(OTHER, long), "{number} are held, and another one is sent nothing long");
        world.write();
    }
    assert_eq!(world.taken[&OTHER].len(), 64);
    world.end();
}

/// Submits `count` waiting outcomes, which go into no line.
fn send_outcomes(world: &World, count: usize) {
    for correlation in 0..count {
        let (source, destination) = (tid(OTHER), tid(1));
        let ticket = Ticket { source, destination, correlation: correlation as u64 };
        world.bench.outlet.submit_beyond(Message::outcome(ticket, Outcome::Delivered)).unwrap();
    }
}

#[test]
fn waiting_outcomes_use_no_room_of_others() {
    let short = &payloads()[0];
    let mut world = World::new();
    for number in 1..=64 {
        world.fill(number, short);
        world.hold(1..=number);
        world.write();
    }
    world.fill(OTHER, short);
    assert_eq!(world.taken[&OTHER].len(), 1, "lines leave the queue no more than its least");
    world.write();
    // The queue's own bound has room for that.
    send_outcomes(&world, MANY.queue_capacity / 2);
    assert!(world.send(OTHER, short), "outcomes are all that waits, and another one is not sent to");
}

#[test]
fn waiting_outcomes_use_no_room_of_held_line() {
    let mut world = World::new();
    world.hold([1]);
    send_outcomes(&world, 3 * MANY.queue_capacity + 1);
    assert!(world.send(1, &payloads()[0]), "a line in which nothing waits takes nothing");
}

#[test]
fn successively_held_destinations_leave_no_lines() {
    for payload in payloads() {
        let mut world = World::new();
        for number in 1..=300 {
            world.hold([number]);
            world.fill(number, &payload);
        }
        world.end();
    }
}
