//! The same with endpoints for both ends.

use std::{
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
    time::Instant,
};

use sinew::{
    Endpoint,
    client::Received,
    message::Kind,
    prelude::*,
    protection::{Cause, DataId, Guard, Protection, State, Tally, open},
};
use sinew_tests::{DEADLINE, Ground, OwnDirectory};

use super::{ECHO, central, drive, node, relay};

/// So long that a busy machine makes nothing old, and so short that a test can wait for it.
const AGE_MAX: Duration = Duration::from_secs(4);
const LOOK: Duration = Duration::from_millis(1);
/// What an output is that is safe.
const SAFE: u64 = 0;

#[derive(Debug, sinew::serde::Serialize, sinew::serde::Deserialize)]
#[serde(crate = "sinew::serde")]
struct Level(u64);

impl Payload for Level {
    const NAME: &'static str = "black_channel.level";
    const PROTECTION: Option<Protection> =
        Some(Protection { within: DEADLINE, age_max: AGE_MAX, lost_max: 1, bad_max: 0, good_min: 4 });
}

/// A central and a drive, with a relay between them.
struct Line {
    central: Endpoint,
    to_central: Endpoint,
    to_drive: Endpoint,
    drive: Endpoint,
    guard: Guard<Arc<AtomicU64>>,
    output: Arc<AtomicU64>,
    number: u64,
    _nodes: [Node; 4],
    _directory: OwnDirectory,
}

impl Line {
    fn start() -> Self {
        let directory = OwnDirectory::new();
        let (one, two) = (Ground::new(), Ground::new());
        let nodes = [
            node(&one, 1, "one.central", &directory),
            node(&one, 2, "one.relay", &directory),
            node(&two, 1, "two.relay", &directory),
            node(&two, 2, "two.drive", &directory),
        ];
        let nodes = nodes.map(|node| node.start().expect("a node"));
        for (node, other) in [(0, 1), (1, 0), (2, 3), (3, 2)] {
            sinew_tests::sees(&nodes[node].handle(), nodes[other].address());
        }
        let mut own = relay("two.drive", drive(), &directory);
        let output = Arc::new(AtomicU64::new(1));
        let safe = |output: &mut Arc<AtomicU64>, _: Cause| output.store(SAFE, Ordering::Relaxed);
        let guard = own.guard::<Level, _>(central(), output.clone(), safe).expect("a thread");
        Self {
            central: relay("one.central", central(), &directory),
            to_central: relay("one.relay", drive(), &directory),
            to_drive: relay("two.relay", central(), &directory),
            drive: own,
            guard,
            output,
            number: 0,
            _nodes: nodes,
            _directory: directory,
        }
    }

    /// The bytes of central's next level, as the relay gets them. Echoes pass as they are.
    fn next(&mut self) -> Vec<u8> {
        assert!(self.drive.receive(LOOK).expect("it is connected").is_none(), "nothing was passed on");
        while let Some(echo) = self.to_drive.receive(LOOK).expect("it is connected") {
            assert_eq!(echo.kind(), ECHO);
            put(&mut self.to_central, central(), ECHO, echo.bytes());
        }
        // Before it has sent the first one nothing says to it that this is for the layer below.
        while let Some(other) = self.central.receive(LOOK).expect("it is connected") {
            assert_eq!((other.kind(), self.number), (ECHO, 0));
        }
        self.number += 1;
        self.central.send(drive(), &Level(self.number)).expect("the relay is there");
        let level = self.to_central.receive(DEADLINE).expect("it is connected").expect("it is passed");
        assert_eq!((level.source(), level.kind()), (central(), Level::KIND));
        level.bytes().to_vec()
    }

    /// Passes bytes on to the drive; what it receives of them.
    fn pass(&mut self, bytes: &[u8]) -> Option<Received> {
        let before = all(&self.guard.tally());
        put(&mut self.to_drive, drive(), Level::KIND, bytes);
        let deadline = Instant::now() + DEADLINE;
        loop {
            let received = self.drive.receive(LOOK).expect("it is connected");
            if received.is_some() || all(&self.guard.tally()) > before {
                return received;
            }
            assert!(Instant::now() < deadline, "it comes");
        }
    }

    /// Good ones until the output has been moved by one.
    fn come_alive(&mut self) {
        let deadline = Instant::now() + DEADLINE;
        loop {
            assert!(Instant::now() < deadline, "it can be armed: {:?}", self.guard.tally());
            let bytes = self.next();
            if let Some(received) = self.pass(&bytes) {
                self.apply(&received);
                return;
            }
            let _ = self.guard.arm(); // refused until enough have come
        }
    }

