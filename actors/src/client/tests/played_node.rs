//! A node that takes what the test tells it to take, and no byte more.

use std::{
    io::{Read, Write},
    net::Shutdown,
    os::{
        fd::AsFd,
        unix::net::{UnixListener, UnixStream},
    },
    path::{Path, PathBuf},
    sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel},
    thread::{self, JoinHandle},
    time::Duration,
};

use bytes::BytesMut;
use rustix::{
    event::{PollFd, PollFlags, Timespec, poll},
    net::{RecvFlags, recv},
};
use sinew_runtime::{
    tid::{AppAddress, NodeAddress, Tid},
    time::Time,
    wire::{FrameCodec, Kind, Message, encode_frame},
};
use sinew_shm::{BellKind, Consumer, Producer};
use tokio_util::codec::Decoder;

use crate::{
    client::link::socket,
    lncl::{
        payload::{self, Register, Registered},
        testing::{TestDirectory, WATCHDOG},
    },
    ring::{self, Exchange, RingFrames, Taken},
};

/// Bytes of its ring: messages are longer.
pub(super) const RING_BYTES: u32 = 4_096;
const PAYLOAD_MAX: usize = 4 << 20;
/// Time in which somebody connects, also on a machine that is busy.
const CALLED_WITHIN: Duration = Duration::from_secs(60);

pub(super) struct PlayedNode {
    directory: TestDirectory,
    orders: Option<SyncSender<Order>>,
    came: Receiver<Message>,
    thread: Option<JoinHandle<()>>,
}

enum Order {
    /// To take about so many bytes, if they are there.
    Take(usize),
    /// To take whatever comes, or nothing any more without an order.
    TakeAll(bool),
}

impl PlayedNode {
    /// One that serves a single client.
    pub(super) fn start() -> Self {
        let directory = TestDirectory::new();
        let listener = UnixListener::bind(socket_in(directory.path())).unwrap();
        let (orders, heard) = sync_channel(65_536);
        let (say, came) = sync_channel(65_536);
        let thread = thread::spawn(move || {
            let socket = caller(&listener);
            let (ends, frames) = (greet(&socket), RingFrames::new(PAYLOAD_MAX));
            Played {
                socket,
                ends,
                frames,
                codec: FrameCodec::new(PAYLOAD_MAX),
                buffer: BytesMut::new(),
                say,
            }
            .obey(&heard);
        });
        Self { directory, orders: Some(orders), came, thread: Some(thread) }
    }

    pub(super) fn path(&self) -> PathBuf {
        socket_in(self.directory.path())
    }

    /// An address behind it.
    pub(super) fn somebody() -> Tid {
        Tid::new(NodeAddress::new(9), AppAddress::fixed(9).unwrap())
    }

    pub(super) fn take(&self, bytes: usize) {
        self.order(Order::Take(bytes));
    }

    pub(super) fn take_all(&self) {
        self.order(Order::TakeAll(true));
    }

    /// The same, by and by.
    pub(super) fn take_all_in(&self, time: Duration) {
        let orders = self.orders.clone().expect("it lives");
        thread::spawn(move || {
            thread::sleep(time);
            // An error is the test's end.
            let _ = orders.send(Order::TakeAll(true));
        });
    }

    pub(super) fn take_nothing(&self) {
        self.order(Order::TakeAll(false));
    }

    /// The next message that has come whole, of an application.
    pub(super) fn next(&self) -> Message {
        self.came.recv_timeout(WATCHDOG).expect("waited for a whole message")
    }

    /// Whether one has come whole.
    pub(super) fn next_now(&self) -> Option<Message> {
        self.came.try_recv().ok()
    }

    fn order(&self, order: Order) {
        self.orders.as_ref().expect("it lives").send(order).expect("it listens");
    }
}

impl Drop for PlayedNode {
    fn drop(&mut self) {
        drop(self.orders.take());
        drop(self.thread.take().map(JoinHandle::join));
    }
}

fn socket_in(directory: &Path) -> PathBuf {
    directory.join("played.sock")
}

/// The first that connects and says something. C looks whether anybody listens before it registers, on a connection of its own.
fn caller(listener: &UnixListener) -> UnixStream {
    loop {
        is_readable(listener, "somebody connects");
        let (socket, _) = listener.accept().unwrap();
        is_readable(&socket, "who has connected says something, or hangs up");
        if recv(&socket, &mut [0; 1][..], RecvFlags::PEEK).unwrap().0 > 0 {
            return socket;
        }
    }
}

