//! The actor shell: it operates sockets and timers for the core's outputs, and passes their events to the core.

mod accepting;
mod authentication;
mod datagram_setup;
mod frames;
mod leaving;
mod link_notifications;
#[cfg(target_os = "linux")]
mod long_segments;
mod lost_addresses;
mod membership;
mod timer;
mod wire;

use std::{
    cell::{Cell, RefCell},
    collections::BTreeMap,
    io,
    net::{Shutdown, SocketAddr},
    rc::Rc,
    sync::{Arc, Mutex, atomic::Ordering},
    time::Duration,
};

use actix::{Actor, AsyncContext, Context, Running, StreamHandler, fut};
use futures_util::stream;
use sinew_model::{accept_limiter::AcceptLimiter, config::NodeConfig, leave_reason::LeaveReason};
use sinew_runtime::{
    supervision::ReadyGate,
    tid::{Incarnation, NodeAddress},
    time::Time,
    wire::Kind,
};
use sinew_session::outlet::Gathering;

use super::{
    authenticator::Authenticator,
    connection_events::ConnectionEvents,
    core::{
        Attach, CANCEL, CLASSES, ConnectionId, Core, DATAGRAMS, GUARD, Input, Introduction, Lane,
        OUTCOME_RUNS, OUTCOMES, Output, Settings, UNDELIVERED, write,
    },
    datagram_reader,
    frame::frame,
    inbound::Inbound,
    link::{self, ConnectionEvent, DialAddresses, EventKind, LastReceived, Mode, ReaderConfig, SharedMode},
    listener,
    peer::Store,
    peer_session::answers_max,
    qos,
    spin::Spin,
    task::{self, Relocation, TaskThread},
};
use crate::State;
use authentication::NOT_AUTHENTICATED;
pub use leaving::LINGER;
use timer::CoreTimer;
use wire::{Linked, Wire};

/// GNCL's actor.
pub struct Gncl {
    state: Arc<State>,
    ready: Option<ReadyGate>,
    core: Core,
    wires: BTreeMap<ConnectionId, Wire>,
    /// Events of the connections.
    connection_events: ConnectionEvents<ConnectionEvent>,
    spin: Arc<Spin>,
    /// Authentication of peers; `None` if it is disabled.
    authenticator: Option<Arc<Authenticator>>,
    timer: Rc<CoreTimer>,
    /// Time at which the layer ends even if peers are still connected; set once the node is being stopped.
    leave_deadline: Option<Time>,
    /// Reasons given by linked peers that sent GOODBYE and are not yet reported as having left; at most one per peer.
    leave_reasons: BTreeMap<NodeAddress, LeaveReason>,
}

impl Gncl {
    /// Creates GNCL for the node of these state. `ready` opens when it listens.
    pub fn new(state: Arc<State>, ready: ReadyGate) -> Self {
        let seed = Time::now().as_nanos() ^ u64::from(state.ctx.node.bits());
        let has_keys = state.security.secured.get().is_some();
        let settings = settings(&state.ctx.config, state.ctx.node, state.ctx.incarnation, has_keys);
        let core = Core::new(settings, seed);
        let spin = Arc::new(Spin::new(state.ctx.config.gncl.spin));
        Self {
            state,
            ready: Some(ready),
            core,
            wires: BTreeMap::new(),
            connection_events: ConnectionEvents::default(),
            spin,
            authenticator: None,
            timer: Rc::default(),
            leave_deadline: None,
            leave_reasons: BTreeMap::new(),
        }
    }

    /// Whether the node is being stopped.
    pub(super) fn is_to_stop(&self) -> bool {
        // SYNC: Relaxed; the stop order passed the supervisor's lock after the flag was set.
        self.state.ctx.stopping.load(Ordering::Relaxed)
    }

    fn input(&mut self, input: Input, ctx: &mut Context<Self>) {
        self.report_receive_times(&input);
        self.core.handle(Time::now(), input);
        while let Some(output) = self.core.poll() {
            self.execute(output, ctx);
        }
        if let Some(at) = self.core.next_wake() {
            self.timer.set(at);
        }
    }

