//! NDL's UDP sockets. Each local address has two: one for queries and answers, and one in the multicast group.

use std::{
    collections::BTreeMap,
    io,
    net::{IpAddr, SocketAddr, SocketAddrV4, SocketAddrV6, UdpSocket},
};

use sinew_model::{address::LocalAddress, config::NdlConfig};
use socket2::{Domain, Protocol, SockRef, Socket, Type};

/// Receive buffer for the answers of a thousand members, if the system grants it (`net.core.rmem_max`).
const RECEIVE_BUFFER: usize = 1 << 20;

/// Binds the socket for queries and answers. It sends multicast on the same interface, to this network only
/// and to this host, too.
pub(super) fn bind_unicast(local: LocalAddress, port: u16) -> io::Result<UdpSocket> {
    // Bound without address reuse, so that a conflict with another process is detected.
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

/// The sockets for queries and answers, one for each address. They stay open during a restart of this layer,
/// so its address and port remain valid for other nodes.
#[derive(Debug, Default)]
pub struct Sockets(BTreeMap<LocalAddress, Kept>);

#[derive(Debug)]
struct Kept {
    port: u16,
    /// `None` if the address was removed. If it returns, the same port is used again.
    socket: Option<UdpSocket>,
}

/// Maximum number of addresses with remembered ports.
const KEPT_MAX: usize = 64;

impl Sockets {
    /// Returns the socket at this address. After a restart of this layer it is the open one, which a former
    /// instance that hangs still uses. Otherwise it is a new one at `port`, or at the former port if `port`
    /// is 0.
    ///
    /// # Errors
    /// Returns the system's error.
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

    pub fn close_all(&mut self) {
        self.0.clear();
    }

    /// Sends from the open socket at `from`.
    ///
    /// # Errors
    /// Returns the system's error, or that no socket is open there.
    pub(super) fn send(&self, from: SocketAddr, bytes: &[u8], to: SocketAddr) -> io::Result<()> {
        let is_it = |socket: &&UdpSocket| socket.local_addr().is_ok_and(|here| here == from);
        let socket = self.all().find(is_it).ok_or(io::ErrorKind::AddrNotAvailable)?;
        send(socket, bytes, to)
    }

    pub(super) fn all(&self) -> impl Iterator<Item = &UdpSocket> {
        self.0.values().filter_map(|kept| kept.socket.as_ref())
    }
}

/// The multicast groups for discovery, one for each address family.
#[derive(Clone, Copy, Debug)]
pub(super) struct Groups {
    pub(super) ipv4: Option<SocketAddrV4>,
    pub(super) ipv6: Option<SocketAddrV6>,
}

impl From<&NdlConfig> for Groups {
    /// Returns the configured groups. If multicast is disabled, there is none of either family.
    fn from(config: &NdlConfig) -> Self {
        Self { ipv4: config.multicast, ipv6: config.multicast6.filter(|_| config.multicast.is_some()) }
    }
}

impl Groups {
    /// Returns the group that is queried from a local address. IPv6 loopback has none: Linux has no route for
    /// groups there.
    pub(super) fn of(self, ip: IpAddr) -> Option<SocketAddr> {
        match ip {
            IpAddr::V4(_) => self.ipv4.map(SocketAddr::from),
            IpAddr::V6(ip) => self.ipv6.filter(|_| !ip.is_loopback()).map(SocketAddr::from),
        }
    }
}

/// Binds the sockets of a path to the interface that has this address now. It may differ from the first one.
pub(super) fn renew(unicast: &UdpSocket, group: Option<(&UdpSocket, SocketAddr)>, local: LocalAddress) {
    // A failure here means that the interface is absent; the call is repeated later.
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

/// Marks the socket's packets as network control, so that a link full of Bulk does not cause the loss of a
/// node. It uses code point CS6 (RFC 4594, section 3.1), and the highest priority in the host's queues that
/// needs no privileges. If the system refuses, datagrams are sent unmarked, as all other traffic is.
#[cfg(target_os = "linux")]
pub(super) fn mark(socket: &UdpSocket) {
    const CODE_POINT: u32 = 48;
    const PRIORITY: u32 = 6;
    let is_ipv6 = socket.local_addr().is_ok_and(|at| at.is_ipv6());
    let socket = SockRef::from(socket);
    // The two low bits are for congestion (RFC 3168). The system derives a priority from this value, so the
    // priority is set after it.
    let _ = if is_ipv6 { socket.set_tclass_v6(CODE_POINT << 2) } else { socket.set_tos_v4(CODE_POINT << 2) };
    let _ = socket.set_priority(PRIORITY);
}

/// Does nothing: not every system has these options.
#[cfg(not(target_os = "linux"))]
pub(super) const fn mark(_: &UdpSocket) {}

/// Binds a socket that receives the multicast group on the interface with this address.
pub(super) fn join_group(group: SocketAddr, local: LocalAddress) -> io::Result<UdpSocket> {
    let socket = udp(Domain::for_address(group))?;
    // Every node of the host receives the group.
    socket.set_reuse_address(true)?;
    // The socket is bound to the group's address and ignores other interfaces, so it receives only the group.
    // A bind to a link-local IPv6 group needs the interface of that link.
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
        // Allows an IPv4 socket at the same port.
        socket.set_only_v6(true)?;
    }
    // The system may grant less. A burst then loses datagrams, which NDL tolerates.
    let _ = socket.set_recv_buffer_size(RECEIVE_BUFFER);
    Ok(socket)
}

/// Sends a datagram without blocking. A full socket buffer drops it, as the network may.
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
    fn loopback_multicast_reaches_every_socket_of_its_group_only() {
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
    fn port_in_use_is_detected() {
        let first = bind_unicast(Ipv4Addr::LOCALHOST.into(), 0).unwrap();
        let port = first.local_addr().unwrap().port();
        assert_eq!(
            bind_unicast(Ipv4Addr::LOCALHOST.into(), port).unwrap_err().kind(),
            io::ErrorKind::AddrInUse
        );
    }
}