    fn apply(&self, received: &Received) {
        let Level(level) = received.decode().expect("it came through the guard");
        assert_eq!(level, self.number);
        self.guard.apply(|output| output.store(level, Ordering::Relaxed)).expect("it is live");
    }
}

fn put(by: &mut Endpoint, to: Tid, kind: Kind, bytes: &[u8]) {
    let mut message = by.create_message(to, kind, bytes.len()).expect("there is room");
    message.copy_from_slice(bytes);
    by.loaned(message).send().expect("it is sent");
}

/// Everything that has come.
const fn all(tally: &Tally) -> u64 {
    tally.good
        + tally.corrupt
        + tally.too_old
        + tally.repeated
        + tally.backwards
        + tally.restarted
        + tally.gaps
        + tally.unreadable
}

/// What the relay does, by its name; what it passes on last, and what that is counted as.
type Error = (&'static str, fn(&mut Line) -> Vec<u8>, fn(&Tally) -> u64, Cause);

const ERRORS: [Error; 6] = [
    (
        "corruption",
        |line| {
            let mut bytes = line.next();
            let at = fastrand::usize(0..bytes.len());
            bytes[at] ^= 1 << fastrand::u8(0..8);
            bytes
        },
        |tally| tally.corrupt,
        Cause::TooManyBad,
    ),
    (
        "unintended repetition",
        |line| {
            let bytes = line.next();
            let received = line.pass(&bytes).expect("the first time it is good");
            line.apply(&received);
            bytes
        },
        |tally| tally.repeated,
        Cause::TooManyBad,
    ),
    (
        "incorrect sequence",
        |line| {
            let (overtaken, bytes) = (line.next(), line.next());
            let received = line.pass(&bytes).expect("one may be missing");
            line.apply(&received);
            overtaken
        },
        |tally| tally.backwards,
        Cause::TooManyBad,
    ),
    (
        "loss",
        |line| {
            let _lost = (line.next(), line.next());
            line.next()
        },
        |tally| tally.gaps,
        Cause::TooMuchLost,
    ),
    (
        "masquerade as a command without protection",
        |line| {
            let data_id = DataId::of::<Level>(central(), drive());
            open(&data_id, &line.next().into()).expect("it is central's").1.to_vec()
        },
        |tally| tally.corrupt,
        Cause::TooManyBad,
    ),
    (
        "unacceptable delay",
        |line| {
            let bytes = line.next();
            // Only time makes it old.
            std::thread::sleep(AGE_MAX);
            bytes
        },
        |tally| tally.too_old,
        Cause::TooManyBad,
    ),
];

#[test]
fn whatever_a_relay_does_to_commands_of_an_endpoint_is_found_and_makes_the_output_safe() {
    let mut line = Line::start();
    assert_eq!(line.output.load(Ordering::Relaxed), SAFE, "before anything else");
    for (class, make, counted, cause) in ERRORS {
        line.come_alive();
        assert_ne!(line.output.load(Ordering::Relaxed), SAFE, "{class}");
        let bytes = make(&mut line);
        assert_eq!(line.guard.state(), State::Live, "{class}");
        let before = line.guard.tally();
        assert!(line.pass(&bytes).is_none(), "{class}");
        let after = line.guard.tally();
        assert_eq!((counted(&after), after.good), (counted(&before) + 1, before.good), "{class}: {after:?}");
        assert_eq!(line.guard.state(), State::Safe(cause), "{class}");
        assert_eq!(line.output.load(Ordering::Relaxed), SAFE, "{class}");
    }
    // Behind all of them commands are applied as before, once somebody arms.
    line.come_alive();
}

#[test]
fn command_that_came_through_no_guard_cannot_be_read_by_mistake() {
    let directory = OwnDirectory::new();
    let ground = Ground::new();
    let _node = node(&ground, 1, "one", &directory).start().expect("a node");
    let mut central = relay("one", central(), &directory);
    let mut other = relay("one", super::stranger(), &directory);
    central.send(other.tid(), &Level(7)).expect("it is there");
    let received = other.receive(DEADLINE).expect("it is connected").expect("it comes");
    // Its first byte would be a number.
    assert_eq!((received.kind(), received.bytes()[0]), (Level::KIND, 1));
    let error = received.decode::<Level>().expect_err("it is sealed");
    assert!(error.to_string().contains("did not come through a guard"), "{error}");
}
