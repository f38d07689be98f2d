//! The present addresses of the chosen interfaces. A separate thread reads them from the kernel after each
//! notified change. The read waits for a lock that is held while an interface is configured, and NDL's thread
//! never blocks.
//!
//! There is no such thread if each interface is chosen by its address.

use std::{
    collections::BTreeMap,
    io,
    net::{IpAddr, SocketAddr},
    thread,
    time::Duration,
};

use sinew_model::{
    address::LocalAddress,
    config::{Families, Interface, Interfaces},
};
use sinew_net::{InterfaceAddress, InterfaceMonitor, Ipv6Flags};
use sinew_runtime::remedy::{Wanted, remedy};
use tokio::sync::watch;

/// Minimum time between two reads, which bounds the cost of a flapping interface.
const READ_GAP: Duration = Duration::from_millis(100);
/// Time between two reads without a notification. The kernel sends none after a failed read, nor to a process
/// that may not subscribe.
const READ_PERIOD: Duration = Duration::from_secs(1);
/// Maximum time of a read.
const READ_WITHIN: Duration = Duration::from_secs(1);
/// Maximum number of IPv6 addresses of an interface that is chosen by its name: the link-local one, and one
/// that is known beyond the link. A host may have a dozen, and each additional route over the same link
/// repeats all queries.
const IPV6_OF_ONE_MAX: usize = 2;

/// An address of this host.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Local {
    /// Name of its interface.
    name: String,
    address: LocalAddress,
    /// Whether the interface is up and has carrier.
    is_running: bool,
    /// State of an IPv6 address in the kernel.
    flags: Ipv6Flags,
}

/// The state of the chosen interfaces' addresses.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct Usable {
    /// Addresses of interfaces that are up and have carrier.
    pub(super) running: Vec<LocalAddress>,
    /// Addresses that the host has. Their open sockets stay open, with or without carrier.
    pub(super) there: Vec<LocalAddress>,
    /// Addresses that cannot be used yet or at all: the kernel is checking for a duplicate, or has found one.
    pub(super) in_doubt: Vec<(LocalAddress, Ipv6Flags)>,
    /// The interface numbers of this host, by interface name.
    pub(super) numbers: BTreeMap<String, u32>,
    /// All addresses of this host, used or not, except those in doubt.
    pub(super) own: Vec<SocketAddr>,
    /// The interface name of each of these addresses.
    pub(super) names: BTreeMap<SocketAddr, String>,
    /// Whether any interface has an IPv6 address, including loopback.
    pub(super) has_ipv6: bool,
    /// Whether a read has succeeded.
    pub(super) is_known: bool,
}

impl Usable {
    /// Selects the chosen addresses of `all`, in order of their priority. That is the order of the choices,
    /// except that further IPv6 addresses of each choice come last.
    fn of(chosen: &Interfaces, all: &[Local]) -> Self {
        let numbers = all.iter().filter(|local| local.address.interface != 0);
        let numbers = numbers.map(|local| (local.name.clone(), local.address.interface)).collect();
        let has_ipv6 = all.iter().any(|local| local.address.ip.is_ipv6());
        let named = all.iter().filter(|local| !local.is_in_doubt());
        let named: Vec<_> = named.map(|local| (local.address.at(0), local.name.clone())).collect();
        let own = named.iter().map(|(address, _)| *address).collect();
        let names = named.into_iter().collect();
        let mut usable = Self { numbers, own, names, has_ipv6, is_known: true, ..Self::default() };
        // If there is no room for all, no IPv6 address of one choice takes the only path of another. The IPv4
        // addresses and the first IPv6 address of each choice come first, then the others in turn.
        let turn = |(nth, local): (usize, &'_ Local)| if local.address.ip.is_ipv4() { 0 } else { nth };
        let in_turn = |choice| chosen_by(choice, all).into_iter().enumerate().map(move |at| (turn(at), at.1));
        let mut wanted: Vec<_> = chosen.iter().flat_map(in_turn).collect();
        wanted.sort_by_key(|(turn, _)| *turn);
        wanted.into_iter().for_each(|(_, local)| usable.take(local));
        usable
    }

    fn take(&mut self, local: &Local) {
        let address = local.address;
        if self.there.contains(&address) || self.in_doubt.iter().any(|(known, _)| *known == address) {
            return;
        }
        if local.is_in_doubt() {
            self.in_doubt.push((address, local.flags));
            return;
        }
        self.there.push(address);
        if local.is_running {
            self.running.push(address);
        }
    }
}

/// Returns the addresses that a choice selects, in order of preference.
fn chosen_by<'a>(choice: &Interface, all: &'a [Local]) -> Vec<&'a Local> {
    let is_chosen = |local: &&Local| match choice {
        Interface::Address(address) => local.address.ip == *address,
        Interface::Address6 { address, zone } => {
            local.address.ip == *address && zone.as_ref().is_none_or(|zone| local.is_called(zone))
        }
        // A host may have further addresses on its loopback interface, which routing announces to the
        // network.
        Interface::Name(name, families) => {
            local.name == *name
                && local.is_of(*families)
                && (local.address.ip.is_loopback() || !choice.is_loopback())
        }
        Interface::All(families) => !local.address.ip.is_loopback() && local.is_of(*families),
    };
    let mut chosen: Vec<_> = all.iter().filter(is_chosen).collect();
    match choice {
        Interface::Address(_) | Interface::Address6 { .. } => return chosen,
        Interface::Name(..) | Interface::All(_) => {}
    }
    // If there is no room for all of them, each link keeps one address before any link has two. Equal
    // addresses keep the kernel's order. The kernel lists the newest first, so addresses in doubt come last.
    chosen.sort_by_key(|local| (local.rank(), local.is_in_doubt()));
    let mut of_one = BTreeMap::<u32, usize>::new();
    chosen.retain(|local| {
        let LocalAddress { ip, interface } = local.address;
        let count = of_one.entry(interface).or_default();
        *count += usize::from(ip.is_ipv6());
        ip.is_ipv4() || *count <= IPV6_OF_ONE_MAX
    });
    chosen
}

