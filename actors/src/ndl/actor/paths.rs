//! This node's paths: for each of its addresses that it uses a socket for queries and answers, and one in the multicast group beside it.
//!
//! What is chosen by its address stays open from when it could be opened, whatever becomes of its interface; what is chosen by its
//! interface's name, as long as the interface has the address. Nothing here waits.

use std::{
    cell::RefCell,
    collections::BTreeSet,
    future::pending,
    io,
    net::{Ipv4Addr, SocketAddr, SocketAddrV4, UdpSocket},
    rc::Rc,
    time::Duration,
};

use futures_util::{
    FutureExt as _, StreamExt as _,
    future::{AbortHandle, LocalBoxFuture, abortable},
    stream::FuturesUnordered,
};
use tokio::sync::watch;

use super::{Shell, browse, lock, receiving::receive, watch_mdns};
use crate::{
    config::Interfaces,
    ndl::{PATHS_MAX, core::Way, interfaces::Usable, mdns::Mdns, socket},
    stores::{self, Stores},
};

/// Time after which what cannot be opened is tried again, and what is open is made sure to send and hear by its interface.
const RETRY: Duration = Duration::from_secs(1);

/// A task of this layer that ends with it, or before.
type Task = LocalBoxFuture<'static, ()>;

/// One path.
struct Path {
    ip: Ipv4Addr,
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
    said: RefCell<BTreeSet<(Ipv4Addr, &'static str)>>,
}

/// A socket that is to be read.
pub(super) struct Reader {
    socket: UdpSocket,
    from: (SocketAddr, Way),
    ip: Ipv4Addr,
}

impl Paths {
    /// Our addresses.
    pub(super) fn here(&self) -> Vec<SocketAddr> {
        self.open.borrow().iter().map(|path| path.here).collect()
    }

