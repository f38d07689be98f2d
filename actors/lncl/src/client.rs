//! One connection of another process, from its first frame to its end.

mod barrier;
mod end;
mod introduction;
mod memberships;
mod orders;
mod outcomes;
mod sink;
mod writing;

use std::{
    future::{pending, poll_fn},
    io,
    ops::ControlFlow,
    pin::pin,
    rc::Rc,
    sync::Arc,
    time::Duration,
};

use rustix::net::Shutdown;
use sinew_model::{cause::Cause, facts::User};
use sinew_protocol::payload::{self, REGISTER_BYTES_MAX, Register, Registered};
use sinew_runtime::{
    lock,
    monitor::DownClass,
    router::{LocalRoute, MessageSink, Reach},
    tid::Tid,
    time::Time,
    wire::{Kind, Message},
};
use sinew_security::access::Applicant;
use sinew_session::{
    book::ClientId,
    outlet::{LinkNumber, OutletLimits, PeerReadHalf, SocketWriter},
};
use sinew_shm::Capacity;
use tokio::net::{UnixStream, unix::UCred};

use self::{
    end::{ConnectionEnd, REFUSAL_TIMEOUT},
    memberships::Orders,
    outcomes::Outcomes,
    sink::ClientSink,
    writing::{encoded, write_soon},
};
use super::{
    command::{CommandPort, HandOver},
    core::{Address, Owner, Request},
    guest_reads::Sent,
    link::{self, ClientReader, ClientSocket, RingHalf},
    link_broker::{Departure, LinkPeer},
    process_watch::ProcessWatch,
    reader::{Reader, Received},
    registrar,
    server::{Server, refuse, send_refusal},
    session::Session,
    unauthenticated::Slot,
};
use crate::State;

/// Deadline of the first frame, and of each step of the handshake.
const HANDSHAKE: Duration = Duration::from_secs(2);

/// The writing half of a client's connection.
pub(super) type ClientOutlet = SocketWriter<ClientSocket>;

/// Serves one connection to its end.
pub(super) async fn serve(
    server: Rc<Server>,
    stream: Arc<UnixStream>,
    credentials: UCred,
    id: ClientId,
    place: Slot,
) {
    let mut reader = Reader::new(REGISTER_BYTES_MAX);
    let mut session = Session::default();
    // spec: LNCL-1
    let register = match tokio::time::timeout(
        HANDSHAKE,
        introduction::receive(&mut reader, &stream, &mut session),
    )
    .await
    {
        Ok(Ok(Some(register))) => {
            drop(place);
            register
        }
        // A connection that only probes the socket closes it without a frame.
        Ok(Ok(None)) => return,
        Ok(Err(why)) => return refuse(&server, &stream, "bad first frame", &why),
        Err(_) => {
            let why = format!("no frame came within {HANDSHAKE:?}; the first must be LNCL_REGISTER");
            return refuse(&server, &stream, "silent stranger", &why);
        }
    };
    let pid = credentials.pid().unwrap_or_default();
    let applicant = Applicant { uid: credentials.uid(), gid: credentials.gid() };
    let peer = Peer { stream: stream.clone(), id, pid, applicant };
    let owner = peer.owner();
    let mut client = match Client::register(server.clone(), peer, register) {
        Ok(client) => client,
        Err(why) => {
            // A refused client knows its identity; a reader of the log does not.
            let both = format!("of {owner}: {why}");
            server.refusals.count(Time::now(), "registration", &both);
            return send_refusal(&server, &stream, &why);
        }
    };
    session.registered(client.tid);
    let end = client.live(reader, &mut session).await;
    client.finish(end).await;
}

/// The other end of a connection.
struct Peer {
    stream: Arc<UnixStream>,
    id: ClientId,
    /// As the kernel reports it; 0 if it does not.
    pid: i32,
    /// As the kernel reports it.
    applicant: Applicant,
}

impl Peer {
    const fn owner(&self) -> Owner {
        Owner::Client { id: self.id, pid: self.pid }
    }
}

/// Ring state of a connection.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Ring {
    None,
    /// The client supports rings.
    Supported,
    /// The client was notified of its rings. The socket carries only descriptors, and the final refusal.
    Announced,
}

