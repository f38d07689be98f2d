//! The network paths of this node. Each local address in use has a socket for queries and answers, and one in
//! the multicast group.
//!
//! A path chosen by its address stays open from its first successful opening, also if its interface
//! disappears. A path chosen by the name of its interface stays open as long as the interface has the
//! address. Nothing here blocks.

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
use sinew_model::{address::LocalAddress, config::Interfaces, limits::PATHS_MAX};
use sinew_net::Ipv6Flags;
use sinew_runtime::{
    lock,
    remedy::{Wanted, remedy},
    time::Time,
};
use tokio::sync::watch;

use super::{Shell, lock_core, mdns_presence::keep_mdns, receiving::receive};
use crate::{State, core::Cast, grid::until_next, interfaces::Usable, socket};

/// Maximum time after which a failed opening is retried, and the open sockets are bound to their interfaces again.
const RETRY: Duration = Duration::from_secs(1);
/// Time between two warnings about the same missing address.
const REMINDER: Duration = Duration::from_secs(60);

/// A task of this layer that ends with it or earlier.
type Task = LocalBoxFuture<'static, ()>;

/// A network path.
struct Path {
    local: LocalAddress,
    here: SocketAddr,
    /// The socket is not registered with the runtime for writing, so it sends at once.
    socket: UdpSocket,
    group: Option<UdpSocket>,
    /// Abort handles of the reading tasks.
    readers: Vec<AbortHandle>,
}

/// The open paths, the preferred one first, and the reports made about other addresses.
#[derive(Default)]
pub(super) struct Paths {
    open: RefCell<Vec<Path>>,
    reported: RefCell<BTreeSet<(LocalAddress, &'static str)>>,
    /// Time of the next warning about each address that cannot be opened.
    unopened: RefCell<BTreeMap<LocalAddress, Time>>,
    has_reported_no_ipv6: Cell<bool>,
    /// Whether addresses were searched before. A path opened later is an addition.
    has_begun: Cell<bool>,
    /// Time of the next warning that there is no address at all.
    none_next: Cell<Time>,
}

/// A socket to read from.
pub(super) struct Reader {
    socket: UdpSocket,
    from: (SocketAddr, Cast),
    local: LocalAddress,
}

impl Paths {
    /// Returns the local addresses of the open paths.
    pub(super) fn here(&self) -> Vec<SocketAddr> {
        self.open.borrow().iter().map(|path| path.here).collect()
    }

    fn locals(&self) -> Vec<LocalAddress> {
        self.open.borrow().iter().map(|path| path.local).collect()
    }

    /// Sends from a local address.
    ///
    /// # Errors
    /// Returns the system's error, or that this address is no longer local.
    pub(super) fn send(&self, from: SocketAddr, bytes: &[u8], to: SocketAddr) -> io::Result<()> {
        let open = self.open.borrow();
        let path = open.iter().find(|path| path.here == from).ok_or(io::ErrorKind::AddrNotAvailable)?;
        socket::send(&path.socket, bytes, to)
    }

    /// Opens the `wanted` addresses that are not open, and closes the others. Returns the sockets to read,
    /// and the addresses that are not open with their errors.
    pub(super) fn open(
        &self,
        state: &State,
        wanted: &[LocalAddress],
    ) -> (Vec<Reader>, Vec<(LocalAddress, io::Error)>) {
        let (mut readers, mut unopened) = (Vec::new(), Vec::new());
        self.close_all_but(state, wanted);
        self.unopened.borrow_mut().retain(|local, _| wanted.contains(local));
        for local in wanted.iter().copied() {
            if !self.locals().contains(&local) {
                match open(state, local) {
                    Ok(path) => {
                        let from = (path.here, Cast::Unicast);
                        match path.socket.try_clone() {
                            Ok(socket) => readers.push(Reader { socket, from, local }),
                            Err(error) => {
                                unopened.push((local, error));
                                continue;
                            }
                        }
                        if self.has_begun.get() {
                            sinew_runtime::log::info!(udp = %path.here, "NDL sends and receives here now");
                        }
                        self.open.borrow_mut().push(path);
                        self.unopened.borrow_mut().remove(&local);
                    }
                    Err(error) => unopened.push((local, error)),
                }
            }
            readers.extend(self.join(state, local));
        }
        self.has_begun.set(true);
        let place = |path: &Path| wanted.iter().position(|local| *local == path.local);
        self.open.borrow_mut().sort_by_key(place);
        (readers, unopened)
    }

