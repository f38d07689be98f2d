//! A ring in each direction in shared memory, and a socket that signals the other end's close.

mod reading;
mod writing;

use std::{
    collections::VecDeque,
    io::IoSlice,
    os::{
        fd::{AsFd, BorrowedFd},
        unix::net::UnixStream,
    },
    sync::{
        Arc, Mutex, OnceLock, PoisonError, TryLockError,
        atomic::{AtomicBool, Ordering},
    },
    time::Duration,
};

use bytes::BytesMut;
use rustix::net::{RecvFlags, Shutdown, recv};
use sinew_protocol::{
    payload::{self, Refusal},
    ring,
};
use sinew_runtime::{
    outcome::{Outcome, ReceiptSink, Ticket},
    wire::{FrameCodec, Header, Kind, Message},
};
use sinew_shm::{Armed, BellKind, Capacity, Counters, HangUp, LoanError, Producer, Region, RoomError, Wait};
use tokio::sync::Notify;
use tokio_util::codec::Decoder;

use super::{Ended, LinkOptions};
use crate::ApiError;

pub(crate) use reading::{Arrived, End, Reader, waiter};
pub(crate) use writing::{Begun, Rest};

/// Maximum bytes taken from a ring at once.
pub(crate) const ENOUGH: usize = 64 * 1024;
/// Maximum number of outcomes that wait for room. It covers the largest `node.mailbox_capacity`, which bounds
/// the confirmed messages of a node with one client, plus the marks of 1,024 links and 16 unanswered
/// introductions. So no outcome is dropped on the path through a node. On a direct link an outcome beyond it
/// is dropped: its sender counts it as Unknown at its own deadline.
pub(super) const PENDING_MAX: usize = 65_536 + 1_024 + 16;
/// Maximum bytes of the reason, with its frame, that a node sends when it closes.
const REFUSAL_BYTES_MAX: usize = 4_096;
/// Longest sleep at a ring: after it, pending outcomes of other threads are written and the socket is checked.
pub(crate) const CHECK_INTERVAL: Duration = Duration::from_millis(20);

/// Returns whether this process can have rings; determined once.
pub(super) fn is_available() -> bool {
    static AVAILABLE: OnceLock<bool> = OnceLock::new();
    *AVAILABLE.get_or_init(|| match Region::create(Capacity::MIN, BellKind::Futex) {
        Ok(_) => true,
        Err(why) => {
            sinew_runtime::log::here!(warn: %why, "messages to the node go through its socket");
            false
        }
    })
}

/// The writing half.
#[derive(Debug)]
pub(crate) struct Writer {
    socket: Arc<UnixStream>,
    /// `None` while a message is lent. Frames are written completely, one after the other. Boxed, because it
    /// moves with each loan.
    producer: Mutex<Option<Box<Producer>>>,
    /// Outcomes that found no room, or a lent ring.
    pending: Mutex<VecDeque<Message>>,
    /// Whether there are any; changed with `pending` locked. Checked with each message.
    has_pending: AtomicBool,
    /// Notified when a thread has left a pending outcome, so that a waiting task checks again.
    pub(super) pending_notify: Notify,
    stall_timeout: Duration,
}

impl Writer {
    pub(crate) fn new(socket: Arc<UnixStream>, mut producer: Producer, options: &LinkOptions) -> Self {
        producer.set_spin(options.spin);
        let (producer, pending) = (Mutex::new(Some(Box::new(producer))), Mutex::default());
        let has_pending = AtomicBool::new(false);
        Self {
            socket,
            producer,
            pending,
            has_pending,
            pending_notify: Notify::new(),
            stall_timeout: options.stall_timeout,
        }
    }

    /// Writes one frame that fits into half the ring; waits for room for at most the link's stall timeout.
    pub(crate) fn write(&self, message: &Message) -> Result<(), ApiError> {
        let head = message.header.encode_in_memory(message.payload.len());
        let parts = [IoSlice::new(&head), IoSlice::new(&message.payload)];
        let mut producer = self.producer.lock().unwrap_or_else(PoisonError::into_inner);
        let written = match producer.as_deref_mut() {
            Some(producer) => self.write_to(producer, &parts, message.size()),
            None => Err(ApiError::LoanActive),
        };
        drop(producer);
        self.flush_pending();
        written
    }

