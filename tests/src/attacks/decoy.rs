//! The role of the one that is attacked instead of the node: what a machine's CPUs and its kernel give to an attack, whoever is attacked.
//!
//! It is in the node's place, a process of the same host, and does no more than nobody can do without who has a port in a network: takes
//! connections at the node's pace, begins TLS with who begins it, closes the oldest one beyond as many as a node lets wait, and throws
//! away what it reads. As in a node, a thread takes connections and a nicer one has the rest.

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

use super::keys::{self, Who};

/// Where it takes connections and datagrams.
pub(super) const CONNECTIONS_PORT: u16 = 7_710;
pub(super) const DATAGRAMS_PORT: u16 = 7_711;

/// As a node's, whose pace its attackers are to have here, too: connections that wait in the kernel, that are taken without a pause, the pause,
/// in which one is saved up, those that are saved up at most, those that may be open, time for a handshake, how much nicer the thread of handshakes
/// is, datagrams that are none of the project's and are read without a pause in the long run, and that pause.
const BACKLOG: i32 = 1_024;
const AT_ONCE_MAX: u32 = 4;
const REST: Duration = Duration::from_millis(1);
const SAVED_MAX: u32 = 64;
const STRANGERS_MAX: usize = 64;
const HANDSHAKE: Duration = Duration::from_secs(2);
const NICER: i32 = 5;
const DATAGRAMS_AT_ONCE: u32 = 16;
const DATAGRAMS_REST: Duration = Duration::from_millis(1);

/// Bytes that are read at once.
const READ_LEN: usize = 16 << 10;
/// The first byte of a connection by TLS.
const HANDSHAKE_RECORD: u8 = 0x16;

/// `NAME KEYS GROUP`: that of the node in whose place it is, its keys, and the group that it hears. Says `up` when it can be attacked, and
/// ends when it is told no more.
pub(super) fn play(arguments: &[String]) {
    let [name, keys, group] = arguments else { panic!("a name, keys, and a group, not {arguments:?}") };
    let who = [keys::HIP, keys::KNEE].into_iter().find(|who| who.name == name).expect("a node of the robot");
    let group: Ipv4Addr = group.parse().expect("the director's group");
    let (tls, listener, datagrams) = (server(who, Path::new(keys)), listen(who), datagrams_to(who, group));
    let reactor = || Builder::new_current_thread().enable_all().build().expect("a reactor");
    let (takes, shakes) = (reactor(), reactor());
    let handshakes = shakes.handle().clone();
    thread::spawn(move || {
        give_way();
        shakes.block_on(std::future::pending::<()>());
    });
    thread::spawn(move || takes.block_on(take(listener, Handshakes { tls, runtime: handshakes })));
    thread::spawn(move || swallow(&datagrams));
    println!("up");
    // Nothing is said to it but that it is over.
    io::stdin().lines().map_while(Result::ok).for_each(drop);
}

/// As nice as a node's thread of handshakes.
fn give_way() {
    if let Ok(nice) = getpriority_process(None) {
        // It goes on as it is where the system refuses it.
        let _ = setpriority_process(None, nice + NICER);
    }
}

fn server(who: Who, keys: &Path) -> Arc<ServerConfig> {
    let credentials = Credentials::load(keys, &who.identity(), TimePolicy::default(), UnixTime::now());
    let tls = Tls::new(&credentials.expect("keys that were just made"), Arc::new(DefaultTimeProvider));
    tls.expect("a key that rustls takes").server()
}

fn listen(who: Who) -> std::net::TcpListener {
    let socket = Socket::new(Domain::IPV4, Type::STREAM.nonblocking().cloexec(), None).expect("a socket");
    socket.set_reuse_address(true).expect("a socket");
    socket
        .bind(&SocketAddr::from((who.address(), CONNECTIONS_PORT)).into())
        .expect("a port of the host's own");
    socket.listen(BACKLOG).expect("a port that was bound");
    socket.into()
}

fn datagrams_to(who: Who, group: Ipv4Addr) -> UdpSocket {
    let socket = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, DATAGRAMS_PORT)).expect("a port of the host's own");
    socket.join_multicast_v4(&group, &who.address()).expect("the host's own interface");
    socket
}

/// What is done on the nicer thread.
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
            // Whoever came has gone, or there are no descriptors left.
            sleep(REST).await;
            continue;
        };
        open.retain(|task| !task.is_finished());
        if open.len() >= STRANGERS_MAX {
            open.pop_front();
        }
        let handshakes = handshakes.clone();
        open.push_back(AbortOnDropHandle::new(tokio::spawn(async move {
            // However it ends, that is the attacker's business.
            let _ = hear(socket, handshakes).await;
        })));
    }
}

/// How fast connections are taken.
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

    /// Returns when the next one may be taken.
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

/// Reads until the other end has enough of it, or the time for a handshake is over.
async fn hear(mut socket: TcpStream, handshakes: Handshakes) -> io::Result<()> {
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

/// Goes on without end with whom it has shaken hands.
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

/// What came next is taken, answered as TLS wants it, and thrown away. Like a node's thread of handshakes, this one goes on if nobody else
/// wants to.
async fn step(socket: &mut TcpStream, tls: &mut ServerConnection, buffer: &mut [u8]) -> io::Result<()> {
    let count = socket.read(buffer).await?;
    if count == 0 {
        return Err(io::ErrorKind::UnexpectedEof.into());
    }
    let (mut bytes, mut fault) = (&buffer[..count], None);
    while !bytes.is_empty() && fault.is_none() {
        tls.read_tls(&mut bytes)?;
        fault = tls.process_new_packets().err();
        let mut said = [0; 4_096];
        while tls.reader().read(&mut said).is_ok_and(|count| count > 0) {}
    }
    let mut answer = Vec::new();
    while tls.wants_write() {
        tls.write_tls(&mut answer)?;
    }
    socket.write_all(&answer).await?;
    thread::yield_now();
    fault.map_or(Ok(()), |fault| Err(io::Error::other(fault)))
}

/// Reads datagrams, and rests as a node's thread of discovery does.
fn swallow(datagrams: &UdpSocket) {
    let mut buffer = [0; 2_048];
    loop {
        for _ in 0..DATAGRAMS_AT_ONCE {
            // What the network has to say of an earlier one is nothing to it.
            let _ = datagrams.recv(&mut buffer);
        }
        thread::sleep(DATAGRAMS_REST);
    }
}
