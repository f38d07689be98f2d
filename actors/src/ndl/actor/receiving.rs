//! Reading datagrams, and what of them is looked at.

use std::{io, net::SocketAddr, rc::Rc, time::Duration};

use sinew_runtime::time::Time;

use super::Shell;
use crate::{
    ndl::{
        core::{Place, Way},
        datagram::{DATAGRAM_MAX, maker_of},
    },
    secured::SEAL_LEN,
};

/// Rest after a failed read, so that a socket that fails for good does not take the whole thread.
const READ_FAILED_REST: Duration = Duration::from_millis(10);
/// Datagrams that are read without a pause between them; then there is a rest, so that a flood leaves a CPU to others, whatever this thread's
/// priority is and however long each of them takes to be checked.
const DATAGRAMS_IN_A_ROW: u32 = 128;
const REST: Duration = Duration::from_millis(1);

/// Reads datagrams for as long as this instance is the current one. Answers leave from here.
pub(super) async fn receive(shell: Rc<Shell>, socket: tokio::net::UdpSocket, (here, way): (SocketAddr, Way)) {
    // One byte more than is taken: a longer datagram is noticed, not cut.
    let mut buffer = [0; DATAGRAM_MAX + SEAL_LEN + 1];
    let mut in_a_row = 0;
    loop {
        if in_a_row == DATAGRAMS_IN_A_ROW {
            in_a_row = 0;
            tokio::time::sleep(REST).await;
        }
        let received = match socket.try_recv_from(&mut buffer) {
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => {
                in_a_row = 0;
                socket.recv_from(&mut buffer).await
            }
            received => received,
        };
        in_a_row += 1;
        match received {
            Ok((length, there)) => {
                let Some(bytes) = shell.unsealed(there, &buffer[..length]) else { continue };
                if !shell.feed(|core, now| core.receive(now, Place { there, here }, way, bytes)) {
                    return;
                }
            }
            Err(error) => {
                shell.refusals.count(Time::now(), "NDL socket not readable", &error);
                tokio::time::sleep(READ_FAILED_REST).await;
            }
        }
    }
}

impl Shell {
    /// What came from `from`, if this node has no keys, or a node of its project made it. spec: NDL-1.3
    fn unsealed<'a>(&self, from: SocketAddr, bytes: &'a [u8]) -> Option<&'a [u8]> {
        let Some(secured) = self.stores.secured.get() else { return Some(bytes) };
        let now = Time::now();
        let refused = |why: &&str| {
            self.refusals.count(
                now,
                "NDL datagram not of this project's keys",
                &format_args!("{from}: {why}"),
            );
        };
        secured.unseal(now, bytes, maker_of).inspect_err(refused).ok()
    }
}
