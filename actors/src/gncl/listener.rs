//! The accepting socket: waits when the system has no more to give, and never spins.

use std::{
    future::poll_fn,
    io,
    net::{Ipv4Addr, Ipv6Addr, SocketAddr, SocketAddrV4},
    time::Duration,
};

use futures_util::{Stream, stream};
use rustix::io::Errno;
use sinew_runtime::time::Time;
use socket2::{Domain, SockRef, Socket, Type};
use tokio::net::{TcpListener, TcpStream};

use crate::{config::NodeConfig, refusals::Refusals};

/// Connections that wait to be accepted at most; the kernel refuses further ones.
const BACKLOG: i32 = 1_024;
/// Connections that are accepted without a pause: each takes some 50 us of the thread, so that no message waits longer for them than for
/// another one of 64 KiB.
const AT_ONCE_MAX: u32 = 4;
/// The pause: 300 nodes that dial all their connections at once are accepted within a third of a second.
const REST: Duration = Duration::from_millis(1);
const BACK_OFF_MIN: Duration = Duration::from_millis(10);
const BACK_OFF_MAX: Duration = Duration::from_millis(100);

/// Listens at `address`; connections of a former process may still be closing there.
///
/// # Errors
/// What the system says.
pub(super) fn listen(address: SocketAddr) -> io::Result<std::net::TcpListener> {
    begin_to_listen(&new_socket(address)?, address)
}

/// Listens at the first interface; where one is chosen by its name, at all addresses that this host has or will have: of IPv4, and of IPv6
/// only where no interface can have one of IPv4. Where all are of loopback, nowhere else.
///
/// # Errors
/// What the system says.
pub(super) fn listen_first(config: &NodeConfig) -> io::Result<std::net::TcpListener> {
    let (chosen, port) = (&config.ndl.interface, config.gncl.port);
    if !chosen.have_ipv4() {
        return listen((all_of_ipv6(config), port).into());
    }
    let first = if chosen.are_loopback() {
        chosen.addresses().next()
    } else {
        chosen.first_address().filter(|_| chosen.are_ipv4_addresses())
    };
    let address = (first.unwrap_or(Ipv4Addr::UNSPECIFIED), port).into();
    if chosen.iter().count() > 1 { listen_also_without(address) } else { listen(address) }
}

/// Where a node listens by IPv6: at all addresses, as those of its interfaces come and go; but at none that other hosts reach where it is to
/// be seen by its own host alone.
fn all_of_ipv6(config: &NodeConfig) -> Ipv6Addr {
    if config.ndl.interface.are_loopback() { Ipv6Addr::LOCALHOST } else { Ipv6Addr::UNSPECIFIED }
}

/// Listens at an address that this host may not have yet.
fn listen_also_without(address: SocketAddr) -> io::Result<std::net::TcpListener> {
    let socket = new_socket(address)?;
    #[cfg(target_os = "linux")]
    socket.set_freebind_v4(true)?;
    begin_to_listen(&socket, address)
}

/// Listens at the further addresses of this node. One that this host does not have now it may have later: an interface that is
/// down, or has no address yet, keeps no node from its start. What cannot be listened at in any case is counted, and not announced.
pub(super) fn listen_at_further(config: &NodeConfig, refusals: &Refusals) -> Vec<std::net::TcpListener> {
    if !config.ndl.interface.are_ipv4_addresses() {
        return Vec::new();
    }
    let listen = |ip: Ipv4Addr| {
        let address = (ip, config.gncl.port).into();
        let noted = |error: &io::Error| {
            refusals.count(
                Time::now(),
                "further address not listened at",
                &format_args!("{address}: {error}"),
            );
        };
        listen_also_without(address).inspect_err(noted).ok()
    };
    config.gncl_further().into_iter().filter_map(listen).collect()
}

