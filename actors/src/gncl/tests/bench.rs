//! What the tests of this layer are made with: nodes that have GNCL only, and peers written by hand.

use std::{
    net::SocketAddr,
    sync::{Arc, atomic::Ordering},
    time::Duration,
};

use actix::{Actor, ActorContext, Addr, Arbiter, AsyncContext, System};
use bytes::Bytes;
use futures_util::{Stream, StreamExt};
use sinew_runtime::{
    outcome::{Outcome, Receipt, ReceiptSink, Rejection, Ticket},
    post::{Post, PostStream},
    router::{LocalRoute, Outlet, Refused},
    supervision::ReadyGate,
    tid::{AppAddress, Incarnation, NodeAddress, Tid},
    time::Time,
    wire::{Checksum, Flags, FrameCodec, Header, Kind, Message},
};
use tokio::{
    net::{TcpListener, TcpStream},
    task::JoinHandle,
};
use tokio_util::codec::Decoder;

use crate::{
    config::NodeConfig,
    gncl::{
        Event, Gncl, LinkFact,
        core::{Introduction, Lane, Refusal, read, write},
        peer::frame,
    },
    ndl::{self, LossReason, MembershipFact},
    session::Ack,
    stores::Stores,
};

pub(super) const KIND: Kind = Kind::named("test");
/// Bytes of the longest payload that a peer written by hand reads: more than the kernel takes of it before it reads.
pub(super) const LONGEST: usize = 16 << 20;

/// Runs a test where actors can live.
pub(super) fn run(test: impl Future<Output = ()>) {
    System::new().block_on(test);
}

/// Waits for what a test needs; says what that was if it does not come.
pub(super) async fn within<T>(what: &str, future: impl Future<Output = T>) -> T {
    let waited = tokio::time::timeout(Duration::from_secs(60), future).await;
    waited.unwrap_or_else(|_| panic!("waited 60 s for {what}"))
}

pub(super) async fn next<T>(what: &str, stream: &mut (impl Stream<Item = T> + Unpin)) -> T {
    within(what, stream.next()).await.unwrap_or_else(|| panic!("the stream of {what} ended"))
}

/// An application that has a mailbox and nothing else.
struct Inbox(Post<Message>);

impl Outlet for Inbox {
    fn submit(&self, message: Message) -> Result<(), Refused> {
        self.0.post(message).map_err(|message| Refused::new(message, Rejection::QueueFull))
    }
}

/// Outcomes as they come in.
struct Outcomes(Post<(u64, Outcome)>);

impl ReceiptSink for Outcomes {
    fn settle(&self, ticket: Ticket, outcome: Outcome) {
        self.0.post((ticket.correlation, outcome)).expect("the test has room for all its outcomes");
    }
}

/// A node with GNCL and no other layer.
pub(super) struct Node {
    pub(super) stores: Arc<Stores>,
    arbiter: Option<Arbiter>,
    layer: Option<Addr<Gncl>>,
    facts: PostStream<ndl::Event>,
    outcomes: Post<(u64, Outcome)>,
    pub(super) settled: PostStream<(u64, Outcome)>,
}

impl Node {
    pub(super) async fn start(number: u32) -> Self {
        Self::start_with(number, |_| {}).await
    }

    pub(super) async fn start_with(number: u32, set: impl FnOnce(&mut NodeConfig)) -> Self {
        let mut config = NodeConfig::new(format!("node-{number}"));
        config.address = Some(NodeAddress::new(number));
        set(&mut config);
        Self::begin(Stores::for_test(config, Incarnation(1))).await
    }

    /// One that has these stores.
    pub(super) async fn begin(stores: Arc<Stores>) -> Self {
        let outcomes = Post::new(10_000);
        let settled = outcomes.attach();
        let facts = stores.posts.ndl.attach();
        let mut node = Self { stores, arbiter: None, layer: None, facts, outcomes, settled };
        node.start_layer().await;
        node
    }

    pub(super) async fn start_layer(&mut self) {
        let (say, ready) = tokio::sync::oneshot::channel();
        let (stores, gate) =
            (self.stores.clone(), ReadyGate::new(move || say.send(()).expect("the test waits")));
        let arbiter = Arbiter::new();
        let (give, layer) = tokio::sync::oneshot::channel();
        arbiter.spawn_fn(move || {
            let layer = Gncl::create(|ctx| {
                // As its supervisor would tell it.
                ctx.run_interval(Duration::from_millis(1), |gncl, ctx| {
                    if gncl.is_to_stop() {
                        ctx.stop();
                    }
                });
                Gncl::new(stores, gate)
            });
            drop(give.send(layer));
        });
        self.layer = Some(within("GNCL to be made", layer).await.expect("it is made"));
        within("GNCL to be ready", ready).await.expect("GNCL says that it is ready");
        self.arbiter = Some(arbiter);
    }

