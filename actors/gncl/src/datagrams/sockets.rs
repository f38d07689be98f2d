//! The sockets at which this node reads datagrams of its peers, and their announcement.

use std::{
    io,
    net::{IpAddr, Ipv4Addr, SocketAddr, SocketAddrV4, UdpSocket},
    sync::{Arc, Mutex},
};

use serde::{Deserialize, Serialize};
use sinew_model::{config::NodeConfig, refusals::Refusals};
use sinew_runtime::{lock, time::Time};
use socket2::{Domain, Protocol, Socket, Type};

use super::super::qos;

/// Receive buffer for datagrams that arrive while the IO thread is busy, if the system grants it
/// (`net.core.rmem_max`): 30 ms of a gigabit.
const RECEIVE_BUFFER: usize = 4 << 20;

/// A node's announcement of where it reads datagrams: payload of the frame DATAGRAMS. spec: DATAGRAM-2
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Announcement {
    /// UDP port; 0: none.
    pub(crate) port: u16,
    /// The key required in each datagram to it.
    pub(crate) key: u64,
    /// Address, as a number; 0: that of the connection that carries the announcement.
    #[serde(default)]
    pub(crate) address: u32,
}

/// One of this node's sockets, as its peers address it.
#[derive(Clone, Debug)]
pub(crate) struct BoundSocket {
    pub(crate) socket: Arc<UdpSocket>,
    at: SocketAddr,
    /// The address at which peers reach it, if it differs from `at`.
    outer: Option<SocketAddrV4>,
}

/// The node's sockets, one for each address at which it listens. They stay open while this layer is restarted.
#[derive(Debug, Default)]
pub(crate) struct Sockets(Mutex<Vec<BoundSocket>>);

impl Sockets {
    /// Binds a socket beside each listener, at the same port if that is free, and not NDL's.
    pub(crate) fn bind(&self, listeners: &[SocketAddr], config: &NodeConfig, refusals: &Refusals) {
        let (gncl, mut all) = (&config.gncl, lock(&self.0));
        for (nth, listener) in listeners.iter().enumerate() {
            // The first one is that of the interface.
            let outer = gncl.announce.filter(|_| nth == 0);
            let port = if listener.port() == config.ndl.port { 0 } else { listener.port() };
            match bind(*listener, port, gncl.marks) {
                Ok(bound) => all.push(BoundSocket { outer, ..bound }),
                // Values are then sent over the connection.
                Err(error) => {
                    refusals.count(
                        Time::now(),
                        "no socket for datagrams",
                        &format_args!("{listener}: {error}"),
                    );
                }
            }
        }
    }

    pub(crate) fn all(&self) -> Vec<BoundSocket> {
        lock(&self.0).clone()
    }

    /// Returns the socket for a connection: that of its local address, or of the node's interface. A socket
    /// of the other family cannot reach the peer and is not returned.
    pub(crate) fn beside(&self, connection: SocketAddr) -> Option<BoundSocket> {
        let all = lock(&self.0);
        let own = all.iter().find(|bound| connection.ip() == bound.at.ip());
        let of_family = || all.iter().find(|bound| connection.is_ipv4() == bound.at.is_ipv4());
        own.or_else(of_family).cloned()
    }

    pub(crate) fn close(&self) {
        lock(&self.0).clear();
    }
}

impl BoundSocket {
    /// Returns the announcement for a connection with this local address.
    pub(super) fn announcement(&self, connection: SocketAddr, key: u64) -> Announcement {
        if let Some(outer) = self.outer {
            return Announcement { port: outer.port(), key, address: outer.ip().to_bits() };
        }
        let is_there = connection.ip() == self.at.ip();
        let address = match self.at.ip() {
            IpAddr::V4(ip) if !is_there => ip.to_bits(),
            IpAddr::V4(_) | IpAddr::V6(_) => 0,
        };
        Announcement { port: self.at.port(), key, address }
    }
}

impl Announcement {
    /// Returns the address where the peer reads datagrams; its connection comes from `remote`.
    pub(super) fn target(self, remote: SocketAddr) -> Option<SocketAddr> {
        // The connection's remote address is used with its scope: a link-local address needs the interface.
        let mut at = remote;
        if self.address != 0 {
            at = (Ipv4Addr::from_bits(self.address), 0).into();
        }
        at.set_port(self.port);
        let is_a_host = match at.ip() {
            IpAddr::V4(ip) => !(ip.is_unspecified() || ip.is_broadcast() || ip.is_multicast()),
            IpAddr::V6(ip) => !(ip.is_unspecified() || ip.is_multicast()),
        };
        (self.port != 0 && is_a_host && at.is_ipv4() == remote.is_ipv4()).then_some(at)
    }
}