/// Listens at all IPv6 addresses, too, where interfaces may have some beside those of IPv4: at the same port, if that is free or was asked for.
/// A host without IPv6 goes on with what it has.
pub(super) fn listen_at_ipv6(config: &NodeConfig, first: SocketAddr) -> Option<std::net::TcpListener> {
    if first.is_ipv6() || !config.ndl.interface.have_ipv6() {
        return None;
    }
    let listen_at = |port| listen((all_of_ipv6(config), port).into());
    let listened = match listen_at(first.port()) {
        Err(error) if config.gncl.port == 0 && error.kind() == io::ErrorKind::AddrInUse => listen_at(0),
        listened => listened,
    };
    let say = |error: &io::Error| {
        crate::log::warn!(
            %error,
            "GNCL does not listen at IPv6 addresses: the other nodes reach this one by IPv4 alone. Where IPv6 is wanted, free the port in `gncl.port`, \
             and see that the kernel has IPv6; where it is not, add /ipv4 to names in `ndl.interface`"
        );
    };
    listened.inspect_err(say).ok()
}

/// Where these listen by IPv4.
pub(super) fn addresses_of(listeners: &[std::net::TcpListener]) -> Vec<SocketAddrV4> {
    let addresses = listeners.iter().filter_map(|listener| match listener.local_addr() {
        Ok(SocketAddr::V4(address)) => Some(address),
        Ok(SocketAddr::V6(_)) | Err(_) => None,
    });
    addresses.collect()
}

fn new_socket(address: SocketAddr) -> io::Result<Socket> {
    Socket::new(Domain::for_address(address), Type::STREAM.nonblocking().cloexec(), None)
}

fn begin_to_listen(socket: &Socket, address: SocketAddr) -> io::Result<std::net::TcpListener> {
    socket.set_reuse_address(true)?;
    if address.is_ipv6() {
        // Beside one of IPv4 at the same port.
        socket.set_only_v6(true)?;
    }
    socket.bind(&address.into())?;
    socket.listen(BACKLOG)?;
    Ok(socket.try_clone()?.into())
}

/// Each connection that is made to `listener`, and each error that made it wait. See [`tune`](super::link::tune). Links that stand share
/// the thread: after [`AT_ONCE_MAX`] connections without a pause it [rests](REST), and whoever floods the port waits in the kernel.
pub(super) fn accepted(
    listener: TcpListener,
    give_up: Duration,
) -> impl Stream<Item = io::Result<TcpStream>> {
    stream::unfold((listener, Duration::ZERO, 0), move |(listener, wait, mut at_once)| async move {
        if wait > Duration::ZERO {
            tokio::time::sleep(wait).await;
        } else if at_once >= AT_ONCE_MAX {
            tokio::time::sleep(REST).await;
            at_once = 0;
        }
        let accepted = poll_fn(|cx| {
            let accepted = listener.poll_accept(cx);
            at_once = if accepted.is_pending() { 0 } else { at_once + 1 };
            accepted
        });
        let accepted = accepted.await.and_then(|(socket, _)| {
            super::link::tune(&socket, give_up)?;
            Ok(socket)
        });
        if accepted.is_err() && is_closed(&listener) {
            // The node is being stopped: nobody comes any more, which is no fault.
            std::future::pending::<()>().await;
        }
        let wait = accepted.as_ref().err().map_or(Duration::ZERO, |error| wait_after(error, wait));
        Some((accepted, (listener, wait, at_once)))
    })
}

/// Whether this socket does not listen any more.
fn is_closed(listener: &TcpListener) -> bool {
    matches!(SockRef::from(listener).is_listener(), Ok(false))
}

/// Whether there were no descriptors left, or no memory.
pub(super) fn is_starved(error: &io::Error) -> bool {
    matches!(Errno::from_io_error(error), Some(Errno::MFILE | Errno::NFILE | Errno::NOBUFS | Errno::NOMEM))
}

/// How long to wait after `error`, having waited `before` after the last one.
fn wait_after(error: &io::Error, before: Duration) -> Duration {
    match Errno::from_io_error(error) {
        // The peer gave up before we took it: the next one may be fine.
        Some(Errno::CONNABORTED | Errno::INTR) => Duration::ZERO,
        // No descriptors or no memory: the same call would fail at once again. Of an error that nobody foresaw nothing
        // better is known.
        Some(_) | None => (before * 2).clamp(BACK_OFF_MIN, BACK_OFF_MAX),
    }
}

