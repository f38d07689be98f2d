//! One connection of another process, from its first frame to its end.

use std::{io, ops::ControlFlow, rc::Rc, sync::Arc, time::Duration};

use bytes::BytesMut;
use rustix::net::Shutdown;
use sinew_runtime::{
    monitor::DownClass,
    outcome::{Outcome, Receipt, ReceiptSink, Rejection, Ticket},
    router::{LocalRoute, Outlet},
    tid::Tid,
    time::Time,
    wire::{Flags, FrameError, Header, Kind, Message, encode_frame},
};
use sinew_shm::PassError;
use tokio::net::{UnixStream, unix::UCred};

use super::{
    core::{Address, ClientId, Owner, Request},
    introductions::{Marks, Party},
    link::{self, ClientReader, ClientSocket, LinkError},
    payload::{self, REGISTER_BYTES_MAX, Refusal, Register, Registered, Resolved},
    reader::Reader,
    registrar,
    server::{Server, refuse},
    session::{Order, Session},
};
use crate::{
    monitors::Cause,
    outlet::{LinkNumber, OutletLimits, StreamOutlet},
    ring::{ExchangeError, RingError},
    stores::{Stores, lock},
};

/// Time for the first frame.
const HANDSHAKE: Duration = Duration::from_secs(2);
/// Time that a client has to take its refusal when earlier messages fill its socket.
const LAST_WORDS: Duration = Duration::from_millis(100);

/// Time until a mark is passed on again that found no room.
const MARK_AGAIN: Duration = Duration::from_millis(2);

/// The writing half of a client's connection.
pub(super) type ClientOutlet = StreamOutlet<ClientSocket>;

/// Why a connection ended.
#[derive(Debug)]
enum End {
    /// It gave its address back.
    Unregistered,
    /// The process closed its socket, or ended.
    HungUp(Option<io::Error>),
    /// It was refused.
    Refused(String),
}

/// Serves one connection to its end.
pub(super) async fn serve(server: Rc<Server>, stream: Arc<UnixStream>, credentials: UCred, id: ClientId) {
    let mut reader = Reader::new(REGISTER_BYTES_MAX);
    let mut session = Session::new();
    // spec: LNCL-1
    let register = match tokio::time::timeout(HANDSHAKE, introduce(&mut reader, &stream, &mut session)).await
    {
        Ok(Ok(Some(register))) => register,
        // Whoever only looks whether somebody listens hangs up without a word.
        Ok(Ok(None)) => return,
        Ok(Err(why)) => return refuse(&server, &stream, "bad first frame", &why),
        Err(_) => {
            let why = format!("no frame came within {HANDSHAKE:?}; the first must be LNCL_REGISTER");
            return refuse(&server, &stream, "silent stranger", &why);
        }
    };
    let peer = Peer { stream: stream.clone(), id, pid: credentials.pid().unwrap_or_default() };
    let mut client = match Client::register(server.clone(), peer, register) {
        Ok(client) => client,
        Err(why) => return refuse(&server, &stream, "registration", &why),
    };
    session.registered(client.tid);
    let end = match client.wait_at_barrier(&mut reader, &mut session).await {
        Some(end) => end,
        None => client.run(reader, &mut session).await,
    };
    client.finish(end).await;
}

/// The first frame; `None` if the peer hung up before it said anything.
async fn introduce(
    reader: &mut Reader,
    stream: &UnixStream,
    session: &mut Session,
) -> Result<Option<Register>, String> {
    let Some(message) = reader.next(stream).await.map_err(|error| error.to_string())? else {
        return Ok(None);
    };
    match session.handle(message) {
        Order::Register(register) => Ok(Some(register)),
        Order::End(violation) => Err(violation.to_string()),
        Order::Route(_)
        | Order::Settle { .. }
        | Order::SetMember { .. }
        | Order::Tell { .. }
        | Order::Resolve { .. }
        | Order::Introduce { .. }
        | Order::Switch { .. }
        | Order::RefuseMessage { .. }
        | Order::Unregister => Err("a stranger can only register".to_owned()),
    }
}

/// The other end of a connection.
struct Peer {
    stream: Arc<UnixStream>,
    id: ClientId,
    /// As the kernel says; 0 where it does not.
    pid: i32,
}

impl Peer {
    const fn owner(&self) -> Owner {
        Owner::Client { id: self.id, pid: self.pid }
    }
}

