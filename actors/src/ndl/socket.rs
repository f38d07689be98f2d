//! NDL's UDP sockets, two for each of its addresses: one of its own for queries and answers, one in the multicast group.

use std::{
    collections::BTreeMap,
    io,
    net::{IpAddr, SocketAddr, SocketAddrV4, SocketAddrV6, UdpSocket},
};

use socket2::{Domain, Protocol, SockRef, Socket, Type};

use super::address::LocalAddress;
use crate::config::NdlConfig;

/// Room for the answers of a thousand members, where the system grants it (`net.core.rmem_max`).
const RECEIVE_BUFFER: usize = 1 << 20;

/// Binds the socket for queries and answers. Multicast leaves by the same interface, for this network only and for
/// this host, too.
pub(super) fn bind_unicast(local: LocalAddress, port: u16) -> io::Result<UdpSocket> {
    // Without address reuse: a port that another process has must be noticed.
    let at = local.at(port);
    let socket = udp(Domain::for_address(at))?;
    socket.bind(&at.into())?;
    send_multicast_by(SockRef::from(&socket), local)?;
    match local.ip {
        IpAddr::V4(_) => {
            socket.set_multicast_ttl_v4(1)?;
            socket.set_multicast_loop_v4(true)?;
        }
        IpAddr::V6(_) => {
            socket.set_multicast_hops_v6(1)?;
            socket.set_multicast_loop_v6(true)?;
        }
    }
    Ok(socket.into())
}

fn send_multicast_by(socket: SockRef<'_>, local: LocalAddress) -> io::Result<()> {
    match local.ip {
        IpAddr::V4(ip) => socket.set_multicast_if_v4(&ip),
        IpAddr::V6(_) => socket.set_multicast_if_v6(local.interface),
    }
}

/// The sockets for queries and answers, one for each address. They stay open while this layer is restarted: whoever knows them still
/// finds us.
#[derive(Debug, Default)]
pub(crate) struct Sockets(BTreeMap<LocalAddress, Kept>);

#[derive(Debug)]
struct Kept {
    port: u16,
    /// `None`: the address was taken away. If it is back, so is the port.
    socket: Option<UdpSocket>,
}

/// Addresses whose ports are remembered, at most.
const KEPT_MAX: usize = 64;

impl Sockets {
    /// The socket at this address: that which is open already, if this layer was restarted, for a former instance that hangs still has it;
    /// else a new one, at `port` or, if that is 0, at the one of before.
    ///
    /// # Errors
    /// What the system says.
    pub(super) fn open(&mut self, local: LocalAddress, port: u16, is_marked: bool) -> io::Result<UdpSocket> {
        let former = match self.0.get(&local) {
            Some(Kept { socket: Some(socket), .. }) => return socket.try_clone(),
            Some(Kept { port, socket: None }) => Some(*port),
            None => None,
        };
        let again = former.filter(|_| port == 0).and_then(|port| bind_unicast(local, port).ok());
        let socket = again.map_or_else(|| bind_unicast(local, port), Ok)?;
        if is_marked {
            mark(&socket);
        }
        let port = socket.local_addr()?.port();
        let kept = socket.try_clone()?;
        if self.0.len() >= KEPT_MAX {
            self.0.retain(|_, kept| kept.socket.is_some());
        }
        self.0.insert(local, Kept { port, socket: Some(kept) });
        Ok(socket)
    }

    pub(super) fn close(&mut self, local: LocalAddress) {
        if let Some(kept) = self.0.get_mut(&local) {
            kept.socket = None;
        }
    }

    pub(crate) fn close_all(&mut self) {
        self.0.clear();
    }

    /// Sends from the open socket at `from`.
    ///
    /// # Errors
    /// What the system says; that no socket is open there.
    pub(super) fn send(&self, from: SocketAddr, bytes: &[u8], to: SocketAddr) -> io::Result<()> {
        let is_it = |socket: &&UdpSocket| socket.local_addr().is_ok_and(|here| here == from);
        let socket = self.all().find(is_it).ok_or(io::ErrorKind::AddrNotAvailable)?;
        send(socket, bytes, to)
    }

    pub(super) fn all(&self) -> impl Iterator<Item = &UdpSocket> {
        self.0.values().filter_map(|kept| kept.socket.as_ref())
    }
}

/// The groups in which nodes ask who is there, one for each family.
#[derive(Clone, Copy, Debug)]
pub(super) struct Groups {
    pub(super) ipv4: Option<SocketAddrV4>,
    pub(super) ipv6: Option<SocketAddrV6>,
}

impl NdlConfig {
    /// Where this node asks who is there. Who switches multicast off wants none of either family.
    pub(super) fn groups(&self) -> Groups {
        Groups { ipv4: self.multicast, ipv6: self.multicast6.filter(|_| self.multicast.is_some()) }
    }
}

impl Groups {
    /// The one that is asked from an address of ours. None from loopback of IPv6: Linux has no route for groups there.
    pub(super) fn of(self, ip: IpAddr) -> Option<SocketAddr> {
        match ip {
            IpAddr::V4(_) => self.ipv4.map(SocketAddr::from),
            IpAddr::V6(ip) => self.ipv6.filter(|_| !ip.is_loopback()).map(SocketAddr::from),
        }
    }
}

/// Has the sockets of a path go by the interface that has this address now: it may be another one than at first.
pub(super) fn renew(unicast: &UdpSocket, group: Option<(&UdpSocket, SocketAddr)>, local: LocalAddress) {
    // What fails here fails because the interface is away; it is tried again.
    let _ = send_multicast_by(SockRef::from(unicast), local);
    if let Some((socket, group)) = group {
        let _ = join(SockRef::from(socket), group, local);
    }
}

