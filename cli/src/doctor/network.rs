//! Checks the interfaces, and whether multicast is received on one of them.

use std::{
    collections::BTreeMap,
    fs, io,
    net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr, SocketAddrV4, SocketAddrV6, UdpSocket},
    time::Duration,
};

use sinew::config::{Families, Interface as Choice, Interfaces};
use socket2::{Domain, Protocol, SockAddr, Socket, Type};

use super::Check;

/// Time limit for a datagram to return from this machine's own interface.
const RECEIVE_TIMEOUT: Duration = Duration::from_millis(500);
/// The groups of the test; Sinew does not use them.
const GROUP: Ipv4Addr = Ipv4Addr::new(239, 255, 255, 77);
const GROUP6: Ipv6Addr = Ipv6Addr::new(0xff12, 0, 0, 0, 0, 0, 0x8000, 0xff4d);
/// Flags of an interface (`linux/if.h`).
const UP: u32 = 0x1;
const MULTICAST: u32 = 0x1000;

/// An interface of this machine.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Interface {
    pub(super) name: String,
    pub(super) addresses: Vec<IpAddr>,
    /// The kernel's number of it, if it has an address.
    pub(super) number: Option<u32>,
    pub(super) flags: u32,
    /// Whether there is a carrier: a cable, a radio link.
    pub(super) has_carrier: bool,
}

impl Interface {
    pub(super) fn is_loopback(&self) -> bool {
        self.addresses.iter().any(IpAddr::is_loopback)
    }

    /// Returns why it cannot carry datagrams of nodes to other hosts, and the fix for that.
    pub(super) fn lacks(&self) -> Option<(&'static str, String)> {
        let name = &self.name;
        if self.flags & UP == 0 {
            return Some(("down", format!("sudo ip link set dev {name} up")));
        }
        if !self.has_carrier {
            return Some(("no carrier", format!("plug the cable of {name} in, or bring its link up")));
        }
        if self.addresses.is_empty() {
            return Some((
                "no address",
                format!("sudo ip address add 10.0.0.1/24 dev {name} (an address of your network)"),
            ));
        }
        if self.flags & MULTICAST == 0 {
            return Some((
                "no multicast",
                format!("sudo ip link set dev {name} multicast on; or [ndl] seeds = [..]"),
            ));
        }
        None
    }

    fn in_words(&self) -> String {
        let addresses: Vec<_> = self.addresses.iter().map(IpAddr::to_string).collect();
        let state = match self.lacks() {
            // Linux carries multicast there without the flag.
            _ if self.is_loopback() => "this host only",
            Some((lack, _)) => lack,
            None => "usable",
        };
        let addresses = if addresses.is_empty() { "-".to_owned() } else { addresses.join(" ") };
        format!("{} {addresses} ({state})", self.name)
    }
}

/// Whether an interface leads to other hosts.
pub(super) fn interfaces(all: &[Interface]) -> Check {
    const NAME: &str = "interfaces";
    let detail: Vec<_> = all.iter().map(Interface::in_words).collect();
    let detail = if detail.is_empty() { "none can be seen".to_owned() } else { detail.join(", ") };
    if all.iter().any(|interface| !interface.is_loopback() && interface.lacks().is_none()) {
        return Check::fine(NAME, detail);
    }
    // The one that passes the most checks.
    let likeliest = all.iter().filter(|interface| !interface.is_loopback());
    let likeliest = likeliest.max_by_key(|interface| {
        (interface.flags & UP, interface.has_carrier, !interface.addresses.is_empty())
    });
    let fix = likeliest.and_then(Interface::lacks).map_or_else(
        || "nodes of this host find each other; for others: a network interface".to_owned(),
        |(_, fix)| fix,
    );
    Check::finding(NAME, format!("none leads to other hosts: {detail}"), fix)
}

