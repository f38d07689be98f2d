//! Attackers that start TLS handshakes, which cost the node more than the attacker, and complete none.

use std::{
    collections::VecDeque,
    io::{Read as _, Write as _},
    net::TcpStream,
    sync::Arc,
    time::Duration,
};

use sinew::security::{Tls, rustls::ClientConnection};

use super::{
    super::raw_peer::{Client, client},
    Happened, Scene, done,
};

const THREADS: usize = 2;
/// Connections of each thread that stay open, so that the node continues with them.
const HELD: usize = 256;
const TIMEOUT: Duration = Duration::from_millis(200);

/// The first bytes of a valid handshake. The node answers before it checks the identity.
pub(super) fn beginning(client: &Arc<Client>) -> Vec<u8> {
    let mut tls = ClientConnection::new(client.clone(), Tls::server_name()).expect("a configuration of ours");
    let mut bytes = Vec::new();
    tls.write_tls(&mut bytes).expect("memory takes it");
    bytes
}

pub(super) fn begun(scene: &Scene<'_>) -> Happened {
    let beginning = beginning(&client(None));
    let begun = scene.on_threads(THREADS, |_| {
        let (mut begun, mut answered, mut held) = (0_u64, 0_u64, VecDeque::new());
        while !scene.is_over() {
            let connected = TcpStream::connect_timeout(&scene.target.connections, TIMEOUT);
            if let Ok(mut socket) = connected {
                // The node may have closed it already.
                begun += u64::from(socket.write_all(&beginning).is_ok());
                held.push_back(socket);
            }
            if held.len() > HELD {
                answered += u64::from(held.pop_front().is_some_and(|socket| is_answered(&socket)));
            }
        }
        (begun, answered + held.iter().filter(|socket| is_answered(socket)).count() as u64)
    });
    let (begun, answered) = begun.iter().fold((0, 0), |sum, one| (sum.0 + one.0, sum.1 + one.1));
    let mut broken = Vec::new();
    if begun == 0 || answered == 0 {
        broken.push(format!("{begun} handshakes were begun, and {answered} answered: the node had no work"));
    }
    Happened {
        done: done("handshakes", begun),
        ..Happened::new(format!("{begun} begun, {answered} answered with the node's own beginning"), broken)
    }
}

/// Returns whether the node has done its part and has sent its ServerHello.
fn is_answered(mut socket: &TcpStream) -> bool {
    const HANDSHAKE_RECORD: u8 = 0x16;
    let mut first = [0];
    socket.set_nonblocking(true).is_ok()
        && socket.read(&mut first).is_ok_and(|count| count == 1)
        && first == [HANDSHAKE_RECORD]
}
