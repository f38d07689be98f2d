//! A frame that is written without waiting, as far as there is room: the rest of a long one is written later.

use std::{io::IoSlice, mem, sync::Arc, sync::PoisonError, time::Duration};

use rustix::fd::{AsFd, BorrowedFd};
use sinew_protocol::ring;
use sinew_runtime::wire::{HEADER_LEN, Message};
use sinew_shm::{Armed, HangUp, LoanError, Producer, Wait};

use super::Writer;
use crate::ApiError;

/// The rest of a frame that is partly in the ring. It owns the ring until the frame is complete: outcomes of
/// other threads are pending meanwhile.
#[derive(Debug)]
pub(crate) struct Rest {
    writer: Arc<Writer>,
    /// `None` once the ring is returned.
    producer: Option<Box<Producer>>,
    head: [u8; HEADER_LEN],
    message: Message,
    written: usize,
    /// Its sender has withdrawn it: the receiver must get nothing of it.
    is_withdrawn: bool,
}

/// The progress of a frame.
#[derive(Debug)]
pub(crate) enum Begun {
    /// The frame is in the ring.
    Whole,
    /// Part of the frame is in the ring; the peer reads the rest as part of the same frame.
    Part(Rest),
    /// Nothing is in the ring: it is full.
    Full(Message),
}

impl Writer {
    /// Writes a frame as far as there is room now.
    ///
    /// # Errors
    /// [`ApiError::LoanActive`], or [`ApiError::Closed`] if the ring cannot be used any more; nothing was written.
    pub(crate) fn begin(self: &Arc<Self>, message: Message) -> Result<Begun, (ApiError, Message)> {
        self.flush_pending();
        let head = message.header.encode_in_memory(message.payload.len());
        let mut place = self.producer.lock().unwrap_or_else(PoisonError::into_inner);
        let Some(producer) = place.as_deref_mut() else { return Err((ApiError::LoanActive, message)) };
        let written = match ring::write(producer, &[IoSlice::new(&head), IoSlice::new(&message.payload)]) {
            Ok(count) => count,
            Err(LoanError::Full { .. }) => return Ok(Begun::Full(message)),
            Err(error @ (LoanError::TooLong { .. } | LoanError::Corrupt(_))) => {
                self.close();
                return Err((ApiError::Closed(error.to_string()), message));
            }
        };
        let producer = if written < message.size() { place.take() } else { None };
        drop(place);
        if producer.is_none() {
            self.flush_pending();
            return Ok(Begun::Whole);
        }
        let mut rest = Rest { writer: self.clone(), producer, head, message, written, is_withdrawn: false };
        match rest.continue_writing() {
            Ok(true) => Ok(Begun::Whole),
            Ok(false) => Ok(Begun::Part(rest)),
            Err(error) => Err((error, rest.into_message())),
        }
    }

    /// Returns the peer's read counter; 0 while the ring is loaned.
    pub(crate) fn taken(&self) -> u32 {
        let mut producer = self.producer.lock().unwrap_or_else(PoisonError::into_inner);
        producer.as_deref_mut().map_or(0, taken)
    }

    /// Returns the total of written bytes; `None` while the ring is lent.
    pub(crate) fn published(&self) -> Option<u32> {
        let producer = self.producer.lock().unwrap_or_else(PoisonError::into_inner);
        producer.as_deref().map(Producer::published)
    }

    /// Returns how much of that the peer has read; `None` if unknown: while the ring is lent, or if its
    /// memory holds an impossible value.
    pub(crate) fn taken_so_far(&self) -> Option<u32> {
        let mut producer = self.producer.lock().unwrap_or_else(PoisonError::into_inner);
        let producer = producer.as_deref_mut()?;
        Some(producer.published().wrapping_sub(producer.unread().ok()?))
    }

    /// Waits until there is room for the start of a frame of this many bytes, until the peer's end, or for
    /// `within` at most.
    pub(crate) fn await_room(&self, length: usize, within: Duration) {
        let mut producer = self.producer.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(producer) = producer.as_deref_mut() {
            await_room(producer, length, self, within);
        }
    }
}

fn await_room(producer: &mut Producer, length: usize, writer: &Writer, within: Duration) {
    let wait = Wait::within(within).or_hang_up(HangUp::Socket(writer.socket.as_fd()));
    let length = ring::piece(producer, length);
    // The next write shows why the wait ended.
    drop(producer.loan_before(length, &wait));
}

