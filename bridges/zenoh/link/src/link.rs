//! The link of one host.

use std::{
    collections::{BTreeSet, VecDeque},
    net::{Ipv4Addr, SocketAddrV4},
    time::Duration,
};

use crate::{
    Class, Counts, DropCause, Header, HostFact, Instance, ProjectKey, Protocol,
    flows::{Flow, Flows},
    group::Group,
    presence::{Change, Presence},
    seal::Seal,
};

/// The settings of a host's link.
#[derive(Clone, Debug)]
pub struct Settings {
    /// Project of the host's nodes.
    pub project: String,
    /// Address of the host in the network.
    pub address: Ipv4Addr,
    /// Length of the network's prefix, 0 to 32 bits.
    pub prefix: u8,
    /// Ports of the host's nodes (`ndl.port`, `gncl.port`) that other hosts reach.
    pub ports: BTreeSet<u16>,
    /// Discovery group of the nodes (`ndl.multicast`); `None`: nodes are found by seeds.
    pub group: Option<SocketAddrV4>,
    /// Minimum time between two packets of one port to the group.
    pub group_every: Duration,
    /// The project's key; `None`: packets are plain.
    pub key: Option<ProjectKey>,
}

/// The destination of a put.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Target {
    /// One host.
    Host(Ipv4Addr),
    /// All hosts.
    All,
}

/// An input of the link.
#[derive(Clone, Copy, Debug)]
pub enum Input<'a> {
    /// A packet was read from the device.
    PacketRead(&'a [u8]),
    /// A put was received. The addresses are those of its key.
    PutReceived {
        /// Target in the key.
        target: Target,
        /// Source in the key.
        source: Ipv4Addr,
        /// Payload of the put.
        payload: &'a [u8],
    },
    /// A liveliness token appeared.
    HostAppeared(Ipv4Addr, Instance),
    /// A liveliness token disappeared.
    HostDisappeared(Ipv4Addr, Instance),
}

/// An order to the caller, or a fact for its log.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Output {
    /// Put this payload.
    Put {
        /// Target of the put.
        target: Target,
        /// Class of the packet.
        class: Class,
        /// Payload of the put.
        payload: Vec<u8>,
    },
    /// Write this packet to the device.
    Write(Vec<u8>),
    /// The present hosts have changed.
    Host(HostFact),
}

/// The link of one host.
///
/// # Examples
///
/// ```
/// use std::{collections::BTreeSet, time::Duration};
/// use sinew_zenoh_link::{DropCause, Input, Instance, Link, PacketError, Settings};
///
/// let settings = Settings {
///     project: "leg".to_owned(),
///     address: [10, 99, 0, 1].into(),
///     prefix: 16,
///     ports: BTreeSet::from([6911, 6912]),
///     group: None,
///     group_every: Duration::from_secs(1),
///     key: None,
/// };
/// let mut link = Link::new(settings, Instance([7; 16]));
/// link.handle(Duration::ZERO, Input::PacketRead(b"no packet"));
/// assert_eq!(link.poll(), None);
/// assert_eq!(link.counts().dropped_for(DropCause::Packet(PacketError::NotIpv4)), 1);
/// ```
#[derive(Debug)]
pub struct Link {
    settings: Settings,
    instance: Instance,
    seal: Seal,
    flows: Flows,
    group: Group,
    presence: Presence,
    counts: Counts,
    outputs: VecDeque<Output>,
}

impl Link {
    /// Creates the link. `instance` is random: with a project key, no two runs of a host may have the same one.
    #[must_use]
    pub fn new(settings: Settings, instance: Instance) -> Self {
        let seal = Seal::new(&settings.project, settings.address, instance, settings.key.as_ref());
        Self {
            settings,
            instance,
            seal,
            flows: Flows::default(),
            group: Group::default(),
            presence: Presence::default(),
            counts: Counts::default(),
            outputs: VecDeque::new(),
        }
    }

    /// Handles an input at `now`, a monotonic time since any start.
    pub fn handle(&mut self, now: Duration, input: Input<'_>) {
        let result = match input {
            Input::PacketRead(packet) => self.packet_read(now, packet),
            Input::PutReceived { target, source, payload } => self.put_received(target, source, payload),
            Input::HostAppeared(host, instance) => self.host_appeared(now, host, instance),
            Input::HostDisappeared(host, instance) => {
                if self.presence.disappear(host, instance) {
                    self.outputs.push_back(Output::Host(HostFact::Disappeared(host)));
                }
                Ok(())
            }
        };
        if let Err(cause) = result {
            self.counts.dropped_one(cause);
        }
    }