    /// Ends the layer as a supervisor would: its thread goes, with all that ran on it.
    pub(super) fn stop_layer(&mut self) {
        if let Some(arbiter) = self.arbiter.take() {
            arbiter.stop();
            arbiter.join().expect("the layer's thread ends without a panic");
        }
    }

    /// From now on the layer does nothing, as one whose thread hangs.
    pub(super) async fn hang_layer(&mut self) -> Hung {
        let arbiter = self.arbiter.take().expect("there is a layer");
        let (say, hangs) = tokio::sync::oneshot::channel();
        let (release, held) = std::sync::mpsc::sync_channel::<()>(1);
        arbiter.spawn_fn(move || {
            say.send(()).expect("the test waits");
            // Until the other end is dropped.
            let _ = held.recv();
        });
        within("the layer to hang", hangs).await.expect("its thread says that it hangs");
        Hung { arbiter, release }
    }

    /// Has the layer end in order, as when its node is stopped.
    pub(super) fn leave(&self) {
        self.stores.stopping.store(true, Ordering::Relaxed);
    }

    /// Waits until the layer has ended.
    pub(super) async fn ended(&self) {
        within("the layer to end", async {
            while self.layer.as_ref().is_some_and(Addr::connected) {
                tokio::task::yield_now().await;
            }
        })
        .await;
    }

    pub(super) fn address(&self) -> NodeAddress {
        self.stores.node
    }

    pub(super) fn listens_at(&self) -> SocketAddr {
        *self.stores.gncl_listen.get().expect("GNCL listens")
    }

    pub(super) fn tid(&self, app: u32) -> Tid {
        Tid::new(self.stores.node, AppAddress::new(0x1000 + app))
    }

    pub(super) fn tell(&self, event: Event) {
        self.stores.posts.gncl.post(event).expect("GNCL reads its post");
    }

    pub(super) fn find(&self, node: NodeAddress, gncl: SocketAddr) {
        self.find_at(node, vec![gncl]);
    }

    /// The same of a node that announces several addresses.
    pub(super) fn find_at(&self, node: NodeAddress, gncl: Vec<SocketAddr>) {
        self.tell(Event::Membership(MembershipFact::NodeFound { node, incarnation: Incarnation(1), gncl }));
    }

    pub(super) fn lose(&self, node: NodeAddress) {
        let fact = MembershipFact::NodeLost { node, incarnation: Incarnation(1), why: LossReason::LinkDown };
        self.tell(Event::Membership(fact));
    }

    pub(super) async fn fact(&mut self) -> LinkFact {
        match next("a fact about a link", &mut self.facts).await {
            ndl::Event::Link(fact) => fact,
            ndl::Event::App(fact) => panic!("GNCL told NDL of an application: {fact:?}"),
        }
    }

    /// Waits until `wanted` is true of a fact, and returns that one.
    pub(super) async fn fact_that(&mut self, wanted: impl Fn(&LinkFact) -> bool) -> LinkFact {
        loop {
            let fact = self.fact().await;
            if wanted(&fact) {
                return fact;
            }
        }
    }

    pub(super) async fn up(&mut self) {
        self.fact_that(|fact| matches!(fact, LinkFact::LinkUp { .. })).await;
    }

    pub(super) async fn broken(&mut self) {
        self.fact_that(|fact| matches!(fact, LinkFact::LinkBroken { .. })).await;
    }

    /// Registers an application; what comes for it comes out of the stream.
    pub(super) fn app(&self, app: u32) -> PostStream<Message> {
        self.app_of(app, 10_000)
    }

    /// The same, with a mailbox for `capacity` messages.
    pub(super) fn app_of(&self, app: u32, capacity: usize) -> PostStream<Message> {
        let post = Post::new(capacity);
        let inbox = post.attach();
        let route = LocalRoute { outlet: Arc::new(Inbox(post)), events: Arc::new([]) };
        self.stores.router.set_local(AppAddress::new(0x1000 + app), route);
        inbox
    }

    pub(super) fn message(&self, to: Tid, payload: &[u8]) -> Message {
        let mut header = Header::new(KIND, self.tid(1), to);
        header.sent = Time::now();
        Message::new(header, Bytes::copy_from_slice(payload))
    }

    pub(super) fn send(&self, to: Tid, payload: &[u8]) {
        self.stores.router.send(self.message(to, payload)).expect("somebody takes the message");
    }

