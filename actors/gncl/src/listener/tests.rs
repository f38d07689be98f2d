//! Where a node listens, and how connections are accepted: paced, with turns of others, and without descriptors.

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
use sinew_model::accept_limiter::{IN_A_ROW_MAX, PAUSE};

const GIVE_UP: Duration = Duration::from_secs(1);

fn lent(listener: TcpListener) -> SharedSocket<TcpListener> {
    SharedSocket::register(&Arc::new(listener)).unwrap()
}

fn own_limiter() -> Rc<RefCell<AcceptLimiter>> {
    Rc::new(RefCell::new(AcceptLimiter::new(Time::now())))
}

const LOOPBACK: &str = if cfg!(target_os = "linux") { "lo" } else { "lo0" };

#[test]
fn loopback_node_listens_nowhere_else() {
    for (choices, ipv6_too) in
        [(&["::1"][..], false), (&["127.0.0.1", "::1"], true), (&["127.0.0.1"], false), (&[LOOPBACK], true)]
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
fn listen_failure_names_the_address_and_the_shared_port() {
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
    assert!(said.contains("listen at [::1]:7000") && said.contains("does not have this address"), "{said}");
    assert!(!words("10.0.0.7", Errno::MFILE.into()).contains("another node"));
}

#[test]
fn second_node_on_a_port_lacks_ipv6_or_fails() {
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
fn missing_loopback_keeps_no_node_from_starting() {
    for choices in [&[LOOPBACK][..], &["lo/ipv6"], &["127.0.0.1", "::1"], &["::1"]] {
        let mut config = NodeConfig::new("test");
        let chosen: Vec<_> = choices.iter().map(|choice| choice.parse().unwrap()).collect();
        config.ndl.interface = chosen.into();
        // The kernel checks this before it checks whether the host has the address.
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
fn lack_of_descriptors_or_memory_backs_off_without_spinning() {
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
async fn orderly_closed_socket_is_no_fault() {
    let listener = listen(SocketAddr::from(([127, 0, 0, 1], 0))).unwrap();
    let listener = Arc::new(listener);
    let theirs = SharedSocket::register(&listener).unwrap();
    let mut accepted = pin!(accepted(theirs, GIVE_UP, own_limiter()));
    assert!(accepted.next().now_or_never().is_none());
    // As GNCL's store does when the node is stopped.
    SockRef::from(&*listener).shutdown(std::net::Shutdown::Both).unwrap();
    let accepted_late = tokio::time::timeout(Duration::from_millis(100), accepted.next()).await;
    assert!(accepted_late.is_err(), "{accepted_late:?}");
}

#[tokio::test]
async fn pause_follows_each_burst_even_without_a_queue() {
    const ROWS: u32 = 5;
    let listener = listen(SocketAddr::from(([127, 0, 0, 1], 0))).unwrap();
    let address = listener.local_addr().unwrap();
    let mut accepted = pin!(accepted(lent(listener), GIVE_UP, own_limiter()));
    let began = Instant::now();
    for _ in 0..ROWS * IN_A_ROW_MAX {
        // The previous one has been accepted, and is closed.
        let next = async { TcpStream::connect(address).await.unwrap() };
        let (accepted, _dialled) = tokio::join!(accepted.next(), next);
        accepted.expect("it listens").unwrap();
    }
    // A slow machine may add pauses, and removes none.
    assert!(began.elapsed() >= PAUSE * (ROWS - 1), "{:?}", began.elapsed());
}

#[tokio::test]
async fn pause_follows_a_burst_over_several_listeners() {
    const LISTENERS: usize = 5;
    let (limiter, mut streams, mut dialled) = (own_limiter(), Vec::new(), Vec::new());
    for _ in 0..LISTENERS {
        let listener = listen(SocketAddr::from(([127, 0, 0, 1], 0))).unwrap();
        let address = listener.local_addr().unwrap();
        dialled.extend((0..IN_A_ROW_MAX).map(|_| std::net::TcpStream::connect(address).unwrap()));
        streams.push(Box::pin(accepted(lent(listener), GIVE_UP, limiter.clone())));
    }
    let began = Instant::now();
    let all: Vec<_> = stream::select_all(streams).take(dialled.len()).collect().await;
    assert!(all.iter().all(Result::is_ok), "{all:?}");
    // A slow machine may add pauses, and removes none.
    assert!(began.elapsed() >= PAUSE * (LISTENERS as u32 - 1), "{:?}", began.elapsed());
}

#[test]
fn several_listeners_share_one_burst_and_each_gets_some() {
    for listeners in 1..=10_usize {
        let each = backlog_of_one(listeners);
        assert!(each >= 100 && each * listeners as i32 <= BACKLOG, "{listeners}: {each}");
    }
    assert_eq!((backlog_of_one(0), backlog_of_one(usize::MAX)), (BACKLOG, 1));
}

/// Adds a stream for each connection, as the layer's shell does.
struct Shell(Option<SharedSocket<TcpListener>>, SyncSender<u32>, Arc<AtomicU32>);

impl Actor for Shell {
    type Context = Context<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        let listener = self.0.take().unwrap();
        context.add_stream(accepted(listener, GIVE_UP, own_limiter()));
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
fn other_tasks_run_between_two_queued_connections() {
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
fn peer_that_gave_up_delays_no_next_one() {
    let error = io::Error::from(Errno::CONNABORTED);
    assert_eq!(wait_after(&error, BACK_OFF_MAX), Duration::ZERO);
    assert!(!is_starved(&error));
}
