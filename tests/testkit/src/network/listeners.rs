//! The network as its owner sees it: listeners, current faults, and counters.

use std::{
    io,
    net::SocketAddr,
    sync::{
        Arc, Mutex,
        atomic::{AtomicU64, Ordering},
    },
    thread::JoinHandle,
};

use sinew::Time;
use sinew_runtime::lock;
use socket2::{Domain, Protocol, Socket, Type};
use tokio::{
    net::{TcpListener, UdpSocket},
    sync::watch,
};

use super::{
    faults::{Cut, Faults, NetworkCommand, Side},
    tcp, udp,
};
use crate::random::SeededRandom;

/// Listen backlog of a listener.
const BACKLOG: i32 = 1_024;

/// A listening address that leads to one side's node.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Listener {
    /// The side that it leads to.
    pub side: Side,
    /// Its address for the other side. Port 0: any free one, see [`FaultyNetwork::address`].
    pub listen: SocketAddr,
    /// Whether it carries datagrams instead of connections.
    pub datagrams: bool,
}

/// Traffic counters.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counts {
    /// Open connections.
    pub open: u64,
    /// Connections established in total.
    pub made: u64,
    /// Connections that were cut.
    pub cut: u64,
    /// Bytes of connections and datagrams forwarded to the left and to the right.
    pub passed: [u64; 2],
    /// Datagrams that were lost.
    pub lost: u64,
    /// Bits that were flipped.
    pub flips: u64,
}

/// The current state of the network, as every connection sees it.
#[derive(Clone, Debug)]
pub(super) struct Conditions {
    /// Indexed by the side that a direction leads to.
    pub(super) faults: [Faults; 2],
    pub(super) refusing: bool,
    /// Connections with a number up to this are cut.
    pub(super) cut_upto: u64,
    pub(super) how: Cut,
}

/// State shared by the owner and the sockets.
#[derive(Debug)]
pub(super) struct Shared {
    pub(super) seed: u64,
    pub(super) targets: Mutex<Vec<Option<SocketAddr>>>,
    pub(super) made: AtomicU64,
    pub(super) open: AtomicU64,
    pub(super) cut: AtomicU64,
    pub(super) passed: [AtomicU64; 2],
    pub(super) lost: AtomicU64,
    pub(super) flips: AtomicU64,
}

impl Shared {
    /// The current destination of the listener.
    pub(super) fn target(&self, listener: usize) -> Option<SocketAddr> {
        lock(&self.targets)[listener]
    }

    /// The random generator for one direction of a connection or a listener.
    pub(super) fn random(&self, number: u64, side: Side) -> SeededRandom {
        SeededRandom::new(self.seed ^ (number << 1 | side.index() as u64).wrapping_mul(0xD6E8_FEB8_6659_FD93))
    }
}

/// A running network. Dropping it ends all its connections.
#[derive(Debug)]
pub struct FaultyNetwork {
    shared: Arc<Shared>,
    conditions: watch::Sender<Conditions>,
    addresses: Vec<SocketAddr>,
    end: Option<watch::Sender<()>>,
    thread: Option<JoinHandle<()>>,
}

impl FaultyNetwork {
    /// Opens the listeners, which have no destination yet. `seed` seeds all random decisions.
    ///
    /// # Errors
    /// The system rejects an address.
    pub fn start(listeners: &[Listener], seed: u64) -> io::Result<Self> {
        let [made, open, cut, lost, flips] = Default::default();
        let targets = Mutex::new(vec![None; listeners.len()]);
        let shared =
            Arc::new(Shared { seed, targets, made, open, cut, passed: Default::default(), lost, flips });
        let faults = [Faults::default(); 2];
        let calm = Conditions { faults, refusing: false, cut_upto: 0, how: Cut::Reset };
        let (conditions, seen) = watch::channel(calm);
        let (end, ends) = watch::channel(());
        let sockets = listeners.iter().map(bind).collect::<io::Result<Vec<_>>>()?;
        let address = |socket: &Socket| {
            Ok(socket.local_addr()?.as_socket().expect("it was bound to an address of this kind"))
        };
        let addresses = sockets.iter().map(address).collect::<io::Result<Vec<_>>>()?;
        let port_of =
            |number: usize| Port { number, listener: listeners[number], address: addresses[number] };
        let ports = sockets.into_iter().enumerate().map(|(number, socket)| (port_of(number), socket));
        let (ports, sees) = (ports.collect::<Vec<_>>(), shared.clone());
        let thread = std::thread::Builder::new().name("network".to_owned()).spawn(move || {
            let reactor = tokio::runtime::Builder::new_current_thread().enable_all().build();
            reactor.expect("a reactor").block_on(serve(ports, sees, seen, ends));
        })?;
        Ok(Self { shared, conditions, addresses, end: Some(end), thread: Some(thread) })
    }

