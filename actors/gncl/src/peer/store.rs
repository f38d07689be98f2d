//! The part of GNCL that outlives its restart: all peers, and the sockets and threads that they share.

use std::{
    collections::{BTreeMap, VecDeque},
    io,
    net::Shutdown,
    sync::{Arc, Mutex, MutexGuard, PoisonError, Weak, atomic::AtomicUsize},
    time::Duration,
};

use sinew_model::{notifications::claim_notifications, periodic_checks::PeriodicChecks, refusals::Refusals};
use sinew_runtime::{
    lock,
    remedy::{Wanted, remedy},
    tid::{Incarnation, NodeAddress},
    time::Time,
};
use socket2::SockRef;
use tokio::sync::Notify;

use super::{
    super::{
        authenticated::AuthenticatedNodes,
        authenticator::Authenticator,
        bulk::BulkThread,
        core::Lane,
        datagrams::{Alarm, ForwardedNumbers, Sockets},
        link_status::LinkStatusTable,
        peer_session::{Offered, PeerSession},
        segments::Segments,
        task::{Relocation, TaskThread},
        transport::Transport,
        yield_policy::YieldPolicy,
    },
    EndedAccounts, Peer,
};
use crate::State;

/// Period of offers to a full application that does not signal room by itself. It is also the longest delay
/// of a report to the sender that a waiting message has expired.
const OFFER_PERIOD: Duration = Duration::from_millis(50);
/// Period of checks for waiting messages that have expired.
const EXPIRY_PERIOD: Duration = Duration::from_millis(50);
/// Longest time before received messages are acknowledged. The peer keeps them for that time, which has no
/// other effect: if more messages arrive, the acknowledgement is earlier.
const ACK_PERIOD: Duration = Duration::from_secs(1);

/// The part of GNCL that outlives its restart.
#[derive(Default)]
pub struct Store {
    peers: Mutex<BTreeMap<NodeAddress, Arc<Peer>>>,
    /// Removed peers with messages that still wait for applications here or are in process, oldest first.
    pub(super) departed: Mutex<Vec<Arc<Peer>>>,
    /// Number of these peers.
    pub(super) departed_count: AtomicUsize,
    /// Numbers forwarded by datagram of removed incarnations that may return, oldest first.
    pub(super) forwarded_numbers: Mutex<VecDeque<(NodeAddress, Incarnation, ForwardedNumbers)>>,
    /// The certificates with which nodes were last linked.
    pub(crate) authenticated: AuthenticatedNodes,
    /// All incarnations of peers that are still referenced, for an audit; dropped ones are counted in `ended_accounts`.
    pub(super) all_incarnations: Mutex<Vec<Weak<Peer>>>,
    /// The accounts of dropped peers, both directions, in total.
    pub(super) ended_accounts: Arc<Mutex<EndedAccounts>>,
    /// Notified when messages begin to wait for an application here, when such an application accepts more,
    /// and when a message of an ended peer is finished.
    pub(crate) queues_changed: Arc<Notify>,
    /// The thread of Bulk, from its first connection until the node ends.
    bulk: Mutex<Option<BulkThread>>,
    /// The authentication of a node with keys, and its thread, from the first instance of this layer until
    /// the node ends.
    pub(crate) authenticator: Mutex<Option<Arc<Authenticator>>>,
    /// The listening sockets, that of the node's interface first. They stay open while this layer is
    /// restarted: a refused peer would report this node as lost.
    pub(crate) listeners: Mutex<Vec<Arc<std::net::TcpListener>>>,
    /// The periodic checks for expired messages, and for messages not acknowledged yet.
    pub(super) expiring: Arc<PeriodicChecks>,
    pub(super) acks: Arc<PeriodicChecks>,
    /// Wakes the task of held events when [outstanding](Self::outstanding) messages were delivered or dropped.
    pub fewer_outstanding: Arc<Notify>,
    /// The sockets for datagrams, and the timer of their channels.
    pub(crate) datagrams: Sockets,
    pub(crate) alarm: Arc<Alarm>,
    /// Limits of the segment lengths of connections.
    pub(crate) segments: Arc<Segments>,
    /// The status of connections, for queries.
    pub link_status: LinkStatusTable,
    /// Counters of GNCL's refusals, by cause.
    pub refusals: Arc<Refusals>,
}

impl Store {
    /// Returns the peers that are known now.
    pub fn peers(&self) -> Vec<Arc<Peer>> {
        self.lock().values().cloned().collect()
    }

    /// Appends the same peers to a list that its owner reuses.
    pub(crate) fn list_peers(&self, list: &mut Vec<Arc<Peer>>) {
        list.extend(self.lock().values().cloned());
    }

    /// Returns the accounts of dropped peers, in total.
    pub fn ended_accounts(&self) -> EndedAccounts {
        *lock(&self.ended_accounts)
    }

    /// Returns the peer at `node`.
    pub fn peer(&self, node: NodeAddress) -> Option<Arc<Peer>> {
        self.lock().get(&node).cloned()
    }

