//! Two programs on one node, each in a process of its own: `knee drive` in one terminal, `knee sensor` in another.
//!
//! The sensor requires the drive. It sends a calibration command in class Control and waits for its outcome. Then it sends ten angles in class
//! Stream, in which a newer value replaces one that still waits. The node is `sinew-node`, or any other node. The second argument is the
//! `lncl.socket` of that node.

use std::{
    io::{self, Write as _},
    process::ExitCode,
    thread,
    time::Duration,
};

use sinew::{NodeApi, Outcome, Payload, Registration, Time, client::ApiError, message::Rejection, payload};

payload!("demo.calibrate" => struct Calibrate { zero_degrees: f32 });
payload!("demo.joint_angle", Stream, expires_after = 20 ms => struct JointAngle { degrees: f32 });

const SECOND: Duration = Duration::from_secs(1);

fn main() -> ExitCode {
    let Err(error) = run() else { return ExitCode::SUCCESS };
    // A reader that closes its pipe, as `head` does, is no error.
    if matches!(&error, Error::Output(error) if error.kind() == io::ErrorKind::BrokenPipe) {
        return ExitCode::SUCCESS;
    }
    // Nothing can be done where standard error takes nothing either.
    let _ = writeln!(io::stderr(), "knee: {error}");
    ExitCode::FAILURE
}

/// Why the program ends early.
#[derive(Debug, thiserror::Error)]
enum Error {
    #[error(transparent)]
    Api(#[from] ApiError),
    #[error("standard output takes nothing: {0}")]
    Output(#[from] io::Error),
}

fn run() -> Result<(), Error> {
    let words: Vec<String> = std::env::args().collect();
    let role = words.get(1).map_or("sensor", String::as_str);
    let path = words.get(2).map_or("/tmp/sinew-knee.sock", String::as_str);
    let node = NodeApi::connect(path)?;
    if role == "drive" { drive(&node) } else { sensor(&node) }
}

fn drive(node: &NodeApi) -> Result<(), Error> {
    let mut drive = node.register_transport_address(Registration::new().name("knee.drive"))?;
    while let Some(message) = drive.receive(10 * SECOND)? {
        if message.kind() == Calibrate::KIND {
            match message.decode() {
                Ok(Calibrate { zero_degrees }) => {
                    writeln!(io::stdout(), "calibrated: zero is at {zero_degrees} degrees")?;
                }
                Err(error) => writeln!(io::stderr(), "from {}: {error}", message.source())?,
            }
        } else if message.kind() == JointAngle::KIND {
            let age = message.age(Time::now());
            match message.decode() {
                Ok(JointAngle { degrees }) => {
                    writeln!(io::stdout(), "{} is at {degrees} degrees, {age:?} ago", message.source())?;
                }
                Err(error) => writeln!(io::stderr(), "from {}: {error}", message.source())?,
            }
        } else {
            message.settle(Outcome::Rejected(Rejection::UnknownKind));
        }
    }
    Ok(())
}

fn sensor(node: &NodeApi) -> Result<(), Error> {
    let registration = Registration::new().requires(["knee.drive"]);
    let mut sensor = node.register_transport_address(registration)?;
    let drive = sensor.resolve("knee.drive", SECOND)?.expect("it is ready: it was required");
    let outcome = sensor.message(drive, &Calibrate { zero_degrees: 0.5 }).confirmed(SECOND)?;
    writeln!(io::stdout(), "calibrate: {outcome:?}")?;
    for number in 0..10_u8 {
        sensor.send(drive, &JointAngle { degrees: f32::from(number) })?;
        thread::sleep(Duration::from_millis(10)); // the period of the stream
    }
    Ok(())
}