    /// Returns the counters of this side that the peer can read; `None` while the ring is lent.
    pub(crate) fn counters(&self) -> Option<Counters> {
        let producer = self.producer.lock().unwrap_or_else(PoisonError::into_inner);
        producer.as_deref().map(Producer::counters)
    }

    /// Writes one frame if it can be one record and there is room for it now. Returns whether it was written. An
    /// error of the ring appears again in [`begin`](Self::begin).
    pub(crate) fn write_at_once(&self, header: &Header, payload: &[u8]) -> bool {
        self.flush_pending();
        let mut producer = self.producer.lock().unwrap_or_else(PoisonError::into_inner);
        let written =
            producer.as_deref_mut().is_some_and(|producer| ring::write_frame(producer, header, payload));
        drop(producer);
        self.flush_pending();
        written
    }

    /// Writes one frame if there is contiguous room for all of it now. Returns whether there was.
    pub(crate) fn try_write(&self, message: &Message) -> Result<bool, ApiError> {
        self.flush_pending();
        let head = message.header.encode_in_memory(message.payload.len());
        let mut producer = self.producer.lock().unwrap_or_else(PoisonError::into_inner);
        let Some(producer) = producer.as_deref_mut() else { return Ok(false) };
        let parts = [IoSlice::new(&head), IoSlice::new(&message.payload)];
        if ring::piece(producer, message.size()) < message.size() {
            return Ok(false);
        }
        match ring::write(producer, &parts) {
            Ok(_) => Ok(true),
            Err(LoanError::Full { .. }) => Ok(false),
            Err(error @ (LoanError::TooLong { .. } | LoanError::Corrupt(_))) => {
                self.close();
                Err(ApiError::Closed(error.to_string()))
            }
        }
    }

    /// Takes the ring out, with room for `length` bytes set aside. Returns `None` if there is no room now, or
    /// if the ring is lent.
    pub(super) fn take_out(&self, length: usize) -> Option<Box<Producer>> {
        // Pending outcomes would otherwise wait for the whole loan.
        self.flush_pending();
        let mut place = self.producer.lock().unwrap_or_else(PoisonError::into_inner);
        // The error appears again when the message is sent.
        place.as_deref_mut()?.loan(length).ok()?.set_aside();
        place.take()
    }

    /// Puts the ring back, and writes the outcomes that became pending meanwhile.
    pub(super) fn put_back(&self, producer: Box<Producer>) {
        *self.producer.lock().unwrap_or_else(PoisonError::into_inner) = Some(producer);
        self.flush_pending();
    }

    /// Announces that a task waits for room for a frame of `length` bytes.
    pub(crate) fn arm(&self, length: usize) -> Armed {
        let mut producer = self.producer.lock().unwrap_or_else(PoisonError::into_inner);
        producer.as_deref_mut().map_or(Armed::Ready, |producer| writing::arm(producer, length))
    }

    /// Records that the task is awake.
    pub(crate) fn disarm(&self) {
        if let Some(producer) = self.producer.lock().unwrap_or_else(PoisonError::into_inner).as_deref_mut() {
            producer.disarm();
        }
    }

