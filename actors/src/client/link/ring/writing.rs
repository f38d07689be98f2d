//! A frame that is written without waiting, as far as there is room: the rest of a long one goes out later.

use std::{io::IoSlice, mem, sync::Arc, sync::PoisonError, time::Duration};

use rustix::fd::{AsFd, BorrowedFd};
use sinew_runtime::wire::{HEADER_LEN, Message};
use sinew_shm::{Armed, HangUp, LoanError, Producer, Wait};

use super::Writer;
use crate::{client::ApiError, ring};

/// The rest of a frame, part of which is in the ring. It has the ring for itself until it is whole: what others say
/// meanwhile is owed.
#[derive(Debug)]
pub(in crate::client) struct Rest {
    writer: Arc<Writer>,
    /// `None` once it is given back.
    producer: Option<Box<Producer>>,
    head: [u8; HEADER_LEN],
    message: Message,
    written: usize,
    /// Its sender has given up: nothing of it is to be received.
    is_withdrawn: bool,
}

/// How far a frame came.
#[derive(Debug)]
pub(in crate::client) enum Begun {
    /// It is in the ring.
    Whole,
    /// Part of it is in the ring; the peer takes the rest for the same frame.
    Part(Rest),
    /// Nothing is in the ring: it is full.
    Full(Message),
}

impl Writer {
    /// Writes a frame as far as there is room now.
    ///
    /// # Errors
    /// [`ApiError::LoanActive`], or [`ApiError::Closed`] if the ring cannot be used any more; nothing was written.
    pub(in crate::client) fn begin(self: &Arc<Self>, message: Message) -> Result<Begun, (ApiError, Message)> {
        self.pay();
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
            self.pay();
            return Ok(Begun::Whole);
        }
        let mut rest = Rest { writer: self.clone(), producer, head, message, written, is_withdrawn: false };
        match rest.go_on() {
            Ok(true) => Ok(Begun::Whole),
            Ok(false) => Ok(Begun::Part(rest)),
            Err(error) => Err((error, rest.into_message())),
        }
    }

    /// A count of what the peer takes; 0 while the ring is lent.
    pub(in crate::client) fn taken(&self) -> u32 {
        let mut producer = self.producer.lock().unwrap_or_else(PoisonError::into_inner);
        producer.as_deref_mut().map_or(0, taken)
    }

    /// How much was ever written; `None` while the ring is lent.
    pub(in crate::client) fn published(&self) -> Option<u32> {
        let producer = self.producer.lock().unwrap_or_else(PoisonError::into_inner);
        producer.as_deref().map(Producer::published)
    }

    /// How much of that the peer has taken; `None` where that is not known: while the ring is lent, or its memory says what cannot be.
    pub(in crate::client) fn taken_so_far(&self) -> Option<u32> {
        let mut producer = self.producer.lock().unwrap_or_else(PoisonError::into_inner);
        let producer = producer.as_deref_mut()?;
        Some(producer.published().wrapping_sub(producer.untaken().ok()?))
    }

    /// Waits until there is room for the beginning of a frame of so many bytes, the peer's end, or `within` this time.
    pub(in crate::client) fn await_room(&self, length: usize, within: Duration) {
        let mut producer = self.producer.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(producer) = producer.as_deref_mut() {
            await_room(producer, length, self, within);
        }
    }
}

fn await_room(producer: &mut Producer, length: usize, writer: &Writer, within: Duration) {
    let wait = Wait::within(within).or_hang_up(HangUp::Socket(writer.socket.as_fd()));
    let length = ring::piece(producer, length);
    // Whatever ended the wait shows when it is written.
    drop(producer.loan_before(length, &wait));
}

/// Corrupt memory, which shows when it is written, takes nothing.
fn taken(producer: &mut Producer) -> u32 {
    producer.published().wrapping_sub(producer.untaken().unwrap_or_default())
}

