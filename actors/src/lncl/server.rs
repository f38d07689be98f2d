//! The door for other processes: accepts connections, and refuses them in words.

use std::{
    cell::{OnceCell, RefCell},
    collections::BTreeMap,
    io,
    rc::Rc,
    sync::{Arc, Weak},
    time::Duration,
};

use sinew_runtime::{
    mailbox::Budget,
    tid::{AppAddress, Tid},
    time::Time,
    wire::{Kind, encode_frame},
};
use tokio::{
    net::{UnixListener, UnixStream, unix::UCred},
    sync::oneshot,
    task::{JoinError, JoinSet},
};

use super::{
    client::{self, ClientOutlet},
    core::{ClientId, User},
    guest_pace::{GuestPace, Sent},
    guests::{Guests, Row},
    introductions::Introductions,
    payload::{self, Refusal},
    rings::{self, Rings},
    strangers::{Bounds, NoPlace, Place, Stranger, Strangers},
};
use crate::{
    access::Applicant,
    refusals::Refusals,
    stores::{Stores, lock},
    undelivered,
};

/// First and longest wait after `accept` failed: usually the process has no descriptor left, and needs time to get one.
const ACCEPT_BACKOFF: (Duration, Duration) = (Duration::from_millis(10), Duration::from_millis(100));

/// The bytes that may wait for clients are enough for so many processes at their worst.
const PROCESSES_MIN: usize = 4;

/// What the connections of one life of LNCL's actor share. All of them live on its thread.
pub(super) struct Server {
    pub(super) stores: Arc<Stores>,
    pub(super) refusals: Arc<Refusals>,
    /// Who has not said yet who it is.
    strangers: Strangers,
    /// How often users have come whom only the access list lets in.
    guests: RefCell<Guests>,
    /// How much these have sent.
    pace: RefCell<GuestPace>,
    /// The bytes that wait for all clients.
    budget: Arc<Budget>,
    /// The part of each process that has clients.
    shares: RefCell<BTreeMap<i32, Weak<Budget>>>,
    /// Who may be introduced to whom.
    pub(super) introductions: Introductions,
    /// What makes the rings of clients, once one has asked for them.
    rings: OnceCell<Rings>,
    /// Who waits at the barrier.
    releases: RefCell<BTreeMap<AppAddress, oneshot::Sender<()>>>,
    /// The connections, for what is to be done now and then.
    clients: RefCell<BTreeMap<ClientId, Arc<ClientOutlet>>>,
}

impl Server {
    pub(super) fn new(stores: Arc<Stores>) -> Rc<Self> {
        let (releases, clients) = (RefCell::default(), RefCell::default());
        let refusals = stores.refusals.clone();
        let (strangers, introductions) = (Strangers::default(), Introductions::default());
        let (budget, shares) = (Budget::new(stores.config.lncl.clients_bytes), RefCell::default());
        let (rings, guests) = (OnceCell::new(), RefCell::new(Guests::new(Time::now())));
        let pace = RefCell::new(GuestPace::new(stores.config.lncl.guest_frames_per_s));
        Rc::new(Self {
            stores,
            refusals,
            strangers,
            guests,
            pace,
            budget,
            shares,
            introductions,
            rings,
            releases,
            clients,
        })
    }

    /// The bytes that may wait for the clients of the process `pid`, together.
    pub(super) fn budget_of(&self, pid: i32) -> Arc<Budget> {
        let mut shares = self.shares.borrow_mut();
        if let Some(share) = shares.get(&pid).and_then(Weak::upgrade) {
            return share;
        }
        // Those of processes that have none any more.
        shares.retain(|_, share| share.strong_count() > 0);
        let share = Budget::part_of(&self.budget, self.stores.config.lncl.clients_bytes / PROCESSES_MIN);
        shares.insert(pid, Arc::downgrade(&share));
        share
    }

    /// Resolves when a connection of the guest `uid` may be read that was not before, that of `tid`. spec: LNCL-13
    pub(super) async fn join_pace(&self, uid: u32, tid: Tid) {
        let rest = self.pace.borrow_mut().rest(uid, Time::now());
        self.rest(uid, tid, rest).await;
    }

    /// This was read of the application `tid` of the guest `uid`. Resolves when it may be read again. spec: LNCL-13
    pub(super) async fn keep_pace(&self, uid: u32, tid: Tid, sent: Sent) {
        let rest = self.pace.borrow_mut().read(uid, sent, Time::now());
        self.rest(uid, tid, rest).await;
    }

    async fn rest(&self, uid: u32, tid: Tid, rest: Option<Duration>) {
        let Some(rest) = rest else { return };
        let per_s = self.stores.config.lncl.guest_frames_per_s;
        let detail = format_args!(
            "nothing, but {tid} of user {uid} has to wait: as much as {per_s} short frames of guests are read in a second, of one user half of \
             that; send less, or raise `lncl.guest_frames_per_s`"
        );
        self.refusals.count(Time::now(), "guest too fast", &detail);
        tokio::time::sleep(rest).await;
    }

