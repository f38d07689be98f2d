//! Tools for the tests of LNCL and of NodeAPI: a node with LNCL only, and handwritten clients.

#![allow(
    missing_docs,
    clippy::unwrap_used,
    clippy::new_without_default,
    clippy::should_implement_trait,
    reason = "tools for tests: their names describe them, and a failure fails the test"
)]

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
use sinew_model::{
    config::NodeConfig,
    directory::DirectoryEntry,
    events::SyncEvent,
    facts::{AppFact, TypeDeclaration, User},
    ports::{AppTypes, Names},
};
use sinew_protocol::payload::{self, Refusal, Register, Registered};
use sinew_runtime::{
    event_queue::EventStream,
    lock,
    outcome::{Outcome, Receipt, ReceiptSink, Rejection, Ticket},
    router::{LocalRoute, MessageSink, Router, SubmitError},
    supervision::ReadyGate,
    tid::{AppAddress, Incarnation, NodeAddress, Tid},
    wire::{FrameCodec, Kind, Message, Payload, encode_frame},
};
use tokio::sync::oneshot;
use tokio_util::codec::Decoder;

use super::{Event, Lncl};
use crate::State;

/// The longest wait of a test for an expected event. It then fails and names the event.
pub const WATCHDOG: Duration = Duration::from_secs(60);

/// A directory of its own, removed at the end.
pub struct TestDirectory(PathBuf);

impl TestDirectory {
    pub fn new() -> Self {
        static COUNT: AtomicU32 = AtomicU32::new(0);
        let number = COUNT.fetch_add(1, Ordering::Relaxed);
        let path = std::env::temp_dir().join(format!("sinew-lncl-{}-{number}", std::process::id()));
        fs::create_dir_all(&path).unwrap();
        Self(path)
    }

    pub fn path(&self) -> &Path {
        &self.0
    }
}

impl Drop for TestDirectory {
    fn drop(&mut self) {
        let _ = fs::remove_dir_all(&self.0);
    }
}

/// A node with LNCL only. The test itself plays the sync manager.
pub struct TestNode {
    pub state: Arc<State>,
    facts: EventStream<SyncEvent>,
    stop: Option<oneshot::Sender<()>>,
    thread: Option<JoinHandle<()>>,
    /// It is removed at the end of the node.
    _directory: TestDirectory,
}

/// Starts the LNCL of a node, and waits until it is ready.
fn live(state: &Arc<State>) -> (oneshot::Sender<()>, JoinHandle<()>) {
    let (report_ready, ready) = sync_channel(1);
    let (stop, stopped) = oneshot::channel();
    let its_stores = state.clone();
    let thread = std::thread::spawn(move || {
        actix_rt::System::new().block_on(async move {
            let gate = ReadyGate::new(move || report_ready.send(()).unwrap());
            let _lncl = Lncl::new(its_stores, gate).start();
            let _ = stopped.await;
        });
    });
    ready.recv_timeout(WATCHDOG).expect("LNCL becomes ready");
    (stop, thread)
}

impl TestNode {
    pub fn start() -> Self {
        Self::start_with(|_| ())
    }

    pub fn start_with(change: impl FnOnce(&mut NodeConfig)) -> Self {
        let directory = TestDirectory::new();
        let mut config = NodeConfig::new("test");
        config.lncl.socket = Some(directory.path().join("node.sock"));
        change(&mut config);
        Self::begin(State::for_test(config, Incarnation(1)), directory)
    }

    /// Starts a node with this access list.
    pub fn start_guarded(access: &str) -> Self {
        Self::start_guarded_with(access, |_| {})
    }

    /// The same, with a configuration of its own.
    pub fn start_guarded_with(access: &str, change: impl FnOnce(&mut NodeConfig)) -> Self {
        let directory = TestDirectory::new();
        let mut config = NodeConfig::new("test");
        change(&mut config);
        config.lncl.socket = Some(directory.path().join("node.sock"));
        let state = State::for_test(config, Incarnation(1));
        state.security.access_in_test(&state.ctx, access);
        Self::begin(state, directory)
    }

    fn begin(state: Arc<State>, directory: TestDirectory) -> Self {
        let facts = state.ctx.event_queues.sync.attach();
        let (stop, thread) = live(&state);
        Self { state, facts, stop: Some(stop), thread: Some(thread), _directory: directory }
    }

    /// Ends the node, and starts another incarnation of it behind the same socket.
    pub fn restart(&mut self) {
        let (config, incarnation) = (self.state.ctx.config.clone(), self.state.ctx.incarnation.0);
        self.stop();
        self.state = State::for_test(config, Incarnation(incarnation + 1));
        self.facts = self.state.ctx.event_queues.sync.attach();
        let (stop, thread) = live(&self.state);
        (self.stop, self.thread) = (Some(stop), Some(thread));
    }

    pub fn path(&self) -> PathBuf {
        self.state.ctx.config.lncl.socket.clone().expect("each of these has one")
    }

    pub fn address(&self) -> NodeAddress {
        self.state.ctx.node
    }

