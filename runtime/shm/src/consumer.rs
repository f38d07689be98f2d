//! Receiving: a message is borrowed in place, read by copying, and its memory is returned when the loan ends.

use std::{fmt, io, os::fd::BorrowedFd, sync::atomic::AtomicU32, time::Instant};

use crate::{
    bell::{BellState, Doorbell, Woken},
    core::{ConsumerCore, Record},
    error::{CorruptError, ReceiveError},
    platform::{OwnHeaderMemory, PeerMemory},
    spin::{Spin, Spinner},
    wait::{Armed, Wait, Waiting, spin},
    wait_set::Slot,
};

/// The receiving end of a connection: one thread at a time.
pub struct Consumer {
    core: ConsumerCore<OwnHeaderMemory, PeerMemory>,
    message: Box<dyn Doorbell>,
    room_button: Box<dyn Doorbell>,
    spinner: Spinner,
    slot: Option<Slot>,
    /// Sleeps since the descriptor was emptied. A peer rings once at most for each, reported or not.
    rings: u32,
}

/// The most rings that stay in a descriptor. A socket holds some 270, and a drain takes 64 of them.
const RINGS_KEPT: u32 = 32;

/// The result of [`Consumer::receive_only`].
#[derive(Debug)]
pub enum Only<'a> {
    /// One message, which no other one follows.
    Message(ReceivedMessage<'a>),
    /// No message.
    Nothing,
    /// Several messages, or a [`CorruptError`] of the peer, which the other calls report.
    Other,
}

impl Consumer {
    pub(crate) fn new(
        core: ConsumerCore<OwnHeaderMemory, PeerMemory>,
        message: Box<dyn Doorbell>,
        room_button: Box<dyn Doorbell>,
        slot: Option<Slot>,
    ) -> Self {
        Self { core, message, room_button, spinner: Spinner::new(Spin::Off), slot, rings: 0 }
    }

    /// Returns its place in a [`WaitSet`](crate::WaitSet), below 128.
    #[must_use]
    #[inline]
    pub fn slot(&self) -> Option<u8> {
        self.slot.as_ref().map(Slot::number)
    }

    /// Sets how this end spins before it sleeps in [`Consumer::receive_before`]. [`Spin::Off`] at first.
    pub const fn set_spin(&mut self, spin: Spin) {
        self.spinner = Spinner::new(spin);
    }

    /// Returns the longest possible message, in bytes: longer ones are never returned.
    #[must_use]
    pub const fn payload_max(&self) -> usize {
        self.core.capacity().payload_max() as usize
    }