#[cfg(test)]
mod tests {
    use std::pin::pin;

    use futures_util::{FutureExt, StreamExt};

    use super::*;

    #[test]
    fn a_node_that_is_on_loopback_alone_listens_nowhere_else() {
        for (choices, ipv6_too) in
            [(&["::1"][..], false), (&["127.0.0.1", "::1"], true), (&["127.0.0.1"], false)]
        {
            let mut config = NodeConfig::new("test");
            let chosen: Vec<_> = choices.iter().map(|choice| choice.parse().unwrap()).collect();
            config.ndl.interface = chosen.into();
            let Ok(first) = listen_first(&config) else {
                println!("skipped: this host has no IPv6");
                return;
            };
            let at = first.local_addr().unwrap();
            let beside = listen_at_ipv6(&config, at).map(|listener| listener.local_addr().unwrap());
            assert!(at.ip().is_loopback(), "{choices:?}: {at}");
            assert!(beside.is_none_or(|at| at.ip().is_loopback()), "{choices:?}: {beside:?}");
            assert_eq!(beside.is_some(), ipv6_too, "{choices:?}");
        }
    }

    #[test]
    fn a_lack_of_descriptors_or_memory_waits_longer_each_time_and_never_spins() {
        for errno in [Errno::MFILE, Errno::NFILE, Errno::NOBUFS, Errno::NOMEM] {
            let error = io::Error::from(errno);
            assert!(is_starved(&error));
            let mut waits = vec![wait_after(&error, Duration::ZERO)];
            for _ in 0..5 {
                waits.push(wait_after(&error, waits[waits.len() - 1]));
            }
            assert_eq!(waits.iter().map(Duration::as_millis).collect::<Vec<_>>(), [10, 20, 40, 80, 100, 100]);
        }
    }

    #[tokio::test]
    async fn a_socket_that_was_closed_in_order_is_no_fault_and_nobody_comes_any_more() {
        let listener = listen(SocketAddr::from(([127, 0, 0, 1], 0))).unwrap();
        let theirs = TcpListener::from_std(listener.try_clone().unwrap()).unwrap();
        let mut accepted = pin!(accepted(theirs, Duration::from_secs(1)));
        assert!(accepted.next().now_or_never().is_none());
        // As GNCL's store does when the node is stopped.
        SockRef::from(&listener).shutdown(std::net::Shutdown::Both).unwrap();
        let told = tokio::time::timeout(Duration::from_millis(100), accepted.next()).await;
        assert!(told.is_err(), "{told:?}");
    }

    #[tokio::test]
    async fn after_some_connections_without_a_pause_the_thread_is_left_to_others_and_all_are_accepted() {
        const DIALLED: u32 = 5 * AT_ONCE_MAX;
        let listener = listen(SocketAddr::from(([127, 0, 0, 1], 0))).unwrap();
        let address = listener.local_addr().unwrap();
        let _dialled: Vec<_> = (0..DIALLED).map(|_| std::net::TcpStream::connect(address).unwrap()).collect();
        let mut accepted = pin!(accepted(TcpListener::from_std(listener).unwrap(), Duration::from_secs(1)));
        let (mut all, mut longest) = (0, 0);
        while all < DIALLED {
            accepted.next().await.expect("it listens").unwrap();
            let mut at_once = 1;
            while let Some(next) = accepted.next().now_or_never() {
                next.expect("it listens").unwrap();
                at_once += 1;
            }
            longest = at_once.max(longest);
            all += at_once;
        }
        assert!(longest <= AT_ONCE_MAX, "{longest} without a pause");
    }

    #[test]
    fn a_peer_that_gave_up_does_not_make_the_next_one_wait() {
        let error = io::Error::from(Errno::CONNABORTED);
        assert_eq!(wait_after(&error, BACK_OFF_MAX), Duration::ZERO);
        assert!(!is_starved(&error));
    }
}
