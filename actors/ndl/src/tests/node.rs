//! A node with NDL alone: its start, its end, and the facts and events that it reports.

use std::{
    net::SocketAddr,
    sync::Arc,
    task::{Context, Waker},
};

use actix::{Actor, Arbiter};
use futures_util::StreamExt;
use sinew_model::{
    config::{NdlConfig, NodeConfig},
    context::NodeContext,
    events::{GnclEvent, LayerReport},
    facts::{AppFact, LossReason, MembershipFact, NodeEvent},
    progress::Progress,
};
use sinew_runtime::{
    event_queue::{EventQueue, EventStream},
    outcome::Rejection,
    router::{LocalRoute, MessageSink, SubmitError},
    supervision::ReadyGate,
    tid::{AppAddress, Incarnation, NodeAddress},
    time::Time,
    wire::{Message, Payload},
};

use super::{LOOPBACK, alone, within};
use crate::{NdlActor, Source, State, actor::lock_core};
/// An application that accepts every event.
pub(super) struct Inbox(pub(super) EventQueue<Message>);

impl MessageSink for Inbox {
    fn submit(&self, message: Message) -> Result<(), SubmitError> {
        self.0.post(message).map_err(|message| SubmitError::new(message, Rejection::QueueFull))
    }

    fn offer(&self, message: Message, room: Option<&Waker>) -> Result<(), SubmitError> {
        let result = self.submit(message);
        if result.is_err()
            && let Some(room) = room
            && self.0.poll_room(&Context::from_waker(room)).is_ready()
        {
            room.wake_by_ref();
        }
        result
    }
}

/// A node with NDL and no other layer.
pub(super) struct Node {
    pub(super) state: Arc<State>,
    pub(super) root: EventQueue<LayerReport>,
    pub(super) layer: Option<Arbiter>,
    pub(super) facts: EventStream<GnclEvent>,
    pub(super) events: EventStream<Message>,
    /// A root that reports progress; without one the node hangs.
    pub(super) has_root: bool,
}

pub(super) async fn all_gets_on(mut root: EventStream<LayerReport>) {
    while let Some(event) = root.next().await {
        if let LayerReport::RequestProgress(answer) = event {
            drop(answer.send(Progress::default()));
        }
    }
}

impl Node {
    pub(super) async fn start(number: u32, set: impl FnOnce(&mut NdlConfig)) -> Self {
        Self::start_life(number, 1, set).await
    }

    pub(super) async fn start_life(number: u32, incarnation: u64, set: impl FnOnce(&mut NdlConfig)) -> Self {
        let mut node = Self::new(number, incarnation, set);
        node.start_layer().await;
        node
    }

    pub(super) fn new(number: u32, incarnation: u64, set: impl FnOnce(&mut NdlConfig)) -> Self {
        let mut config = NodeConfig::new(format!("node-{number}"));
        config.address = Some(NodeAddress::new(number));
        alone(&mut config.ndl);
        set(&mut config.ndl);
        Self::of(config, incarnation)
    }

    pub(super) fn of(config: NodeConfig, incarnation: u64) -> Self {
        let number = config.node_address().bits();
        let (ctx, root) = NodeContext::for_test(config, Incarnation(incarnation));
        let state = State::new(ctx, Arc::default());
        state.ctx.listens.first.set(gncl_of(number)).unwrap();
        let (inbox, facts) = (EventQueue::new(1_000), state.ctx.event_queues.gncl.attach());
        let events = inbox.attach();
        let route = LocalRoute { sink: Arc::new(Inbox(inbox)), events: Arc::new([NodeEvent::KIND]) };
        state.ctx.router.set_local(AppAddress::new(0x1000), route);
        state
            .ctx
            .app_backlogs
            .queue_for_ndl(&state.ctx.event_queues, AppFact::Ready { app: AppAddress::new(0x1000) });
        Self { state, root, layer: None, facts, events, has_root: true }
    }

    pub(super) async fn start_layer(&mut self) {
        let (sender, ready) = tokio::sync::oneshot::channel();
        let gate = ReadyGate::new(move || sender.send(()).expect("the test waits"));
        let (state, layer) = (self.state.clone(), Arbiter::new());
        layer.spawn_fn(move || drop(NdlActor::new(state, gate).start()));
        if self.has_root {
            layer.spawn(all_gets_on(self.root.attach()));
        }
        within("NDL to be ready", ready).await.expect("NDL reports that it is ready");
        self.layer = Some(layer);
    }

    /// Ends the layer as a crash would: its thread ends, with everything that ran on it.
    pub(super) fn end_layer(&mut self) {
        if let Some(layer) = self.layer.take() {
            layer.stop();
            layer.join().expect("the layer's thread ends without a panic");
        }
    }

    pub(super) fn udp(&self) -> SocketAddr {
        lock_core(&self.state).paths().first().copied().expect("NDL has bound its socket")
    }

    pub(super) async fn fact(&mut self, what: &str) -> MembershipFact {
        let event = within(what, self.facts.next()).await.expect("this queue has no other reader");
        let GnclEvent::Membership(fact) = event else { panic!("no node moves: {event:?}") };
        fact
    }

    pub(super) async fn finds(&mut self, other: &Self) {
        let (node, incarnation) = (other.state.ctx.node, other.state.ctx.incarnation);
        let found = MembershipFact::NodeFound { node, incarnation, gncl: vec![gncl_of(node.bits())] };
        assert_eq!(self.fact(&format!("node {node} to be found")).await, found);
    }

    pub(super) async fn loses(&mut self, other: &Self, reason: LossReason) {
        let (node, incarnation) = (other.state.ctx.node, other.state.ctx.incarnation);
        let lost = MembershipFact::NodeLost { node, incarnation, why: reason };
        assert_eq!(self.fact(&format!("node {node} to be lost")).await, lost);
    }

    pub(super) async fn event(&mut self) -> Message {
        within("an event", self.events.next()).await.expect("nobody else reads this inbox")
    }

    pub(super) fn sources(&self) -> Vec<Source> {
        let members = lock_core(&self.state).members(Time::now());
        members.iter().flat_map(|member| member.sources.keys().copied()).collect()
    }
}

impl Drop for Node {
    fn drop(&mut self) {
        self.end_layer();
    }
}

fn gncl_of(number: u32) -> SocketAddr {
    SocketAddr::from((LOOPBACK, 40_000 + number as u16))
}
