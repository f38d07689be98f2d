//! What another node is to the senders of this one: its sessions, which outlive connections and restarts of this layer.

mod lives;

use std::{
    collections::{BTreeMap, VecDeque},
    hash::{BuildHasher as _, RandomState},
    io,
    net::Shutdown,
    sync::{
        Arc, Mutex, MutexGuard, PoisonError, Weak,
        atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering},
    },
    task::{Wake, Waker},
    time::Duration,
};

use bytes::Bytes;
use sinew_runtime::{
    outcome::{MemberReport, Outcome, ReceiptSink, Rejection, Ticket},
    router::{Outlet, Refused},
    tid::{AppAddress, Incarnation, NodeAddress, Tid},
    time::Time,
    wire::{Class, Header, Kind, Message},
};
use socket2::SockRef;
use tokio::sync::Notify;

use super::{
    bulk::BulkThread,
    core::{Attach, Lane, write},
    courtesy::Courtesy,
    datagrams::{Alarm, Channel, HandedOn, Position, Sockets},
    notes::Notes,
    owed::Owed,
    proofs::Proofs,
    secure::Secure,
    segments::Segments,
    task::{Move, Place},
    ticks::Ticks,
    transport::Transport,
    way::{Ends, Offered, Told, Way, WayAccount},
};
use crate::{
    audit::Account,
    outlet::{OutletAccount, OutletCounts},
    refusals::Refusals,
    stores::{Stores, lock},
    takeover::take_over,
    undelivered::Report,
};

/// How often what waits for an application that is full is offered to it, if it does not say itself that it takes more; so late at most
/// its sender is told that something has expired there.
const OFFER_PERIOD: Duration = Duration::from_millis(50);
/// How often it is looked for messages that have expired while they wait.
const EXPIRY_PERIOD: Duration = Duration::from_millis(50);
/// After so long at most a peer is told what was taken of it. It keeps that so long and needs no more: where more comes, it is told before.
const ACK_PERIOD: Duration = Duration::from_secs(1);

/// One life of another node, from its first link until it is forgotten.
pub(crate) struct Peer {
    pub(crate) node: NodeAddress,
    pub(crate) incarnation: Incarnation,
    /// A session for each class, or one for all.
    ways: Vec<Way>,
    /// Whether it knows [`CANCEL`](Kind::CANCEL).
    takes_cancels: bool,
    /// Whether it takes [reports](Kind::GNCL_UNDELIVERED).
    takes_reports: bool,
    /// When something of it was read last, in nanoseconds of our clock; 0: never.
    sign: AtomicU64,
    /// When it said that it leaves, in nanoseconds of our clock, 0: it has not; what it still sends is taken.
    has_left: AtomicU64,
    /// It is over: nothing more is taken of it.
    is_over: AtomicBool,
    /// What goes by datagram, where both sides may have it so.
    channel: Option<Channel>,
    buried: Arc<Mutex<Buried>>,
    expiring: Arc<Ticks>,
    fewer_owed: Arc<Notify>,
}

/// What became of the messages to and from lives of peers that are gone, all together.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Buried {
    pub(crate) sent: Account,
    pub(crate) arrived: Account,
}

impl Drop for Peer {
    fn drop(&mut self) {
        let accounts = self.accounts();
        let mut buried = lock(&self.buried);
        for WayAccount { sent, arrived, .. } in accounts {
            buried.sent = buried.sent + Account::of_outlet(&sent);
            // What still waited for applications is gone with it, and its receipts say so.
            buried.arrived = buried.arrived + Account::of_arrivals(&arrived).over();
        }
        self.fewer_owed.notify_one();
    }
}