    /// Returns the next output.
    pub fn poll(&mut self) -> Option<Output> {
        self.outputs.pop_front()
    }

    /// Returns the counters since the start.
    #[must_use]
    pub const fn counts(&self) -> &Counts {
        &self.counts
    }

    /// Returns the addresses of the present hosts.
    pub fn hosts(&self) -> impl Iterator<Item = Ipv4Addr> {
        self.presence.hosts()
    }

    // spec: ZLINK-1.1
    fn packet_read(&mut self, now: Duration, packet: &[u8]) -> Result<(), DropCause> {
        let header = Header::parse(packet).map_err(DropCause::Packet)?;
        if header.source != self.settings.address {
            return Err(DropCause::ForeignSource);
        }
        if self.is_for_group(&header) {
            let every = self.settings.group_every;
            if !self.group.read(now, header.source_port, packet, every) {
                return Err(DropCause::GroupPace);
            }
            self.put(Target::All, header.class, packet);
            return Ok(());
        }
        if header.target == header.source || !self.is_inside(header.target) {
            return Err(DropCause::OutsideTarget);
        }
        let Header { protocol, source_port: local_port, target: remote, target_port: remote_port, .. } =
            header;
        if !self.settings.ports.contains(&local_port) {
            self.flows.sent(Flow { protocol, local_port, remote, remote_port });
        }
        self.put(Target::Host(remote), header.class, packet);
        Ok(())
    }

    // spec: ZLINK-1.2
    fn put_received(&mut self, target: Target, source: Ipv4Addr, payload: &[u8]) -> Result<(), DropCause> {
        let packet = self.seal.open(source, target, payload)?;
        let header = Header::parse(&packet).map_err(DropCause::Packet)?;
        let is_addressed = match target {
            Target::All => self.is_for_group(&header),
            Target::Host(host) => {
                host == self.settings.address && (header.target == host || self.is_for_group(&header))
            }
        };
        if header.source != source || source == self.settings.address || !is_addressed {
            return Err(DropCause::ForgedAddress);
        }
        if !self.is_for_group(&header) && !self.is_open(&header) {
            return Err(DropCause::ClosedPort);
        }
        self.counts.received += 1;
        self.outputs.push_back(Output::Write(packet));
        Ok(())
    }

    fn host_appeared(&mut self, now: Duration, host: Ipv4Addr, instance: Instance) -> Result<(), DropCause> {
        if instance == self.instance {
            return Ok(());
        }
        if host == self.settings.address {
            self.outputs.push_back(Output::Host(HostFact::AddressTaken(instance)));
            return Ok(());
        }
        match self.presence.appear(host, instance) {
            Change::None => return Ok(()),
            Change::Full => return Err(DropCause::TooManyHosts),
            Change::Host => self.outputs.push_back(Output::Host(HostFact::Appeared(host))),
            // The host's nodes may have restarted, too.
            Change::Instance => {}
        }
        let recent: Vec<_> = self.group.recent(now).map(<[u8]>::to_vec).collect();
        for packet in recent {
            self.put(Target::Host(host), Class::Discovery, &packet);
        }
        Ok(())
    }

    fn put(&mut self, target: Target, class: Class, packet: &[u8]) {
        self.counts.sent += 1;
        let payload = self.seal.seal(target, packet);
        self.outputs.push_back(Output::Put { target, class, payload });
    }

    fn is_for_group(&self, header: &Header) -> bool {
        let at = SocketAddrV4::new(header.target, header.target_port);
        header.protocol == Protocol::Udp && self.settings.group == Some(at)
    }

    // spec: ZLINK-2
    fn is_open(&self, header: &Header) -> bool {
        let Header { protocol, source: remote, source_port: remote_port, target_port: local_port, .. } =
            *header;
        self.settings.ports.contains(&local_port)
            || self.flows.contains(&Flow { protocol, local_port, remote, remote_port })
    }

    fn is_inside(&self, address: Ipv4Addr) -> bool {
        let network_bits = u32::from(self.settings.prefix.min(32));
        let mask = u32::MAX.checked_shl(32 - network_bits).unwrap_or(0);
        (address.to_bits() ^ self.settings.address.to_bits()) & mask == 0
    }
}

#[cfg(test)]
mod tests;
