//! A side's own memory, and the connection of two sides.

use std::os::fd::BorrowedFd;

use crate::{
    bell::{Bell, BellKind, Bells, Doorbell},
    consumer::Consumer,
    core::{ConsumerCore, ProducerCore},
    error::{CreateError, OfferError},
    layout::Capacity,
    offer::Offer,
    platform,
    producer::Producer,
    wait_set::Slot,
};

/// One side's memory: the ring of its sent messages, and its header. Only this side can ever write it: the
/// system enforces that.
pub struct Region {
    pub(crate) capacity: Capacity,
    own: platform::OwnMemory,
    message: Box<dyn Doorbell>,
    room: Box<dyn Doorbell>,
    slot: Option<Slot>,
}

/// The offers that this side accepts from a peer.
#[derive(Clone, Debug)]
pub struct Terms {
    /// The largest ring of the peer that this side maps. The memory is charged to the peer, the address space
    /// to this side.
    pub capacity_max: Capacity,
    /// The kinds of bell that the peer may use. [`BellKind::EventFd`] is for trusted peers.
    pub bells: Vec<BellKind>,
}

impl Default for Terms {
    /// 16 MiB, and no bell that could block.
    fn default() -> Self {
        Self {
            capacity_max: Capacity::new(16 * 1024 * 1024).expect("a power of two within the limits"),
            bells: vec![BellKind::Futex, BellKind::Socket, BellKind::Set],
        }
    }
}

impl Region {
    /// Creates memory for a ring of this capacity, filled with zeros and sealed, and the offer for the peer.
    /// `bell` is how this side wants to be woken. It has no name in any file system, and is freed when both
    /// sides are gone.
    ///
    /// # Errors
    /// [`CreateError::Unsupported`] where there is no sealed memory; [`CreateError::SetFull`]; otherwise the error of
    /// the system.
    pub fn create(capacity: Capacity, bell: impl Into<Bell>) -> Result<(Self, Offer), CreateError> {
        let (own, memory) = platform::create(capacity)?;
        let bell = bell.into();
        let Bells { message, room, buttons, slot } = platform::bells(&bell)?;
        let descriptors = [memory].into_iter().chain(buttons).collect();
        let offered_slot = slot.as_ref().map_or(0, Slot::number);
        let offer = Offer { capacity, bell: bell.kind(), slot: offered_slot, descriptors };
        Ok((Self { capacity, own, message, room, slot }, offer))
    }

    /// Maps the peer's offer, if it is valid. The region is consumed either way.
    ///
    /// # Errors
    /// The fault and its party; then nothing of the offer is kept.
    pub fn connect(self, peer: Offer, terms: &Terms) -> Result<(Producer, Consumer), OfferError> {
        let accepted = self.accept(peer, terms)?;
        Ok(self.join(accepted))
    }

    /// Maps the peer's offer, if it is valid. The region remains, for a caller that must not close it. Its
    /// bells may hold descriptors from a peer that knows them; these are closed with the region, which can
    /// block.
    ///
    /// # Errors
    /// As of [`connect`](Self::connect).
    pub fn accept(&self, peer: Offer, terms: &Terms) -> Result<Accepted, OfferError> {
        let Offer { capacity: theirs, bell, slot, descriptors } = peer;
        if theirs > terms.capacity_max {
            return Err(OfferError::TooLarge { offered: theirs, allowed: terms.capacity_max });
        }
        if !terms.bells.contains(&bell) {
            return Err(OfferError::Bell(bell));
        }
        let mut descriptors = descriptors.into_iter();
        let memory = descriptors.next().ok_or(OfferError::Descriptors { got: 0, expected: 1 })?;
        let peer = platform::adopt(memory, theirs)?;
        let platform::Buttons { message, room, place } =
            platform::buttons(bell, slot, descriptors.collect())?;
        Ok(Accepted { peer: peer.at(place), capacity: theirs, message, room })
    }

    /// Joins both rings, this side's and the accepted one.
    #[must_use]
    pub fn join(self, peer: Accepted) -> (Producer, Consumer) {
        let Accepted { peer, capacity: theirs, message, room } = peer;
        let (header, ring) = self.own.split();
        let producer = ProducerCore::new(ring, peer.clone(), self.capacity);
        let consumer = ConsumerCore::new(header, peer, theirs);
        (Producer::new(producer, self.room, message), Consumer::new(consumer, self.message, room, self.slot))
    }

    /// Returns the descriptors of this side's bells, for messages and for room; `None` for a futex.
    #[must_use]
    pub fn bells(&self) -> [Option<BorrowedFd<'_>>; 2] {
        [self.message.fd(), self.room.fd()]
    }

    /// Writes any value at any place, like a hostile peer. `place` counts 32-bit words from the region's
    /// beginning and is taken modulo their number.
    #[cfg(any(test, feature = "hostile-peer"))]
    pub fn scribble(&mut self, place: u32, value: u32) {
        self.own.scribble(place, value);
    }
}

/// A peer's validated memory, mapped, and its bells. For [`Region::join`].
pub struct Accepted {
    peer: platform::PeerMemory,
    capacity: Capacity,
    message: Box<dyn Doorbell>,
    room: Box<dyn Doorbell>,
}

impl std::fmt::Debug for Accepted {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Accepted").field("capacity", &self.capacity).finish_non_exhaustive()
    }
}

impl std::fmt::Debug for Region {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Region").field("capacity", &self.capacity).finish_non_exhaustive()
    }
}
