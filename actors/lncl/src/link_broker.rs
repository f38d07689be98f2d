//! The broker of direct links: LNCL creates a socket between two clients and passes each an end. It is not on the path
//! of their messages.
//!
//! The node creates the sockets itself, so a client receives only genuine socket ends from it. (Clients pass only
//! offers of rings, and unexpected descriptors: `rings`, `reader`.) The node closes its own copies once they are sent,
//! so the hang-up of one end is the end of its holder. The requester's end waits here for the answer, bounded in number
//! and time.

mod established;
mod pending;
mod unanswered;

use std::{
    cell::RefCell,
    collections::BTreeMap,
    io::IoSlice,
    mem::MaybeUninit,
    os::fd::{AsFd, BorrowedFd, OwnedFd},
    sync::{
        Arc, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicUsize, Ordering},
    },
};

use rustix::{
    io::Errno,
    net::{
        AddressFamily, SendAncillaryBuffer, SendAncillaryMessage, SendFlags, Shutdown, SocketFlags,
        SocketType, sendmsg, socketpair,
    },
};
use sinew_runtime::{
    outcome::{Outcome, Receipt, ReceiptSink, Rejection, Ticket},
    router::{MessageSink, SubmitError},
    tid::{AppAddress, Tid},
    time::Time,
    wire::{Class, Flags, Kind, Message},
};

pub(super) use self::established::Departure;
use sinew_protocol::payload::{self, Introduction, Switch};
use sinew_session::outlet::{Socket, SocketWriter};

use self::{
    established::EstablishedLinks,
    pending::PendingRings,
    unanswered::{Processes, Unanswered},
};

/// Maximum number of link requests to one client without its answer, including abandoned ones. Each is a descriptor on
/// its way to the client. Further requests are rejected with `QueueFull`.
pub(crate) const UNANSWERED_MAX: usize = 16;
/// Maximum number of SWITCHes to one client that it has not confirmed. Their marks exceed the bounds of its queue. A
/// further one is rejected with `QueueFull`, and its sender repeats it.
const SWITCHES_MAX: usize = 1_024;

/// The queue of a client's frames.
pub(super) trait Listener: MessageSink {
    /// Queues a mark behind all earlier frames, without a bound. A later mark could follow frames of its sender's next
    /// incarnation.
    fn submit_mark(&self, mark: Message) -> Result<(), SubmitError>;
}

impl<S: Socket> Listener for SocketWriter<S> {
    fn submit_mark(&self, mark: Message) -> Result<(), SubmitError> {
        self.submit_beyond(mark)
    }
}

/// A client that can have direct links.
pub(super) struct LinkPeer {
    pub(super) tid: Tid,
    /// As the kernel reports it.
    pub(super) pid: u32,
    /// The queue of its frames.
    pub(super) outlet: Arc<dyn Listener>,
    /// Its socket, which can carry descriptors: its frames use rings.
    pub(super) socket: Arc<dyn AsFd + Send + Sync>,
    unanswered: AtomicUsize,
    switches: AtomicUsize,
    /// Its link peers.
    links: EstablishedLinks,
}

impl LinkPeer {
    pub(super) fn new(
        tid: Tid,
        pid: u32,
        outlet: Arc<dyn Listener>,
        socket: Arc<dyn AsFd + Send + Sync>,
    ) -> Self {
        let none = || AtomicUsize::new(0);
        Self {
            tid,
            pid,
            outlet,
            socket,
            unanswered: none(),
            switches: none(),
            links: EstablishedLinks::default(),
        }
    }
}

/// A LNCL_INTRODUCE request.
#[derive(Clone, Copy, Debug)]
pub(super) struct LinkRequest {
    /// Number of the future link. It is unique.
    pub(super) number: u64,
    /// Correlation of the answer.
    pub(super) correlation: u64,
}

/// All clients that can have links.
#[derive(Default)]
pub(super) struct LinkBroker {
    peers: RefCell<BTreeMap<AppAddress, Arc<LinkPeer>>>,
    /// Clients with rings in creation: they can have links soon.
    pending: PendingRings,
    open: Open,
}

/// The unanswered link requests. Any thread may deliver an answer.
type Open = Arc<Mutex<Unanswered<OpenRequest>>>;

impl LinkBroker {
    /// Adds a client, and handles the waiting requests to it.
    pub(super) fn add(&self, peer: LinkPeer) {
        let peer = Arc::new(peer);
        self.peers.borrow_mut().insert(peer.tid.app, peer.clone());
        for (asked, since) in self.pending.arrived(peer.tid) {
            let pending::PendingRequest { requester, request, .. } = asked;
            if let Err(why) = self.begin(requester.clone(), peer.clone(), request, since) {
                notify_rejected(&requester, peer.tid, request, why);
            }
        }
    }

