//! Programs in C and C++, compiled as a user would, against a node in a process of its own.

#[path = "programs/barriers.rs"]
mod barriers;
#[path = "programs/ground.rs"]
mod ground;
#[path = "programs/log.rs"]
mod log;
#[path = "programs/payloads.rs"]
mod payloads;

use ground::{C, CPP, CPP20, Ground, WATCHDOG, endpoint, is_there};
use rustix::process::Signal;
use serde::{Deserialize, Serialize};
use sinew::{
    AppAddress, Class, Endpoint, NodeApi, Outcome, Payload, Registration, Tid,
    events::RequirementEvent,
    message::Kind,
    stop::{AskStop, StopReport, StopState},
};

/// As in `programs/holder.c`.
#[derive(Debug, PartialEq, Serialize, Deserialize)]
struct Torque {
    newton_metres: f32,
}

impl Payload for Torque {
    const NAME: &'static str = "test.torque";
}

/// As in `examples/sensor.c` and `examples/drive.cpp`.
#[derive(Debug, PartialEq, Serialize, Deserialize)]
struct JointAngle {
    degrees: f32,
    number: u32,
}

impl Payload for JointAngle {
    const NAME: &'static str = "demo.joint_angle";
    const CLASS: Class = Class::Stream;
}

/// As in `examples/sensor.c` and `examples/drive.cpp`.
#[derive(Debug, PartialEq, Serialize, Deserialize)]
struct DriveReport {
    degrees: f32,
    number: u32,
}

impl Payload for DriveReport {
    const NAME: &'static str = "demo.drive_report";
}

/// The memory of an endpoint that exists is no leak, as in a child of `fork`; a buffer that is read from has
/// no pointer to its start. One thread runs at a time; without `fair-sched` the same one may run again for
/// any number of times.
const VALGRIND: [&str; 6] = [
    "valgrind",
    "--fair-sched=try",
    "--leak-check=full",
    "--show-leak-kinds=definite,indirect",
    "--errors-for-leak-kinds=definite,indirect",
    "--error-exitcode=99",
];

fn resolve(endpoint: &mut Endpoint, name: &str) -> Tid {
    endpoint.resolve(name, WATCHDOG).expect("the node answers").expect("it is registered")
}

#[test]
fn c_sensor_and_cpp_drive_work_together() {
    if !is_there("gcc") || !is_there("g++") {
        return;
    }
    let ground = Ground::new();
    // Each waits for the other for its documented time, and not for a compiler.
    let sensor = C.shared("examples/sensor.c", &ground);
    let mut drive = ground.start(&CPP.shared("examples/drive.cpp", &ground), &[]);
    drive.wait_for(&["drive is"]);
    let mut sensor = ground.start(&sensor, &["200"]);
    sensor.wait_for(&["last angle: delivered"]);
    sensor.wait_for(&["the drive of node knee is at number 200"]);
    assert_eq!(sensor.wait_for_exit(), Some(0));
    drive.wait_for(&["last angle was number 200"]);
    assert_eq!(drive.wait_for_exit(), Some(0));
}

#[test]
fn first_c_program_asks_and_prints_the_reply() {
    if !is_there("gcc") {
        return;
    }
    let ground = Ground::new();
    let mut greeter = endpoint(&ground, Registration::new().name("greeter"));
    let mut hello = ground.start(&C.shared("examples/hello.c", &ground), &[]);
    let request = greeter.receive(WATCHDOG).unwrap().expect("a name");
    assert_eq!((request.kind(), request.bytes()), (Kind::named("demo.name"), &b"Ankle"[..]));
    let mut reply = greeter.create_message(request.source(), request.kind(), 6).unwrap();
    reply.copy_from_slice(b"Hello!");
    greeter.loaned(reply).reply_to(&request).unwrap();
    hello.wait_for(&["Hello!"]);
    assert_eq!(hello.wait_for_exit(), Some(0));
}

#[test]
fn first_c_program_is_greeted_by_its_partner() {
    if !is_there("gcc") {
        return;
    }
    let ground = Ground::new();
    let hello = C.shared("examples/hello.c", &ground);
    let mut greeter = ground.start(&C.shared("examples/greeter.c", &ground), &[]);
    greeter.wait_for(&["the greeter is there"]);
    let mut hello = ground.start(&hello, &[]);
    hello.wait_for(&["Hello, Ankle"]);
    assert_eq!((hello.wait_for_exit(), greeter.wait_for_exit()), (Some(0), Some(0)));
}

