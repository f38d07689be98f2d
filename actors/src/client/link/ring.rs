//! A ring each way in shared memory, and a socket that tells the other end's end.

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
use sinew_runtime::{
    outcome::{Outcome, ReceiptSink, Ticket},
    time::Time,
    wire::{FrameCodec, Kind, Message},
};
use sinew_shm::{
    Any, AnyError, Armed, BellKind, Capacity, Consumer, Ends, HangUp, LoanError, Looked, Looking, Producer,
    Region, RoomError, Spin, Wait, Waiter,
};
use tokio::sync::Notify;
use tokio_util::codec::Decoder;

use super::{Ended, LinkOptions, Read, socket};
use crate::{
    client::ApiError,
    lncl::payload::{self, Refusal},
    ring::{self, RingFrames, Taken},
};

pub(in crate::client) use writing::{Begun, Rest};

/// Bytes that are taken from a ring at once.
pub(in crate::client) const ENOUGH: usize = 64 * 1024;
/// Outcomes that wait for room at most: as many as the largest `node.mailbox_capacity`, which is how many confirmed messages
/// a node has with one client at most, with the marks of 1,024 links and 16 introductions that this side has not answered. So none is left
/// out on the way through a node. Of a direct link one more is not said: its sender counts it as Unknown at its own deadline.
pub(super) const OWED_MAX: usize = 65_536 + 1_024 + 16;
/// Longest sentence, with its frame, that a node takes leave with.
const LAST_WORDS_BYTES_MAX: usize = 4_096;
/// Longest sleep at a ring: then what other threads owe is paid, and the socket is looked at.
pub(in crate::client) const NAP: Duration = Duration::from_millis(20);

/// Whether this process can have rings; found out once.
pub(super) fn is_available() -> bool {
    static AVAILABLE: OnceLock<bool> = OnceLock::new();
    *AVAILABLE.get_or_init(|| match Region::create(Capacity::MIN, BellKind::Futex) {
        Ok(_) => true,
        Err(why) => {
            crate::log::here!(warn: %why, "messages to the node go through its socket");
            false
        }
    })
}

/// The writing half.
#[derive(Debug)]
pub(in crate::client) struct Writer {
    socket: Arc<UnixStream>,
    /// `None` while a message is lent. Frames go out whole, one after the other. Boxed, since it moves with each loan.
    producer: Mutex<Option<Box<Producer>>>,
    /// Outcomes that found no room, or the ring lent, when they were said.
    owed: Mutex<VecDeque<Message>>,
    /// Whether there are any; changed with `owed` locked. Looked at with each message.
    is_owing: AtomicBool,
    /// Told when some thread has left something owed: a task that waits looks again.
    pub(super) owing: Notify,
    stall_timeout: Duration,
}

impl Writer {
    pub(in crate::client) fn new(
        socket: Arc<UnixStream>,
        mut producer: Producer,
        options: &LinkOptions,
    ) -> Self {
        producer.set_spin(options.spin);
        let (producer, owed) = (Mutex::new(Some(Box::new(producer))), Mutex::default());
        let is_owing = AtomicBool::new(false);
        Self { socket, producer, owed, is_owing, owing: Notify::new(), stall_timeout: options.stall_timeout }
    }

    /// Writes one frame that fits into half the ring; waits for room as long as the link's stall timeout lasts.
    pub(in crate::client) fn write(&self, message: &Message) -> Result<(), ApiError> {
        let head = message.header.encode_in_memory(message.payload.len());
        let parts = [IoSlice::new(&head), IoSlice::new(&message.payload)];
        let mut producer = self.producer.lock().unwrap_or_else(PoisonError::into_inner);
        let written = match producer.as_deref_mut() {
            Some(producer) => self.write_to(producer, &parts, message.size()),
            None => Err(ApiError::LoanActive),
        };
        drop(producer);
        self.pay();
        written
    }

