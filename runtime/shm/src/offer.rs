//! The offer of a side to the other: its memory and its bells, as descriptors and a few plain bytes.

use std::{
    io,
    os::fd::{AsFd, OwnedFd},
};

use crate::{
    bell::BellKind,
    error::{OfferError, PassError},
    layout::{Capacity, MAGIC, VERSION},
    platform,
    wait_set::SLOTS_MAX,
};

/// Length of [`Offer::to_bytes`].
pub const OFFER_BYTES: usize = 24;

/// A region as its peer receives it. Created by [`crate::Region::create`], consumed by
/// [`crate::Region::connect`].
///
/// Its bytes, little-endian: magic (8, `SINEWSHM`), version (4), kind of bell (1), place in the set (1), zero (2),
/// capacity of the ring (8). Its descriptors, in this order: the memory; then for a futex the page with both bells; for
/// a set the page with bells and bits, and the page with the announcement; otherwise the bell for messages and the bell
/// for room.
#[derive(Debug)]
pub struct Offer {
    pub(crate) capacity: Capacity,
    pub(crate) bell: BellKind,
    /// The place in the set of the offering side; 0 without a set.
    pub(crate) slot: u8,
    pub(crate) descriptors: Vec<OwnedFd>,
}

impl Offer {
    /// The most descriptors an offer has.
    pub const DESCRIPTORS_MAX: usize = 3;

    /// Returns the size of the offered ring in bytes.
    #[must_use]
    pub const fn capacity(&self) -> Capacity {
        self.capacity
    }

    /// Returns how the offering side wants to be woken.
    #[must_use]
    pub const fn bell(&self) -> BellKind {
        self.bell
    }

    /// Returns the plain part, for a caller that embeds it in a frame of its own.
    #[must_use]
    pub fn to_bytes(&self) -> [u8; OFFER_BYTES] {
        let mut bytes = [0; OFFER_BYTES];
        bytes[..8].copy_from_slice(&MAGIC.to_le_bytes());
        bytes[8..12].copy_from_slice(&VERSION.to_le_bytes());
        bytes[12] = self.bell.number();
        bytes[13] = self.slot;
        bytes[16..].copy_from_slice(&u64::from(self.capacity.bytes()).to_le_bytes());
        bytes
    }

    /// Returns the descriptors, to be passed with the plain part and in this order.
    #[must_use]
    pub fn descriptors(&self) -> &[OwnedFd] {
        &self.descriptors
    }

    /// Sends it over a unix socket: one message with its descriptors beside it. Once it has arrived, this
    /// side's copy can be dropped.
    ///
    /// # Errors
    /// [`PassError::System`], also when a non-blocking socket is full.
    pub fn send(&self, socket: impl AsFd) -> Result<(), PassError> {
        platform::send(self, socket.as_fd())
    }

    /// Receives an offer from a unix socket, where it must be the next data. The descriptors of an invalid
    /// offer are closed. Closing a peer's descriptor can block (a file on a file system of the peer's own),
    /// so this is not for a thread that must not block.
    ///
    /// # Errors
    /// The outer one as of [`Received::receive`]; the inner one when it is not an offer.
    pub fn receive(socket: impl AsFd) -> Result<Result<Self, OfferError>, PassError> {
        Ok(Received::receive(socket)?.into_offer())
    }

    /// Creates an offer from the data of the peer. The descriptors are checked when it is connected.
    ///
    /// # Errors
    /// When the bytes are not an offer, or the number of descriptors is not the one that they require.
    pub fn from_parts(bytes: &[u8; OFFER_BYTES], descriptors: Vec<OwnedFd>) -> Result<Self, OfferError> {
        let (magic, version) = (u64::from_le_bytes(take(bytes, 0)), u32::from_le_bytes(take(bytes, 8)));
        if magic != MAGIC {
            return Err(OfferError::Magic);
        }
        if version != VERSION {
            return Err(OfferError::Version { theirs: version, ours: VERSION });
        }
        let bell = BellKind::numbered(bytes[12]).ok_or(OfferError::UnknownBell(bytes[12]))?;
        let slot = bytes[13];
        if usize::from(slot) >= SLOTS_MAX {
            return Err(OfferError::Slot(slot));
        }
        let capacity = Capacity::new(u64::from_le_bytes(take(bytes, 16)))
            .map_err(|error| OfferError::Capacity(error.0))?;
        let expected = 1 + bell.descriptors();
        if descriptors.len() != expected {
            return Err(OfferError::Descriptors { got: descriptors.len(), expected });
        }
        Ok(Self { capacity, bell, slot, descriptors })
    }
}

