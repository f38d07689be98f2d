//! This node's paths: for each of its addresses that it uses a socket for queries and answers, and one in the multicast group beside it.
//!
//! What is chosen by its address stays open from when it could be opened, whatever becomes of its interface; what is chosen by its
//! interface's name, as long as the interface has the address. Nothing here waits.

use std::{
    cell::{Cell, RefCell},
    collections::{BTreeMap, BTreeSet},
    future::pending,
    io,
    net::{SocketAddr, UdpSocket},
    rc::Rc,
    time::Duration,
};

use futures_util::{
    FutureExt as _, StreamExt as _,
    future::{AbortHandle, LocalBoxFuture, abortable},
    stream::FuturesUnordered,
};
use sinew_runtime::{
    remedy::{Wanted, remedy},
    time::Time,
};
use tokio::sync::watch;

use super::{Shell, lock, receiving::receive, speaking::speak_mdns};
use crate::{
    config::Interfaces,
    ndl::{
        PATHS_MAX,
        address::LocalAddress,
        core::Way,
        interfaces::{Flags, Usable},
        socket,
    },
    stores::{self, Stores},
};

/// Time after which what cannot be opened is tried again, and what is open is made sure to send and hear by its interface.
const RETRY: Duration = Duration::from_secs(1);
/// Time between two warnings of the same address that is not there.
const REMINDER: Duration = Duration::from_secs(60);

/// A task of this layer that ends with it, or before.
type Task = LocalBoxFuture<'static, ()>;

/// One path.
struct Path {
    local: LocalAddress,
    here: SocketAddr,
    /// Sends at once, whatever the runtime knows of the socket.
    socket: UdpSocket,
    group: Option<UdpSocket>,
    /// Ends those that read.
    readers: Vec<AbortHandle>,
}

/// Those that are open, the one that is preferred first, and what has been said of those that are not.
#[derive(Default)]
pub(super) struct Paths {
    open: RefCell<Vec<Path>>,
    said: RefCell<BTreeSet<(LocalAddress, &'static str)>>,
    /// When it is said next that an address cannot be opened, as long as that is so.
    unopened: RefCell<BTreeMap<LocalAddress, Time>>,
    has_said_no_ipv6: Cell<bool>,
    /// Whether addresses were looked for before: what is opened later came later.
    has_begun: Cell<bool>,
    /// When it is said next that there is no address at all.
    none_next: Cell<Time>,
}

/// A socket that is to be read.
pub(super) struct Reader {
    socket: UdpSocket,
    from: (SocketAddr, Way),
    local: LocalAddress,
}

impl Paths {
    /// Our addresses.
    pub(super) fn here(&self) -> Vec<SocketAddr> {
        self.open.borrow().iter().map(|path| path.here).collect()
    }

    fn locals(&self) -> Vec<LocalAddress> {
        self.open.borrow().iter().map(|path| path.local).collect()
    }

    /// Sends from one of our addresses.
    ///
    /// # Errors
    /// What the system says; that this address is ours no more.
    pub(super) fn send(&self, from: SocketAddr, bytes: &[u8], to: SocketAddr) -> io::Result<()> {
        let open = self.open.borrow();
        let path = open.iter().find(|path| path.here == from).ok_or(io::ErrorKind::AddrNotAvailable)?;
        socket::send(&path.socket, bytes, to)
    }

    /// Opens what is `wanted` and is not open, closes what is not wanted. What is to be read from now on; and what is not open, and why.
    pub(super) fn open(
        &self,
        stores: &Stores,
        wanted: &[LocalAddress],
    ) -> (Vec<Reader>, Vec<(LocalAddress, io::Error)>) {
        let (mut readers, mut unopened) = (Vec::new(), Vec::new());
        self.close_all_but(stores, wanted);
        self.unopened.borrow_mut().retain(|local, _| wanted.contains(local));
        for local in wanted.iter().copied() {
            if !self.locals().contains(&local) {
                match open(stores, local) {
                    Ok(path) => {
                        let from = (path.here, Way::Unicast);
                        match path.socket.try_clone() {
                            Ok(socket) => readers.push(Reader { socket, from, local }),
                            Err(error) => {
                                unopened.push((local, error));
                                continue;
                            }
                        }
                        if self.has_begun.get() {
                            crate::log::info!(udp = %path.here, "NDL sends and receives here now");
                        }
                        self.open.borrow_mut().push(path);
                        self.unopened.borrow_mut().remove(&local);
                    }
                    Err(error) => unopened.push((local, error)),
                }
            }
            readers.extend(self.join(stores, local));
        }
        self.has_begun.set(true);
        let place = |path: &Path| wanted.iter().position(|local| *local == path.local);
        self.open.borrow_mut().sort_by_key(place);
        (readers, unopened)
    }