#[test]
fn library_links_statically_and_wrapper_compiles_as_cpp20() {
    if !is_there("gcc") || !is_there("g++") {
        return;
    }
    let ground = Ground::new();
    let sensor = C.static_("examples/sensor.c", &ground);
    let mut drive = ground.start(&CPP20.shared("examples/drive.cpp", &ground), &[]);
    drive.wait_for(&["drive is"]);
    let mut sensor = ground.start(&sensor, &["3"]);
    assert_eq!(sensor.wait_for_exit(), Some(0));
    drive.wait_for(&["last angle was number 3"]);
}

/// Acts as the drive until the sensor's final request; returns the last angle that arrived.
fn drive_in_rust(drive: &mut Endpoint) -> (f32, u32) {
    let mut last = (0.0, 0);
    loop {
        let message =
            drive.receive(WATCHDOG).expect("the node lives").expect("an angle, or the question at the end");
        if message.wants_reply() {
            assert_eq!(message.kind(), Kind::named("demo.drive_report"));
            let report = DriveReport { degrees: last.0, number: last.1 };
            drive.reply(&message, &report).expect("the node takes it");
            return last;
        }
        let angle: JointAngle = message.decode().expect("an angle");
        // The last one is Control, which overtakes the queued Stream messages.
        if angle.number > last.1 {
            last = (angle.degrees, angle.number);
        }
    }
}

#[test]
fn c_sensor_works_with_a_rust_drive() {
    if !is_there("gcc") {
        return;
    }
    let ground = Ground::new();
    let mut drive = endpoint(&ground, Registration::new().name("knee.drive"));
    let mut sensor = ground.start(&C.shared("examples/sensor.c", &ground), &["50"]);
    assert_eq!(drive_in_rust(&mut drive), (0.0, 50));
    sensor.wait_for(&["the drive of node knee is at number 50"]);
    assert_eq!(sensor.wait_for_exit(), Some(0));
}

fn echoed(asking: &mut Endpoint, to: Tid, kind: Kind) -> Vec<u8> {
    let mut packet = asking.create_message(to, kind, 16).expect("it is short");
    packet.fill(0xa5);
    asking.loaned(packet).send().expect("the node takes it");
    let back = asking.receive(WATCHDOG).expect("the node lives").expect("what was sent");
    assert_eq!(back.kind(), kind);
    back.bytes().to_vec()
}

#[test]
fn bench_receiver_in_cpp_echoes_payloads_and_ages() {
    if !is_there("g++") {
        return;
    }
    let ground = Ground::new();
    let mut echo = ground.start(&CPP.shared("../../actors/benches/lncl/echo.cpp", &ground), &[]);
    echo.wait_for(&["there"]);
    let mut asking = endpoint(&ground, Registration::new());
    let to = resolve(&mut asking, "echo");
    assert_eq!(echoed(&mut asking, to, Kind::named("test.packet")), [0xa5; 16]);
    let aged = echoed(&mut asking, to, Kind::named("lncl.aged"));
    let (age, rest) = aged.split_first_chunk::<8>().expect("it is as long as what was sent");
    assert_eq!(rest, [0xa5; 8]);
    assert!(i64::from_ne_bytes(*age) >= 0, "{age:?}");
}

#[test]
fn killed_c_process_fails_its_unsettled_messages() {
    if !is_there("gcc") {
        return;
    }
    let ground = Ground::new();
    let mut holder = ground.start(&C.shared("tests/programs/holder.c", &ground), &[]);
    holder.wait_for(&["ready"]);
    let mut watching =
        endpoint(&ground, Registration::new().requires(["holder"]).subscribe::<RequirementEvent>());
    let to = resolve(&mut watching, "holder");
    let socket = ground.socket();
    let sending = std::thread::spawn(move || {
        let node = NodeApi::connect(socket).unwrap();
        let mut sender = node.register_transport_address(Registration::new()).unwrap();
        let message = sender.create_message(to, Kind::named("test.held"), 3).unwrap();
        sender.loaned(message).confirmed(WATCHDOG).unwrap()
    });
    holder.wait_for(&["held 3 bytes"]);
    holder.signal(Signal::KILL);
    assert_eq!(sending.join().unwrap(), Outcome::Failed);
    let event = watching.receive(WATCHDOG).unwrap().expect("an event");
    assert!(matches!(event.decode().unwrap(), RequirementEvent::Lost { .. }), "{event:?}");
    assert_eq!(watching.resolve("holder", WATCHDOG).unwrap(), None);
}