    /// Reports to the core when messages were last received, before an input that depends on it: the passing
    /// of time, or a liveness frame. Only the affected connections are reported, and not with each message.
    fn report_receive_times(&mut self, before: &Input) {
        let Self { core, wires, .. } = self;
        let mut report = |connection: ConnectionId, wire: &mut Wire| {
            if let Some(at) = wire.take_last_received() {
                core.handle(at, Input::FramesReceived(connection, at));
            }
        };
        if matches!(before, Input::TimePassed) {
            wires.iter_mut().for_each(|(connection, wire)| report(*connection, wire));
        } else if let Input::PingReceived(connection) | Input::PongReceived(connection) = before
            && let Some(wire) = wires.get_mut(connection)
        {
            report(*connection, wire);
        }
    }

    fn execute(&mut self, output: Output, ctx: &mut Context<Self>) {
        match output {
            Output::Dial { connection, address } => self.dial(connection, address),
            Output::SendHello(connection, hello) => self.send_hello(connection, &hello, ctx),
            Output::Attach(attach) => self.attach(&attach),
            Output::Detach { connection, node, .. } => self.detach(connection, node),
            Output::Refuse(connection, refusal) => self.refuse(connection, &refusal, ctx),
            Output::Close(connection) => self.close(connection, ctx),
            Output::SendPing(node, lane) => self.send(node, lane, Kind::GNCL_PING),
            Output::SendPong(node, lane) => self.send(node, lane, Kind::GNCL_PONG),
            Output::SendGoodbye(node) => self.send_goodbye(node),
            Output::Forget(node) => {
                self.state.ctx.router.remove_peer(node);
                if let Some(left) = self.state.store.peer(node).filter(|peer| peer.has_left()) {
                    self.state.ctx.clocks.forget(node, left.incarnation);
                }
                self.state.store.forget(node);
                self.state.store.segments.forget(node);
            }
            Output::Fact(fact) => self.push_fact(fact),
            Output::Silent(node) => self.on_silence(node),
            Output::Count { cause, detail } => self.state.store.refusals.count(Time::now(), cause, &detail),
        }
    }

    fn dial(&mut self, connection: ConnectionId, address: SocketAddr) {
        let mode = Arc::new(Mutex::new(Mode::Handshake));
        let reading = self.reading(&mode);
        let addresses = DialAddresses::select(address, &self.own_paths());
        let node = self.core.node_dialled(connection);
        let segment_max = node.and_then(|node| self.state.store.segments.limit(node));
        let addresses = DialAddresses { segment_max, ..addresses };
        let shared = (mode, reading.last_received.clone());
        let reader = self.connection_events.add(link::dial(connection, addresses, reading));
        self.wires.insert(connection, Wire::new(None, shared, reader, self.authenticator.is_none()));
    }

    fn reading(&self, mode: &SharedMode) -> ReaderConfig {
        let NodeConfig { payload_max, gncl, .. } = &self.state.ctx.config;
        let (payload_max, give_up) = (*payload_max, gncl.give_up);
        let (mode, last_received) = (mode.clone(), LastReceived::default());
        ReaderConfig { mode, last_received, payload_max, give_up, authenticator: self.authenticator.clone() }
    }

    fn attach(&mut self, attach: &Attach) {
        let Attach { connection, node, lane, .. } = *attach;
        self.confirm(attach);
        let welcome = attach.welcome.clone().map(|introduction| {
            let introduction = Introduction { datagrams_made: self.datagrams_made(), ..introduction };
            frame(self.state.ctx.node, node, Kind::GNCL_WELCOME, write(&introduction))
        });
        let Some(wire) = self.wires.get_mut(&connection) else { return };
        let Some(transport) = wire.transport.clone() else { return };
        let peer = self.state.store.get_or_create(Time::now(), attach, &self.state);
        let Some(session) = peer.session(lane) else { return };
        if attach.by_class && self.state.ctx.config.gncl.marks {
            qos::mark(transport.socket(), lane);
        }
        let payload_max = usize::try_from(attach.payload_max).unwrap_or(usize::MAX);
        let Relocation { thread, transport } = match self.state.store.relocate(lane, transport.clone()) {
            Ok(there) => there,
            Err(error) => {
                // The connection's reader finds the end, without regard to bytes behind the peer's WELCOME,
                // and the core dials again.
                wire.set_mode(Mode::Discard);
                transport.shut(Shutdown::Both);
                if listener::is_starved(&error) {
                    // The outputs of this input are executed after the current one.
                    self.core.handle(Time::now(), Input::Starved);
                }
                return;
            }
        };
        wire.transport = Some(transport.clone());
        let checksum = attach.checksum();
        let link = session.outlet.connect(Gathering::new(transport.clone(), checksum), payload_max, welcome);
        session.attach(link);
        let spin = if thread.is_io() { self.spin.clone() } else { Arc::default() };
        let (state, peer_there, met) = (self.state.clone(), peer.clone(), peer.clone());
        let (outcomes, conversion, former) = (RefCell::default(), Cell::default(), Cell::default());
        let inbound =
            Inbound { state, peer: peer_there, spin, lane, link, checksum, outcomes, conversion, former };
        // Before the first message is read: the types of a former incarnation do not count for this one.
        self.state.ctx.router.set_peer(node, peer.clone());
        wire.set_mode(Mode::Relocate(inbound, Relocation { thread: thread.clone(), transport }));
        let drain_thread = thread.clone();
        let drainer = thread.begin(async move {
            if let Some(session) = peer.session(lane) {
                session.outlet.drain_by_turns(link, || drain_thread.end_turn()).await;
            }
        });
        let drainer = stream::once(async move {
            task::end_of(drainer).await;
            ConnectionEvent { connection, kind: EventKind::Ended }
        });
        wire.link = Some(Linked::new(&met, lane, link, self.connection_events.add(drainer)));
        if lane == Lane::Stream {
            self.announce_datagrams(attach);
        }
    }

