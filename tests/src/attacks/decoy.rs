//! The role of the process that is attacked instead of the node. It shows how much of a machine's CPU and
//! kernel time an attack takes from any victim.
//!
//! It runs in the node's place, on the same host, and does only the minimum that any process with an open
//! port must do: it accepts connections at the node's pace and answers TLS handshakes. It closes the oldest
//! connection above the node's limit, and discards the data that it reads. As in a node, one thread accepts
//! connections, and a thread with lower priority does the rest.

use std::{
    collections::VecDeque,
    io::{self, Read as _},
    net::{Ipv4Addr, SocketAddr, UdpSocket},
    path::Path,
    sync::Arc,
    thread,
    time::{Duration, Instant},
};

use rustix::process::{getpriority_process, setpriority_process};
use sinew::security::{
    Credentials, TimePolicy, Tls, UnixTime,
    rustls::{ServerConfig, ServerConnection, time_provider::DefaultTimeProvider},
};
use socket2::{Domain, Socket, Type};
use tokio::{
    io::{AsyncReadExt as _, AsyncWriteExt as _},
    net::{TcpListener, TcpStream},
    runtime::{Builder, Handle},
    task::yield_now,
    time::{sleep, timeout},
};
use tokio_util::task::AbortOnDropHandle;

use super::keys::{self, TestNode};

/// The ports for connections and datagrams.
pub(super) const CONNECTIONS_PORT: u16 = 7_710;
pub(super) const DATAGRAMS_PORT: u16 = 7_711;

/// The limits of a node, so that its attackers have the same pace here. In this order:
///
/// - the listen backlog
/// - connections accepted in a burst
/// - the pause after a burst, in which one more is saved up
/// - the maximum that can be saved up
/// - the maximum number of open connections
/// - the handshake timeout
/// - the priority decrease of the handshake thread
/// - the sustained number of foreign datagrams read without a pause
/// - the pause after these
const BACKLOG: i32 = 1_024;
const AT_ONCE_MAX: u32 = 4;
const REST: Duration = Duration::from_millis(1);
const SAVED_MAX: u32 = 64;
const STRANGERS_MAX: usize = 64;
const HANDSHAKE: Duration = Duration::from_secs(2);
const NICER: i32 = 5;
const DATAGRAMS_AT_ONCE: u32 = 16;
const DATAGRAMS_REST: Duration = Duration::from_millis(1);

/// Maximum length of one read, in bytes.
const READ_LEN: usize = 16 << 10;
/// The first byte of a TLS connection.
const HANDSHAKE_RECORD: u8 = 0x16;

/// `NAME KEYS GROUP`: the name of the node that it replaces, its keys, and its multicast group. Prints `up`
/// when it can be attacked, and exits when its standard input closes.
pub(super) fn run(arguments: &[String]) {
    let [name, keys, group] = arguments else { panic!("a name, keys, and a group, not {arguments:?}") };
    let node =
        [keys::HIP, keys::KNEE].into_iter().find(|node| node.name == name).expect("a node of the robot");
    let group: Ipv4Addr = group.parse().expect("the scenario's group");
    let (tls, listener, datagrams) = (server(node, Path::new(keys)), listen(node), datagrams_to(node, group));
    let reactor = || Builder::new_current_thread().enable_all().build().expect("a reactor");
    let (takes, shakes) = (reactor(), reactor());
    let handshakes = shakes.handle().clone();
    thread::spawn(move || {
        lower_priority();
        shakes.block_on(std::future::pending::<()>());
    });
    thread::spawn(move || takes.block_on(take(listener, Handshakes { tls, runtime: handshakes })));
    thread::spawn(move || swallow(&datagrams));
    println!("up");
    // Only the end of the input is significant.
    io::stdin().lines().map_while(Result::ok).for_each(drop);
}

/// Lowers the priority as a node does for its handshake thread.
fn lower_priority() {
    if let Ok(nice) = getpriority_process(None) {
        // If the system refuses, the priority stays as it is.
        let _ = setpriority_process(None, nice + NICER);
    }
}

fn server(node: TestNode, keys: &Path) -> Arc<ServerConfig> {
    let credentials = Credentials::load(keys, &node.identity(), TimePolicy::default(), UnixTime::now());
    let tls = Tls::new(&credentials.expect("keys that were just made"), Arc::new(DefaultTimeProvider));
    tls.expect("a key that rustls takes").server()
}

fn listen(node: TestNode) -> std::net::TcpListener {
    let socket = Socket::new(Domain::IPV4, Type::STREAM.nonblocking().cloexec(), None).expect("a socket");
    socket.set_reuse_address(true).expect("a socket");
    socket
        .bind(&SocketAddr::from((node.address(), CONNECTIONS_PORT)).into())
        .expect("a port of the host's own");
    socket.listen(BACKLOG).expect("a port that was bound");
    socket.into()
}

fn datagrams_to(node: TestNode, group: Ipv4Addr) -> UdpSocket {
    let socket = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, DATAGRAMS_PORT)).expect("a port of the host's own");
    socket.join_multicast_v4(&group, &node.address()).expect("the host's own interface");
    socket
}

