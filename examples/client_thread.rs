//! An application in a plain thread of a program that is not the node: an endpoint at the node's client socket.
//!
//! Run it: `cargo run -p sinew-examples --example client_thread`

use std::{error::Error, path::Path};

use sinew::{NodeApi, Registration, client::ApiError, prelude::*};

payload!("client_thread.move" => struct Move { degrees: f32 });
payload!("client_thread.get_angle" => struct GetAngle);
payload!("client_thread.angle" => struct Angle { degrees: f32 });

const SECOND: Duration = Duration::from_secs(1);

// ANCHOR: client
/// Needs no node in its program, and no async runtime.
fn client(socket: &Path) -> Result<(), ApiError> {
    let node = NodeApi::connect(socket)?;
    // Returns when the knee is ready.
    let registration = Registration::new().name("gait").requires(["knee"]);
    let mut gait = node.register_transport_address(registration)?;

    let outcome = gait.message("knee", &Move { degrees: 30.0 }).confirmed(SECOND)?;
    println!("gait: the move was {outcome:?}");
    let angle: Angle = gait.message("knee", &GetAngle).ask(SECOND)?;
    println!("gait: the knee answers {} degrees", angle.degrees);
    while let Some(message) = gait.receive(SECOND / 5)? {
        if message.kind() == Angle::KIND {
            println!("gait: the knee sent {} degrees", message.decode::<Angle>()?.degrees);
        }
    }
    gait.unregister()
}
// ANCHOR_END: client

struct Knee {
    degrees: f32,
}

impl Actor for Knee {
    type Context = AppContext<Self>;
}

impl Handler<Delivery<Move>> for Knee {
    type Result = ();

    fn handle(&mut self, command: Delivery<Move>, ctx: &mut Self::Context) {
        self.degrees = command.degrees;
        if let Err(error) = ctx.send(command.source, &Angle { degrees: self.degrees }) {
            eprintln!("not sent: {error}");
        }
    }
}

impl Handler<Delivery<GetAngle>> for Knee {
    type Result = ();

    fn handle(&mut self, request: Delivery<GetAngle>, ctx: &mut Self::Context) {
        if let Err(error) = ctx.reply(&request, &Angle { degrees: self.degrees }) {
            eprintln!("no reply: {error}");
        }
    }
}

fn main() -> Result<(), Box<dyn Error>> {
    // In a robot the node is another program, with a path such as /run/sinew/knee.sock.
    let socket = std::env::temp_dir().join("sinew-client_thread.sock");
    let node = Node::builder("client_thread").configure(|config| {
        config.project = "client_thread".to_owned();
        config.lncl.socket = Some(socket.clone());
    });
    let knee = AppSpec::new("knee", || Knee { degrees: 0.0 }).handles::<Move>().handles::<GetAngle>();
    let node = node.app(knee).start()?;
    client(&socket)?;
    node.stop();
    Ok(())
}