/// Whether a connection has rings.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Ring {
    None,
    /// The client can.
    Asked,
    /// The client was told so: the socket carries descriptors, and last words.
    Told,
}

/// A registered connection. Dropping it takes the registration back, whatever the reason: the end of the peer's
/// process, of this task, or of LNCL.
struct Client {
    server: Rc<Server>,
    peer: Peer,
    outlet: Arc<ClientOutlet>,
    /// Set while messages flow.
    link: Option<LinkNumber>,
    tid: Tid,
    name: String,
    requires: Vec<String>,
    events: Arc<[Kind]>,
    /// Whether the peer can use rings; later, whether it was told that it does.
    ring: Ring,
    /// Whether others may be introduced to it.
    wants_links: bool,
    /// Whether the peer knows why its connection ends.
    has_been_told: bool,
    /// How it ends, as far as it is known.
    cause: Cause,
}

impl Client {
    fn register(server: Rc<Server>, peer: Peer, asked: Register) -> Result<Self, super::RegisterError> {
        let Register { name, address, requires, events, kinds, pid: _, direct, ring, former } = asked;
        let any = former.map_or(Address::Dynamic, Address::Former);
        let address = address.map_or(any, Address::Fixed);
        let request = Request { address, name, requires: requires.clone(), kinds, owner: peer.owner() };
        let app = registrar::register_client(&server.stores, request)?;
        let tid = Tid::new(server.stores.node, app);
        let name = lock(&server.stores.registry).name_of(app);
        let outlet = Arc::new(StreamOutlet::new(limits(&server.stores)));
        server.add_outlet(peer.id, outlet.clone());
        tracing::info!(%tid, name, pid = peer.pid, "an application of another process has registered");
        let (link, events, has_been_told) = (None, events.into(), false);
        let cause = Cause::new(DownClass::Killed, registrar::LNCL_ENDED);
        let ring = if ring { Ring::Asked } else { Ring::None };
        let wants_links = direct;
        Ok(Self {
            server,
            peer,
            outlet,
            link,
            tid,
            name,
            requires,
            events,
            ring,
            wants_links,
            has_been_told,
            cause,
        })
    }

    /// Holds the client until all that it requires is ready. Returns why its connection ended, if it did.
    async fn wait_at_barrier(&self, reader: &mut Reader, session: &mut Session) -> Option<End> {
        // spec: LNCL-6
        if self.requires.is_empty() {
            return None;
        }
        // The release comes through this very thread, so that it cannot come before somebody waits for it.
        let released = self.server.wait_for_release(self.tid.app);
        let early = async {
            match reader.next(&self.peer.stream).await {
                Ok(Some(message)) => match session.handle(message) {
                    Order::Unregister => End::Unregistered,
                    Order::End(violation) => End::Refused(violation.to_string()),
                    Order::Register(_)
                    | Order::Route(_)
                    | Order::Settle { .. }
                    | Order::SetMember { .. }
                    | Order::Tell { .. }
                    | Order::Resolve { .. }
                    | Order::Introduce { .. }
                    | Order::Switch { .. }
                    | Order::RefuseMessage { .. } => End::Refused("wait for LNCL_REGISTERED".to_owned()),
                },
                Ok(None) => End::HungUp(None),
                Err(error) => End::from(error),
            }
        };
        let end = tokio::select! {
            end = early => Some(end),
            released = released => released.is_err().then(|| End::Refused("LNCL ended".to_owned())),
        };
        self.server.forget_release(self.tid.app);
        end
    }

    /// Opens the connection and carries frames both ways.
    async fn run(&mut self, reader: Reader, session: &mut Session) -> End {
        // What is sent to it from now on waits in the outlet. So whoever knows that it is registered can send to it.
        session.released(self.tid);
        let route = LocalRoute { outlet: self.outlet.clone(), events: self.events.clone() };
        registrar::open(&self.server.stores, self.tid.app, route);
        let (mut reader, link) = match self.open_link(reader).await {
            Ok(opened) => opened,
            Err(end) => return end,
        };
        self.link = Some(link);
        let receive = self.receive(&mut reader, session);
        tokio::pin!(receive);
        tokio::select! {
            end = &mut receive => end,
            // What it said before it went still counts; it is there already.
            cause = self.outlet.drain(link) => {
                tokio::time::timeout(LAST_WORDS, receive).await.unwrap_or_else(|_| End::of_write(cause))
            }
        }
    }

