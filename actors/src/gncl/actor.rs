//! The shell: sockets and timers for the core's orders, events for what they do.

mod accepting;
mod by_datagram;
mod leaving;
#[cfg(target_os = "linux")]
mod long_segments;
mod lost_addresses;
mod membership;
mod proven;
mod wire;

use std::{
    cell::RefCell,
    collections::BTreeMap,
    io,
    net::{Shutdown, SocketAddr},
    rc::Rc,
    sync::{Arc, Mutex, atomic::Ordering},
    time::Duration,
};

use actix::{Actor, AsyncContext, Context, Running, SpawnHandle, StreamHandler, fut};
use futures_util::stream;
use sinew_runtime::{
    supervision::ReadyGate,
    tid::NodeAddress,
    time::Time,
    wire::{Kind, Message},
};

use super::{
    LinkFact,
    core::{
        Attach, CANCEL, CLASSES, ConnectionId, Core, DATAGRAMS, Decline, GUARD, Input, Introduction, Lane,
        OUTCOMES, Output, Refusal, Settings, UNDELIVERED, read, write,
    },
    crowd::Crowd,
    datagrams,
    inbound::Inbound,
    link::{self, Ends, Heard, Mode, News, Reading, SharedMode, What},
    listener, marks,
    peer::{Store, frame},
    secure::Secure,
    spin::Spin,
    task::{self, Move},
    way::answers_max,
};
use crate::{
    accept_pace::Pace,
    config::NodeConfig,
    last_words::LastWords,
    outlet::Gathering,
    stores::{Stores, lock},
};
pub(crate) use leaving::LINGER;
use proven::NOT_PROVEN;
use wire::{Linked, Wire};

/// Time until a layer whose post was full is offered again what it had no room for.
const RETRY: Duration = Duration::from_millis(10);

/// GNCL's actor.
pub(crate) struct Gncl {
    stores: Arc<Stores>,
    ready: Option<ReadyGate>,
    core: Core,
    wires: BTreeMap<ConnectionId, Wire>,
    /// What they have to say.
    crowd: Crowd<News>,
    spin: Arc<Spin>,
    /// How peers prove who they are; `None`: they do not.
    secure: Option<Arc<Secure>>,
    alarm: Option<(Time, SpawnHandle)>,
    /// A layer is to be told again what it had no room for.
    tells_again: bool,
    /// When it goes, whoever has not hung up; set once the node is being stopped.
    goes_at: Option<Time>,
    /// Why linked peers gave up that have said goodbye and are not told to have left yet; one for each peer at most.
    last_words: BTreeMap<NodeAddress, LastWords>,
}

impl Gncl {
    /// GNCL for the node whose stores these are. `ready` opens when it listens.
    pub(crate) fn new(stores: Arc<Stores>, ready: ReadyGate) -> Self {
        let seed = Time::now().as_nanos() ^ u64::from(stores.node.bits());
        let core = Core::new(settings(&stores), seed);
        let spin = Arc::new(Spin::new(stores.config.gncl.spin));
        Self {
            stores,
            ready: Some(ready),
            core,
            wires: BTreeMap::new(),
            crowd: Crowd::default(),
            spin,
            secure: None,
            alarm: None,
            tells_again: false,
            goes_at: None,
            last_words: BTreeMap::new(),
        }
    }

    /// Whether the node is being stopped.
    pub(super) fn is_to_stop(&self) -> bool {
        // SYNC: Relaxed; the order to stop came through the supervisor's lock, after the flag was set.
        self.stores.stopping.load(Ordering::Relaxed)
    }

    fn input(&mut self, input: Input, ctx: &mut Context<Self>) {
        self.say_who_was_heard(&input);
        self.core.handle(Time::now(), input);
        while let Some(output) = self.core.poll() {
            self.obey(output, ctx);
        }
        self.set_alarm(ctx);
    }

    /// What follows from the time, or from a sign of life, depends on when messages came: the core is told so before, of whomever it is about,
    /// and not with each message.
    fn say_who_was_heard(&mut self, before: &Input) {
        let Self { core, wires, .. } = self;
        let mut say = |connection: ConnectionId, wire: &mut Wire| {
            if let Some(at) = wire.heard() {
                core.handle(at, Input::Heard(connection, at));
            }
        };
        if matches!(before, Input::TimePassed) {
            wires.iter_mut().for_each(|(connection, wire)| say(*connection, wire));
        } else if let Input::PingReceived(connection) | Input::PongReceived(connection) = before
            && let Some(wire) = wires.get_mut(connection)
        {
            say(*connection, wire);
        }
    }

