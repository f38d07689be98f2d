//! Introductions: LNCL makes a socket between two clients, gives each an end, and is not on the path of what follows.
//!
//! No client ever passes a descriptor to the node: it makes the sockets itself, so that nobody gets a descriptor from it that
//! is not one. Its own copies are closed as soon as they are on their way: a hang-up of one end is the end of its holder.

use std::{
    cell::RefCell,
    collections::BTreeMap,
    io::IoSlice,
    mem::MaybeUninit,
    os::fd::{AsFd, BorrowedFd, OwnedFd},
    sync::{
        Arc, Mutex, PoisonError,
        atomic::{AtomicUsize, Ordering},
    },
};

use rustix::{
    io::Errno,
    net::{
        AddressFamily, SendAncillaryBuffer, SendAncillaryMessage, SendFlags, SocketFlags, SocketType,
        sendmsg, socketpair,
    },
};
use sinew_runtime::{
    outcome::{Outcome, Receipt, ReceiptSink, Rejection, Ticket},
    router::{Outlet, Refused},
    tid::{AppAddress, Tid},
    wire::{Class, Flags, Kind, Message},
};

use super::payload::{self, Introduction, Switch};
use crate::outlet::{Socket, StreamOutlet};

/// Introductions that one client may have asked for and that are not answered yet; one more is refused as `QueueFull`.
pub(crate) const ASKED_MAX: usize = 64;
/// Introductions to one client that it has not answered: each is a descriptor on its way to it. One more is refused likewise.
pub(crate) const UNANSWERED_MAX: usize = 16;
/// SWITCHes to one client that it has not confirmed: their marks wait beside the bounds of its queue. One more is refused as
/// `QueueFull`, and its sender says it again.
const SWITCHES_MAX: usize = 1_024;

/// What takes the frames of a client.
pub(super) trait Listener: Outlet {
    /// Takes a mark, which keeps its place behind all that was submitted before, whatever the bounds: one that came later
    /// could come behind what the next life of its sender sends.
    fn submit_mark(&self, mark: Message) -> Result<(), Refused>;
}

impl<S: Socket> Listener for StreamOutlet<S> {
    fn submit_mark(&self, mark: Message) -> Result<(), Refused> {
        self.submit_beyond(mark)
    }
}

/// A client that others may be introduced to.
pub(super) struct Party {
    pub(super) tid: Tid,
    /// As the kernel says.
    pub(super) pid: u32,
    /// What takes its frames.
    pub(super) outlet: Arc<dyn Listener>,
    /// Its socket, which takes descriptors: its frames go through rings.
    pub(super) socket: Arc<dyn AsFd + Send + Sync>,
    asked: AtomicUsize,
    unanswered: AtomicUsize,
    switches: AtomicUsize,
}

impl Party {
    pub(super) fn new(
        tid: Tid,
        pid: u32,
        outlet: Arc<dyn Listener>,
        socket: Arc<dyn AsFd + Send + Sync>,
    ) -> Self {
        let none = || AtomicUsize::new(0);
        Self { tid, pid, outlet, socket, asked: none(), unanswered: none(), switches: none() }
    }
}

/// All whom others may be introduced to.
#[derive(Default)]
pub(super) struct Introductions(RefCell<BTreeMap<AppAddress, Arc<Party>>>);

impl Introductions {
    pub(super) fn add(&self, party: Party) {
        self.0.borrow_mut().insert(party.tid.app, Arc::new(party));
    }

    pub(super) fn remove(&self, app: AppAddress) {
        self.0.borrow_mut().remove(&app);
    }

    /// Introduces `asker` to `to` by the link `number`. The asker is told LNCL_INTRODUCED, or an outcome, as `correlation`.
    ///
    /// # Errors
    /// Why not, to be told to the asker.
    pub(super) fn introduce(
        &self,
        asker: Tid,
        to: Tid,
        number: u64,
        correlation: u64,
    ) -> Result<(), Rejection> {
        let (asker, peer) = (self.party(asker)?, self.party(to)?);
        if asker.tid == peer.tid {
            return Err(Rejection::Unsupported);
        }
        let pending = Pending::begin(asker, peer)?;
        let (their_end, own_end) = pair().map_err(|_| Rejection::QueueFull)?;
        pass(&*pending.peer.socket, number, &their_end).map_err(|_| Rejection::QueueFull)?;
        drop(their_end);
        let (peer, asker) = (pending.peer.clone(), pending.asker.clone());
        let mut message = told(Kind::LNCL_INTRODUCTION, &peer, &asker, number);
        message.header.flags = Flags::CONFIRM;
        message.header.correlation = number;
        let ticket = Ticket { source: message.header.source, destination: peer.tid, correlation: number };
        let answer = Answer { pending, number, correlation, end: Mutex::new(Some(own_end)) };
        message.receipt = Some(Receipt::new(Arc::new(answer), ticket));
        if let Err(refused) = peer.outlet.submit(message) {
            // The asker is told by the receipt.
            refused.message.reject(refused.why);
        }
        Ok(())
    }