    /// Tells the client its address, and agrees with it on what carries the messages.
    async fn open_link(&mut self, mut reader: Reader) -> Result<(ClientReader, LinkNumber), End> {
        let config = &self.server.stores.config;
        let payload_max = config.payload_max;
        let ring_bytes = config.lncl.ring_bytes;
        let ring = (self.ring == Ring::Asked).then(|| link::prepare(ring_bytes)).flatten();
        let Some((capacity, exchange)) = ring else {
            reader.set_payload_max(payload_max);
            let socket = ClientSocket::Plain(self.peer.stream.clone());
            let link = self.outlet.connect(socket, payload_max, Some(self.registered(None)));
            return Ok((ClientReader::Plain(reader), link));
        };
        // spec: LNCL-9
        write_now(&self.peer.stream, &self.registered(Some(capacity.bytes())))?;
        self.ring = Ring::Told;
        let exchange = link::exchange(exchange, &self.peer.stream, payload_max);
        let (socket, reader) = match tokio::time::timeout(HANDSHAKE, exchange).await {
            Ok(Ok(both)) => both,
            Ok(Err(ExchangeError::Pass(PassError::Closed))) => return Err(End::HungUp(None)),
            Ok(Err(why)) => return Err(End::Refused(why.to_string())),
            Err(_) => {
                return Err(End::Refused(format!("no offer of shared memory came within {HANDSHAKE:?}")));
            }
        };
        let link = self.outlet.connect(socket, payload_max, None);
        self.let_meet_others();
        Ok((reader, link))
    }

    /// Its socket takes descriptors from now on.
    fn let_meet_others(&self) {
        if self.wants_links {
            let pid = u32::try_from(self.peer.pid).unwrap_or_default();
            let party = Party::new(self.tid, pid, self.outlet.clone(), self.peer.stream.clone());
            self.server.introductions.add(party);
        }
    }

    async fn receive(&self, reader: &mut ClientReader, session: &mut Session) -> End {
        loop {
            let message = match reader.next(&self.peer.stream).await {
                Ok(Some(message)) => message,
                Ok(None) => return End::HungUp(None),
                Err(error) => return End::from(error),
            };
            if let ControlFlow::Break(end) = self.obey(session.handle(message)) {
                return end;
            }
        }
    }

    fn obey(&self, order: Order) -> ControlFlow<End> {
        match order {
            Order::Route(message) => self.route(message),
            Order::Settle { source, correlation, outcome } => self.settle(source, correlation, outcome),
            Order::SetMember { group, member, confirm } => {
                registrar::set_member(&self.server.stores, self.tid.app, group, member);
                if let Some(correlation) = confirm {
                    self.tell(payload::lncl_of(self.tid.node), correlation, Outcome::Delivered);
                }
            }
            Order::Tell { destination, correlation, outcome } => {
                self.tell(destination, correlation, outcome);
            }
            Order::Resolve { name, correlation } => self.resolve(&name, correlation),
            Order::Introduce { to, correlation } => self.introduce(to, correlation),
            Order::Switch { to, number, correlation } => self.switch(to, number, correlation),
            Order::RefuseMessage { message, why } => self.refuse_message(&message, why),
            Order::Unregister => return ControlFlow::Break(End::Unregistered),
            Order::End(violation) => return ControlFlow::Break(End::Refused(violation.to_string())),
            Order::Register(_) => {
                return ControlFlow::Break(End::Refused("registered already".to_owned()));
            }
        }
        ControlFlow::Continue(())
    }

    fn route(&self, mut message: Message) {
        let router = &self.server.stores.router;
        let destination = router.absolute(message.header.destination);
        let is_confirmed = message.header.flags.has(Flags::CONFIRM);
        if is_confirmed {
            let correlation = message.header.correlation;
            let ticket = Ticket { source: self.tid, destination, correlation };
            message.receipt = Some(Receipt::new(Arc::new(OutcomeSink(self.outlet.clone())), ticket));
        }
        if let Err(why) = router.send(message)
            && !is_confirmed
            && destination.is_single()
        {
            // The source of a confirmed message knows; a group without members is no fault.
            let detail = format!("from {} to {destination}: {why}", self.tid);
            self.server.refusals.count(Time::now(), "unconfirmed message not taken", &detail);
        }
    }