    fn ips(&self) -> Vec<Ipv4Addr> {
        self.open.borrow().iter().map(|path| path.ip).collect()
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

    /// Opens what is `wanted` and is not open, closes what is not wanted. What is to be read from now on; and the first error.
    pub(super) fn open(&self, stores: &Stores, wanted: &[Ipv4Addr]) -> (Vec<Reader>, Option<io::Error>) {
        let (mut readers, mut first_error) = (Vec::new(), None);
        self.close_all_but(stores, wanted);
        for ip in wanted.iter().copied() {
            if !self.ips().contains(&ip) {
                match open(stores, ip) {
                    Ok(path) => {
                        let from = (path.here, Way::Unicast);
                        match path.socket.try_clone() {
                            Ok(socket) => readers.push(Reader { socket, from, ip }),
                            Err(error) => {
                                first_error.get_or_insert(error);
                                continue;
                            }
                        }
                        self.open.borrow_mut().push(path);
                        self.said.borrow_mut().remove(&(ip, UNOPENED));
                    }
                    Err(error) => {
                        first_error.get_or_insert(error);
                    }
                }
            }
            readers.extend(self.join(stores, ip));
        }
        let place = |path: &Path| wanted.iter().position(|ip| *ip == path.ip);
        self.open.borrow_mut().sort_by_key(place);
        (readers, first_error)
    }

    fn close_all_but(&self, stores: &Stores, wanted: &[Ipv4Addr]) {
        self.open.borrow_mut().retain(|path| {
            let is_wanted = wanted.contains(&path.ip);
            if !is_wanted {
                path.readers.iter().for_each(AbortHandle::abort);
                stores::lock(&stores.ndl_sockets).close(path.ip);
                crate::log::info!(udp = %path.here, "NDL does not ask there any more: the address is gone");
            }
            is_wanted
        });
        self.said.borrow_mut().retain(|(ip, _)| wanted.contains(ip));
    }

    /// Joins the group on a path that has not joined it yet.
    fn join(&self, stores: &Stores, ip: Ipv4Addr) -> Option<Reader> {
        let group = stores.config.ndl.multicast?;
        let mut open = self.open.borrow_mut();
        let path = open.iter_mut().find(|path| path.ip == ip && path.group.is_none())?;
        let joined = socket::join_group(group, ip).and_then(|socket| Ok((socket.try_clone()?, socket)));
        match joined {
            Ok((socket, kept)) => {
                path.group = Some(kept);
                self.said.borrow_mut().remove(&(ip, UNJOINED));
                Some(Reader { socket, from: (path.here, Way::Multicast), ip })
            }
            Err(error) => {
                if self.said.borrow_mut().insert((ip, UNJOINED)) {
                    say_unjoined(group, ip, &error);
                }
                None
            }
        }
    }

    /// What is not open, and why, once.
    fn say_unopened(&self, stores: &Stores, wanted: &[Ipv4Addr], error: &io::Error) {
        let port = stores.config.ndl.port;
        for ip in wanted.iter().filter(|ip| !self.ips().contains(ip)) {
            if self.said.borrow_mut().insert((*ip, UNOPENED)) {
                crate::log::warn!(
                    "NDL cannot use UDP {ip}:{port} yet: {error}; it tries again each second. Give this host the address \
                     (`ip address`), leave it out of `ndl.interface`, or set `ndl.port` to a port that is free there"
                );
            }
        }
    }

    /// Sockets whose interface was gone for a while, and has the address again, send and hear by it.
    fn renew(&self, stores: &Stores) {
        for path in self.open.borrow().iter().filter(|path| !path.ip.is_loopback()) {
            socket::renew(&path.socket, path.group.as_ref().zip(stores.config.ndl.multicast), path.ip);
        }
    }

    fn keep(&self, ip: Ipv4Addr, reader: AbortHandle) {
        if let Some(path) = self.open.borrow_mut().iter_mut().find(|path| path.ip == ip) {
            path.readers.push(reader);
        }
    }
}

const UNOPENED: &str = "it cannot be opened";
const UNJOINED: &str = "the group cannot be joined";

fn open(stores: &Stores, ip: Ipv4Addr) -> io::Result<Path> {
    let (ndl, marks) = (&stores.config.ndl, stores.config.gncl.marks);
    let socket = stores::lock(&stores.ndl_sockets).open(ip, ndl.port, marks)?;
    let here = socket.local_addr()?;
    crate::log::info!(udp = %here, "NDL asks and answers");
    Ok(Path { ip, here, socket, group: None, readers: Vec::new() })
}

fn say_unjoined(group: SocketAddrV4, interface: Ipv4Addr, error: &io::Error) {
    crate::log::warn!(
        "NDL does not hear multicast {group} on {interface}: {error}; nodes are found through mDNS and seeds only. \
         Set `ndl.interface` to an interface that is up and `ndl.multicast` to a group, or list `ndl.seeds`",
    );
}

/// Which addresses are used: those that were chosen, and of the other interfaces those that packets get out at, or that are open.
fn wanted(chosen: &Interfaces, usable: &Usable, open: &[Ipv4Addr]) -> Vec<Ipv4Addr> {
    let mut wanted: Vec<_> = chosen.addresses().collect();
    let is_used = |ip: &Ipv4Addr| usable.running.contains(ip) || open.contains(ip);
    for ip in usable.there.iter().copied().filter(is_used) {
        if !wanted.contains(&ip) {
            wanted.push(ip);
        }
    }
    wanted.truncate(PATHS_MAX);
    wanted
}

impl Shell {
    /// Reads a socket, until this instance or its path ends.
    pub(super) fn reading(self: &Rc<Self>, reader: Reader) -> io::Result<Task> {
        let Reader { socket, from, ip } = reader;
        let socket = tokio::net::UdpSocket::from_std(socket)?;
        let (task, handle) = abortable(receive(self.clone(), socket, from));
        self.paths.keep(ip, handle);
        Ok(task.map(drop).boxed_local())
    }

