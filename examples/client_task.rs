//! Two applications in tasks of tokio, in a program that is not the node: the calls of their endpoints are awaited.
//!
//! Run it: `cargo run -p sinew-examples --example client_task`

use std::error::Error;

use sinew::{NodeApi, Registration, client::ApiError, prelude::*};

payload!("client_task.torque" => struct Torque { newton_metres: f32 });

const LIMIT_NM: f32 = 40.0;

// ANCHOR: client
/// Answers requests with the torque that it applies.
async fn drive(node: &NodeApi, requests: usize) -> Result<(), ApiError> {
    let mut drive = node.register_transport_address_async(Registration::new().name("drive")).await?;
    for _ in 0..requests {
        let request = drive.receive().await?;
        let Torque { newton_metres } = request.decode()?;
        drive.reply(&request, &Torque { newton_metres: newton_metres.min(LIMIT_NM) }).await?;
    }
    drive.unregister().await
}

/// Asks the drive for torques. Each request ends within a second.
async fn control(node: &NodeApi, torques: [f32; 3]) -> Result<(), ApiError> {
    let registration = Registration::new().requires(["drive"]); // registered when the drive is ready
    let mut control = node.register_transport_address_async(registration).await?;
    for newton_metres in torques {
        let wanted = Torque { newton_metres };
        let applied: Torque = control.message("drive", &wanted).ask(Duration::from_secs(1)).await?;
        println!("asked for {newton_metres} Nm, the drive applies {} Nm", applied.newton_metres);
    }
    control.unregister().await
}
// ANCHOR_END: client

#[tokio::main(flavor = "current_thread")]
async fn main() -> Result<(), Box<dyn Error>> {
    // In a robot the node is another program, with a path such as /run/sinew/knee.sock.
    let socket = std::env::temp_dir().join("sinew-client_task.sock");
    let builder = Node::builder("client_task").configure(|config| {
        config.project = "client_task".to_owned();
        config.lncl.socket = Some(socket.clone());
    });
    let node = builder.start()?;
    let api = NodeApi::connect(&socket)?;
    let torques = [10.0, 30.0, 50.0];
    tokio::try_join!(drive(&api, torques.len()), control(&api, torques))?;
    node.stop();
    Ok(())
}