    fn close_all_but(&self, stores: &Stores, wanted: &[LocalAddress]) {
        self.open.borrow_mut().retain(|path| {
            let is_wanted = wanted.contains(&path.local);
            if !is_wanted {
                path.readers.iter().for_each(AbortHandle::abort);
                stores::lock(&stores.ndl_sockets).close(path.local);
                crate::log::info!(udp = %path.here, "NDL no longer sends and receives here: the address is gone, or its socket of no use");
            }
            is_wanted
        });
        // What is said of those that are not used each clears itself.
        let is_of_unused = |what: &str| [IN_DOUBT, TAKEN, LEFT_OUT].contains(&what);
        self.said.borrow_mut().retain(|(local, what)| is_of_unused(what) || wanted.contains(local));
    }

    /// Joins the group on a path that has not joined it yet.
    fn join(&self, stores: &Stores, local: LocalAddress) -> Option<Reader> {
        let group = stores.config.ndl.groups().of(local.ip)?;
        let mut open = self.open.borrow_mut();
        let path = open.iter_mut().find(|path| path.local == local && path.group.is_none())?;
        let joined = socket::join_group(group, local).and_then(|socket| Ok((socket.try_clone()?, socket)));
        match joined {
            Ok((socket, kept)) => {
                path.group = Some(kept);
                self.said.borrow_mut().remove(&(local, UNJOINED));
                Some(Reader { socket, from: (path.here, Way::Multicast), local })
            }
            Err(error) => {
                if self.said.borrow_mut().insert((local, UNJOINED)) {
                    say_unjoined(group, local, &error);
                }
                None
            }
        }
    }

    /// Warns of each address that is not open, with the reason: at once, and each minute as long as that is so.
    fn say_unopened(&self, now: Time, port: u16, unopened: &[(LocalAddress, io::Error)]) {
        for (local, error) in unopened {
            let next = self.unopened.borrow().get(local).copied();
            if next.is_some_and(|next| now < next) {
                continue;
            }
            self.unopened.borrow_mut().insert(*local, now + REMINDER);
            let (at, remedy) = (local.at(port), remedy(Wanted::Port("ndl.port"), error));
            crate::log::warn!(
                "NDL cannot use UDP {at} yet: {error}; it tries again each second, and warns each minute until then: {remedy}, or leave it \
                 out of `ndl.interface`"
            );
        }
    }

    /// For what there is no room, once as long as that is so.
    fn say_left_out(&self, left_out: &[LocalAddress]) {
        let mut said = self.said.borrow_mut();
        said.retain(|(local, what)| *what != LEFT_OUT || left_out.contains(local));
        for local in left_out {
            if said.insert((*local, LEFT_OUT)) {
                crate::log::warn!(
                    %local,
                    "NDL does not use this address: it uses {PATHS_MAX} at most, and this host has more; name those in `ndl.interface` over which \
                     other nodes are"
                );
            }
        }
    }

    /// Sockets whose interface was gone for a while, and has the address again, send and hear by it.
    fn renew(&self, stores: &Stores) {
        for path in self.open.borrow().iter().filter(|path| !path.local.ip.is_loopback()) {
            let group = stores.config.ndl.groups().of(path.local.ip);
            socket::renew(&path.socket, path.group.as_ref().zip(group), path.local);
        }
    }

    fn keep(&self, local: LocalAddress, reader: AbortHandle) {
        if let Some(path) = self.open.borrow_mut().iter_mut().find(|path| path.local == local) {
            path.readers.push(reader);
        }
    }

