//! What tests of LNCL and of NodeAPI stand on: a node that has only its LNCL, and clients spoken by hand.

use std::{
    fs,
    io::{self, IoSlice, Read, Write},
    mem::MaybeUninit,
    os::{fd::BorrowedFd, unix::net::UnixStream},
    path::{Path, PathBuf},
    sync::{
        Arc, Mutex,
        atomic::{AtomicU32, Ordering},
        mpsc::{Receiver, SyncSender, sync_channel},
    },
    thread::JoinHandle,
    time::Duration,
};

use actix::Actor;
use bytes::BytesMut;
use futures_util::StreamExt;
use rustix::net::{SendAncillaryBuffer, SendAncillaryMessage, SendFlags, sendmsg};
use sinew_runtime::{
    outcome::{Outcome, Receipt, ReceiptSink, Rejection, Ticket},
    post::PostStream,
    router::{LocalRoute, Outlet, Refused},
    supervision::ReadyGate,
    tid::{AppAddress, Incarnation, NodeAddress, Tid},
    wire::{FrameCodec, Kind, Message, Payload, encode_frame},
};
use tokio::sync::oneshot;
use tokio_util::codec::Decoder;

use super::{
    AppFact, Event, Lncl,
    payload::{self, Refusal, Register, Registered},
};
use crate::{NodeConfig, access::Access, stores::Stores, sync};

/// How long a test waits for what must come; it fails then with what it waited for.
pub(crate) const WATCHDOG: Duration = Duration::from_secs(60);

/// A directory of its own, removed at the end.
pub(crate) struct TestDirectory(PathBuf);

impl TestDirectory {
    pub(crate) fn new() -> Self {
        static COUNT: AtomicU32 = AtomicU32::new(0);
        let number = COUNT.fetch_add(1, Ordering::Relaxed);
        let path = std::env::temp_dir().join(format!("sinew-lncl-{}-{number}", std::process::id()));
        fs::create_dir_all(&path).unwrap();
        Self(path)
    }

    pub(crate) fn path(&self) -> &Path {
        &self.0
    }
}

impl Drop for TestDirectory {
    fn drop(&mut self) {
        let _ = fs::remove_dir_all(&self.0);
    }
}

/// A node that has only its LNCL. The test itself plays the sync manager.
pub(crate) struct TestNode {
    pub(crate) stores: Arc<Stores>,
    facts: PostStream<sync::Event>,
    stop: Option<oneshot::Sender<()>>,
    thread: Option<JoinHandle<()>>,
    directory: TestDirectory,
}

/// Starts the LNCL of a node, and waits until it is ready.
fn live(stores: &Arc<Stores>) -> (oneshot::Sender<()>, JoinHandle<()>) {
    let (say_ready, ready) = sync_channel(1);
    let (stop, stopped) = oneshot::channel();
    let its_stores = stores.clone();
    let thread = std::thread::spawn(move || {
        actix_rt::System::new().block_on(async move {
            let gate = ReadyGate::new(move || say_ready.send(()).unwrap());
            let _lncl = Lncl::new(its_stores, gate).start();
            let _ = stopped.await;
        });
    });
    ready.recv_timeout(WATCHDOG).expect("LNCL becomes ready");
    (stop, thread)
}

impl TestNode {
    pub(crate) fn start() -> Self {
        Self::start_with(|_| ())
    }

    pub(crate) fn start_with(change: impl FnOnce(&mut NodeConfig)) -> Self {
        let directory = TestDirectory::new();
        let mut config = NodeConfig::new("test");
        config.lncl.socket = Some(directory.path().join("node.sock"));
        change(&mut config);
        Self::begin(Stores::for_test(config, Incarnation(1)), directory)
    }

    /// One with this access list.
    pub(crate) fn start_guarded(access: &str) -> Self {
        Self::start_guarded_with(access, |_| {})
    }

    /// The same, with a configuration of its own.
    pub(crate) fn start_guarded_with(access: &str, change: impl FnOnce(&mut NodeConfig)) -> Self {
        let directory = TestDirectory::new();
        let mut config = NodeConfig::new("test");
        change(&mut config);
        config.lncl.socket = Some(directory.path().join("node.sock"));
        let stores = Stores::for_test(config, Incarnation(1));
        Access::in_test(&stores, access);
        Self::begin(stores, directory)
    }

