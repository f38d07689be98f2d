//! Protected commands of programs in C: to each other, to Rust, and from Rust.

#[path = "programs/ground.rs"]
#[expect(dead_code, reason = "it is for other programs, too")]
mod ground;

use std::{
    sync::atomic::{AtomicBool, Ordering},
    time::{Duration, Instant},
};

use ground::{C, Ground, WATCHDOG, endpoint, is_there};
use serde::{Deserialize, Serialize};
use sinew::{Endpoint, Payload, Registration, Tid, message::Kind, protection::Protection};

/// As in `examples/commands.c`.
#[derive(Debug, PartialEq, Serialize, Deserialize)]
struct Torque {
    newton_metres: f32,
}

impl Payload for Torque {
    const NAME: &'static str = "demo.commanded_torque";
    const PROTECTION: Option<Protection> = Some(Protection::of_period(Duration::from_millis(500)));
}

const SOON: Duration = Duration::from_millis(20);

/// The TID of a program that comes soon.
fn await_name(endpoint: &mut Endpoint, name: &str) -> Tid {
    let begun = Instant::now();
    loop {
        if let Some(tid) = endpoint.resolve(name, WATCHDOG).expect("the node answers") {
            return tid;
        }
        assert!(begun.elapsed() < WATCHDOG, "{name} did not come");
        std::thread::sleep(SOON);
    }
}

#[test]
fn each_error_makes_an_output_safe_until_it_is_armed_again() {
    if !is_there("gcc") {
        return;
    }
    let ground = Ground::new();
    ground.run(&C.shared("tests/programs/protected.c", &ground), "all well");
}

#[test]
fn a_drive_in_c_follows_a_control_in_c_and_is_safe_when_that_ends() {
    if !is_there("gcc") {
        return;
    }
    let ground = Ground::new();
    let commands = C.shared("examples/commands.c", &ground);
    let mut drive = ground.start(&commands, &["drive"]);
    let mut control = ground.start(&commands, &["control", "100"]);
    drive.wait_for(&["moved by 2.5 Nm"]);
    assert_eq!(control.wait_for_end(), Some(0));
    drive.wait_for(&["safe: no good message came in time"]);
    assert_eq!(drive.wait_for_end(), Some(0));
}

#[test]
fn a_guard_in_rust_lets_through_what_c_has_sealed() {
    if !is_there("gcc") {
        return;
    }
    let ground = Ground::new();
    let mut drive = endpoint(&ground, Registration::new().name("knee.drive"));
    let _control = ground.start(&C.shared("examples/commands.c", &ground), &["control", "100000"]);
    let source = await_name(&mut drive, "knee.control");
    let guard = drive.guard::<Torque, _>(source, 0.0_f32, |torque, _| *torque = 0.0).expect("a thread");
    let begun = Instant::now();
    loop {
        // Refused until enough good ones have come.
        let _ = guard.arm();
        if let Some(received) = drive.receive(SOON).expect("the node lives")
            && received.kind() == Torque::KIND
        {
            let torque: Torque = received.decode().expect("it is a torque, and came through the guard");
            assert_eq!(torque, Torque { newton_metres: 2.5 });
            assert_eq!((guard.tally().corrupt, guard.tally().unreadable), (0, 0));
            return;
        }
        assert!(begun.elapsed() < WATCHDOG, "nothing came through: {:?}", guard.tally());
    }
}

#[test]
fn a_guard_in_c_lets_through_what_rust_has_sealed_and_not_what_it_has_not() {
    if !is_there("gcc") {
        return;
    }
    let ground = Ground::new();
    let mut control = endpoint(&ground, Registration::new().name("knee.control"));
    let mut drive = ground.start(&C.shared("examples/commands.c", &ground), &["drive"]);
    let to = await_name(&mut control, "knee.drive");
    let (has_moved, is_over) = (AtomicBool::new(false), AtomicBool::new(false));
    std::thread::scope(|scope| {
        scope.spawn(|| {
            // One more than is borne; good ones go on coming.
            let mut bare = 2;
            send_until(&mut control, &is_over, |control| {
                control.send(to, &Torque { newton_metres: 3.5 }).expect("the node takes it");
                if has_moved.load(Ordering::Relaxed) && bare > 0 {
                    bare -= 1;
                    send_bare(control, to);
                }
            });
        });
        drive.wait_for(&["moved by 3.5 Nm"]);
        has_moved.store(true, Ordering::Relaxed);
        // Then: what is not sealed moves nothing, and is what makes the output safe.
        drive.wait_for(&["safe: too many bad messages came"]);
        is_over.store(true, Ordering::Relaxed);
    });
    assert_eq!(drive.wait_for_end(), Some(0));
    assert!(!drive.said().iter().any(|line| line.contains("moved by 32.0 Nm")));
}

/// Sealed, of the same name and as long, and no torque of the drive's.
#[derive(Serialize, Deserialize)]
struct OtherTorque {
    newton_meters: f32,
}

impl Payload for OtherTorque {
    const NAME: &'static str = Torque::NAME;
    const PROTECTION: Option<Protection> = Torque::PROTECTION;
}

#[test]
fn a_drive_in_c_that_cannot_read_a_good_command_makes_its_output_safe() {
    if !is_there("gcc") {
        return;
    }
    let ground = Ground::new();
    let mut control = endpoint(&ground, Registration::new().name("knee.control"));
    let mut drive = ground.start(&C.shared("examples/commands.c", &ground), &["drive"]);
    let to = await_name(&mut control, "knee.drive");
    let is_over = AtomicBool::new(false);
    std::thread::scope(|scope| {
        scope.spawn(|| {
            send_until(&mut control, &is_over, |control| {
                control.send(to, &OtherTorque { newton_meters: 3.5 }).expect("the node takes it");
            });
        });
        drive.wait_for(&["safe: it was tripped"]);
        is_over.store(true, Ordering::Relaxed);
    });
    assert_eq!(drive.wait_for_end(), Some(0));
    assert!(!drive.said().iter().any(|line| line.contains("moved by")));
}

/// A torque without an envelope.
fn send_bare(control: &mut Endpoint, to: Tid) {
    let mut bare = control.create_message(to, Torque::KIND, 20).expect("it is short");
    bare[..15].copy_from_slice(b"\x81\xadnewton_metres");
    bare[15..].copy_from_slice(&[0xca, 0x42, 0, 0, 0]);
    control.loaned(bare).send().expect("the node takes it");
}

/// Sends, each 20 ms or so, and hears what it has to quote.
fn send_until(control: &mut Endpoint, is_over: &AtomicBool, mut send: impl FnMut(&mut Endpoint)) {
    let begun = Instant::now();
    while !is_over.load(Ordering::Relaxed) && begun.elapsed() < WATCHDOG {
        send(control);
        // The first echo may be before what it is for, and is for nobody.
        if let Some(received) = control.receive(SOON).expect("the node lives") {
            assert_eq!(received.kind(), Kind::named("sinew.echo"));
        }
    }
}