    /// Why an IPv6 address that was chosen is not used, and that there are none at all; each once.
    fn say_what_is_missing(&self, now: Time, stores: &Stores, usable: &Usable) {
        for (local, flags) in &usable.in_doubt {
            let is_open = self.locals().contains(local);
            // Whoever was told that an address is asked for is told again if another host has it.
            let what = if flags.is_duplicate { TAKEN } else { IN_DOUBT };
            if !is_open && self.said.borrow_mut().insert((*local, what)) {
                say_in_doubt(*local, *flags);
            }
        }
        self.said.borrow_mut().retain(|(local, what)| {
            ![IN_DOUBT, TAKEN].contains(what) || usable.in_doubt.iter().any(|(known, _)| known == local)
        });
        let interfaces = &stores.config.ndl.interface;
        let has_none = usable.is_known && wanted_later(interfaces, usable) && self.here().is_empty();
        if has_none && self.none_next.get() <= now {
            self.none_next.set(now + REMINDER);
            crate::log::warn!(
                %interfaces,
                "NDL has no address yet: no interface of this host that is up has what `ndl.interface` chooses. It begins when there is one, and warns each minute \
                 until then: give the host the address (`ip address`), or choose another interface"
            );
        }
        if usable.is_known
            && !usable.has_ipv6
            && interfaces.have_ipv6()
            && !self.has_said_no_ipv6.replace(true)
        {
            crate::log::warn!(
                %interfaces,
                "this host has no IPv6: NDL goes on with IPv4, and takes IPv6 addresses when there are any. Where they are wanted, look at \
                 `sysctl net.ipv6.conf.all.disable_ipv6` and at `ipv6.disable` of the kernel's command line; where they are not, add /ipv4 \
                 to names in `ndl.interface`"
            );
        }
    }
}

const IN_DOUBT: &str = "another host may have it";
const TAKEN: &str = "another host has it";
const LEFT_OUT: &str = "there are too many";
const UNJOINED: &str = "the group cannot be joined";

fn open(stores: &Stores, local: LocalAddress) -> io::Result<Path> {
    let (ndl, marks) = (&stores.config.ndl, stores.config.gncl.marks);
    let socket = stores::lock(&stores.ndl_sockets).open(local, ndl.port, marks)?;
    let here = socket.local_addr()?;
    crate::log::debug!(udp = %here, "NDL sends and receives here");
    Ok(Path { local, here, socket, group: None, readers: Vec::new() })
}

fn say_in_doubt(local: LocalAddress, flags: Flags) {
    if flags.is_duplicate {
        crate::log::error!(
            %local,
            "NDL does not use this address: another host on the link has it (duplicate address detection). Take it away from one of the two \
             (`sudo ip -6 address del`), and give it another one"
        );
    } else {
        crate::log::debug!(%local, "NDL uses this address as soon as the kernel knows that no other host on the link has it");
    }
}

fn say_unjoined(group: SocketAddr, interface: LocalAddress, error: &io::Error) {
    crate::log::warn!(
        "NDL does not hear multicast {group} on {interface}: {error}; nodes are found through mDNS and seeds only. \
         Set `ndl.interface` to an interface that is up and `{}` to a group, or list `ndl.seeds`",
        if group.is_ipv4() { "ndl.multicast" } else { "ndl.multicast6" },
    );
}

/// Whether there is nothing that could be used, now or as soon as it is known to be this host's alone.
fn wanted_later(chosen: &Interfaces, usable: &Usable) -> bool {
    usable.running.is_empty() && usable.in_doubt.is_empty() && chosen.addresses().next().is_none()
}

/// Which addresses are used: those that were chosen, and of the other interfaces those that packets get out at, or that are open.
fn wanted(chosen: &Interfaces, usable: &Usable, open: &[LocalAddress]) -> Vec<LocalAddress> {
    let mut wanted: Vec<_> = chosen.addresses().map(LocalAddress::from).collect();
    let is_used = |local: &LocalAddress| usable.running.contains(local) || open.contains(local);
    // An interface that comes back may ask once more whether it alone has an address: what is open there stays open.
    let asked_again =
        usable.in_doubt.iter().filter(|(_, flags)| !flags.is_duplicate).map(|(local, _)| *local);
    let asked_again = asked_again.filter(|local| open.contains(local));
    for local in usable.there.iter().copied().filter(is_used).chain(asked_again) {
        if !wanted.contains(&local) {
            wanted.push(local);
        }
    }
    wanted
}

/// Takes those out that there is no room for, and returns them. What is `kept` comes first, in that order: what was chosen by its address, and
/// what is open, which leads somewhere perhaps.
fn leave_out(wanted: &mut Vec<LocalAddress>, kept: &[LocalAddress]) -> Vec<LocalAddress> {
    let place = |local: &LocalAddress| kept.iter().position(|other| other == local).unwrap_or(usize::MAX);
    let mut in_turn = wanted.clone();
    in_turn.sort_by_key(place);
    let left_out: Vec<_> = in_turn.into_iter().skip(PATHS_MAX).collect();
    wanted.retain(|local| !left_out.contains(local));
    left_out
}

impl Shell {
    /// Reads a socket, until this instance or its path ends.
    pub(super) fn reading(self: &Rc<Self>, reader: Reader) -> io::Result<Task> {
        let Reader { socket, from, local } = reader;
        let socket = tokio::net::UdpSocket::from_std(socket)?;
        let (task, handle) = abortable(receive(self.clone(), socket, from));
        self.paths.keep(local, handle);
        Ok(task.map(drop).boxed_local())
    }