    /// The address of a listener, by its index from 0.
    #[must_use]
    pub fn address(&self, listener: usize) -> SocketAddr {
        self.addresses[listener]
    }

    /// Sets the destination of a listener, for new connections and all datagrams.
    pub fn set_destination(&self, listener: usize, to: SocketAddr) {
        lock(&self.shared.targets)[listener] = Some(to);
    }

    /// Changes the faults of the direction to `side`.
    pub fn change(&self, side: Side, change: impl FnOnce(&mut Faults)) {
        self.conditions.send_modify(|conditions| change(&mut conditions.faults[side.index()]));
    }

    /// Cuts all open connections.
    pub fn cut(&self, how: Cut) {
        let cut_upto = self.shared.made.load(Ordering::Relaxed);
        self.conditions.send_modify(|conditions| (conditions.cut_upto, conditions.how) = (cut_upto, how));
    }

    /// Closes the listeners for connections, or reopens them. Open connections stay.
    pub fn refuse(&self, refusing: bool) {
        self.conditions.send_modify(|conditions| conditions.refusing = refusing);
    }

    /// Ends all faults.
    pub fn heal(&self) {
        self.conditions.send_modify(|conditions| {
            (conditions.faults, conditions.refusing) = ([Faults::default(); 2], false);
        });
    }

    /// Executes a command.
    pub fn execute(&self, command: NetworkCommand) {
        match command {
            NetworkCommand::Cut(how) => self.cut(how),
            NetworkCommand::Refuse(refusing) => self.refuse(refusing),
            NetworkCommand::Heal => self.heal(),
            NetworkCommand::Change(Some(side), change) => self.change(side, |faults| change.apply(faults)),
            NetworkCommand::Change(None, change) => {
                for side in [Side::Left, Side::Right] {
                    self.change(side, |faults| change.apply(faults));
                }
            }
        }
    }

    /// The counters so far.
    #[must_use]
    pub fn counts(&self) -> Counts {
        let Shared { made, open, cut, passed, lost, flips, .. } = &*self.shared;
        let of = |count: &AtomicU64| count.load(Ordering::Relaxed);
        Counts {
            open: of(open),
            made: of(made),
            cut: of(cut),
            passed: [of(&passed[0]), of(&passed[1])],
            lost: of(lost),
            flips: of(flips),
        }
    }
}

impl Drop for FaultyNetwork {
    fn drop(&mut self) {
        drop(self.end.take());
        if let Some(thread) = self.thread.take() {
            // The message of a panic is on the terminal.
            let _ = thread.join();
        }
    }
}

/// A listener as its own task sees it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Port {
    pub(super) number: usize,
    pub(super) listener: Listener,
    /// Its address, with the port that the system chose.
    pub(super) address: SocketAddr,
}

fn bind(listener: &Listener) -> io::Result<Socket> {
    let (kind, protocol) =
        if listener.datagrams { (Type::DGRAM, Protocol::UDP) } else { (Type::STREAM, Protocol::TCP) };
    let socket =
        Socket::new(Domain::for_address(listener.listen), kind.nonblocking().cloexec(), Some(protocol))?;
    if !listener.datagrams {
        socket.set_reuse_address(true)?;
    }
    socket.bind(&listener.listen.into())?;
    if !listener.datagrams {
        socket.listen(BACKLOG)?;
    }
    Ok(socket)
}

/// Listens again at a listener that was closed.
pub(super) fn reopen(port: &Port) -> io::Result<TcpListener> {
    TcpListener::from_std(bind(&Listener { listen: port.address, ..port.listener })?.into())
}

async fn serve(
    ports: Vec<(Port, Socket)>,
    shared: Arc<Shared>,
    conditions: watch::Receiver<Conditions>,
    mut ends: watch::Receiver<()>,
) {
    for (port, socket) in ports {
        let (shared, conditions) = (shared.clone(), conditions.clone());
        if port.listener.datagrams {
            let socket = UdpSocket::from_std(socket.into()).expect("it was bound just now");
            tokio::spawn(udp::serve(port, socket, shared, conditions));
        } else {
            let listener = TcpListener::from_std(socket.into()).expect("it was bound just now");
            tokio::spawn(tcp::serve(port, listener, shared, conditions));
        }
    }
    // An error means that the owner is gone; all tasks end with the reactor.
    while ends.changed().await.is_ok() {}
}

/// Sleeps from `now` until `wake`; forever if that is `None`, until another event wakes the task.
pub(super) async fn sleep_until(wake: Option<Time>, now: Time) {
    match wake {
        Some(at) => tokio::time::sleep(at.since(now)).await,
        None => std::future::pending().await,
    }
}