impl Local {
    fn is_called(&self, zone: &str) -> bool {
        self.name == zone || zone.parse() == Ok(self.address.interface)
    }

    /// Returns whether the address is used if its interface is chosen, and not the address itself. Temporary
    /// addresses are not.
    const fn is_of(&self, families: Families) -> bool {
        match self.address.ip {
            IpAddr::V4(_) => families.has_ipv4(),
            IpAddr::V6(_) => families.has_ipv6() && !self.flags.is_temporary,
        }
    }

    /// Returns whether another host may have the address, or has it.
    const fn is_in_doubt(&self) -> bool {
        self.flags.is_tentative || self.flags.is_duplicate
    }

    /// Returns the preference of the address: IPv4 before IPv6. Within IPv6 the link-local address is first,
    /// since it needs no assignment, then those of a site (RFC 4193), then others.
    const fn rank(&self) -> u8 {
        match self.address.ip {
            IpAddr::V4(_) => 0,
            IpAddr::V6(ip) if ip.is_unicast_link_local() => 1,
            IpAddr::V6(ip) if ip.is_unique_local() => 2,
            IpAddr::V6(_) => 3,
        }
    }
}

/// Reads the addresses now and after each change, for as long as there is a receiver.
///
/// # Errors
/// Returns an error if no thread can be started.
pub(super) fn watch(chosen: Interfaces) -> io::Result<watch::Receiver<Usable>> {
    let (sender, receiver) = watch::channel(Usable::default());
    thread::Builder::new().name("ndl-interfaces".to_owned()).spawn(move || follow(&chosen, &sender))?;
    Ok(receiver)
}

fn follow(chosen: &Interfaces, sender: &watch::Sender<Usable>) {
    let mut monitor = None;
    let (mut has_failed, mut is_in_doubt) = (false, false);
    while !sender.is_closed() {
        match read(&mut monitor) {
            Ok(all) => {
                has_failed = false;
                let usable = Usable::of(chosen, &all);
                // Duplicate address detection takes seconds, so the next read is soon.
                is_in_doubt = !usable.in_doubt.is_empty();
                sender.send_if_modified(|known| {
                    let is_new = *known != usable;
                    *known = usable;
                    is_new
                });
            }
            Err(error) => {
                monitor = None;
                if !has_failed {
                    sinew_runtime::log::warn!(
                        %error,
                        remedy = %remedy(Wanted::Descriptor, &error),
                        "NDL cannot see this host's interfaces; it uses the last state, and retries every second. \
                         Where that goes on, choose interfaces by their addresses in `ndl.interface`"
                    );
                }
                has_failed = true;
            }
        }
        thread::sleep(READ_GAP);
        wait(&mut monitor, sender, is_in_doubt);
    }
}

/// Returns all addresses of this host. Subscribes before the first read, so that no change is missed between
/// the two.
fn read(monitor: &mut Option<InterfaceMonitor>) -> io::Result<Vec<Local>> {
    let monitor = match monitor {
        Some(monitor) => monitor,
        None => monitor.insert(open()?),
    };
    Ok(monitor.read_all(READ_WITHIN)?.into_iter().map(Local::from).collect())
}

fn open() -> io::Result<InterfaceMonitor> {
    InterfaceMonitor::subscribe().or_else(|error| {
        let monitor = InterfaceMonitor::without_reports()?;
        sinew_runtime::log::warn!(%error, "the kernel does not report interface changes: NDL reads the interfaces every second");
        Ok(monitor)
    })
}

/// Waits until something has changed, or until the next read is due.
fn wait(monitor: &mut Option<InterfaceMonitor>, sender: &watch::Sender<Usable>, is_in_doubt: bool) {
    while !sender.is_closed() {
        let Some(open) = monitor else { return thread::sleep(READ_PERIOD) };
        match open.wait(READ_PERIOD) {
            Ok(false) if open.is_subscribed() && !is_in_doubt => {}
            Ok(_) => return,
            Err(error) => {
                sinew_runtime::log::warn!(%error, "the kernel does not report interface changes any more: NDL subscribes again");
                *monitor = None;
            }
        }
    }
}

impl From<InterfaceAddress> for Local {
    fn from(InterfaceAddress { name, index, ip, is_running, flags }: InterfaceAddress) -> Self {
        let interface = if ip.is_ipv6() { index } else { 0 };
        Self { name, address: LocalAddress { ip, interface }, is_running, flags }
    }
}

#[cfg(test)]
mod tests;
