//! Who speaks so slowly that he never comes to an end.

use std::{io::Write as _, net::TcpStream, time::Duration};

use super::{super::stranger::client, Happened, Scene, handshakes::beginning};

const CONNECTIONS: usize = 256;
const PACE: Duration = Duration::from_millis(100);
const PATIENCE: Duration = Duration::from_millis(200);

pub(super) fn drip(scene: &Scene<'_>) -> Happened {
    let beginning = beginning(&client(None));
    let seen = scene.on_threads(1, |_| {
        let mut connections: Vec<Option<(TcpStream, usize)>> = (0..CONNECTIONS).map(|_| None).collect();
        let (mut made, mut bytes) = (0_u64, 0_u64);
        while !scene.is_over() {
            for place in &mut connections {
                if place.is_none() {
                    *place = TcpStream::connect_timeout(&scene.robot.knee(), PATIENCE)
                        .ok()
                        .map(|socket| (socket, 0));
                    made += u64::from(place.is_some());
                }
                let Some((socket, said)) = place else { continue };
                let byte = beginning.get(*said..=*said).unwrap_or(&[0]);
                if socket.write_all(byte).is_ok() {
                    *said += 1;
                    bytes += 1;
                } else {
                    // The node has closed it: he comes again.
                    *place = None;
                }
            }
            scene.rest(PACE);
        }
        (made, bytes)
    });
    let (made, bytes) = seen[0];
    let broken = if bytes == 0 { vec!["nothing was said".to_owned()] } else { Vec::new() };
    Happened { what: format!("{made} connections, {bytes} bytes, one at a time"), broken }
}
