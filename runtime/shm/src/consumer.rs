//! Receiving: a message is lent in place, read by copying, and its memory goes back when the lending ends.

use std::{fmt, io, os::fd::BorrowedFd, sync::atomic::AtomicU32, time::Instant};

use crate::{
    bell::{Doorbell, Heard, Woken},
    core::{ConsumerCore, Record, sleep::Ear},
    error::{Corrupt, ReceiveError},
    platform::{OwnHeaderMemory, PeerMemory},
    spin::{Spin, Spinner},
    wait::{Armed, Wait, Waiting, spin},
};

/// The receiving end of a connection: one thread at a time.
pub struct Consumer {
    core: ConsumerCore<OwnHeaderMemory, PeerMemory>,
    message: Box<dyn Doorbell>,
    room_button: Box<dyn Doorbell>,
    spinner: Spinner,
}

impl Consumer {
    pub(crate) fn new(
        core: ConsumerCore<OwnHeaderMemory, PeerMemory>,
        message: Box<dyn Doorbell>,
        room_button: Box<dyn Doorbell>,
    ) -> Self {
        Self { core, message, room_button, spinner: Spinner::new(Spin::Off) }
    }

    /// What this end does before it sleeps in [`Consumer::receive_before`]. [`Spin::Off`] at first.
    pub const fn set_spin(&mut self, spin: Spin) {
        self.spinner = Spinner::new(spin);
    }

    /// The longest message that can come, in bytes: no other length is ever lent.
    #[must_use]
    pub const fn payload_max(&self) -> usize {
        self.core.capacity().payload_max() as usize
    }

