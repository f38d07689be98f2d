//! Two programs on one node, each in a process of its own: a sensor that streams angles to a drive.
//!
//! Run it in three terminals, the node first: `cargo run -p sinew-node --
//! bindings/c/examples/knee.toml`, `cargo run -p sinew-examples --example knee -- drive`, and `cargo run -p
//! sinew-examples --example knee -- sensor`. A second argument is the `lncl.socket` of another node.

use std::{error::Error, thread};

use sinew::{NodeApi, Registration, client::ApiError, message::Rejection, prelude::*};

payload!("demo.calibrate" => struct Calibrate { zero_degrees: f32 });
payload!("demo.joint_angle", Stream, expires_after = 20 ms => struct JointAngle { degrees: f32 });

const SECOND: Duration = Duration::from_secs(1);

fn main() -> Result<(), Box<dyn Error>> {
    let words: Vec<String> = std::env::args().collect();
    let socket = words.get(2).map_or("/tmp/sinew-knee.sock", String::as_str);
    let node = NodeApi::connect(socket)?;
    match words.get(1).map(String::as_str) {
        Some("drive") => drive(&node)?,
        Some("sensor") => sensor(&node)?,
        _ => return Err("say which of the two: drive or sensor".into()),
    }
    Ok(())
}

// ANCHOR: drive
fn drive(node: &NodeApi) -> Result<(), ApiError> {
    let mut drive = node.register_transport_address(Registration::new().name("knee.drive"))?;
    println!("the drive is {} on node {}", drive.tid(), drive.node_name());
    // Ends when nothing has come for 10 s.
    while let Some(message) = drive.receive(10 * SECOND)? {
        if message.kind() == Calibrate::KIND {
            match message.decode() {
                Ok(Calibrate { zero_degrees }) => println!("calibrated: zero is at {zero_degrees} degrees"),
                Err(error) => eprintln!("from {}: {error}", message.source()),
            }
        } else if message.kind() == JointAngle::KIND {
            let age = message.age(Time::now());
            match message.decode() {
                Ok(JointAngle { degrees }) => println!("the sensor is at {degrees} degrees, {age:?} ago"),
                Err(error) => eprintln!("from {}: {error}", message.source()),
            }
        } else {
            message.settle(Outcome::Rejected(Rejection::UnknownKind));
        }
    }
    Ok(())
}
// ANCHOR_END: drive

// ANCHOR: sensor
fn sensor(node: &NodeApi) -> Result<(), ApiError> {
    // Returns when the drive is ready.
    let mut sensor = node.register_transport_address(Registration::new().requires(["knee.drive"]))?;
    let outcome = sensor.message("knee.drive", &Calibrate { zero_degrees: 0.5 }).confirmed(SECOND)?;
    println!("calibrate: {outcome:?}");
    // A loop looks a name up once, and sends to the TID.
    let Some(drive) = sensor.resolve("knee.drive", SECOND)? else { return Ok(()) };
    for number in 0..10_u8 {
        sensor.send(drive, &JointAngle { degrees: f32::from(number) })?;
        thread::sleep(Duration::from_millis(10)); // the period of the stream
    }
    sensor.unregister()
}
// ANCHOR_END: sensor
