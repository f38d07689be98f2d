//! A message under construction: memory for its payload, in the ring itself if possible.

#[cfg(test)]
mod tests;

use std::{
    ops::{Deref, DerefMut},
    sync::Arc,
    time::Duration,
};

use bytes::{Bytes, BytesMut};
use sinew_runtime::wire::{Class, Header, Message, zeroed};

use super::{ApiError, link::loan::InRing};

/// Writable memory for one payload, lent by [`create_message`](super::Endpoint::create_message). Sending
/// consumes it. Dropping it, or the end of the process, leaves no trace.
///
/// **An endpoint lends one message at a time, and sends nothing else until that message is sent or dropped.**
/// With any transport, a second message is refused with [`ApiError::LoanActive`]. So are send, ask, reply,
/// resolve, join and leave. Unregister is refused, too, but releases the address nevertheless. Receiving
/// continues, but outcomes of received messages may be delayed. So keep the message no longer than it takes
/// to write it.
///
/// If there is room in the ring to its receiver, or to the node, the payload lies there, and sending copies
/// nothing. Otherwise (no rings, more than half a ring, no room now) it is ordinary memory that is copied
/// when sent. [`is_in_place`](Self::is_in_place) returns which. After a restart of the node it is copied to
/// the node's next incarnation.
///
/// # Examples
///
/// ```
/// use sinew::{Class, Endpoint, Tid, client::ApiError, message::Kind};
///
/// fn send_samples(endpoint: &mut Endpoint, to: Tid, samples: &[f32]) -> Result<(), ApiError> {
///     let mut memory = endpoint.create_message(to, Kind::named("plate.samples"), 4 * samples.len())?;
///     for (bytes, sample) in memory.chunks_exact_mut(4).zip(samples) {
///         bytes.copy_from_slice(&sample.to_le_bytes());
///     }
///     endpoint.loaned(memory).class(Class::Bulk).send()
/// }
/// ```
#[derive(Debug)]
#[must_use = "memory that is dropped is not sent"]
pub struct LoanedMessage {
    header: Header,
    memory: Memory,
    /// Ends when the memory has been returned.
    _loan: Loan,
}

/// The loan state of an endpoint: one message at a time.
#[derive(Debug, Default)]
pub(super) struct Lender(Arc<()>);

/// An active loan.
#[derive(Debug)]
pub(super) struct Loan {
    _of: Arc<()>,
}

impl Lender {
    /// Starts a loan.
    pub(super) fn lend(&self) -> Result<Loan, ApiError> {
        self.check_free()?;
        Ok(Loan { _of: self.0.clone() })
    }

    /// Checks that nothing is lent.
    pub(super) fn check_free(&self) -> Result<(), ApiError> {
        if Arc::strong_count(&self.0) > 1 { Err(ApiError::LoanActive) } else { Ok(()) }
    }
}

#[derive(Debug)]
enum Memory {
    Own(BytesMut),
    InRing(InRing),
}

impl LoanedMessage {
    /// Returns a message in a ring if there is room, else in its own memory.
    pub(super) fn new(loan: Loan, header: Header, room: Option<InRing>, length: usize) -> Self {
        let own = || Memory::Own(zeroed(length));
        Self { header, memory: room.map_or_else(own, Memory::InRing), _loan: loan }
    }

    /// Sets the class of the message. Default: Control.
    pub const fn set_class(&mut self, class: Class) {
        self.header.class = class;
    }

    /// Sets the age at which the message expires in a queue. At most
    /// [`TIME_TO_LIVE_MAX`](sinew_runtime::wire::TIME_TO_LIVE_MAX), 71 minutes and 35 s; a longer time is
    /// reduced to that. Default: it never expires.
    pub fn set_expires_after(&mut self, time: Duration) {
        // Only the send waits for an outcome.
        let _ = self.header.set_time_to_live(time);
    }

    /// Returns whether the payload lies in a ring: sending it copies nothing.
    #[must_use]
    pub const fn is_in_place(&self) -> bool {
        match self.memory {
            Memory::Own(_) => false,
            Memory::InRing(_) => true,
        }
    }
}

impl Deref for LoanedMessage {
    type Target = [u8];

    fn deref(&self) -> &[u8] {
        match &self.memory {
            Memory::Own(buffer) => buffer,
            Memory::InRing(room) => room.payload(),
        }
    }
}

impl DerefMut for LoanedMessage {
    fn deref_mut(&mut self) -> &mut [u8] {
        match &mut self.memory {
            Memory::Own(buffer) => buffer,
            Memory::InRing(room) => room.payload_mut(),
        }
    }
}

/// A message that is about to be sent, wherever its payload lies.
#[derive(Debug)]
pub(super) struct Draft {
    pub(super) header: Header,
    pub(super) payload: Content,
}

/// The location of a payload.
#[derive(Debug)]
pub(super) enum Content {
    Bytes(Bytes),
    InRing(InRing),
}

impl Content {
    pub(super) fn len(&self) -> usize {
        self.bytes().len()
    }

    pub(super) fn bytes(&self) -> &[u8] {
        match self {
            Self::Bytes(bytes) => bytes,
            Self::InRing(room) => room.payload(),
        }
    }

    /// Returns the payload in its own memory; copied if it lies in a ring, which is returned.
    pub(super) fn into_bytes(self) -> Bytes {
        match self {
            Self::Bytes(bytes) => bytes,
            Self::InRing(room) => room.into_bytes(),
        }
    }
}

impl Draft {
    /// Returns a message in its own memory.
    pub(super) fn into_message(self) -> Message {
        Message::new(self.header, self.payload.into_bytes())
    }
}

impl From<Message> for Draft {
    fn from(message: Message) -> Self {
        Self { header: message.header, payload: Content::Bytes(message.payload) }
    }
}

impl From<LoanedMessage> for Draft {
    #[inline]
    fn from(loaned: LoanedMessage) -> Self {
        // Its own send must not wait for the loan.
        let LoanedMessage { header, memory, _loan: _ } = loaned;
        let payload = match memory {
            Memory::Own(buffer) => Content::Bytes(buffer.freeze()),
            Memory::InRing(room) => Content::InRing(room),
        };
        Self { header, payload }
    }
}
