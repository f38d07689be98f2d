//! The known addresses of this host, and the losses of addresses. Pure.
//!
//! An address is lost if it is removed, or if its interface goes down or is removed. If reports were lost,
//! all addresses are listed again, and missing ones are treated as reported lost.

use std::{
    collections::{BTreeMap, BTreeSet},
    net::{IpAddr, SocketAddr, SocketAddrV6},
};

use crate::report::{Address, Dump, Ipv6Flags, Link, Report, messages};

/// Maximum number of known addresses, and of known interfaces. The loss of a further address is not reported.
pub(crate) const ADDRESSES_MAX: usize = 1_024;

/// An address of this host.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct InterfaceAddress {
    /// Name of its interface, or the address's own label.
    pub name: String,
    /// Index of its interface.
    pub index: u32,
    /// The address.
    pub ip: IpAddr,
    /// Whether the interface is administratively up, and has carrier.
    pub is_running: bool,
    /// State of an IPv6 address; none of the flags is set for IPv4.
    pub flags: Ipv6Flags,
}

/// The result of received messages.
#[derive(Debug, Default)]
pub(crate) struct Received {
    /// The lost addresses.
    pub(crate) lost: Vec<SocketAddr>,
    /// The list to request now.
    pub(crate) request: Option<Dump>,
    /// Whether the kernel reported a change.
    pub(crate) has_changed: bool,
    /// The error number of a refused request.
    pub(crate) refused: Option<i32>,
}

/// A running dump, as far as the kernel has answered.
#[derive(Debug)]
struct RunningDump {
    dump: Dump,
    found: Interfaces,
    /// Whether the interfaces are listed, too: they may have gone down without a report.
    has_links: bool,
    /// Whether reports were lost meanwhile.
    is_inconsistent: bool,
}

impl RunningDump {
    fn new(has_links: bool) -> Self {
        Self { dump: Dump::Addresses, found: Interfaces::default(), has_links, is_inconsistent: false }
    }
}

/// The known addresses, and the running dump.
#[derive(Debug, Default)]
pub(crate) struct Table {
    known: Interfaces,
    running_dump: Option<RunningDump>,
}

impl Table {
    /// Begins to list the addresses, without the state of interfaces. Returns the list to request now.
    pub(crate) fn begin(&mut self) -> Dump {
        self.running_dump = Some(RunningDump::new(false));
        Dump::Addresses
    }

    /// Processes the kernel's messages.
    pub(crate) fn receive(&mut self, bytes: &[u8]) -> Received {
        let mut received = Received::default();
        for message in messages(bytes) {
            match (message.report, &mut self.running_dump) {
                (Some(Report::Done), _) => received.request = self.on_done(&mut received.lost),
                // Operation continues without the list.
                (Some(Report::Refused(code)), _) => {
                    self.running_dump = None;
                    received.refused = Some(code);
                }
                (report, Some(running_dump)) if message.is_from_dump => {
                    running_dump.is_inconsistent |= message.is_inconsistent;
                    received
                        .lost
                        .extend(report.map(|report| running_dump.found.apply(report)).unwrap_or_default());
                }
                (Some(report), running_dump) => {
                    // The report follows a part of the dump that already arrived, or its content is in a part
                    // still to arrive.
                    let found =
                        running_dump.as_mut().map(|running_dump| running_dump.found.apply(report.clone()));
                    let known = self.known.apply(report);
                    let lost = known.into_iter().chain(found.into_iter().flatten());
                    received.lost.extend(lost.collect::<BTreeSet<_>>());
                    received.has_changed = true;
                }
                (None, _) => {}
            }
        }
        received
    }

    /// Begins to list all addresses and interfaces, or repeats a running dump, as reports were lost. Returns
    /// the list to request now.
    pub(crate) fn on_missed_reports(&mut self) -> Option<Dump> {
        if let Some(running_dump) = &mut self.running_dump {
            running_dump.is_inconsistent = true;
            return None;
        }
        self.running_dump = Some(RunningDump::new(true));
        Some(Dump::Addresses)
    }