    fn set_alarm(&mut self, ctx: &mut Context<Self>) {
        let Some(at) = self.core.next_wake() else { return };
        match self.alarm {
            Some((set, _)) if set <= at => return,
            Some((_, handle)) => drop(ctx.cancel_future(handle)),
            None => {}
        }
        let handle = ctx.run_later(at.since(Time::now()), |actor, ctx| {
            actor.alarm = None;
            actor.input(Input::TimePassed, ctx);
        });
        self.alarm = Some((at, handle));
    }

    fn obey(&mut self, output: Output, ctx: &mut Context<Self>) {
        match output {
            Output::Dial { connection, address } => self.dial(connection, address),
            Output::SendHello(connection, hello) => self.send_hello(connection, &hello, ctx),
            Output::Attach(attach) => self.attach(&attach),
            Output::Detach { connection, node, .. } => self.detach(connection, node),
            Output::Refuse(connection, refusal) => self.refuse(connection, &refusal, ctx),
            Output::Close(connection) => self.close(connection, ctx),
            Output::SendPing(node, lane) => self.send(node, lane, Kind::GNCL_PING),
            Output::SendPong(node, lane) => self.send(node, lane, Kind::GNCL_PONG),
            Output::SendGoodbye(node) => self.say_goodbye(node),
            Output::Forget(node) => {
                self.stores.router.remove_peer(node);
                if let Some(left) = self.stores.gncl.peer(node).filter(|peer| peer.has_left()) {
                    self.stores.clocks.forget(node, left.incarnation);
                }
                self.stores.gncl.forget(node);
                self.stores.gncl.segments.forget(node);
            }
            Output::Fact(fact) => self.tell(fact, ctx),
            Output::Silent(node) => self.is_silent(node),
            Output::Count { cause, detail } => self.stores.gncl.refusals.count(Time::now(), cause, &detail),
        }
    }

    fn dial(&mut self, connection: ConnectionId, address: SocketAddr) {
        let mode = Arc::new(Mutex::new(Mode::Handshake));
        let reading = self.reading(&mode);
        let ends = Ends::of(address, lock(&self.stores.ndl).paths());
        let node = self.core.node_dialled(connection);
        let segment_max = node.and_then(|node| self.stores.gncl.segments.limit(node));
        let ends = Ends { segment_max, ..ends };
        let shared = (mode, reading.heard.clone());
        let reader = self.crowd.join(link::dial(connection, ends, reading));
        self.wires.insert(connection, Wire::new(None, shared, reader, self.secure.is_none()));
    }

    fn reading(&self, mode: &SharedMode) -> Reading {
        let NodeConfig { payload_max, gncl, .. } = &self.stores.config;
        let (payload_max, give_up) = (*payload_max, gncl.give_up);
        let (mode, heard) = (mode.clone(), Heard::default());
        Reading { mode, heard, payload_max, give_up, secure: self.secure.clone() }
    }

    fn send_hello(&mut self, connection: ConnectionId, hello: &Introduction, ctx: &mut Context<Self>) {
        let hello = Introduction { datagrams_made: self.datagrams_made(), ..hello.clone() };
        let message = frame(self.stores.node, hello.peer, Kind::GNCL_HELLO, write(&hello));
        self.speak(connection, message, AfterSpeaking::Listen, ctx);
    }

    fn refuse(&mut self, connection: ConnectionId, refusal: &Refusal, ctx: &mut Context<Self>) {
        let message = frame(self.stores.node, NodeAddress::HERE, Kind::GNCL_REFUSAL, write(refusal));
        if let Some(wire) = self.wires.get(&connection) {
            wire.set_mode(Mode::Discard);
        }
        self.speak(connection, message, AfterSpeaking::Hush, ctx);
    }

    /// Writes a frame on a connection that is not a link.
    fn speak(
        &mut self,
        connection: ConnectionId,
        words: Message,
        then: AfterSpeaking,
        ctx: &mut Context<Self>,
    ) {
        let Some(wire) = self.wires.get_mut(&connection) else { return };
        let (Some(transport), may_speak) = (wire.transport.clone(), wire.may_speak) else { return };
        let task = async move {
            if may_speak && link::write_frame(transport.clone(), &words).await.is_err() {
                // The reader meets the same error, and tells the core.
                return;
            }
            if then == AfterSpeaking::Hush {
                transport.shut(Shutdown::Write);
            }
        };
        wire.tasks.push(ctx.spawn(fut::wrap_future(task)));
    }