    pub fn stop(&mut self) {
        drop(self.stop.take());
        if let Some(thread) = self.thread.take() {
            thread.join().unwrap();
        }
        // As the root does.
        self.state.client_socket.close();
    }

    /// Returns the next fact from LNCL for the sync manager.
    pub fn fact(&mut self) -> AppFact {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build().unwrap();
        let next = runtime.block_on(async { tokio::time::timeout(WATCHDOG, self.facts.next()).await });
        match next.expect("LNCL notifies the sync manager").expect("the event queue exists") {
            SyncEvent::App(fact) => {
                if fact == AppFact::GroupsChanged {
                    self.state.ctx.mark_groups_read();
                }
                fact
            }
            other @ (SyncEvent::Membership(_)
            | SyncEvent::Link(_)
            | SyncEvent::Monitors
            | SyncEvent::Message(_)) => {
                panic!("LNCL sent {other:?}")
            }
        }
    }

    /// Returns the node's routing table.
    pub fn router(&self) -> &Arc<Router> {
        &self.state.ctx.router
    }

    /// Runs this on a thread that holds the registry until it returns: the node answers no client meanwhile.
    pub fn with_registry_held(&self, run: impl FnOnce() + Send + 'static) -> JoinHandle<()> {
        let state = self.state.clone();
        std::thread::spawn(move || {
            let _registry = lock(&state.registry);
            run();
        })
    }

    /// Replaces the access list of a guarded node.
    pub fn replace_access(&self, list: &str) {
        self.state.security.access.get().expect("it has a list").replace_in_test(list);
    }

    /// Lets the test play the sync manager's answers.
    pub fn with_names(&self) -> Arc<PlayedNames> {
        let names = Arc::<PlayedNames>::default();
        self.state.ctx.ports.connect_names(&(names.clone() as Arc<_>));
        names
    }

    /// Lets the test receive the declarations of types.
    pub fn with_types(&self) -> PlayedTypes {
        let (declares, declared) = sync_channel(DECLARATIONS_MAX);
        let port: Arc<dyn AppTypes> = Arc::new(TypesPort(declares));
        self.state.ctx.ports.connect_app_types(&port);
        PlayedTypes { _port: port, declared }
    }

    /// Opens the barrier for an application, as the root does.
    pub fn release(&self, app: AppAddress) {
        self.state.ctx.event_queues.lncl.post(Event::Released { app }).unwrap();
    }

    /// Returns the number of rejections for `cause`.
    pub fn refused(&self, cause: &'static str) -> u64 {
        self.state.ctx.refusals.of(cause)
    }

    /// Registers an application in the node's process, played by the test.
    pub fn local(&self, index: u32) -> PlayedApp {
        let app = AppAddress::fixed(index).unwrap();
        let (sender, inbox) = sync_channel(1_024);
        let route = LocalRoute { sink: Arc::new(Channel(sender)), events: Arc::new([]) };
        self.state.ctx.router.set_local(app, route);
        PlayedApp { tid: Tid::new(self.address(), app), inbox: Mutex::new(inbox) }
    }

