//! The sockets at which this node reads datagrams of its peers, and what a peer is told of them.

use std::{
    io,
    net::{IpAddr, Ipv4Addr, SocketAddr, SocketAddrV4, UdpSocket},
    sync::{Arc, Mutex},
};

use serde::{Deserialize, Serialize};
use sinew_runtime::time::Time;
use socket2::{Domain, Protocol, Socket, Type};

use super::super::marks;
use crate::{config::NodeConfig, refusals::Refusals, stores::lock};

/// Room for what comes while the IO thread does something else, where the system grants it (`net.core.rmem_max`): 30 ms of a gigabit.
const RECEIVE_BUFFER: usize = 4 << 20;

/// What a node says of where it reads datagrams: payload of the frame DATAGRAMS. spec: DATAGRAM-2
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(in crate::gncl) struct Announcement {
    /// UDP port; 0: nowhere.
    pub(in crate::gncl) port: u16,
    /// What each datagram to it is to have.
    pub(in crate::gncl) key: u64,
    /// Address, as a number; 0: that of the connection on which this is said.
    #[serde(default)]
    pub(in crate::gncl) address: u32,
}

/// One of this node's sockets, as the peers know it.
#[derive(Clone, Debug)]
pub(in crate::gncl) struct Door {
    pub(super) socket: Arc<UdpSocket>,
    at: SocketAddr,
    /// Where the others reach it, if not there.
    outer: Option<SocketAddrV4>,
}

/// The node's sockets, one for each address at which it listens. They stay open while this layer is restarted.
#[derive(Debug, Default)]
pub(in crate::gncl) struct Sockets(Mutex<Vec<Door>>);

impl Sockets {
    /// Binds one beside each listener, at the same port if that is free, and not to be NDL's.
    pub(in crate::gncl) fn bind(&self, listeners: &[SocketAddr], config: &NodeConfig, refusals: &Refusals) {
        let (gncl, mut doors) = (&config.gncl, lock(&self.0));
        for (nth, listener) in listeners.iter().enumerate() {
            // The first one is that of the interface.
            let outer = gncl.announce.filter(|_| nth == 0);
            let port = if listener.port() == config.ndl.port { 0 } else { listener.port() };
            match door(*listener, port, gncl.marks) {
                Ok(door) => doors.push(Door { outer, ..door }),
                // Values go by the connection then.
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

    pub(super) fn all(&self) -> Vec<Door> {
        lock(&self.0).clone()
    }

    /// The one that belongs to a connection: that of its own address, or of the node's interface; none of the other family, from which nothing
    /// gets there.
    pub(in crate::gncl) fn beside(&self, connection: SocketAddr) -> Option<Door> {
        let doors = lock(&self.0);
        let own = doors.iter().find(|door| connection.ip() == door.at.ip());
        let of_family = || doors.iter().find(|door| connection.is_ipv4() == door.at.is_ipv4());
        own.or_else(of_family).cloned()
    }

    pub(in crate::gncl) fn close(&self) {
        lock(&self.0).clear();
    }
}

impl Door {
    /// What a peer is told of it on a connection that has this address here.
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
    /// Where the peer reads datagrams, whose connection comes from `remote`.
    pub(super) fn target(self, remote: SocketAddr) -> Option<SocketAddr> {
        // That of the connection as it is: a link-local one with the interface that leads there.
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

/// One at the listener's address, at this port if that is free.
fn door(listener: SocketAddr, port: u16, is_marked: bool) -> io::Result<Door> {
    let bound = |port| -> io::Result<Socket> {
        let socket = Socket::new(
            Domain::for_address(listener),
            Type::DGRAM.nonblocking().cloexec(),
            Some(Protocol::UDP),
        )?;
        // An interface that is down may come up, as for the listener.
        #[cfg(target_os = "linux")]
        if listener.is_ipv4() {
            socket.set_freebind_v4(true)?;
        } else if !listener.ip().is_unspecified() {
            socket.set_freebind_v6(true)?;
        }
        if listener.is_ipv6() {
            // Beside one of IPv4 at the same port.
            socket.set_only_v6(true)?;
        }
        socket.bind(&SocketAddr::new(listener.ip(), port).into())?;
        Ok(socket)
    };
    // Who opens a firewall needs one number. Where another has that port, any will do: peers are told which.
    let socket = bound(port).or_else(|_| bound(0))?;
    // The system may grant less; then a burst loses datagrams, which are sent again.
    let _ = socket.set_recv_buffer_size(RECEIVE_BUFFER);
    if is_marked {
        marks::mark_datagrams(&socket, listener);
    }
    let socket = UdpSocket::from(socket);
    Ok(Door { at: socket.local_addr()?, socket: Arc::new(socket), outer: None })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn said(address: u32) -> Announcement {
        Announcement { port: 9, key: 1, address }
    }

    #[test]
    fn a_peer_on_a_link_reads_datagrams_there_and_one_of_ipv6_at_no_address_of_ipv4() {
        let remote: SocketAddr = "[fe80::2%3]:5".parse().unwrap();
        assert_eq!(said(0).target(remote), Some("[fe80::2%3]:9".parse().unwrap()));
        assert_eq!(
            said(0x0a00_0001).target(remote),
            None,
            "our socket there sends nothing of the other family"
        );
        assert_eq!(
            said(0x0a00_0001).target("10.0.0.2:5".parse().unwrap()),
            Some("10.0.0.1:9".parse().unwrap())
        );
        assert_eq!(Announcement { port: 0, ..said(0) }.target(remote), None);
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn an_address_that_this_host_does_not_have_yet_has_its_socket() {
        for at in ["192.0.2.7:0", "[2001:db8::7]:0"] {
            match door(at.parse().unwrap(), 0, false) {
                Err(error) if error.raw_os_error() == Some(rustix::io::Errno::AFNOSUPPORT.raw_os_error()) => {
                    println!("skipped: this host has no IPv6");
                }
                bound => assert!(bound.is_ok_and(|door| door.at.port() != 0), "{at}"),
            }
        }
    }

    #[test]
    fn beside_a_connection_is_the_socket_of_its_address_or_one_of_its_family() {
        let sockets = Sockets::default();
        let config = NodeConfig::new("test");
        let listeners = ["127.0.0.1:0", "0.0.0.0:0"].map(|at| at.parse().unwrap());
        sockets.bind(&listeners, &config, &Refusals::default());
        let beside = |at: &str| sockets.beside(at.parse().unwrap()).map(|door| door.at.ip().to_string());
        assert_eq!(beside("127.0.0.1:5").as_deref(), Some("127.0.0.1"));
        assert_eq!(beside("127.0.0.2:5").as_deref(), Some("127.0.0.1"));
        assert_eq!(beside("[fe80::1%3]:5"), None, "none of this node's gets there");
    }
    #[test]
    fn the_port_that_ndl_is_to_have_is_left_to_it() {
        let listener = std::net::TcpListener::bind(("127.0.0.1", 0)).unwrap().local_addr().unwrap();
        let mut config = NodeConfig::new("test");
        config.ndl.port = listener.port();
        let sockets = Sockets::default();
        sockets.bind(&[listener], &config, &Refusals::default());
        let door = sockets.beside(listener).unwrap();
        assert_eq!(door.at.ip(), listener.ip());
        assert_ne!(door.at.port(), listener.port());
    }
}