    fn attach(&mut self, attach: &Attach) {
        let Attach { connection, node, lane, .. } = *attach;
        self.confirm(attach);
        let welcome = attach.welcome.clone().map(|words| {
            let words = Introduction { datagrams_made: self.datagrams_made(), ..words };
            frame(self.stores.node, node, Kind::GNCL_WELCOME, write(&words))
        });
        let Some(wire) = self.wires.get_mut(&connection) else { return };
        let Some(transport) = wire.transport.clone() else { return };
        let peer = self.stores.gncl.meet(Time::now(), attach, &self.stores);
        let Some(way) = peer.way(lane) else { return };
        if attach.by_class && self.stores.config.gncl.marks {
            marks::mark(transport.socket(), lane);
        }
        let payload_max = usize::try_from(attach.payload_max).unwrap_or(usize::MAX);
        let Move { place, transport } = match self.stores.gncl.place(lane, transport.clone()) {
            Ok(there) => there,
            Err(error) => {
                // Its reader meets the end, whatever the peer has sent behind its welcome, and the core makes another one.
                wire.set_mode(Mode::Discard);
                transport.shut(Shutdown::Both);
                if listener::is_starved(&error) {
                    // What that has done is done when this is.
                    self.core.handle(Time::now(), Input::Starved);
                }
                return;
            }
        };
        wire.transport = Some(transport.clone());
        let checksum = attach.checksum();
        let link = way.outlet.connect(Gathering::new(transport.clone(), checksum), payload_max, welcome);
        way.attach(link);
        let spin = if place.is_here() { self.spin.clone() } else { Arc::default() };
        let (stores, peer_there, met) = (self.stores.clone(), peer.clone(), peer.clone());
        let outcomes = RefCell::default();
        let inbound = Inbound { stores, peer: peer_there, spin, lane, link, checksum, outcomes };
        wire.set_mode(Mode::Moves(inbound, Move { place: place.clone(), transport }));
        self.stores.router.set_peer(node, peer.clone());
        let there = place.clone();
        let drainer = place.begin(async move {
            if let Some(way) = peer.way(lane) {
                way.outlet.drain_by_turns(link, || there.end_turn()).await;
            }
        });
        let drainer = stream::once(async move {
            task::end_of(drainer).await;
            News { connection, what: What::Ended }
        });
        wire.link = Some(Linked::new(&met, lane, link, self.crowd.join(drainer)));
        if lane == Lane::Stream {
            self.announce_datagrams(attach);
        }
    }

    fn detach(&mut self, connection: ConnectionId, node: NodeAddress) {
        let Some(wire) = self.wires.get_mut(&connection) else { return };
        // The drainer goes with it.
        let Some(link) = wire.link.take() else { return };
        wire.may_speak = link.disconnect();
        if let Some(peer) = self.stores.gncl.peer(node) {
            peer.holds_what_may_expire();
        }
    }

    fn close(&mut self, connection: ConnectionId, ctx: &mut Context<Self>) {
        let Some(wire) = self.wires.remove(&connection) else { return };
        // Its reader goes with it.
        for task in wire.tasks {
            ctx.cancel_future(task);
        }
        if let Some(transport) = wire.transport {
            transport.shut(Shutdown::Both);
        }
    }

    /// The connection has ended by itself.
    fn ended(&mut self, connection: ConnectionId, ctx: &mut Context<Self>) {
        if self.wires.get_mut(&connection).is_some_and(|wire| std::mem::take(&mut wire.owes_the_last)) {
            self.input(Input::GoodbyeReceived(connection), ctx);
        }
        self.input(Input::Ended(connection), ctx);
        self.close(connection, ctx);
    }

    fn send(&self, node: NodeAddress, lane: Lane, kind: Kind) {
        if let Some(way) = self.stores.gncl.peer(node).as_ref().and_then(|peer| peer.way(lane)) {
            way.say(frame(self.stores.node, node, kind, bytes::Bytes::new()));
        }
    }

