//! Protected commands through a real black channel, on real nodes. A relay stands between a sender and a
//! guard. It repeats, reorders, delays, loses, changes and misdirects the bytes of the commands. Every error
//! is detected, no faulty command is applied, and the output is safe at once.
//!
//! ```text
//!   network one                                  network two
//!   central 127.0.0.1 <---> node 127.0.0.2       node 127.0.0.1 <---> drive 127.0.0.2
//!                              relay: the drive, to central | central, to the drive
//! ```
//!
//! Neither end can detect the relay: each knows the other by the address that the relay has in its place. In
//! `endpoints.rs` the ends are endpoints in other processes.

mod endpoints;

use std::{
    sync::{
        Mutex,
        mpsc::{Receiver, SyncSender, sync_channel},
    },
    time::Instant,
};

use sinew::{
    Endpoint, NodeApi, Outcome, Registration,
    message::{Kind, Rejection},
    prelude::*,
    protection::{Cause, DataId, Guard, Protection, State, Tally, open, seal},
    stop::{AskStop, StopReport, StopState},
};
use sinew_testkit::{DEADLINE, Loopback, TestDirectory};

/// Trials of each error; those of a delay take the time of the delay.
const TRIALS: u32 = 50;
const DELAYS: u32 = 5;
/// Greatest age in tests of errors other than age: a busy machine may stall between the creation of a message
/// and its arrival.
const PATIENT_MS: u64 = 20_000;
/// Greatest age in the test of excessive age.
const BRIEF_MS: u64 = 1_000;
/// The first bad message makes the output safe; the other limits allow for a busy machine.
const fn protection(age_max_ms: u64) -> Protection {
    let age_max = Duration::from_millis(age_max_ms);
    Protection { within: DEADLINE, age_max, lost_max: 1, bad_max: 0, good_min: 4 }
}
/// By its name: the type is private to the runtime.
const ECHO: Kind = Kind::named("sinew.echo");

#[derive(Debug, sinew::serde::Serialize, sinew::serde::Deserialize)]
#[serde(crate = "sinew::serde")]
struct Torque<const AGE_MAX_MS: u64> {
    number: u64,
}

impl<const AGE_MAX_MS: u64> Payload for Torque<AGE_MAX_MS> {
    const NAME: &'static str = "black_channel.torque";
    const CLASS: Class = Class::Control;
    const PROTECTION: Option<Protection> = Some(protection(AGE_MAX_MS));
}

payload!("black_channel.go", Control =>
    /// Requests the next torque, to be sent to the requester.
    struct Go;
);

fn tid(host: u8, app: u32) -> Tid {
    Tid::new(NodeAddress::from([127, 0, 0, host]), AppAddress::fixed(app).expect("a fixed one"))
}

fn central() -> Tid {
    tid(1, 1)
}

/// Another sender of torques, none of which are for the drive's guard.
fn stranger() -> Tid {
    tid(1, 2)
}

fn drive() -> Tid {
    tid(2, 1)
}

/// Another receiver of central's torques.
fn other_drive() -> Tid {
    tid(2, 2)
}

#[derive(Default)]
struct Central<const AGE_MAX_MS: u64> {
    number: u64,
}

impl<const AGE_MAX_MS: u64> Actor for Central<AGE_MAX_MS> {
    type Context = AppContext<Self>;
}

impl<const AGE_MAX_MS: u64> Handler<Delivery<Go>> for Central<AGE_MAX_MS> {
    type Result = ();

    fn handle(&mut self, go: Delivery<Go>, context: &mut Self::Context) {
        self.number += 1;
        context.send(go.source, &Torque::<AGE_MAX_MS> { number: self.number }).expect("the relay is there");
    }
}

/// Events at the motor.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Seen {
    Moved(u64),
    Safe(Cause),
}

struct Drive<const AGE_MAX_MS: u64> {
    motor: SyncSender<Seen>,
    guards: SyncSender<Guard<SyncSender<Seen>>>,
    guard: Option<Guard<SyncSender<Seen>>>,
}

impl<const AGE_MAX_MS: u64> Actor for Drive<AGE_MAX_MS> {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        let safe =
            |motor: &mut SyncSender<Seen>, cause| motor.send(Seen::Safe(cause)).expect("the test looks");
        let guard =
            context.guard::<Torque<AGE_MAX_MS>, _>(central(), self.motor.clone(), safe).expect("a thread");
        self.guards.send(guard.clone()).expect("the test waits");
        self.guard = Some(guard);
    }
}

