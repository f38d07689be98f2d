//! A client that is stopped only fills what is its own.

use rustix::process::Signal;
use sinew::{Class, Endpoint, NodeApi, Payload, Registration, message::Kind, prelude::*};
use sinew_tests::{
    DEADLINE, Log,
    clients::{Held, Performer, Stage, StageLimits, Window},
    program,
    puppet::{Job, Order, Value},
    until,
};

const CAPACITY: usize = 64;
/// So many of each class are sent to the one that is stopped: more than socket, ring and queue hold.
const ROUNDS: u64 = 4_000;
/// What the node may hold for it: three full queues of small messages, and as much again for their places in memory.
const BOUND_KIB: u64 = 3 * CAPACITY as u64 + 2 * 1024;

struct Scene {
    stage: Stage,
    others: [Performer; 2],
    stopped: Performer,
    /// Round trips of the others.
    windows: Log<Window>,
    /// What the one that was stopped got.
    got: Log<(String, u64)>,
    sender: Endpoint,
    to: Tid,
}

impl Scene {
    fn new() -> Self {
        let limits = StageLimits { mailbox_capacity: CAPACITY, payload_max: 64 * 1024, clients_max: 16 };
        let stage = Stage::new(&program("client_kills"), limits);
        let (ups, windows, got) = (Log::default(), Log::default(), Log::default());
        let up = |role: &str, arguments: &[&str], count: usize, hear: Box<dyn Fn(&str) + Send>| {
            let arguments: Vec<_> = arguments.iter().map(|&argument| argument.to_owned()).collect();
            let says = ups.clone();
            let performer = stage
                .start(role, &arguments, move |line| if line == "up" { says.write(()) } else { hear(line) });
            ups.wait_for_many((), count);
            performer
        };
        let echo = up("taker", &["echo"], 1, Box::new(|_| {}));
        let measured: Log<Window> = windows.clone();
        let pinger = up("pinger", &[], 2, Box::new(move |line| measured.write(Window::read(line))));
        let recorded: Log<(String, u64)> = got.clone();
        let stopped = up(
            "recorder",
            &["stopped"],
            3,
            Box::new(move |line| {
                let (class, number) = line.split_once(' ').expect("a class and a number");
                recorded.write((class.to_owned(), number.parse().expect("a number")));
            }),
        );
        let api = NodeApi::connect(stage.socket()).expect("the door is open");
        // The node takes whatever is sent, and refuses it itself. A sender that gave up at its own full ring would leave gaps in
        // the numbers, and perhaps the newest value unsent, whenever the node is late for it.
        let registration = Registration::new().stall_timeout(DEADLINE);
        let mut sender = api.register_transport_address(registration).expect("an address");
        let to = sender.resolve("stopped", DEADLINE).expect("the node answers").expect("it is registered");
        Self { stage, others: [echo, pinger], stopped, windows, got, sender, to }
    }