    pub(super) fn confirmed(&self, to: Tid, correlation: u64) -> Message {
        let mut message = self.message(to, &correlation.to_le_bytes());
        message.header.correlation = correlation;
        let ticket = Ticket { source: message.header.source, destination: to, correlation };
        message.receipt = Some(Receipt::new(Arc::new(Outcomes(self.outcomes.clone())), ticket));
        message
    }

    /// Refusals are counted on the layer's thread: waits until this cause was counted.
    pub(super) async fn counted(&self, cause: &'static str) {
        within(cause, async {
            while self.stores.gncl.refusals.of(cause) == 0 {
                tokio::task::yield_now().await;
            }
        })
        .await;
    }
}

/// A layer whose thread hangs.
pub(super) struct Hung {
    arbiter: Arbiter,
    release: std::sync::mpsc::SyncSender<()>,
}

impl Hung {
    /// It comes back, and is dropped at once, as its successor is there.
    pub(super) fn comes_back(self) {
        let Self { arbiter, release } = self;
        arbiter.stop();
        drop(release);
        arbiter.join().expect("the layer's thread ends without a panic");
    }
}

impl Drop for Node {
    fn drop(&mut self) {
        if let Some(arbiter) = self.arbiter.take() {
            arbiter.stop();
        }
    }
}

/// Two nodes that have found each other.
pub(super) async fn pair() -> (Node, Node) {
    let (mut a, mut b) = (Node::start(1).await, Node::start(2).await);
    a.find(b.address(), b.listens_at());
    b.find(a.address(), a.listens_at());
    a.up().await;
    b.up().await;
    (a, b)
}

/// A peer that is written by hand.
pub(super) struct ByHand {
    pub(super) socket: TcpStream,
    buffer: bytes::BytesMut,
    /// The number of what it sends next in its session.
    number: u16,
    /// What its frames have for a checksum.
    checksum: Checksum,
}

impl ByHand {
    pub(super) async fn dial(node: &Node) -> Self {
        Self::on(
            within("a connection", TcpStream::connect(node.listens_at())).await.expect("the node listens"),
        )
    }

    pub(super) fn on(socket: TcpStream) -> Self {
        Self { socket, buffer: bytes::BytesMut::new(), number: 1, checksum: Checksum::Crc }
    }

    /// A link to `node`, as its peer number 9.
    pub(super) async fn linked_to(node: &mut Node) -> Self {
        let peer = Self::greeting(node, &introduction(node.address())).await;
        node.up().await;
        peer
    }

    /// A connection to `node` on which `hello` was said, and welcomed.
    pub(super) async fn greeting(node: &Node, hello: &Introduction) -> Self {
        let mut peer = Self::dial(node).await;
        peer.say(&frame(NINE, node.address(), Kind::GNCL_HELLO, write(hello))).await;
        let welcome = peer.hear().await;
        assert_eq!(welcome.header.kind, Kind::GNCL_WELCOME);
        let welcome: Introduction = read(&welcome.payload).expect("a WELCOME has a payload");
        assert_eq!((welcome.node, welcome.peer), (node.address(), NINE));
        assert_eq!((welcome.lane, welcome.link), (hello.lane, hello.link));
        if hello.knows("guard") {
            peer.checksum = Checksum::Guarded;
        }
        peer.begin(node).await;
        peer
    }

    /// Says what it takes next: everything from the first message on, as if it had not been there before.
    async fn begin(&mut self, node: &Node) {
        let theirs = self.try_hear_any().await.expect("the node says what it takes next");
        assert_eq!(theirs.header.kind, Kind::GNCL_ACK);
        let memory = Time::now().as_nanos();
        let ours = Ack { memory, epoch: memory, of: 0, next: 1, change: 0, held: Vec::new(), room: None };
        self.say(&frame(NINE, node.address(), Kind::GNCL_ACK, write(&ours))).await;
    }

    /// Leaves its session's order.
    pub(super) fn skip(&mut self, numbers: i32) {
        self.number = self.number.wrapping_add_signed(numbers as i16);
    }

    /// Writes a frame, with the next number if it is a message.
    pub(super) async fn say(&mut self, message: &Message) {
        let mut bytes = bytes::BytesMut::new();
        let mut message = Message::new(message.header, message.payload.clone());
        if message.header.destination.app != AppAddress::GNCL || message.header.kind == Kind::GNCL_OUTCOMES {
            message.header.number = self.number;
            self.number = self.number.wrapping_add(1);
        }
        bytes.extend_from_slice(&self.checksum.encode(&message.header, &message.payload));
        bytes.extend_from_slice(&message.payload);
        self.say_bytes(&bytes).await;
    }

