//! Who begins handshakes of TLS, which cost the node more than himself, and ends none.

use std::{collections::VecDeque, io::Write as _, net::TcpStream, sync::Arc, time::Duration};

use sinew::security::{Tls, rustls::ClientConnection};

use super::{
    super::stranger::{Client, client},
    Happened, Scene,
};

const THREADS: usize = 2;
/// Connections of each thread that are left open, so that the node goes on with them.
const HELD: usize = 256;
const PATIENCE: Duration = Duration::from_millis(200);

/// The first bytes of a right handshake: whose they are is not asked before the node has answered.
pub(super) fn beginning(client: &Arc<Client>) -> Vec<u8> {
    let mut tls = ClientConnection::new(client.clone(), Tls::server_name()).expect("a configuration of ours");
    let mut bytes = Vec::new();
    tls.write_tls(&mut bytes).expect("memory takes it");
    bytes
}

pub(super) fn begun(scene: &Scene<'_>) -> Happened {
    let beginning = beginning(&client(None));
    let begun = scene.on_threads(THREADS, |_| {
        let (mut begun, mut held) = (0_u64, VecDeque::new());
        while !scene.is_over() {
            let connected = TcpStream::connect_timeout(&scene.robot.knee(), PATIENCE);
            if let Ok(mut socket) = connected {
                // It may have been closed already.
                begun += u64::from(socket.write_all(&beginning).is_ok());
                held.push_back(socket);
            }
            if held.len() > HELD {
                held.pop_front();
            }
        }
        begun
    });
    let begun: u64 = begun.iter().sum();
    let broken = if begun == 0 { vec!["no handshake was begun".to_owned()] } else { Vec::new() };
    Happened { what: format!("{begun} begun"), broken }
}
