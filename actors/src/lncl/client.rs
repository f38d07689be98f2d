//! One connection of another process, from its first frame to its end.

mod barrier;
mod end;
pub(super) mod life;
mod memberships;
mod orders;
mod outcomes;

use std::{io::ErrorKind, ops::ControlFlow, rc::Rc, sync::Arc, time::Duration};

use bytes::{Buf, BytesMut};
use rustix::net::Shutdown;
use sinew_runtime::{
    monitor::DownClass,
    router::{LocalRoute, Outlet, Reach},
    tid::Tid,
    time::Time,
    wire::{Kind, Message, encode_frame},
};
use sinew_shm::Capacity;
use tokio::net::{UnixStream, unix::UCred};

use self::{
    end::{End, LAST_WORDS},
    life::Life,
    memberships::Orders,
    outcomes::Outcomes,
};
use super::{
    core::{Address, ClientId, Owner, Request, User},
    guest_pace::Sent,
    introductions::{Leaves, Party},
    link::{self, ClientReader, ClientSocket, Half},
    payload::{self, REGISTER_BYTES_MAX, Register, Registered},
    reader::{Heard, Reader},
    registrar,
    server::{Server, refuse, say_why},
    session::{Order, Session},
    strangers::Place,
};
use crate::{
    access::Applicant,
    monitors::Cause,
    outlet::{Left, LinkNumber, OutletLimits, StreamOutlet},
    stores::{Stores, lock},
};

/// Time for the first frame.
const HANDSHAKE: Duration = Duration::from_secs(2);

/// The writing half of a client's connection.
pub(super) type ClientOutlet = StreamOutlet<ClientSocket>;

/// Serves one connection to its end.
pub(super) async fn serve(
    server: Rc<Server>,
    stream: Arc<UnixStream>,
    credentials: UCred,
    id: ClientId,
    place: Place,
) {
    let mut reader = Reader::new(REGISTER_BYTES_MAX);
    let mut session = Session::new();
    // spec: LNCL-1
    let register = match tokio::time::timeout(HANDSHAKE, introduce(&mut reader, &stream, &mut session)).await
    {
        Ok(Ok(Some(register))) => {
            drop(place);
            register
        }
        // Whoever only looks whether somebody listens hangs up without a word.
        Ok(Ok(None)) => return,
        Ok(Err(why)) => return refuse(&server, &stream, "bad first frame", &why),
        Err(_) => {
            let why = format!("no frame came within {HANDSHAKE:?}; the first must be LNCL_REGISTER");
            return refuse(&server, &stream, "silent stranger", &why);
        }
    };
    let pid = credentials.pid().unwrap_or_default();
    let who = Applicant { uid: credentials.uid(), gid: credentials.gid() };
    let peer = Peer { stream: stream.clone(), id, pid, who };
    let owner = peer.owner();
    let mut client = match Client::register(server.clone(), peer, register) {
        Ok(client) => client,
        Err(why) => {
            // Who is refused knows who it is; whoever reads the log does not.
            let both = format!("of {owner}: {why}");
            server.refusals.count(Time::now(), "registration", &both);
            return say_why(&server, &stream, &why);
        }
    };
    session.registered(client.tid);
    let end = client.live(reader, &mut session).await;
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
    /// As the kernel says.
    who: Applicant,
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
    outcomes: Arc<Outcomes>,
    /// What it has asked about its groups.
    orders: Orders,
    /// Set while messages flow.
    link: Option<LinkNumber>,
    tid: Tid,
    /// Whose it is.
    user: User,
    name: String,
    /// Whether it chose the name; else that is its address.
    is_named: bool,
    requires: Vec<String>,
    /// Whether the peer wants to be told what it waits for.
    waits: bool,
    events: Arc<[Kind]>,
    /// Whether the peer can use rings; later, whether it was told that it does.
    ring: Ring,
    /// Whether others may be introduced to it.
    wants_links: bool,
    /// How it leaves those to whom it was introduced.
    leaves: Leaves,
    /// Whether the peer knows why its connection ends.
    has_been_told: bool,
    /// How it ends, as far as it is known.
    cause: Cause,
    /// Whether it takes what lies in its memory when it has ended here.
    left: Left,
}

