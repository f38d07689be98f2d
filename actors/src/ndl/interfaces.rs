//! Which addresses the chosen interfaces have now. A thread of its own asks the kernel, when that says that something has changed: the
//! question waits for a lock that whoever configures an interface holds, and NDL's thread waits for nobody.
//!
//! Nobody looks where each interface is chosen by its address.

use std::{io, net::Ipv4Addr, thread, time::Duration};

use if_addrs::IfAddr;
use tokio::sync::watch;

use crate::config::{Interface, Interfaces};

/// Time between two looks, at least: an interface that flaps costs no more.
const LOOK_GAP: Duration = Duration::from_millis(100);
/// Time until it looks again if the kernel says nothing: it says nothing where a look failed, nor to whoever may not listen.
const LOOK_AGAIN: Duration = Duration::from_secs(1);
/// Interfaces that are looked at, at most.
const INTERFACES_MAX: usize = 1_024;

/// An address of this host.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Local {
    /// Of its interface.
    name: String,
    address: Ipv4Addr,
    /// Whether the interface is up and has carrier.
    is_running: bool,
}

/// What is known of the chosen interfaces' addresses.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct Usable {
    /// Packets get out there.
    pub(super) running: Vec<Ipv4Addr>,
    /// The host has these; whether packets get out or not, what is open there stays open.
    pub(super) there: Vec<Ipv4Addr>,
}

impl Usable {
    /// What of `all` is chosen, in the order of the choices.
    fn of(chosen: &Interfaces, all: &[Local]) -> Self {
        let mut usable = Self::default();
        for choice in chosen.iter() {
            let is_chosen = |local: &&Local| match choice {
                Interface::Address(address) => local.address == *address,
                Interface::Name(name) => local.name == *name,
                Interface::All => !local.address.is_loopback(),
            };
            for local in all.iter().filter(is_chosen) {
                if usable.there.contains(&local.address) {
                    continue;
                }
                usable.there.push(local.address);
                if local.is_running {
                    usable.running.push(local.address);
                }
            }
        }
        usable
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
    let mut has_failed = false;
    while !tell.is_closed() {
        match look() {
            Ok(all) => {
                has_failed = false;
                let usable = Usable::of(chosen, &all);
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
                    "NDL cannot see this host's interfaces; what was known of them holds, and it looks again each second. \
                     Where that goes on, raise `ulimit -n`, or choose interfaces by their addresses in `ndl.interface`"
                );
            }
            Err(_) => {}
        }
        thread::sleep(LOOK_GAP);
        changes.wait(tell, has_failed);
    }
}

/// All IPv4 addresses of this host.
fn look() -> io::Result<Vec<Local>> {
    let all = if_addrs::get_if_addrs()?.into_iter().take(INTERFACES_MAX);
    let local = |interface: if_addrs::Interface| {
        let is_running = interface.is_oper_up();
        match interface.addr {
            IfAddr::V4(of) => Some(Local { name: interface.name, address: of.ip, is_running }),
            IfAddr::V6(_) => None,
        }
    };
    Ok(all.filter_map(local).collect())
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

    /// `RTMGRP_LINK | RTMGRP_IPV4_IFADDR`.
    const GROUPS: u32 = 0x11;
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
        pub(super) fn wait(&mut self, tell: &watch::Sender<Usable>, has_failed: bool) {
            let mut buffer = [0; BUFFER_LEN];
            while !tell.is_closed() {
                let Some(socket) = &self.0 else { return std::thread::sleep(LOOK_AGAIN) };
                match recv(socket, &mut buffer[..], RecvFlags::empty()) {
                    Err(rustix::io::Errno::AGAIN) if !has_failed => {}
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
mod tests {
    use super::*;

    fn local(name: &str, address: [u8; 4], is_running: bool) -> Local {
        Local { name: name.to_owned(), address: address.into(), is_running }
    }

    fn chosen(choices: &[&str]) -> Interfaces {
        choices.iter().map(|choice| choice.parse().unwrap()).collect::<Vec<Interface>>().into()
    }

    #[test]
    fn a_choice_takes_what_it_names_in_order_and_once_and_loopback_only_where_it_is_asked_for() {
        let all = [
            local("lo", [127, 0, 0, 1], true),
            local("eth0", [10, 0, 0, 1], true),
            local("eth0", [10, 0, 0, 9], true),
            local("eth1", [10, 1, 0, 1], false),
        ];
        let of = |choices: &[&str]| {
            let usable = Usable::of(&chosen(choices), &all);
            [usable.running, usable.there]
                .map(|addresses| addresses.iter().map(ToString::to_string).collect::<Vec<_>>().join(" "))
        };
        assert_eq!(of(&["all"]), ["10.0.0.1 10.0.0.9", "10.0.0.1 10.0.0.9 10.1.0.1"]);
        assert_eq!(of(&["eth1", "10.0.0.9", "all"]), ["10.0.0.9 10.0.0.1", "10.1.0.1 10.0.0.9 10.0.0.1"]);
        assert_eq!(of(&["lo", "eth7"]), ["127.0.0.1", "127.0.0.1"]);
        assert_eq!(of(&["all", "127.0.0.1"])[0], "10.0.0.1 10.0.0.9 127.0.0.1");
    }

    #[test]
    fn the_loopback_interface_is_seen_and_the_thread_ends_with_its_listener() {
        let mut told = watch(chosen(&["lo"])).expect("a thread");
        let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build().unwrap();
        let seen = runtime.block_on(async {
            let seen = told.wait_for(|usable| usable.running.contains(&Ipv4Addr::LOCALHOST));
            tokio::time::timeout(Duration::from_secs(10), seen).await.expect("lo is seen within 10 s").is_ok()
        });
        assert!(seen);
    }
}