impl Peer {
    /// `now` numbers what is remembered of the peer: a later peer of the same life has a larger number.
    fn new(now: Time, attach: &Attach, stores: &Stores) -> Self {
        let ways = if attach.by_class { Lane::ALL.len() } else { 1 };
        let ends = Ends {
            here: stores.node,
            node: attach.node,
            takes_outcomes: attach.takes_outcomes,
            answers_there: usize::try_from(attach.answers_max).unwrap_or(usize::MAX),
            payload_max_there: usize::try_from(attach.payload_max).unwrap_or(usize::MAX),
            ways,
        };
        let Store { refusals, acks, fewer_owed, held_up, .. } = &stores.gncl;
        let told = Told {
            refusals: refusals.clone(),
            acks: acks.clone(),
            fewer_owed: fewer_owed.clone(),
            held_up: held_up.clone(),
        };
        let ways = (0..ways).map(|_| Way::new(now, ends, &stores.config, &told)).collect();
        let channel = attach.takes_datagrams.then(|| {
            // Nobody can guess it: this has its seed from the system.
            let key = RandomState::new().hash_one(());
            let ends = (stores.node, attach.node);
            let former = stores.gncl.handed_on(attach.node, attach.incarnation);
            Channel::new(now, ends, key, former, &stores.gncl)
        });
        let (buried, expiring) = (stores.gncl.buried.clone(), stores.gncl.expiring.clone());
        let fewer_owed = fewer_owed.clone();
        let Attach { node, incarnation, takes_cancels, takes_reports, .. } = *attach;
        Self {
            node,
            incarnation,
            ways,
            takes_cancels,
            takes_reports,
            channel,
            sign: AtomicU64::new(0),
            has_left: AtomicU64::new(0),
            is_over: AtomicBool::new(false),
            buried,
            expiring,
            fewer_owed,
        }
    }

    /// Its sessions.
    pub(crate) fn ways(&self) -> &[Way] {
        &self.ways
    }

    /// The session whose messages travel on connections of this lane.
    pub(super) fn way(&self, lane: Lane) -> Option<&Way> {
        self.ways.get(lane as usize)
    }

    /// What goes by datagram, and the session of the values that do not.
    pub(super) const fn channel(&self) -> Option<&Channel> {
        self.channel.as_ref()
    }

    /// Nothing goes by datagram any more: what is under way goes by the connection.
    pub(super) fn retire_datagrams(&self) {
        if let Some(channel) = &self.channel {
            channel.retire(self.way_of(Class::Stream));
        }
    }

    /// Sends again what counts as lost, and acknowledges what came. Returns when to look again.
    pub(super) fn look_at_the_time(&self, now: Time) -> Option<Time> {
        self.channel.as_ref()?.tick(now, self.way_of(Class::Stream))
    }

    /// Nothing reaches it any more, and nothing that waits will.
    fn end(&self, why: Rejection) {
        self.channel.iter().for_each(Channel::end);
        self.ways.iter().for_each(|way| way.outlet.close(why));
    }

    /// The session of this class.
    fn way_of(&self, class: Class) -> &Way {
        self.ways.get(class as usize).unwrap_or(&self.ways[0])
    }

    /// Something of this life of it was read at `now`: NDL does not lose it for a while. Once for all that was read at once.
    pub(super) fn gives_a_sign(&self, now: Time) {
        // SYNC: Relaxed; nothing else becomes visible with it, and NDL reads it long after.
        self.sign.store(now.as_nanos(), Ordering::Relaxed);
    }

    /// Nothing more is taken of this life of it.
    fn fence(&self) {
        self.ways.iter().for_each(Way::fence);
        // SYNC: Release, with the Acquire in `owed`: who sees it sees the fences.
        if !self.is_over.swap(true, Ordering::Release) {
            self.fewer_owed.notify_one();
        }
    }

    /// To whom a message of this life, if it has left or is over, may still come.
    fn owed(&self) -> Owed {
        // SYNC: Acquire, see `fence`.
        if self.is_over.load(Ordering::Acquire) {
            return self.ways.iter().map(Way::owed).fold(Owed::NOBODY, Owed::and);
        }
        if self.has_left() { Owed::Anyone } else { Owed::NOBODY }
    }

    /// Whether it has said that it leaves.
    pub(super) fn has_left(&self) -> bool {
        // SYNC: Relaxed; a flag by itself.
        self.has_left.load(Ordering::Relaxed) != 0
    }

    /// Something waits here again that had gone out.
    pub(super) fn holds_what_may_expire(&self) {
        self.expiring.want();
    }

    /// Reports messages of its applications that were refused here. Without a connection it is told nothing. spec: GNCL-20
    pub(crate) fn report_undelivered(&self, here: NodeAddress, report: &Report) {
        if self.takes_reports {
            let report = frame(here, self.node, Kind::GNCL_UNDELIVERED, write(report));
            self.way_of(Class::Control).say(report);
        }
    }

    /// Cuts every connection.
    pub(super) fn cut(&self) {
        self.ways.iter().for_each(|way| way.outlet.cut());
    }

    /// Messages for it that have not arrived, as far as is known here.
    pub(super) fn left(&self) -> usize {
        let by_datagram = self.channel.as_ref().map_or(0, Channel::left);
        by_datagram + self.ways.iter().map(|way| way.outlet.left()).sum::<usize>()
    }