    fn detach(&mut self, connection: ConnectionId, node: NodeAddress) {
        let Some(wire) = self.wires.get_mut(&connection) else { return };
        // The drain task ends with the link.
        let Some(link) = wire.link.take() else { return };
        wire.may_write = link.disconnect();
        if let Some(peer) = self.state.store.peer(node) {
            peer.request_expiry_checks();
        }
    }

    fn close(&mut self, connection: ConnectionId, ctx: &mut Context<Self>) {
        let Some(wire) = self.wires.remove(&connection) else { return };
        // The reader task ends with the wire.
        for task in wire.tasks {
            ctx.cancel_future(task);
        }
        if let Some(transport) = wire.transport {
            transport.shut(Shutdown::Both);
        }
    }

    /// Processes a connection that ended by itself.
    fn ended(&mut self, connection: ConnectionId, ctx: &mut Context<Self>) {
        if self.wires.get_mut(&connection).is_some_and(|wire| std::mem::take(&mut wire.last_ack_pending)) {
            self.input(Input::GoodbyeReceived(connection), ctx);
        }
        self.input(Input::Ended(connection), ctx);
        self.close(connection, ctx);
    }

    /// Cuts all connections of a former instance of this layer, or of this one.
    fn cut_all(&self) {
        for peer in self.state.store.peers() {
            peer.cut();
        }
    }
}

/// Returns the core's settings for a node. `has_keys`: connections authenticate their peers.
pub fn settings(
    config: &NodeConfig,
    node: NodeAddress,
    incarnation: Incarnation,
    has_keys: bool,
) -> Settings {
    let NodeConfig { name, project, payload_max, gncl, ndl, .. } = config.clone();
    // Security protects connections only; a datagram would be sent unprotected.
    let datagrams = (gncl.datagrams && !has_keys).then_some(DATAGRAMS);
    let features = [CLASSES, CANCEL, GUARD, OUTCOMES, OUTCOME_RUNS, UNDELIVERED].into_iter().chain(datagrams);
    Settings {
        ours: Introduction {
            project,
            node,
            name,
            incarnation,
            peer: NodeAddress::HERE,
            dial: 0,
            payload_max: payload_max as u64,
            answers_max: answers_max(gncl.queue_capacity) as u64,
            features: features.map(str::to_owned).collect(),
            lane: Lane::Control,
            link: 0,
            datagrams_made: 0,
        },
        handshake: gncl.handshake,
        redial_min: gncl.redial_min,
        redial_max: gncl.redial_max,
        strangers_max: gncl.strangers_max,
        peers_max: ndl.nodes_max,
        ping_period: Duration::from_secs(1),
        idle_ping_delay: Duration::from_secs(10),
        pings_missed_max: 3,
        healthy: Duration::from_secs(5),
        orphan: Duration::from_secs(5),
        connections_authenticate: has_keys,
    }
}

/// Runs a task of the IO thread until the actor ends. If the task panics, the actor fails with it.
fn run_beside(ctx: &mut Context<Gncl>, task: impl Future<Output = ()> + Send + 'static) {
    let task = TaskThread::Io.begin(task);
    ctx.spawn(fut::wrap_future(async move {
        task::end_of(task).await;
    }));
}