impl Client {
    fn register(server: Rc<Server>, peer: Peer, asked: Register) -> Result<Self, super::RegisterError> {
        let Register { name, address, requires, events, kinds, pid: _, direct, ring, former, waits } = asked;
        let (uid, own) = (peer.who.uid, rustix::process::geteuid().as_raw());
        // Other nodes may still call whoever has it by the name of whoever had it. spec: LNCL-5
        let access = server.stores.access.get();
        let former =
            former.filter(|app| access.is_none_or(|access| access.has_held(*app, uid, name.as_deref())));
        let any = former.map_or(Address::Dynamic, Address::Former);
        if let Some(access) = server.stores.access.get() {
            let allowed = access.may_register(own, peer.who, name.as_deref(), address);
            allowed.map_err(|why| super::RegisterError::NotAllowed(why.to_string()))?;
        }
        let address = address.map_or(any, Address::Fixed);
        let (owner, user) = (peer.owner(), User::of(uid, own));
        let request = Request { address, name, requires: requires.clone(), kinds, owner, user };
        let called = request.name.clone();
        let app = registrar::register_client(&server.stores, request)?;
        if let Some(access) = server.stores.access.get() {
            access.holds(app, uid, called.as_deref());
        }
        let tid = Tid::new(server.stores.node, app);
        let name = lock(&server.stores.registry).name_of(app);
        let outlet = Arc::new(StreamOutlet::sharing(limits(&server.stores), server.budget_of(peer.pid)));
        let outcomes = {
            let config = &server.stores.config;
            Outcomes::new(outlet.clone(), config.mailbox_capacity, config.payload_max)
        };
        server.add_client(peer.id, outlet.clone());
        server.stores.book.add_client(peer.id, app, &name, outlet.clone());
        if let Some(suppressed) = server.stores.log_quotas.clients.take(&name, Time::now()) {
            let (suppressed, pid) = ((suppressed > 0).then_some(suppressed), peer.pid);
            // Each command of `sinew` registers some without a name.
            if called.is_some() {
                crate::log::info!(%tid, name, pid, suppressed, "an application of another process has registered");
            } else {
                crate::log::debug!(%tid, pid, suppressed, "an application of another process has registered");
            }
        }
        let (link, events, has_been_told) = (None, events.into(), false);
        let cause = Cause::new(DownClass::Killed, registrar::LNCL_ENDED);
        let ring = if ring { Ring::Asked } else { Ring::None };
        let (wants_links, leaves) = (direct, Leaves::WithItsLinks);
        Ok(Self {
            server,
            peer,
            outlet,
            outcomes,
            orders: Orders::default(),
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
            leaves,
            has_been_told,
            cause,
            left: Left::Somebody,
        })
    }

    /// Serves it until its connection ends, or its process.
    async fn live(&mut self, mut reader: Reader, session: &mut Session) -> End {
        let (life, stream) = (self.life(), self.peer.stream.clone());
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
            () = life.ended() => {
                // A child of its may hold the socket open, which hangs up now. An error means that it did so already. What the
                // process said before it ended still counts; it is there already.
                let _ = rustix::net::shutdown(&stream, Shutdown::Both);
                let end = tokio::time::timeout(LAST_WORDS, served).await.unwrap_or(End::HungUp(None));
                self.leaves = Leaves::Dead;
                return end;
            }
        };
        drop(served);
        if matches!(end, End::HungUp(_)) {
            self.leaves = Leaves::HungUp(life);
        }
        end
    }

    /// The life of its process.
    fn life(&self) -> Life {
        Life::behind(&*self.peer.stream, self.peer.pid).unwrap_or_else(|cause| {
            let detail = format!("{}, {}: {cause}", self.tid, self.peer.owner());
            self.server.refusals.count(Time::now(), "process cannot be watched", &detail);
            Life::Unknown
        })
    }

    /// Opens the connection and carries frames both ways.
    async fn run(&mut self, reader: Reader, session: &mut Session) -> End {
        // What is sent to it from now on waits in the outlet. So whoever knows that it is registered can send to it.
        session.released(self.tid);
        if self.wants_links && self.ring == Ring::Asked {
            self.server.introductions.expect(self.tid, self.pid());
        }
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
        let ring = if self.ring == Ring::Asked { self.prepare(ring_bytes).await } else { None };
        let Some((capacity, half)) = ring else {
            reader.set_payload_max(payload_max);
            self.server.introductions.expect_no_more(self.tid);
            let socket = ClientSocket::Plain(self.peer.stream.clone());
            let link = self.outlet.connect(socket, payload_max, Some(self.registered(None)));
            return Ok((ClientReader::Plain(reader), link));
        };
        // spec: LNCL-9
        write_soon(&self.peer.stream, encoded(&self.registered(Some(capacity.bytes())))).await?;
        self.ring = Ring::Told;
        let exchange = link::exchange(half, &self.peer.stream, payload_max, self.server.rings());
        let (socket, reader) = match tokio::time::timeout(HANDSHAKE, exchange).await {
            Ok(Ok(both)) => both,
            Ok(Err(why)) => return Err(why.into()),
            Err(_) => {
                return Err(End::Late(format!(
                    "its rings were not there within {HANDSHAKE:?}: it was stopped or slow to offer its half, or this node was slow to map it"
                )));
            }
        };
        let link = self.outlet.connect(socket, payload_max, None);
        self.let_meet_others();
        Ok((reader, link))
    }

    /// The node's half of its rings; `None` if it is to have none.
    async fn prepare(&self, ring_bytes: usize) -> Option<(Capacity, Half)> {
        let prepare = link::prepare(ring_bytes, &self.peer.stream, self.server.rings());
        tokio::time::timeout(HANDSHAKE, prepare).await.unwrap_or_else(|_| {
            let tid = self.tid;
            crate::log::warn!(%tid, "no rings were made within {HANDSHAKE:?}; this client gets a plain socket");
            None
        })
    }

    /// Its socket takes descriptors from now on.
    fn let_meet_others(&self) {
        if self.wants_links {
            let party = Party::new(self.tid, self.pid(), self.outlet.clone(), self.peer.stream.clone());
            self.server.introductions.add(party);
        }
    }

    fn pid(&self) -> u32 {
        u32::try_from(self.peer.pid).unwrap_or_default()
    }

    async fn receive(&self, reader: &mut ClientReader, session: &mut Session) -> End {
        if let User::Guest(uid) = self.user {
            self.server.join_pace(uid, self.tid).await;
        }
        loop {
            let mut sent = Sent::default();
            match reader.hear(&self.peer.stream).await {
                Ok(Heard::Frame(message)) => {
                    sent = self.sent(&message);
                    let order = session.handle(message);
                    if let ControlFlow::Break(end) = self.obey_session(session, order) {
                        return end;
                    }
                    self.outcomes.may_come().await;
                    self.orders.may_come().await;
                }
                Ok(Heard::Turn) => {
                    // What no frame came of is work all the same.
                    sent.frames = 1;
                    tokio::task::yield_now().await;
                }
                Ok(Heard::End) => return End::HungUp(None),
                Err(error) => return End::from(error),
            }
            if let User::Guest(uid) = self.user {
                sent.idle = reader.take_idle();
                self.server.keep_pace(uid, self.tid, sent).await;
            }
        }
    }

    /// What a frame of a guest costs; of the robot's own nobody reckons that.
    fn sent(&self, message: &Message) -> Sent {
        let User::Guest(_) = self.user else { return Sent::default() };
        let Reach { here, elsewhere } = self.server.stores.router.reach(message.header.destination);
        Sent { frames: 1, bytes: message.payload.len(), idle: 0, here: here.saturating_sub(1), elsewhere }
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
}