    fn close_all_but(&self, state: &State, wanted: &[LocalAddress]) {
        self.open.borrow_mut().retain(|path| {
            let is_wanted = wanted.contains(&path.local);
            if !is_wanted {
                path.readers.iter().for_each(AbortHandle::abort);
                lock(&state.sockets).close(path.local);
                sinew_runtime::log::info!(udp = %path.here, "NDL no longer sends and receives here: the address is gone, or its socket of no use");
            }
            is_wanted
        });
        // Reports about unused addresses are cleared by their own functions.
        let is_of_unused = |what: &str| [IN_DOUBT, TAKEN, LEFT_OUT].contains(&what);
        self.reported.borrow_mut().retain(|(local, what)| is_of_unused(what) || wanted.contains(local));
    }

    /// Joins the group on a path that has not joined it yet.
    fn join(&self, state: &State, local: LocalAddress) -> Option<Reader> {
        let group = socket::Groups::from(&state.ctx.config.ndl).of(local.ip)?;
        let mut open = self.open.borrow_mut();
        let path = open.iter_mut().find(|path| path.local == local && path.group.is_none())?;
        let joined = socket::join_group(group, local).and_then(|socket| Ok((socket.try_clone()?, socket)));
        match joined {
            Ok((socket, kept)) => {
                path.group = Some(kept);
                self.reported.borrow_mut().remove(&(local, UNJOINED));
                Some(Reader { socket, from: (path.here, Cast::Multicast), local })
            }
            Err(error) => {
                if self.reported.borrow_mut().insert((local, UNJOINED)) {
                    warn_unjoined(group, local, &error);
                }
                None
            }
        }
    }

    /// Warns of each address that is not open, with the reason: at once, and each minute for as long as that lasts.
    fn warn_unopened(&self, now: Time, port: u16, unopened: &[(LocalAddress, io::Error)]) {
        for (local, error) in unopened {
            let next = self.unopened.borrow().get(local).copied();
            if next.is_some_and(|next| now < next) {
                continue;
            }
            self.unopened.borrow_mut().insert(*local, now + REMINDER);
            let (at, remedy) = (local.at(port), remedy(Wanted::Port("ndl.port"), error));
            sinew_runtime::log::warn!(
                "NDL cannot use UDP {at} yet: {error}; it tries again each second, and warns each minute until then: {remedy}, or leave it \
                 out of `ndl.interface`"
            );
        }
    }

    /// Reports addresses for which there is no room, once for as long as that lasts.
    fn warn_left_out(&self, left_out: &[LocalAddress]) {
        let mut reported = self.reported.borrow_mut();
        reported.retain(|(local, what)| *what != LEFT_OUT || left_out.contains(local));
        for local in left_out {
            if reported.insert((*local, LEFT_OUT)) {
                sinew_runtime::log::warn!(
                    %local,
                    "NDL does not use this address: it uses {PATHS_MAX} at most, and this host has more; name those in `ndl.interface` over which \
                     other nodes are"
                );
            }
        }
    }

    /// Binds sockets to their interface again, if it was gone for a while and has the address again.
    fn renew(&self, state: &State) {
        for path in self.open.borrow().iter().filter(|path| !path.local.ip.is_loopback()) {
            let group = socket::Groups::from(&state.ctx.config.ndl).of(path.local.ip);
            socket::renew(&path.socket, path.group.as_ref().zip(group), path.local);
        }
    }

    fn keep(&self, local: LocalAddress, reader: AbortHandle) {
        if let Some(path) = self.open.borrow_mut().iter_mut().find(|path| path.local == local) {
            path.readers.push(reader);
        }
    }

