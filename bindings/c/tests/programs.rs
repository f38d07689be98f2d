//! Programs in C and C++, compiled as a user would, against a node in a process of its own.

#[path = "programs/ground.rs"]
mod ground;

use std::{
    io::{PipeReader, PipeWriter, Write, pipe},
    time::Duration,
};

use ground::{C, CPP, CPP20, Ground, WATCHDOG, endpoint, is_there};
use rustix::{io::ioctl_fionbio, process::Signal};
use serde::{Deserialize, Serialize};
use sinew::{
    Class, Endpoint, NodeApi, Outcome, Payload, Registration, Tid, barrier::Barrier,
    events::RequirementEvent, message::Kind,
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

/// What an endpoint that lives has is no leak, as in a child of `fork`; a buffer that is read from has no pointer to its start.
const VALGRIND: [&str; 5] = [
    "valgrind",
    "--leak-check=full",
    "--show-leak-kinds=definite,indirect",
    "--errors-for-leak-kinds=definite,indirect",
    "--error-exitcode=99",
];

fn resolve(endpoint: &mut Endpoint, name: &str) -> Tid {
    endpoint.resolve(name, WATCHDOG).expect("the node answers").expect("it is registered")
}

#[test]
fn the_sensor_in_c_and_the_drive_in_cpp_find_each_other_and_walk() {
    if !is_there("gcc") || !is_there("g++") {
        return;
    }
    let ground = Ground::new();
    // Each waits for the other so long as it says, and not for a compiler.
    let sensor = C.shared("examples/sensor.c", &ground);
    let mut drive = ground.start(&CPP.shared("examples/drive.cpp", &ground), &[]);
    drive.wait_for(&["drive is"]);
    let mut sensor = ground.start(&sensor, &["200"]);
    sensor.wait_for(&["last angle: delivered"]);
    sensor.wait_for(&["the drive of node knee is at number 200"]);
    assert_eq!(sensor.wait_for_end(), Some(0));
    drive.wait_for(&["last angle was number 200"]);
    assert_eq!(drive.wait_for_end(), Some(0));
}

#[test]
fn the_first_program_in_c_asks_and_prints_the_reply() {
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
    assert_eq!(hello.wait_for_end(), Some(0));
}

#[test]
fn the_library_says_on_the_standard_error_what_sinew_log_asks_for() {
    if !is_there("gcc") {
        return;
    }
    let ground = Ground::new();
    let greeter = C.shared("examples/greeter.c", &ground);
    let mut greeter = ground.start_under(&["env", "SINEW_LOG=debug"], &greeter, &[]);
    greeter.wait_for(&["registered", "knee"]);
}

/// A pipe that takes nothing, with the end that nobody reads.
fn full_pipe() -> (PipeReader, PipeWriter) {
    let (unread, mut full) = pipe().expect("the system has a pipe");
    ioctl_fionbio(&full, true).expect("it is ours");
    while full.write(&[b'.'; 4_096]).is_ok() {}
    ioctl_fionbio(&full, false).expect("it is ours");
    (unread, full)
}

#[test]
fn a_standard_error_that_nobody_reads_stops_no_call() {
    if !is_there("gcc") {
        return;
    }
    let ground = Ground::new();
    let (_unread, full) = full_pipe();
    let mut greeter = ground.start_logging_to(full, &C.shared("examples/greeter.c", &ground));
    greeter.wait_for(&["the greeter is there"]);
    let mut asking = endpoint(&ground, Registration::new());
    assert_eq!(ask_for_a_greeting(&mut asking), b"Hello, Ankle");
    assert_eq!(greeter.wait_for_end(), Some(0));
}

fn ask_for_a_greeting(asking: &mut Endpoint) -> Vec<u8> {
    let to = resolve(asking, "greeter");
    let mut name = asking.create_message(to, Kind::named("demo.name"), 5).expect("it is short");
    name.copy_from_slice(b"Ankle");
    asking.loaned(name).ask_raw(WATCHDOG).expect("the greeter answers").bytes().to_vec()
}

#[test]
fn a_standard_error_that_is_closed_is_not_mistaken_for_the_socket_that_has_its_number() {
    if !is_there("gcc") {
        return;
    }
    let ground = Ground::new();
    let under = ["env", "SINEW_LOG=debug", "sh", "-c", r#"exec "$@" 2>&-"#, "sh"];
    let mut greeter = ground.start_under(&under, &C.shared("examples/greeter.c", &ground), &[]);
    greeter.wait_for(&["the greeter is there"]);
    let mut asking = endpoint(&ground, Registration::new());
    assert_eq!(ask_for_a_greeting(&mut asking), b"Hello, Ankle");
    assert_eq!(greeter.wait_for_end(), Some(0));
}

#[test]
fn the_first_program_in_c_is_greeted_by_the_one_beside_it() {
    if !is_there("gcc") {
        return;
    }
    let ground = Ground::new();
    let hello = C.shared("examples/hello.c", &ground);
    let mut greeter = ground.start(&C.shared("examples/greeter.c", &ground), &[]);
    greeter.wait_for(&["the greeter is there"]);
    let mut hello = ground.start(&hello, &[]);
    hello.wait_for(&["Hello, Ankle"]);
    assert_eq!((hello.wait_for_end(), greeter.wait_for_end()), (Some(0), Some(0)));
}

#[test]
fn the_library_can_be_linked_statically_and_the_wrapper_compiled_as_cpp20() {
    if !is_there("gcc") || !is_there("g++") {
        return;
    }
    let ground = Ground::new();
    let sensor = C.static_("examples/sensor.c", &ground);
    let mut drive = ground.start(&CPP20.shared("examples/drive.cpp", &ground), &[]);
    drive.wait_for(&["drive is"]);
    let mut sensor = ground.start(&sensor, &["3"]);
    assert_eq!(sensor.wait_for_end(), Some(0));
    drive.wait_for(&["last angle was number 3"]);
}

/// Plays the drive until the sensor asks at its end; the last angle that came.
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
        // The last one is Control, which overtakes what waits of the Stream.
        if angle.number > last.1 {
            last = (angle.degrees, angle.number);
        }
    }
}