    /// Links `requester` with `to`, at once or when `to` can have links. The requester receives
    /// LNCL_INTRODUCED or an outcome.
    ///
    /// # Errors
    /// The rejection, for the requester.
    pub(super) fn introduce(
        &self,
        requester: Tid,
        to: Tid,
        request: LinkRequest,
        now: Time,
    ) -> Result<(), Rejection> {
        let requester = self.link_peer(requester)?;
        if self.pending.is_expected(to) {
            return self.pending.wait(pending::PendingRequest { requester, to, request }, now);
        }
        let peer = self.link_peer(to)?;
        self.begin(requester, peer, request, now)
    }

    fn begin(
        &self,
        requester: Arc<LinkPeer>,
        peer: Arc<LinkPeer>,
        request: LinkRequest,
        now: Time,
    ) -> Result<(), Rejection> {
        let LinkRequest { number, correlation } = request;
        if requester.tid == peer.tid {
            return Err(Rejection::Unsupported);
        }
        let answer = Answer::begin(peer.clone(), number, self.open.clone())?;
        let of = Processes { requester: requester.pid, peer: peer.pid };
        if !lock(&self.open).has_room_for(of) {
            return Err(Rejection::QueueFull);
        }
        let (their_end, end) = pair().map_err(|_| Rejection::QueueFull)?;
        pass(&*peer.socket, number, &their_end).map_err(|_| Rejection::QueueFull)?;
        drop(their_end);
        let mut message = introduction_frame(Kind::LNCL_INTRODUCTION, &peer, &requester, number);
        message.header.flags = Flags::CONFIRM;
        message.header.correlation = number;
        let ticket = Ticket { source: message.header.source, destination: peer.tid, correlation: number };
        message.receipt = Some(Receipt::new(Arc::new(answer), ticket));
        let asked = OpenRequest { requester, peer: peer.clone(), number, correlation, end };
        lock(&self.open).insert(number, of, asked, now);
        // Such frames are few. If the queue is full it is in use, since a client that has just registered had messages
        // before.
        if let Err(refused) = peer.outlet.submit_mark(message) {
            // The receipt notifies the requester.
            refused.message.reject(refused.why);
        }
        Ok(())
    }

    /// Abandons requests that were not answered in time, and rejects them to their requesters. Returns whether requests
    /// are left.
    pub(super) fn expire(&self, now: Time) -> bool {
        let late = lock(&self.open).expire(now);
        for asked in late {
            asked.answer(Outcome::Rejected(Rejection::QueueFull));
        }
        let are_pending = self.pending.expire(now);
        are_pending || !lock(&self.open).is_empty()
    }

    /// Notifies `to` that `source` continues on their link. It queues one mark per class, behind all waiting messages,
    /// since order holds only within a class. `receipt` confirms the last mark.
    ///
    /// # Errors
    /// The rejection, for the source.
    pub(super) fn pass_marks(
        &self,
        source: Tid,
        to: Tid,
        number: u64,
        receipt: Receipt,
    ) -> Result<(), (Receipt, Rejection)> {
        let Ok(peer) = self.link_peer(to) else { return Err((receipt, Rejection::NoSuchApplication)) };
        if peer.switches.fetch_add(1, Ordering::Relaxed) >= SWITCHES_MAX {
            peer.switches.fetch_sub(1, Ordering::Relaxed);
            return Err((receipt, Rejection::QueueFull));
        }
        let frame =
            payload::frame(Kind::LNCL_SWITCH, source, peer.tid, &Switch { peer: source.bits(), number });
        let correlation = receipt.ticket().correlation;
        let ticket = receipt.ticket();
        let confirmed = Confirmed { peer: peer.clone(), receipt: Mutex::new(Some(receipt)) };
        for class in [Class::Control, Class::Stream] {
            let mut mark = Message::new(frame.header, frame.payload.clone());
            mark.header.class = class;
            // An error means that the peer is gone; the last mark reports that.
            let _ = peer.outlet.submit_mark(mark);
        }
        let mut last = frame;
        last.header.class = Class::Bulk;
        last.header.flags = Flags::CONFIRM;
        last.header.correlation = correlation;
        last.receipt = Some(Receipt::new(Arc::new(confirmed), ticket));
        if let Err(refused) = peer.outlet.submit_mark(last) {
            refused.message.reject(refused.why);
        }
        Ok(())
    }

    fn link_peer(&self, tid: Tid) -> Result<Arc<LinkPeer>, Rejection> {
        let peers = self.peers.borrow();
        let peer = peers.get(&tid.app).filter(|peer| peer.tid == tid);
        peer.cloned().ok_or(Rejection::Unsupported)
    }
}

/// Counts a SWITCH until its receiver has answered or is gone.
struct Confirmed {
    peer: Arc<LinkPeer>,
    receipt: Mutex<Option<Receipt>>,
}

impl ReceiptSink for Confirmed {
    fn settle(&self, _: Ticket, outcome: Outcome) {
        let receipt = self.receipt.lock().unwrap_or_else(PoisonError::into_inner).take();
        if let Some(receipt) = receipt {
            self.peer.switches.fetch_sub(1, Ordering::Relaxed);
            receipt.settle(outcome);
        }
    }
}

