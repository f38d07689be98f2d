//! The server for other processes: accepts connections, and refuses them with a reason.

use std::{
    cell::{OnceCell, RefCell},
    collections::BTreeMap,
    io,
    rc::Rc,
    sync::{Arc, Weak},
    time::Duration,
};

use sinew_model::{accept_limiter::AcceptRow, facts::User, refusals::Refusals};
use sinew_protocol::{
    payload::{self, Refusal},
    user_namespace::unmapped_user,
};
use sinew_runtime::{
    lock,
    mailbox::Budget,
    safe_wake::SafelyWoken,
    tid::{AppAddress, Tid},
    time::Time,
    wire::{Kind, encode_frame},
};
use sinew_security::access::Applicant;
use sinew_session::book::ClientId;
use tokio::{
    net::{UnixListener, UnixStream, unix::UCred},
    sync::oneshot,
    task::{JoinError, JoinSet},
};

use super::{
    client::{self, ClientOutlet},
    guest_connections::GuestConnections,
    guest_reads::{GuestReads, Sent},
    link_broker::LinkBroker,
    rings::{self, Rings},
    unauthenticated::{Bounds, LimitError, Slot, Unauthenticated, UnauthenticatedLimits},
};
use crate::{State, undelivered};

/// First and longest delay after a failed `accept`. Usually the process has no descriptor left, and needs time to get
/// one.
const ACCEPT_BACKOFF: (Duration, Duration) = (Duration::from_millis(10), Duration::from_millis(100));

/// Number of processes at their maximum for which the byte budget of all clients suffices.
const PROCESSES_MIN: usize = 4;

/// State that the connections of one incarnation of LNCL's actor share. All of them run on its thread.
pub(super) struct Server {
    pub(super) state: Arc<State>,
    pub(super) refusals: Arc<Refusals>,
    /// Limits on connections that are not registered yet.
    unauthenticated: UnauthenticatedLimits,
    /// Connection rates of guests: users that only the access list admits.
    guest_connections: RefCell<GuestConnections>,
    /// Send rates of guests.
    guest_reads: RefCell<GuestReads>,
    /// The byte budget of the queues of all clients.
    budget: Arc<Budget>,
    /// The budget of each process that has clients.
    shares: RefCell<BTreeMap<i32, Weak<Budget>>>,
    /// Broker of direct links between clients.
    pub(super) link_broker: LinkBroker,
    /// Threads that create the rings of clients. They start on first use.
    rings: OnceCell<Rings>,
    /// Waiters at the barrier.
    releases: RefCell<BTreeMap<AppAddress, oneshot::Sender<()>>>,
    /// The connections, for periodic work.
    clients: RefCell<BTreeMap<ClientId, Arc<ClientOutlet>>>,
}

impl Server {
    pub(super) fn new(state: Arc<State>) -> Rc<Self> {
        let (releases, clients) = (RefCell::default(), RefCell::default());
        let refusals = state.ctx.refusals.clone();
        let (unauthenticated, link_broker) = (UnauthenticatedLimits::default(), LinkBroker::default());
        let (budget, shares) = (Budget::new(state.ctx.config.lncl.clients_bytes), RefCell::default());
        let (rings, guest_connections) = (OnceCell::new(), RefCell::new(GuestConnections::new()));
        let guest_reads = RefCell::new(GuestReads::new(state.ctx.config.lncl.guest_frames_per_s));
        Rc::new(Self {
            state,
            refusals,
            unauthenticated,
            guest_connections,
            guest_reads,
            budget,
            shares,
            link_broker,
            rings,
            releases,
            clients,
        })
    }