/// Binds a socket at the listener's address, at this port if that is free.
fn bind(listener: SocketAddr, port: u16, is_marked: bool) -> io::Result<BoundSocket> {
    let bound = |port| -> io::Result<Socket> {
        let socket = Socket::new(
            Domain::for_address(listener),
            Type::DGRAM.nonblocking().cloexec(),
            Some(Protocol::UDP),
        )?;
        // An interface that is down may come up later, as for the listener.
        #[cfg(target_os = "linux")]
        if listener.is_ipv4() {
            socket.set_freebind_v4(true)?;
        } else if !listener.ip().is_unspecified() {
            socket.set_freebind_v6(true)?;
        }
        if listener.is_ipv6() {
            // An IPv4 socket may use the same port.
            socket.set_only_v6(true)?;
        }
        socket.bind(&SocketAddr::new(listener.ip(), port).into())?;
        Ok(socket)
    };
    // An equal port needs only one firewall rule. If another process has that port, any port is used, because
    // peers get it announced.
    let socket = bound(port).or_else(|_| bound(0))?;
    // The system may grant less. A burst then loses datagrams, which are sent again.
    let _ = socket.set_recv_buffer_size(RECEIVE_BUFFER);
    if is_marked {
        qos::mark_datagrams(&socket, listener);
    }
    let socket = UdpSocket::from(socket);
    Ok(BoundSocket { at: socket.local_addr()?, socket: Arc::new(socket), outer: None })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn announcement_at(address: u32) -> Announcement {
        Announcement { port: 9, key: 1, address }
    }

    #[test]
    fn link_local_peer_reads_on_its_link_only() {
        let remote: SocketAddr = "[fe80::2%3]:5".parse().unwrap();
        assert_eq!(announcement_at(0).target(remote), Some("[fe80::2%3]:9".parse().unwrap()));
        assert_eq!(
            announcement_at(0x0a00_0001).target(remote),
            None,
            "our socket there sends nothing of the other family"
        );
        assert_eq!(
            announcement_at(0x0a00_0001).target("10.0.0.2:5".parse().unwrap()),
            Some("10.0.0.1:9".parse().unwrap())
        );
        assert_eq!(Announcement { port: 0, ..announcement_at(0) }.target(remote), None);
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn missing_address_of_this_host_still_has_its_socket() {
        for at in ["192.0.2.7:0", "[2001:db8::7]:0"] {
            match bind(at.parse().unwrap(), 0, false) {
                Err(error) if error.raw_os_error() == Some(rustix::io::Errno::AFNOSUPPORT.raw_os_error()) => {
                    println!("skipped: this host has no IPv6");
                }
                bound => assert!(bound.is_ok_and(|bound| bound.at.port() != 0), "{at}"),
            }
        }
    }

    #[test]
    fn connection_uses_the_socket_of_its_address_or_family() {
        let sockets = Sockets::default();
        let config = NodeConfig::new("test");
        let listeners = ["127.0.0.1:0", "0.0.0.0:0"].map(|at| at.parse().unwrap());
        sockets.bind(&listeners, &config, &Refusals::default());
        let beside = |at: &str| sockets.beside(at.parse().unwrap()).map(|bound| bound.at.ip().to_string());
        assert_eq!(beside("127.0.0.1:5").as_deref(), Some("127.0.0.1"));
        assert_eq!(beside("127.0.0.2:5").as_deref(), Some("127.0.0.1"));
        assert_eq!(beside("[fe80::1%3]:5"), None, "none of this node's gets there");
    }
    #[test]
    fn port_reserved_for_ndl_is_left_free() {
        let listener = std::net::TcpListener::bind(("127.0.0.1", 0)).unwrap().local_addr().unwrap();
        let mut config = NodeConfig::new("test");
        config.ndl.port = listener.port();
        let sockets = Sockets::default();
        sockets.bind(&[listener], &config, &Refusals::default());
        let bound = sockets.beside(listener).unwrap();
        assert_eq!(bound.at.ip(), listener.ip());
        assert_ne!(bound.at.port(), listener.port());
    }
}