    /// Tells `to` by marks that `source` goes on on their link: one behind all that waits in each class, for only within a
    /// class is the order kept. The last one is confirmed by `receipt`.
    ///
    /// # Errors
    /// Why not, to be told to the source.
    pub(super) fn pass_marks(
        &self,
        source: Tid,
        to: Tid,
        number: u64,
        receipt: Receipt,
    ) -> Result<(), (Receipt, Rejection)> {
        let Ok(peer) = self.party(to) else { return Err((receipt, Rejection::NoSuchApplication)) };
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
            // Not taken: it has gone, which the last one tells.
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

    fn party(&self, tid: Tid) -> Result<Arc<Party>, Rejection> {
        let parties = self.0.borrow();
        let party = parties.get(&tid.app).filter(|party| party.tid == tid);
        party.cloned().ok_or(Rejection::Unsupported)
    }
}

/// Counts a SWITCH until the one who was to hear it has answered, or has gone.
struct Confirmed {
    peer: Arc<Party>,
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

/// One introduction under way, in the counts of both.
struct Pending {
    asker: Arc<Party>,
    peer: Arc<Party>,
}

impl Pending {
    fn begin(asker: Arc<Party>, peer: Arc<Party>) -> Result<Self, Rejection> {
        let pending = Self { asker, peer };
        let asked = pending.asker.asked.fetch_add(1, Ordering::Relaxed);
        let unanswered = pending.peer.unanswered.fetch_add(1, Ordering::Relaxed);
        if asked >= ASKED_MAX || unanswered >= UNANSWERED_MAX {
            return Err(Rejection::QueueFull);
        }
        Ok(pending)
    }
}

impl Drop for Pending {
    fn drop(&mut self) {
        self.asker.asked.fetch_sub(1, Ordering::Relaxed);
        self.peer.unanswered.fetch_sub(1, Ordering::Relaxed);
    }
}

/// Carries the answer of the one who was asked to the one who asks, and with it the other end.
struct Answer {
    pending: Pending,
    number: u64,
    correlation: u64,
    end: Mutex<Option<OwnedFd>>,
}

impl ReceiptSink for Answer {
    fn settle(&self, _: Ticket, outcome: Outcome) {
        let end = self.end.lock().unwrap_or_else(PoisonError::into_inner).take();
        let Pending { asker, peer } = &self.pending;
        let mut answer = match (outcome, end) {
            (Outcome::Delivered, Some(end)) if pass(&*asker.socket, self.number, &end).is_ok() => {
                told(Kind::LNCL_INTRODUCED, asker, peer, self.number)
            }
            // Its socket takes nothing, or this process has no descriptors left. Later, perhaps.
            (Outcome::Delivered, _) => {
                outcome_frame(peer.tid, asker.tid, Outcome::Rejected(Rejection::QueueFull))
            }
            (other, _) => outcome_frame(peer.tid, asker.tid, other),
        };
        answer.header.correlation = self.correlation;
        // Not taken: it is gone, or it does not read and goes on through the node.
        let _ = asker.outlet.submit(answer);
    }
}

/// What is told to `to` about `peer`.
fn told(kind: Kind, to: &Party, peer: &Party, number: u64) -> Message {
    let introduction = Introduction { peer: peer.tid.bits(), pid: peer.pid, number };
    payload::frame(kind, payload::lncl_of(to.tid.node), to.tid, &introduction)
}

fn outcome_frame(about: Tid, to: Tid, outcome: Outcome) -> Message {
    Message::outcome(Ticket { source: to, destination: about, correlation: 0 }, outcome)
}

fn pair() -> Result<(OwnedFd, OwnedFd), Errno> {
    let flags = SocketFlags::CLOEXEC | SocketFlags::NONBLOCK;
    socketpair(AddressFamily::UNIX, SocketType::STREAM, flags, None)
}

/// Passes one end of a link to a client: the link's number, eight bytes little-endian, and the descriptor beside it.
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
mod tests {
    use std::{
        os::unix::net::UnixStream,
        sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel},
    };

    use rustix::net::{RecvAncillaryBuffer, RecvAncillaryMessage, RecvFlags, recv, recvmsg};
    use sinew_runtime::tid::NodeAddress;