#[test]
fn c_program_survives_a_node_restart() {
    if !is_there("gcc") {
        return;
    }
    let mut ground = Ground::new();
    let mut holder = ground.start(&C.shared("tests/programs/holder.c", &ground), &[]);
    holder.wait_for(&["ready"]);
    ground.node.signal(Signal::KILL);
    holder.wait_for(&["away", "the connection to the node has ended", "registers again by itself"]);
    ground.start_node_again();
    let mut asking = endpoint(&ground, Registration::new().requires(["holder"]));
    let to = resolve(&mut asking, "holder");
    let doubled: Torque = asking.message(to, &Torque { newton_metres: 2.5 }).ask(WATCHDOG).unwrap();
    assert_eq!(doubled, Torque { newton_metres: 5.0 });
}

#[test]
fn misuse_in_c_is_rejected_with_a_sentence() {
    if !is_there("gcc") {
        return;
    }
    let ground = Ground::new();
    ground.run(&C.shared("tests/programs/misuse.c", &ground), "all refused");
}

#[test]
fn c_program_presses_the_stop_and_acknowledges_it() {
    if !is_there("gcc") {
        return;
    }
    let ground = Ground::new();
    ground.run(&C.shared("tests/programs/press.c", &ground), "pressed and released");
    // The node has had both.
    let mut asking = endpoint(&ground, Registration::new());
    let to = Tid::new(asking.tid().node, AppAddress::STOP);
    let report: StopReport = asking.message(to, &AskStop {}).ask(WATCHDOG).unwrap();
    assert_eq!((report.state, report.presses.len()), (StopState::Released, 0), "{report:?}");
}

#[test]
fn cpp_wrapper_settles_at_scope_end_and_throws_errors() {
    if !is_there("g++") {
        return;
    }
    let ground = Ground::new();
    ground.run(&CPP.shared("tests/programs/wrapper.cpp", &ground), "all well");
}

#[test]
fn valgrind_reports_no_error_and_no_leak() {
    if !is_there("gcc") || !is_there("valgrind") {
        return;
    }
    let ground = Ground::new();
    let program = C.shared("tests/programs/misuse.c", &ground);
    let mut watched = ground.start_under(&VALGRIND, &program, &[]);
    let end = watched.wait_for_exit();
    let said = watched.output().join("\n");
    assert_eq!(end, Some(0), "{said}");
    println!("{said}");
}

/// Each beside a partner in Rust: how slow a partner gets under valgrind does not matter then.
#[test]
fn examples_are_clean_under_valgrind() {
    if !is_there("gcc") || !is_there("g++") || !is_there("valgrind") {
        return;
    }
    let ground = Ground::new();
    let mut drive = endpoint(&ground, Registration::new().name("knee.drive"));
    let mut sensor = ground.start_under(&VALGRIND, &C.shared("examples/sensor.c", &ground), &["5"]);
    assert_eq!(drive_in_rust(&mut drive).1, 5);
    assert_eq!(sensor.wait_for_exit(), Some(0), "{}", sensor.output().join("\n"));
    drive.unregister().unwrap();
    let mut drive = ground.start_under(&VALGRIND, &CPP.shared("examples/drive.cpp", &ground), &[]);
    drive.wait_for(&["drive is"]);
    let mut sensor = endpoint(&ground, Registration::new());
    let to = resolve(&mut sensor, "knee.drive");
    let question = sensor.create_message(to, Kind::named("demo.drive_report"), 0).unwrap();
    let answer = sensor.loaned(question).ask_raw(WATCHDOG).unwrap();
    assert_eq!(answer.decode::<DriveReport>().unwrap(), DriveReport { degrees: 0.0, number: 0 });
    assert_eq!(drive.wait_for_exit(), Some(0), "{}", drive.output().join("\n"));
}

#[test]
fn send_in_c_waits_for_room_and_loses_nothing() {
    if !is_there("gcc") {
        return;
    }
    for way in ["rings", "socket"] {
        let ground = Ground::new();
        let mut room = ground.start(&C.shared("tests/programs/room.c", &ground), &[way]);
        room.wait_for(&["stop it"]);
        ground.node.pause();
        room.send_line("go");
        room.wait_for(&["let it go on"]);
        ground.node.signal(Signal::CONT);
        room.send_line("go");
        room.wait_for(&["all came"]);
        assert_eq!(room.wait_for_exit(), Some(0));
    }
}