    fn tell(&mut self, mut fact: LinkFact, ctx: &mut Context<Self>) {
        match &mut fact {
            LinkFact::PeerLeft { node, gave_up, .. } => *gave_up = self.last_words.remove(node),
            LinkFact::LinkBroken { node, .. } => _ = self.last_words.remove(node),
            LinkFact::LinkUp { .. } | LinkFact::DialRefused { .. } => {}
        }
        let (LinkFact::LinkUp { node, .. }
        | LinkFact::LinkBroken { node, .. }
        | LinkFact::DialRefused { node, .. }
        | LinkFact::PeerLeft { node, .. }) = &fact;
        if let Some(suppressed) = self.stores.log_quotas.links.take(node, Time::now()) {
            crate::log::debug!(?fact, suppressed, "link");
        }
        self.stores.gncl.notes.fact(Time::now(), &fact);
        if let LinkFact::PeerLeft { node, incarnation, .. } = fact {
            self.stores.gncl.leaves(Time::now(), node, incarnation);
        }
        self.stores.untold_of_links.note(fact);
        self.tell_the_rest(ctx);
    }

    /// Tells other layers what they have not been told yet, until they have room for all of it.
    fn tell_the_rest(&mut self, ctx: &mut Context<Self>) {
        let Some(layer) = self.stores.untold_of_links.offer(&self.stores.posts) else { return };
        let what = format_args!("{layer} does not read its events: it is told later which links stand");
        self.stores.gncl.refusals.count(Time::now(), "a layer's post is full", &what);
        if !self.tells_again {
            self.tells_again = true;
            ctx.run_later(RETRY, |actor, ctx| {
                actor.tells_again = false;
                actor.tell_the_rest(ctx);
            });
        }
    }

    fn frame_came(&mut self, connection: ConnectionId, message: &Message, ctx: &mut Context<Self>) {
        let input =
            self.input_of(connection, message).unwrap_or_else(|decline| Input::Violated(connection, decline));
        if !matches!(input, Input::Violated(..) | Input::PingReceived(_) | Input::PongReceived(_)) {
            self.input(Input::Heard(connection, Time::now()), ctx);
            self.peer_speaks(message.header.source.node);
        }
        if matches!(input, Input::GoodbyeReceived(_)) {
            return self.goodbye_came(connection, ctx);
        }
        self.input(input, ctx);
    }

    fn input_of(&mut self, connection: ConnectionId, message: &Message) -> Result<Input, Decline> {
        let mut introduction = || -> Result<Introduction, Decline> {
            let introduction: Introduction = read(&message.payload)?;
            if introduction.node != message.header.source.node {
                let what = "the source of this frame is another node than its sender says";
                return Err(Decline::Violation(what.to_owned()));
            }
            self.introduces_itself(connection, &introduction)?;
            Ok(introduction)
        };
        match message.header.kind {
            Kind::GNCL_HELLO => Ok(Input::HelloReceived(connection, introduction()?)),
            Kind::GNCL_WELCOME => Ok(Input::WelcomeReceived(connection, introduction()?)),
            Kind::GNCL_REFUSAL => Ok(Input::RefusalReceived(connection, read(&message.payload)?)),
            Kind::GNCL_PING => Ok(Input::PingReceived(connection)),
            Kind::GNCL_PONG => Ok(Input::PongReceived(connection)),
            Kind::GNCL_GOODBYE => {
                self.note_last_words(message.header.source.node, &message.payload)?;
                Ok(Input::GoodbyeReceived(connection))
            }
            kind => {
                Err(Decline::Violation(format!("a frame of kind {kind} came before the handshake was over")))
            }
        }
    }

    /// Cuts what a former instance of this layer, or this one, has connected.
    fn cut_all(&self) {
        for peer in self.stores.gncl.peers() {
            peer.cut();
        }
    }

    /// What a former instance has connected is down.
    fn tell_what_was_cut(&mut self, ctx: &mut Context<Self>) {
        let peers = self.stores.gncl.peers();
        let broken =
            peers.iter().map(|peer| LinkFact::LinkBroken { node: peer.node, incarnation: peer.incarnation });
        self.stores.untold_of_links.links_are_cut(broken);
        self.tell_the_rest(ctx);
    }
}

/// What follows a frame that is written on a connection that is not a link.
#[derive(Clone, Copy, PartialEq, Eq)]
enum AfterSpeaking {
    Listen,
    Hush,
}

