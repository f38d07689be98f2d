//! The accepting socket: it waits when the system has no resources left, and never spins.

use std::{
    cell::RefCell,
    future::poll_fn,
    io,
    net::{Ipv4Addr, Ipv6Addr, SocketAddr, SocketAddrV4, TcpListener},
    rc::Rc,
    task::{Context, Poll, ready},
    time::Duration,
};

use futures_util::{Stream, stream};
use rustix::io::Errno;
use sinew_model::{accept_limiter::AcceptLimiter, config::NodeConfig, refusals::Refusals};
use sinew_runtime::{
    remedy::{Wanted, remedy},
    time::Time,
};
use socket2::{Domain, SockRef, Socket, Type};
use tokio::net::TcpStream;

use super::shared_socket::SharedSocket;

/// Maximum number of connections that wait to be accepted, at all listeners together; the kernel refuses
/// further ones. The connections of 300 nodes that find this one at once wait here, and need not be dialled
/// again a second later.
const BACKLOG: i32 = 1_024;
const BACK_OFF_MIN: Duration = Duration::from_millis(10);
const BACK_OFF_MAX: Duration = Duration::from_millis(100);

/// Listens at the first interface. If one is selected by its name, listens at all present and future
/// addresses of this host. These are IPv4 addresses, or IPv6 addresses if no interface can have IPv4. If all
/// interfaces are loopback, listens only there. The host need not have the address yet: NDL waits for it, and
/// announces it when it is there.
///
/// # Errors
/// The error of the system.
pub(super) fn listen_first(config: &NodeConfig) -> io::Result<TcpListener> {
    listen(first_of(config))
}

fn first_of(config: &NodeConfig) -> SocketAddr {
    let (chosen, port) = (&config.ndl.interface, config.gncl.port);
    if !chosen.have_ipv4() {
        return (all_of_ipv6(config), port).into();
    }
    let first = if chosen.are_loopback() {
        chosen.addresses().next()
    } else {
        chosen.first_address().filter(|_| chosen.are_ipv4_addresses())
    };
    let all = if chosen.are_loopback() { Ipv4Addr::LOCALHOST } else { Ipv4Addr::UNSPECIFIED };
    (first.unwrap_or(all), port).into()
}

/// Returns why this node cannot [listen](listen_first), with the remedy.
pub(super) fn why_not(config: &NodeConfig, error: &io::Error) -> String {
    let address = first_of(config);
    let remedy = if error.kind() == io::ErrorKind::AddrInUse && address.ip().is_unspecified() {
        "another node or program of this host has this port. Where `ndl.interface` chooses by name, or an IPv6 address, GNCL listens at all \
         addresses of the host, so that each node of one host needs a port of its own, though their addresses differ: set `gncl.port` to a free \
         one (0 takes any), or choose by IPv4 addresses alone"
            .into()
    } else {
        remedy(Wanted::Port("gncl.port"), error)
    };
    format!("GNCL cannot listen at {address}: {error}; {remedy}")
}

/// Returns the IPv6 listen address: all addresses, because those of interfaces change. A node that is visible
/// only to its own host uses loopback.
fn all_of_ipv6(config: &NodeConfig) -> Ipv6Addr {
    if config.ndl.interface.are_loopback() { Ipv6Addr::LOCALHOST } else { Ipv6Addr::UNSPECIFIED }
}

/// Listens at an address that this host may not have yet. Connections of a former process may still be closing there.
///
/// # Errors
/// The error of the system.
pub(super) fn listen(address: SocketAddr) -> io::Result<TcpListener> {
    let socket = new_socket(address)?;
    #[cfg(target_os = "linux")]
    if address.is_ipv4() {
        socket.set_freebind_v4(true)?;
    } else if !address.ip().is_unspecified() {
        socket.set_freebind_v6(true)?;
    }
    begin_to_listen(&socket, address)
}