fn encoded(message: &Message) -> BytesMut {
    let mut bytes = BytesMut::new();
    encode_frame(&message.header, &message.payload, &mut bytes);
    bytes
}

/// Writes a frame that the socket has room for: the last one.
fn write_now(stream: &UnixStream, message: &Message) -> Result<(), End> {
    let mut bytes = encoded(message);
    write_some(stream, &mut bytes)?;
    if bytes.is_empty() { Ok(()) } else { Err(End::HungUp(None)) }
}

/// Writes what the socket has room for now; `bytes` are the rest.
fn write_some(stream: &UnixStream, bytes: &mut BytesMut) -> Result<(), End> {
    while !bytes.is_empty() {
        match stream.try_write(bytes) {
            Ok(count) => bytes.advance(count),
            Err(cause) if cause.kind() == ErrorKind::WouldBlock => break,
            Err(cause) => return Err(End::HungUp(Some(cause))),
        }
    }
    Ok(())
}

/// Writes all of it as the peer reads, which has [`HANDSHAKE`] for that.
async fn write_soon(stream: &UnixStream, mut bytes: BytesMut) -> Result<(), End> {
    let write = async {
        loop {
            write_some(stream, &mut bytes)?;
            if bytes.is_empty() {
                return Ok(());
            }
            stream.writable().await.map_err(|cause| End::HungUp(Some(cause)))?;
        }
    };
    tokio::time::timeout(HANDSHAKE, write).await.unwrap_or(Err(End::HungUp(None)))
}

fn limits(stores: &Stores) -> OutletLimits {
    let config = &stores.config;
    OutletLimits {
        queue_capacity: config.mailbox_capacity,
        queue_bytes: config.mailbox_bytes,
        unconfirmed_max: config.mailbox_capacity,
        payload_max: config.payload_max,
    }
}

#[cfg(test)]
mod tests {
    use std::io::Read;

    use super::*;

    #[test]
    fn a_frame_for_which_there_was_not_room_comes_whole_when_the_peer_reads() {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().expect("a runtime");
        runtime.block_on(async {
            // Given: a peer that does not read, and more than its socket takes.
            let (ours, mut theirs) = std::os::unix::net::UnixStream::pair().expect("a pair");
            ours.set_nonblocking(true).expect("it is ours");
            let ours = UnixStream::from_std(ours).expect("it is a socket");
            let whole: Vec<u8> = (0..2_000_000_u32).map(|index| (index % 251) as u8).collect();
            let mut rest = BytesMut::from(&whole[..]);
            ours.writable().await.expect("it takes something");
            assert!(write_some(&ours, &mut rest).is_ok());
            assert!(!rest.is_empty() && rest.len() < whole.len(), "{} bytes are left", rest.len());
            // When: it reads.
            let reading = std::thread::spawn(move || {
                let mut read = Vec::new();
                theirs.read_to_end(&mut read).map(|_| read)
            });
            assert!(write_soon(&ours, rest).await.is_ok());
            drop(ours);
            // Then:
            assert!(reading.join().expect("no panic").expect("it reads") == whole);
        });
    }
}
