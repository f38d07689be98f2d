//! Introductions: LNCL makes a socket between two clients, gives each an end, and is not on the path of what follows.
//!
//! No client passes a descriptor to the node for it: it makes the sockets itself, so that nobody gets a descriptor from it that
//! is not one. (What clients do pass are offers of rings, and what nobody has asked for: `rings`, `reader`.) Its own copies are closed as soon as they are on their way: a hang-up of one end is the end of its holder. The asker's
//! end waits here for the answer, within bounds of number and time.

mod coming;
mod met;
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
    router::{Outlet, Refused},
    tid::{AppAddress, Tid},
    time::Time,
    wire::{Class, Flags, Kind, Message},
};

pub(super) use self::met::Leaves;
use self::{
    coming::Coming,
    met::Met,
    unanswered::{Processes, Unanswered},
};
use super::payload::{self, Introduction, Switch};
use crate::outlet::{Socket, StreamOutlet};

/// Introductions to one client that it has not answered, also those that were given up: each is a descriptor on its way to it. One
/// more is refused as `QueueFull`.
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
    unanswered: AtomicUsize,
    switches: AtomicUsize,
    /// Those whom it has a link with.
    met: Met,
}

impl Party {
    pub(super) fn new(
        tid: Tid,
        pid: u32,
        outlet: Arc<dyn Listener>,
        socket: Arc<dyn AsFd + Send + Sync>,
    ) -> Self {
        let none = || AtomicUsize::new(0);
        Self { tid, pid, outlet, socket, unanswered: none(), switches: none(), met: Met::default() }
    }
}

/// A LNCL_INTRODUCE.
#[derive(Clone, Copy, Debug)]
pub(super) struct Question {
    /// Of the link that is to be; no other has it.
    pub(super) number: u64,
    /// Of the answer.
    pub(super) correlation: u64,
}

/// All whom others may be introduced to.
#[derive(Default)]
pub(super) struct Introductions {
    parties: RefCell<BTreeMap<AppAddress, Arc<Party>>>,
    /// Those whose rings are being made: they can be met in a moment.
    coming: Coming,
    open: Open,
}

/// The introductions that are not answered. Any thread may bring an answer.
type Open = Arc<Mutex<Unanswered<Asked>>>;

impl Introductions {
    /// A client that can be met from now on, also by those who have asked for it before.
    pub(super) fn add(&self, party: Party) {
        let party = Arc::new(party);
        self.parties.borrow_mut().insert(party.tid.app, party.clone());
        for (asked, since) in self.coming.arrived(party.tid) {
            let coming::Asked { asker, question, .. } = asked;
            if let Err(why) = self.begin(asker.clone(), party.clone(), question, since) {
                tell_refused(&asker, party.tid, question, why);
            }
        }
    }

    /// Introduces `asker` to `to` as it has asked, at once or when `to` can be met. The asker is told LNCL_INTRODUCED, or an outcome.
    ///
    /// # Errors
    /// Why not, to be told to the asker.
    pub(super) fn introduce(
        &self,
        asker: Tid,
        to: Tid,
        question: Question,
        now: Time,
    ) -> Result<(), Rejection> {
        let asker = self.party(asker)?;
        if self.coming.is_expected(to) {
            return self.coming.wait(coming::Asked { asker, to, question }, now);
        }
        let peer = self.party(to)?;
        self.begin(asker, peer, question, now)
    }