/// Listens at the further addresses of this node. This host may get a missing address later: an interface
/// that is down or has no address does not prevent the start. An address that cannot be used at all is
/// counted, and not announced.
pub(super) fn listen_at_further(config: &NodeConfig, refusals: &Refusals) -> Vec<TcpListener> {
    if !config.ndl.interface.are_ipv4_addresses() {
        return Vec::new();
    }
    let listen_at = |ip: Ipv4Addr| {
        let address = (ip, config.gncl.port).into();
        let noted = |error: &io::Error| {
            refusals.count(
                Time::now(),
                "further address not listened at",
                &format_args!("{address}: {error}"),
            );
        };
        listen(address).inspect_err(noted).ok()
    };
    config.gncl_further().into_iter().filter_map(listen_at).collect()
}

/// Listens at all IPv6 addresses, too, if interfaces may have some beside IPv4. The port is the same if it is
/// free or was configured. A host without IPv6 continues without.
pub(super) fn listen_at_ipv6(config: &NodeConfig, first: SocketAddr) -> Option<TcpListener> {
    if first.is_ipv6() || !config.ndl.interface.have_ipv6() {
        return None;
    }
    // Loopback may not have an IPv6 address yet, or never get one.
    let listen_at = |port| listen((all_of_ipv6(config), port).into());
    let listened = match listen_at(first.port()) {
        Err(error) if config.gncl.port == 0 && error.kind() == io::ErrorKind::AddrInUse => listen_at(0),
        listened => listened,
    };
    let say = |error: &io::Error| {
        if has_no_ipv6(error) {
            // NDL reports this, with the remedy.
            return sinew_runtime::log::debug!(%error, "GNCL does not listen at IPv6 addresses: this host has none");
        }
        sinew_runtime::log::warn!(
            %error,
            port = first.port(),
            "GNCL does not listen at IPv6 addresses: the other nodes reach this one by IPv4 alone. Is another node or program of this host using the \
             port there? Where IPv6 is wanted, set `gncl.port` to one that is free in both families (0 takes any); where it is not, add /ipv4 to \
             names in `ndl.interface`"
        );
    };
    listened.inspect_err(say).ok()
}

/// Whether the kernel has no IPv6, as with `ipv6.disable=1`, or loopback has no IPv6 address.
fn has_no_ipv6(error: &io::Error) -> bool {
    let errno = Errno::from_io_error(error);
    matches!(errno, Some(Errno::AFNOSUPPORT | Errno::PROTONOSUPPORT | Errno::ADDRNOTAVAIL))
}

/// Returns the IPv4 addresses of these listeners.
pub(super) fn addresses_of(listeners: &[TcpListener]) -> Vec<SocketAddrV4> {
    let addresses = listeners.iter().filter_map(|listener| match listener.local_addr() {
        Ok(SocketAddr::V4(address)) => Some(address),
        Ok(SocketAddr::V6(_)) | Err(_) => None,
    });
    addresses.collect()
}

/// Sets each listener's share of the backlog. They share an [`AcceptLimiter`], and all waiting connections are
/// accepted within a second.
///
/// # Errors
/// The error of the system.
pub(super) fn share_backlog(listeners: &[TcpListener]) -> io::Result<()> {
    let backlog = backlog_of_one(listeners.len());
    listeners.iter().try_for_each(|listener| SockRef::from(listener).listen(backlog))
}

fn backlog_of_one(listeners: usize) -> i32 {
    i32::try_from(listeners).map_or(1, |listeners| (BACKLOG / listeners.max(1)).max(1))
}

fn new_socket(address: SocketAddr) -> io::Result<Socket> {
    Socket::new(Domain::for_address(address), Type::STREAM.nonblocking().cloexec(), None)
}

fn begin_to_listen(socket: &Socket, address: SocketAddr) -> io::Result<TcpListener> {
    socket.set_reuse_address(true)?;
    if address.is_ipv6() {
        // An IPv4 listener may use the same port.
        socket.set_only_v6(true)?;
    }
    socket.bind(&address.into())?;
    socket.listen(BACKLOG)?;
    Ok(socket.try_clone()?.into())
}