    /// Returns whether a dump is running.
    pub(crate) const fn is_listing(&self) -> bool {
        self.running_dump.is_some()
    }

    /// Returns the known addresses of known interfaces, in the kernel's order.
    pub(crate) fn addresses(&self) -> Vec<InterfaceAddress> {
        let Interfaces { links, addresses } = &self.known;
        let known = addresses.iter().filter_map(|address| {
            let Address { index, ip, label, flags } = address.clone();
            let link = links.get(&index)?;
            let name = label.unwrap_or_else(|| link.name.clone());
            Some(InterfaceAddress { name, index, ip, is_running: link.is_running, flags })
        });
        known.collect()
    }

    /// Processes the end of a dump. Returns the next list to request.
    fn on_done(&mut self, lost: &mut Vec<SocketAddr>) -> Option<Dump> {
        let mut running_dump = self.running_dump.take()?;
        if running_dump.is_inconsistent {
            self.running_dump = Some(RunningDump::new(true));
            return Some(Dump::Addresses);
        }
        if running_dump.has_links && running_dump.dump == Dump::Addresses {
            running_dump.dump = Dump::Links;
            self.running_dump = Some(running_dump);
            return Some(Dump::Links);
        }
        lost.extend(self.known.without(&running_dump.found));
        self.known = running_dump.found;
        None
    }
}

/// The interfaces of this host by their index, and all addresses.
#[derive(Debug, Default)]
struct Interfaces {
    links: BTreeMap<u32, Link>,
    addresses: Vec<Address>,
}

impl Interfaces {
    /// Returns the addresses that are missing in `found`; none if `found` is truncated.
    fn without(&self, found: &Self) -> Vec<SocketAddr> {
        if found.addresses.len() >= ADDRESSES_MAX {
            return Vec::new();
        }
        let lost =
            self.addresses.iter().filter(|address| found.position(address.index, address.ip).is_none());
        lost.map(|address| socket_address(address.index, address.ip)).collect()
    }

    fn position(&self, index: u32, ip: IpAddr) -> Option<usize> {
        self.addresses.iter().position(|address| address.index == index && address.ip == ip)
    }

    fn of_link(&self, index: u32) -> Vec<SocketAddr> {
        let of_link = self.addresses.iter().filter(|address| address.index == index);
        of_link.map(|address| socket_address(index, address.ip)).collect()
    }

    /// Applies one report. Returns the lost addresses.
    fn apply(&mut self, report: Report) -> Vec<SocketAddr> {
        match report {
            Report::Link(link) => {
                // The interface may have the same addresses when it is up again, so they are kept.
                let lost = if link.is_running { Vec::new() } else { self.of_link(link.index) };
                if self.links.len() < ADDRESSES_MAX || self.links.contains_key(&link.index) {
                    self.links.insert(link.index, link);
                }
                lost
            }
            Report::LinkRemoved { index } => {
                let lost = self.of_link(index);
                self.links.remove(&index);
                self.addresses.retain(|address| address.index != index);
                lost
            }
            Report::Address(address) => {
                match self.position(address.index, address.ip) {
                    Some(at) => self.addresses[at] = address,
                    None if self.addresses.len() < ADDRESSES_MAX => self.addresses.push(address),
                    None => {}
                }
                Vec::new()
            }
            Report::AddressRemoved { index, ip } => {
                self.addresses.retain(|address| address.index != index || address.ip != ip);
                vec![socket_address(index, ip)]
            }
            Report::Done | Report::Refused(_) => Vec::new(),
        }
    }
}

/// Returns an address of this interface in the form of a socket address, without a port.
fn socket_address(index: u32, ip: IpAddr) -> SocketAddr {
    match ip {
        IpAddr::V4(_) => (ip, 0).into(),
        IpAddr::V6(ip) => SocketAddrV6::new(ip, 0, 0, index).into(),
    }
}

#[cfg(test)]
pub(crate) mod tests;