fn join(socket: SockRef<'_>, group: SocketAddr, local: LocalAddress) -> io::Result<()> {
    match (group.ip(), local.ip) {
        (IpAddr::V4(group), IpAddr::V4(ip)) => socket.join_multicast_v4(&group, &ip),
        (IpAddr::V6(group), IpAddr::V6(_)) => socket.join_multicast_v6(&group, local.interface),
        (IpAddr::V4(_), IpAddr::V6(_)) | (IpAddr::V6(_), IpAddr::V4(_)) => {
            Err(io::ErrorKind::Unsupported.into())
        }
    }
}

/// Marks what leaves this socket as what keeps a network up, so that no queue has a node lost while its link is full of Bulk: code
/// point CS6 (RFC 4594, section 3.1), and the highest priority in this host's own queues that needs no rights. Where the system
/// refuses, datagrams go unmarked, as everything else does.
#[cfg(target_os = "linux")]
pub(super) fn mark(socket: &UdpSocket) {
    const CODE_POINT: u32 = 48;
    const PRIORITY: u32 = 6;
    let is_ipv6 = socket.local_addr().is_ok_and(|at| at.is_ipv6());
    let socket = SockRef::from(socket);
    // The two low bits are for congestion (RFC 3168). The system derives a priority from this: ours comes after it.
    let _ = if is_ipv6 { socket.set_tclass_v6(CODE_POINT << 2) } else { socket.set_tos_v4(CODE_POINT << 2) };
    let _ = socket.set_priority(PRIORITY);
}

/// Marks nothing: not every system has these options.
#[cfg(not(target_os = "linux"))]
pub(super) const fn mark(_: &UdpSocket) {}

/// Binds a socket that hears the multicast group on the interface that has this address.
pub(super) fn join_group(group: SocketAddr, local: LocalAddress) -> io::Result<UdpSocket> {
    let socket = udp(Domain::for_address(group))?;
    // Every node of the host hears the group.
    socket.set_reuse_address(true)?;
    // Bound to the group's address and deaf to other interfaces, this hears nothing but the group. To bind a group of IPv6 that
    // belongs to a link takes the interface that leads there.
    let at = match group {
        SocketAddr::V4(_) => group,
        SocketAddr::V6(group) => SocketAddrV6::new(*group.ip(), group.port(), 0, local.interface).into(),
    };
    socket.bind(&at.into())?;
    #[cfg(target_os = "linux")]
    match group {
        SocketAddr::V4(_) => socket.set_multicast_all_v4(false)?,
        SocketAddr::V6(_) => socket.set_multicast_all_v6(false)?,
    }
    join(SockRef::from(&socket), group, local)?;
    Ok(socket.into())
}

fn udp(family: Domain) -> io::Result<Socket> {
    let socket = Socket::new(family, Type::DGRAM, Some(Protocol::UDP))?;
    socket.set_nonblocking(true)?;
    if family == Domain::IPV6 {
        // Beside one of IPv4 at the same port.
        socket.set_only_v6(true)?;
    }
    // The system may grant less; then a burst loses datagrams, which NDL can bear.
    let _ = socket.set_recv_buffer_size(RECEIVE_BUFFER);
    Ok(socket)
}

/// Sends one datagram now or not at all: a full socket loses it, as the network may.
pub(super) fn send(socket: &UdpSocket, bytes: &[u8], to: SocketAddr) -> io::Result<()> {
    socket.send_to(bytes, to).map(drop)
}

#[cfg(test)]
mod tests {
    use std::{net::Ipv4Addr, time::Duration};

    use super::*;

    /// The watchdog of a blocking test.
    const DEADLINE: Duration = Duration::from_secs(10);

    #[test]
    fn multicast_on_loopback_reaches_every_socket_of_the_group_and_not_another_group() {
        // given: two listeners of a group, and one of another group at the same port
        let sender = bind_unicast(Ipv4Addr::LOCALHOST.into(), 0).unwrap();
        let port = sender.local_addr().unwrap().port();
        let group = SocketAddrV4::new(Ipv4Addr::new(239, 255, 1, 1), port);
        let other = SocketAddrV4::new(Ipv4Addr::new(239, 255, 1, 2), port);
        let listeners = [group, group, other].map(|group| {
            let socket = join_group(group.into(), Ipv4Addr::LOCALHOST.into()).unwrap();
            socket.set_nonblocking(false).unwrap();
            socket.set_read_timeout(Some(DEADLINE)).unwrap();
            socket
        });
        // when
        send(&sender, b"to the group", group.into()).unwrap();
        send(&sender, b"to the others", other.into()).unwrap();
        // then
        for (listener, expected) in
            listeners.iter().zip([&b"to the group"[..], &b"to the group"[..], &b"to the others"[..]])
        {
            let mut buffer = [0; 64];
            let (length, from) = listener.recv_from(&mut buffer).unwrap();
            assert_eq!(&buffer[..length], expected);
            assert_eq!(from, sender.local_addr().unwrap());
        }
    }

    #[test]
    fn a_port_that_is_in_use_is_noticed() {
        let first = bind_unicast(Ipv4Addr::LOCALHOST.into(), 0).unwrap();
        let port = first.local_addr().unwrap().port();
        assert_eq!(
            bind_unicast(Ipv4Addr::LOCALHOST.into(), port).unwrap_err().kind(),
            io::ErrorKind::AddrInUse
        );
    }
}
