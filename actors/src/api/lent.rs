//! A message in the making: memory for its payload, in the ring itself where that is possible.

#[cfg(test)]
mod tests;

use std::ops::{Deref, DerefMut};

use bytes::Bytes;
use sinew_runtime::wire::{Class, Header, Message, MessageBuffer};

use super::link::loan::InRing;

/// Writable memory for one payload: what [`create_message`](super::Endpoint::create_message) lends. Sent, it is gone;
/// dropped, it was never there, and so it is when the process is killed.
///
/// Where there is room for it in the ring to its receiver, or to the node, it lies there, and sending it copies nothing.
/// That ring is lent until then: whatever else is to be sent on it is refused with
/// [`ApiError::Lent`](super::ApiError::Lent), and the outcomes of messages that were received wait. So keep it no longer than
/// it takes to write it. Else (no rings, more than half a ring, no room now, or another one lent already) it is ordinary
/// memory, copied when it is sent. [`is_in_place`](Self::is_in_place) says which.
#[derive(Debug)]
#[must_use = "memory that is dropped is not sent"]
pub struct LentMessage {
    header: Header,
    memory: Memory,
}

#[derive(Debug)]
enum Memory {
    Own(MessageBuffer),
    InRing(InRing),
}

impl LentMessage {
    pub(super) fn new(header: Header, length: usize) -> Self {
        Self { memory: Memory::Own(MessageBuffer::new(header, length)), header }
    }

    pub(super) const fn in_ring(header: Header, room: InRing) -> Self {
        Self { header, memory: Memory::InRing(room) }
    }

    /// The class in which it will travel. Control at first.
    pub const fn set_class(&mut self, class: Class) {
        self.header.class = class;
    }

    /// Whether it lies in a ring: sending it copies nothing, and nothing else goes that way before.
    #[must_use]
    pub const fn is_in_place(&self) -> bool {
        match self.memory {
            Memory::Own(_) => false,
            Memory::InRing(_) => true,
        }
    }
}

impl Deref for LentMessage {
    type Target = [u8];

    fn deref(&self) -> &[u8] {
        match &self.memory {
            Memory::Own(buffer) => buffer,
            Memory::InRing(room) => room.payload(),
        }
    }
}

impl DerefMut for LentMessage {
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

impl From<LentMessage> for Draft {
    fn from(lent: LentMessage) -> Self {
        let payload = match lent.memory {
            Memory::Own(buffer) => Content::Bytes(buffer.freeze().payload),
            Memory::InRing(room) => Content::InRing(room),
        };
        Self { header: lent.header, payload }
    }
}