    /// The oldest message, if there is any. Its memory goes back to the peer when the lending ends, in order.
    ///
    /// # Errors
    /// [`Corrupt`] when the peer wrote what no peer of ours writes; from then on always.
    pub fn receive(&mut self) -> Result<Option<Lent<'_>>, Corrupt> {
        Ok(self.core.next()?.map(|record| Lent { consumer: self, record }))
    }

    /// The oldest message; waits for it.
    ///
    /// # Errors
    /// [`ReceiveError::TimedOut`] at the deadline; [`ReceiveError::HungUp`] when the peer is gone and the ring is empty.
    pub fn receive_before(&mut self, wait: &Wait<'_>) -> Result<Lent<'_>, ReceiveError> {
        let record = self.await_record(wait)?;
        Ok(Lent { consumer: self, record })
    }

    /// Gives the memory of the messages that were kept ([`Lent::keep`]) back to the peer, which is woken if it waits for room.
    pub fn give_back(&mut self) {
        if self.core.give_back() {
            self.room_button.ring();
        }
    }

    /// Whether there is a message. It stays there.
    ///
    /// # Errors
    /// As [`Consumer::receive`].
    pub fn is_ready(&mut self) -> Result<bool, Corrupt> {
        Ok(self.core.next()?.is_some())
    }

    /// Whether the producer has published something since it was last looked at.
    pub(crate) fn has_moved(&self) -> bool {
        self.core.has_moved()
    }

    pub(crate) fn message_bell(&self) -> &dyn Doorbell {
        &*self.message
    }

    /// The word that a ring of this peer changes, and nobody else can.
    pub(crate) fn own_word(&self) -> &AtomicU32 {
        self.core.peer.rung()
    }

    /// Whether the peer says that it has rung for the sleep that was announced last.
    pub(crate) fn was_rung(&self) -> bool {
        self.core.was_rung()
    }

    /// Says that this side is awake, of a bell that keeps no rings.
    pub(crate) fn withdraw(&mut self) {
        self.core.disarm();
    }

    /// Announces sleep, one of several; see [`ConsumerCore::announce`].
    pub(crate) fn announce(&mut self, ear: Ear) {
        self.core.announce(ear);
    }

    /// Announces that a reactor is about to wait for [`Consumer::fd`]. Followed by [`Consumer::disarm`] in any case but
    /// [`Armed::Ready`].
    ///
    /// # Errors
    /// As [`Consumer::receive`].
    pub fn arm(&mut self) -> Result<Armed, Corrupt> {
        self.core.arm()
    }

    /// Says that the reactor is awake, and forgets the rings so far.
    pub fn disarm(&mut self) {
        self.core.disarm();
        self.message.drain();
    }

    /// What a reactor waits for (readable) while armed; `None` for a futex.
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
        let now = Instant::now();
        let waiting = wait.begin(now);
        if spin(self.spinner.begin().min(waiting.left(now)), || self.core.has_moved())
            && let Some(record) = self.core.next()?
        {
            return Ok(record);
        }
        loop {
            let heard = self.message.listen();
            let ended = match self.core.arm()? {
                Armed::Sleep => self.sleep(heard, &waiting)?,
                Armed::Ready => Woken::Rung,
            };
            // What was published before the end of the wait, or of the peer, is still a message.
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

    fn sleep(&mut self, heard: Heard, waiting: &Waiting<'_>) -> Result<Woken, ReceiveError> {
        let ended = self.message.sleep(heard, waiting);
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
/// There is no `&[u8]` of it: the peer can change its bytes at any time, and Rust takes bytes behind a reference for
/// unchanging. They are copied out, each one read once, and then parsed; or read in pieces with [`Lent::reader`].
#[derive(Debug)]
pub struct Lent<'a> {
    consumer: &'a mut Consumer,
    record: Record,
}

impl Lent<'_> {
    /// Bytes of the message: at most [`Consumer::payload_max`].
    #[must_use]
    pub const fn len(&self) -> usize {
        self.record.length as usize
    }

    /// Whether it has no bytes.
    #[must_use]
    pub const fn is_empty(&self) -> bool {
        self.record.length == 0
    }

    /// Copies from byte `from` on, as much as there is and the target holds; how much that was.
    pub fn copy_at(&self, from: usize, target: &mut [u8]) -> usize {
        let count = self.len().saturating_sub(from).min(target.len());
        if count > 0 {
            self.consumer.core.peer.copy_out(self.record.position as usize + from, &mut target[..count]);
        }
        count
    }

    /// Copies from the beginning, as much as there is and the target holds; how much that was.
    pub fn copy_to(&self, target: &mut [u8]) -> usize {
        self.copy_at(0, target)
    }

    /// Appends the whole message.
    pub fn append_to(&self, target: &mut Vec<u8>) {
        let before = target.len();
        target.resize(before + self.len(), 0);
        self.copy_to(&mut target[before..]);
    }

    /// The whole message.
    #[must_use]
    pub fn to_vec(&self) -> Vec<u8> {
        let mut bytes = vec![0; self.len()];
        self.copy_to(&mut bytes);
        bytes
    }

    /// Ends the lending without giving the memory back yet: that is done with the next message's, or by
    /// [`Consumer::give_back`]. For who reads several at once: a peer that waits for room is woken for all of them.
    pub fn keep(self) {
        let mut lent = std::mem::ManuallyDrop::new(self);
        let record = lent.record;
        lent.consumer.core.keep(record);
    }

    /// Reads it in pieces, for a decoder. Each byte is read once; a decoder that reads a length twice may see two.
    #[must_use]
    pub const fn reader(&self) -> LentReader<'_> {
        LentReader { lent: self, at: 0 }
    }
}

impl Drop for Lent<'_> {
    fn drop(&mut self) {
        let consumer = &mut *self.consumer;
        if consumer.core.release(self.record) {
            consumer.room_button.ring();
        }
    }
}

/// A message as a stream of bytes. Never fails; ends at the message's end.
#[derive(Debug)]
pub struct LentReader<'a> {
    lent: &'a Lent<'a>,
    at: usize,
}

impl io::Read for LentReader<'_> {
    fn read(&mut self, target: &mut [u8]) -> io::Result<usize> {
        let count = self.lent.copy_at(self.at, target);
        self.at += count;
        Ok(count)
    }
}
