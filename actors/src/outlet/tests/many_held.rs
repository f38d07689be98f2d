//! A peer that holds many, all at once or one after the other, whose senders fill all that there is: what waits is bounded all together, what
//! was taken goes out once and in order, and what is for others is taken all the while. spec: CREDIT-4

use std::collections::BTreeMap;

use super::*;
use crate::session::Window;

const MANY: OutletLimits =
    OutletLimits { queue_capacity: 200, queue_bytes: 1 << 20, unconfirmed_max: 4, payload_max: 10_000 };
const WINDOW: Window = Window { messages: 200, bytes: PLENTY };
/// What may wait at most: what lines may hold, three times what a queue may, for each of 256 lines the least that a queue takes in any case, and
/// two messages that began within their bounds.
const MESSAGES: usize = WINDOW.messages + 3 * MANY.queue_capacity + 256;
const BYTES: usize = (4 << 20) + 3 * MANY.queue_bytes + 256 * (4 << 10) + 2 * MANY.payload_max;
/// An application that is never held.
const OTHER: u32 = 0;

struct World {
    bench: Bench,
    change: u64,
    submitted: u64,
    /// What was taken of each application's, in this order.
    taken: BTreeMap<u32, Vec<u64>>,
}

impl World {
    fn new() -> Self {
        let void = message(Class::Control, 0).header;
        let outlet = StreamOutlet::with_session(MANY, Session::new(1, WINDOW, void, None));
        let wire = Arc::new(Wire::default());
        let link = outlet.connect(wire.clone(), usize::MAX, None);
        let bench = Bench { outlet, wire, link, ledger: Arc::default() };
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
        let ack = Ack { memory: 1, epoch: 1, of: 1, next, change: self.change, held, room: None };
        self.bench.outlet.heard(self.bench.link, &ack, Time::now());
    }

    /// The wire takes for a moment what may be sent.
    fn write(&self) {
        self.bench.make_room(PLENTY);
        self.bench.wire.room.store(0, Ordering::Relaxed);
    }

    /// Nobody is held any more, and all that was taken goes out.
    fn end(mut self) {
        while self.bench.outlet.waiting() > 0 {
            let before = self.bench.outlet.waiting();
            self.hold([]);
            self.write();
            assert!(self.bench.outlet.waiting() < before, "{before} wait for ever");
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
fn many_that_are_held_after_each_has_filled_the_queue_hold_no_queue_each() {
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
fn one_that_takes_is_sent_long_messages_beside_many_that_are_held_after_each_has_filled_the_queue() {
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

/// So many outcomes wait, which go into no line.
fn say_outcomes(world: &World, count: usize) {
    for correlation in 0..count {
        let (source, destination) = (tid(OTHER), tid(1));
        let ticket = Ticket { source, destination, correlation: correlation as u64 };
        world.bench.outlet.submit_beyond(Message::outcome(ticket, Outcome::Delivered)).unwrap();
    }
}

#[test]
fn outcomes_that_wait_take_no_room_from_what_is_for_others() {
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
    say_outcomes(&world, MANY.queue_capacity / 2);
    assert!(world.send(OTHER, short), "outcomes are all that waits, and another one is not sent to");
}

#[test]
fn outcomes_that_wait_take_no_room_from_the_line_of_one_that_is_held() {
    let mut world = World::new();
    world.hold([1]);
    say_outcomes(&world, 3 * MANY.queue_capacity + 1);
    assert!(world.send(1, &payloads()[0]), "a line in which nothing waits takes nothing");
}

#[test]
fn many_that_are_held_one_after_the_other_leave_no_line_each_in_the_queue() {
    for payload in payloads() {
        let mut world = World::new();
        for number in 1..=300 {
            world.hold([number]);
            world.fill(number, &payload);
        }
        world.end();
    }
}