/// Returns all interfaces, with the kernel's data about them.
pub(super) fn found() -> Vec<Interface> {
    let mut addresses: BTreeMap<String, (Vec<IpAddr>, Option<u32>)> = BTreeMap::new();
    for interface in if_addrs::get_if_addrs().unwrap_or_default() {
        let (ip, index) = (interface.ip(), interface.index);
        let (all, number) = addresses.entry(interface.name).or_default();
        all.push(ip);
        *number = number.or(index);
    }
    let entries = fs::read_dir("/sys/class/net").into_iter().flatten().flatten();
    let names: Vec<_> = entries.filter_map(|entry| entry.file_name().into_string().ok()).collect();
    let mut found: Vec<_> = names
        .into_iter()
        .filter_map(|name| {
            let read =
                |what: &str| fs::read_to_string(format!("/sys/class/net/{name}/{what}")).unwrap_or_default();
            let flags = u32::from_str_radix(read("flags").trim().trim_start_matches("0x"), 16).ok()?;
            let has_carrier = read("carrier").trim() == "1";
            let (addresses, number) = addresses.remove(&name).unwrap_or_default();
            // An interface that is down and has no address is certainly not intended (tunnels, shapers).
            let is_meant = flags & UP != 0
                || !addresses.is_empty()
                || fs::exists(format!("/sys/class/net/{name}/device")).unwrap_or(false);
            is_meant.then_some(Interface { name, addresses, number, flags, has_carrier })
        })
        .collect();
    found.sort_by(|one, other| one.name.cmp(&other.name));
    found
}

const MULTICAST_NAME: &str = "multicast";

/// Checks whether a datagram to a group returns at each address of these interfaces.
pub(super) fn multicast(chosen: &Interfaces, all: &[Interface]) -> Vec<Check> {
    chosen.iter().flat_map(|choice| multicast_at(choice, all)).collect()
}

fn multicast_at(choice: &Choice, all: &[Interface]) -> Vec<Check> {
    let usable = |interface: &&Interface| !interface.is_loopback() && interface.lacks().is_none();
    let (at, families, none): (Vec<&Interface>, Families, String) = match choice {
        Choice::Address(address) => return vec![hears_at((*address).into(), None, all)],
        Choice::Address6 { address, zone } => {
            return vec![hears_at((*address).into(), zone.as_deref(), all)];
        }
        Choice::Name(name, families) => (
            all.iter().filter(|interface| interface.name == *name).collect(),
            *families,
            format!("no interface of this host is called {name}, or it has no address"),
        ),
        Choice::All(families) => (
            all.iter().filter(usable).collect(),
            *families,
            "no interface leads to other hosts, and `all` is chosen".to_owned(),
        ),
    };
    let checks: Vec<_> = at
        .iter()
        .copied()
        .flat_map(|interface| tried(interface, choice, families).map(|address| heard_at(address, interface)))
        .collect();
    if !checks.is_empty() {
        return checks.into_iter().chain(without_ipv4(choice, families, &at)).collect();
    }
    let names: Vec<_> = all.iter().map(Interface::in_words).collect();
    let fix = format!(
        "the node waits until there is one; or set `ndl.interface` to one of this host: {}",
        names.join(", ")
    );
    vec![Check::finding(MULTICAST_NAME, none, fix)]
}

/// Reports that a chosen interface has no IPv4 address although it may have one: nodes without IPv6 cannot reach that
/// node. A lease may have ended.
fn without_ipv4(choice: &Choice, families: Families, at: &[&Interface]) -> Option<Check> {
    let has_ipv4 = at.iter().flat_map(|interface| &interface.addresses).any(IpAddr::is_ipv4);
    if has_ipv4 || !families.has_ipv4() {
        return None;
    }
    let device = at.first().map_or("eth0", |interface| interface.name.as_str());
    let fix = format!(
        "sudo ip address add 10.0.0.1/24 dev {device} (an address of your network); or, where IPv6 alone is meant, `ndl.interface` = \"{choice}/ipv6\""
    );
    let detail = format!("{choice} has no IPv4 address: the node is seen by IPv6 alone");
    Some(Check::finding(MULTICAST_NAME, detail, fix))
}

/// Returns the addresses of an interface at which groups are tested: each IPv4 address, and one IPv6 address, because
/// the group belongs to the link. For loopback, those that nodes use there.
fn tried(interface: &Interface, choice: &Choice, families: Families) -> impl Iterator<Item = IpAddr> {
    let is_on_loopback = choice.is_loopback();
    let used = interface.addresses.iter().copied().filter(move |ip| ip.is_loopback() || !is_on_loopback);
    let of_ipv6 = used.clone().filter(|_| families.has_ipv6()).find(IpAddr::is_ipv6);
    used.filter(move |ip| families.has_ipv4() && ip.is_ipv4()).chain(of_ipv6)
}

