//! The tools of this layer's tests: nodes with GNCL only, and handwritten peers.

mod by_hand;
mod cable;

use std::{
    net::SocketAddr,
    sync::{Arc, atomic::Ordering},
    time::Duration,
};

use actix::{Actor, ActorContext, Addr, Arbiter, AsyncContext, System};
use bytes::Bytes;
use futures_util::{Stream, StreamExt};
use sinew_model::{
    config::NodeConfig,
    events::NdlEvent,
    facts::{LinkFact, LossReason, MembershipFact},
};
use sinew_runtime::{
    event_queue::{EventQueue, EventStream},
    outcome::{Outcome, Receipt, ReceiptSink, Rejection, Ticket},
    router::{LocalRoute, MessageSink, SubmitError},
    supervision::ReadyGate,
    tid::{AppAddress, Incarnation, NodeAddress, Tid},
    time::Time,
    wire::{Header, Kind, Message},
};

use crate::{Event, Gncl, State};
pub(super) use by_hand::{ByHand, NINE, introduction};
pub(super) use cable::Cable;

pub(super) const KIND: Kind = Kind::named("test");
/// Bytes of the longest payload that a handwritten peer reads: more than the kernel accepts of it before the peer
/// reads.
pub(super) const LONGEST: usize = 16 << 20;

/// Runs a test in an environment for actors.
pub(super) fn run(test: impl Future<Output = ()>) {
    System::new().block_on(test);
}

/// Waits for a future of a test; names it if it does not complete.
pub(super) async fn within<T>(what: &str, future: impl Future<Output = T>) -> T {
    let waited = tokio::time::timeout(Duration::from_secs(60), future).await;
    waited.unwrap_or_else(|_| panic!("waited 60 s for {what}"))
}

pub(super) async fn next<T>(what: &str, stream: &mut (impl Stream<Item = T> + Unpin)) -> T {
    within(what, stream.next()).await.unwrap_or_else(|| panic!("the stream of {what} ended"))
}

/// An application with a mailbox only.
struct Inbox(EventQueue<Message>);

impl MessageSink for Inbox {
    fn submit(&self, message: Message) -> Result<(), SubmitError> {
        self.0.post(message).map_err(|message| SubmitError::new(message, Rejection::QueueFull))
    }
}

/// Outcomes in the order of their arrival.
struct Outcomes(EventQueue<(u64, Outcome)>);

impl ReceiptSink for Outcomes {
    fn settle(&self, ticket: Ticket, outcome: Outcome) {
        self.0.post((ticket.correlation, outcome)).expect("the test has room for all its outcomes");
    }
}

/// A node with GNCL and no other layer.
pub(super) struct Node {
    pub(super) state: Arc<State>,
    arbiter: Option<Arbiter>,
    layer: Option<Addr<Gncl>>,
    facts: EventStream<NdlEvent>,
    outcomes: EventQueue<(u64, Outcome)>,
    pub(super) settled: EventStream<(u64, Outcome)>,
}

impl Node {
    pub(super) async fn start(number: u32) -> Self {
        Self::start_with(number, |_| {}).await
    }

    pub(super) async fn start_with(number: u32, set: impl FnOnce(&mut NodeConfig)) -> Self {
        let mut config = NodeConfig::new(format!("node-{number}"));
        config.address = Some(NodeAddress::new(number));
        set(&mut config);
        Self::begin(State::for_test(config, Incarnation(1))).await
    }

    /// Starts a node with these state.
    pub(super) async fn begin(state: Arc<State>) -> Self {
        let outcomes = EventQueue::new(10_000);
        let settled = outcomes.attach();
        let facts = state.ctx.event_queues.ndl.attach();
        let mut node = Self { state, arbiter: None, layer: None, facts, outcomes, settled };
        node.start_layer().await;
        node
    }

    pub(super) async fn start_layer(&mut self) {
        let (say, ready) = tokio::sync::oneshot::channel();
        let (state, gate) =
            (self.state.clone(), ReadyGate::new(move || say.send(()).expect("the test waits")));
        let arbiter = Arbiter::new();
        let (give, layer) = tokio::sync::oneshot::channel();
        arbiter.spawn_fn(move || {
            let layer = Gncl::create(|ctx| {
                // As its supervisor would request.
                ctx.run_interval(Duration::from_millis(1), |gncl, ctx| {
                    if gncl.is_to_stop() {
                        ctx.stop();
                    }
                });
                Gncl::new(state, gate)
            });
            drop(give.send(layer));
        });
        self.layer = Some(within("GNCL to be made", layer).await.expect("it is made"));
        within("GNCL to be ready", ready).await.expect("GNCL says that it is ready");
        self.arbiter = Some(arbiter);
    }

