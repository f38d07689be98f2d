//! Which addresses the chosen interfaces have now. A thread of its own asks the kernel, when that says that something has changed: the
//! question waits for a lock that whoever configures an interface holds, and NDL's thread waits for nobody.
//!
//! Nobody looks where each interface is chosen by its address.

mod flags;

use std::{
    collections::BTreeMap,
    io,
    net::{IpAddr, SocketAddr},
    thread,
    time::Duration,
};

use sinew_runtime::remedy::{Wanted, remedy};
use tokio::sync::watch;

pub(super) use self::flags::Flags;
use super::address::LocalAddress;
use crate::config::{Families, Interface, Interfaces};

/// Time between two looks, at least: an interface that flaps costs no more.
const LOOK_GAP: Duration = Duration::from_millis(100);
/// Time until it looks again if the kernel says nothing: it says nothing where a look failed, nor to whoever may not listen.
const LOOK_AGAIN: Duration = Duration::from_secs(1);
/// Interfaces that are looked at, at most.
const INTERFACES_MAX: usize = 1_024;
/// IPv6 addresses of an interface that is chosen by its name: the link-local one, and one that is known beyond the link. A host may have a
/// dozen, and each way that leads over the same link asks every node once more.
const IPV6_OF_ONE_MAX: usize = 2;

/// An address of this host.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Local {
    /// Of its interface.
    name: String,
    address: LocalAddress,
    /// Whether the interface is up and has carrier.
    is_running: bool,
    /// What the kernel says of an IPv6 address.
    flags: Flags,
}

/// What is known of the chosen interfaces' addresses.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct Usable {
    /// Packets get out there.
    pub(super) running: Vec<LocalAddress>,
    /// The host has these; whether packets get out or not, what is open there stays open.
    pub(super) there: Vec<LocalAddress>,
    /// Addresses that cannot be used yet, or never: the kernel asks whether another host has them, or one has.
    pub(super) in_doubt: Vec<(LocalAddress, Flags)>,
    /// The numbers of this host's interfaces, by their names.
    pub(super) numbers: BTreeMap<String, u32>,
    /// All addresses of this host, used or not.
    pub(super) own: Vec<SocketAddr>,
    /// Whether any interface has an IPv6 address, be it that of loopback.
    pub(super) has_ipv6: bool,
    /// Whether a look has succeeded.
    pub(super) is_known: bool,
}

impl Usable {
    /// What of `all` is chosen, in the order in which there is room for it: that of the choices, but for further IPv6 addresses of each.
    fn of(chosen: &Interfaces, all: &[Local]) -> Self {
        let numbers = all.iter().filter(|local| local.address.interface != 0);
        let numbers = numbers.map(|local| (local.name.clone(), local.address.interface)).collect();
        let has_ipv6 = all.iter().any(|local| local.address.ip.is_ipv6());
        let own = all.iter().filter(|local| !local.is_in_doubt()).map(|local| local.address.at(0)).collect();
        let mut usable = Self { numbers, own, has_ipv6, is_known: true, ..Self::default() };
        // Where there is no room for all, no IPv6 address of one choice takes the only path of another: first the first one of each, and
        // each of IPv4, then the others in turn.
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

/// The addresses that a choice takes, in the order in which they are preferred.
fn chosen_by<'a>(choice: &Interface, all: &'a [Local]) -> Vec<&'a Local> {
    let is_chosen = |local: &&Local| match choice {
        Interface::Address(address) => local.address.ip == *address,
        Interface::Address6 { address, zone } => {
            local.address.ip == *address && zone.as_ref().is_none_or(|zone| local.is_called(zone))
        }
        // A host may have others on its loopback interface, which are told to the network by routing.
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
    // Where there is no room for all of them, each link keeps one before any has two. The order of the kernel holds among equals; but one
    // that cannot be used yet, or never can, takes nobody's place: the kernel lists the newest first.
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

    /// Whether it is used where its interface is chosen and not it: none that the host gives up of its own accord.
    const fn is_of(&self, families: Families) -> bool {
        match self.address.ip {
            IpAddr::V4(_) => families.has_ipv4(),
            IpAddr::V6(_) => families.has_ipv6() && !self.flags.is_temporary,
        }
    }

    /// Whether another host may have it, or has it.
    const fn is_in_doubt(&self) -> bool {
        self.flags.is_tentative || self.flags.is_duplicate
    }

    /// IPv4 before IPv6; of that the link's own address, which needs nobody to give it, then those of a site (RFC 4193), then others.
    const fn rank(&self) -> u8 {
        match self.address.ip {
            IpAddr::V4(_) => 0,
            IpAddr::V6(ip) if ip.is_unicast_link_local() => 1,
            IpAddr::V6(ip) if ip.is_unique_local() => 2,
            IpAddr::V6(_) => 3,
        }
    }
}

/// Looks now, and whenever something changes, for as long as anybody listens.
///
/// # Errors
/// There is no thread for it.
pub(super) fn watch(chosen: Interfaces) -> io::Result<watch::Receiver<Usable>> {
    let (tell, told) = watch::channel(Usable::default());
    thread::Builder::new().name("ndl-interfaces".to_owned()).spawn(move || follow(&chosen, &tell))?;
    Ok(told)
}

fn follow(chosen: &Interfaces, tell: &watch::Sender<Usable>) {
    // Before the first look, so that no change is missed between the two.
    let mut changes = Changes::begin();
    let (mut has_failed, mut is_in_doubt) = (false, false);
    while !tell.is_closed() {
        match look() {
            Ok(all) => {
                has_failed = false;
                let usable = Usable::of(chosen, &all);
                // Whether another host has an address is known within seconds.
                is_in_doubt = !usable.in_doubt.is_empty();
                tell.send_if_modified(|known| {
                    let is_new = *known != usable;
                    *known = usable;
                    is_new
                });
            }
            Err(error) if !has_failed => {
                has_failed = true;
                crate::log::warn!(
                    %error,
                    remedy = %remedy(Wanted::Descriptor, &error),
                    "NDL cannot see this host's interfaces; what was known of them holds, and it looks again each second. \
                     Where that goes on, choose interfaces by their addresses in `ndl.interface`"
                );
            }
            Err(_) => {}
        }
        thread::sleep(LOOK_GAP);
        changes.wait(tell, has_failed || is_in_doubt);
    }
}

/// All addresses of this host.
fn look() -> io::Result<Vec<Local>> {
    let all = if_addrs::get_if_addrs()?.into_iter().take(INTERFACES_MAX);
    let all: Vec<_> = all.collect();
    let flags = if all.iter().any(|of| of.ip().is_ipv6()) { flags::look() } else { BTreeMap::new() };
    let local = |of: if_addrs::Interface| {
        let (is_running, ip) = (of.is_oper_up(), of.ip());
        let interface = of.index.filter(|_| ip.is_ipv6());
        // Without its interface's number it can be neither reached nor asked.
        if ip.is_ipv6() && interface.is_none() {
            return None;
        }
        let address = LocalAddress { ip, interface: interface.unwrap_or(0) };
        let flags = flags.get(&address).copied().unwrap_or_default();
        Some(Local { name: of.name, address, is_running, flags })
    };
    Ok(all.into_iter().filter_map(local).collect())
}

#[cfg(target_os = "linux")]
mod changes {
    use std::{io, os::fd::OwnedFd};

