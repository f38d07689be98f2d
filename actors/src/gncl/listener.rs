//! The accepting socket: waits when the system has no more to give, and never spins.

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
use sinew_runtime::{
    remedy::{Wanted, remedy},
    time::Time,
};
use socket2::{Domain, SockRef, Socket, Type};
use tokio::net::TcpStream;

use super::lent::Lent;
use crate::{accept_pace::Pace, config::NodeConfig, refusals::Refusals};

/// Connections that wait to be accepted at most, at all listeners together; the kernel refuses further ones. Those that 300 nodes make who all
/// meet this one at once wait here, and are not made again a second later.
const BACKLOG: i32 = 1_024;
const BACK_OFF_MIN: Duration = Duration::from_millis(10);
const BACK_OFF_MAX: Duration = Duration::from_millis(100);

/// Listens at the first interface; where one is chosen by its name, at all addresses that this host has or will have: of IPv4, and of IPv6
/// only where no interface can have one of IPv4. Where all are of loopback, nowhere else. This host need not have the address yet: NDL waits for
/// it, and announces it when it is there.
///
/// # Errors
/// What the system says.
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

/// Why this node cannot [listen](listen_first), and what to do.
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

/// Where a node listens by IPv6: at all addresses, as those of its interfaces come and go; but at none that other hosts reach where it is to
/// be seen by its own host alone.
fn all_of_ipv6(config: &NodeConfig) -> Ipv6Addr {
    if config.ndl.interface.are_loopback() { Ipv6Addr::LOCALHOST } else { Ipv6Addr::UNSPECIFIED }
}

/// Listens at an address that this host may not have yet; connections of a former process may still be closing there.
///
/// # Errors
/// What the system says.
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

/// Listens at the further addresses of this node. One that this host does not have now it may have later: an interface that is
/// down, or has no address yet, keeps no node from its start. What cannot be listened at in any case is counted, and not announced.
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

/// Listens at all IPv6 addresses, too, where interfaces may have some beside those of IPv4: at the same port, if that is free or was asked for.
/// A host without IPv6 goes on with what it has.
pub(super) fn listen_at_ipv6(config: &NodeConfig, first: SocketAddr) -> Option<TcpListener> {
    if first.is_ipv6() || !config.ndl.interface.have_ipv6() {
        return None;
    }
    // Loopback may have no address of IPv6 yet, or never.
    let listen_at = |port| listen((all_of_ipv6(config), port).into());
    let listened = match listen_at(first.port()) {
        Err(error) if config.gncl.port == 0 && error.kind() == io::ErrorKind::AddrInUse => listen_at(0),
        listened => listened,
    };
    let say = |error: &io::Error| {
        if has_no_ipv6(error) {
            // NDL says so, with what can be done.
            return crate::log::debug!(%error, "GNCL does not listen at IPv6 addresses: this host has none");
        }
        crate::log::warn!(
            %error,
            port = first.port(),
            "GNCL does not listen at IPv6 addresses: the other nodes reach this one by IPv4 alone. Is another node or program of this host using the \
             port there? Where IPv6 is wanted, set `gncl.port` to one that is free in both families (0 takes any); where it is not, add /ipv4 to \
             names in `ndl.interface`"
        );
    };
    listened.inspect_err(say).ok()
}

/// Whether the kernel knows no IPv6, as with `ipv6.disable=1`, or loopback has no address of it.
fn has_no_ipv6(error: &io::Error) -> bool {
    let errno = Errno::from_io_error(error);
    matches!(errno, Some(Errno::AFNOSUPPORT | Errno::PROTONOSUPPORT | Errno::ADDRNOTAVAIL))
}

/// Where these listen by IPv4.
pub(super) fn addresses_of(listeners: &[TcpListener]) -> Vec<SocketAddrV4> {
    let addresses = listeners.iter().filter_map(|listener| match listener.local_addr() {
        Ok(SocketAddr::V4(address)) => Some(address),
        Ok(SocketAddr::V6(_)) | Err(_) => None,
    });
    addresses.collect()
}

/// Each of these has its part of what may wait: they share a [pace](Pace), and all that waits has been accepted a second later.
///
/// # Errors
/// What the system says.
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
        // Beside one of IPv4 at the same port.
        socket.set_only_v6(true)?;
    }
    socket.bind(&address.into())?;
    socket.listen(BACKLOG)?;
    Ok(socket.try_clone()?.into())
}