/// Data received in the place of an offer, before any of it is validated or closed.
#[derive(Debug)]
pub struct Received {
    pub(crate) bytes: [u8; OFFER_BYTES],
    /// At most as many as an offer can have.
    pub(crate) descriptors: Vec<OwnedFd>,
    pub(crate) copies: Vec<OwnedFd>,
}

impl Received {
    /// Receives a message of an offer's length with no more descriptors than an offer can have. Other data is
    /// left in the socket, unchanged: it costs this process nothing until the socket is drained or closed,
    /// which can block. No close in this function can block.
    ///
    /// # Errors
    /// [`PassError::Closed`], [`PassError::Broken`], and [`PassError::System`]: also when a non-blocking
    /// socket is empty, and when this process has no descriptor left; then the offer is still there.
    pub fn receive(socket: impl AsFd) -> Result<Self, PassError> {
        platform::receive(socket.as_fd())
    }

    /// Returns further copies of the descriptors; none the second time. While these exist, no close of this
    /// value's descriptors is the last one of the peer's, the only one that can block.
    pub fn copies(&mut self) -> Vec<OwnedFd> {
        std::mem::take(&mut self.copies)
    }

    /// Converts the data into the offer. Data that does not belong to one is closed.
    ///
    /// # Errors
    /// As [`Offer::from_parts`].
    pub fn into_offer(self) -> Result<Offer, OfferError> {
        Offer::from_parts(&self.bytes, self.descriptors)
    }
}

/// Whether descriptors may arrive over a unix socket.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Descriptors {
    /// The system rejects them at the sender (`EPERM`).
    Refused,
    /// They arrive: the default of the system.
    Taken,
}

/// Sets whether descriptors may arrive over `socket` from now on; data that has arrived already stays. A
/// connection inherits it from the listening socket.
///
/// # Errors
/// The system cannot refuse them: Linux before 6.16. Then they can arrive, and nothing else has changed.
pub fn set_descriptors(socket: impl AsFd, which: Descriptors) -> io::Result<()> {
    platform::set_descriptors(socket.as_fd(), which)
}

/// Makes an urgent byte that is sent to `socket` arrive in its place among the others. Otherwise a peek skips
/// it, with its descriptors. These are then closed when the reader reads on or closes the socket. Applies to
/// data that has arrived already, too.
///
/// # Errors
/// It is not a socket.
pub fn keep_urgent_in_line(socket: impl AsFd) -> io::Result<()> {
    platform::keep_urgent_in_line(socket.as_fd())
}

/// Returns a descriptor of the process that has connected at the other end of a unix socket, or that listens
/// there. It is readable when that process has ended, also if its ID is unknown because it lives in another
/// PID namespace.
///
/// # Errors
/// The system does not support it: Linux before 6.5. Or the process has ended and was reaped (ESRCH or
/// EINVAL).
pub fn peer_pidfd(socket: impl AsFd) -> io::Result<OwnedFd> {
    platform::peer_pidfd(socket.as_fd())
}

fn take<const N: usize>(bytes: &[u8; OFFER_BYTES], from: usize) -> [u8; N] {
    std::array::from_fn(|index| bytes[from + index])
}

#[cfg(all(test, not(loom)))]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn any_bytes_give_an_offer_or_an_error(bytes: [u8; OFFER_BYTES], like_ours: bool) {
            let mut bytes = bytes;
            if like_ours {
                bytes[..8].copy_from_slice(&MAGIC.to_le_bytes());
                bytes[8..12].copy_from_slice(&VERSION.to_le_bytes());
            }
            prop_assert!(Offer::from_parts(&bytes, Vec::new()).is_err(), "no offer comes without memory");
        }
    }

    #[test]
    fn other_version_is_rejected_with_both_versions() {
        let offer =
            Offer { capacity: Capacity::MIN, bell: BellKind::Futex, slot: 0, descriptors: Vec::new() };
        let mut bytes = offer.to_bytes();
        bytes[8] = 9;
        let refused = Offer::from_parts(&bytes, Vec::new()).expect_err("version 9 is not known");
        assert_eq!(refused.to_string(), "the peer's layout has version 9, this one 3");
    }
}