    /// Calls a function with the descriptor that signals room.
    pub(crate) fn with_bell<T>(&self, look: impl FnOnce(Option<BorrowedFd<'_>>) -> T) -> T {
        let producer = self.producer.lock().unwrap_or_else(PoisonError::into_inner);
        look(producer.as_deref().and_then(Producer::fd))
    }

    /// Writes invalid data.
    #[cfg(test)]
    pub(crate) fn write_garbage(&self) {
        let mut producer = self.producer.lock().unwrap_or_else(PoisonError::into_inner);
        let producer = producer.as_deref_mut().expect("nothing is lent");
        ring::write(producer, &[IoSlice::new(&[7; 200])]).expect("there is room");
    }

    /// Wakes the peer: it may sleep, and the socket has been closed.
    pub(crate) fn wake_peer(&self) {
        let producer = self.producer.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(producer) = producer.as_deref() {
            producer.ring();
        }
    }

    fn write_to(
        &self,
        producer: &mut Producer,
        parts: &[IoSlice<'_>],
        length: usize,
    ) -> Result<(), ApiError> {
        let wait = Wait::within(self.stall_timeout).or_hang_up(HangUp::Socket(self.socket.as_fd()));
        match producer.loan_before(length, &wait) {
            Ok(mut loan) => {
                ring::gather(parts, &mut loan);
                loan.publish();
                Ok(())
            }
            Err(RoomError::TimedOut) => Err(ApiError::Stalled(self.stall_timeout)),
            Err(RoomError::HungUp) => Err(ApiError::Closed(Ended::without_reason().why)),
            Err(error @ (RoomError::TooLong { .. } | RoomError::Corrupt(_) | RoomError::System(_))) => {
                self.close();
                Err(ApiError::Closed(error.to_string()))
            }
        }
    }

    /// Writes pending outcomes as far as there is room. Never waits: a thread that holds the ring now writes
    /// them when it is done.
    pub(crate) fn flush_pending(&self) {
        while self.has_pending() {
            let mut producer = match self.producer.try_lock() {
                Ok(producer) => producer,
                Err(TryLockError::Poisoned(poisoned)) => poisoned.into_inner(),
                Err(TryLockError::WouldBlock) => return,
            };
            let Some(producer) = producer.as_deref_mut() else { return };
            if !self.flush_pending_to(producer) {
                return;
            }
        }
    }

    /// Writes pending outcomes. Returns whether all were written.
    fn flush_pending_to(&self, producer: &mut Producer) -> bool {
        let mut pending = self.pending.lock().unwrap_or_else(PoisonError::into_inner);
        while let Some(message) = pending.front() {
            let head = message.header.encode_in_memory(message.payload.len());
            match ring::write(producer, &[IoSlice::new(&head), IoSlice::new(&message.payload)]) {
                Ok(_) => drop(pending.pop_front()),
                Err(LoanError::Full { .. }) => return false,
                // The link is unusable, which shows when it is read.
                Err(LoanError::TooLong { .. } | LoanError::Corrupt(_)) => pending.clear(),
            }
        }
        self.has_pending.store(false, Ordering::Release);
        true
    }

    pub(crate) fn has_pending(&self) -> bool {
        self.has_pending.load(Ordering::Acquire)
    }

    /// Closes the connection, which releases the address.
    pub(crate) fn close(&self) {
        // An error means that it is closed already.
        let _ = rustix::net::shutdown(&self.socket, Shutdown::Both);
    }
}

impl ReceiptSink for Writer {
    fn settle(&self, ticket: Ticket, outcome: Outcome) {
        let mut pending = self.pending.lock().unwrap_or_else(PoisonError::into_inner);
        if pending.len() < PENDING_MAX {
            pending.push_back(Message::outcome(ticket, outcome));
            self.has_pending.store(true, Ordering::Release);
        }
        drop(pending);
        self.flush_pending();
        if self.has_pending() {
            self.pending_notify.notify_one();
        }
    }
}

/// Returns why the node has closed the socket.
fn end_reason(socket: &UnixStream) -> Ended {
    received_refusal(socket).unwrap_or_else(Ended::without_reason)
}

/// Returns the reason that the node sent when it closed, if there is one: the only bytes that a ring's socket
/// ever carries.
pub(super) fn received_refusal(socket: &UnixStream) -> Option<Ended> {
    let mut buffer = BytesMut::zeroed(REFUSAL_BYTES_MAX);
    let count = recv(socket, &mut buffer[..], RecvFlags::DONTWAIT).map_or(0, |(count, _)| count);
    buffer.truncate(count);
    let refusal = FrameCodec::new(REFUSAL_BYTES_MAX).decode(&mut buffer).ok().flatten();
    let refusal = refusal.filter(|message| message.header.kind == Kind::LNCL_REFUSAL);
    refusal.and_then(|message| payload::read::<Refusal>(&message.payload).ok()).map(Ended::from)
}
