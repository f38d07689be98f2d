//! Errors, and the party at fault for each.

use std::io;

use thiserror::Error;

use crate::{bell::BellKind, layout::Capacity};

/// The peer's fault: its shared memory holds values that no valid peer writes. The connection is unusable;
/// both its halves repeat this error from now on. Nothing was read or written outside the ring.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Error)]
pub enum CorruptError {
    /// The peer's count of published bytes went back, or beyond the ring's capacity, or is not a multiple of
    /// 8.
    #[error("the peer's tail of {tail} does not follow {seen}")]
    Tail {
        /// The count that the peer wrote.
        tail: u32,
        /// The peer's previous count.
        seen: u32,
    },
    /// The peer's count of consumed bytes went back, or beyond the published bytes, or is not a multiple of
    /// 8.
    #[error("the peer's head of {head} does not lie between {seen} and {tail}")]
    Head {
        /// The count that the peer wrote.
        head: u32,
        /// The peer's previous count.
        seen: u32,
        /// This side's count of published bytes.
        tail: u32,
    },
    /// A record does not begin with a valid mark.
    #[error("a record begins with {0:#018x}")]
    Mark(u64),
    /// A message would reach beyond the published bytes, or beyond the ring's end, or is longer than half the
    /// ring.
    #[error("a message of {length} bytes where {room} bytes are left")]
    Length {
        /// The length that the peer wrote.
        length: u32,
        /// The greatest possible length, including its mark.
        room: u32,
    },
    /// A skip to the ring's beginning without a message there.
    #[error("a skip of {skipped} bytes with {published} published")]
    Skip {
        /// Bytes from the skip to the ring's end.
        skipped: u32,
        /// Bytes that were published and not consumed.
        published: u32,
    },
}

