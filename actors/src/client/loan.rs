//! A message in the making: memory for its payload, in the ring itself where that is possible.

#[cfg(test)]
mod tests;

use std::{
    ops::{Deref, DerefMut},
    sync::Arc,
    time::Duration,
};

use bytes::Bytes;
use sinew_runtime::wire::{Class, Header, Message, MessageBuffer};

use super::{ApiError, link::loan::InRing};

/// Writable memory for one payload: what [`create_message`](super::Endpoint::create_message) lends. Sent, it is gone;
/// dropped, it was never there, and so it is when the process is killed.
///
/// **An endpoint lends one message at a time, and until that is sent or dropped nothing else goes out of it**: to create
/// another, to send, ask, reply, resolve, join and leave are refused with [`ApiError::LoanActive`], whatever carries the messages, and
/// so is to unregister, which gives the address back all the same. To receive goes on. What is said of received messages
/// may wait. So keep it no longer than it takes to write it.
///
/// Where there is room for it in the ring to its receiver, or to the node, it lies there, and sending it copies nothing. Else
/// (no rings, more than half a ring, no room now) it is ordinary memory, copied when it is sent.
/// [`is_in_place`](Self::is_in_place) says which. After a restart of the node it is copied to the node's next life.
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
    /// Over when the memory has been given back.
    _loan: Loan,
}

/// What an endpoint lends from: one message at a time.
#[derive(Debug, Default)]
pub(super) struct Lender(Arc<()>);

/// A loan that is not over.
#[derive(Debug)]
pub(super) struct Loan {
    _of: Arc<()>,
}

impl Lender {
    /// Begins a loan.
    pub(super) fn lend(&self) -> Result<Loan, ApiError> {
        self.be_free()?;
        Ok(Loan { _of: self.0.clone() })
    }

    /// Whether nothing is lent.
    pub(super) fn be_free(&self) -> Result<(), ApiError> {
        if Arc::strong_count(&self.0) > 1 { Err(ApiError::LoanActive) } else { Ok(()) }
    }
}

#[derive(Debug)]
enum Memory {
    Own(MessageBuffer),
    InRing(InRing),
}

impl LoanedMessage {
    /// In a ring if there is room, else in memory of its own.
    pub(super) fn new(loan: Loan, header: Header, room: Option<InRing>, length: usize) -> Self {
        let own = || Memory::Own(MessageBuffer::new(header, length));
        Self { header, memory: room.map_or_else(own, Memory::InRing), _loan: loan }
    }

    /// The class in which it will travel. Control at first.
    pub const fn set_class(&mut self, class: Class) {
        self.header.class = class;
    }

    /// Has it expire where it waits when it is older than this. At most [`TIME_TO_LIVE_MAX`](sinew_runtime::wire::TIME_TO_LIVE_MAX), 71 minutes
    /// and 35 s: a longer time counts as that. It never expires at first.
    pub fn set_expires_after(&mut self, time: Duration) {
        // It is the send that waits for an outcome.
        let _ = self.header.set_time_to_live(time);
    }

    /// Whether it lies in a ring: sending it copies nothing.
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

/// A message that is about to be sent, wherever its payload is.
#[derive(Debug)]
pub(super) struct Draft {
    pub(super) header: Header,
    pub(super) payload: Content,
}

/// Where a payload is.
#[derive(Debug)]
pub(super) enum Content {
    Bytes(Bytes),
    InRing(InRing),
}

impl Content {
    pub(super) fn len(&self) -> usize {
        match self {
            Self::Bytes(bytes) => bytes.len(),
            Self::InRing(room) => room.payload().len(),
        }
    }

    /// In memory of its own; copied if it lies in a ring, which is given back.
    pub(super) fn into_bytes(self) -> Bytes {
        match self {
            Self::Bytes(bytes) => bytes,
            Self::InRing(room) => room.into_bytes(),
        }
    }
}

impl Draft {
    /// As a message in memory of its own.
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
    fn from(lent: LoanedMessage) -> Self {
        // What its own sending does not wait for.
        let LoanedMessage { header, memory, _loan: _ } = lent;
        let payload = match memory {
            Memory::Own(buffer) => Content::Bytes(buffer.freeze().payload),
            Memory::InRing(room) => Content::InRing(room),
        };
        Self { header, payload }
    }
}
