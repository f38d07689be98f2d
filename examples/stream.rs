//! Newest wins: of values of class Stream that wait only the newest is handled, of commands (Control) all.
//!
//! The sensor sends five positions and five commands at once, before the drive has its turn.
//!
//! Run it: `cargo run -p sinew-examples --example stream`

use std::process::ExitCode;

use sinew::{message::SendError, prelude::*};

// A measurement. One that has waited for longer than 10 s would not be handled.
payload!("stream.position", Stream, expires_after = 10 s => struct Position { number: u32 });
payload!("stream.command" => struct Command { number: u32 });

struct Sensor;

impl Actor for Sensor {
    type Context = AppContext<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        if let Err(error) = send_all(ctx) {
            eprintln!("not sent: {error}");
        }
    }
}

fn send_all(ctx: &AppContext<Sensor>) -> Result<(), SendError> {
    for number in 1..=5 {
        ctx.send("drive", &Position { number })?;
        ctx.send("drive", &Command { number })?;
    }
    Ok(())
}

struct Drive;

impl Actor for Drive {
    type Context = AppContext<Self>;
}

impl Handler<Delivery<Command>> for Drive {
    type Result = ();

    fn handle(&mut self, command: Delivery<Command>, _: &mut Self::Context) {
        println!("command {}", command.number);
    }
}

impl Handler<Delivery<Position>> for Drive {
    type Result = ();

    fn handle(&mut self, position: Delivery<Position>, ctx: &mut Self::Context) {
        println!("position {}", position.number); // after the commands: Control goes first
        ctx.stop();
    }
}

fn main() -> ExitCode {
    // Both are on the thread that applications share by default, so that the sensor's turn is over before the drive's.
    let sensor = AppSpec::new("sensor", || Sensor).requires(["drive"]);
    let drive = AppSpec::new("drive", || Drive).handles::<Position>().handles::<Command>();
    let node = Node::builder("stream").configure(|config| config.project = "stream".to_owned());
    node.app(sensor)
        .app(drive.restart(Restart::Transient).significant())
        .auto_shutdown(AutoShutdown::AnySignificant)
        .run()
}