    /// Returns the byte budget that the clients of the process `pid` share. Without a process from the kernel (0), the
    /// budget is for one client.
    pub(super) fn budget_of(&self, pid: i32) -> Arc<Budget> {
        let share_max = self.state.ctx.config.lncl.clients_bytes / PROCESSES_MIN;
        // A pid of 0 stands for any number of processes, so each connection has its own budget.
        if pid == 0 {
            return Budget::part_of(&self.budget, share_max);
        }
        let mut shares = self.shares.borrow_mut();
        if let Some(share) = shares.get(&pid).and_then(Weak::upgrade) {
            return share;
        }
        // Entries of processes that have no clients any more.
        shares.retain(|_, share| share.strong_count() > 0);
        let share = Budget::part_of(&self.budget, share_max);
        shares.insert(pid, Arc::downgrade(&share));
        share
    }

    /// Resolves when a new connection of the guest `uid`, that of `tid`, may be read. spec: LNCL-13
    pub(super) async fn guest_read_delay(&self, uid: u32, tid: Tid) {
        let delay = self.guest_reads.borrow_mut().delay(uid, Time::now());
        self.delay_guest(uid, tid, delay).await;
    }

    /// Counts a read from the application `tid` of the guest `uid`. Resolves when it may be read again. spec: LNCL-13
    pub(super) async fn on_guest_read(&self, uid: u32, tid: Tid, sent: Sent) {
        let delay = self.guest_reads.borrow_mut().on_read(uid, sent, Time::now());
        self.delay_guest(uid, tid, delay).await;
    }

    async fn delay_guest(&self, uid: u32, tid: Tid, delay: Option<Duration>) {
        let Some(delay) = delay else { return };
        let per_s = self.state.ctx.config.lncl.guest_frames_per_s;
        let detail = format_args!(
            "nothing, but {tid} of user {uid} has to wait: as much as {per_s} short frames of guests are read in a second, of one user half of \
             that; send less, or raise `lncl.guest_frames_per_s`"
        );
        self.refusals.count(Time::now(), "guest too fast", &detail);
        tokio::time::sleep(delay).await;
    }

    /// Returns the threads that create the rings of clients.
    pub(super) fn rings(&self) -> &Rings {
        let lncl = &self.state.ctx.config.lncl;
        self.rings.get_or_init(|| Rings::begin(lncl.clients_max + lncl.strangers_max))
    }

    /// Resolves when the cleanup queue has room for one more connection.
    async fn may_accept(&self) {
        while self.rings.get().is_some_and(|rings| !rings.has_room()) {
            tokio::time::sleep(ACCEPT_BACKOFF.1).await;
        }
    }

    /// Registers `app` as a waiter; the receiver resolves when the barrier opens for it.
    pub(super) fn wait_for_release(&self, app: AppAddress) -> oneshot::Receiver<()> {
        let (sender, receiver) = oneshot::channel();
        self.releases.borrow_mut().insert(app, sender);
        receiver
    }

    /// Removes `app` from the waiters.
    pub(super) fn forget_release(&self, app: AppAddress) {
        self.releases.borrow_mut().remove(&app);
    }

    /// Opens the barrier for `app`. No effect if it does not wait.
    pub(super) fn release(&self, app: AppAddress) {
        let waiting = self.releases.borrow_mut().remove(&app);
        if let Some(waiting) = waiting {
            // An error means that its connection has just ended.
            let _ = waiting.send(());
        }
    }

    pub(super) fn add_client(&self, id: ClientId, outlet: Arc<ClientOutlet>) {
        self.state.client_socket.add_outlet(id, &outlet);
        self.clients.borrow_mut().insert(id, outlet);
        self.state.ctx.checks.request();
    }

    pub(super) fn remove_client(&self, id: ClientId) {
        self.clients.borrow_mut().remove(&id);
    }

    /// Expires messages of clients that do not read, abandons unanswered link requests, and reports rejected messages
    /// to their senders. Returns whether anything is left that a later call must do.
    pub(super) fn tick(&self, now: Time) -> bool {
        // All are called, without a short circuit.
        let mut is_left = self.link_broker.expire(now);
        is_left |= self.state.ctx.log_quotas.tick(now);
        for outlet in self.clients.borrow().values() {
            is_left |= outlet.expire(now);
        }
        self.state.commands.hand_over();
        is_left |= self.state.observed_links.retry(&self.state.ctx.router);
        is_left | undelivered::report(&self.state, now)
    }
}

