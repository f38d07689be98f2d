//! A stopped client fills only its own queues.

use rustix::process::Signal;
use sinew::{Class, Endpoint, NodeApi, Payload, Registration, message::Kind, prelude::*};
use sinew_testkit::NodeProcess;
use sinew_testkit::Resources;
use sinew_testkit::{
    DEADLINE, Log,
    scripted::{Job, Order, Value},
    until,
};
use sinew_tests::clients::{FixtureLimits, NodeFixture, Window};

const CAPACITY: usize = 64;
/// Number of messages of each class that are sent to the stopped client: more than socket, ring and queue
/// hold.
const ROUNDS: u64 = 4_000;
/// Memory that the node may hold for it: three full queues of small messages, and as much again for their
/// slots.
const BOUND_KIB: u64 = 3 * CAPACITY as u64 + 2 * 1024;

struct Scene {
    fixture: NodeFixture,
    others: [NodeProcess; 2],
    stopped: NodeProcess,
    /// Messages that the stopped client received.
    got: Log<(String, u64)>,
    sender: Endpoint,
    to: Tid,
}

/// Starts a process, and returns when it is up.
fn up(
    fixture: &NodeFixture,
    role: &str,
    arguments: &[&str],
    take: impl FnMut(&str) -> bool + Send + 'static,
) -> NodeProcess {
    let mut process = fixture.start_with(role, arguments, take);
    process.expect("up");
    process
}

impl Scene {
    fn new() -> Self {
        let limits = FixtureLimits { mailbox_capacity: CAPACITY, payload_max: 64 * 1024, clients_max: 16 };
        let fixture = NodeFixture::new(limits);
        let echo = up(&fixture, "taker", &["echo"], |_| false);
        let pinger = up(&fixture, "pinger", &[], |_| false);
        let got: Log<(String, u64)> = Log::default();
        let recorded = got.clone();
        let stopped = up(&fixture, "recorder", &["stopped"], move |line| {
            // All lines but the first one.
            let Some((class, number)) = line.split_once(' ') else { return false };
            recorded.write((class.to_owned(), number.parse().expect("a number")));
            true
        });
        let api = NodeApi::connect(fixture.socket()).expect("the door is open");
        // The node accepts every message, and rejects it itself. A sender that gave up at its own full ring
        // would leave gaps in the numbers. It might also not send the newest value while the node is late.
        let registration = Registration::new().stall_timeout(DEADLINE);
        let mut sender = api.register_transport_address(registration).expect("an address");
        let to = sender.resolve("stopped", DEADLINE).expect("the node answers").expect("it is registered");
        Self { fixture, others: [echo, pinger], stopped, got, sender, to }
    }

    /// Collects round trips of the other clients from now on, until there were some. A window is as short as
    /// the requester is fast.
    fn others_flow(&mut self) -> Window {
        self.others[1].ask("window");
        let mut flowed = Window::default();
        until("round trips of the others", || {
            let window = Window::read(&self.others[1].ask("window"));
            flowed.count += window.count;
            flowed.failed += window.failed;
            (flowed.count >= 20).then_some(flowed)
        })
    }

    fn numbers(&self, class: &str) -> Vec<u64> {
        self.got.all().into_iter().filter(|(of, _)| of == class).map(|(_, number)| number).collect()
    }

    fn wait_for(&self, class: &str, number: u64) {
        self.got.wait_for((class.to_owned(), number));
    }

    fn send<P: Payload>(&mut self, value: &P) {
        self.sender.send(self.to, value).expect("the node takes it, and passes it on or refuses it");
    }

    /// Checks that it is rejected at once, and that the sender is notified.
    fn assert_full<P: Payload>(&mut self, value: &P) {
        let outcome = self.sender.message(self.to, value).confirmed(DEADLINE).expect("the node answers");
        assert_eq!(
            outcome,
            Outcome::Rejected(sinew::message::Rejection::QueueFull),
            "{} to a full queue",
            P::NAME
        );
    }

    /// Sends until it is handled, so there is room again.
    fn send_until_delivered<P: Payload>(&mut self, value: &P) {
        until("it is delivered", || match self.sender.message(self.to, value).confirmed(DEADLINE) {
            Ok(Outcome::Delivered) => Some(()),
            Ok(Outcome::Rejected(sinew::message::Rejection::QueueFull)) => None,
            other => panic!("it ends as {other:?}"),
        });
    }

    fn end(self) {
        let Self { fixture, others: [echo, pinger], stopped, .. } = self;
        for process in [pinger, echo, stopped] {
            assert!(process.stop().success());
        }
        fixture.end();
    }
}

/// Whether the numbers are 1, 2, 3 and so on, without a gap.
fn is_unbroken(numbers: &[u64]) -> bool {
    numbers.iter().copied().eq(1..=numbers.len() as u64)
}