/// The state of a connection on the low-priority thread.
#[derive(Clone)]
struct Handshakes {
    tls: Arc<ServerConfig>,
    runtime: Handle,
}

async fn take(listener: std::net::TcpListener, handshakes: Handshakes) {
    let listener = TcpListener::from_std(listener).expect("a reactor");
    let (mut pace, mut open) = (Pace::new(), VecDeque::<AbortOnDropHandle<()>>::new());
    loop {
        pace.keep().await;
        let accepted = listener.accept().await;
        pace.took_one();
        let Ok((socket, _)) = accepted else {
            // The peer has disconnected, or no file descriptors are left.
            sleep(REST).await;
            continue;
        };
        open.retain(|task| !task.is_finished());
        if open.len() >= STRANGERS_MAX {
            open.pop_front();
        }
        let handshakes = handshakes.clone();
        open.push_back(AbortOnDropHandle::new(tokio::spawn(async move {
            // The result concerns only the attacker.
            let _ = receive(socket, handshakes).await;
        })));
    }
}

/// The pace at which connections are accepted.
struct Pace {
    saved: u32,
    as_of: Instant,
    at_once: u32,
    last: Instant,
}

impl Pace {
    fn new() -> Self {
        let now = Instant::now();
        Self { saved: SAVED_MAX, as_of: now, at_once: 0, last: now }
    }

    /// Returns when the next connection may be accepted.
    async fn keep(&mut self) {
        loop {
            self.pass_time();
            if self.saved > 0 && self.at_once < AT_ONCE_MAX {
                break;
            }
            sleep(REST).await;
        }
        if self.at_once > 0 {
            yield_now().await;
        }
    }

    fn took_one(&mut self) {
        self.pass_time();
        (self.at_once, self.last) = (self.at_once + 1, Instant::now());
        self.saved = self.saved.saturating_sub(1);
    }

    fn pass_time(&mut self) {
        if self.last.elapsed() >= REST {
            self.at_once = 0;
        }
        while self.as_of.elapsed() >= REST {
            self.as_of += REST;
            self.saved = SAVED_MAX.min(self.saved + 1);
        }
    }
}

/// Reads until the peer disconnects or the handshake timeout expires.
async fn receive(mut socket: TcpStream, handshakes: Handshakes) -> io::Result<()> {
    let mut first = [0];
    let came = timeout(HANDSHAKE, socket.peek(&mut first)).await??;
    if came > 0 && first == [HANDSHAKE_RECORD] {
        let (socket, tls) = (socket.into_std()?, handshakes.tls);
        let shaking = handshakes.runtime.spawn(async move { shake(TcpStream::from_std(socket)?, tls).await });
        return AbortOnDropHandle::new(shaking).await.map_err(io::Error::other)?;
    }
    let mut buffer = vec![0; READ_LEN];
    let all = async {
        while socket.read(&mut buffer).await? > 0 {}
        Ok(())
    };
    timeout(HANDSHAKE, all).await?
}

/// Completes the handshake, then keeps reading without a limit.
async fn shake(mut socket: TcpStream, tls: Arc<ServerConfig>) -> io::Result<()> {
    let (mut tls, mut buffer) = (ServerConnection::new(tls).map_err(io::Error::other)?, vec![0; READ_LEN]);
    let shake = async {
        while tls.is_handshaking() {
            step(&mut socket, &mut tls, &mut buffer).await?;
        }
        Ok::<_, io::Error>(())
    };
    timeout(HANDSHAKE, shake).await??;
    loop {
        step(&mut socket, &mut tls, &mut buffer).await?;
    }
}

/// Reads the next bytes, answers them as TLS requires, and discards the content. Like a node's handshake
/// thread, it yields to other threads afterwards.
async fn step(socket: &mut TcpStream, tls: &mut ServerConnection, buffer: &mut [u8]) -> io::Result<()> {
    let count = socket.read(buffer).await?;
    if count == 0 {
        return Err(io::ErrorKind::UnexpectedEof.into());
    }
    let (mut bytes, mut fault) = (&buffer[..count], None);
    while !bytes.is_empty() && fault.is_none() {
        tls.read_tls(&mut bytes)?;
        fault = tls.process_new_packets().err();
        let mut plaintext = [0; 4_096];
        while tls.reader().read(&mut plaintext).is_ok_and(|count| count > 0) {}
    }
    let mut answer = Vec::new();
    while tls.wants_write() {
        tls.write_tls(&mut answer)?;
    }
    socket.write_all(&answer).await?;
    thread::yield_now();
    fault.map_or(Ok(()), |fault| Err(io::Error::other(fault)))
}

/// Reads datagrams, and pauses as a node's discovery thread does.
fn swallow(datagrams: &UdpSocket) {
    let mut buffer = [0; 2_048];
    loop {
        for _ in 0..DATAGRAMS_AT_ONCE {
            // An error about an earlier datagram is ignored.
            let _ = datagrams.recv(&mut buffer);
        }
        thread::sleep(DATAGRAMS_REST);
    }
}