/// The reason why no memory was loaned for a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Error)]
pub enum LoanError {
    /// The caller's fault: no ring of this capacity can ever hold it.
    #[error("{asked} bytes are more than a message may have here ({max})")]
    TooLong {
        /// The requested length, in bytes.
        asked: usize,
        /// The longest message, in bytes.
        max: usize,
    },
    /// The peer has not consumed enough yet. Nothing changed; try again later or wait for room.
    #[error("no room for {asked} bytes now: {free} at most")]
    Full {
        /// The requested length, in bytes.
        asked: usize,
        /// The longest message that would fit now, in bytes; 0 may also mean that none does.
        free: usize,
    },
    /// The peer's fault.
    #[error(transparent)]
    Corrupt(#[from] CorruptError),
}

/// Why a wait for a message ended without one.
#[derive(Debug, Error)]
pub enum ReceiveError {
    /// The deadline passed.
    #[error("no message until the deadline")]
    TimedOut,
    /// The peer is gone, and all its published messages have been received.
    #[error("the peer is gone")]
    HungUp,
    /// The peer's fault.
    #[error(transparent)]
    Corrupt(#[from] CorruptError),
    /// The environment's fault: the system refused to wait.
    #[error("waiting for a message: {0}")]
    System(#[source] io::Error),
}

/// Why a wait for several consumers ended without a message.
#[derive(Debug, Error)]
pub enum AnyError {
    /// The fault of the peer at this index.
    #[error("{cause}")]
    Corrupt {
        /// Index of the consumer.
        index: usize,
        /// The error in the peer's memory.
        #[source]
        cause: CorruptError,
    },
    /// The environment's fault: the system refused to wait.
    #[error("waiting for messages: {0}")]
    System(#[source] io::Error),
}

/// Why a wait for room ended without room.
#[derive(Debug, Error)]
pub enum RoomError {
    /// The caller's fault: no ring of this capacity can ever hold it.
    #[error("{asked} bytes are more than a message may have here ({max})")]
    TooLong {
        /// The requested length, in bytes.
        asked: usize,
        /// The longest message, in bytes.
        max: usize,
    },
    /// The deadline passed.
    #[error("no room until the deadline")]
    TimedOut,
    /// The peer is gone.
    #[error("the peer is gone")]
    HungUp,
    /// The peer's fault.
    #[error(transparent)]
    Corrupt(#[from] CorruptError),
    /// The environment's fault: the system refused to wait.
    #[error("waiting for room: {0}")]
    System(#[source] io::Error),
}

/// Why no region was created.
#[derive(Debug, Error)]
pub enum CreateError {
    /// The environment's fault: this platform has no sealed shared memory.
    #[error("this platform has no sealed shared memory; use sockets")]
    Unsupported,
    /// The caller's fault: the wait set has its most regions.
    #[error("the wait set has its most rings")]
    SetFull,
    /// The environment's fault: no memory, no descriptors, or a system older than Linux 5.1.
    #[error("{step}: {cause}")]
    System {
        /// The operation that failed.
        step: &'static str,
        /// The error of the system.
        #[source]
        cause: io::Error,
    },
}

/// Why the peer's offer was rejected. Nothing of it is mapped or kept.
#[derive(Debug, Error)]
pub enum OfferError {
    /// This platform has no sealed shared memory.
    #[error("this platform has no sealed shared memory; use sockets")]
    Unsupported,
    /// The offer does not have the magic number of a region.
    #[error("the offer does not begin with a region's magic number")]
    Magic,
    /// The peer uses another version.
    #[error("the peer's layout has version {theirs}, this one {ours}")]
    Version {
        /// The peer's version.
        theirs: u32,
        /// This side's version.
        ours: u32,
    },
    /// The offered capacity is invalid.
    #[error("the offer has a capacity of {0} bytes, which is none")]
    Capacity(u64),
    /// The capacity is more than this side allows.
    #[error("the offer's ring of {offered} is larger than allowed ({allowed})")]
    TooLarge {
        /// The peer's capacity.
        offered: Capacity,
        /// The capacity that the terms allow.
        allowed: Capacity,
    },
    /// No kind of bell has this number.
    #[error("the offer has an unknown kind of bell: {0}")]
    UnknownBell(u8),
    /// No wait set has this place.
    #[error("the offer names the place {0} of a set, which has 128")]
    Slot(u8),
    /// The terms do not allow this kind of bell.
    #[error("the offer asks to be woken by {0}, which is not allowed here")]
    Bell(BellKind),
    /// The offer arrived with too few or too many descriptors.
    #[error("the offer came with {got} descriptors, not {expected}")]
    Descriptors {
        /// Number of descriptors that arrived.
        got: usize,
        /// Number of descriptors that belong to it.
        expected: usize,
    },
    /// The memory could be cut, grown, punched or unsealed later.
    #[error("the offered memory lacks seals: {0}")]
    Seals(String),
    /// The memory is not of the required kind: a hole in huge pages causes a bus error.
    #[error("the offered memory is not an ordinary memfd")]
    Kind,
    /// The size of the memory differs from its capacity.
    #[error("the offered memory has {got} bytes, not {expected}")]
    Size {
        /// The size that the system reports.
        got: u64,
        /// The size that the capacity requires.
        expected: u64,
    },
    /// The memory has holes, which this side would have to fill.
    #[error("the offered memory has holes: {allocated} of {expected} bytes are there")]
    Holes {
        /// The allocated size that the system reports.
        allocated: u64,
        /// The size that the capacity requires.
        expected: u64,
    },
    /// The identity in the memory differs from that in the offer.
    #[error("the header of the offered memory differs from the offer")]
    Identity,
    /// A descriptor that must be a bell is not one.
    #[error("a descriptor of the offer is no {0}")]
    NotABell(BellKind),
    /// The environment's fault.
    #[error("{step}: {cause}")]
    System {
        /// The operation that failed.
        step: &'static str,
        /// The error of the system.
        #[source]
        cause: io::Error,
    },
}

/// Why an offer was not transferred over a socket.
#[derive(Debug, Error)]
pub enum PassError {
    /// The peer closed the socket.
    #[error("the peer closed the socket")]
    Closed,
    /// The peer's fault: the message is shorter than an offer, or has too many descriptors for one. It is
    /// left in the socket.
    #[error(
        "the received offer is incomplete: {bytes} bytes, {descriptors} descriptors, more than that: {cut}"
    )]
    Broken {
        /// Number of bytes that were read ahead.
        bytes: usize,
        /// Number of descriptors that were read ahead.
        descriptors: usize,
        /// Whether there are more.
        cut: bool,
    },
    /// The environment's fault; `WouldBlock` on a non-blocking socket, "too many open files" if this process
    /// has no descriptor left.
    #[error("passing an offer: {0}")]
    System(#[source] io::Error),
}