/// Checks whether a datagram to a group returns at the interface with this address.
fn hears_at(address: IpAddr, zone: Option<&str>, all: &[Interface]) -> Check {
    let is_it = |interface: &&Interface| {
        let has_it = interface.addresses.contains(&address)
            || (address.is_ipv4() && address.is_loopback() && interface.is_loopback());
        let is_called = |zone: &str| interface.name == zone || zone.parse().ok() == interface.number;
        has_it && zone.is_none_or(is_called)
    };
    if let Some(interface) = all.iter().find(is_it) {
        return heard_at(address, interface);
    }
    let others: Vec<_> =
        all.iter().flat_map(|interface| &interface.addresses).map(IpAddr::to_string).collect();
    let fix = format!(
        "set `ndl.interface`, and --interface here, to an address of this host: {}",
        others.join(", ")
    );
    Check::finding(MULTICAST_NAME, format!("no interface of this host has the address {address}"), fix)
}

fn heard_at(address: IpAddr, interface: &Interface) -> Check {
    const NAME: &str = MULTICAST_NAME;
    let device = &interface.name;
    if address.is_ipv6() && address.is_loopback() {
        let detail =
            format!("{address} ({device}) has no groups: nodes of this host find each other there by seeds");
        return Check::fine(NAME, detail);
    }
    let fix = || {
        let (route, key) = match address {
            IpAddr::V4(_) => ("ip route add 239.0.0.0/8", "multicast"),
            IpAddr::V6(_) => ("ip -6 route add multicast ff00::/8 table local", "multicast6"),
        };
        format!(
            "sudo ip link set dev {device} multicast on && sudo {route} dev {device}; or do without it: [ndl] {key} = \
             false, seeds = [..]"
        )
    };
    match hears_itself(address, interface.number) {
        Ok(true) => Check::fine(
            NAME,
            format!(
                "a datagram to a group came back at {address} ({device}); the way to other hosts was not tried"
            ),
        ),
        Ok(false) => {
            let detail = format!(
                "a datagram to a group at {address} ({device}) did not come back within {RECEIVE_TIMEOUT:?}"
            );
            Check::finding(NAME, detail, fix())
        }
        Err(error) => {
            Check::finding(NAME, format!("no group can be joined at {address} ({device}): {error}"), fix())
        }
    }
}

