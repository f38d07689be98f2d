//! Sending: room in the ring is loaned, written in place, and published or returned.

use std::{
    fmt,
    ops::{Deref, DerefMut},
    os::fd::BorrowedFd,
    time::Instant,
};

use crate::{
    bell::{BellState, Doorbell, Woken},
    core::{ProducerCore, producer::Reserved, sleep::WakePlace},
    error::{CorruptError, LoanError, RoomError},
    platform::{Counters, OwnRingMemory, PeerCounters, PeerMemory},
    spin::{Spin, Spinner},
    wait::{Armed, Wait, Waiting, spin},
};

/// The sending end of a connection: one thread at a time.
pub struct Producer {
    core: ProducerCore<OwnRingMemory, PeerMemory>,
    room: Box<dyn Doorbell>,
    message_button: Box<dyn Doorbell>,
    spinner: Spinner,
}

impl Producer {
    pub(crate) fn new(
        core: ProducerCore<OwnRingMemory, PeerMemory>,
        room: Box<dyn Doorbell>,
        message_button: Box<dyn Doorbell>,
    ) -> Self {
        Self { core, room, message_button, spinner: Spinner::new(Spin::Off) }
    }

    /// Sets how this end spins before it sleeps in [`Producer::loan_before`]. [`Spin::Off`] at first.
    pub const fn set_spin(&mut self, spin: Spin) {
        self.spinner = Spinner::new(spin);
    }

    /// Returns the counters of this side.
    #[must_use]
    pub fn counters(&self) -> Counters {
        self.core.own.counters()
    }

    /// Returns the counters of the peer.
    #[must_use]
    pub fn peer_counters(&self) -> PeerCounters {
        self.core.peer.counters()
    }

    /// Returns the longest message, in bytes: half the ring, less 8.
    #[must_use]
    #[inline]
    pub const fn payload_max(&self) -> usize {
        self.core.capacity().payload_max() as usize
    }