    /// Writes one frame if there is room for all of it now, in one piece; returns whether there was.
    pub(in crate::client) fn try_write(&self, message: &Message) -> Result<bool, ApiError> {
        self.pay();
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

    /// Takes the ring out, with room for `length` bytes set aside; `None` if there is no room now, or the ring is lent.
    pub(super) fn take_out(&self, length: usize) -> Option<Box<Producer>> {
        // What is owed would wait for as long as the loan lasts.
        self.pay();
        let mut place = self.producer.lock().unwrap_or_else(PoisonError::into_inner);
        // An error shows itself again when the message is sent.
        place.as_deref_mut()?.loan(length).ok()?.set_aside();
        place.take()
    }

    /// Takes the ring back, and pays what was said meanwhile.
    pub(super) fn put_back(&self, producer: Box<Producer>) {
        *self.producer.lock().unwrap_or_else(PoisonError::into_inner) = Some(producer);
        self.pay();
    }

    /// Announces that a task waits for room for a frame of `length` bytes.
    pub(in crate::client) fn arm(&self, length: usize) -> Armed {
        let mut producer = self.producer.lock().unwrap_or_else(PoisonError::into_inner);
        producer.as_deref_mut().map_or(Armed::Ready, |producer| writing::arm(producer, length))
    }

    /// Says that it is awake.
    pub(in crate::client) fn disarm(&self) {
        if let Some(producer) = self.producer.lock().unwrap_or_else(PoisonError::into_inner).as_deref_mut() {
            producer.disarm();
        }
    }

    /// Does something with the descriptor of the bell for room.
    pub(in crate::client) fn with_bell<T>(&self, look: impl FnOnce(Option<BorrowedFd<'_>>) -> T) -> T {
        let producer = self.producer.lock().unwrap_or_else(PoisonError::into_inner);
        look(producer.as_deref().and_then(Producer::fd))
    }

    /// Writes what is no frame.
    #[cfg(test)]
    pub(in crate::client) fn write_garbage(&self) {
        let mut producer = self.producer.lock().unwrap_or_else(PoisonError::into_inner);
        let producer = producer.as_deref_mut().expect("nothing is lent");
        ring::write(producer, &[IoSlice::new(&[7; 200])]).expect("there is room");
    }

    /// Rings the peer's bell: it may sleep, and the socket has been closed.
    pub(in crate::client) fn wake_peer(&self) {
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
            Err(RoomError::HungUp) => Err(ApiError::Closed(Ended::silently().why)),
            Err(error @ (RoomError::TooLong { .. } | RoomError::Corrupt(_) | RoomError::System(_))) => {
                self.close();
                Err(ApiError::Closed(error.to_string()))
            }
        }
    }

    /// Writes what is owed, as far as there is room. Never waits: who has the ring now pays when it is done.
    pub(in crate::client) fn pay(&self) {
        while self.owes() {
            let mut producer = match self.producer.try_lock() {
                Ok(producer) => producer,
                Err(TryLockError::Poisoned(poisoned)) => poisoned.into_inner(),
                Err(TryLockError::WouldBlock) => return,
            };
            let Some(producer) = producer.as_deref_mut() else { return };
            if !self.pay_with(producer) {
                return;
            }
        }
    }

    /// Whether all was paid.
    fn pay_with(&self, producer: &mut Producer) -> bool {
        let mut owed = self.owed.lock().unwrap_or_else(PoisonError::into_inner);
        while let Some(message) = owed.front() {
            let head = message.header.encode_in_memory(message.payload.len());
            match ring::write(producer, &[IoSlice::new(&head), IoSlice::new(&message.payload)]) {
                Ok(_) => drop(owed.pop_front()),
                Err(LoanError::Full { .. }) => return false,
                // The link is of no more use, which shows when it is read.
                Err(LoanError::TooLong { .. } | LoanError::Corrupt(_)) => owed.clear(),
            }
        }
        self.is_owing.store(false, Ordering::Release);
        true
    }

    pub(in crate::client) fn owes(&self) -> bool {
        self.is_owing.load(Ordering::Acquire)
    }

    /// Closes the connection, which gives the address back.
    pub(in crate::client) fn close(&self) {
        // An error means that it is closed already.
        let _ = rustix::net::shutdown(&self.socket, Shutdown::Both);
    }
}

impl ReceiptSink for Writer {
    fn settle(&self, ticket: Ticket, outcome: Outcome) {
        let mut owed = self.owed.lock().unwrap_or_else(PoisonError::into_inner);
        if owed.len() < OWED_MAX {
            owed.push_back(Message::outcome(ticket, outcome));
            self.is_owing.store(true, Ordering::Release);
        }
        drop(owed);
        self.pay();
        if self.owes() {
            self.owing.notify_one();
        }
    }
}

/// Why the node has closed the socket.
fn last_words(socket: &UnixStream) -> Ended {
    farewell(socket).unwrap_or_else(Ended::silently)
}

/// The words with which the node takes leave, if there are any: the only bytes that a ring's socket ever carries.
pub(super) fn farewell(socket: &UnixStream) -> Option<Ended> {
    let mut buffer = BytesMut::zeroed(LAST_WORDS_BYTES_MAX);
    let count = recv(socket, &mut buffer[..], RecvFlags::DONTWAIT).map_or(0, |(count, _)| count);
    buffer.truncate(count);
    let refusal = FrameCodec::new(LAST_WORDS_BYTES_MAX).decode(&mut buffer).ok().flatten();
    let refusal = refusal.filter(|message| message.header.kind == Kind::LNCL_REFUSAL);
    refusal.and_then(|message| payload::read::<Refusal>(&message.payload).ok()).map(Ended::from)
}

/// The reading half.
pub(in crate::client) struct Reader {
    end: End,
    frames: RingFrames,
    waiter: Waiter,
    /// When the socket is looked at again.
    look_at: Time,
    /// Why nothing will come any more, once what is there was taken.
    ended: Option<Ended>,
    /// What is there is not taken either.
    is_turned_away: bool,
}

/// What is waited for.
pub(in crate::client) struct End {
    socket: Arc<UnixStream>,
    consumer: Consumer,
}

impl Ends for End {
    fn count(&self) -> usize {
        1
    }

    fn consumer(&self, _: usize) -> &Consumer {
        &self.consumer
    }