/// Each connection that is made to `listener`, and each error that made it wait. See [`tune`](super::link::tune). Links that stand share
/// the thread: they have their turn between two connections, it rests at a [pace](Pace) that whoever connects cannot quicken, nor by more than one
/// of the listeners, which share it, and who floods the port waits in the kernel.
pub(super) fn accepted(
    listener: Lent<TcpListener>,
    give_up: Duration,
    pace: Rc<RefCell<Pace>>,
) -> impl Stream<Item = io::Result<TcpStream>> {
    stream::unfold((listener, Duration::ZERO, pace), move |(listener, wait, pace)| async move {
        if wait > Duration::ZERO {
            tokio::time::sleep(wait).await;
        }
        let accepted = loop {
            others_turn().await;
            match poll_fn(|cx| poll_accept(&listener, &pace, cx)).await {
                Turn::Rest(rest) => tokio::time::sleep(rest).await,
                Turn::Over(accepted) => break accepted,
            }
        };
        let accepted = accepted.and_then(|socket| {
            super::link::tune(&socket, give_up)?;
            Ok(socket)
        });
        if accepted.is_err() && is_closed(listener.socket()) {
            // The node is being stopped: nobody comes any more, which is no fault.
            std::future::pending::<()>().await;
        }
        let wait = accepted.as_ref().err().map_or(Duration::ZERO, |error| wait_after(error, wait));
        Some((accepted, (listener, wait, pace)))
    })
}

/// What a listener that may accept one does.
enum Turn {
    /// It is too early.
    Rest(Duration),
    Over(io::Result<TcpStream>),
}

/// Accepts one when it comes, if the pace has one left then: another listener may have had it since this one began to wait.
fn poll_accept(listener: &Lent<TcpListener>, pace: &RefCell<Pace>, cx: &mut Context<'_>) -> Poll<Turn> {
    let mut pace = pace.borrow_mut();
    if let Some(rest) = pace.rest(Time::now()) {
        return Poll::Ready(Turn::Rest(rest));
    }
    let accepted = ready!(listener.poll(cx, TcpListener::accept));
    pace.took_one(Time::now());
    let accepted = accepted.and_then(|(socket, _)| {
        socket.set_nonblocking(true)?;
        TcpStream::from_std(socket)
    });
    Poll::Ready(Turn::Over(accepted))
}

