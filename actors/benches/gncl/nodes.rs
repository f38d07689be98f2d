//! The addresses of the nodes of a case.

use std::{
    fmt::{Display, Formatter, Result},
    net::{Ipv4Addr, SocketAddrV4},
};

use sinew::prelude::*;

/// An address of a node of this run, and the group where it finds the others.
#[derive(Clone, Copy, Debug)]
pub(crate) struct At {
    address: Ipv4Addr,
    group: SocketAddrV4,
}

impl At {
    /// The first address of the loopback interface, and a group that only this process and those that it starts have.
    pub(crate) fn loopback() -> Self {
        let id = std::process::id();
        let group = Ipv4Addr::new(239, 255, 84, (id % 200 + 1) as u8);
        Self { address: Ipv4Addr::LOCALHOST, group: SocketAddrV4::new(group, 20_000 + (id % 20_000) as u16) }
    }

    /// The port of the group, which is this run's own.
    pub(crate) fn port(self) -> u16 {
        self.group.port()
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

    /// Returns a node at this address that finds no other node.
    pub(crate) fn node(self, name: &str) -> NodeBuilder {
        Node::builder(name).address(self.address).configure(|config| {
            config.ndl.interface = self.address.into();
            config.ndl.multicast = Some(self.group);
            config.ndl.mdns_port = None;
            config.rt.probe = Duration::ZERO;
        })
    }

    /// Parses the text of [`Display`].
    pub(crate) fn read(words: &str) -> Self {
        let parts = words.split_once('@').and_then(|(address, group)| {
            Some(Self { address: address.parse().ok()?, group: group.parse().ok()? })
        });
        parts.expect("an address that this program wrote itself")
    }
}

impl Display for At {
    fn fmt(&self, f: &mut Formatter<'_>) -> Result {
        write!(f, "{}@{}", self.address, self.group)
    }
}