    /// Returns the oldest message, if there is any. Its memory is returned to the peer when the loan ends, in
    /// order.
    ///
    /// # Errors
    /// [`CorruptError`] when the peer wrote values that no valid peer writes; every later call returns it too.
    pub fn receive(&mut self) -> Result<Option<ReceivedMessage<'_>>, CorruptError> {
        Ok(self.core.next()?.map(|record| ReceivedMessage { consumer: self, record }))
    }

    /// Returns the oldest message if no other one follows it.
    #[inline]
    pub fn receive_only(&mut self) -> Only<'_> {
        match self.core.next() {
            Ok(None) => Only::Nothing,
            Ok(Some(record)) if self.core.is_last(record) => {
                Only::Message(ReceivedMessage { consumer: self, record })
            }
            Ok(Some(_)) | Err(_) => Only::Other,
        }
    }

    /// Waits for the oldest message and returns it.
    ///
    /// # Errors
    /// [`ReceiveError::TimedOut`] at the deadline; [`ReceiveError::HungUp`] when the peer is gone and the
    /// ring is empty; [`ReceiveError::System`] in a [`WaitSet`](crate::WaitSet), which a
    /// [`Waiter`](crate::Waiter) waits for.
    pub fn receive_before(&mut self, wait: &Wait<'_>) -> Result<ReceivedMessage<'_>, ReceiveError> {
        let record = self.await_record(wait)?;
        Ok(ReceivedMessage { consumer: self, record })
    }

    /// Returns the memory of the kept messages ([`ReceivedMessage::keep`]) to the peer, and wakes it if it waits for
    /// room.
    pub fn give_back(&mut self) {
        if self.core.give_back() {
            self.room_button.ring();
        }
    }

    /// Returns whether there is a message. The message stays there.
    ///
    /// # Errors
    /// As [`Consumer::receive`].
    pub fn is_ready(&mut self) -> Result<bool, CorruptError> {
        Ok(self.core.next()?.is_some())
    }

    /// Whether the producer has published a message since the last check.
    pub(crate) fn has_moved(&self) -> bool {
        self.core.has_moved()
    }

    /// The word that a ring changes; `None` if the bell is no futex.
    pub(crate) fn bell_word(&self) -> Option<&AtomicU32> {
        self.message.word()
    }

    /// The word that a ring of this peer changes, and no other peer can write.
    pub(crate) fn own_word(&self) -> &AtomicU32 {
        self.core.peer.rung()
    }

    /// Whether the peer reports a ring for this sleep of the set.
    pub(crate) fn was_rung_for(&self, sleep: u32) -> bool {
        self.core.was_rung_for(sleep)
    }

    /// Whether the peer has reported all messages that were found to the set.
    pub(crate) fn is_reported(&self) -> bool {
        self.core.is_reported()
    }

    /// Announces that this side is awake, for a bell that stores no rings.
    pub(crate) fn withdraw(&mut self) {
        self.core.disarm();
    }

    /// Announces sleep, as one of several consumers; see [`ConsumerCore::announce`].
    pub(crate) fn announce(&mut self) {
        self.core.announce();
    }

    /// Announces that a reactor is about to wait for [`Consumer::fd`]. Must be followed by
    /// [`Consumer::disarm`], except after [`Armed::Ready`].
    ///
    /// # Errors
    /// As [`Consumer::receive`].
    pub fn arm(&mut self) -> Result<Armed, CorruptError> {
        self.core.arm()
    }

    /// Announces that the reactor is awake, and discards the rings so far.
    pub fn disarm(&mut self) {
        self.core.disarm();
        self.message.drain();
    }

    /// Announces that the reactor is awake, for one that reports each ring once, such as an edge-triggered `epoll`.
    /// The rings stay in the descriptor, and are discarded long before they fill it.
    pub fn disarm_reported(&mut self) {
        self.core.disarm();
        self.rings += 1;
        if self.rings >= RINGS_KEPT {
            self.rings = 0;
            self.message.drain();
        }
    }

    /// Returns the descriptor that a reactor waits for (readable) while armed; `None` for a futex.
    #[must_use]
    pub fn fd(&self) -> Option<BorrowedFd<'_>> {
        self.message.fd()
    }

    fn await_record(&mut self, wait: &Wait<'_>) -> Result<Record, ReceiveError> {
        if let Some(record) = self.core.next()? {
            return Ok(record);
        }
        let started = self.spinner.learns().then(Instant::now);
        let record = self.spin_or_sleep(wait)?;
        if let Some(started) = started {
            self.spinner.learn(started.elapsed());
        }
        Ok(record)
    }

    fn spin_or_sleep(&mut self, wait: &Wait<'_>) -> Result<Record, ReceiveError> {
        if self.slot.is_some() {
            return Err(ReceiveError::System(io::ErrorKind::InvalidInput.into()));
        }
        let now = Instant::now();
        let waiting = wait.begin(now);
        if spin(self.spinner.begin().min(waiting.left(now)), || self.core.has_moved())
            && let Some(record) = self.core.next()?
        {
            return Ok(record);
        }
        loop {
            let seen = self.message.listen();
            let ended = match self.core.arm()? {
                Armed::Sleep => self.sleep(seen, &waiting)?,
                Armed::Ready => Woken::Rung,
            };
            // A message published before the end of the wait, or of the peer, is still received.
            if let Some(record) = self.core.next()? {
                return Ok(record);
            }
            match ended {
                Woken::Rung => {}
                Woken::TimedOut => return Err(ReceiveError::TimedOut),
                Woken::HungUp => return Err(ReceiveError::HungUp),
            }
        }
    }

    fn sleep(&mut self, seen: BellState, waiting: &Waiting<'_>) -> Result<Woken, ReceiveError> {
        let ended = self.message.sleep(seen, waiting);
        self.core.disarm();
        ended.map_err(ReceiveError::System)
    }
}