impl<const AGE_MAX_MS: u64> Handler<Delivery<Torque<AGE_MAX_MS>>> for Drive<AGE_MAX_MS> {
    type Result = ();

    fn handle(&mut self, torque: Delivery<Torque<AGE_MAX_MS>>, _: &mut Self::Context) {
        let guard = self.guard.as_ref().expect("it was made first");
        let moved = guard.apply(|motor| motor.send(Seen::Moved(torque.number)));
        moved.expect("it was live when the torque was let through").expect("the test looks");
    }
}

/// All four nodes, and the control of the relay between them.
struct Scene<const AGE_MAX_MS: u64> {
    to_central: Endpoint,
    to_central_as_another: Endpoint,
    to_drive: Endpoint,
    // In drop order: the motor is notified of all earlier ends.
    _nodes: [Node; 4],
    _directory: TestDirectory,
    guard: Guard<SyncSender<Seen>>,
    motor: Receiver<Seen>,
    /// The number of the last forwarded torque.
    number: u64,
}

/// A node at 127.0.0.`host` with a client socket for endpoints.
fn node(loopback: &Loopback, host: u8, name: &str, directory: &TestDirectory) -> NodeBuilder {
    let socket = directory.join(&format!("{name}.sock"));
    loopback.node(name).address([127, 0, 0, host]).configure(|config| config.lncl.socket = Some(socket))
}

fn relay(name: &str, own: Tid, directory: &TestDirectory) -> Endpoint {
    let api = NodeApi::connect(directory.join(&format!("{name}.sock"))).expect("its door");
    let registration = Registration::new().fixed_address(own.app).deadline(DEADLINE);
    api.register_transport_address(registration).expect("the address is free")
}

/// Waits until the relay's node knows that no stop is in force: before, it hands over no echo of a client.
fn await_release(relay: &mut Endpoint) {
    let stop = Tid::new(relay.tid().node, AppAddress::STOP);
    sinew_testkit::until("the node is not held", || {
        let report: StopReport = relay.message(stop, &AskStop {}).ask(DEADLINE).expect("the node answers");
        (report.state == StopState::Released).then_some(())
    });
}

impl<const AGE_MAX_MS: u64> Scene<AGE_MAX_MS> {
    fn start() -> Self {
        let directory = TestDirectory::new();
        let (one, two) = (Loopback::new(), Loopback::new());
        let ((motor, seen), (guards, guard)) = (sync_channel(1_000), sync_channel(1));
        let ends = Mutex::new(Some((motor, guards)));
        let drive_app = AppSpec::new("drive", move || {
            let (motor, guards) = ends.lock().expect("no holder panics").take().expect("one incarnation");
            Drive::<AGE_MAX_MS> { motor, guards, guard: None }
        });
        let central_app = |name, tid: Tid| {
            AppSpec::new(name, Central::<AGE_MAX_MS>::default).address(tid.app).handles::<Go>()
        };
        let centrals = [central_app("central", central()), central_app("stranger", stranger())];
        let [first, second] = centrals;
        let nodes = [
            node(&one, 1, "one.central", &directory).app(first).app(second),
            node(&one, 2, "one.relay", &directory),
            node(&two, 1, "two.relay", &directory),
            node(&two, 2, "two.drive", &directory)
                .app(drive_app.address(drive().app).handles::<Torque<AGE_MAX_MS>>()),
        ];
        let nodes = nodes.map(|node| node.start().expect("a node"));
        sinew_testkit::all_run(&[&nodes[0], &nodes[3]]);
        sinew_testkit::sees(&nodes[1].handle(), nodes[0].address());
        sinew_testkit::sees(&nodes[2].handle(), nodes[3].address());
        let guard = guard.recv_timeout(DEADLINE).expect("the drive has a guard");
        let mut to_central = relay("one.relay", drive(), &directory);
        let mut to_drive = relay("two.relay", central(), &directory);
        await_release(&mut to_central);
        await_release(&mut to_drive);
        Self {
            to_central,
            to_central_as_another: relay("one.relay", other_drive(), &directory),
            to_drive,
            guard,
            motor: seen,
            number: 0,
            _nodes: nodes,
            _directory: directory,
        }
    }