    /// Opens and closes paths as they come and go; `false` when a later instance has taken over.
    fn look_at_paths(self: &Rc<Self>, usable: &Usable, tasks: &FuturesUnordered<Task>) -> bool {
        let (stores, before) = (&self.stores, self.paths.here());
        let wanted = wanted(&stores.config.ndl.interface, usable, &self.paths.ips());
        let (readers, error) = self.paths.open(stores, &wanted);
        if let Some(error) = error {
            self.paths.say_unopened(stores, &wanted, &error);
        }
        for reader in readers {
            match self.reading(reader) {
                Ok(task) => tasks.push(task),
                Err(error) => crate::log::error!("NDL's socket cannot be watched: {error}"),
            }
        }
        self.paths.renew(stores);
        let here = self.paths.here();
        here == before
            || self.feed(|core, now| {
                core.announce_gncl(super::announced(stores, &self.paths.ips()));
                core.use_paths(now, &here);
            })
    }
}

/// mDNS speaks at the first path, for as long as there is that.
#[derive(Default)]
pub(super) struct MdnsAt(Option<(SocketAddr, Vec<AbortHandle>)>);

impl MdnsAt {
    /// Begins, if there is a path and it has not begun there.
    fn look(&mut self, shell: &Rc<Shell>, tasks: &FuturesUnordered<Task>) {
        let here = shell.paths.here();
        if self.0.as_ref().is_some_and(|(at, _)| here.contains(at)) {
            return;
        }
        for task in self.0.take().into_iter().flat_map(|(_, tasks)| tasks) {
            task.abort();
        }
        let Some(at) = here.first().copied() else { return };
        let mdns = shell.start_mdns();
        let handles = mdns.into_iter().flat_map(|mdns| begin_mdns(shell, &mdns, tasks)).collect();
        // Where it does not start, that is said, and tried again only elsewhere.
        self.0 = Some((at, handles));
    }
}

fn begin_mdns(shell: &Rc<Shell>, mdns: &Rc<Mdns>, tasks: &FuturesUnordered<Task>) -> [AbortHandle; 2] {
    let (watched, watching) = abortable(watch_mdns(mdns.clone()));
    let (browsed, browsing) = abortable(browse(shell.clone(), mdns.clone()));
    tasks.push(watched.map(drop).boxed_local());
    tasks.push(browsed.map(drop).boxed_local());
    [watching, browsing]
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
    use super::*;

    const CHOSEN: Ipv4Addr = Ipv4Addr::new(10, 9, 0, 1);
    const NAMED: Ipv4Addr = Ipv4Addr::new(10, 8, 0, 1);

    #[test]
    fn what_is_chosen_by_address_is_always_wanted_and_what_is_open_as_long_as_the_address_is_there() {
        let chosen: Interfaces = vec!["10.9.0.1".parse().unwrap(), "eth0".parse().unwrap()].into();
        let usable = |running: &[Ipv4Addr], there: &[Ipv4Addr]| Usable {
            running: running.into(),
            there: there.into(),
        };
        assert_eq!(wanted(&chosen, &usable(&[], &[]), &[]), [CHOSEN], "also where the host has not got it");
        assert_eq!(wanted(&chosen, &usable(&[NAMED], &[NAMED, CHOSEN]), &[]), [CHOSEN, NAMED]);
        assert_eq!(wanted(&chosen, &usable(&[], &[NAMED]), &[]), [CHOSEN], "no carrier yet");
        assert_eq!(wanted(&chosen, &usable(&[], &[NAMED]), &[NAMED]), [CHOSEN, NAMED], "no carrier any more");
        assert_eq!(wanted(&chosen, &usable(&[], &[]), &[NAMED]), [CHOSEN], "the address is gone");
        let many: Vec<_> = (0..20).map(|last| Ipv4Addr::new(10, 8, 1, last)).collect();
        assert_eq!(wanted(&chosen, &usable(&many, &many), &[]).len(), PATHS_MAX);
    }
}