/// Returns the peer's read counter; 0 for corrupt memory, which is detected at the next write.
fn taken(producer: &mut Producer) -> u32 {
    producer.published().wrapping_sub(producer.unread().unwrap_or_default())
}

/// Announces sleep until there is room for the next record of a frame of which `length` bytes are left.
pub(super) fn arm(producer: &mut Producer, length: usize) -> Armed {
    let length = ring::piece(producer, length);
    // An error is detected at the next write.
    producer.arm(length).unwrap_or(Armed::Ready)
}

impl Rest {
    /// Continues writing, as far as there is room now. Returns whether all is written. After an error the
    /// peer observes the end of the link.
    ///
    /// # Errors
    /// The ring cannot be used any more.
    pub(crate) fn continue_writing(&mut self) -> Result<bool, ApiError> {
        while self.producer.is_some() && (self.is_withdrawn || self.left() > 0) {
            match self.write_some() {
                Ok(()) => {}
                Err(LoanError::Full { .. }) => return Ok(false),
                Err(error @ (LoanError::TooLong { .. } | LoanError::Corrupt(_))) => {
                    self.writer.close();
                    return Err(ApiError::Closed(error.to_string()));
                }
            }
        }
        self.return_ring();
        Ok(true)
    }

    /// Returns the peer's read counter.
    pub(crate) fn taken(&mut self) -> u32 {
        self.producer.as_deref_mut().map_or(0, taken)
    }

    /// Writes one record.
    fn write_some(&mut self) -> Result<(), LoanError> {
        let Some(producer) = self.producer.as_deref_mut() else { return Ok(()) };
        if self.is_withdrawn {
            ring::withdraw(producer)?;
            self.return_ring();
            return Ok(());
        }
        let parts = [
            IoSlice::new(&self.head[self.written.min(HEADER_LEN)..]),
            IoSlice::new(&self.message.payload[self.written.saturating_sub(HEADER_LEN)..]),
        ];
        self.written += ring::write(producer, &parts)?;
        Ok(())
    }

    /// Returns the number of unwritten bytes.
    fn left(&self) -> usize {
        if self.is_withdrawn { 0 } else { HEADER_LEN + self.message.payload.len() - self.written }
    }

    /// Withdraws the written part: a record without bytes is written instead of the rest.
    pub(crate) fn withdraw(&mut self) {
        self.is_withdrawn = true;
        self.message.payload = bytes::Bytes::new();
    }

    /// Returns whether the frame was withdrawn and only the withdrawal is still unwritten.
    pub(crate) const fn is_withdrawn(&self) -> bool {
        self.is_withdrawn
    }

    /// Returns the message that will not be completed because its link ends; `None` if it was withdrawn.
    pub(crate) fn cut(&self) -> Option<Message> {
        (!self.is_withdrawn).then(|| Message::new(self.message.header, self.message.payload.clone()))
    }

    /// Announces that a task waits for room for more.
    pub(crate) fn arm(&mut self) -> Armed {
        let left = self.left();
        self.producer.as_deref_mut().map_or(Armed::Ready, |producer| arm(producer, left))
    }

    /// Records that the task is awake.
    pub(crate) fn disarm(&mut self) {
        if let Some(producer) = self.producer.as_deref_mut() {
            producer.disarm();
        }
    }

    /// Returns the descriptor that signals room.
    pub(crate) fn bell(&self) -> Option<BorrowedFd<'_>> {
        self.producer.as_deref().and_then(Producer::fd)
    }

    /// Waits until there is room for more, until the peer's end, or for `within` at most.
    pub(crate) fn await_room(&mut self, within: Duration) {
        let left = self.left();
        if let Some(producer) = self.producer.as_deref_mut() {
            await_room(producer, left, &self.writer, within);
        }
    }

    /// Wakes the peer: the link's socket has been closed.
    pub(crate) fn wake_peer(&self) {
        if let Some(producer) = &self.producer {
            producer.ring();
        }
    }

    fn into_message(mut self) -> Message {
        let nothing = Message::new(self.message.header, bytes::Bytes::new());
        mem::replace(&mut self.message, nothing)
    }

    fn return_ring(&mut self) {
        if let Some(producer) = self.producer.take() {
            *self.writer.producer.lock().unwrap_or_else(PoisonError::into_inner) = Some(producer);
            self.writer.flush_pending();
        }
    }
}

impl Drop for Rest {
    fn drop(&mut self) {
        // A frame that was cut off ends with its link: nothing may be written behind it.
        if self.written == 0 {
            self.return_ring();
        }
    }
}