    use super::*;

    struct Queue {
        frames: SyncSender<Message>,
        /// More than are passed.
        marks: SyncSender<Message>,
    }

    impl Listener for Queue {
        fn submit_mark(&self, mark: Message) -> Result<(), Refused> {
            self.marks.send(mark).map_err(|error| Refused::new(error.0, Rejection::Closed))
        }
    }

    impl Outlet for Queue {
        fn submit(&self, message: Message) -> Result<(), Refused> {
            self.frames.try_send(message).map_err(|error| match error {
                TrySendError::Full(message) => Refused::new(message, Rejection::QueueFull),
                TrySendError::Disconnected(message) => Refused::new(message, Rejection::Closed),
            })
        }
    }

    struct Client {
        tid: Tid,
        frames: Receiver<Message>,
        marks: Receiver<Message>,
        socket: UnixStream,
    }

    fn tid(app: u32) -> Tid {
        Tid::new(NodeAddress::new(0x7f00_0001), AppAddress::new(app))
    }

    fn join(introductions: &Introductions, app: u32, room: usize) -> Client {
        let ((sender, frames), (marking, marks)) = (sync_channel(room), sync_channel(4 * SWITCHES_MAX));
        let (theirs, socket) = UnixStream::pair().unwrap();
        let party =
            Party::new(tid(app), app, Arc::new(Queue { frames: sender, marks: marking }), Arc::new(theirs));
        introductions.add(party);
        Client { tid: tid(app), frames, marks, socket }
    }

    impl Client {
        fn next(&self) -> Message {
            self.frames.try_recv().expect("a frame")
        }