#[test]
fn c_is_driven_by_rust() {
    if !is_there("gcc") {
        return;
    }
    let ground = Ground::new();
    let mut drive = endpoint(&ground, Registration::new().name("knee.drive"));
    let mut sensor = ground.start(&C.shared("examples/sensor.c", &ground), &["50"]);
    assert_eq!(drive_in_rust(&mut drive), (0.0, 50));
    sensor.wait_for(&["the drive of node knee is at number 50"]);
    assert_eq!(sensor.wait_for_end(), Some(0));
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
fn the_receiver_in_cpp_of_the_bench_sends_back_what_it_gets_with_its_age_where_that_is_asked_for() {
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
fn a_type_of_rust_is_read_and_written_by_c() {
    if !is_there("gcc") {
        return;
    }
    let ground = Ground::new();
    let mut holder = ground.start(&C.shared("tests/programs/holder.c", &ground), &[]);
    holder.wait_for(&["ready"]);
    let mut asking = endpoint(&ground, Registration::new());
    let to = resolve(&mut asking, "holder");
    let doubled: Torque = asking.message(to, &Torque { newton_metres: 2.5 }).ask(WATCHDOG).unwrap();
    assert_eq!(doubled, Torque { newton_metres: 5.0 });
}

#[test]
fn the_death_of_a_process_in_c_is_noticed_and_what_it_had_in_hand_has_failed() {
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
fn a_program_in_c_is_told_of_its_nodes_death_and_comes_back_with_it() {
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
fn what_c_does_wrong_is_refused_in_words() {
    if !is_there("gcc") {
        return;
    }
    let ground = Ground::new();
    ground.run(&C.shared("tests/programs/misuse.c", &ground), "all refused");
}

#[test]
fn the_wrapper_in_cpp_settles_at_the_end_of_a_scope_and_throws_errors() {
    if !is_there("g++") {
        return;
    }
    let ground = Ground::new();
    ground.run(&CPP.shared("tests/programs/wrapper.cpp", &ground), "all well");
}

#[test]
fn valgrind_finds_no_error_and_no_leak() {
    if !is_there("gcc") || !is_there("valgrind") {
        return;
    }
    let ground = Ground::new();
    let program = C.shared("tests/programs/misuse.c", &ground);
    let mut watched = ground.start_under(&VALGRIND, &program, &[]);
    let end = watched.wait_for_end();
    let said = watched.said().join("\n");
    assert_eq!(end, Some(0), "{said}");
    println!("{said}");
}

/// Each beside a partner in Rust: how slow it gets under valgrind is then nobody's matter.
#[test]
fn the_examples_are_clean_under_valgrind() {
    if !is_there("gcc") || !is_there("g++") || !is_there("valgrind") {
        return;
    }
    let ground = Ground::new();
    let mut drive = endpoint(&ground, Registration::new().name("knee.drive"));
    let mut sensor = ground.start_under(&VALGRIND, &C.shared("examples/sensor.c", &ground), &["5"]);
    assert_eq!(drive_in_rust(&mut drive).1, 5);
    assert_eq!(sensor.wait_for_end(), Some(0), "{}", sensor.said().join("\n"));
    drive.unregister().unwrap();
    let mut drive = ground.start_under(&VALGRIND, &CPP.shared("examples/drive.cpp", &ground), &[]);
    drive.wait_for(&["drive is"]);
    let mut sensor = endpoint(&ground, Registration::new());
    let to = resolve(&mut sensor, "knee.drive");
    let question = sensor.create_message(to, Kind::named("demo.drive_report"), 0).unwrap();
    let answer = sensor.loaned(question).ask_raw(WATCHDOG).unwrap();
    assert_eq!(answer.decode::<DriveReport>().unwrap(), DriveReport { degrees: 0.0, number: 0 });
    assert_eq!(drive.wait_for_end(), Some(0), "{}", drive.said().join("\n"));
}

#[test]
fn a_send_in_c_waits_for_room_as_long_as_it_says_and_loses_nothing() {
    if !is_there("gcc") {
        return;
    }
    for way in ["rings", "socket"] {
        let ground = Ground::new();
        let mut room = ground.start(&C.shared("tests/programs/room.c", &ground), &[way]);
        room.wait_for(&["stop it"]);
        ground.node.freeze();
        room.tell("go");
        room.wait_for(&["let it go on"]);
        ground.node.signal(Signal::CONT);
        room.tell("go");
        room.wait_for(&["all came"]);
        assert_eq!(room.wait_for_end(), Some(0));
    }
}

#[test]
fn axes_in_c_come_up_and_step_with_one_in_rust() {
    if !is_there("gcc") {
        return;
    }
    let ground = Ground::new();
    let axis = C.shared("examples/axis.c", &ground);
    let start = |name| ground.start(&axis, &[name]);
    let mut in_c = [start("knee.axis"), start("ankle.axis")];
    let axes = ["hip.axis", "knee.axis", "ankle.axis"];
    let mut hip = endpoint(&ground, Registration::new().name("hip.axis"));
    assert_eq!(hip.meet(&Barrier::phase("homed", axes).within(WATCHDOG)).unwrap(), 1);
    in_c.iter_mut().for_each(|axis| drop(axis.wait_for(&["all axes are homed"])));
    for round in 1..=3 {
        assert_eq!(hip.meet(&Barrier::new("step", axes).within(WATCHDOG)).unwrap(), round);
        in_c.iter_mut().for_each(|axis| drop(axis.wait_for(&[&format!("step {round}")])));
    }
    in_c.iter_mut().for_each(|axis| assert_eq!(axis.wait_for_end(), Some(0)));
}

#[test]
fn a_barrier_that_does_not_open_says_the_same_in_c_and_in_rust() {
    if !is_there("gcc") {
        return;
    }
    let ground = Ground::new();
    let mut hip = endpoint(&ground, Registration::new().name("hip"));
    let within = Duration::from_millis(20);
    let mut says = |barrier: Barrier| hip.meet(&barrier.within(within)).unwrap_err().to_string();
    let late = says(Barrier::new("ready", ["hip", "knee"]));
    let late_phase = says(Barrier::phase("ready", ["hip", "knee"]));
    let no_party = says(Barrier::new("ready", ["knee", "ankle"]));
    assert!(late.contains("knee is missing (not there)"), "{late}");
    hip.unregister().unwrap();
    let mut program = ground.start(&C.shared("tests/programs/barriers.c", &ground), &[]);
    for line in [
        format!("late -21 {late}"),
        format!("late phase -21 {late_phase}"),
        format!("no party -3 {no_party}"),
        "alone 0 done".to_owned(),
        "again 0 done".to_owned(),
        "generation 2".to_owned(),
        "no barrier -1 `barrier` is NULL".to_owned(),
        "no endpoint -13".to_owned(),
        "odd flags -1 `barrier.flags` is 0x40".to_owned(),
        "reserved -1 `barrier.reserved` is 7".to_owned(),
        "no texts -1 `barrier.parties` is NULL".to_owned(),
    ] {
        program.wait_for(&[&line]);
    }
    assert_eq!(program.wait_for_end(), Some(0));
}