/// Waits until what else is ready on the thread has had its turn. An actor looks at its streams again and again in one turn as long as there is
/// something new, so that it is not enough to say once that nothing is ready: a task that the runtime begins runs behind the others.
async fn others_turn() {
    // It ends in no other way than by running, but where the runtime is being shut down.
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
    use std::{
        pin::pin,
        sync::{
            Arc,
            atomic::{AtomicU32, Ordering},
            mpsc::{SyncSender, sync_channel},
        },
        time::Instant,
    };

    use actix::{Actor, AsyncContext, Context, StreamHandler, System};
    use futures_util::{FutureExt, StreamExt};

    use super::*;
    use crate::accept_pace::{IN_A_ROW_MAX, REST};

    const GIVE_UP: Duration = Duration::from_secs(1);

    fn lent(listener: TcpListener) -> Lent<TcpListener> {
        Lent::of(&Arc::new(listener)).unwrap()
    }

    fn own_pace() -> Rc<RefCell<Pace>> {
        Rc::new(RefCell::new(Pace::new(Time::now())))
    }

    const LOOPBACK: &str = if cfg!(target_os = "linux") { "lo" } else { "lo0" };

    #[test]
    fn a_node_that_is_on_loopback_alone_listens_nowhere_else() {
        for (choices, ipv6_too) in [
            (&["::1"][..], false),
            (&["127.0.0.1", "::1"], true),
            (&["127.0.0.1"], false),
            (&[LOOPBACK], true),
        ] {
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
    fn who_cannot_listen_is_told_where_and_that_nodes_at_all_addresses_need_a_port_each() {
        let words = |interface: &str, error: io::Error| {
            let mut config = NodeConfig::new("test");
            config.ndl.interface = vec![interface.parse().unwrap()].into();
            config.gncl.port = 7_000;
            why_not(&config, &error)
        };
        for (interface, at) in [("eth0", "0.0.0.0:7000"), ("fd00::7", "[::]:7000")] {
            let said = words(interface, Errno::ADDRINUSE.into());
            assert!(said.contains(&format!("listen at {at}: ")), "{said}");
            assert!(said.contains("needs a port of its own") && said.contains("`gncl.port`"), "{said}");
        }
        let said = words("10.0.0.7", Errno::ADDRINUSE.into());
        assert!(said.contains("listen at 10.0.0.7:7000") && !said.contains("of its own"), "{said}");
        let said = words("::1", Errno::ADDRNOTAVAIL.into());
        assert!(
            said.contains("listen at [::1]:7000") && said.contains("does not have this address"),
            "{said}"
        );
        assert!(!words("10.0.0.7", Errno::MFILE.into()).contains("another node"));
    }

    #[test]
    fn of_two_nodes_of_one_host_with_one_port_the_second_has_no_ipv6_or_does_not_start() {
        let config = |choices: &[&str], port: u16| {
            let mut config = NodeConfig::new("test");
            let chosen: Vec<_> = choices.iter().map(|choice| choice.parse().unwrap()).collect();
            config.ndl.interface = chosen.into();
            config.gncl.port = port;
            config
        };
        let Ok(first) = listen_first(&config(&["::1"], 0)) else {
            println!("skipped: this host has no IPv6");
            return;
        };
        let port = first.local_addr().unwrap().port();
        let alone = listen_first(&config(&["::1"], port));
        assert_eq!(alone.unwrap_err().kind(), io::ErrorKind::AddrInUse);
        let both = config(&["127.0.0.1", "::1"], port);
        let ipv4 = listen_first(&both).unwrap();
        assert!(listen_at_ipv6(&both, ipv4.local_addr().unwrap()).is_none());
        assert!(!has_no_ipv6(&io::ErrorKind::AddrInUse.into()));
        assert!(has_no_ipv6(&Errno::AFNOSUPPORT.into()) && has_no_ipv6(&Errno::ADDRNOTAVAIL.into()));
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn loopback_that_is_down_or_has_no_ipv6_keeps_no_node_from_its_start() {
        for choices in [&[LOOPBACK][..], &["lo/ipv6"], &["127.0.0.1", "::1"], &["::1"]] {
            let mut config = NodeConfig::new("test");
            let chosen: Vec<_> = choices.iter().map(|choice| choice.parse().unwrap()).collect();
            config.ndl.interface = chosen.into();
            // The kernel asks this before it looks whether the host has the address.
            let waits = |listener: &TcpListener| match listener.local_addr().unwrap() {
                SocketAddr::V4(_) => SockRef::from(listener).freebind_v4().unwrap(),
                SocketAddr::V6(_) => SockRef::from(listener).freebind_v6().unwrap(),
            };
            let first = match listen_first(&config) {
                Err(error) if has_no_ipv6(&error) && !config.ndl.interface.have_ipv4() => continue,
                listened => listened.unwrap_or_else(|error| panic!("{choices:?}: {error}")),
            };
            let beside = listen_at_ipv6(&config, first.local_addr().unwrap());
            assert!(waits(&first) && beside.is_none_or(|beside| waits(&beside)), "{choices:?}");
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
        let listener = Arc::new(listener);
        let theirs = Lent::of(&listener).unwrap();
        let mut accepted = pin!(accepted(theirs, GIVE_UP, own_pace()));
        assert!(accepted.next().now_or_never().is_none());
        // As GNCL's store does when the node is stopped.
        SockRef::from(&*listener).shutdown(std::net::Shutdown::Both).unwrap();
        let told = tokio::time::timeout(Duration::from_millis(100), accepted.next()).await;
        assert!(told.is_err(), "{told:?}");
    }

    #[tokio::test]
    async fn each_row_of_connections_is_followed_by_a_rest_also_where_none_waits_when_the_next_one_comes() {
        const ROWS: u32 = 5;
        let listener = listen(SocketAddr::from(([127, 0, 0, 1], 0))).unwrap();
        let address = listener.local_addr().unwrap();
        let mut accepted = pin!(accepted(lent(listener), GIVE_UP, own_pace()));
        let began = Instant::now();
        for _ in 0..ROWS * IN_A_ROW_MAX {
            // The one before has been accepted, and is closed.
            let next = async { TcpStream::connect(address).await.unwrap() };
            let (accepted, _dialled) = tokio::join!(accepted.next(), next);
            accepted.expect("it listens").unwrap();
        }
        // A slow machine may make pauses of its own, and takes none away.
        assert!(began.elapsed() >= REST * (ROWS - 1), "{:?}", began.elapsed());
    }

    #[tokio::test]
    async fn a_row_is_followed_by_a_rest_also_where_each_of_its_connections_waits_at_a_listener_of_its_own() {
        const LISTENERS: usize = 5;
        let (pace, mut streams, mut dialled) = (own_pace(), Vec::new(), Vec::new());
        for _ in 0..LISTENERS {
            let listener = listen(SocketAddr::from(([127, 0, 0, 1], 0))).unwrap();
            let address = listener.local_addr().unwrap();
            dialled.extend((0..IN_A_ROW_MAX).map(|_| std::net::TcpStream::connect(address).unwrap()));
            streams.push(Box::pin(accepted(lent(listener), GIVE_UP, pace.clone())));
        }
        let began = Instant::now();
        let all: Vec<_> = stream::select_all(streams).take(dialled.len()).collect().await;
        assert!(all.iter().all(Result::is_ok), "{all:?}");
        // A slow machine may make pauses of its own, and takes none away.
        assert!(began.elapsed() >= REST * (LISTENERS as u32 - 1), "{:?}", began.elapsed());
    }

    #[test]
    fn several_listeners_let_no_more_wait_together_than_one_and_each_of_them_some() {
        for listeners in 1..=10_usize {
            let each = backlog_of_one(listeners);
            assert!(each >= 100 && each * listeners as i32 <= BACKLOG, "{listeners}: {each}");
        }
        assert_eq!((backlog_of_one(0), backlog_of_one(usize::MAX)), (BACKLOG, 1));
    }

    /// Has a stream more for each connection, as the layer's shell has.
    struct Shell(Option<Lent<TcpListener>>, SyncSender<u32>, Arc<AtomicU32>);

    impl Actor for Shell {
        type Context = Context<Self>;

        fn started(&mut self, context: &mut Self::Context) {
            let listener = self.0.take().unwrap();
            context.add_stream(accepted(listener, GIVE_UP, own_pace()));
        }
    }

    impl StreamHandler<io::Result<TcpStream>> for Shell {
        fn handle(&mut self, accepted: io::Result<TcpStream>, context: &mut Self::Context) {
            accepted.unwrap();
            self.1.send(self.2.load(Ordering::Relaxed)).unwrap();
            context.add_stream(stream::pending());
        }
    }

    #[test]
    fn between_two_connections_that_wait_the_others_on_the_thread_have_their_turn() {
        System::new().block_on(async {
            let listener = listen(SocketAddr::from(([127, 0, 0, 1], 0))).unwrap();
            let address = listener.local_addr().unwrap();
            let _dialled: Vec<_> =
                (0..IN_A_ROW_MAX).map(|_| std::net::TcpStream::connect(address).unwrap()).collect();
            let (say, said) = sync_channel(IN_A_ROW_MAX as usize);
            let turns = Arc::new(AtomicU32::new(0));
            let counting = turns.clone();
            let _shell = Shell(Some(lent(listener)), say, turns).start();
            let other = tokio::task::spawn_local(async move {
                loop {
                    counting.fetch_add(1, Ordering::Relaxed);
                    tokio::task::yield_now().await;
                }
            });
            let mut seen = Vec::new();
            while seen.len() < IN_A_ROW_MAX as usize {
                seen.extend(said.try_iter());
                tokio::task::yield_now().await;
            }
            other.abort();
            let have_turns = seen.windows(2).all(|pair| pair[0] < pair[1]);
            assert!(have_turns, "turns of another task before each connection: {seen:?}");
        });
    }

    #[test]
    fn a_peer_that_gave_up_does_not_make_the_next_one_wait() {
        let error = io::Error::from(Errno::CONNABORTED);
        assert_eq!(wait_after(&error, BACK_OFF_MAX), Duration::ZERO);
        assert!(!is_starved(&error));
    }
}