/// A registered connection. Dropping it removes the registration, at the end of the peer's process, of this task, or of
/// LNCL.
struct Client {
    server: Rc<Server>,
    peer: Peer,
    outlet: Arc<ClientOutlet>,
    outcomes: Arc<Outcomes>,
    /// Its pending requests on its groups.
    orders: Orders,
    /// Its command, if the node has started its process for one.
    command: Option<Arc<CommandPort>>,
    /// Set while messages flow.
    link: Option<LinkNumber>,
    tid: Tid,
    /// User of the peer's process.
    user: User,
    name: String,
    /// Whether the client chose its name; otherwise the name is its address.
    is_named: bool,
    requires: Vec<String>,
    /// Whether the peer wants to be notified of the applications that it waits for.
    waits: bool,
    events: Arc<[Kind]>,
    /// Ring state.
    ring: Ring,
    /// Whether other clients may have links to it.
    wants_links: bool,
    /// The effect of its end on the peers of its links.
    departure: Departure,
    /// Whether the peer was notified why its connection ends.
    is_notified: bool,
    /// The cause of its end, as far as it is known.
    cause: Cause,
    /// Whether the client still reads its shared memory after the connection has ended here.
    peer_read_half: PeerReadHalf,
}

impl Client {
    fn register(server: Rc<Server>, peer: Peer, asked: Register) -> Result<Self, super::RegisterError> {
        let Register { name, address, requires, events, kinds, pid: _, direct, ring, former, waits } = asked;
        let (uid, own) = (peer.applicant.uid, rustix::process::geteuid().as_raw());
        // Other nodes may still call the new owner of the address by the name of the former one. spec: LNCL-5
        let access = server.state.security.access.get();
        let former =
            former.filter(|app| access.is_none_or(|access| access.has_held(*app, uid, name.as_deref())));
        let any = former.map_or(Address::Dynamic, Address::Former);
        if let Some(access) = server.state.security.access.get() {
            let allowed = access.may_register(own, peer.applicant, name.as_deref(), address);
            allowed.map_err(|why| super::RegisterError::NotAllowed(why.to_string()))?;
        }
        let address = address.map_or(any, Address::Fixed);
        let (owner, user) = (peer.owner(), User::of(uid, own));
        let request = Request { address, name, requires: requires.clone(), kinds, owner, user };
        let (called, from) = (request.name.clone(), (peer.id, peer.pid, &*peer.stream));
        let command = called.as_deref().and_then(|name| server.state.commands.named(name));
        let app = match &command {
            Some(port) => registrar::claim_command(&server.state, port, from, &request)?,
            None => registrar::register_client(&server.state, request)?,
        };
        if let Some(access) = server.state.security.access.get() {
            access.holds(app, uid, called.as_deref());
        }
        let tid = Tid::new(server.state.ctx.node, app);
        let name = lock(&server.state.registry).name_of(app);
        let outlet = Arc::new(SocketWriter::sharing(limits(&server.state), server.budget_of(peer.pid)));
        let outcomes = {
            let config = &server.state.ctx.config;
            Outcomes::new(outlet.clone(), config.mailbox_capacity, config.payload_max)
        };
        server.add_client(peer.id, outlet.clone());
        server.state.book.add_client(peer.id, app, &name, outlet.clone());
        if let Some(suppressed) = server.state.ctx.log_quotas.clients.take(&name, Time::now()) {
            let (suppressed, pid) = ((suppressed > 0).then_some(suppressed), peer.pid);
            // Each `sinew` command registers some without a name.
            if called.is_some() {
                sinew_runtime::log::info!(%tid, name, pid, suppressed, "an application of another process has registered");
            } else {
                sinew_runtime::log::debug!(%tid, pid, suppressed, "an application of another process has registered");
            }
        }
        let (link, events, is_notified) = (None, events.into(), false);
        let cause = Cause::new(DownClass::Killed, registrar::LNCL_ENDED);
        let ring = if ring { Ring::Supported } else { Ring::None };
        // All messages of a command pass the node, which keeps them when its process ends.
        let (wants_links, departure) = (direct && command.is_none(), Departure::LinksRemain);
        Ok(Self {
            server,
            peer,
            outlet,
            outcomes,
            orders: Orders::default(),
            command,
            link,
            tid,
            user,
            name,
            is_named: called.is_some(),
            requires,
            waits,
            events,
            ring,
            wants_links,
            departure,
            is_notified,
            cause,
            peer_read_half: PeerReadHalf::MayBeOpen,
        })
    }