    use rustix::net::{
        AddressFamily, RecvFlags, SocketFlags, SocketType, bind, netlink::SocketAddrNetlink, recv,
        socket_with,
    };
    use tokio::sync::watch;

    use super::{LOOK_AGAIN, Usable};

    /// `RTMGRP_LINK | RTMGRP_IPV4_IFADDR | RTMGRP_IPV6_IFADDR`.
    const GROUPS: u32 = 0x111;
    /// What is said is not read further than that it was said.
    const BUFFER_LEN: usize = 4 << 10;

    /// The kernel's word that something has changed; `None` where it says nothing to this process.
    pub(super) struct Changes(Option<OwnedFd>);

    impl Changes {
        pub(super) fn begin() -> Self {
            Self(listen().inspect_err(|error| {
                crate::log::warn!(%error, "the kernel does not say when an interface changes: NDL looks each second");
            }).ok())
        }

        /// Waits until something has changed, or until it is time to look in any case.
        pub(super) fn wait(&mut self, tell: &watch::Sender<Usable>, looks_again: bool) {
            let mut buffer = [0; BUFFER_LEN];
            while !tell.is_closed() {
                let Some(socket) = &self.0 else { return std::thread::sleep(LOOK_AGAIN) };
                match recv(socket, &mut buffer[..], RecvFlags::empty()) {
                    Err(rustix::io::Errno::AGAIN) if !looks_again => {}
                    Err(rustix::io::Errno::INTR) => {}
                    Err(rustix::io::Errno::AGAIN) => return,
                    // More was said than there was room for, or it was read: that something has changed is known.
                    Ok(_) | Err(rustix::io::Errno::NOBUFS) => return self.drain(&mut buffer),
                    Err(error) => {
                        crate::log::warn!(%error, "the kernel does not say any more when an interface changes: NDL looks each second");
                        self.0 = None;
                    }
                }
            }
        }

        /// One look answers all that was said before it.
        fn drain(&self, buffer: &mut [u8]) {
            const MOST: usize = 4_096;
            let Some(socket) = &self.0 else { return };
            for _ in 0..MOST {
                if recv(socket, &mut *buffer, RecvFlags::DONTWAIT).is_err() {
                    return;
                }
            }
        }
    }

    fn listen() -> io::Result<OwnedFd> {
        let socket = socket_with(AddressFamily::NETLINK, SocketType::RAW, SocketFlags::CLOEXEC, None)?;
        socket2::SockRef::from(&socket).set_read_timeout(Some(LOOK_AGAIN))?;
        bind(&socket, &SocketAddrNetlink::new(0, GROUPS))?;
        Ok(socket)
    }
}

#[cfg(not(target_os = "linux"))]
mod changes {
    use tokio::sync::watch;

    use super::{LOOK_AGAIN, Usable};

    /// Nobody says when something has changed.
    pub(super) struct Changes;

    impl Changes {
        pub(super) const fn begin() -> Self {
            Self
        }

        pub(super) fn wait(&mut self, _: &watch::Sender<Usable>, _: bool) {
            std::thread::sleep(LOOK_AGAIN);
        }
    }
}

use changes::Changes;

#[cfg(test)]
mod tests;