    /// Returns the bytes of central's next torque, which quotes a fresh echo.
    fn next(&mut self) -> Vec<u8> {
        self.pass_echoes();
        next_of::<AGE_MAX_MS>(&mut self.to_central, central())
    }

    /// Forwards the drive's echoes unchanged.
    fn pass_echoes(&mut self) {
        while let Some(echo) = self.to_drive.receive(Duration::ZERO).expect("it is connected") {
            assert_eq!(echo.kind(), ECHO);
            let passed = pass(&mut self.to_central, central(), ECHO, echo.bytes());
            assert_eq!(passed, Outcome::Delivered);
        }
    }

    /// Forwards bytes to the drive. All bytes take this path.
    fn pass(&mut self, bytes: &[u8]) -> Outcome {
        pass(&mut self.to_drive, drive(), Torque::<AGE_MAX_MS>::KIND, bytes)
    }

    /// Sends valid torques until the output is armed and one has moved it, however busy the machine is.
    fn come_alive(&mut self) {
        let deadline = Instant::now() + DEADLINE;
        loop {
            assert!(Instant::now() < deadline, "it can be armed: {:?}", self.guard.tally());
            let torque = self.next();
            let is_live = self.pass(&torque) == Outcome::Delivered;
            let seen: Vec<Seen> = self.motor.try_iter().collect();
            if let ([Seen::Moved(number)], true) = (&seen[..], is_live) {
                assert!(*number > self.number, "{number} after {}", self.number);
                self.number = *number;
                return;
            }
            let _ = self.guard.arm(); // rejected until enough valid ones have arrived
        }
    }

    /// Injects an error into a channel in which commands are applied. It must be detected and not applied,
    /// and the output must be safe.
    fn inject(&mut self, figures: &mut Figures, error: &Error<AGE_MAX_MS>) {
        let deadline = Instant::now() + DEADLINE;
        let bytes = loop {
            assert!(Instant::now() < deadline, "good ones are applied before: {:?}", self.guard.tally());
            self.come_alive();
            let bytes = (error.make)(self);
            let is_live = self.guard.state() == State::Live;
            if let (Some(bytes), true) = (bytes, is_live) {
                break bytes;
            }
        };
        // Discards the events of the valid messages that the error needed.
        for seen in self.motor.try_iter() {
            assert!(matches!(seen, Seen::Moved(_)), "{seen:?} before the error");
        }
        let before = self.guard.tally();
        figures.injected += 1;
        let outcome = self.pass(&bytes);
        let after = self.guard.tally();
        let is_counted = (error.counted)(&after) == (error.counted)(&before) + 1 && after.good == before.good;
        figures.detected += u32::from(is_counted && outcome == Outcome::Rejected(error.rejection));
        for seen in self.motor.try_iter() {
            match seen {
                Seen::Moved(_) => figures.applied += 1,
                Seen::Safe(cause) => figures.made_safe += u32::from(cause == error.cause),
            }
        }
    }
}

/// Sends bytes unchanged, and waits for their outcome.
fn pass(by: &mut Endpoint, to: Tid, kind: Kind, bytes: &[u8]) -> Outcome {
    let mut message = by.create_message(to, kind, bytes.len()).expect("there is room");
    message.copy_from_slice(bytes);
    by.loaned(message).confirmed(DEADLINE).expect("it is sent")
}

/// Returns the bytes of the next torque of `source` for the requester.
fn next_of<const AGE_MAX_MS: u64>(asks: &mut Endpoint, source: Tid) -> Vec<u8> {
    assert_eq!(asks.message(source, &Go).confirmed(DEADLINE).expect("it is sent"), Outcome::Delivered);
    let torque = asks.receive(DEADLINE).expect("it is connected").expect("it sends one");
    assert_eq!((torque.source(), torque.kind()), (source, Torque::<AGE_MAX_MS>::KIND));
    torque.bytes().to_vec()
}

#[derive(Debug, Default, PartialEq, Eq)]
struct Figures {
    injected: u32,
    detected: u32,
    applied: u32,
    made_safe: u32,
}

/// One class of errors.
struct Error<const AGE_MAX_MS: u64> {
    class: &'static str,
    trials: u32,
    /// Creates the bytes to forward; `None` if a valid message before them arrived too late on a busy
    /// machine.
    make: fn(&mut Scene<AGE_MAX_MS>) -> Option<Vec<u8>>,
    rejection: Rejection,
    counted: fn(&Tally) -> u64,
    cause: Cause,
}

