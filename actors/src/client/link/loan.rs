//! Room in a ring for one message, kept by whoever makes the message. The ring is taken out of its writer meanwhile.

use std::sync::Arc;

use bytes::Bytes;
use sinew_runtime::wire::{HEADER_LEN, Header};
use sinew_shm::Producer;

use super::ring::Writer;

/// A frame in the making, in the ring. Nobody sees it before it is published; dropped, it was never there.
#[derive(Debug)]
pub(in crate::client) struct InRing {
    writer: Arc<Writer>,
    /// With the frame's memory set aside; `None` once that is over.
    producer: Option<Box<Producer>>,
}

impl Writer {
    /// Lends room for a payload of `length` bytes, all zeros; `None` if there is no room for it in one piece now, or the ring
    /// is lent already. Never waits.
    pub(in crate::client) fn lend(self: &Arc<Self>, length: usize) -> Option<InRing> {
        let mut producer = self.take_out(HEADER_LEN + length)?;
        // Left over are messages to others, which are not this receiver's to read.
        producer.aside_mut().fill(0);
        Some(InRing { writer: self.clone(), producer: Some(producer) })
    }
}

impl InRing {
    /// Whether it lies in the ring of this writer.
    pub(in crate::client) fn is_of(&self, writer: &Arc<Writer>) -> bool {
        Arc::ptr_eq(&self.writer, writer)
    }

    pub(in crate::client) fn payload(&self) -> &[u8] {
        self.producer.as_deref().and_then(|producer| producer.aside().get(HEADER_LEN..)).unwrap_or_default()
    }

    pub(in crate::client) fn payload_mut(&mut self) -> &mut [u8] {
        let producer = self.producer.as_deref_mut();
        producer.and_then(|producer| producer.aside_mut().get_mut(HEADER_LEN..)).unwrap_or_default()
    }

    /// Makes it a message, and wakes the peer if it sleeps.
    pub(in crate::client) fn publish(mut self, header: &Header) {
        let head = header.encode_in_memory(self.payload().len());
        let Some(mut producer) = self.producer.take() else { return };
        if let Some(mut loan) = producer.resume() {
            loan[..HEADER_LEN].copy_from_slice(&head);
            loan.publish();
        }
        self.writer.put_back(producer);
    }

    /// Copies it out, and gives the ring back: it cannot go this way any more.
    pub(in crate::client) fn into_bytes(self) -> Bytes {
        Bytes::copy_from_slice(self.payload())
    }
}

impl Drop for InRing {
    fn drop(&mut self) {
        if let Some(mut producer) = self.producer.take() {
            // Its drop gives the room back.
            drop(producer.resume());
            self.writer.put_back(producer);
        }
    }
}