    fn begin(stores: Arc<Stores>, directory: TestDirectory) -> Self {
        let facts = stores.posts.sync.attach();
        let (stop, thread) = live(&stores);
        Self { stores, facts, stop: Some(stop), thread: Some(thread), directory }
    }

    /// Ends it, and starts another life of it behind the same socket.
    pub(crate) fn restart(&mut self) {
        let (config, life) = (self.stores.config.clone(), self.stores.incarnation.0);
        self.stop();
        self.stores = Stores::for_test(config, Incarnation(life + 1));
        self.facts = self.stores.posts.sync.attach();
        let (stop, thread) = live(&self.stores);
        (self.stop, self.thread) = (Some(stop), Some(thread));
    }

    pub(crate) fn path(&self) -> PathBuf {
        self.directory.path().join("node.sock")
    }

    pub(crate) fn address(&self) -> NodeAddress {
        self.stores.node
    }

    pub(crate) fn stop(&mut self) {
        drop(self.stop.take());
        if let Some(thread) = self.thread.take() {
            thread.join().unwrap();
        }
        // As the root does.
        self.stores.close();
    }

    /// The next thing that LNCL says to the sync manager.
    pub(crate) fn fact(&mut self) -> AppFact {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build().unwrap();
        let next = runtime.block_on(async { tokio::time::timeout(WATCHDOG, self.facts.next()).await });
        match next.expect("LNCL tells the sync manager something").expect("the post lives") {
            sync::Event::App(fact) => {
                if fact == AppFact::GroupsChanged {
                    self.stores.groups_are_looked_at();
                }
                fact
            }
            other @ (sync::Event::Membership(_)
            | sync::Event::Link(_)
            | sync::Event::Monitors
            | sync::Event::Message(_)) => {
                panic!("LNCL said {other:?}")
            }
        }
    }

    /// Opens the barrier for an application, as the root does.
    pub(crate) fn release(&self, app: AppAddress) {
        self.stores.posts.lncl.post(Event::Released { app }).unwrap();
    }

    /// How much was refused for `cause`.
    pub(crate) fn refused(&self, cause: &'static str) -> u64 {
        self.stores.refusals.of(cause)
    }

    /// An application in the node's process, played by the test.
    pub(crate) fn local(&self, index: u32) -> PlayedApp {
        let app = AppAddress::fixed(index).unwrap();
        let (sender, inbox) = sync_channel(1_024);
        let route = LocalRoute { outlet: Arc::new(Channel(sender)), events: Arc::new([]) };
        self.stores.router.set_local(app, route);
        PlayedApp { tid: Tid::new(self.address(), app), inbox: Mutex::new(inbox) }
    }

    /// Sends a value from an application in the node's process and hands out where its outcome will come.
    pub(crate) fn send_confirmed<P: Payload>(&self, from: Tid, to: Tid, value: &P) -> Receiver<Outcome> {
        let mut message = Message::typed(from, to, value);
        let (outcome, receiver) = sync_channel(1);
        static CORRELATION: AtomicU32 = AtomicU32::new(1);
        let correlation = u64::from(CORRELATION.fetch_add(1, Ordering::Relaxed));
        message.header.correlation = correlation;
        let ticket = Ticket { source: from, destination: to, correlation };
        message.receipt = Some(Receipt::new(Arc::new(Outcomes(outcome)), ticket));
        // A refusal is an outcome too.
        let _ = self.stores.router.send(message);
        receiver
    }
}

impl Drop for TestNode {
    fn drop(&mut self) {
        self.stop();
    }
}

struct Outcomes(SyncSender<Outcome>);

impl ReceiptSink for Outcomes {
    fn settle(&self, _: Ticket, outcome: Outcome) {
        self.0.send(outcome).unwrap();
    }
}

struct Channel(SyncSender<Message>);

impl Outlet for Channel {
    fn submit(&self, message: Message) -> Result<(), Refused> {
        self.0.try_send(message).map_err(|error| match error {
            std::sync::mpsc::TrySendError::Full(message) => Refused::new(message, Rejection::QueueFull),
            std::sync::mpsc::TrySendError::Disconnected(message) => Refused::new(message, Rejection::Closed),
        })
    }
}

/// An application in the node's process.
pub(crate) struct PlayedApp {
    pub(crate) tid: Tid,
    inbox: Mutex<Receiver<Message>>,
}

