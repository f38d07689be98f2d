//! The black channel with endpoints at both ends.

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
use sinew_testkit::{DEADLINE, Loopback, TestDirectory};

use super::{ECHO, central, drive, node, relay};

/// Long enough that nothing expires on a busy machine, and short enough for a test to wait for it.
const AGE_MAX: Duration = Duration::from_secs(4);
const LOOK: Duration = Duration::from_millis(1);
/// The safe value of an output.
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
    _directory: TestDirectory,
}

impl Line {
    fn start() -> Self {
        let directory = TestDirectory::new();
        let (one, two) = (Loopback::new(), Loopback::new());
        let nodes = [
            node(&one, 1, "one.central", &directory),
            node(&one, 2, "one.relay", &directory),
            node(&two, 1, "two.relay", &directory),
            node(&two, 2, "two.drive", &directory),
        ];
        let nodes = nodes.map(|node| node.start().expect("a node"));
        for (node, other) in [(0, 1), (1, 0), (2, 3), (3, 2)] {
            sinew_testkit::sees(&nodes[node].handle(), nodes[other].address());
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

    /// Returns the bytes of central's next level, as the relay receives them. Forwards echoes unchanged.
    fn next(&mut self) -> Vec<u8> {
        assert!(self.drive.receive(LOOK).expect("it is connected").is_none(), "nothing was passed on");
        while let Some(echo) = self.to_drive.receive(LOOK).expect("it is connected") {
            assert_eq!(echo.kind(), ECHO);
            put(&mut self.to_central, central(), ECHO, echo.bytes());
        }
        // Before central has sent the first level, it cannot know that an echo is for the protection layer.
        while let Some(other) = self.central.receive(LOOK).expect("it is connected") {
            assert_eq!((other.kind(), self.number), (ECHO, 0));
        }
        self.number += 1;
        self.central.send(drive(), &Level(self.number)).expect("the relay is there");
        let level = self.to_central.receive(DEADLINE).expect("it is connected").expect("it is passed");
        assert_eq!((level.source(), level.kind()), (central(), Level::KIND));
        level.bytes().to_vec()
    }

    /// Forwards bytes to the drive; returns the message that the drive receives, if any.
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

    /// Sends valid levels until the output is live and one has moved it.
    fn come_alive(&mut self) {
        let deadline = Instant::now() + DEADLINE;
        loop {
            assert!(Instant::now() < deadline, "it can be armed: {:?}", self.guard.tally());
            let bytes = self.next();
            if let Some(received) = self.pass(&bytes) {
                self.apply(&received);
                return;
            }
            let _ = self.guard.arm(); // rejected until enough valid ones have arrived
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

/// Number of all messages that arrived.
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

/// One error of the relay: its name, the bytes that it forwards last, the counter that must count them, and
/// the cause of the safe state.
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
            // Only elapsed time makes it too old.
            std::thread::sleep(AGE_MAX);
            bytes
        },
        |tally| tally.too_old,
        Cause::TooManyBad,
    ),
];

#[test]
fn relay_errors_are_detected_and_make_output_safe() {
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
    // After all of them commands are applied as before, once the output is armed.
    line.come_alive();
}

#[test]
fn unguarded_command_cannot_be_decoded() {
    let directory = TestDirectory::new();
    let loopback = Loopback::new();
    let _node = node(&loopback, 1, "one", &directory).start().expect("a node");
    let mut central = relay("one", central(), &directory);
    let mut other = relay("one", super::stranger(), &directory);
    central.send(other.tid(), &Level(7)).expect("it is there");
    let received = other.receive(DEADLINE).expect("it is connected").expect("it comes");
    // The first byte of a plain payload would be a number.
    assert_eq!((received.kind(), received.bytes()[0]), (Level::KIND, 1));
    let error = received.decode::<Level>().expect_err("it is sealed");
    assert!(error.to_string().contains("did not come through a guard"), "{error}");
}