    /// Round trips of the others from now on, until there were some. A window is as short as the one who asks for it is quick.
    fn others_flow(&mut self) -> Window {
        self.others[1].tell("window");
        self.windows.wait("the first window", |seen| (!seen.is_empty()).then_some(()));
        let mut flowed = Window::default();
        until("round trips of the others", || {
            let before = self.windows.all().len();
            self.others[1].tell("window");
            let window = self.windows.wait("the next window", |seen| seen.get(before).copied());
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

    /// Refused at once, and the sender told so.
    fn assert_full<P: Payload>(&mut self, value: &P) {
        let outcome = self.sender.message(self.to, value).confirmed(DEADLINE).expect("the node answers");
        assert_eq!(
            outcome,
            Outcome::Rejected(sinew::message::Rejection::QueueFull),
            "{} to a full queue",
            P::NAME
        );
    }

    /// Sends until it is handled: there is room again.
    fn send_until_delivered<P: Payload>(&mut self, value: &P) {
        until("it is delivered", || match self.sender.message(self.to, value).confirmed(DEADLINE) {
            Ok(Outcome::Delivered) => Some(()),
            Ok(Outcome::Rejected(sinew::message::Rejection::QueueFull)) => None,
            other => panic!("it ends as {other:?}"),
        });
    }

    fn end(self) {
        let Self { stage, others: [echo, pinger], stopped, .. } = self;
        for performer in [pinger, echo, stopped] {
            assert!(performer.end().success());
        }
        stage.end();
    }
}

/// From 1 on, without a gap.
fn is_unbroken(numbers: &[u64]) -> bool {
    numbers.iter().copied().eq(1..=numbers.len() as u64)
}

#[test]
fn a_stopped_client_fills_what_is_its_own_and_gets_what_its_classes_promise_when_it_goes_on() {
    // Given: one that is stopped, and a pair of others.
    let mut scene = Scene::new();
    let before = Held::of(scene.stage.node_id());
    scene.stopped.freeze();

    // When: more is sent to it than there is room for.
    for number in 1..=ROUNDS {
        scene.send(&Job { number });
        scene.send(&Value { number });
        scene.send(&Order { number });
    }

    // Then: whoever asks is told, the others are served, and the node holds no more than it may.
    scene.assert_full(&Job { number: ROUNDS + 1 });
    scene.assert_full(&Order { number: ROUNDS + 1 });
    let window = scene.others_flow();
    assert_eq!(window.failed, 0, "{window}");
    let held = Held::of(scene.stage.node_id());
    let grown = held.own_kib.saturating_sub(before.own_kib);
    assert!(grown <= BOUND_KIB, "the node has grown by {grown} KiB of {BOUND_KIB}: {held}");
    assert_eq!(scene.got.all().len(), 0, "it is stopped");

    // And when it goes on, it gets the oldest of what is ordered, and the newest value.
    scene.stopped.signal(Signal::CONT);
    scene.wait_for("stream", ROUNDS);
    scene.send_until_delivered(&Order { number: ROUNDS + 2 });
    scene.send_until_delivered(&Job { number: ROUNDS + 2 });
    // It says what it got before it settles it, but through a pipe that has a reader of its own.
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
/// `node.mailbox_bytes` with the default configuration, in messages of that length: what waits for one, each class by itself.
const LONG_WAIT: u64 = 4;
/// What it keeps of them in any case: two buffers of the thread that takes them, four rings, and a MiB of all else.
const LONG_KEPT_KIB: u64 = 2 * 1_024 + 4 * 260 + 1_024;
/// What it may hold for one that takes nothing: those that wait in each class, one that is written in part, one of the sender's
/// that has come in part; and what it keeps.
const LONG_BOUND_KIB: u64 = (3 * LONG_WAIT + 1 + 1) * 1_028 + LONG_KEPT_KIB;
const LONG_ROUNDS: u64 = 256;

#[test]
fn a_stopped_client_costs_its_node_bytes_within_their_bound_and_they_go_back_when_it_takes_them() {
    // Given: a node with the default bounds, one client that is stopped, and one that sends.
    let limits = StageLimits { mailbox_capacity: 256, payload_max: LONG, clients_max: 16 };
    let stage = Stage::that_gives_back(&program("client_kills"), limits);
    let got: Log<String> = Log::default();
    let says = got.clone();
    let stopped = stage.start("recorder", &["stopped".to_owned()], move |line| says.write(line.to_owned()));
    got.wait_for("up".to_owned());
    let api = NodeApi::connect(stage.socket()).expect("the door is open");
    let mut sender = api.register_transport_address(Registration::new()).expect("an address");
    let to = sender.resolve("stopped", DEADLINE).expect("the node answers").expect("it is registered");
    let before = Held::of(stage.node_id());
    stopped.freeze();

    // When: as many of the longest messages are sent to it as it may have waiting in number.
    let mut most = 0;
    for number in 1..=LONG_ROUNDS {
        for class in [Class::Control, Class::Stream, Class::Bulk] {
            // Values of their own, so that none takes the place of another.
            let kind = Kind::named(&format!("scenario.load.{number}"));
            let mut message = sender.create_message(to, kind, LONG).expect("the longest there may be");
            message.set_class(class);
            message[..8].copy_from_slice(&number.to_le_bytes());
            sender.loaned(message).send().expect("the node takes it, and passes it on or refuses it");
        }
        most = most.max(Held::of(stage.node_id()).own_kib.saturating_sub(before.own_kib));
    }

    // Then: the node holds so many bytes and no more, and who asks is told.
    assert!(most <= LONG_BOUND_KIB, "the node has grown by {most} KiB of {LONG_BOUND_KIB}");
    assert!(most >= LONG_WAIT * 1_024, "it did hold what it may: {most} KiB");
    let refused = sender.create_message(to, Kind::named("scenario.load"), LONG).expect("as above");
    let outcome = sender.loaned(refused).confirmed(DEADLINE).expect("it is sent");
    assert_eq!(outcome, Outcome::Rejected(sinew::message::Rejection::QueueFull));

    // And when it goes on, it gets what waited, and the memory is free again.
    stopped.signal(Signal::CONT);
    let loads = |got: &Log<String>| got.all().iter().filter(|line| line.starts_with("load")).count();
    until("what waited for it has come", || (loads(&got) as u64 >= 3 * LONG_WAIT).then_some(()));
    let mut left = 0;
    until("the memory is given back", || {
        left = Held::of(stage.node_id()).own_kib.saturating_sub(before.own_kib);
        (left <= LONG_KEPT_KIB).then_some(())
    });
    println!("grown by {most} KiB at most, by {left} KiB after it");
    assert!(stopped.end().success());
    stage.end();
}