impl fmt::Debug for Consumer {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Consumer").field("core", &self.core).finish_non_exhaustive()
    }
}

/// A message in the ring.
///
/// It offers no `&[u8]`: the peer can change its bytes at any time, and Rust requires that bytes behind a
/// reference do not change. The bytes are copied out, each one read once, and then parsed; or read in pieces
/// with [`ReceivedMessage::reader`].
#[derive(Debug)]
pub struct ReceivedMessage<'a> {
    consumer: &'a mut Consumer,
    record: Record,
}

impl ReceivedMessage<'_> {
    /// Returns the length in bytes: at most [`Consumer::payload_max`].
    #[must_use]
    #[inline]
    pub const fn len(&self) -> usize {
        self.record.length as usize
    }

    /// Returns whether the message has no bytes.
    #[must_use]
    pub const fn is_empty(&self) -> bool {
        self.record.length == 0
    }

    /// Copies from byte `from` on, as much as there is and the target holds. Returns the number of bytes.
    #[inline]
    pub fn copy_at(&self, from: usize, target: &mut [u8]) -> usize {
        let count = self.len().saturating_sub(from).min(target.len());
        if count > 0 {
            self.consumer.core.peer.copy_out(self.record.position as usize + from, &mut target[..count]);
        }
        count
    }

    /// Copies from the beginning, as much as there is and the target holds. Returns the number of bytes.
    #[inline]
    pub fn copy_to(&self, target: &mut [u8]) -> usize {
        self.copy_at(0, target)
    }

    /// Appends the whole message.
    pub fn append_to(&self, target: &mut Vec<u8>) {
        let before = target.len();
        target.resize(before + self.len(), 0);
        self.copy_to(&mut target[before..]);
    }

    /// Returns a copy of the whole message.
    #[must_use]
    pub fn to_vec(&self) -> Vec<u8> {
        let mut bytes = vec![0; self.len()];
        self.copy_to(&mut bytes);
        bytes
    }

    /// Ends the loan without returning the memory yet: that is done with the next message's memory, or by
    /// [`Consumer::give_back`]. For a reader of several messages at once: a peer that waits for room is woken
    /// once for all of them.
    pub fn keep(self) {
        let mut message = std::mem::ManuallyDrop::new(self);
        let record = message.record;
        message.consumer.core.keep(record);
    }

    /// Ends the loan and leaves the message in the ring: the next call returns it again.
    pub fn leave(self) {
        // Its drop would release the message. It contains only a borrow.
        std::mem::forget(self);
    }

    /// Returns a reader for a decoder. Each byte is read once; a decoder that reads a length twice may see
    /// two values.
    #[must_use]
    pub const fn reader(&self) -> MessageReader<'_> {
        MessageReader { message: self, at: 0 }
    }
}

impl Drop for ReceivedMessage<'_> {
    fn drop(&mut self) {
        let consumer = &mut *self.consumer;
        if consumer.core.release(self.record) {
            consumer.room_button.ring();
        }
    }
}

/// A message as a stream of bytes. It never fails, and ends at the end of the message.
#[derive(Debug)]
pub struct MessageReader<'a> {
    message: &'a ReceivedMessage<'a>,
    at: usize,
}

impl io::Read for MessageReader<'_> {
    fn read(&mut self, target: &mut [u8]) -> io::Result<usize> {
        let count = self.message.copy_at(self.at, target);
        self.at += count;
        Ok(count)
    }
}
