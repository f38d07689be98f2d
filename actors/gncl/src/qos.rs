//! Network marks of each class, so that Control does not wait behind Bulk in the queues of a network.

use std::net::SocketAddr;

use tokio::net::TcpStream;

use super::core::Lane;

/// A class's mark: the code point for switches and access points (DSCP), and the priority in this host's own queues.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct QosMarking {
    /// RFC 4594, table 3.
    code_point: u32,
    /// `SO_PRIORITY`, of which 0 to 6 need no privileges; pfifo_fast and prio send from 6 before 0 before 2.
    priority: u32,
}

impl QosMarking {
    const fn of(lane: Lane) -> Self {
        match lane {
            // Expedited forwarding (RFC 3246), TC_PRIO_INTERACTIVE: like voice, with little volume.
            Lane::Control => Self { code_point: 46, priority: 6 },
            // Assured forwarding 41 (RFC 2597), TC_PRIO_BESTEFFORT: values that are useful only while they are new.
            Lane::Stream => Self { code_point: 34, priority: 0 },
            // Assured forwarding 11, TC_PRIO_BULK: much data that can wait.
            Lane::Bulk => Self { code_point: 10, priority: 2 },
        }
    }
}

/// Marks a connection that carries one class. If the system refuses, the connection stays unmarked.
#[cfg(target_os = "linux")]
pub(super) fn mark(socket: &TcpStream, lane: Lane) {
    let is_ipv6 = socket.local_addr().is_ok_and(|at| at.is_ipv6());
    let (socket, QosMarking { code_point, priority }) =
        (&socket2::SockRef::from(socket), QosMarking::of(lane));
    // The two low bits are for congestion (RFC 3168). The system derives a priority from this, so the
    // priority is set afterwards.
    set_code_point(socket, is_ipv6, code_point);
    let _ = socket.set_priority(priority);
}

/// Marks a socket at this address for datagrams with values of class Stream.
#[cfg(target_os = "linux")]
pub(super) fn mark_datagrams(socket: &socket2::Socket, at: SocketAddr) {
    let QosMarking { code_point, priority } = QosMarking::of(Lane::Stream);
    set_code_point(socket, at.is_ipv6(), code_point);
    let _ = socket.set_priority(priority);
}

#[cfg(target_os = "linux")]
fn set_code_point(socket: &socket2::Socket, is_ipv6: bool, code_point: u32) {
    let _ = if is_ipv6 { socket.set_tclass_v6(code_point << 2) } else { socket.set_tos_v4(code_point << 2) };
}

/// Marks nothing, likewise.
#[cfg(not(target_os = "linux"))]
pub(super) fn mark_datagrams(_: &socket2::Socket, _: SocketAddr) {}

/// Marks nothing: not every system has these options.
#[cfg(not(target_os = "linux"))]
pub(super) fn mark(_: &TcpStream, lane: Lane) {
    let _ = QosMarking::of(lane);
}

#[cfg(all(test, target_os = "linux"))]
mod tests {
    use std::net::Ipv4Addr;

    use socket2::SockRef;
    use tokio::net::TcpListener;

    use super::*;

    #[tokio::test(flavor = "current_thread")]
    async fn each_class_has_a_mark_of_its_own() {
        let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).await.unwrap();
        for (lane, code_point, priority) in
            [(Lane::Control, 46, 6), (Lane::Stream, 34, 0), (Lane::Bulk, 10, 2)]
        {
            let socket = TcpStream::connect(listener.local_addr().unwrap()).await.unwrap();
            mark(&socket, lane);
            let socket = SockRef::from(&socket);
            assert_eq!(
                (socket.tos_v4().unwrap() >> 2, socket.priority().unwrap()),
                (code_point, priority),
                "{lane:?}"
            );
        }
    }
}
