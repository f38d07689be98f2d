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

/// Waits for a program that will register this name; returns its TID.
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
fn each_error_makes_the_output_safe_until_armed() {
    if !is_there("gcc") {
        return;
    }
    let ground = Ground::new();
    ground.run(&C.shared("tests/programs/protected.c", &ground), "all well");
}

#[test]
fn drive_follows_control_and_ends_safe() {
    if !is_there("gcc") {
        return;
    }
    let ground = Ground::new();
    let commands = C.shared("examples/commands.c", &ground);
    let mut drive = ground.start(&commands, &["drive"]);
    let mut control = ground.start(&commands, &["control", "100"]);
    drive.wait_for(&["moved by 2.5 Nm"]);
    assert_eq!(control.wait_for_exit(), Some(0));
    drive.wait_for(&["safe: no good message came in time"]);
    assert_eq!(drive.wait_for_exit(), Some(0));
}

#[test]
fn rust_guard_accepts_commands_sealed_in_c() {
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
        // Rejected until enough good ones have arrived.
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
fn c_guard_accepts_only_commands_sealed_in_rust() {
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
            // One more than the limit; good ones keep arriving.
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
        // then: messages without a seal move nothing, and make the output safe
        drive.wait_for(&["safe: too many bad messages came"]);
        is_over.store(true, Ordering::Relaxed);
    });
    assert_eq!(drive.wait_for_exit(), Some(0));
    assert!(!drive.output().iter().any(|line| line.contains("moved by 32.0 Nm")));
}

/// Sealed, with the same name and length, but not a torque of the drive.
#[derive(Serialize, Deserialize)]
struct OtherTorque {
    newton_meters: f32,
}

impl Payload for OtherTorque {
    const NAME: &'static str = Torque::NAME;
    const PROTECTION: Option<Protection> = Torque::PROTECTION;
}

#[test]
fn c_drive_makes_output_safe_on_unreadable_command() {
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
    assert_eq!(drive.wait_for_exit(), Some(0));
    assert!(!drive.output().iter().any(|line| line.contains("moved by")));
}

/// Sends a torque without an envelope.
fn send_bare(control: &mut Endpoint, to: Tid) {
    let mut bare = control.create_message(to, Torque::KIND, 20).expect("it is short");
    bare[..15].copy_from_slice(b"\x81\xadnewton_metres");
    bare[15..].copy_from_slice(&[0xca, 0x42, 0, 0, 0]);
    control.loaned(bare).send().expect("the node takes it");
}

/// Sends about every 20 ms, and receives the echoes to quote.
fn send_until(control: &mut Endpoint, is_over: &AtomicBool, mut send: impl FnMut(&mut Endpoint)) {
    let begun = Instant::now();
    while !is_over.load(Ordering::Relaxed) && begun.elapsed() < WATCHDOG {
        send(control);
        // The first echo may be sent before the first protected message; it is delivered here and ignored.
        if let Some(received) = control.receive(SOON).expect("the node lives") {
            assert_eq!(received.kind(), Kind::named("sinew.echo"));
        }
    }
}