    /// Reports once each why a chosen IPv6 address is not used, and that there are no IPv6 addresses at all.
    fn report_missing(&self, now: Time, state: &State, usable: &Usable) {
        for (local, flags) in &usable.in_doubt {
            let is_open = self.locals().contains(local);
            // An address in doubt is reported again if another host turns out to have it.
            let what = if flags.is_duplicate { TAKEN } else { IN_DOUBT };
            if !is_open && self.reported.borrow_mut().insert((*local, what)) {
                log_in_doubt(*local, *flags);
            }
        }
        self.reported.borrow_mut().retain(|(local, what)| {
            ![IN_DOUBT, TAKEN].contains(what) || usable.in_doubt.iter().any(|(known, _)| known == local)
        });
        let interfaces = &state.ctx.config.ndl.interface;
        let has_none = usable.is_known && wanted_later(interfaces, usable) && self.here().is_empty();
        if has_none && self.none_next.get() <= now {
            self.none_next.set(now + REMINDER);
            sinew_runtime::log::warn!(
                %interfaces,
                "NDL has no address yet: no interface of this host that is up has what `ndl.interface` chooses. It begins when there is one, and warns each minute \
                 until then: give the host the address (`ip address`), or choose another interface"
            );
        }
        if usable.is_known
            && !usable.has_ipv6
            && interfaces.have_ipv6()
            && !self.has_reported_no_ipv6.replace(true)
        {
            sinew_runtime::log::warn!(
                %interfaces,
                "this host has no IPv6: NDL continues with IPv4, and uses IPv6 addresses as soon as there are any. Where they are wanted, look at \
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

fn open(state: &State, local: LocalAddress) -> io::Result<Path> {
    let (ndl, marks) = (&state.ctx.config.ndl, state.ctx.config.gncl.marks);
    let socket = lock(&state.sockets).open(local, ndl.port, marks)?;
    let here = socket.local_addr()?;
    sinew_runtime::log::debug!(udp = %here, "NDL sends and receives here");
    Ok(Path { local, here, socket, group: None, readers: Vec::new() })
}

fn log_in_doubt(local: LocalAddress, flags: Ipv6Flags) {
    if flags.is_duplicate {
        sinew_runtime::log::error!(
            %local,
            "NDL does not use this address: another host on the link has it (duplicate address detection). Take it away from one of the two \
             (`sudo ip -6 address del`), and give it another one"
        );
    } else {
        sinew_runtime::log::debug!(%local, "NDL uses this address as soon as the kernel knows that no other host on the link has it");
    }
}

fn warn_unjoined(group: SocketAddr, interface: LocalAddress, error: &io::Error) {
    sinew_runtime::log::warn!(
        "NDL does not receive multicast {group} on {interface}: {error}; nodes are found through mDNS and seeds only. \
         Set `ndl.interface` to an interface that is up and `{}` to a group, or list `ndl.seeds`",
        if group.is_ipv4() { "ndl.multicast" } else { "ndl.multicast6" },
    );
}

/// Returns whether no address is usable, now or after its duplicate address detection.
fn wanted_later(chosen: &Interfaces, usable: &Usable) -> bool {
    usable.running.is_empty() && usable.in_doubt.is_empty() && chosen.addresses().next().is_none()
}

/// Returns the addresses to use: those chosen by address, and of the other interfaces those that are running
/// or already open.
fn wanted(chosen: &Interfaces, usable: &Usable, open: &[LocalAddress]) -> Vec<LocalAddress> {
    let mut wanted: Vec<_> = chosen.addresses().map(LocalAddress::from).collect();
    let is_used = |local: &LocalAddress| usable.running.contains(local) || open.contains(local);
    // An interface that returns may repeat duplicate address detection. Its open addresses stay open.
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

/// Removes the addresses for which there is no room, and returns them. The addresses in `kept` have priority,
/// in that order: those chosen by address, and open ones, which may have a working route.
fn leave_out(wanted: &mut Vec<LocalAddress>, kept: &[LocalAddress]) -> Vec<LocalAddress> {
    let place = |local: &LocalAddress| kept.iter().position(|other| other == local).unwrap_or(usize::MAX);
    let mut in_turn = wanted.clone();
    in_turn.sort_by_key(place);
    let left_out: Vec<_> = in_turn.into_iter().skip(PATHS_MAX).collect();
    wanted.retain(|local| !left_out.contains(local));
    left_out
}

impl Shell {
    /// Returns a task that reads a socket until this instance or its path ends.
    pub(super) fn reading(self: &Rc<Self>, reader: Reader) -> io::Result<Task> {
        let Reader { socket, from, local } = reader;
        let socket = tokio::net::UdpSocket::from_std(socket)?;
        let (task, handle) = abortable(receive(self.clone(), socket, from));
        self.paths.keep(local, handle);
        Ok(task.map(drop).boxed_local())
    }

    /// Opens and closes paths as addresses appear and disappear. Returns `false` if a later instance has taken over.
    fn update_paths(self: &Rc<Self>, usable: &Usable, tasks: &FuturesUnordered<Task>) -> bool {
        let (state, before) = (&self.state, self.paths.here());
        let mut wanted = wanted(&state.ctx.config.ndl.interface, usable, &self.paths.locals());
        let chosen = state.ctx.config.ndl.interface.addresses().map(LocalAddress::from);
        let kept: Vec<_> = chosen.chain(self.paths.locals()).collect();
        let left_out = leave_out(&mut wanted, &kept);
        self.paths.warn_left_out(&left_out);
        let (readers, unopened) = self.paths.open(state, &wanted);
        self.paths.warn_unopened(Time::now(), state.ctx.config.ndl.port, &unopened);
        let mut watched = self.paths.locals();
        for reader in readers {
            let local = reader.local;
            match self.reading(reader) {
                Ok(task) => tasks.push(task),
                Err(error) => {
                    sinew_runtime::log::error!(%local, "NDL's socket cannot be watched, and is reopened at the next check: {error}");
                    watched.retain(|other| *other != local);
                }
            }
        }
        // A path without a reader would send queries and lose every answer.
        self.paths.close_all_but(state, &watched);
        self.paths.renew(state);
        self.paths.report_missing(Time::now(), state, usable);
        let here = self.paths.here();
        let seeds = super::seeds(state, Some(usable));
        let is_known = {
            let core = lock_core(state);
            core.has_seeds(&seeds) && (!usable.is_known || core.has_local_addresses(&usable.own))
        };
        (here == before && is_known)
            || self.feed(|core, now| {
                if usable.is_known {
                    core.use_local_addresses(&usable.own);
                    core.use_interface_names(usable.names.clone());
                }
                core.announce_gncl(super::announcing::announced(state, &here));
                core.use_seeds(now, seeds);
                core.use_paths(now, &here);
            })
    }
}

/// The mDNS tasks, one for each path for as long as it exists.
#[derive(Default)]
pub(super) struct MdnsTasks(BTreeMap<SocketAddr, AbortHandle>);

impl MdnsTasks {
    /// Starts missing tasks, and ends those without a path.
    fn update(&mut self, shell: &Rc<Shell>, tasks: &FuturesUnordered<Task>) {
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
                let (task, handle) = abortable(keep_mdns(shell.clone(), at));
                tasks.push(task.map(drop).boxed_local());
                handle
            });
        }
    }
}

/// Follows the interfaces for as long as this instance is the current one.
pub(super) async fn keep_paths(shell: Rc<Shell>, mut news: Option<watch::Receiver<Usable>>) {
    let (mut tasks, mut mdns) = (FuturesUnordered::new(), MdnsTasks::default());
    loop {
        let usable = news.as_mut().map(|news| news.borrow_and_update().clone()).unwrap_or_default();
        if !shell.update_paths(&usable, &tasks) || !lock_core(&shell.state).is_current(shell.epoch) {
            return;
        }
        mdns.update(&shell, &tasks);
        let retry = tokio::time::sleep(until_next(Time::now(), RETRY));
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
mod tests;