    /// Lends memory in the ring for a message of `length` bytes. It still contains bytes of earlier messages
    /// to the same peer. The peer does not see it before [`Loan::publish`]; a dropped loan is returned.
    ///
    /// # Errors
    /// [`LoanError::Full`] when the peer has not consumed enough yet: nothing changed.
    #[inline]
    pub fn loan(&mut self, length: usize) -> Result<Loan<'_>, LoanError> {
        let reserved = self.core.reserve(length)?;
        Ok(Loan { producer: self, reserved })
    }

    /// Same as [`Producer::loan`], and waits for room.
    ///
    /// # Errors
    /// [`RoomError::TimedOut`] at the deadline, [`RoomError::HungUp`] when the peer is gone.
    pub fn loan_before(&mut self, length: usize, wait: &Wait<'_>) -> Result<Loan<'_>, RoomError> {
        let reserved = self.await_room(length, wait)?;
        Ok(Loan { producer: self, reserved })
    }

    /// Resumes the loan that [`Loan::set_aside`] left.
    #[inline]
    pub const fn resume(&mut self) -> Option<Loan<'_>> {
        match self.core.reserved() {
            Some(reserved) => Some(Loan { producer: self, reserved }),
            None => None,
        }
    }

    /// Returns the memory that [`Loan::set_aside`] left; empty if there is none.
    #[must_use]
    #[inline]
    pub fn aside(&self) -> &[u8] {
        let reserved = self.core.reserved();
        reserved.map_or(&[], |reserved| {
            self.core.own.bytes(self.core.payload_position(reserved), reserved.length)
        })
    }

    /// Returns the same memory, to be written.
    #[inline]
    pub fn aside_mut(&mut self) -> &mut [u8] {
        match self.core.reserved() {
            Some(reserved) => {
                let position = self.core.payload_position(reserved);
                self.core.own.bytes_mut(position, reserved.length)
            }
            None => &mut [],
        }
    }

    /// Copies a message into the ring and publishes it.
    ///
    /// # Errors
    /// As [`Producer::loan`].
    pub fn send(&mut self, payload: &[u8]) -> Result<(), LoanError> {
        let mut loan = self.loan(payload.len())?;
        loan.copy_from_slice(payload);
        loan.publish();
        Ok(())
    }

    /// Announces that a reactor is about to wait for [`Producer::fd`] until there is room for `length` bytes.
    /// Must be followed by [`Producer::disarm`], except after [`Armed::Ready`].
    ///
    /// # Errors
    /// [`LoanError::TooLong`] or [`LoanError::Corrupt`]; never `Full`.
    pub fn arm(&mut self, length: usize) -> Result<Armed, LoanError> {
        self.core.arm(length)
    }

    /// Announces that the reactor is awake, and discards the rings so far.
    pub fn disarm(&mut self) {
        self.core.disarm();
        self.room.drain();
    }

    /// Returns the descriptor that a reactor waits for (readable) while armed; `None` for a futex.
    #[must_use]
    pub fn fd(&self) -> Option<BorrowedFd<'_>> {
        self.room.fd()
    }

    /// Returns the number of bytes of the ring that were ever used for messages; wraps. The increase by a
    /// message is the share of that message.
    #[must_use]
    pub const fn published(&self) -> u32 {
        self.core.published()
    }

    /// Returns how many of those bytes the peer has not consumed yet. An honest peer has not read a message
    /// among them.
    ///
    /// # Errors
    /// The peer's fault: its count is impossible.
    pub fn unread(&mut self) -> Result<u32, CorruptError> {
        self.core.unread()
    }

    /// Wakes the peer without a message, so that it checks whether this side is still present. For a side
    /// that is about to leave.
    pub fn ring(&self) {
        self.message_button.ring();
        self.core.force_ring_report();
        self.core.own.wake_rung();
    }

    /// Whether the consumer has announced that it sleeps.
    #[cfg(all(test, not(any(loom, miri))))]
    pub(crate) fn peer_sleeps(&self) -> bool {
        self.core.peer_sleeps()
    }

    /// Wakes the sleeping consumer.
    fn wake(&self) {
        match self.core.wake_place() {
            // Reported after the wake: a sleeper that sees the report, and was not woken, has lost a ring to
            // another peer.
            WakePlace::Bell => {
                self.message_button.ring();
                self.core.report_ring();
            }
            WakePlace::Own => {
                self.core.report_ring();
                self.core.own.wake_rung();
            }
        }
    }

    fn await_room(&mut self, length: usize, wait: &Wait<'_>) -> Result<Reserved, RoomError> {
        if let Some(reserved) = self.room_now(length)? {
            return Ok(reserved);
        }
        let started = self.spinner.learns().then(Instant::now);
        let reserved = self.spin_or_sleep(length, wait)?;
        if let Some(started) = started {
            self.spinner.learn(started.elapsed());
        }
        Ok(reserved)
    }

    fn spin_or_sleep(&mut self, length: usize, wait: &Wait<'_>) -> Result<Reserved, RoomError> {
        let now = Instant::now();
        let waiting = wait.begin(now);
        if spin(self.spinner.begin().min(waiting.left(now)), || self.core.has_moved())
            && let Some(reserved) = self.room_now(length)?
        {
            return Ok(reserved);
        }
        loop {
            let seen = self.room.listen();
            let ended = match self.core.arm(length) {
                Ok(Armed::Sleep) => self.sleep(seen, &waiting)?,
                Ok(Armed::Ready) => Woken::Rung,
                Err(LoanError::Corrupt(corrupt)) => return Err(corrupt.into()),
                Err(LoanError::TooLong { asked, max } | LoanError::Full { asked, free: max }) => {
                    return Err(RoomError::TooLong { asked, max });
                }
            };
            if let Some(reserved) = self.room_now(length)? {
                return Ok(reserved);
            }
            match ended {
                Woken::Rung => {}
                Woken::TimedOut => return Err(RoomError::TimedOut),
                Woken::HungUp => return Err(RoomError::HungUp),
            }
        }
    }

    fn sleep(&mut self, seen: BellState, waiting: &Waiting<'_>) -> Result<Woken, RoomError> {
        let ended = self.room.sleep(seen, waiting);
        self.core.disarm();
        ended.map_err(RoomError::System)
    }

    fn room_now(&mut self, length: usize) -> Result<Option<Reserved>, RoomError> {
        match self.core.reserve(length) {
            Ok(reserved) => Ok(Some(reserved)),
            Err(LoanError::Full { .. }) => Ok(None),
            Err(LoanError::TooLong { asked, max }) => Err(RoomError::TooLong { asked, max }),
            Err(LoanError::Corrupt(corrupt)) => Err(corrupt.into()),
        }
    }

    /// Returns the error that this end detected in the peer's memory, if any.
    #[must_use]
    pub const fn corrupt(&self) -> Option<CorruptError> {
        self.core.corrupt()
    }
}

impl fmt::Debug for Producer {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Producer").field("core", &self.core).finish_non_exhaustive()
    }
}

/// Memory in the ring for one message, as bytes that only this side can write.
#[derive(Debug)]
pub struct Loan<'a> {
    producer: &'a mut Producer,
    reserved: Reserved,
}

impl Loan<'_> {
    /// Publishes it as a message. The peer is woken if it sleeps: then, and only then, this is a system call.
    #[inline]
    pub fn publish(self) {
        let producer = &mut *self.producer;
        if producer.core.publish() {
            producer.wake();
        }
    }

    /// Shortens it: the requested length was an upper bound. A longer length changes nothing.
    pub fn truncate(&mut self, length: usize) {
        let shorter = u32::try_from(length).unwrap_or(u32::MAX).min(self.reserved.length);
        self.producer.core.shorten(shorter);
        self.reserved.length = shorter;
    }

    /// Keeps the memory without the borrow, until [`Producer::resume`] continues it or another loan replaces
    /// it.
    #[inline]
    pub fn set_aside(self) {
        // Its drop would return the memory. It contains only a borrow.
        std::mem::forget(self);
    }
}

impl Deref for Loan<'_> {
    type Target = [u8];

    #[inline]
    fn deref(&self) -> &[u8] {
        let position = self.producer.core.payload_position(self.reserved);
        self.producer.core.own.bytes(position, self.reserved.length)
    }
}

impl DerefMut for Loan<'_> {
    #[inline]
    fn deref_mut(&mut self) -> &mut [u8] {
        let position = self.producer.core.payload_position(self.reserved);
        self.producer.core.own.bytes_mut(position, self.reserved.length)
    }
}

impl Drop for Loan<'_> {
    fn drop(&mut self) {
        // After `publish` no room is reserved any more.
        self.producer.core.give_back();
    }
}
