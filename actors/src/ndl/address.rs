//! Addresses of this host and of others, and which of its interfaces they belong to.
//!
//! A link-local IPv6 address (fe80::/10) is one host's on one link, and may be another host's on the next: it means something only with
//! the interface of this host that leads to the link, the `scope_id` of [`SocketAddrV6`]. Between hosts it goes without that, as each
//! host numbers its own interfaces. So an address that was heard is completed by that one of ours over which it is to be reached.

use std::{
    fmt,
    net::{IpAddr, Ipv4Addr, SocketAddr, SocketAddrV6},
};

/// An address of this host, and which interface has it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct LocalAddress {
    pub(crate) ip: IpAddr,
    /// The kernel's number of the interface; 0 for IPv4, where nobody asks.
    pub(crate) interface: u32,
}

impl LocalAddress {
    /// Where a socket with this address and port is.
    pub(crate) fn at(self, port: u16) -> SocketAddr {
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

/// Whether this address means something only together with an interface.
pub(crate) const fn is_link_local(ip: IpAddr) -> bool {
    match ip {
        IpAddr::V4(_) => false,
        IpAddr::V6(ip) => ip.is_unicast_link_local(),
    }
}

/// The same address as another host may say it: without the number that an interface has here.
pub(crate) const fn unscoped(address: SocketAddr) -> SocketAddr {
    match address {
        SocketAddr::V4(_) => address,
        SocketAddr::V6(v6) => SocketAddr::V6(SocketAddrV6::new(*v6.ip(), v6.port(), 0, 0)),
    }
}

/// An address as it is reached from `here`: a link-local one by the same interface.
pub(crate) fn seen_from(here: SocketAddr, there: SocketAddr) -> SocketAddr {
    match (here, there) {
        (SocketAddr::V6(here), SocketAddr::V6(there)) if there.ip().is_unicast_link_local() => {
            SocketAddrV6::new(*there.ip(), there.port(), 0, here.scope_id()).into()
        }
        _ => there,
    }
}

/// Whether both are addresses of one interface of one host, whatever their ports are.
pub(crate) fn is_same_host(one: SocketAddr, other: SocketAddr) -> bool {
    host_at(one) == host_at(other)
}

/// The same for all ports of one address.
pub(crate) fn host_at(address: SocketAddr) -> SocketAddr {
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
    fn a_link_local_address_takes_the_interface_over_which_it_is_reached_and_no_other_one_does() {
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
    fn a_socket_of_a_link_local_address_is_at_its_interface_and_one_of_another_address_is_not() {
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