    /// Opens and closes paths as they come and go; `false` when a later instance has taken over.
    fn look_at_paths(self: &Rc<Self>, usable: &Usable, tasks: &FuturesUnordered<Task>) -> bool {
        let (stores, before) = (&self.stores, self.paths.here());
        let mut wanted = wanted(&stores.config.ndl.interface, usable, &self.paths.locals());
        let chosen = stores.config.ndl.interface.addresses().map(LocalAddress::from);
        let kept: Vec<_> = chosen.chain(self.paths.locals()).collect();
        let left_out = leave_out(&mut wanted, &kept);
        self.paths.say_left_out(&left_out);
        let (readers, unopened) = self.paths.open(stores, &wanted);
        self.paths.say_unopened(Time::now(), stores.config.ndl.port, &unopened);
        let mut watched = self.paths.locals();
        for reader in readers {
            let local = reader.local;
            match self.reading(reader) {
                Ok(task) => tasks.push(task),
                Err(error) => {
                    crate::log::error!(%local, "NDL's socket cannot be watched, and is opened anew at the next look: {error}");
                    watched.retain(|other| *other != local);
                }
            }
        }
        // What nobody reads would be asked from, and every answer lost.
        self.paths.close_all_but(stores, &watched);
        self.paths.renew(stores);
        self.paths.say_what_is_missing(Time::now(), stores, usable);
        let here = self.paths.here();
        let seeds = super::seeds(stores, Some(usable));
        let is_known = {
            let core = lock(stores);
            core.has_seeds(&seeds) && (!usable.is_known || core.has_own(&usable.own))
        };
        (here == before && is_known)
            || self.feed(|core, now| {
                if usable.is_known {
                    core.use_own(&usable.own);
                }
                core.announce_gncl(super::announcing::announced(stores, &here));
                core.use_seeds(now, seeds);
                core.use_paths(now, &here);
            })
    }
}

/// Where mDNS speaks: at every path, for as long as there is that.
#[derive(Default)]
pub(super) struct MdnsAt(BTreeMap<SocketAddr, AbortHandle>);

impl MdnsAt {
    /// Begins where it has not begun, ends where there is no path any more.
    fn look(&mut self, shell: &Rc<Shell>, tasks: &FuturesUnordered<Task>) {
        let here = shell.paths.here();
        self.0.retain(|at, task| {
            let is_there = here.contains(at);
            if !is_there {
                task.abort();
            }
            is_there
        });
        for at in here {
            self.0.entry(at).or_insert_with(|| {
                let (task, handle) = abortable(speak_mdns(shell.clone(), at));
                tasks.push(task.map(drop).boxed_local());
                handle
            });
        }
    }
}

/// Follows the interfaces for as long as this instance is the current one.
pub(super) async fn keep_paths(shell: Rc<Shell>, mut news: Option<watch::Receiver<Usable>>) {
    let (mut tasks, mut mdns) = (FuturesUnordered::new(), MdnsAt::default());
    loop {
        let usable = news.as_mut().map(|news| news.borrow_and_update().clone()).unwrap_or_default();
        if !shell.look_at_paths(&usable, &tasks) || !lock(&shell.stores).is_current(shell.epoch) {
            return;
        }
        mdns.look(&shell, &tasks);
        let retry = tokio::time::sleep(RETRY);
        tokio::pin!(retry);
        loop {
            let changed = async {
                let has_changed = match &mut news {
                    Some(news) => news.changed().await.is_ok(),
                    None => false,
                };
                if !has_changed {
                    pending::<()>().await;
                }
            };
            tokio::select! {
                () = &mut retry => break,
                () = changed => break,
                Some(()) = tasks.next() => {}
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::net::Ipv4Addr;

    use sinew_runtime::tid::Incarnation;

    use super::*;
    use crate::config::NodeConfig;

    fn v4(address: [u8; 4]) -> LocalAddress {
        Ipv4Addr::from(address).into()
    }

    #[test]
    fn what_is_chosen_by_address_is_always_wanted_and_what_is_open_as_long_as_the_address_is_there() {
        let (by_address, named) = (v4([10, 9, 0, 1]), v4([10, 8, 0, 1]));
        let chosen: Interfaces = vec!["10.9.0.1".parse().unwrap(), "eth0".parse().unwrap()].into();
        let usable = |running: &[LocalAddress], there: &[LocalAddress]| Usable {
            running: running.into(),
            there: there.into(),
            ..Usable::default()
        };
        assert_eq!(
            wanted(&chosen, &usable(&[], &[]), &[]),
            [by_address],
            "also where the host has not got it"
        );
        assert_eq!(wanted(&chosen, &usable(&[named], &[named, by_address]), &[]), [by_address, named]);
        assert_eq!(wanted(&chosen, &usable(&[], &[named]), &[]), [by_address], "no carrier yet");
        assert_eq!(
            wanted(&chosen, &usable(&[], &[named]), &[named]),
            [by_address, named],
            "no carrier any more"
        );
        assert_eq!(wanted(&chosen, &usable(&[], &[]), &[named]), [by_address], "the address is gone");
    }

    #[test]
    fn of_more_addresses_than_can_be_used_those_that_are_open_stay_and_the_others_are_said() {
        let many: Vec<_> = (0..20).map(|last| v4([10, 8, 1, last])).collect();
        let mut at_first = many.clone();
        assert_eq!(leave_out(&mut at_first, &[]), many[PATHS_MAX..]);
        assert_eq!(at_first, many[..PATHS_MAX]);
        // When another one comes ahead of those that are open
        let open = &many[1..=PATHS_MAX];
        let mut wanted = many.clone();
        assert!(leave_out(&mut wanted, open).contains(&many[0]));
        assert_eq!(wanted, open);
    }

    #[test]
    fn that_there_is_no_room_for_an_address_is_said_once_as_long_as_it_is_so() {
        let stores = Stores::for_test(NodeConfig::new("test"), Incarnation(1));
        let (paths, local) = (Paths::default(), v4([10, 8, 1, 9]));
        for _ in 0..2 {
            paths.say_left_out(&[local]);
            paths.close_all_but(&stores, &[]);
            assert!(paths.said.borrow().contains(&(local, LEFT_OUT)));
        }
        paths.say_left_out(&[]);
        assert!(paths.said.borrow().is_empty(), "then it is said again the next time");
    }

    #[test]
    fn each_address_that_cannot_be_opened_has_its_own_reason() {
        let taken = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
        let mut config = NodeConfig::new("test");
        config.ndl.port = taken.local_addr().unwrap().port();
        let stores = Stores::for_test(config, Incarnation(1));
        // TEST-NET-1: no host has it.
        let wanted = [v4([127, 0, 0, 1]), v4([192, 0, 2, 1])];
        let (_, unopened) = Paths::default().open(&stores, &wanted);
        let reasons: Vec<_> = unopened.iter().map(|(local, error)| (*local, error.kind())).collect();
        let expected = [io::ErrorKind::AddrInUse, io::ErrorKind::AddrNotAvailable];
        assert_eq!(reasons, wanted.into_iter().zip(expected).collect::<Vec<_>>());
    }

    #[test]
    fn an_open_address_stays_open_while_the_kernel_asks_for_it_again_and_not_when_another_host_has_it() {
        let chosen: Interfaces = vec!["eth0".parse().unwrap()].into();
        let local = LocalAddress { ip: "fe80::1".parse().unwrap(), interface: 2 };
        let usable = |flags| Usable { in_doubt: vec![(local, flags)], ..Usable::default() };
        let asked = Flags { is_tentative: true, ..Flags::default() };
        let taken = Flags { is_duplicate: true, ..Flags::default() };
        assert!(wanted(&chosen, &usable(asked), &[]).is_empty());
        assert_eq!(wanted(&chosen, &usable(asked), &[local]), [local]);
        assert!(wanted(&chosen, &usable(taken), &[local]).is_empty());
    }
}