    /// Those of applications among these.
    pub(super) fn left_of_applications(&self) -> usize {
        let by_datagram = self.channel.as_ref().map_or(0, Channel::left);
        by_datagram + self.ways.iter().map(|way| way.outlet.left_of_applications()).sum::<usize>()
    }

    /// Nothing reaches it any more, because this node stops.
    pub(super) fn close(&self) {
        self.end(Rejection::Closed);
    }

    /// The peer says what became of these messages; those that nobody waits for any more are left.
    pub(super) fn confirm(&self, outcomes: &mut Vec<(Ticket, Outcome)>) {
        // A ticket does not say the class.
        self.ways.iter().for_each(|way| way.outlet.confirm_all(outcomes));
    }

    /// Where every message to it and from it is, session by session.
    pub(crate) fn accounts(&self) -> Vec<WayAccount> {
        let mut accounts: Vec<_> = self.ways.iter().map(Way::account).collect();
        if let Some(channel) = &self.channel
            && let Some(account) = accounts.get_mut(Class::Stream as usize)
        {
            account.sent = with_datagrams(account.sent, &channel.position());
        }
        accounts
    }

    /// What became of the messages to it so far.
    pub(crate) fn counts(&self) -> OutletCounts {
        let by_datagram = self.channel.as_ref().map(|channel| channel.position().counts);
        let by_datagram = by_datagram.map(|counts| OutletCounts {
            sent: counts.sent,
            superseded: counts.superseded,
            expired: counts.expired,
            lost: counts.lost,
            refused: 0,
        });
        let first = by_datagram.unwrap_or_default();
        self.ways.iter().fold(first, |sum, way| sum + way.outlet.counts())
    }

    /// Messages that wait to be sent to it.
    pub(crate) fn waiting(&self) -> usize {
        let by_datagram = self.channel.as_ref().map_or(0, |channel| channel.position().waiting as usize);
        by_datagram + self.ways.iter().map(|way| way.outlet.waiting()).sum::<usize>()
    }

    /// Confirmed messages to it whose outcome is not known yet.
    pub(crate) fn unconfirmed(&self) -> usize {
        self.ways.iter().map(|way| way.outlet.unconfirmed()).sum()
    }
}

impl Outlet for Peer {
    fn submit(&self, message: Message) -> Result<(), Refused> {
        // Who has been told that it is lost has nothing taken that nobody would hear of: GNCL itself is told at the same time, and may act later.
        // SYNC: Acquire, see `fence`.
        if self.is_over.load(Ordering::Acquire) {
            return Err(Refused::new(message, Rejection::NoSuchNode));
        }
        let has_a_time = message.header.time_to_live_us != 0 || message.receipt.is_some();
        let way = self.way_of(message.header.class);
        match &self.channel {
            Some(channel) if message.header.class == Class::Stream => channel.submit(message, way)?,
            Some(_) | None => way.outlet.submit(message)?,
        }
        if has_a_time {
            self.expiring.want();
        }
        Ok(())
    }

    /// Requests are of class Control, and so is what takes them back: it comes behind them. spec: GNCL-15
    fn cancel(&self, ticket: Ticket) -> bool {
        let outlet = &self.way_of(Class::Control).outlet;
        if outlet.cancel(ticket) {
            return true;
        }
        let mut cancel = Message::cancel(ticket);
        cancel.header.sent = Time::now();
        // One that finds the queue full leaves its request to its time to live.
        self.takes_cancels && outlet.submit(cancel).is_ok()
    }
}

/// The outcome of a message that came from this peer goes back to it. spec: GNCL-12
impl ReceiptSink for Peer {
    fn settle(&self, ticket: Ticket, outcome: Outcome) {
        let mut said = Message::outcome(ticket, outcome);
        said.header.sent = Time::now();
        self.way_of(said.header.class).send_outcome(said);
    }

    /// So do reports about members of this node. spec: FRAME-7
    fn members(&self, ticket: Ticket, reports: &[MemberReport]) {
        let way = self.way_of(Class::Control);
        for mut frame in Message::members(ticket, reports, way.payload_max()) {
            frame.header.sent = Time::now();
            way.send_outcome(frame);
        }
    }
}