/// Waits until there is something to be had.
fn is_readable(from: &impl AsFd, what: &str) {
    let within = Timespec::try_from(CALLED_WITHIN).unwrap();
    let there = poll(&mut [PollFd::new(from, PollFlags::IN)], Some(&within)).unwrap();
    assert!(there > 0, "not within {CALLED_WITHIN:?}: {what}");
}

/// Registers whoever has connected.
fn greet(socket: &UnixStream) -> Option<(Producer, Consumer)> {
    let mut codec = FrameCodec::new(PAYLOAD_MAX);
    let mut buffer = BytesMut::new();
    let asked = loop {
        let mut chunk = [0; 4_096];
        let count = { socket }.read(&mut chunk).unwrap();
        assert!(count > 0, "it has gone before it was registered");
        buffer.extend_from_slice(&chunk[..count]);
        if let Some(message) = codec.decode(&mut buffer).unwrap() {
            break message;
        }
    };
    let ring = payload::read::<Register>(&asked.payload).unwrap().ring.then_some(RING_BYTES);
    let (node, app) = (NodeAddress::new(1), AppAddress::fixed(1).unwrap());
    let payload_max = PAYLOAD_MAX as u32;
    let registered = Registered { node, app, node_name: "played".to_owned(), payload_max, ring };
    let lncl = payload::lncl_of(node);
    let answer = payload::frame(Kind::LNCL_REGISTERED, lncl, Tid::new(node, app), &registered);
    let mut bytes = BytesMut::new();
    encode_frame(&answer.header, &answer.payload, &mut bytes);
    { socket }.write_all(&bytes).unwrap();
    socket.set_nonblocking(true).unwrap();
    ring.map(|bytes| exchange(socket, bytes))
}

/// Exchanges offers with the client.
fn exchange(socket: &UnixStream, ring_bytes: u32) -> (Producer, Consumer) {
    let (exchange, offer) = Exchange::prepare(ring::capacity(ring_bytes as usize), BellKind::Futex).unwrap();
    offer.send(socket).unwrap();
    let until = Time::now() + WATCHDOG;
    loop {
        if let Some(theirs) = Exchange::receive(socket).unwrap() {
            let theirs = exchange.accept(theirs).unwrap();
            return exchange.join(theirs);
        }
        assert!(socket::wait(socket, PollFlags::IN, until).unwrap(), "waited for the client's offer");
    }
}

struct Played {
    socket: UnixStream,
    /// Without them it is the socket that carries the frames.
    ends: Option<(Producer, Consumer)>,
    frames: RingFrames,
    codec: FrameCodec,
    buffer: BytesMut,
    say: SyncSender<Message>,
}

impl Played {
    fn obey(mut self, orders: &Receiver<Order>) {
        let mut takes_all = false;
        loop {
            let stall_timeout = if takes_all { Duration::from_millis(1) } else { WATCHDOG };
            match orders.recv_timeout(stall_timeout) {
                Ok(Order::Take(bytes)) => self.take(bytes),
                Ok(Order::TakeAll(all)) => takes_all = all,
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => return,
            }
            if takes_all {
                self.take(usize::MAX);
            }
        }
    }

    /// Takes so many bytes, or what there is of them.
    fn take(&mut self, mut bytes: usize) {
        while bytes > 0 {
            let count = match &mut self.ends {
                Some((_, consumer)) => match self.frames.take(consumer, bytes.min(1)).unwrap() {
                    // A record is at most half the ring.
                    Taken::Some => RING_BYTES as usize / 2,
                    Taken::Nothing => 0,
                },
                None => {
                    let mut chunk = vec![0; bytes.min(32 * 1024)];
                    // An error is that there is nothing, or the end.
                    let count = self.socket.read(&mut chunk).unwrap_or_default();
                    self.buffer.extend_from_slice(&chunk[..count]);
                    count
                }
            };
            self.tell();
            if count == 0 {
                return;
            }
            bytes = bytes.saturating_sub(count);
        }
    }

    fn tell(&mut self) {
        loop {
            let next = match &self.ends {
                Some(_) => self.frames.next().unwrap(),
                None => self.codec.decode(&mut self.buffer).unwrap(),
            };
            match next {
                // An error is that nobody wants to know.
                Some(message) if message.header.kind.is_user() => drop(self.say.send(message)),
                // As a node does: the address is free.
                Some(message) if message.header.kind == Kind::LNCL_UNREGISTER => {
                    self.socket.shutdown(Shutdown::Both).unwrap();
                }
                Some(_) => {}
                None => return,
            }
        }
    }
}