    fn begin(
        &self,
        asker: Arc<Party>,
        peer: Arc<Party>,
        question: Question,
        now: Time,
    ) -> Result<(), Rejection> {
        let Question { number, correlation } = question;
        if asker.tid == peer.tid {
            return Err(Rejection::Unsupported);
        }
        let answer = Answer::begin(peer.clone(), number, self.open.clone())?;
        let of = Processes { asker: asker.pid, peer: peer.pid };
        if !lock(&self.open).has_room_for(of) {
            return Err(Rejection::QueueFull);
        }
        let (their_end, end) = pair().map_err(|_| Rejection::QueueFull)?;
        pass(&*peer.socket, number, &their_end).map_err(|_| Rejection::QueueFull)?;
        drop(their_end);
        let mut message = told(Kind::LNCL_INTRODUCTION, &peer, &asker, number);
        message.header.flags = Flags::CONFIRM;
        message.header.correlation = number;
        let ticket = Ticket { source: message.header.source, destination: peer.tid, correlation: number };
        message.receipt = Some(Receipt::new(Arc::new(answer), ticket));
        let asked = Asked { asker, peer: peer.clone(), number, correlation, end };
        lock(&self.open).insert(number, of, asked, now);
        // Few, and where its queue is full it is in use: one that has just come had messages before.
        if let Err(refused) = peer.outlet.submit_mark(message) {
            // The asker is told by the receipt.
            refused.message.reject(refused.why);
        }
        Ok(())
    }

    /// Gives up what was not answered in time, and tells the askers that it is not to be now.
    pub(super) fn give_up(&self, now: Time) {
        let late = lock(&self.open).give_up(now);
        for asked in late {
            asked.answer(Outcome::Rejected(Rejection::QueueFull));
        }
        self.coming.give_up(now);
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
        let parties = self.parties.borrow();
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

/// What is kept for who asks, until the other side has answered or the time for it is over.
struct Asked {
    asker: Arc<Party>,
    peer: Arc<Party>,
    number: u64,
    correlation: u64,
    /// The asker's end.
    end: OwnedFd,
}

impl Asked {
    /// Tells the asker, and passes its end with it.
    fn answer(self, outcome: Outcome) {
        let Self { asker, peer, number, correlation, end } = self;
        let mut answer = match outcome {
            Outcome::Delivered if pass(&*asker.socket, number, &end).is_ok() => {
                asker.met.add(&peer, number);
                peer.met.add(&asker, number);
                told(Kind::LNCL_INTRODUCED, &asker, &peer, number)
            }
            // Its socket takes nothing, or this process has no descriptors left. Later, perhaps.
            Outcome::Delivered => outcome_frame(peer.tid, asker.tid, Outcome::Rejected(Rejection::QueueFull)),
            Outcome::Rejected(_)
            | Outcome::Expired
            | Outcome::Failed
            | Outcome::PeerLost
            | Outcome::Unknown => outcome_frame(peer.tid, asker.tid, outcome),
        };
        answer.header.correlation = correlation;
        // Not taken: it is gone, or it does not read and goes on through the node.
        if asker.outlet.submit(answer).is_err() {
            // It knows of no link, so nobody's death on it concerns it; and the other side sees that there is none.
            peer.met.forget(asker.tid.app);
            // An error means that it has ended already.
            let _ = rustix::net::shutdown(&end, Shutdown::Both);
        }
    }
}

/// Carries the answer of the one who was asked, and counts the question until then.
struct Answer {
    peer: Arc<Party>,
    number: u64,
    open: Open,
}

impl Answer {
    fn begin(peer: Arc<Party>, number: u64, open: Open) -> Result<Self, Rejection> {
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
        // Given up: the asker was told so.
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

fn lock(open: &Mutex<Unanswered<Asked>>) -> MutexGuard<'_, Unanswered<Asked>> {
    open.lock().unwrap_or_else(PoisonError::into_inner)
}

/// What is told to `to` about `peer`.
fn told(kind: Kind, to: &Party, peer: &Party, number: u64) -> Message {
    let introduction = Introduction { peer: peer.tid.bits(), pid: peer.pid, number };
    payload::frame(kind, payload::lncl_of(to.tid.node), to.tid, &introduction)
}

/// Tells `asker` that it is not introduced to `to`.
fn tell_refused(asker: &Party, to: Tid, question: Question, why: Rejection) {
    let mut answer = outcome_frame(to, asker.tid, Outcome::Rejected(why));
    answer.header.correlation = question.correlation;
    // Not taken: it is gone, or it does not read and goes on through the node.
    let _ = asker.outlet.submit(answer);
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
mod tests;