impl PlayedApp {
    pub(crate) fn next(&self) -> Message {
        self.inbox.lock().unwrap().recv_timeout(WATCHDOG).expect("a message comes")
    }
}

/// A client spoken by hand, as one in another language would.
pub(crate) struct RawClient {
    socket: UnixStream,
    codec: FrameCodec,
    buffer: BytesMut,
}

impl RawClient {
    pub(crate) fn connect(node: &TestNode) -> Self {
        let socket = UnixStream::connect(node.path()).unwrap();
        socket.set_read_timeout(Some(WATCHDOG)).unwrap();
        Self { socket, codec: FrameCodec::new(1 << 20), buffer: BytesMut::new() }
    }

    /// Registers, requiring nothing.
    pub(crate) fn register(node: &TestNode, register: &Register) -> (Self, Tid) {
        let mut client = Self::connect(node);
        client.ask_for_address(register);
        let tid = client.expect_registered();
        (client, tid)
    }

    pub(crate) fn ask_for_address(&mut self, register: &Register) {
        let lncl = payload::lncl_of(NodeAddress::HERE);
        self.send(&payload::frame(Kind::LNCL_REGISTER, Tid::NONE, lncl, register));
    }

    pub(crate) fn expect_registered(&mut self) -> Tid {
        let message = self.next().expect("an answer to the registration");
        assert_eq!(message.header.kind, Kind::LNCL_REGISTERED, "{message:?}");
        let registered: Registered = payload::read(&message.payload).unwrap();
        Tid::new(registered.node, registered.app)
    }

    /// The sentence of the refusal that must come next, after which the node closes.
    pub(crate) fn expect_refusal(&mut self) -> String {
        let message = self.next().expect("a refusal");
        assert_eq!(message.header.kind, Kind::LNCL_REFUSAL, "{message:?}");
        assert!(self.next().is_none(), "the node closes after a refusal");
        let refusal: Refusal = payload::read(&message.payload).unwrap();
        refusal.sentence
    }

    pub(crate) fn send(&mut self, message: &Message) {
        let mut bytes = BytesMut::new();
        encode_frame(&message.header, &message.payload, &mut bytes);
        self.send_bytes(&bytes);
    }

    pub(crate) fn send_bytes(&mut self, bytes: &[u8]) {
        // The node may have closed already: what it says then is what the test looks at.
        let _ = self.socket.write_all(bytes);
    }

    /// Passes the bytes with a descriptor beside them.
    pub(crate) fn pass(&mut self, bytes: &[u8], descriptors: &[BorrowedFd<'_>]) -> io::Result<()> {
        let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(2))];
        let mut control = SendAncillaryBuffer::new(&mut space);
        assert!(control.push(SendAncillaryMessage::ScmRights(descriptors)), "the space is for two");
        let sent = sendmsg(&self.socket, &[IoSlice::new(bytes)], &mut control, SendFlags::NOSIGNAL)?;
        assert_eq!(sent, bytes.len());
        Ok(())
    }

    /// Sends if the node goes on taking what is sent. If not, part of it may be sent: this is the last thing that is.
    pub(crate) fn takes_at_once(&mut self, message: &Message) -> bool {
        let mut bytes = BytesMut::new();
        encode_frame(&message.header, &message.payload, &mut bytes);
        self.socket.set_write_timeout(Some(Duration::from_millis(500))).unwrap();
        self.socket.write_all(&bytes).is_ok()
    }

    /// Reads until the node has closed.
    pub(crate) fn skip_until_closed(&mut self) {
        let mut chunk = [0; 4_096];
        while matches!(self.socket.read(&mut chunk), Ok(count) if count > 0) {}
    }

    /// The next frame; `None` when the node has closed.
    pub(crate) fn next(&mut self) -> Option<Message> {
        loop {
            if let Some(message) = self.codec.decode(&mut self.buffer).unwrap() {
                return Some(message);
            }
            let mut chunk = [0; 4_096];
            match self.socket.read(&mut chunk) {
                Ok(0) => return None,
                Ok(count) => self.buffer.extend_from_slice(&chunk[..count]),
                // Closed with bytes of ours unread.
                Err(error) if error.kind() == io::ErrorKind::ConnectionReset => return None,
                Err(error) => panic!("waiting for a frame: {error}"),
            }
        }
    }
}