/// Announces sleep until there is room for the next record of a frame of which `length` bytes are left.
pub(super) fn arm(producer: &mut Producer, length: usize) -> Armed {
    let length = ring::piece(producer, length);
    // Whatever is wrong shows when it is written.
    producer.arm(length).unwrap_or(Armed::Ready)
}

impl Rest {
    /// Writes on, as far as there is room now; whether all is written. The peer sees an end of the link otherwise.
    ///
    /// # Errors
    /// The ring cannot be used any more.
    pub(in crate::client) fn go_on(&mut self) -> Result<bool, ApiError> {
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
        self.give_back();
        Ok(true)
    }

    /// A count of what the peer takes.
    pub(in crate::client) fn taken(&mut self) -> u32 {
        self.producer.as_deref_mut().map_or(0, taken)
    }

    /// Writes one record.
    fn write_some(&mut self) -> Result<(), LoanError> {
        let Some(producer) = self.producer.as_deref_mut() else { return Ok(()) };
        if self.is_withdrawn {
            ring::withdraw(producer)?;
            self.give_back();
            return Ok(());
        }
        let parts = [
            IoSlice::new(&self.head[self.written.min(HEADER_LEN)..]),
            IoSlice::new(&self.message.payload[self.written.saturating_sub(HEADER_LEN)..]),
        ];
        self.written += ring::write(producer, &parts)?;
        Ok(())
    }

    /// Bytes that are not written yet.
    fn left(&self) -> usize {
        if self.is_withdrawn { 0 } else { HEADER_LEN + self.message.payload.len() - self.written }
    }

    /// Takes back what is written: a record without bytes is written instead of the rest.
    pub(in crate::client) fn withdraw(&mut self) {
        self.is_withdrawn = true;
        self.message.payload = bytes::Bytes::new();
    }

    /// Whether it was taken back, and only that is still to be said.
    pub(in crate::client) const fn is_withdrawn(&self) -> bool {
        self.is_withdrawn
    }

    /// The message that will not become whole any more, since its link ends; `None` if it was taken back.
    pub(in crate::client) fn cut(&self) -> Option<Message> {
        (!self.is_withdrawn).then(|| Message::new(self.message.header, self.message.payload.clone()))
    }

    /// Announces that a task waits for room for more.
    pub(in crate::client) fn arm(&mut self) -> Armed {
        let left = self.left();
        self.producer.as_deref_mut().map_or(Armed::Ready, |producer| arm(producer, left))
    }

    /// Says that it is awake.
    pub(in crate::client) fn disarm(&mut self) {
        if let Some(producer) = self.producer.as_deref_mut() {
            producer.disarm();
        }
    }

    /// The descriptor of the bell for room.
    pub(in crate::client) fn bell(&self) -> Option<BorrowedFd<'_>> {
        self.producer.as_deref().and_then(Producer::fd)
    }

    /// Waits until there is room for more, the peer's end, or `within` this time.
    pub(in crate::client) fn await_room(&mut self, within: Duration) {
        let left = self.left();
        if let Some(producer) = self.producer.as_deref_mut() {
            await_room(producer, left, &self.writer, within);
        }
    }

    /// Wakes the peer: the link's socket has been closed.
    pub(in crate::client) fn wake_peer(&self) {
        if let Some(producer) = &self.producer {
            producer.ring();
        }
    }

    fn into_message(mut self) -> Message {
        let nothing = Message::new(self.message.header, bytes::Bytes::new());
        mem::replace(&mut self.message, nothing)
    }

    fn give_back(&mut self) {
        if let Some(producer) = self.producer.take() {
            *self.writer.producer.lock().unwrap_or_else(PoisonError::into_inner) = Some(producer);
            self.writer.pay();
        }
    }
}

impl Drop for Rest {
    fn drop(&mut self) {
        // A frame that was cut ends with its link: nobody may write behind it.
        if self.written == 0 {
            self.give_back();
        }
    }
}