    fn settle(&self, source: Tid, correlation: u64, outcome: Outcome) {
        let ticket = Ticket { source, destination: self.tid, correlation };
        if !self.outlet.confirm(ticket, outcome) {
            let detail = format!("{} settles a message {correlation} of {source} that it has not", self.tid);
            self.server.refusals.count(Time::now(), "outcome of nothing", &detail);
        }
    }

    fn resolve(&self, name: &str, correlation: u64) {
        let tid = registrar::resolve(&self.server.stores, name).map(Tid::bits);
        let lncl = payload::lncl_of(self.tid.node);
        let mut answer = payload::frame(Kind::LNCL_RESOLVED, lncl, self.tid, &Resolved { tid });
        answer.header.correlation = correlation;
        self.say(answer);
    }

    fn introduce(&self, to: Tid, correlation: u64) {
        let number = lock(&self.server.stores.registry).new_link();
        let to = self.server.stores.router.absolute(to);
        if let Err(why) = self.server.introductions.introduce(self.tid, to, number, correlation) {
            self.tell(to, correlation, Outcome::Rejected(why));
        }
    }

    // spec: LNCL-11
    fn switch(&self, to: Tid, number: u64, correlation: u64) {
        let to = self.server.stores.router.absolute(to);
        let ticket = Ticket { source: self.tid, destination: to, correlation };
        let receipt = Receipt::new(Arc::new(OutcomeSink(self.outlet.clone())), ticket);
        match self.server.introductions.marks(self.tid, to, number, receipt) {
            Ok(marks) => pass_on(marks),
            Err((receipt, why)) => receipt.settle(Outcome::Rejected(why)),
        }
    }

    fn refuse_message(&self, message: &Message, why: Rejection) {
        let Header { source, destination, correlation, flags, .. } = message.header;
        let detail = format!("{} said that {source} sends to {destination}: {why}", self.tid);
        let cause = if why == Rejection::ForgedSource { "forged source" } else { "unsupported flags" };
        self.server.refusals.count(Time::now(), cause, &detail);
        if flags.has(Flags::CONFIRM) {
            self.tell(destination, correlation, Outcome::Rejected(why));
        }
    }

    fn tell(&self, about: Tid, correlation: u64, outcome: Outcome) {
        let ticket = Ticket { source: self.tid, destination: about, correlation };
        self.say(Message::outcome(ticket, outcome));
    }

    fn say(&self, message: Message) {
        if let Err(refused) = self.outlet.submit(message) {
            let detail = format!("{} does not read its socket: {}", self.tid, refused.why);
            self.server.refusals.count(Time::now(), "client does not listen", &detail);
        }
    }

    fn registered(&self, ring: Option<u32>) -> Message {
        let config = &self.server.stores.config;
        let payload_max = u32::try_from(config.payload_max).unwrap_or(u32::MAX);
        let Tid { node, app } = self.tid;
        let registered = Registered { node, app, node_name: config.name.clone(), payload_max, ring };
        payload::frame(Kind::LNCL_REGISTERED, payload::lncl_of(node), self.tid, &registered)
    }

    /// Says the last words, if there are any.
    async fn finish(mut self, end: End) {
        self.has_been_told = true;
        self.cause = end.cause();
        match end {
            End::Unregistered => self.log("has unregistered"),
            End::HungUp(None) => self.log("has gone: its process closed the socket, or ended"),
            End::HungUp(Some(cause)) => self.log(&format!("has gone: {cause}")),
            // spec: LNCL-4
            End::Refused(sentence) => {
                let detail = format!("{} ({}): {sentence}", self.name, self.tid);
                self.server.refusals.count(Time::now(), "protocol violation", &detail);
                self.say_farewell(sentence).await;
            }
        }
    }

    async fn say_farewell(&self, sentence: String) {
        if self.ring == Ring::Told {
            return self.say_last(sentence, false);
        }
        self.say(self.refusal(sentence, false));
        // Without a link nothing was written yet, and the socket takes a sentence at once.
        let link = self.link.unwrap_or_else(|| {
            let payload_max = self.server.stores.config.payload_max;
            self.outlet.connect(ClientSocket::Plain(self.peer.stream.clone()), payload_max, None)
        });
        if self.outlet.waiting() > 0 {
            // What the socket does not take in this time is not read by anybody.
            let _ = tokio::time::timeout(LAST_WORDS, self.outlet.drain(link)).await;
        }
    }