    fn consumer_mut(&mut self, _: usize) -> &mut Consumer {
        &mut self.consumer
    }

    fn hang_up(&self, _: usize) -> Option<HangUp<'_>> {
        Some(HangUp::Socket(self.socket.as_fd()))
    }
}

impl Reader {
    pub(super) fn new(socket: Arc<UnixStream>, consumer: Consumer, payload_max: usize, spin: Spin) -> Self {
        let (end, frames) = (End { socket, consumer }, RingFrames::new(payload_max));
        Self {
            end,
            frames,
            waiter: Waiter::new(spin),
            look_at: Time::ZERO,
            ended: None,
            is_turned_away: false,
        }
    }

    /// The next frame of those that were taken.
    pub(super) fn next(&mut self) -> Result<Option<Message>, ApiError> {
        Ok(self.frames.next()?)
    }

    /// Takes nothing any more.
    pub(super) fn turn_away(&mut self) {
        self.is_turned_away = true;
        self.ended = Some(Ended::silently());
    }

    /// Takes what is there, without waiting.
    pub(super) fn read(&mut self, now: Time) -> Read {
        if let (true, Some(why)) = (self.is_turned_away, &self.ended) {
            return Read::Ended(why.clone());
        }
        match self.frames.take(&mut self.end.consumer, ENOUGH) {
            Err(corrupt) => {
                Read::Ended(Ended::for_good(format!("shared memory holds what it cannot: {corrupt}")))
            }
            Ok(Taken::Some) => Read::Some,
            Ok(Taken::Nothing) => match self.ended.clone() {
                Some(why) => Read::Ended(why),
                // What was published before the end is taken by the next look.
                None if self.has_ended(now) => Read::Some,
                None => Read::Nothing,
            },
        }
    }

    /// Whether the node is gone. A caller that never waits has to learn it, too, and a ring takes messages for the dead;
    /// so the socket is looked at now and then.
    pub(super) fn has_ended(&mut self, now: Time) -> bool {
        if self.ended.is_none() && now >= self.look_at {
            self.look_at = now + NAP;
            self.ended = socket::has_hung_up(&self.end.socket).then(|| last_words(&self.end.socket));
        }
        self.ended.is_some()
    }

    /// Waits for a message, the node's end, or a nap's length.
    pub(super) fn wait(&mut self, left: Duration) {
        if self.ended.is_some() {
            return;
        }
        let ended = self.waiter.wait_within(&mut self.end, left.min(NAP));
        self.note(&ended);
    }

    /// As [`wait`](Self::wait), for the ends that `all` makes of the node's, which is the first, and others.
    pub(in crate::client) fn wait_for_all<'a, E: Ends>(
        &'a mut self,
        left: Duration,
        all: impl FnOnce(&'a mut End) -> E,
    ) -> Result<Any, AnyError> {
        self.waiter.wait_within(&mut all(&mut self.end), left.min(NAP))
    }

    /// The look of a task before it sleeps; `None` if it is to sleep at once.
    pub(in crate::client) fn begin_looking(&mut self) -> Option<Looking> {
        self.waiter.begin()
    }

    /// Looks at the ends that `all` makes of the node's and others.
    pub(in crate::client) fn look<'a, E: Ends>(
        &'a mut self,
        looking: &Looking,
        all: impl FnOnce(&'a mut End) -> E,
    ) -> Looked {
        looking.look(&mut all(&mut self.end))
    }

    /// The wait that began with this look is over.
    pub(in crate::client) fn end_looking(&mut self, looking: &Looking) {
        self.waiter.end(looking);
    }

    /// What the end of a wait says about the node.
    pub(in crate::client) fn note(&mut self, ended: &Result<Any, AnyError>) {
        match ended {
            Ok(Any::HungUp(0)) => self.ended = Some(last_words(&self.end.socket)),
            Ok(Any::Message(_) | Any::TimedOut | Any::HungUp(_))
            | Err(AnyError::Corrupt { index: 1.., .. }) => {}
            Err(error @ (AnyError::Corrupt { .. } | AnyError::System(_))) => {
                self.ended = Some(Ended::for_good(error.to_string()))
            }
        }
    }

    /// Announces that a task waits for a message. [`Armed::Ready`]: there is something to do.
    pub(in crate::client) fn arm(&mut self) -> Armed {
        if self.ended.is_some() {
            return Armed::Ready;
        }
        // Corrupt memory shows itself when it is read.
        self.end.consumer.arm().unwrap_or(Armed::Ready)
    }

    /// Says that it is awake.
    pub(in crate::client) fn disarm(&mut self) {
        self.end.consumer.disarm();
    }

    /// The next look at the ring looks at the socket, too.
    pub(in crate::client) fn look_at_once(&mut self) {
        self.look_at = Time::ZERO;
    }

    /// The descriptor of the bell for messages.
    pub(in crate::client) fn bell(&self) -> Option<BorrowedFd<'_>> {
        self.end.consumer.fd()
    }

    /// The socket beside the ring.
    pub(in crate::client) fn socket(&self) -> Arc<UnixStream> {
        self.end.socket.clone()
    }
}
