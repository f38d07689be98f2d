//! Where the nodes of a case are.

use std::{
    fmt::{Display, Formatter, Result},
    net::{Ipv4Addr, SocketAddrV4},
};

use sinew::prelude::*;

use crate::keys;

/// An address of a node of this run, and the group where it finds the others.
#[derive(Clone, Copy, Debug)]
pub(crate) struct At {
    address: Ipv4Addr,
    group: SocketAddrV4,
    /// The process that has made keys for the nodes of this run; 0: they have none.
    keys: u32,
}

impl At {
    /// The first address of the loopback interface, and a group that only this process and those that it starts have.
    pub(crate) fn loopback() -> Self {
        let id = std::process::id();
        let group = Ipv4Addr::new(239, 255, 84, (id % 200 + 1) as u8);
        let group = SocketAddrV4::new(group, 20_000 + (id % 20_000) as u16);
        Self { address: Ipv4Addr::LOCALHOST, group, keys: 0 }
    }

    /// The port of the group, which is this run's own.
    pub(crate) fn port(self) -> u16 {
        self.group.port()
    }

    /// The address.
    pub(crate) fn ip(self) -> Ipv4Addr {
        self.address
    }

    /// Another address, the same group.
    pub(crate) fn on(self, address: Ipv4Addr) -> Self {
        Self { address, ..self }
    }

    /// The address with this last number.
    pub(crate) fn host(self, number: u8) -> Self {
        let [a, b, c, _] = self.address.octets();
        self.on(Ipv4Addr::new(a, b, c, number))
    }

    /// The same, for nodes that have the keys that this process has made.
    pub(crate) fn secured(self) -> Self {
        Self { keys: std::process::id(), ..self }
    }

    /// A node there that finds nobody else.
    pub(crate) fn node(self, name: &str) -> NodeBuilder {
        Node::builder(name).address(self.address).configure(|config| {
            config.ndl.interface = self.address;
            config.ndl.multicast = Some(self.group);
            config.ndl.mdns_port = None;
            config.security.keys = (self.keys != 0).then(|| keys::of_node(self.keys, name));
        })
    }

    /// What [`Display`] wrote.
    pub(crate) fn read(words: &str) -> Self {
        let at = |words: &str| {
            let mut parts = words.split('@');
            let (address, group, keys) = (parts.next()?, parts.next()?, parts.next()?);
            Some(Self {
                address: address.parse().ok()?,
                group: group.parse().ok()?,
                keys: keys.parse().ok()?,
            })
        };
        at(words).expect("an address that this program wrote itself")
    }
}

impl Display for At {
    fn fmt(&self, f: &mut Formatter<'_>) -> Result {
        write!(f, "{}@{}@{}", self.address, self.group, self.keys)
    }
}
