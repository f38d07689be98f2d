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
use crate::{config::GnclConfig, refusals::Refusals, stores::lock};

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
    /// Binds one beside each listener, at the same port if that is free.
    pub(in crate::gncl) fn bind(&self, listeners: &[SocketAddr], gncl: &GnclConfig, refusals: &Refusals) {
        let mut doors = lock(&self.0);
        for (nth, listener) in listeners.iter().enumerate() {
            // The first one is that of the interface.
            let outer = gncl.announce.filter(|_| nth == 0);
            match door(*listener, gncl.marks) {
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

    /// The one that belongs to a connection: that of its own address, or of the node's interface.
    pub(in crate::gncl) fn beside(&self, connection: SocketAddr) -> Option<Door> {
        let doors = lock(&self.0);
        let own = doors.iter().find(|door| connection.ip() == door.at.ip());
        own.or_else(|| doors.first()).cloned()
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
        let ip = if self.address == 0 { remote.ip() } else { Ipv4Addr::from_bits(self.address).into() };
        let is_a_host = match ip {
            IpAddr::V4(ip) => !(ip.is_unspecified() || ip.is_broadcast() || ip.is_multicast()),
            IpAddr::V6(ip) => !(ip.is_unspecified() || ip.is_multicast()),
        };
        (self.port != 0 && is_a_host).then(|| SocketAddr::new(ip, self.port))
    }
}

fn door(listener: SocketAddr, is_marked: bool) -> io::Result<Door> {
    let bound = |port| -> io::Result<Socket> {
        let socket = Socket::new(
            Domain::for_address(listener),
            Type::DGRAM.nonblocking().cloexec(),
            Some(Protocol::UDP),
        )?;
        // An interface that is down may come up, as for the listener.
        #[cfg(target_os = "linux")]
        socket.set_freebind_v4(true)?;
        socket.bind(&SocketAddr::new(listener.ip(), port).into())?;
        Ok(socket)
    };
    // Who opens a firewall needs one number. Where another has that port, any will do: peers are told which.
    let socket = bound(listener.port()).or_else(|_| bound(0))?;
    // The system may grant less; then a burst loses datagrams, which are sent again.
    let _ = socket.set_recv_buffer_size(RECEIVE_BUFFER);
    if is_marked {
        marks::mark_datagrams(&socket);
    }
    let socket = UdpSocket::from(socket);
    Ok(Door { at: socket.local_addr()?, socket: Arc::new(socket), outer: None })
}
