//! The network as its owner sees it: doors, what goes wrong now, and counts.

use std::{
    io,
    net::SocketAddr,
    sync::{
        Arc, Mutex, PoisonError,
        atomic::{AtomicU64, Ordering},
    },
    thread::JoinHandle,
};

use sinew::Time;
use socket2::{Domain, Protocol, Socket, Type};
use tokio::{
    net::{TcpListener, UdpSocket},
    sync::watch,
};

use super::{
    faults::{Cut, Faults, Side, Word},
    tcp, udp,
};
use crate::dice::Dice;

/// Connections that are made to a door and wait to be taken at most.
const BACKLOG: i32 = 1_024;

/// Where one side's node is reached.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Door {
    /// Whose node this leads to.
    pub side: Side,
    /// Where it is for the other side. Port 0: any free one, see [`Proxy::address`].
    pub listen: SocketAddr,
    /// Datagrams, or else connections.
    pub datagrams: bool,
}

/// What has passed, and what has not.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counts {
    /// Connections that are open now.
    pub open: u64,
    /// Connections that were made.
    pub made: u64,
    /// Connections that were cut.
    pub cut: u64,
    /// Bytes and datagrams' bytes that passed, to the left and to the right.
    pub passed: [u64; 2],
    /// Datagrams that were lost.
    pub lost: u64,
    /// Bits that were flipped.
    pub flips: u64,
}

/// What happens now, as every connection sees it.
#[derive(Clone, Debug)]
pub(super) struct Weather {
    /// By the side that a way leads to.
    pub(super) faults: [Faults; 2],
    pub(super) refusing: bool,
    /// Connections with a number up to this are cut.
    pub(super) cut_upto: u64,
    pub(super) how: Cut,
}

/// What the owner and the sockets share.
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
    /// Where the door leads now.
    pub(super) fn target(&self, door: usize) -> Option<SocketAddr> {
        self.targets.lock().unwrap_or_else(PoisonError::into_inner)[door]
    }

    /// The chance of one way of a connection or a door.
    pub(super) fn dice(&self, number: u64, side: Side) -> Dice {
        Dice::new(self.seed ^ (number << 1 | side.index() as u64).wrapping_mul(0xD6E8_FEB8_6659_FD93))
    }
}

/// A network that runs. It ends, with all its connections, when this is dropped.
#[derive(Debug)]
pub struct Proxy {
    shared: Arc<Shared>,
    weather: watch::Sender<Weather>,
    addresses: Vec<SocketAddr>,
    end: Option<watch::Sender<()>>,
    thread: Option<JoinHandle<()>>,
}

impl Proxy {
    /// Opens the doors, which lead nowhere yet. All chance comes from `seed`.
    ///
    /// # Errors
    /// What the system says of an address.
    pub fn start(doors: &[Door], seed: u64) -> io::Result<Self> {
        let [made, open, cut, lost, flips] = Default::default();
        let targets = Mutex::new(vec![None; doors.len()]);
        let shared =
            Arc::new(Shared { seed, targets, made, open, cut, passed: Default::default(), lost, flips });
        let faults = [Faults::default(); 2];
        let calm = Weather { faults, refusing: false, cut_upto: 0, how: Cut::Reset };
        let (weather, seen) = watch::channel(calm);
        let (end, ends) = watch::channel(());
        let sockets = doors.iter().map(bind).collect::<io::Result<Vec<_>>>()?;
        let address = |socket: &Socket| {
            Ok(socket.local_addr()?.as_socket().expect("it was bound to an address of this kind"))
        };
        let addresses = sockets.iter().map(address).collect::<io::Result<Vec<_>>>()?;
        let room = |number: usize| Room { number, door: doors[number], address: addresses[number] };
        let rooms = sockets.into_iter().enumerate().map(|(number, socket)| (room(number), socket));
        let (rooms, sees) = (rooms.collect::<Vec<_>>(), shared.clone());
        let thread = std::thread::Builder::new().name("proxy".to_owned()).spawn(move || {
            let reactor = tokio::runtime::Builder::new_current_thread().enable_all().build();
            reactor.expect("a reactor").block_on(serve(rooms, sees, seen, ends));
        })?;
        Ok(Self { shared, weather, addresses, end: Some(end), thread: Some(thread) })
    }