    /// What makes the rings of clients.
    pub(super) fn rings(&self) -> &Rings {
        let lncl = &self.stores.config.lncl;
        self.rings.get_or_init(|| Rings::begin(lncl.clients_max + lncl.strangers_max))
    }

    /// Resolves when there is room for what one connection more may leave.
    async fn may_accept(&self) {
        while self.rings.get().is_some_and(|rings| !rings.has_room()) {
            tokio::time::sleep(ACCEPT_BACKOFF.1).await;
        }
    }

    /// Resolves when the barrier opens for `app`.
    pub(super) fn wait_for_release(&self, app: AppAddress) -> oneshot::Receiver<()> {
        let (sender, receiver) = oneshot::channel();
        self.releases.borrow_mut().insert(app, sender);
        receiver
    }

    /// `app` waits no more.
    pub(super) fn forget_release(&self, app: AppAddress) {
        self.releases.borrow_mut().remove(&app);
    }

    /// Opens the barrier for `app`. One that waits for nothing is not here and is not missed.
    pub(super) fn release(&self, app: AppAddress) {
        let waiting = self.releases.borrow_mut().remove(&app);
        if let Some(waiting) = waiting {
            // Its connection has ended this very moment if it does not listen.
            let _ = waiting.send(());
        }
    }

    pub(super) fn add_client(&self, id: ClientId, outlet: Arc<ClientOutlet>) {
        self.stores.door.add_outlet(id, &outlet);
        self.clients.borrow_mut().insert(id, outlet);
    }

    pub(super) fn remove_client(&self, id: ClientId) {
        self.clients.borrow_mut().remove(&id);
    }

    /// Settles messages that expired while their client did not read, gives up introductions that nobody answers, and reports
    /// refused messages to their senders.
    pub(super) fn tick(&self, now: Time) {
        self.introductions.give_up(now);
        self.stores.log_quotas.tick(now);
        for outlet in self.clients.borrow().values() {
            outlet.expire(now);
        }
        undelivered::report(&self.stores, now);
    }
}

/// Accepts connections for ever, each in a task of its own; dropping this future ends them all.
pub(super) async fn accept(server: Rc<Server>, listener: UnixListener) {
    let mut clients = JoinSet::new();
    let mut backoff = ACCEPT_BACKOFF.0;
    // Of users other than the node's own: whoever connects as soon as he is refused has no more of this thread than that. Who waits behind him
    // in the kernel's queue waits for no more than these rests: what comes too often is refused, and not left there.
    let mut row = Row::new(Time::now());
    loop {
        let accept = async {
            server.may_accept().await;
            while let Some(rest) = row.rest(Time::now()) {
                tokio::time::sleep(rest).await;
            }
            listener.accept().await
        };
        tokio::select! {
            Some(ended) = clients.join_next() => report(ended),
            accepted = accept => match accepted {
                Ok((stream, _)) => {
                    backoff = ACCEPT_BACKOFF.0;
                    if admit(&server, stream, &mut clients) != Some(User::Own) {
                        row.took_one(Time::now());
                    }
                    // Who has said already who it is leaves the strangers before the next one comes.
                    tokio::task::yield_now().await;
                }
                Err(cause) => {
                    server.refusals.count(Time::now(), "accept failed", &cause);
                    tokio::time::sleep(backoff).await;
                    backoff = (backoff * 2).min(ACCEPT_BACKOFF.1);
                }
            },
        }
    }
}

/// A connection's task that panicked has taken its registration back on its way down; the others go on.
fn report(ended: Result<(), JoinError>) {
    if let Err(panicked) = ended
        && panicked.is_panic()
    {
        crate::log::error!(
            "the task of a client's connection panicked; the connection is closed: {panicked}"
        );
    }
}

/// Serves a connection from now on, or refuses it. Those that are served are bounded: as strangers here, as clients by the
/// registry, and those of a user whom only the access list lets in by how often he has come. Returns whose it is; `None`: his who may not come in.
fn admit(server: &Rc<Server>, stream: UnixStream, clients: &mut JoinSet<()>) -> Option<User> {
    let connected = Connected::new(server, stream);
    let stream = connected.stream.clone();
    let credentials = match check_credentials(&server.stores, &stream) {
        Ok(credentials) => credentials,
        Err(why) => {
            refuse(server, &stream, "credentials", &why);
            return None;
        }
    };
    let user = User::of(credentials.uid(), rustix::process::geteuid().as_raw());
    // spec: LNCL-13
    if let User::Guest(uid) = user
        && let Err(why) = server.guests.borrow_mut().admit(uid, Time::now())
    {
        refuse(server, &stream, "too many connections of a guest", &why);
        return Some(user);
    }
    let place = match place_for(server, credentials, user) {
        Ok(place) => place,
        Err(why) => {
            refuse(server, &stream, "too many strangers", &why);
            return Some(user);
        }
    };
    let id = lock(&server.stores.registry).new_client();
    server.stores.door.admit(id, &stream);
    clients.spawn_local(async move {
        client::serve(connected.server.clone(), stream, credentials, id, place).await;
        connected.server.stores.door.dismiss(id);
    });
    Some(user)
}