#[test]
fn stopped_client_fills_its_queues_and_resumes_per_class() {
    // Given: one stopped client, and a pair of others.
    let mut scene = Scene::new();
    let before = Resources::of(scene.fixture.node().id());
    scene.stopped.pause();

    // When: more is sent to it than there is room for.
    for number in 1..=ROUNDS {
        scene.send(&Job { number });
        scene.send(&Value { number });
        scene.send(&Order { number });
    }

    // Then: senders of confirmed messages are notified, the others are served, and the node holds no more
    // than its bound.
    scene.assert_full(&Job { number: ROUNDS + 1 });
    scene.assert_full(&Order { number: ROUNDS + 1 });
    let window = scene.others_flow();
    assert_eq!(window.failed, 0, "{window}");
    let held = Resources::of(scene.fixture.node().id());
    let grown = held.own_kib.saturating_sub(before.own_kib);
    assert!(grown <= BOUND_KIB, "the node has grown by {grown} KiB of {BOUND_KIB}: {held}");
    assert_eq!(scene.got.all().len(), 0, "it is stopped");

    // And: when it continues, it receives the oldest ordered messages and the newest value.
    scene.stopped.signal(Signal::CONT);
    scene.wait_for("stream", ROUNDS);
    scene.send_until_delivered(&Order { number: ROUNDS + 2 });
    scene.send_until_delivered(&Job { number: ROUNDS + 2 });
    // It reports a message before it settles it, but through a pipe with a reader of its own.
    scene.wait_for("control", ROUNDS + 2);
    scene.wait_for("bulk", ROUNDS + 2);
    let [mut control, stream, mut bulk] = ["control", "stream", "bulk"].map(|class| scene.numbers(class));
    assert_eq!([control.pop(), bulk.pop()], [Some(ROUNDS + 2); 2]);
    assert!(is_unbroken(&control) && is_unbroken(&bulk), "the oldest, in order: {control:?} {bulk:?}");
    assert!(control.len() >= CAPACITY && bulk.len() >= CAPACITY, "{} {}", control.len(), bulk.len());
    assert!(stream.is_sorted() && stream.last() == Some(&ROUNDS), "the newest is the last: {stream:?}");
    assert!(stream.len() < ROUNDS as usize, "a newer value takes the place of one that waits");
    let all = scene.got.all();
    let place = |class: &str, number| all.iter().position(|(of, one)| of == class && *one == number);
    let last_control = place("control", control.len() as u64);
    assert!(last_control < place("bulk", bulk.len() as u64), "Control goes ahead of Bulk where both wait");
    scene.end();
}

/// The longest payload with the default configuration.
const LONG: usize = 1 << 20;
/// `node.mailbox_bytes` with the default configuration, in messages of that length: the queue of one client,
/// for each class.
const LONG_WAIT: u64 = 4;
/// Memory that stays in any case: two buffers of the receiving thread, four rings, and 1 MiB for all else.
const LONG_KEPT_KIB: u64 = 2 * 1_024 + 4 * 260 + 1_024;
/// Bound for one client that does not read: the queued messages of each class, one partly written message,
/// one partly received message of the sender, and the memory that stays.
const LONG_BOUND_KIB: u64 = (3 * LONG_WAIT + 1 + 1) * 1_028 + LONG_KEPT_KIB;
const LONG_ROUNDS: u64 = 256;

#[test]
fn stopped_client_costs_bounded_memory_that_is_freed() {
    // Given: a node with the default bounds, one stopped client, and one that sends.
    let limits = FixtureLimits { mailbox_capacity: 256, payload_max: LONG, clients_max: 16 };
    let fixture = NodeFixture::that_gives_back(limits);
    let mut stopped = up(&fixture, "recorder", &["stopped"], |_| false);
    let api = NodeApi::connect(fixture.socket()).expect("the door is open");
    let mut sender = api.register_transport_address(Registration::new()).expect("an address");
    let to = sender.resolve("stopped", DEADLINE).expect("the node answers").expect("it is registered");
    let before = Resources::of(fixture.node().id());
    stopped.pause();

    // When: as many of the longest messages are sent to it as may wait by number.
    let mut most = 0;
    for number in 1..=LONG_ROUNDS {
        for class in [Class::Control, Class::Stream, Class::Bulk] {
            // Each value has a kind of its own, so that none replaces another.
            let kind = Kind::named(&format!("scenario.load.{number}"));
            let mut message = sender.create_message(to, kind, LONG).expect("the longest there may be");
            message.set_class(class);
            message[..8].copy_from_slice(&number.to_le_bytes());
            sender.loaned(message).send().expect("the node takes it, and passes it on or refuses it");
        }
        most = most.max(Resources::of(fixture.node().id()).own_kib.saturating_sub(before.own_kib));
    }

    // Then: the node holds no more than the bound, and senders of confirmed messages are notified.
    assert!(most <= LONG_BOUND_KIB, "the node has grown by {most} KiB of {LONG_BOUND_KIB}");
    assert!(most >= LONG_WAIT * 1_024, "it did hold what it may: {most} KiB");
    let refused = sender.create_message(to, Kind::named("scenario.load"), LONG).expect("as above");
    let outcome = sender.loaned(refused).confirmed(DEADLINE).expect("it is sent");
    assert_eq!(outcome, Outcome::Rejected(sinew::message::Rejection::QueueFull));

    // And: when it continues, it receives the queued messages, and the memory is freed.
    stopped.signal(Signal::CONT);
    let is_load = |line: &&String| line.starts_with("load");
    until("what waited for it has come", || {
        let loads = stopped.poll_output().iter().filter(is_load).count();
        (loads as u64 >= 3 * LONG_WAIT).then_some(())
    });
    let mut left = 0;
    until("the memory is given back", || {
        left = Resources::of(fixture.node().id()).own_kib.saturating_sub(before.own_kib);
        (left <= LONG_KEPT_KIB).then_some(())
    });
    println!("grown by {most} KiB at most, by {left} KiB after it");
    assert!(stopped.stop().success());
    fixture.end();
}