impl Actor for Gncl {
    type Context = Context<Self>;

    fn started(&mut self, ctx: &mut Context<Self>) {
        let listeners = self
            .start_authentication()
            .and_then(|()| self.listen().map_err(|error| listener::why_not(&self.state.ctx.config, &error)));
        let listeners = match listeners {
            Ok(listeners) => listeners,
            Err(why) => return self.state.ctx.cannot_start(why),
        };
        self.watch_certificate_times(ctx);
        self.cut_all();
        ctx.add_stream(self.connection_events.stream());
        ctx.add_stream(self.timer.clone().events());
        self.report_cut_links();
        self.catch_up(ctx);
        let limiter = Rc::new(RefCell::new(AcceptLimiter::new(Time::now())));
        for listener in listeners {
            ctx.add_stream(listener::accepted(listener, self.state.ctx.config.gncl.give_up, limiter.clone()));
        }
        #[cfg(target_os = "linux")]
        self.watch_interfaces(ctx);
        self.watch_limits(ctx);
        ctx.add_stream(self.state.ctx.event_queues.gncl.attach_keeping(Clone::clone));
        ctx.spawn(fut::wrap_future(Store::serve_queues(self.state.clone())));
        ctx.spawn(fut::wrap_future(link_notifications::offer_later(self.state.clone())));
        let spin = self.spin.clone();
        ctx.spawn(fut::wrap_future(async move { spin.keep_awake().await }));
        // Tasks of their own: a datagram, or the time of one, wakes one of them, and not the other futures of
        // this actor.
        run_beside(ctx, datagram_reader::read_all(self.state.clone(), self.spin.clone()));
        run_beside(ctx, datagram_reader::keep_time(self.state.clone()));
        ctx.spawn(fut::wrap_future(Store::run_expiry_checks(self.state.clone())));
        ctx.spawn(fut::wrap_future(Store::run_late_acknowledgements(self.state.clone())));
        if let Some(ready) = self.ready.take() {
            ready.reached();
        }
    }

    fn stopping(&mut self, ctx: &mut Self::Context) -> Running {
        if !self.is_to_stop() {
            return Running::Stop;
        }
        let now = Time::now();
        if self.leave_deadline.is_none() {
            self.leave(now, ctx);
        }
        if !self.may_end(now) {
            return Running::Continue;
        }
        self.abandon_undelivered();
        Running::Stop
    }
}

impl Drop for Gncl {
    /// Disconnects the links, because senders must not write to the sockets of an ended actor. An actor that
    /// hung and resumes leaves its successor's links alone.
    fn drop(&mut self) {
        for link in self.wires.values().filter_map(|wire| wire.link.as_ref()) {
            link.disconnect();
        }
    }
}

impl StreamHandler<ConnectionEvent> for Gncl {
    fn handle(&mut self, event: ConnectionEvent, ctx: &mut Context<Self>) {
        let connection = event.connection;
        match event.kind {
            EventKind::Connected(transport, peer) => {
                self.authenticated(connection, transport, peer.as_deref());
                self.input(Input::Connected(connection), ctx);
            }
            EventKind::Authenticated(transport, peer) => {
                self.authenticated(connection, transport, Some(&*peer))
            }
            EventKind::AuthFailed(why) => self.auth_failed(connection, &why, ctx),
            EventKind::DialFailed(error) => {
                sinew_runtime::log::debug!(%error, "dial failed");
                if listener::is_starved(&error) {
                    self.input(Input::Starved, ctx);
                }
                if let Some((node, address)) = self.core.dialled(connection) {
                    self.state.store.link_status.dial_failed(Time::now(), node, address, &error);
                }
                if error.kind() == io::ErrorKind::InvalidData {
                    self.state.store.refusals.count(Time::now(), NOT_AUTHENTICATED, &error);
                }
                let refused = error.kind() == io::ErrorKind::ConnectionRefused;
                self.input(Input::DialFailed { connection, refused }, ctx);
                self.close(connection, ctx);
            }
            EventKind::Frame(message) => self.on_frame(connection, &message, ctx),
            EventKind::TrafficSeen => self.input(Input::TrafficSeen(connection), ctx),
            EventKind::Violated(decline) => self.input(Input::Violated(connection, decline), ctx),
            EventKind::Ended => self.ended(connection, ctx),
        }
    }

    /// The end of one connection does not end the layer.
    fn finished(&mut self, _: &mut Context<Self>) {}
}
