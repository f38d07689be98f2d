//! A played node that reads as many bytes as the test commands, and no more.

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
use sinew_lncl::testing::{TestDirectory, WATCHDOG};
use sinew_protocol::{
    payload::{self, Register, Registered},
    ring::{self, Exchange, RingFrames, Taken},
};
use sinew_runtime::{
    tid::{AppAddress, NodeAddress, Tid},
    time::Time,
    wire::{FrameCodec, Kind, Message, encode_frame},
};
use sinew_shm::{BellKind, Consumer, Producer};
use tokio_util::codec::Decoder;

use crate::link::socket;

/// Bytes of its ring: messages are longer.
pub(super) const RING_BYTES: u32 = 4_096;
const PAYLOAD_MAX: usize = 4 << 20;
/// Time in which a client connects, also on a busy machine.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(60);

pub(super) struct PlayedNode {
    directory: TestDirectory,
    commands: Option<SyncSender<Command>>,
    messages: Receiver<Message>,
    thread: Option<JoinHandle<()>>,
}

enum Command {
    /// Read about this number of bytes, if they are there.
    Take(usize),
    /// Read everything that arrives.
    TakeAll,
    /// Read nothing any more without a command, and confirm it.
    StopReading(SyncSender<()>),
}

impl PlayedNode {
    /// Starts a node that serves a single client.
    pub(super) fn start() -> Self {
        let directory = TestDirectory::new();
        let listener = UnixListener::bind(socket_in(directory.path())).unwrap();
        let (commands, received_commands) = sync_channel(65_536);
        let (sender, messages) = sync_channel(65_536);
        let thread = thread::spawn(move || {
            let socket = accept_client(&listener);
            let (ends, frames) = (register_client(&socket), RingFrames::new(PAYLOAD_MAX));
            Played {
                socket,
                ends,
                frames,
                codec: FrameCodec::new(PAYLOAD_MAX),
                buffer: BytesMut::new(),
                sender,
            }
            .run(&received_commands);
        });
        Self { directory, commands: Some(commands), messages, thread: Some(thread) }
    }

    pub(super) fn path(&self) -> PathBuf {
        socket_in(self.directory.path())
    }

    /// Returns the address of an application behind the node.
    pub(super) fn remote_app() -> Tid {
        Tid::new(NodeAddress::new(9), AppAddress::fixed(9).unwrap())
    }

    pub(super) fn take(&self, bytes: usize) {
        self.command(Command::Take(bytes));
    }

    pub(super) fn take_all(&self) {
        self.command(Command::TakeAll);
    }

    /// Reads everything after this time.
    pub(super) fn take_all_in(&self, time: Duration) {
        let commands = self.commands.clone().expect("the node runs");
        thread::spawn(move || {
            thread::sleep(time);
            // An error is the test's end.
            let _ = commands.send(Command::TakeAll);
        });
    }

    /// Returns when the node no longer reads: later messages stay in the transport.
    pub(super) fn stop_reading(&self) {
        let (confirm, confirmed) = sync_channel(1);
        self.command(Command::StopReading(confirm));
        confirmed.recv_timeout(WATCHDOG).expect("waited until it stopped to read");
    }

    /// Returns the next complete message of an application.
    pub(super) fn next(&self) -> Message {
        self.messages.recv_timeout(WATCHDOG).expect("waited for a whole message")
    }

    /// Returns a complete message, if there is one.
    pub(super) fn next_now(&self) -> Option<Message> {
        self.messages.try_recv().ok()
    }

    fn command(&self, command: Command) {
        self.commands.as_ref().expect("the node runs").send(command).expect("the node reads commands");
    }
}

impl Drop for PlayedNode {
    fn drop(&mut self) {
        drop(self.commands.take());
        drop(self.thread.take().map(JoinHandle::join));
    }
}

fn socket_in(directory: &Path) -> PathBuf {
    directory.join("played.sock")
}

/// Returns the first client that connects and sends data. C checks for a listener before it registers, on a
/// separate connection.
fn accept_client(listener: &UnixListener) -> UnixStream {
    loop {
        is_readable(listener, "a client connects");
        let (socket, _) = listener.accept().unwrap();
        is_readable(&socket, "the connected client sends data, or hangs up");
        if recv(&socket, &mut [0; 1][..], RecvFlags::PEEK).unwrap().0 > 0 {
            return socket;
        }
    }
}

/// Waits until there is something to read.
fn is_readable(from: &impl AsFd, what: &str) {
    let within = Timespec::try_from(CONNECT_TIMEOUT).unwrap();
    let there = poll(&mut [PollFd::new(from, PollFlags::IN)], Some(&within)).unwrap();
    assert!(there > 0, "not within {CONNECT_TIMEOUT:?}: {what}");
}

/// Registers the connected client.
fn register_client(socket: &UnixStream) -> Option<(Producer, Consumer)> {
    let mut codec = FrameCodec::new(PAYLOAD_MAX);
    let mut buffer = BytesMut::new();
    let asked = loop {
        let mut chunk = [0; 4_096];
        let count = { socket }.read(&mut chunk).unwrap();
        assert!(count > 0, "it has ended before it was registered");
        buffer.extend_from_slice(&chunk[..count]);
        if let Some(message) = codec.decode(&mut buffer).unwrap() {
            break message;
        }
    };
    let ring = payload::read::<Register>(&asked.payload).unwrap().ring.then_some(RING_BYTES);
    let (node, app) = (NodeAddress::new(1), AppAddress::fixed(1).unwrap());
    let payload_max = PAYLOAD_MAX as u32;
    let registered = Registered {
        node,
        app,
        node_name: "played".to_owned(),
        payload_max,
        ring,
        types: false,
        ready: false,
    };
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
    /// Without rings the socket carries the frames.
    ends: Option<(Producer, Consumer)>,
    frames: RingFrames,
    codec: FrameCodec,
    buffer: BytesMut,
    sender: SyncSender<Message>,
}

impl Played {
    fn run(mut self, commands: &Receiver<Command>) {
        let mut takes_all = false;
        loop {
            let stall_timeout = if takes_all { Duration::from_millis(1) } else { WATCHDOG };
            match commands.recv_timeout(stall_timeout) {
                Ok(Command::Take(bytes)) => self.take(bytes),
                Ok(Command::TakeAll) => takes_all = true,
                Ok(Command::StopReading(confirm)) => {
                    takes_all = false;
                    // An error is the test's end.
                    let _ = confirm.send(());
                }
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => return,
            }
            if takes_all {
                self.take(usize::MAX);
            }
        }
    }

    /// Reads this number of bytes, or the available part of them.
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
            self.forward_messages();
            if count == 0 {
                return;
            }
            bytes = bytes.saturating_sub(count);
        }
    }

    fn forward_messages(&mut self) {
        loop {
            let next = match &self.ends {
                Some(_) => self.frames.next_message().unwrap(),
                None => self.codec.decode(&mut self.buffer).unwrap(),
            };
            match next {
                // A send error means that the test no longer needs the message.
                Some(message) if message.header.kind.is_user() => drop(self.sender.send(message)),
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