const CORRUPT: Error<PATIENT_MS> = Error {
    class: "corruption",
    trials: TRIALS,
    make: |scene| {
        let mut bytes = scene.next();
        for _ in 0..fastrand::usize(1..=8) {
            let at = fastrand::usize(0..bytes.len());
            // The value differs however often it is changed: each step only adds, and all steps together add
            // less than 256.
            bytes[at] = bytes[at].wrapping_add(fastrand::u8(1..=31));
        }
        Some(bytes)
    },
    rejection: Rejection::Malformed,
    counted: |tally| tally.corrupt,
    cause: Cause::TooManyBad,
};

const DELAY: Error<BRIEF_MS> = Error {
    class: "unacceptable delay",
    trials: DELAYS,
    make: |scene| {
        let bytes = scene.next();
        // Only elapsed time makes it too old.
        std::thread::sleep(protection(BRIEF_MS).age_max);
        Some(bytes)
    },
    rejection: Rejection::ByHandler,
    counted: |tally| tally.too_old,
    cause: Cause::TooManyBad,
};

const ERRORS: [Error<PATIENT_MS>; 8] = [
    CORRUPT,
    Error {
        class: "unintended repetition",
        make: |scene| {
            let bytes = scene.next();
            // The first copy is valid.
            (scene.pass(&bytes) == Outcome::Delivered).then_some(bytes)
        },
        rejection: Rejection::ByHandler,
        counted: |tally| tally.repeated,
        ..CORRUPT
    },
    Error {
        class: "incorrect sequence",
        make: |scene| {
            let (overtaken, bytes) = (scene.next(), scene.next());
            // One may be missing.
            (scene.pass(&bytes) == Outcome::Delivered).then_some(overtaken)
        },
        rejection: Rejection::ByHandler,
        counted: |tally| tally.backwards,
        ..CORRUPT
    },
    Error {
        class: "loss",
        make: |scene| {
            for _ in 0..fastrand::u64(2..=5) {
                scene.next();
            }
            Some(scene.next())
        },
        rejection: Rejection::ByHandler,
        counted: |tally| tally.gaps,
        cause: Cause::TooMuchLost,
        ..CORRUPT
    },
    Error {
        class: "insertion",
        make: |scene| Some(next_of::<PATIENT_MS>(&mut scene.to_central, stranger())),
        ..CORRUPT
    },
    Error {
        class: "masquerade as the command of another type",
        make: |scene| {
            let bytes = scene.next();
            let own = DataId::of::<Torque<PATIENT_MS>>(central(), drive());
            let (stamp, payload) = open(&own, &bytes.into()).expect("it is central's");
            Some(seal(&DataId { name: "black_channel.speed", ..own }, stamp, &payload).to_vec())
        },
        ..CORRUPT
    },
    Error {
        class: "masquerade as a command without protection",
        make: |scene| {
            let own = DataId::of::<Torque<PATIENT_MS>>(central(), drive());
            Some(open(&own, &scene.next().into()).expect("it is central's").1.to_vec())
        },
        ..CORRUPT
    },
    Error {
        class: "addressing",
        make: |scene| Some(next_of::<PATIENT_MS>(&mut scene.to_central_as_another, central())),
        ..CORRUPT
    },
];

/// Injects each of these errors, in a channel of its own, and checks that all are detected.
fn inject<const AGE_MAX_MS: u64>(errors: &[Error<AGE_MAX_MS>]) {
    let mut scene = Scene::<AGE_MAX_MS>::start();
    assert_eq!(scene.motor.recv_timeout(DEADLINE), Ok(Seen::Safe(Cause::NotArmed)), "before anything else");
    for error in errors {
        let mut figures = Figures::default();
        for _ in 0..error.trials {
            scene.inject(&mut figures, error);
        }
        let (class, trials) = (error.class, error.trials);
        println!("{class}: {figures:?}");
        let all = Figures { injected: trials, detected: trials, applied: 0, made_safe: trials };
        assert_eq!(figures, all, "{class}");
    }
    // After all of them commands are applied as before, once the output is armed.
    scene.come_alive();
}

#[test]
fn relay_errors_are_detected_and_make_output_safe() {
    inject(&ERRORS);
    inject(&[DELAY]);
}