        /// The number and the descriptor that came over the socket.
        fn end(&self) -> (u64, OwnedFd) {
            let mut number = [0; 8];
            let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(1))];
            let mut control = RecvAncillaryBuffer::new(&mut space);
            let mut parts = [std::io::IoSliceMut::new(&mut number)];
            let flags = RecvFlags::DONTWAIT | RecvFlags::CMSG_CLOEXEC;
            recvmsg(&self.socket, &mut parts, &mut control, flags).unwrap();
            let Some(RecvAncillaryMessage::ScmRights(mut ends)) = control.drain().next() else {
                panic!("no descriptor")
            };
            (u64::from_le_bytes(number), ends.next().expect("a descriptor"))
        }
    }

    fn outcome_of(message: &Message) -> Outcome {
        assert_eq!(message.header.kind, Kind::OUTCOME);
        Outcome::from_code(message.payload[0]).expect("an outcome")
    }

    fn introduction_of(message: &Message, kind: Kind) -> Introduction {
        assert_eq!(message.header.kind, kind);
        payload::read(&message.payload).unwrap()
    }

    #[test]
    fn both_get_an_end_of_one_socket_and_the_node_keeps_none() {
        let introductions = Introductions::default();
        let (asker, peer) = (join(&introductions, 1, 4), join(&introductions, 2, 4));
        introductions.introduce(asker.tid, peer.tid, 7, 99).unwrap();
        let mut message = peer.next();
        let told = introduction_of(&message, Kind::LNCL_INTRODUCTION);
        assert_eq!(told, Introduction { peer: asker.tid.bits(), pid: 1, number: 7 });
        assert!(asker.frames.try_recv().is_err(), "the asker is told when the peer agrees");
        message.settle(Outcome::Delivered);
        let answer = asker.next();
        assert_eq!(answer.header.correlation, 99);
        let told = introduction_of(&answer, Kind::LNCL_INTRODUCED);
        assert_eq!(told, Introduction { peer: peer.tid.bits(), pid: 2, number: 7 });
        let ((own_number, own), (their_number, theirs)) = (asker.end(), peer.end());
        assert_eq!((own_number, their_number), (7, 7));
        rustix::net::send(&own, b"x", SendFlags::empty()).unwrap();
        assert_eq!(recv(&theirs, &mut [0; 2][..], RecvFlags::empty()).unwrap().0, 1);
        drop(own);
        assert_eq!(recv(&theirs, &mut [0; 2][..], RecvFlags::DONTWAIT).unwrap().0, 0, "nobody else has it");
    }

    #[test]
    fn who_is_refused_is_told_so_and_the_peer_sees_the_end_of_the_link() {
        let introductions = Introductions::default();
        let (asker, peer) = (join(&introductions, 1, 4), join(&introductions, 2, 4));
        introductions.introduce(asker.tid, peer.tid, 7, 99).unwrap();
        peer.next().settle(Outcome::Rejected(Rejection::QueueFull));
        let answer = asker.next();
        assert_eq!(
            (answer.header.correlation, outcome_of(&answer)),
            (99, Outcome::Rejected(Rejection::QueueFull))
        );
        let (_, theirs) = peer.end();
        assert_eq!(recv(&theirs, &mut [0; 2][..], RecvFlags::DONTWAIT).unwrap().0, 0);
    }

    #[test]
    fn who_is_not_there_or_oneself_cannot_be_met() {
        let introductions = Introductions::default();
        let asker = join(&introductions, 1, 4);
        assert_eq!(introductions.introduce(asker.tid, tid(3), 1, 1), Err(Rejection::Unsupported));
        assert_eq!(introductions.introduce(asker.tid, asker.tid, 1, 1), Err(Rejection::Unsupported));
        let gone = join(&introductions, 2, 4);
        introductions.remove(gone.tid.app);
        assert_eq!(introductions.introduce(asker.tid, gone.tid, 1, 1), Err(Rejection::Unsupported));
        assert_eq!(introductions.introduce(gone.tid, asker.tid, 1, 1), Err(Rejection::Unsupported));
    }

    #[test]
    fn a_peer_that_does_not_answer_has_so_many_descriptors_on_their_way_and_no_more() {
        let introductions = Introductions::default();
        let (asker, peer) = (join(&introductions, 1, 64), join(&introductions, 2, 64));
        for number in 0..UNANSWERED_MAX as u64 {
            introductions.introduce(asker.tid, peer.tid, number, number).unwrap();
        }
        assert_eq!(introductions.introduce(asker.tid, peer.tid, 50, 50), Err(Rejection::QueueFull));
        peer.next().settle(Outcome::Delivered);
        assert_eq!(introductions.introduce(asker.tid, peer.tid, 51, 51), Ok(()));
    }

    #[test]
    fn a_peer_that_takes_no_frames_or_dies_is_an_answer() {
        let introductions = Introductions::default();
        let (asker, peer) = (join(&introductions, 1, 4), join(&introductions, 2, 1));
        introductions.introduce(asker.tid, peer.tid, 1, 1).unwrap();
        introductions.introduce(asker.tid, peer.tid, 2, 2).unwrap();
        let refused = asker.next();
        assert_eq!(
            (refused.header.correlation, outcome_of(&refused)),
            (2, Outcome::Rejected(Rejection::QueueFull))
        );
        drop(peer);
        let failed = asker.next();
        assert_eq!((failed.header.correlation, outcome_of(&failed)), (1, Outcome::Failed));
    }

    #[test]
    fn a_mark_goes_behind_each_class_whatever_the_bounds_and_so_many_are_unconfirmed_at_most() {
        struct Told(SyncSender<Outcome>);
        impl ReceiptSink for Told {
            fn settle(&self, _: Ticket, outcome: Outcome) {
                // At the end of this test nobody listens.
                let _ = self.0.try_send(outcome);
            }
        }
        let introductions = Introductions::default();
        let peer = join(&introductions, 2, 1);
        let (sender, outcome) = sync_channel(1);
        let ticket = Ticket { source: tid(1), destination: peer.tid, correlation: 5 };
        let receipt = || Receipt::new(Arc::new(Told(sender.clone())), ticket);
        let pass = |to| {
            introductions.pass_marks(tid(1), to, 7, receipt()).map_err(|(receipt, why)| {
                receipt.settle(Outcome::Rejected(why));
                why
            })
        };
        assert_eq!(pass(peer.tid), Ok(()), "there is room for one, and three are taken");
        let (first, second, mut third) =
            (peer.marks.try_recv().unwrap(), peer.marks.try_recv().unwrap(), peer.marks.try_recv().unwrap());
        assert_eq!(
            [&first, &second, &third].map(|mark| (mark.header.class, mark.header.flags.has(Flags::CONFIRM))),
            [(Class::Control, false), (Class::Stream, false), (Class::Bulk, true)]
        );
        assert_eq!(third.header.correlation, 5);
        third.settle(Outcome::Delivered);
        assert_eq!(outcome.recv(), Ok(Outcome::Delivered));
        assert_eq!(pass(tid(9)), Err(Rejection::NoSuchApplication));
        assert_eq!(outcome.recv(), Ok(Outcome::Rejected(Rejection::NoSuchApplication)));
        for _ in 0..SWITCHES_MAX {
            assert_eq!(pass(peer.tid), Ok(()));
        }
        assert_eq!(pass(peer.tid), Err(Rejection::QueueFull));
        assert_eq!(outcome.recv(), Ok(Outcome::Rejected(Rejection::QueueFull)));
    }
}