fn settings(stores: &Stores) -> Settings {
    let NodeConfig { name, project, payload_max, gncl, ndl, .. } = stores.config.clone();
    // What is sealed is a connection: a datagram would go as it is.
    let datagrams = (gncl.datagrams && stores.secured.get().is_none()).then_some(DATAGRAMS);
    let features = [CLASSES, CANCEL, GUARD, OUTCOMES, UNDELIVERED].into_iter().chain(datagrams);
    Settings {
        ours: Introduction {
            project,
            node: stores.node,
            name,
            incarnation: stores.incarnation,
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
        side_rest: Duration::from_secs(10),
        pings_missed_max: 3,
        healthy: Duration::from_secs(5),
        orphan: Duration::from_secs(5),
        connections_prove: stores.secured.get().is_some(),
    }
}

impl Actor for Gncl {
    type Context = Context<Self>;

    fn started(&mut self, ctx: &mut Context<Self>) {
        self.begin_to_prove();
        self.mind_the_times(ctx);
        let listeners = self
            .listen()
            .unwrap_or_else(|error| panic!("{}", listener::why_not(&self.stores.config, &error)));
        self.cut_all();
        ctx.add_stream(self.crowd.news());
        self.tell_what_was_cut(ctx);
        self.catch_up(ctx);
        let pace = Rc::new(RefCell::new(Pace::new(Time::now())));
        for listener in listeners {
            ctx.add_stream(listener::accepted(listener, self.stores.config.gncl.give_up, pace.clone()));
        }
        #[cfg(target_os = "linux")]
        self.watch_interfaces(ctx);
        self.watch_limits(ctx);
        ctx.add_stream(self.stores.posts.gncl.attach_keeping(Clone::clone));
        ctx.spawn(fut::wrap_future(Store::serve_those_held_up(self.stores.clone())));
        let spin = self.spin.clone();
        ctx.spawn(fut::wrap_future(async move { spin.keep_awake().await }));
        ctx.spawn(fut::wrap_future(datagrams::read_all(self.stores.clone(), self.spin.clone())));
        ctx.spawn(fut::wrap_future(datagrams::keep_time(self.stores.clone())));
        ctx.spawn(fut::wrap_future(Store::look_for_expired(self.stores.clone())));
        ctx.spawn(fut::wrap_future(Store::acknowledge_late(self.stores.clone())));
        if let Some(ready) = self.ready.take() {
            ready.reached();
        }
    }

    fn stopping(&mut self, ctx: &mut Self::Context) -> Running {
        if !self.is_to_stop() {
            return Running::Stop;
        }
        let now = Time::now();
        if self.goes_at.is_none() {
            self.leave(now, ctx);
        }
        if !self.may_go(now) {
            return Running::Continue;
        }
        self.give_up();
        Running::Stop
    }
}

impl Drop for Gncl {
    /// Senders must not go on writing to the sockets of an actor that is gone. One that hung, and comes back, leaves those of its successor alone.
    fn drop(&mut self) {
        for link in self.wires.values().filter_map(|wire| wire.link.as_ref()) {
            link.disconnect();
        }
    }
}

impl StreamHandler<News> for Gncl {
    fn handle(&mut self, news: News, ctx: &mut Context<Self>) {
        let connection = news.connection;
        match news.what {
            What::Connected(transport, peer) => {
                self.proven(connection, transport, peer.as_deref());
                self.input(Input::Connected(connection), ctx);
            }
            What::Proven(transport, peer) => self.proven(connection, transport, Some(&*peer)),
            What::Unproven(why) => self.unproven(connection, &why, ctx),
            What::DialFailed(error) => {
                crate::log::debug!(%error, "dial failed");
                if listener::is_starved(&error) {
                    self.input(Input::Starved, ctx);
                }
                if let Some((node, address)) = self.core.dialled(connection) {
                    self.stores.gncl.notes.dial_failed(Time::now(), node, address, &error);
                }
                if error.kind() == io::ErrorKind::InvalidData {
                    self.stores.gncl.refusals.count(Time::now(), NOT_PROVEN, &error);
                }
                let refused = error.kind() == io::ErrorKind::ConnectionRefused;
                self.input(Input::DialFailed { connection, refused }, ctx);
                self.close(connection, ctx);
            }
            What::Frame(message) => self.frame_came(connection, &message, ctx),
            What::Carried => self.input(Input::Carried(connection), ctx),
            What::Violated(decline) => self.input(Input::Violated(connection, decline), ctx),
            What::Ended => self.ended(connection, ctx),
        }
    }

    /// One connection's end is not the layer's.
    fn finished(&mut self, _: &mut Context<Self>) {}
}