    /// Ends the layer as a supervisor would: its thread ends, with everything that ran on it.
    pub(super) fn stop_layer(&mut self) {
        if let Some(arbiter) = self.arbiter.take() {
            arbiter.stop();
            arbiter.join().expect("the layer's thread ends without a panic");
        }
    }

    /// Blocks the layer from now on, like a hung thread.
    pub(super) async fn hang_layer(&mut self) -> Hung {
        let arbiter = self.arbiter.take().expect("there is a layer");
        let (say, hangs) = tokio::sync::oneshot::channel();
        let (release, held) = std::sync::mpsc::sync_channel::<()>(1);
        arbiter.spawn_fn(move || {
            say.send(()).expect("the test waits");
            // Blocks until the other end is dropped.
            let _ = held.recv();
        });
        within("the layer to hang", hangs).await.expect("its thread says that it hangs");
        Hung { arbiter, release }
    }

    /// Ends the layer in order, as a stop of its node does.
    pub(super) fn leave(&self) {
        self.state.ctx.stopping.store(true, Ordering::Relaxed);
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
        self.state.ctx.node
    }

    pub(super) fn listens_at(&self) -> SocketAddr {
        *self.state.ctx.listens.first.get().expect("GNCL listens")
    }

    pub(super) fn tid(&self, app: u32) -> Tid {
        Tid::new(self.state.ctx.node, AppAddress::new(0x1000 + app))
    }

    pub(super) fn notify(&self, event: Event) {
        self.state.ctx.event_queues.gncl.post(event).expect("GNCL reads its queue");
    }

    pub(super) fn find(&self, node: NodeAddress, gncl: SocketAddr) {
        self.find_at(node, vec![gncl]);
    }

    /// The same for a node that announces several addresses.
    pub(super) fn find_at(&self, node: NodeAddress, gncl: Vec<SocketAddr>) {
        self.notify(Event::Membership(MembershipFact::NodeFound { node, incarnation: Incarnation(1), gncl }));
    }

    pub(super) fn lose(&self, node: NodeAddress) {
        let fact = MembershipFact::NodeLost { node, incarnation: Incarnation(1), why: LossReason::LinkDown };
        self.notify(Event::Membership(fact));
    }

    pub(super) async fn fact(&mut self) -> LinkFact {
        match next("a fact about a link", &mut self.facts).await {
            NdlEvent::Link(fact) => fact,
            NdlEvent::App(fact) => panic!("GNCL told NDL of an application: {fact:?}"),
        }
    }

    /// Waits until `wanted` is true of a fact, and returns it.
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

    /// Registers an application; the stream yields its messages.
    pub(super) fn app(&self, app: u32) -> EventStream<Message> {
        self.app_of(app, 10_000)
    }

    /// The same, with a mailbox for `capacity` messages.
    pub(super) fn app_of(&self, app: u32, capacity: usize) -> EventStream<Message> {
        let queue = EventQueue::new(capacity);
        let inbox = queue.attach();
        let route = LocalRoute { sink: Arc::new(Inbox(queue)), events: Arc::new([]) };
        self.state.ctx.router.set_local(AppAddress::new(0x1000 + app), route);
        inbox
    }

    pub(super) fn message(&self, to: Tid, payload: &[u8]) -> Message {
        let mut header = Header::new(KIND, self.tid(1), to);
        header.sent = Time::now();
        Message::new(header, Bytes::copy_from_slice(payload))
    }

    pub(super) fn send(&self, to: Tid, payload: &[u8]) {
        self.state.ctx.router.send(self.message(to, payload)).expect("somebody takes the message");
    }

    pub(super) fn confirmed(&self, to: Tid, correlation: u64) -> Message {
        let mut message = self.message(to, &correlation.to_le_bytes());
        message.header.correlation = correlation;
        let ticket = Ticket { source: message.header.source, destination: to, correlation };
        message.receipt = Some(Receipt::new(Arc::new(Outcomes(self.outcomes.clone())), ticket));
        message
    }

    /// Waits until this cause was counted, as rejections are counted on the layer's thread.
    pub(super) async fn counted(&self, cause: &'static str) {
        within(cause, async {
            while self.state.store.refusals.of(cause) == 0 {
                tokio::task::yield_now().await;
            }
        })
        .await;
    }
}

/// A layer with a hung thread.
pub(super) struct Hung {
    arbiter: Arbiter,
    release: std::sync::mpsc::SyncSender<()>,
}

impl Hung {
    /// Resumes the layer. It is dropped at once, as its successor is present.
    pub(super) fn resume(self) {
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

/// Returns two nodes that have found each other.
pub(super) async fn pair() -> (Node, Node) {
    let (mut a, mut b) = (Node::start(1).await, Node::start(2).await);
    a.find(b.address(), b.listens_at());
    b.find(a.address(), a.listens_at());
    a.up().await;
    b.up().await;
    (a, b)
}
