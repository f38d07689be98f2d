//! Room in a ring for one message, lent to the code that creates the message. Meanwhile the ring is taken out
//! of its writer.

use std::sync::Arc;

use bytes::Bytes;
use sinew_runtime::wire::{HEADER_LEN, Header};
use sinew_shm::Producer;

use super::ring::Writer;

/// A frame under construction in the ring. It is invisible before it is published, and dropping it leaves no trace.
#[derive(Debug)]
pub(crate) struct InRing {
    writer: Arc<Writer>,
    /// The producer, with the frame's memory set aside; `None` once the loan has ended.
    producer: Option<Box<Producer>>,
}

impl Writer {
    /// Lends room for a payload of `length` bytes, all zeros. Returns `None` if there is no contiguous room
    /// now, or if the ring is lent already. Never waits.
    pub(crate) fn lend(self: &Arc<Self>, length: usize) -> Option<InRing> {
        let mut producer = self.take_out(HEADER_LEN + length)?;
        // The memory contains earlier messages to others, which this caller must not read.
        producer.aside_mut().fill(0);
        Some(InRing { writer: self.clone(), producer: Some(producer) })
    }
}

impl InRing {
    /// Returns whether the frame is in the ring of this writer.
    pub(crate) fn is_of(&self, writer: &Arc<Writer>) -> bool {
        Arc::ptr_eq(&self.writer, writer)
    }

    pub(crate) fn payload(&self) -> &[u8] {
        self.producer.as_deref().and_then(|producer| producer.aside().get(HEADER_LEN..)).unwrap_or_default()
    }

    pub(crate) fn payload_mut(&mut self) -> &mut [u8] {
        let producer = self.producer.as_deref_mut();
        producer.and_then(|producer| producer.aside_mut().get_mut(HEADER_LEN..)).unwrap_or_default()
    }

    /// Publishes the frame as a message, and wakes the peer if it sleeps.
    pub(crate) fn publish(&mut self, header: &Header) {
        let Some(mut producer) = self.producer.take() else { return };
        if let Some(mut loan) = producer.resume() {
            let memory = &mut loan[..];
            let length = memory.len().saturating_sub(HEADER_LEN);
            memory[..HEADER_LEN].copy_from_slice(&header.encode_in_memory(length));
            loan.publish();
        }
        self.writer.put_back(producer);
    }

    /// Copies the payload out and returns the ring: the message cannot be sent this way any more.
    pub(crate) fn into_bytes(self) -> Bytes {
        Bytes::copy_from_slice(self.payload())
    }
}

impl Drop for InRing {
    fn drop(&mut self) {
        if let Some(mut producer) = self.producer.take() {
            // Its drop returns the room.
            drop(producer.resume());
            self.writer.put_back(producer);
        }
    }
}