/// Returns a stream of the connections made to `listener`, and of the errors that delayed it. See
/// [`tune`](super::link::tune). Established links share the thread, and run between two connections. The
/// [`AcceptLimiter`] limits the rate of all listeners together. Excess connections wait in the kernel.
pub(super) fn accepted(
    listener: SharedSocket<TcpListener>,
    give_up: Duration,
    limiter: Rc<RefCell<AcceptLimiter>>,
) -> impl Stream<Item = io::Result<TcpStream>> {
    stream::unfold((listener, Duration::ZERO, limiter), move |(listener, wait, limiter)| async move {
        if wait > Duration::ZERO {
            tokio::time::sleep(wait).await;
        }
        let accepted = loop {
            others_turn().await;
            match poll_fn(|cx| poll_accept(&listener, &limiter, cx)).await {
                Turn::Delayed(delay) => tokio::time::sleep(delay).await,
                Turn::Over(accepted) => break accepted,
            }
        };
        let accepted = accepted.and_then(|socket| {
            super::link::tune(&socket, give_up)?;
            Ok(socket)
        });
        if accepted.is_err() && is_closed(listener.socket()) {
            // The node is being stopped: no further connection is accepted, which is not an error.
            std::future::pending::<()>().await;
        }
        let wait = accepted.as_ref().err().map_or(Duration::ZERO, |error| wait_after(error, wait));
        Some((accepted, (listener, wait, limiter)))
    })
}

/// The result of an attempt to accept a connection.
enum Turn {
    /// The next connection is not due yet.
    Delayed(Duration),
    Over(io::Result<TcpStream>),
}

/// Accepts a connection when it arrives, if the limiter admits it then: another listener may have used up
/// the burst meanwhile.
fn poll_accept(
    listener: &SharedSocket<TcpListener>,
    limiter: &RefCell<AcceptLimiter>,
    cx: &mut Context<'_>,
) -> Poll<Turn> {
    let mut limiter = limiter.borrow_mut();
    if let Some(delay) = limiter.delay(Time::now()) {
        return Poll::Ready(Turn::Delayed(delay));
    }
    let accepted = ready!(listener.poll(cx, TcpListener::accept));
    limiter.on_accept(Time::now());
    let accepted = accepted.and_then(|(socket, _)| {
        socket.set_nonblocking(true)?;
        TcpStream::from_std(socket)
    });
    Poll::Ready(Turn::Over(accepted))
}

/// Waits until other ready tasks of the thread have run. An actor polls its streams repeatedly in one turn
/// while one of them is ready. A single pending result is therefore not enough: a new task of the runtime
/// runs behind the others.
async fn others_turn() {
    // The task always completes, except while the runtime is being shut down.
    let _ = tokio::spawn(async {}).await;
}

/// Whether this socket does not listen any more.
fn is_closed(listener: &TcpListener) -> bool {
    matches!(SockRef::from(listener).is_listener(), Ok(false))
}

/// Whether there were no descriptors left, or no memory.
pub(super) fn is_starved(error: &io::Error) -> bool {
    matches!(Errno::from_io_error(error), Some(Errno::MFILE | Errno::NFILE | Errno::NOBUFS | Errno::NOMEM))
}

/// Returns how long to wait after `error`, after a wait of `before` for the last one.
fn wait_after(error: &io::Error, before: Duration) -> Duration {
    match Errno::from_io_error(error) {
        // The peer gave up before the accept: the next one may succeed.
        Some(Errno::CONNABORTED | Errno::INTR) => Duration::ZERO,
        // No descriptors or no memory: the same call would fail at once again. Unexpected errors are handled
        // the same way.
        Some(_) | None => (before * 2).clamp(BACK_OFF_MIN, BACK_OFF_MAX),
    }
}

#[cfg(test)]
mod tests;