    /// Sends a value from an application in the node's process. Returns the receiver of its outcome.
    pub fn send_confirmed<P: Payload>(&self, from: Tid, to: Tid, value: &P) -> Receiver<Outcome> {
        let mut message = Message::typed(from, to, value);
        let (outcome, receiver) = sync_channel(1);
        static CORRELATION: AtomicU32 = AtomicU32::new(1);
        let correlation = u64::from(CORRELATION.fetch_add(1, Ordering::Relaxed));
        message.header.correlation = correlation;
        let ticket = Ticket { source: from, destination: to, correlation };
        message.receipt = Some(Receipt::new(Arc::new(Outcomes(outcome)), ticket));
        // A rejection is an outcome too.
        let _ = self.state.ctx.router.send(message);
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

impl MessageSink for Channel {
    fn submit(&self, message: Message) -> Result<(), SubmitError> {
        self.0.try_send(message).map_err(|error| match error {
            std::sync::mpsc::TrySendError::Full(message) => SubmitError::new(message, Rejection::QueueFull),
            std::sync::mpsc::TrySendError::Disconnected(message) => {
                SubmitError::new(message, Rejection::Closed)
            }
        })
    }
}

/// A sync manager that knows what the test tells it.
#[derive(Default)]
pub struct PlayedNames {
    pub called: Mutex<Vec<(String, Tid)>>,
    pub missing: Mutex<Vec<(String, &'static str)>>,
}

impl Names for PlayedNames {
    fn called(&self, name: &str) -> Vec<Tid> {
        let called = lock(&self.called);
        called.iter().filter(|(known, _)| known == name).map(|(_, tid)| *tid).collect()
    }

    fn all(&self) -> Vec<String> {
        lock(&self.called).iter().map(|(name, _)| name.clone()).collect()
    }

    fn directory(&self) -> Vec<DirectoryEntry> {
        Vec::new()
    }

    fn missing_in_brief(&self, _: AppAddress) -> Option<Vec<(String, &'static str)>> {
        Some(lock(&self.missing).clone())
    }
}

/// Maximum number of declarations that a test has not read.
const DECLARATIONS_MAX: usize = 64;

struct TypesPort(SyncSender<(AppAddress, TypeDeclaration)>);

/// Receives the declarations of types in the place of the node. Those without a structure are refused.
pub struct PlayedTypes {
    _port: Arc<dyn AppTypes>,
    declared: Receiver<(AppAddress, TypeDeclaration)>,
}

impl AppTypes for TypesPort {
    fn declare(&self, app: AppAddress, _: User, declaration: TypeDeclaration) -> Result<(), String> {
        if declaration.schema.is_empty() {
            return Err("it has no structure".to_owned());
        }
        self.0.try_send((app, declaration)).map_err(|why| why.to_string())
    }

    fn forget(&self, _: AppAddress) {}
}

impl PlayedTypes {
    /// Returns the next declaration.
    pub fn next(&self) -> (AppAddress, TypeDeclaration) {
        self.declared.recv_timeout(WATCHDOG).expect("a declaration")
    }
}

/// An application in the node's process.
pub struct PlayedApp {
    pub tid: Tid,
    inbox: Mutex<Receiver<Message>>,
}

impl PlayedApp {
    pub fn next(&self) -> Message {
        self.next_within(WATCHDOG).expect("a message comes")
    }

    /// Returns the next message, if one arrives within this time.
    pub fn next_within(&self, within: Duration) -> Option<Message> {
        self.inbox.lock().unwrap().recv_timeout(within).ok()
    }
}

/// A handwritten client, as in another language.
pub struct RawClient {
    socket: UnixStream,
    codec: FrameCodec,
    buffer: BytesMut,
}

impl RawClient {
    pub fn connect(node: &TestNode) -> Self {
        let socket = UnixStream::connect(node.path()).unwrap();
        socket.set_read_timeout(Some(WATCHDOG)).unwrap();
        Self { socket, codec: FrameCodec::new(1 << 20), buffer: BytesMut::new() }
    }

    /// Registers without requirements.
    pub fn register(node: &TestNode, register: &Register) -> (Self, Tid) {
        let mut client = Self::connect(node);
        client.ask_for_address(register);
        let tid = client.expect_registered();
        (client, tid)
    }

    pub fn ask_for_address(&mut self, register: &Register) {
        let lncl = payload::lncl_of(NodeAddress::HERE);
        self.send(&payload::frame(Kind::LNCL_REGISTER, Tid::NONE, lncl, register));
    }

    pub fn expect_registered(&mut self) -> Tid {
        let message = self.next().expect("an answer to the registration");
        assert_eq!(message.header.kind, Kind::LNCL_REGISTERED, "{message:?}");
        let registered: Registered = payload::read(&message.payload).unwrap();
        Tid::new(registered.node, registered.app)
    }

    /// Returns the text of the refusal, which must come next and be followed by the close.
    pub fn expect_refusal(&mut self) -> String {
        let message = self.next().expect("a refusal");
        assert_eq!(message.header.kind, Kind::LNCL_REFUSAL, "{message:?}");
        assert!(self.next().is_none(), "the node closes after a refusal");
        let refusal: Refusal = payload::read(&message.payload).unwrap();
        refusal.sentence
    }

    pub fn send(&mut self, message: &Message) {
        let mut bytes = BytesMut::new();
        encode_frame(&message.header, &message.payload, &mut bytes);
        self.send_bytes(&bytes);
    }

    pub fn send_bytes(&mut self, bytes: &[u8]) {
        // The node may have closed already: the test checks its last frame.
        let _ = self.socket.write_all(bytes);
    }

    /// Sends the bytes with a descriptor.
    pub fn pass(&mut self, bytes: &[u8], descriptors: &[BorrowedFd<'_>]) -> io::Result<()> {
        let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(2))];
        let mut control = SendAncillaryBuffer::new(&mut space);
        assert!(control.push(SendAncillaryMessage::ScmRights(descriptors)), "the space is for two");
        let sent = sendmsg(&self.socket, &[IoSlice::new(bytes)], &mut control, SendFlags::NOSIGNAL)?;
        assert_eq!(sent, bytes.len());
        Ok(())
    }

    /// Sends a message, and returns whether the node accepted it at once. If not, part of it may be sent, and nothing
    /// may follow.
    pub fn takes_at_once(&mut self, message: &Message) -> bool {
        let mut bytes = BytesMut::new();
        encode_frame(&message.header, &message.payload, &mut bytes);
        self.socket.set_write_timeout(Some(Duration::from_millis(500))).unwrap();
        self.socket.write_all(&bytes).is_ok()
    }

    /// Reads until the node has closed.
    pub fn skip_until_closed(&mut self) {
        let mut chunk = [0; 4_096];
        while matches!(self.socket.read(&mut chunk), Ok(count) if count > 0) {}
    }

    /// Returns the next frame; `None` when the node has closed.
    pub fn next(&mut self) -> Option<Message> {
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