    /// Serves the client until its connection or its process ends.
    async fn live(&mut self, mut reader: Reader, session: &mut Session) -> ConnectionEnd {
        let (process, stream) = (self.watch_process(), self.peer.stream.clone());
        let (command, id) = (self.command.clone(), self.peer.id);
        let served = async {
            match self.wait_at_barrier(&mut reader, session).await {
                Some(end) => end,
                None => self.run(reader, session).await,
            }
        };
        let mut served = Box::pin(served);
        let end = tokio::select! {
            end = &mut served => end,
            // spec: LNCL-15
            () = ended(&process, command.as_deref(), id) => {
                // A child of the process may hold the socket open, so it is shut down here. An error means that it
                // already was. Frames that the process sent before its end have arrived, and are still handled.
                let _ = rustix::net::shutdown(&stream, Shutdown::Both);
                let end = tokio::time::timeout(REFUSAL_TIMEOUT, served).await.unwrap_or(ConnectionEnd::HungUp(None));
                self.departure = Departure::ProcessEnded;
                return end;
            }
        };
        drop(served);
        if matches!(end, ConnectionEnd::HungUp(_)) {
            self.departure = Departure::HungUp(process);
        }
        end
    }

    /// Returns the watch on the client's process.
    fn watch_process(&self) -> ProcessWatch {
        ProcessWatch::behind(&*self.peer.stream, self.peer.pid).unwrap_or_else(|cause| {
            let detail = format!("{}, {}: {cause}", self.tid, self.peer.owner());
            self.server.refusals.count(Time::now(), "process cannot be watched", &detail);
            ProcessWatch::Unknown
        })
    }

    /// Opens the connection, and carries frames in both directions.
    async fn run(&mut self, reader: Reader, session: &mut Session) -> ConnectionEnd {
        // Messages sent from now on wait in the outlet, so any sender that knows of the registration can send to it.
        session.released(self.tid);
        if self.wants_links && self.ring == Ring::Supported {
            self.server.link_broker.expect(self.tid, self.pid());
        }
        let checks = self.server.state.ctx.checks.clone();
        let sink = Arc::new(ClientSink::new(self.outlet.clone(), checks));
        if self.command.is_none() {
            let route = LocalRoute { sink: sink.clone(), events: self.events.clone() };
            registrar::open(&self.server.state, self.tid.app, route);
        }
        let (mut reader, link) = match self.open_link(reader).await {
            Ok(opened) => opened,
            Err(end) => return end,
        };
        self.link = Some(link);
        if let Some(port) = &self.command {
            // Only now: a message that is handed over before the connection carries it would be lost with it.
            let queue: Arc<dyn HandOver> = sink;
            let to = (port, self.tid.app);
            registrar::open_command(&self.server.state, to, self.peer.id, (queue, self.events.clone()));
        }
        let receive = self.receive(&mut reader, session);
        tokio::pin!(receive);
        tokio::select! {
            end = &mut receive => end,
            // Frames that the client sent before its end have arrived, and are still handled.
            cause = self.drain(link) => {
                tokio::time::timeout(REFUSAL_TIMEOUT, receive).await.unwrap_or_else(|_| ConnectionEnd::of_write(cause))
            }
        }
    }

    /// Writes queued messages whenever the connection has room. Resolves when it cannot be written to any more.
    async fn drain(&self, link: LinkNumber) -> io::Error {
        let mut drain = pin!(self.outlet.drain(link));
        poll_fn(|cx| {
            let drained = drain.as_mut().poll(cx);
            if let Some(port) = &self.command {
                // There may be room now for messages that wait in the node.
                port.hand_over();
            }
            drained
        })
        .await
    }

    /// Notifies the client of its address, and agrees with it on the transport of messages.
    async fn open_link(&mut self, mut reader: Reader) -> Result<(ClientReader, LinkNumber), ConnectionEnd> {
        let config = &self.server.state.ctx.config;
        let payload_max = config.payload_max;
        let ring_bytes = config.lncl.ring_bytes;
        let ring = if self.ring == Ring::Supported { self.prepare(ring_bytes).await } else { None };
        let Some((capacity, half)) = ring else {
            reader.set_payload_max(payload_max);
            self.server.link_broker.expect_no_more(self.tid);
            let socket = ClientSocket::Plain(self.peer.stream.clone());
            let link = self.outlet.connect(socket, payload_max, Some(self.registered(None)));
            return Ok((ClientReader::Plain(reader), link));
        };
        // spec: LNCL-9
        write_soon(&self.peer.stream, encoded(&self.registered(Some(capacity.bytes())))).await?;
        self.ring = Ring::Announced;
        let exchange = link::exchange(half, &self.peer.stream, payload_max, self.server.rings());
        let (socket, reader, counters) = match tokio::time::timeout(HANDSHAKE, exchange).await {
            Ok(Ok(both)) => both,
            Ok(Err(why)) => return Err(why.into()),
            Err(_) => {
                return Err(ConnectionEnd::Late(format!(
                    "its rings were not there within {HANDSHAKE:?}: it was stopped or slow to offer its half, or this node was slow to map it"
                )));
            }
        };
        let link = self.outlet.connect(socket, payload_max, None);
        self.server.state.book.add_links(self.peer.id, Arc::new(counters));
        self.join_link_broker();
        Ok((reader, link))
    }