/// The state of a request until the peer answers or the deadline expires.
struct OpenRequest {
    requester: Arc<LinkPeer>,
    peer: Arc<LinkPeer>,
    number: u64,
    correlation: u64,
    /// The requester's end of the socket.
    end: OwnedFd,
}

impl OpenRequest {
    /// Notifies the requester, and passes its end of the socket.
    fn answer(self, outcome: Outcome) {
        let Self { requester, peer, number, correlation, end } = self;
        let mut answer = match outcome {
            Outcome::Delivered if pass(&*requester.socket, number, &end).is_ok() => {
                requester.links.add(&peer, number);
                peer.links.add(&requester, number);
                introduction_frame(Kind::LNCL_INTRODUCED, &requester, &peer, number)
            }
            // Its socket is full, or this process has no descriptors left. A later request may succeed.
            Outcome::Delivered => {
                outcome_frame(peer.tid, requester.tid, Outcome::Rejected(Rejection::QueueFull))
            }
            Outcome::Rejected(_)
            | Outcome::Expired
            | Outcome::Failed
            | Outcome::PeerLost
            | Outcome::Unknown => outcome_frame(peer.tid, requester.tid, outcome),
        };
        answer.header.correlation = correlation;
        // An error means that the requester is gone, or does not read and continues through the node.
        if requester.outlet.submit(answer).is_err() {
            // The requester has no link, so the peer's end does not concern it. The peer sees the end of its
            // socket.
            peer.links.forget(requester.tid.app);
            // An error means that it has ended already.
            let _ = rustix::net::shutdown(&end, Shutdown::Both);
        }
    }
}

/// Delivers the peer's answer, and counts the request until then.
struct Answer {
    peer: Arc<LinkPeer>,
    number: u64,
    open: Open,
}

impl Answer {
    fn begin(peer: Arc<LinkPeer>, number: u64, open: Open) -> Result<Self, Rejection> {
        let answer = Self { peer, number, open };
        if answer.peer.unanswered.fetch_add(1, Ordering::Relaxed) >= UNANSWERED_MAX {
            return Err(Rejection::QueueFull);
        }
        Ok(answer)
    }
}

impl ReceiptSink for Answer {
    fn settle(&self, _: Ticket, outcome: Outcome) {
        let asked = lock(&self.open).remove(self.number);
        // `None`: the request was abandoned, and the requester notified.
        if let Some(asked) = asked {
            asked.answer(outcome);
        }
    }
}

impl Drop for Answer {
    fn drop(&mut self) {
        self.peer.unanswered.fetch_sub(1, Ordering::Relaxed);
    }
}

fn lock(open: &Mutex<Unanswered<OpenRequest>>) -> MutexGuard<'_, Unanswered<OpenRequest>> {
    open.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Returns the notification of `to` about `peer`.
fn introduction_frame(kind: Kind, to: &LinkPeer, peer: &LinkPeer, number: u64) -> Message {
    let introduction = Introduction { peer: peer.tid.bits(), pid: peer.pid, number };
    payload::frame(kind, payload::lncl_of(to.tid.node), to.tid, &introduction)
}

/// Notifies `requester` that its link to `to` is rejected.
fn notify_rejected(requester: &LinkPeer, to: Tid, request: LinkRequest, why: Rejection) {
    let mut answer = outcome_frame(to, requester.tid, Outcome::Rejected(why));
    answer.header.correlation = request.correlation;
    // An error means that the requester is gone, or does not read and continues through the node.
    let _ = requester.outlet.submit(answer);
}

fn outcome_frame(about: Tid, to: Tid, outcome: Outcome) -> Message {
    Message::outcome(Ticket { source: to, destination: about, correlation: 0 }, outcome)
}

fn pair() -> Result<(OwnedFd, OwnedFd), Errno> {
    let flags = SocketFlags::CLOEXEC | SocketFlags::NONBLOCK;
    socketpair(AddressFamily::UNIX, SocketType::STREAM, flags, None)
}

/// Passes one end of a link to a client: the link's number, eight bytes little-endian, with the descriptor beside it.
fn pass(socket: &dyn AsFd, number: u64, end: &OwnedFd) -> Result<(), Errno> {
    let ends: [BorrowedFd<'_>; 1] = [end.as_fd()];
    let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(1))];
    let mut control = SendAncillaryBuffer::new(&mut space);
    let pushed = control.push(SendAncillaryMessage::ScmRights(&ends));
    assert!(pushed, "the space is for one descriptor");
    let number = number.to_le_bytes();
    let flags = SendFlags::DONTWAIT | SendFlags::NOSIGNAL;
    match sendmsg(socket.as_fd(), &[IoSlice::new(&number)], &mut control, flags) {
        Ok(count) if count == number.len() => Ok(()),
        // A socket takes eight bytes as a whole.
        Ok(_) => Err(Errno::MSGSIZE),
        Err(error) => Err(error),
    }
}

#[cfg(test)]
mod tests;