/// Returns whether a datagram to a group on this interface returns; it never leaves this machine.
fn hears_itself(address: IpAddr, number: Option<u32>) -> io::Result<bool> {
    let family = if address.is_ipv4() { Domain::IPV4 } else { Domain::IPV6 };
    let socket = Socket::new(family, Type::DGRAM, Some(Protocol::UDP))?;
    match address {
        IpAddr::V4(interface) => {
            socket.bind(&SockAddr::from(SocketAddrV4::new(Ipv4Addr::UNSPECIFIED, 0)))?;
            socket.set_multicast_if_v4(&interface)?;
            socket.set_multicast_ttl_v4(0)?;
            socket.set_multicast_loop_v4(true)?;
            socket.join_multicast_v4(&GROUP, &interface)?;
        }
        IpAddr::V6(_) => {
            let number = number.ok_or(io::ErrorKind::AddrNotAvailable)?;
            socket.set_only_v6(true)?;
            socket.bind(&SockAddr::from(SocketAddrV6::new(Ipv6Addr::UNSPECIFIED, 0, 0, 0)))?;
            socket.set_multicast_if_v6(number)?;
            socket.set_multicast_hops_v6(0)?;
            socket.set_multicast_loop_v6(true)?;
            socket.join_multicast_v6(&GROUP6, number)?;
        }
    }
    let socket = UdpSocket::from(socket);
    socket.set_read_timeout(Some(RECEIVE_TIMEOUT))?;
    let sent = std::process::id().to_le_bytes();
    let group = if address.is_ipv4() { IpAddr::V4(GROUP) } else { IpAddr::V6(GROUP6) };
    socket.send_to(&sent, SocketAddr::new(group, socket.local_addr()?.port()))?;
    let mut received = [0; 8];
    match socket.recv_from(&mut received) {
        Ok((length, _)) => Ok(received[..length] == sent),
        Err(error) if matches!(error.kind(), io::ErrorKind::WouldBlock | io::ErrorKind::TimedOut) => {
            Ok(false)
        }
        Err(error) => Err(error),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn interface(name: &str, address: Option<[u8; 4]>, flags: u32, has_carrier: bool) -> Interface {
        let addresses = address.into_iter().map(IpAddr::from).collect();
        Interface { name: name.to_owned(), addresses, number: Some(1), flags, has_carrier }
    }

    #[test]
    fn each_interface_defect_has_a_fixing_command() {
        let lo = || interface("lo", Some([127, 0, 0, 1]), UP, true);
        let usable = interface("eth0", Some([10, 0, 0, 5]), UP | MULTICAST, true);
        assert!(interfaces(&[lo(), usable]).fix.is_none());
        for (one, fix) in [
            (interface("eth0", None, MULTICAST, false), "ip link set dev eth0 up"),
            (interface("eth0", None, UP | MULTICAST, false), "cable of eth0"),
            (interface("eth0", None, UP | MULTICAST, true), "ip address add"),
            (interface("eth0", Some([10, 0, 0, 5]), UP, true), "eth0 multicast on"),
        ] {
            let check = interfaces(&[lo(), one]);
            assert!(check.fix.as_ref().is_some_and(|text| text.contains(fix)), "{fix}: {:?}", check.fix);
        }
        assert!(interfaces(&[lo()]).fix.is_some(), "there is only this host");
        assert!(interfaces(&[]).fix.is_some());
    }

    #[test]
    fn unknown_address_is_reported_with_the_existing_ones() {
        let all = [interface("lo", Some([127, 0, 0, 1]), UP, true)];
        let check = hears_at(Ipv4Addr::new(192, 0, 2, 1).into(), None, &all);
        assert!(check.fix.is_some_and(|fix| fix.contains("127.0.0.1")));
    }

    #[test]
    fn unmatched_interface_choices_are_findings() {
        let all =
            [interface("lo", Some([127, 0, 0, 1]), UP, true), interface("eth0", None, MULTICAST, false)];
        for (choice, word) in [("eth1", "eth1"), ("all", "`all`"), ("fe80::1%eth1", "fe80::1")] {
            let choice: Choice = choice.parse().unwrap();
            let checks = multicast(&vec![choice].into(), &all);
            assert_eq!(checks.len(), 1);
            assert!(checks[0].detail.contains(word), "{}", checks[0].detail);
            assert!(checks[0].fix.as_ref().is_some_and(|fix| fix.contains("eth0") || word == "fe80::1"));
        }
    }

    #[test]
    fn missing_ipv4_is_a_finding_unless_ipv6_is_chosen() {
        let of = |addresses: &[&str], choice: &str| {
            let addresses = addresses.iter().map(|ip| ip.parse().unwrap()).collect();
            let all = [Interface { addresses, ..interface("eth0", None, UP | MULTICAST, true) }];
            let checks = multicast(&vec![choice.parse::<Choice>().unwrap()].into(), &all);
            checks.into_iter().find(|check| check.detail.contains("no IPv4 address"))
        };
        for choice in ["eth0", "all"] {
            let missing = of(&["fe80::1"], choice).expect("a finding");
            assert!(missing.fix.is_some_and(|fix| fix.contains(&format!("{choice}/ipv6"))));
            assert!(of(&["fe80::1", "127.0.0.9"], choice).is_none());
        }
        assert!(of(&["fe80::1"], "eth0/ipv6").is_none());
    }

    #[test]
    fn each_address_of_an_interface_is_tested() {
        let mut lo = interface("lo", Some([127, 0, 0, 1]), UP, true);
        lo.addresses.extend(["127.0.0.2", "::1"].map(|ip| ip.parse::<IpAddr>().unwrap()));
        let all = [lo.clone()];
        let count = |choice: &str| multicast(&vec![choice.parse::<Choice>().unwrap()].into(), &all).len();
        assert_eq!((count("lo"), count("lo/ipv4"), count("lo/ipv6"), count("::1%lo")), (3, 2, 1, 1));
        // Nodes do not use this one: an address that routing announces to the network.
        lo.addresses.insert(0, [10, 9, 9, 9].into());
        lo.addresses.insert(0, Ipv6Addr::new(0xfd00, 0, 0, 0, 0, 0, 0, 7).into());
        let tried: Vec<_> = tried(&lo, &"lo".parse().unwrap(), Families::Both).collect();
        assert_eq!(
            tried.iter().map(IpAddr::to_string).collect::<Vec<_>>(),
            ["127.0.0.1", "127.0.0.2", "::1"]
        );
    }
}