    /// Returns the node's half of the rings, or `None` for a plain socket.
    async fn prepare(&self, ring_bytes: usize) -> Option<(Capacity, RingHalf)> {
        let prepare = link::prepare(ring_bytes, &self.peer.stream, self.server.rings());
        tokio::time::timeout(HANDSHAKE, prepare).await.unwrap_or_else(|_| {
            let tid = self.tid;
            sinew_runtime::log::warn!(%tid, "no rings were made within {HANDSHAKE:?}; this client gets a plain socket");
            None
        })
    }

    /// Registers the client with the link broker: its socket can carry descriptors from now on.
    fn join_link_broker(&self) {
        if self.wants_links {
            let peer = LinkPeer::new(self.tid, self.pid(), self.outlet.clone(), self.peer.stream.clone());
            self.server.link_broker.add(peer);
            let state = &self.server.state;
            if state.observed_links.add(&state.ctx.router, self.tid) {
                state.ctx.checks.request();
            }
        }
    }

    fn pid(&self) -> u32 {
        u32::try_from(self.peer.pid).unwrap_or_default()
    }

    async fn receive(&self, reader: &mut ClientReader, session: &mut Session) -> ConnectionEnd {
        if let User::Guest(uid) = self.user {
            self.server.guest_read_delay(uid, self.tid).await;
        }
        loop {
            let mut sent = Sent::default();
            match reader.receive(&self.peer.stream).await {
                Ok(Received::Frame(message)) => {
                    sent = self.sent(&message);
                    let order = session.handle(message);
                    if let ControlFlow::Break(end) = self.execute_session(session, order) {
                        return end;
                    }
                    if let Some(port) = &self.command {
                        port.on_frame();
                    }
                    self.outcomes.wait_for_room().await;
                    self.orders.wait_for_turn().await;
                }
                Ok(Received::Yield) => {
                    // A turn without a frame is counted as work, too.
                    sent.frames = 1;
                    tokio::task::yield_now().await;
                }
                Ok(Received::End) => return ConnectionEnd::HungUp(None),
                Err(error) => return ConnectionEnd::from(error),
            }
            if let User::Guest(uid) = self.user {
                sent.idle = reader.take_idle();
                self.server.on_guest_read(uid, self.tid, sent).await;
            }
        }
    }

    /// Returns the cost of a guest's frame. Frames of the node's own user cost nothing.
    fn sent(&self, message: &Message) -> Sent {
        let User::Guest(_) = self.user else { return Sent::default() };
        let Reach { here, elsewhere } = self.server.state.ctx.router.reach(message.header.destination);
        Sent { frames: 1, bytes: message.payload.len(), idle: 0, here: here.saturating_sub(1), elsewhere }
    }

    fn submit(&self, message: Message) {
        if let Err(refused) = self.outlet.submit(message) {
            let detail = format!("{} does not read its socket: {}", self.tid, refused.why);
            self.server.refusals.count(Time::now(), "client does not listen", &detail);
        }
    }

    fn registered(&self, ring: Option<u32>) -> Message {
        let config = &self.server.state.ctx.config;
        let payload_max = u32::try_from(config.payload_max).unwrap_or(u32::MAX);
        let Tid { node, app } = self.tid;
        let types = self.server.state.ctx.ports.app_types().is_some();
        let node_name = config.name.clone();
        let ready = self.command.as_ref().is_some_and(|port| port.awaits_ready());
        let registered = Registered { node, app, node_name, payload_max, ring, types, ready };
        payload::frame(Kind::LNCL_REGISTERED, payload::lncl_of(node), self.tid, &registered)
    }
}

/// Resolves when the process has ended, or when its connection has lost the name of a command. A process that has left
/// its group outlives its command. The next process has the same TID, and only one may send from that. spec: LNCL-22
async fn ended(process: &ProcessWatch, command: Option<&CommandPort>, id: ClientId) {
    let lost = async {
        match command {
            Some(port) => port.lost(id).await,
            None => pending().await,
        }
    };
    tokio::select! {
        () = process.ended() => {}
        () = lost => {}
    }
}

fn limits(state: &State) -> OutletLimits {
    let config = &state.ctx.config;
    OutletLimits {
        queue_capacity: config.mailbox_capacity,
        queue_bytes: config.mailbox_bytes,
        unconfirmed_max: config.mailbox_capacity,
        payload_max: config.payload_max,
    }
}