    pub(super) async fn say_bytes(&mut self, bytes: &[u8]) {
        let writing = tokio::io::AsyncWriteExt::write_all(&mut self.socket, bytes);
        within("the node to read", writing).await.expect("the node reads");
    }

    /// The next frame; panics if the node closes the connection instead.
    pub(super) async fn hear(&mut self) -> Message {
        self.try_hear().await.expect("the node closed the connection")
    }

    /// The next frame that is no ACK, or `None` when the node has closed the connection.
    pub(super) async fn try_hear(&mut self) -> Option<Message> {
        loop {
            let message = self.try_hear_any().await?;
            if message.header.kind != Kind::GNCL_ACK {
                return Some(message);
            }
        }
    }

    pub(super) async fn try_hear_any(&mut self) -> Option<Message> {
        loop {
            if let Some(message) =
                FrameCodec::new(LONGEST).decode(&mut self.buffer).expect("the node writes frames")
            {
                return Some(message);
            }
            let reading = tokio::io::AsyncReadExt::read_buf(&mut self.socket, &mut self.buffer);
            match within("bytes from the node", reading).await {
                Ok(0) | Err(_) => return None,
                Ok(_) => {}
            }
        }
    }

    /// The refusal that must come next, and then the end of the connection.
    pub(super) async fn refusal(mut self) -> Refusal {
        let message = self.hear().await;
        assert_eq!(message.header.kind, Kind::GNCL_REFUSAL);
        let refusal = read(&message.payload).expect("a REFUSAL has a payload");
        assert!(self.try_hear().await.is_none(), "the connection is closed after a refusal");
        refusal
    }

    /// An outcome for the confirmed message `about`.
    pub(super) fn outcome(about: &Message, outcome: Outcome) -> Message {
        let mut header = Header::new(Kind::OUTCOME, about.header.destination, about.header.source);
        header.flags = Flags::OUTCOME;
        header.correlation = about.header.correlation;
        Message::new(header, Bytes::copy_from_slice(&[outcome.code()]))
    }
}

/// The peer that is written by hand.
pub(super) const NINE: NodeAddress = NodeAddress::new(9);

pub(super) fn introduction(to: NodeAddress) -> Introduction {
    Introduction {
        project: "sinew".to_owned(),
        node: NINE,
        name: "by-hand".to_owned(),
        incarnation: Incarnation(1),
        peer: to,
        dial: 1,
        payload_max: 1 << 20,
        answers_max: 8_192,
        features: Vec::new(),
        lane: Lane::Control,
        link: 0,
        datagrams_made: 0,
    }
}

/// What is cut: of the connections that were made, in their order from 0, this one, or all.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Cut {
    All,
    One(usize),
}

/// A cable between a dialler and `target` that can be cut.
pub(super) struct Cable {
    pub(super) address: SocketAddr,
    cut: tokio::sync::watch::Sender<(u64, Cut)>,
    accepting: JoinHandle<()>,
}

impl Cable {
    pub(super) async fn to(target: SocketAddr) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").await.expect("loopback has a free port");
        let address = listener.local_addr().expect("it is bound");
        let (cut, cuts) = tokio::sync::watch::channel((0, Cut::All));
        let accepting = actix_rt::spawn(async move {
            let mut made = 0..;
            while let (Ok((mut near, _)), Some(number)) = (listener.accept().await, made.next()) {
                let mut cuts = cuts.clone();
                let before = cuts.borrow_and_update().0;
                let Ok(mut far) = TcpStream::connect(target).await else { continue };
                actix_rt::spawn(async move {
                    tokio::select! {
                        _ = tokio::io::copy_bidirectional(&mut near, &mut far) => {}
                        _ = cuts.wait_for(|(at, cut)| {
                            *at > before && matches!(*cut, Cut::All) || *cut == Cut::One(number)
                        }) => {}
                    }
                });
            }
        });
        Self { address, cut, accepting }
    }

    /// Ends all present connections.
    pub(super) fn cut(&self) {
        self.cut.send_modify(|(at, cut)| (*at, *cut) = (*at + 1, Cut::All));
    }

    /// Nobody can be reached through it any more.
    pub(super) fn remove(&self) {
        self.accepting.abort();
    }

    /// Ends the connection with this number, of those that were made, from 0.
    pub(super) fn cut_one(&self, number: usize) {
        self.cut.send_modify(|(at, cut)| (*at, *cut) = (*at + 1, Cut::One(number)));
    }
}

impl Drop for Cable {
    fn drop(&mut self) {
        self.accepting.abort();
    }
}