/// Accepts connections forever, and serves each in a task of its own. Dropping this future ends them all.
pub(super) async fn accept(server: Rc<Server>, listener: UnixListener) {
    let mut clients = JoinSet::new();
    let mut backoff = ACCEPT_BACKOFF.0;
    // Limits connections of other users: one that reconnects after each refusal gets no more of this thread than this.
    // Connections behind it in the kernel's queue wait only for these pauses, since excess connections are refused and
    // not left in the queue.
    let mut row = AcceptRow::new(Time::now());
    loop {
        let accept = async {
            server.may_accept().await;
            while let Some(pause) = row.delay(Time::now()) {
                tokio::time::sleep(pause).await;
            }
            listener.accept().await
        };
        tokio::select! {
            Some(ended) = clients.join_next() => report(ended),
            accepted = accept => match accepted {
                Ok((stream, _)) => {
                    backoff = ACCEPT_BACKOFF.0;
                    if admit(&server, stream, &mut clients) != Some(User::Own) {
                        row.on_accept(Time::now());
                    }
                    // A connection that has already registered leaves the count of unregistered ones before the next
                    // accept.
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

/// Logs a panic of a connection's task. Unwinding has removed its registration; the other connections continue.
fn report(ended: Result<(), JoinError>) {
    if let Err(panicked) = ended
        && panicked.is_panic()
    {
        sinew_runtime::log::error!(
            "the task of a client's connection panicked; the connection is closed: {panicked}"
        );
    }
}

/// Serves a connection, or refuses it. Served connections are bounded: unregistered ones here, clients by the registry,
/// and guests by their connection rate. Returns the user, or `None` if that user has no access.
fn admit(server: &Rc<Server>, stream: UnixStream, clients: &mut JoinSet<()>) -> Option<User> {
    let connected = Connected::new(server, stream);
    let stream = connected.stream.clone();
    let credentials = match check_credentials(&server.state, &stream) {
        Ok(credentials) => credentials,
        Err(why) => {
            refuse(server, &stream, "credentials", &why);
            return None;
        }
    };
    let user = User::of(credentials.uid(), rustix::process::geteuid().as_raw());
    // spec: LNCL-13
    if let User::Guest(uid) = user
        && let Err(why) = server.guest_connections.borrow_mut().admit(uid, Time::now())
    {
        refuse(server, &stream, "too many connections of a guest", &why);
        return Some(user);
    }
    let place = match reserve_slot(server, credentials, user) {
        Ok(place) => place,
        Err(why) => {
            refuse(server, &stream, "too many strangers", &why);
            return Some(user);
        }
    };
    let id = lock(&server.state.registry).new_client();
    server.state.client_socket.admit(id, &stream);
    // Senders on any thread wake it.
    clients.spawn_local(SafelyWoken::new(async move {
        client::serve(connected.server.clone(), stream, credentials, id, place).await;
        connected.server.state.client_socket.dismiss(id);
    }));
    Some(user)
}

/// An accepted connection. Dropping it ends the connection. Its unread data is then removed by a thread that may block,
/// since a descriptor beside that data can take forever to close.
struct Connected {
    server: Rc<Server>,
    stream: Arc<UnixStream>,
}

impl Connected {
    fn new(server: &Rc<Server>, stream: UnixStream) -> Self {
        // Set before the first read. It fails only for a descriptor that is no socket. spec: LNCL-18
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
fn reserve_slot(server: &Server, credentials: UCred, user: User) -> Result<Slot, LimitError> {
    let lncl = &server.state.ctx.config.lncl;
    let bounds = Bounds { all: lncl.strangers_max, per_process: lncl.strangers_per_process_max };
    server.unauthenticated.admit(Unauthenticated { pid: credentials.pid().unwrap_or_default(), user }, bounds)
}

fn check_credentials(state: &State, stream: &UnixStream) -> Result<UCred, String> {
    let credentials = stream
        .peer_cred()
        .map_err(|cause: io::Error| format!("the kernel does not name the user of this process: {cause}"))?;
    let own = rustix::process::geteuid().as_raw();
    if unmapped_user() == Some(credentials.uid()) {
        return Err(format!(
            "user {} may not use this node: in this user namespace that number stands for every user of the host that the namespace does not map; run \
             the application as a user that it maps",
            credentials.uid()
        ));
    }
    if let Some(access) = state.security.access.get() {
        let applicant = Applicant { uid: credentials.uid(), gid: credentials.gid() };
        return access.admit(own, applicant).map(|()| credentials).map_err(|why| why.to_string());
    }
    if admits(own, credentials.uid()) {
        return Ok(credentials);
    }
    let theirs = credentials.uid();
    Err(format!(
        "user {theirs} may not use this node: it runs as user {own}; run the application as that user"
    ))
}

/// spec: LNCL-2: admits the node's own user and root, if there is no access list.
const fn admits(own: u32, theirs: u32) -> bool {
    theirs == own || theirs == 0
}

/// Counts a refusal, and sends it to the peer if its socket takes it at once. The caller closes the connection by
/// dropping it.
pub(super) fn refuse(server: &Server, stream: &UnixStream, cause: &'static str, why: &dyn std::fmt::Display) {
    server.refusals.count(Time::now(), cause, why);
    send_refusal(server, stream, why);
}

/// Sends a client the reason of its refusal.
pub(super) fn send_refusal(server: &Server, stream: &UnixStream, why: &dyn std::fmt::Display) {
    let refusal = Refusal { sentence: why.to_string(), again: false };
    let lncl = payload::lncl_of(server.state.ctx.node);
    let message = payload::frame(Kind::LNCL_REFUSAL, lncl, Tid::NONE, &refusal);
    let mut bytes = bytes::BytesMut::new();
    encode_frame(&message.header, &message.payload, &mut bytes);
    // A peer that does not read its refusal is closed without one.
    let _ = stream.try_write(&bytes);
}

#[cfg(test)]
mod tests {
    use std::{os::unix::net::UnixStream as Plain, sync::mpsc::sync_channel};

    use sinew_runtime::tid::Incarnation;

    use super::*;
    use crate::{
        slow_close::{self, SlowClose},
        testing::WATCHDOG,
    };
    use sinew_model::config::NodeConfig;

    /// Ends a connection with an unread descriptor that does not close and has no other copy.
    fn ends_with(pass: fn(&Plain, std::net::TcpStream)) {
        // Given:
        let (ours, theirs) = Plain::pair().unwrap();
        ours.set_nonblocking(true).unwrap();
        let mut slow = SlowClose::new();
        pass(&theirs, slow.ours.take().expect("it is passed once"));
        // When:
        let (report, reported) = sync_channel(1);
        std::thread::spawn(move || {
            let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
            let _inside = runtime.enter();
            let server = Server::new(State::for_test(NodeConfig::new("hip"), Incarnation(1)));
            drop(Connected::new(&server, UnixStream::from_std(ours).unwrap()));
            // The test may have ended before this.
            let _ = report.send(());
        });
        // Then:
        assert_eq!(reported.recv_timeout(WATCHDOG), Ok(()));
        slow.release();
    }

    // spec: LNCL-18
    #[test]
    fn connection_ends_without_waiting_for_unread_descriptors() {
        ends_with(|theirs, passed| assert_eq!(slow_close::pass(theirs, b"S", passed), Ok(1)));
        ends_with(|theirs, passed| assert_eq!(slow_close::pass_urgent(theirs, passed), Ok(1)));
    }

    #[test]
    fn only_the_nodes_own_user_and_root_are_admitted() {
        let (node, root, other) = (1000, 0, 1001);
        assert!(admits(node, node) && admits(node, root) && !admits(node, other) && !admits(root, other));
    }
}