/// A connection that was taken. Dropping it ends it, and has what the peer left unread in it taken out by a thread that may wait: a
/// descriptor may be beside it, which can take for ever to close.
struct Connected {
    server: Rc<Server>,
    stream: Arc<UnixStream>,
}

impl Connected {
    fn new(server: &Rc<Server>, stream: UnixStream) -> Self {
        // Before it is looked at for the first time; it fails for what is no socket alone. spec: LNCL-18
        let _ = sinew_shm::keep_urgent_in_line(&stream);
        Self { server: server.clone(), stream: Arc::new(stream) }
    }
}

impl Drop for Connected {
    fn drop(&mut self) {
        // spec: LNCL-18
        if rings::shut(&self.stream) {
            self.server.rings().empty(self.stream.clone());
        }
    }
}

/// spec: LNCL-13
fn place_for(server: &Server, credentials: UCred, user: User) -> Result<Place, NoPlace> {
    let lncl = &server.stores.config.lncl;
    let bounds = Bounds { all: lncl.strangers_max, per_process: lncl.strangers_per_process_max };
    server.strangers.admit(Stranger { pid: credentials.pid().unwrap_or_default(), user }, bounds)
}

fn check_credentials(stores: &Stores, stream: &UnixStream) -> Result<UCred, String> {
    let credentials = stream.peer_cred().map_err(|cause: io::Error| format!("who are you? {cause}"))?;
    let own = rustix::process::geteuid().as_raw();
    if let Some(access) = stores.access.get() {
        let who = Applicant { uid: credentials.uid(), gid: credentials.gid() };
        return access.admit(own, who).map(|()| credentials).map_err(|why| why.to_string());
    }
    if admits(own, credentials.uid()) {
        return Ok(credentials);
    }
    let theirs = credentials.uid();
    Err(format!(
        "user {theirs} may not use this node: it runs as user {own}; run the application as that user"
    ))
}

/// spec: LNCL-2: the user that the node runs as, and root, where no access list says more.
const fn admits(own: u32, theirs: u32) -> bool {
    theirs == own || theirs == 0
}

/// Counts a refusal and says it to the peer, as far as its socket takes it at once. The connection is closed by
/// dropping it.
pub(super) fn refuse(server: &Server, stream: &UnixStream, cause: &'static str, why: &dyn std::fmt::Display) {
    server.refusals.count(Time::now(), cause, why);
    say_why(server, stream, why);
}

/// Says to a client why it is refused.
pub(super) fn say_why(server: &Server, stream: &UnixStream, why: &dyn std::fmt::Display) {
    let refusal = Refusal { sentence: why.to_string(), again: false };
    let lncl = payload::lncl_of(server.stores.node);
    let message = payload::frame(Kind::LNCL_REFUSAL, lncl, Tid::NONE, &refusal);
    let mut bytes = bytes::BytesMut::new();
    encode_frame(&message.header, &message.payload, &mut bytes);
    // Whoever does not read its refusal is closed without one.
    let _ = stream.try_write(&bytes);
}

#[cfg(test)]
mod tests {
    use std::{os::unix::net::UnixStream as Plain, sync::mpsc::sync_channel};

    use sinew_runtime::tid::Incarnation;

    use super::*;
    use crate::{
        config::NodeConfig,
        lingering::{self, Lingering},
        lncl::testing::WATCHDOG,
    };

    /// Ends a connection in which lies what does not close, and of which nobody has a copy.
    fn ends_with(pass: fn(&Plain, std::net::TcpStream)) {
        // Given:
        let (ours, theirs) = Plain::pair().unwrap();
        ours.set_nonblocking(true).unwrap();
        let mut lingering = Lingering::new();
        pass(&theirs, lingering.ours.take().expect("it is passed once"));
        // When:
        let (say, said) = sync_channel(1);
        std::thread::spawn(move || {
            let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
            let _inside = runtime.enter();
            let server = Server::new(Stores::for_test(NodeConfig::new("hip"), Incarnation(1)));
            drop(Connected::new(&server, UnixStream::from_std(ours).unwrap()));
            // The test has ended, where this comes too late.
            let _ = say.send(());
        });
        // Then:
        assert_eq!(said.recv_timeout(WATCHDOG), Ok(()));
        lingering.let_go();
    }

    // spec: LNCL-18
    #[test]
    fn who_ends_a_connection_does_not_wait_for_what_is_unread_in_it() {
        ends_with(|theirs, passed| assert_eq!(lingering::pass(theirs, b"S", passed), Ok(1)));
        ends_with(|theirs, passed| assert_eq!(lingering::pass_urgent(theirs, passed), Ok(1)));
    }

    #[test]
    fn only_the_nodes_own_user_and_root_are_admitted() {
        let (node, root, other) = (1000, 0, 1001);
        assert!(admits(node, node) && admits(node, root) && !admits(node, other) && !admits(root, other));
    }
}