/// The account of a session with what went by datagram beside it.
fn with_datagrams(session: OutletAccount, datagrams: &Position) -> OutletAccount {
    OutletAccount {
        taken: session.taken + datagrams.taken(),
        arrived: session.arrived + datagrams.arrived,
        superseded: session.superseded + datagrams.superseded(),
        expired: session.expired + datagrams.expired(),
        lost: session.lost + datagrams.counts.lost,
        unknown: session.unknown + datagrams.unknown(),
        waiting: session.waiting + datagrams.waiting,
        unacknowledged: session.unacknowledged + datagrams.unacknowledged,
        ..session
    }
}

/// A frame from this node's GNCL to that of `node`.
pub(super) fn frame(here: NodeAddress, node: NodeAddress, kind: Kind, payload: Bytes) -> Message {
    let mut header = Header::new(kind, Tid::new(here, AppAddress::GNCL), Tid::new(node, AppAddress::GNCL));
    header.sent = Time::now();
    Message::new(header, payload)
}

/// Woken when an application takes more, for which messages wait.
struct Room(Arc<Notify>);

impl Wake for Room {
    fn wake(self: Arc<Self>) {
        self.0.notify_one();
    }
}

/// What of GNCL outlives a restart of it.
#[derive(Default)]
pub(crate) struct Store {
    peers: Mutex<BTreeMap<NodeAddress, Arc<Peer>>>,
    /// Peers that are gone, as long as messages of theirs wait for applications here or are in hand, oldest first.
    gone: Mutex<Vec<Arc<Peer>>>,
    /// How many they are.
    gone_count: AtomicUsize,
    /// What was handed on by datagram of lives that are forgotten and may come back, oldest first.
    handed_on: Mutex<VecDeque<(NodeAddress, Incarnation, HandedOn)>>,
    /// How nodes proved who they are when they were linked last.
    pub(super) proofs: Proofs,
    /// Every life of a peer that somebody still holds, for an audit; those that are gone are in `buried`.
    met: Mutex<Vec<Weak<Peer>>>,
    /// The accounts of those that nobody holds any more, both ways, all together.
    buried: Arc<Mutex<Buried>>,
    /// Told when messages begin to wait for an application here, when one for which they wait takes more, and when a message of a peer that
    /// is over has ended.
    pub(super) held_up: Arc<Notify>,
    /// The thread of Bulk, from its first connection until the node ends.
    bulk: Mutex<Option<BulkThread>>,
    /// How connections of a node that has keys are made, and the thread of that, from the first life of this layer until the node ends.
    pub(super) secure: Mutex<Option<Arc<Secure>>>,
    /// The sockets that listen, that of the node's interface first. They stay open while this layer is restarted: a peer that is
    /// refused would say that this node is lost.
    pub(super) listeners: Mutex<Vec<Arc<std::net::TcpListener>>>,
    /// Who looks for what has expired, and who for what was taken and not acknowledged.
    expiring: Arc<Ticks>,
    acks: Arc<Ticks>,
    /// Told when messages that were [owed](Self::owed) came or will not come. For one who waits.
    pub(crate) fewer_owed: Arc<Notify>,
    /// Where datagrams are read, and who looks at the time for them.
    pub(super) datagrams: Sockets,
    pub(super) alarm: Arc<Alarm>,
    /// How long segments of connections may be.
    pub(super) segments: Arc<Segments>,
    /// What is told of connections to whoever asks.
    pub(crate) notes: Notes,
    /// What GNCL refused, and why.
    pub(crate) refusals: Arc<Refusals>,
}

impl Store {
    /// The peers that are known now.
    pub(crate) fn peers(&self) -> Vec<Arc<Peer>> {
        self.lock().values().cloned().collect()
    }

    /// The same, in a list that its owner uses again.
    pub(super) fn list_peers(&self, list: &mut Vec<Arc<Peer>>) {
        list.extend(self.lock().values().cloned());
    }

    /// The accounts of those that are gone, all together.
    pub(crate) fn buried(&self) -> Buried {
        *lock(&self.buried)
    }

    /// The peer at `node`.
    pub(crate) fn peer(&self, node: NodeAddress) -> Option<Arc<Peer>> {
        self.lock().get(&node).cloned()
    }