    /// Says why it ends, without waiting.
    fn say_last(&self, sentence: String, again: bool) {
        let refusal = self.refusal(sentence, again);
        match self.ring {
            Ring::None | Ring::Asked => self.say(refusal),
            // The ring may be full or not there yet, and nothing but these words ever goes into the socket. Whoever is
            // gone need not hear them.
            Ring::Told => drop(write_now(&self.peer.stream, &refusal)),
        }
    }

    fn refusal(&self, sentence: String, again: bool) -> Message {
        let lncl = payload::lncl_of(self.tid.node);
        payload::frame(Kind::LNCL_REFUSAL, lncl, self.tid, &Refusal { sentence, again })
    }

    fn log(&self, what: &str) {
        tracing::info!(tid = %self.tid, name = self.name, pid = self.peer.pid, "an application of another process {what}");
    }
}

impl Drop for Client {
    fn drop(&mut self) {
        self.server.introductions.remove(self.tid.app);
        registrar::owner_gone(&self.server.stores, self.peer.owner(), &self.cause);
        self.server.remove_outlet(self.peer.id);
        if !self.has_been_told {
            self.say_last("the node's LNCL has ended; connect again when it is back".to_owned(), true);
        }
        // Senders may hold the outlet, and with it the socket, a little longer; the peer is told now. An error means
        // that it is closed already.
        let _ = rustix::net::shutdown(&self.peer.stream, Shutdown::Both);
        // spec: LNCL-7. A peer that sleeps at a ring is woken by its end.
        self.outlet.end(Outcome::Failed, Rejection::Closed);
    }
}

impl End {
    /// What those are told who watch the application.
    fn cause(&self) -> Cause {
        match self {
            Self::Unregistered => Cause::new(DownClass::Normal, "it unregistered"),
            Self::HungUp(_) => {
                Cause::new(DownClass::ProcessEnded, "its process ended, or closed its connection")
            }
            Self::Refused(sentence) => {
                Cause::new(DownClass::Killed, format!("its connection was ended: {sentence}"))
            }
        }
    }
}

impl End {
    /// The end of a connection that could not be written to.
    fn of_write(cause: io::Error) -> Self {
        if cause.kind() == io::ErrorKind::InvalidData {
            Self::Refused(cause.to_string())
        } else {
            Self::HungUp(Some(cause))
        }
    }
}

impl From<LinkError> for End {
    fn from(error: LinkError) -> Self {
        match error {
            LinkError::Ring(RingError::Frame(error)) => error.into(),
            LinkError::Ring(RingError::Corrupt(_)) | LinkError::StrayBytes => {
                Self::Refused(error.to_string())
            }
        }
    }
}

impl From<FrameError> for End {
    fn from(error: FrameError) -> Self {
        match error {
            FrameError::Io(cause) => Self::HungUp(Some(cause)),
            FrameError::Header(_) | FrameError::TooLong { .. } => Self::Refused(error.to_string()),
        }
    }
}

/// Passes marks on, now or, where there is no room, as soon as there is.
fn pass_on(mut marks: Marks) {
    if marks.pass_on() {
        tokio::task::spawn_local(async move {
            // Ends when there is room, or the client's outlet has ended.
            while marks.pass_on() {
                tokio::time::sleep(MARK_AGAIN).await;
            }
        });
    }
}

/// Writes a frame that the socket has room for: the first one.
fn write_now(stream: &UnixStream, message: &Message) -> Result<(), End> {
    let mut bytes = BytesMut::new();
    encode_frame(&message.header, &message.payload, &mut bytes);
    match stream.try_write(&bytes) {
        Ok(count) if count == bytes.len() => Ok(()),
        Ok(_) => Err(End::HungUp(None)),
        Err(cause) => Err(End::HungUp(Some(cause))),
    }
}

/// Carries outcomes of a client's messages back to it. Any thread settles them, and writes to the socket itself.
struct OutcomeSink(Arc<ClientOutlet>);

impl ReceiptSink for OutcomeSink {
    fn settle(&self, ticket: Ticket, outcome: Outcome) {
        // Not taken: the client is gone, or does not read; its own deadline says `Unknown`.
        let _ = self.0.submit(Message::outcome(ticket, outcome));
    }
}

fn limits(stores: &Stores) -> OutletLimits {
    let config = &stores.config;
    OutletLimits {
        queue_capacity: config.mailbox_capacity,
        unconfirmed_max: config.mailbox_capacity,
        payload_max: config.payload_max,
    }
}
