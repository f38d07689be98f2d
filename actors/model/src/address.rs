//! Addresses of this host and of others, and the interfaces they belong to.
//!
//! A link-local IPv6 address (fe80::/10) belongs to one host on one link, and may belong to another host on
//! the next. It is only valid together with the interface of this host that leads to the link, the `scope_id`
//! of [`SocketAddrV6`]. Hosts exchange the address without it, as each host numbers its own interfaces. So a
//! received address is completed with the local interface over which it is reached.

use std::{
    fmt,
    net::{IpAddr, Ipv4Addr, SocketAddr, SocketAddrV6},
};

/// An address of this host and its interface.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct LocalAddress {
    /// The address.
    pub ip: IpAddr,
    /// The kernel's number of the interface; 0 for IPv4, where it is not needed.
    pub interface: u32,
}

impl LocalAddress {
    /// Returns the socket address with this address and port.
    pub fn at(self, port: u16) -> SocketAddr {
        match self.ip {
            IpAddr::V6(ip) if ip.is_unicast_link_local() => {
                SocketAddrV6::new(ip, port, 0, self.interface).into()
            }
            ip @ (IpAddr::V4(_) | IpAddr::V6(_)) => (ip, port).into(),
        }
    }
}

impl From<Ipv4Addr> for LocalAddress {
    fn from(ip: Ipv4Addr) -> Self {
        Self { ip: ip.into(), interface: 0 }
    }
}

impl fmt::Display for LocalAddress {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.ip.fmt(f)?;
        if is_link_local(self.ip) { write!(f, "%{}", self.interface) } else { Ok(()) }
    }
}

/// Returns whether this address is only valid together with an interface.
pub const fn is_link_local(ip: IpAddr) -> bool {
    match ip {
        IpAddr::V4(_) => false,
        IpAddr::V6(ip) => ip.is_unicast_link_local(),
    }
}

/// Returns the address as another host may send it: without the local number of an interface.
pub const fn unscoped(address: SocketAddr) -> SocketAddr {
    match address {
        SocketAddr::V4(_) => address,
        SocketAddr::V6(v6) => SocketAddr::V6(SocketAddrV6::new(*v6.ip(), v6.port(), 0, 0)),
    }
}

/// Returns an address as it is reached from `here`: a link-local one on the same interface.
pub fn seen_from(here: SocketAddr, there: SocketAddr) -> SocketAddr {
    match (here, there) {
        (SocketAddr::V6(here), SocketAddr::V6(there)) if there.ip().is_unicast_link_local() => {
            SocketAddrV6::new(*there.ip(), there.port(), 0, here.scope_id()).into()
        }
        _ => there,
    }
}

/// Returns whether both addresses belong to one interface of one host, regardless of their ports.
pub fn is_same_host(one: SocketAddr, other: SocketAddr) -> bool {
    host_at(one) == host_at(other)
}

/// Returns a value that is the same for all ports of one address.
pub fn host_at(address: SocketAddr) -> SocketAddr {
    match address {
        SocketAddr::V6(v6) if v6.ip().is_unicast_link_local() => {
            SocketAddrV6::new(*v6.ip(), 0, 0, v6.scope_id()).into()
        }
        SocketAddr::V4(_) | SocketAddr::V6(_) => (address.ip(), 0).into(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(text: &str) -> SocketAddr {
        text.parse().unwrap()
    }

    #[test]
    fn link_local_address_takes_its_routes_interface() {
        let here = at("[fe80::1%3]:7");
        assert_eq!(seen_from(here, at("[fe80::2]:8")), at("[fe80::2%3]:8"));
        assert_eq!(
            seen_from(here, at("[fe80::2%9]:8")),
            at("[fe80::2%3]:8"),
            "another host's number means nothing"
        );
        assert_eq!(seen_from(here, at("[fd00::2]:8")), at("[fd00::2]:8"));
        assert_eq!(seen_from(at("10.0.0.1:7"), at("10.0.0.2:8")), at("10.0.0.2:8"));
        assert_eq!(unscoped(here), at("[fe80::1]:7"));
        assert!(is_same_host(here, at("[fe80::1%3]:9")) && !is_same_host(here, at("[fe80::1%4]:7")));
    }

    #[test]
    fn only_link_local_socket_addresses_have_an_interface() {
        let local = |ip: &str| LocalAddress { ip: ip.parse().unwrap(), interface: 3 };
        assert_eq!(local("fe80::1").at(7), at("[fe80::1%3]:7"));
        assert_eq!(local("fd00::1").at(7), at("[fd00::1]:7"));
        assert_eq!(local("10.0.0.1").at(7), at("10.0.0.1:7"));
        assert_eq!(
            (local("fe80::1").to_string(), local("fd00::1").to_string()),
            ("fe80::1%3".into(), "fd00::1".into())
        );
    }
}