    /// Offers what waits for applications here to them, whenever one of them takes more.
    pub(super) async fn serve_those_held_up(stores: Arc<Stores>) {
        let store = &stores.gncl;
        take_over(&store.held_up);
        let room = Waker::from(Arc::new(Room(store.held_up.clone())));
        // What is over first: a later life of the same node comes behind it.
        let all = || lock(&store.gone).clone().into_iter().chain(store.peers()).collect::<Vec<_>>();
        all().iter().flat_map(|peer| &peer.ways).for_each(Way::forget_offers);
        loop {
            let now = Time::now();
            let offer = |peer: &Arc<Peer>| {
                let is_early = |line| store.waits_before(peer, line);
                peer.ways.iter().map(|way| way.offer_again(now, &stores.router, &room, is_early)).max()
            };
            let offered = all().iter().filter_map(offer).max();
            store.drop_those_served();
            match offered.unwrap_or(Offered::All) {
                Offered::All => store.held_up.notified().await,
                // Whether somebody was told or the time is over: it is tried again.
                Offered::Full => drop(tokio::time::timeout(OFFER_PERIOD, store.held_up.notified()).await),
                Offered::Turn => {}
            }
            // Whoever is told again and again takes no other task's turn.
            tokio::task::yield_now().await;
        }
    }

    /// Where the connections of a lane are read and written from now on, and this one, `transport`, as it is to be used there.
    ///
    /// # Errors
    /// There is no descriptor for it, which was counted. Once there is a thread of Bulk, Bulk goes there or not at all, as long as there is no descriptor for it: what reads the connection before may
    /// be in the middle of a message there, and on another thread the next message would overtake that.
    pub(super) fn place(&self, lane: Lane, transport: Transport) -> io::Result<Move> {
        match lane {
            Lane::Control | Lane::Stream => Ok(Move { place: Place::Here, transport }),
            Lane::Bulk => match self.bulk_place(&transport) {
                Ok(there) => Ok(there),
                Err(error) if lock(&self.bulk).is_none() => {
                    // It works there, too; only that Control may wait for Bulk.
                    self.refusals.count(Time::now(), "Bulk stays on the IO thread", &error);
                    Ok(Move { place: Place::Here, transport })
                }
                Err(error) => {
                    let words = format!(
                        "{error}; what there is of Bulk for this peer waits, and it is tried again within a second: raise `ulimit -n`, or close \
                         what this process holds open"
                    );
                    self.refusals.count(Time::now(), "no descriptor for a connection of Bulk", &words);
                    Err(error)
                }
            },
        }
    }

    fn bulk_place(&self, transport: &Transport) -> io::Result<Move> {
        let mut bulk = lock(&self.bulk);
        let there = |thread: &BulkThread| -> io::Result<Move> {
            let socket = thread.adopt(transport.socket())?;
            Ok(Move { place: thread.place(), transport: transport.with_socket(socket) })
        };
        if let Some(thread) = &*bulk {
            return there(thread);
        }
        // It counts as one that was there before once it has read anything.
        let thread = BulkThread::begin("bulk", Courtesy::default())?;
        let moved = there(&thread)?;
        *bulk = Some(thread);
        Ok(moved)
    }

    /// Settles what has expired while it waited, and outcomes that do not come any more.
    pub(super) async fn look_for_expired(stores: Arc<Stores>) {
        let (store, mut peers) = (&stores.gncl, Vec::new());
        let look = || {
            let now = Time::now();
            // All of them, whatever the first says.
            store.all_ways(&mut peers, |way| way.outlet.expire(now)) > 0
        };
        store.expiring.run(EXPIRY_PERIOD, look).await;
    }

    /// Acknowledges what came so seldom that nothing else did.
    pub(super) async fn acknowledge_late(stores: Arc<Stores>) {
        let (store, mut peers) = (&stores.gncl, Vec::new());
        store.acks.run(ACK_PERIOD, || store.all_ways(&mut peers, Way::acknowledge_if_owed) > 0).await;
    }

    /// Of how many sessions `what` is true. Nobody is kept in `peers`, whose memory is used again.
    fn all_ways(&self, peers: &mut Vec<Arc<Peer>>, what: impl Fn(&Way) -> bool) -> usize {
        self.list_peers(peers);
        peers.drain(..).map(|peer| peer.ways.iter().filter(|way| what(way)).count()).sum()
    }

    /// The threads of Bulk and of handshakes are not needed any more.
    pub(crate) fn end_threads(&self) {
        lock(&self.bulk).take();
        lock(&self.secure).take();
    }

    /// Nobody connects any more, and the ports are free, whoever still holds the sockets.
    pub(crate) fn close(&self) {
        self.datagrams.close();
        for listener in lock(&self.listeners).drain(..) {
            // An error says that it does not listen any more.
            let _ = SockRef::from(&*listener).shutdown(Shutdown::Both);
        }
    }

    fn lock(&self) -> MutexGuard<'_, BTreeMap<NodeAddress, Arc<Peer>>> {
        self.peers.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