    /// Offers waiting messages to applications here, whenever one of them accepts more.
    pub(crate) async fn serve_queues(state: Arc<State>) {
        let store = &state.store;
        let (room, has_room) = (state.ctx.room_notifier.waker(), &state.ctx.room_notifier.messages);
        claim_notifications(&store.queues_changed);
        claim_notifications(has_room);
        // Ended incarnations are first: a later one of the same node follows behind them.
        let all = || lock(&store.departed).clone().into_iter().chain(store.peers()).collect::<Vec<_>>();
        all().iter().flat_map(|peer| &peer.sessions).for_each(PeerSession::forget_offers);
        loop {
            let now = Time::now();
            let offer = |peer: &Arc<Peer>| {
                let is_early = |queue| store.has_earlier_messages(peer, queue);
                peer.sessions
                    .iter()
                    .map(|session| session.offer_again(now, &state.ctx.router, &room, is_early))
                    .max()
            };
            let offered = all().iter().filter_map(offer).max();
            store.drop_served();
            match offered.unwrap_or(Offered::All) {
                Offered::All => store.queues_changed.notified().await,
                // The offer is repeated after a notification as well as after the timeout.
                Offered::Full => tokio::select! {
                    () = store.queues_changed.notified() => {}
                    () = has_room.notified() => {}
                    () = tokio::time::sleep(OFFER_PERIOD) => {}
                },
                Offered::Turn => {}
            }
            // Repeated notifications must not block other tasks.
            tokio::task::yield_now().await;
        }
    }

    /// Returns where the connections of a lane are read and written from now on, and this `transport` in the
    /// form for that thread.
    ///
    /// # Errors
    /// There is no descriptor for it, which was counted. Once the thread of Bulk exists, a Bulk connection
    /// runs only there and waits for a descriptor. The former connection may still be delivering a message
    /// there, and a message read on another thread would overtake that.
    pub(crate) fn relocate(&self, lane: Lane, transport: Transport) -> io::Result<Relocation> {
        match lane {
            Lane::Control | Lane::Stream => Ok(Relocation { thread: TaskThread::Io, transport }),
            Lane::Bulk => match self.bulk_relocation(&transport) {
                Ok(there) => Ok(there),
                Err(error) if lock(&self.bulk).is_none() => {
                    // Bulk works on the IO thread, too, except that Control may wait for Bulk.
                    self.refusals.count(Time::now(), "Bulk stays on the IO thread", &error);
                    Ok(Relocation { thread: TaskThread::Io, transport })
                }
                Err(error) => {
                    let remedy = remedy(Wanted::Reactor, &error);
                    let detail = format!(
                        "{error}; messages of class Bulk for this peer wait, with another try each second; {remedy}"
                    );
                    self.refusals.count(Time::now(), "no descriptor for a connection of Bulk", &detail);
                    Err(error)
                }
            },
        }
    }

    fn bulk_relocation(&self, transport: &Transport) -> io::Result<Relocation> {
        let mut bulk = lock(&self.bulk);
        let there = |thread: &BulkThread| -> io::Result<Relocation> {
            let socket = thread.adopt(transport.socket())?;
            Ok(Relocation { thread: thread.task_thread(), transport: transport.with_socket(socket) })
        };
        if let Some(thread) = &*bulk {
            return there(thread);
        }
        // The thread is stored only after it has accepted its first connection.
        let thread = BulkThread::begin("bulk", YieldPolicy::default())?;
        let moved = there(&thread)?;
        *bulk = Some(thread);
        Ok(moved)
    }

    /// Settles waiting messages that have expired, and gives up overdue outcomes.
    pub(crate) async fn run_expiry_checks(state: Arc<State>) {
        let (store, mut peers) = (&state.store, Vec::new());
        let check = || {
            let now = Time::now();
            // All sessions are checked, without a short circuit.
            store.count_sessions(&mut peers, |session| session.outlet.expire(now)) > 0
        };
        store.expiring.run(EXPIRY_PERIOD, check).await;
    }

    /// Acknowledges messages that are too rare to trigger an acknowledgement.
    pub(crate) async fn run_late_acknowledgements(state: Arc<State>) {
        let (store, mut peers) = (&state.store, Vec::new());
        store
            .acks
            .run(ACK_PERIOD, || store.count_sessions(&mut peers, PeerSession::acknowledge_pending) > 0)
            .await;
    }

    /// Returns the number of sessions that satisfy `what`. The list `peers` is empty afterwards, and its
    /// memory is reused.
    fn count_sessions(&self, peers: &mut Vec<Arc<Peer>>, what: impl Fn(&PeerSession) -> bool) -> usize {
        self.list_peers(peers);
        peers.drain(..).map(|peer| peer.sessions.iter().filter(|session| what(session)).count()).sum()
    }

    /// Ends the threads of Bulk and of handshakes.
    pub fn end_threads(&self) {
        lock(&self.bulk).take();
        lock(&self.authenticator).take();
    }

    /// Closes all sockets: no peer can connect any more, and the ports are free, even if other threads still
    /// hold the sockets.
    pub fn close(&self) {
        self.datagrams.close();
        for listener in lock(&self.listeners).drain(..) {
            // An error means that it does not listen any more.
            let _ = SockRef::from(&*listener).shutdown(Shutdown::Both);
        }
    }

    pub(super) fn lock(&self) -> MutexGuard<'_, BTreeMap<NodeAddress, Arc<Peer>>> {
        self.peers.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