    /// Where a door is, counted from 0.
    #[must_use]
    pub fn address(&self, door: usize) -> SocketAddr {
        self.addresses[door]
    }

    /// A door leads there from now on: new connections, and all datagrams.
    pub fn lead(&self, door: usize, to: SocketAddr) {
        self.shared.targets.lock().unwrap_or_else(PoisonError::into_inner)[door] = Some(to);
    }

    /// Changes what goes wrong on the way to `side`.
    pub fn change(&self, side: Side, change: impl FnOnce(&mut Faults)) {
        self.weather.send_modify(|weather| change(&mut weather.faults[side.index()]));
    }

    /// Cuts all connections that there are.
    pub fn cut(&self, how: Cut) {
        let cut_upto = self.shared.made.load(Ordering::Relaxed);
        self.weather.send_modify(|weather| (weather.cut_upto, weather.how) = (cut_upto, how));
    }

    /// Nobody listens at the doors for connections any more, or again. Those that there are stay.
    pub fn refuse(&self, refusing: bool) {
        self.weather.send_modify(|weather| weather.refusing = refusing);
    }

    /// Nothing goes wrong from now on.
    pub fn heal(&self) {
        self.weather.send_modify(|weather| {
            (weather.faults, weather.refusing) = ([Faults::default(); 2], false);
        });
    }

    /// Does as it is told.
    pub fn obey(&self, word: Word) {
        match word {
            Word::Cut(how) => self.cut(how),
            Word::Refuse(refusing) => self.refuse(refusing),
            Word::Heal => self.heal(),
            Word::Change(Some(side), change) => self.change(side, |faults| change.apply(faults)),
            Word::Change(None, change) => {
                for side in [Side::Left, Side::Right] {
                    self.change(side, |faults| change.apply(faults));
                }
            }
        }
    }

    /// What has passed so far.
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

impl Drop for Proxy {
    fn drop(&mut self) {
        drop(self.end.take());
        if let Some(thread) = self.thread.take() {
            // What it panicked of is on the terminal.
            let _ = thread.join();
        }
    }
}

/// A door as its own task sees it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Room {
    pub(super) number: usize,
    pub(super) door: Door,
    /// Where it is, with the port that the system chose.
    pub(super) address: SocketAddr,
}

fn bind(door: &Door) -> io::Result<Socket> {
    let (kind, protocol) =
        if door.datagrams { (Type::DGRAM, Protocol::UDP) } else { (Type::STREAM, Protocol::TCP) };
    let socket = Socket::new(Domain::for_address(door.listen), kind.nonblocking().cloexec(), Some(protocol))?;
    if !door.datagrams {
        socket.set_reuse_address(true)?;
    }
    socket.bind(&door.listen.into())?;
    if !door.datagrams {
        socket.listen(BACKLOG)?;
    }
    Ok(socket)
}

/// Listens again at a door that was closed.
pub(super) fn reopen(room: &Room) -> io::Result<TcpListener> {
    TcpListener::from_std(bind(&Door { listen: room.address, ..room.door })?.into())
}

async fn serve(
    rooms: Vec<(Room, Socket)>,
    shared: Arc<Shared>,
    weather: watch::Receiver<Weather>,
    mut ends: watch::Receiver<()>,
) {
    for (room, socket) in rooms {
        let (shared, weather) = (shared.clone(), weather.clone());
        if room.door.datagrams {
            let socket = UdpSocket::from_std(socket.into()).expect("it was bound just now");
            tokio::spawn(udp::serve(room, socket, shared, weather));
        } else {
            let listener = TcpListener::from_std(socket.into()).expect("it was bound just now");
            tokio::spawn(tcp::serve(room, listener, shared, weather));
        }
    }
    // An error says that the owner is gone; all tasks end with the reactor.
    while ends.changed().await.is_ok() {}
}

/// From `now` until `wake`; for ever if that is `None`: something else wakes then.
pub(super) async fn sleep_until(wake: Option<Time>, now: Time) {
    match wake {
        Some(at) => tokio::time::sleep(at.since(now)).await,
        None => std::future::pending().await,
    }
}
