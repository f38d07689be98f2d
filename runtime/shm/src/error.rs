//! What can go wrong, and whose fault it is.

use std::io;

use thiserror::Error;

use crate::{bell::BellKind, layout::Capacity};

/// The peer's fault: its shared memory holds what no peer of ours writes. The connection is of no more use; both its
/// halves repeat this error from now on. Nothing was read or written outside the ring.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Error)]
pub enum Corrupt {
    /// The peer's count of published bytes went back, or beyond the ring's capacity, or is no multiple of 8.
    #[error("the peer's tail of {tail} does not follow {seen}")]
    Tail {
        /// What the peer wrote.
        tail: u32,
        /// What it had written before.
        seen: u32,
    },
    /// The peer's count of taken bytes went back, or beyond what was published, or is no multiple of 8.
    #[error("the peer's head of {head} does not lie between {seen} and {tail}")]
    Head {
        /// What the peer wrote.
        head: u32,
        /// What it had written before.
        seen: u32,
        /// What this side has published.
        tail: u32,
    },
    /// A record begins with what is no mark.
    #[error("a record begins with {0:#018x}")]
    Mark(u64),
    /// A message would reach beyond what was published, or beyond the ring's end, or is longer than half the ring.
    #[error("a message of {length} bytes where {room} bytes are left")]
    Length {
        /// What the peer wrote.
        length: u32,
        /// What could be there, with its mark.
        room: u32,
    },
    /// A skip to the ring's beginning that leads nowhere.
    #[error("a skip of {skipped} bytes with {published} published")]
    Skip {
        /// From here to the ring's end.
        skipped: u32,
        /// What was published and not taken.
        published: u32,
    },
}

/// Why no memory was lent to write a message into.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Error)]
pub enum LoanError {
    /// The caller's fault: no ring of this capacity ever has room for it.
    #[error("{asked} bytes are more than a message may have here ({max})")]
    TooLong {
        /// What was asked for, in bytes.
        asked: usize,
        /// The longest message, in bytes.
        max: usize,
    },
    /// The peer has not taken enough yet. Nothing changed; ask again later or wait for room.
    #[error("no room for {asked} bytes now: {free} at most")]
    Full {
        /// What was asked for, in bytes.
        asked: usize,
        /// The longest message that would fit now, in bytes; 0 may also mean that none does.
        free: usize,
    },
    /// The peer's fault.
    #[error(transparent)]
    Corrupt(#[from] Corrupt),
}

/// Why waiting for a message ended without one.
#[derive(Debug, Error)]
pub enum ReceiveError {
    /// The deadline passed.
    #[error("no message until the deadline")]
    TimedOut,
    /// The peer is gone, and all that it had published has been received.
    #[error("the peer is gone")]
    HungUp,
    /// The peer's fault.
    #[error(transparent)]
    Corrupt(#[from] Corrupt),
    /// The environment's fault: the system refused to wait.
    #[error("waiting for a message: {0}")]
    System(#[source] io::Error),
}

/// Why waiting for several consumers ended without any.
#[derive(Debug, Error)]
pub enum AnyError {
    /// The fault of the peer at this index.
    #[error("{cause}")]
    Corrupt {
        /// Which of those that were waited for.
        index: usize,
        /// What it wrote.
        #[source]
        cause: Corrupt,
    },
    /// The environment's fault: the system refused to wait.
    #[error("waiting for messages: {0}")]
    System(#[source] io::Error),
}

/// Why waiting for room ended without any.
#[derive(Debug, Error)]
pub enum RoomError {
    /// The caller's fault: no ring of this capacity ever has room for it.
    #[error("{asked} bytes are more than a message may have here ({max})")]
    TooLong {
        /// What was asked for, in bytes.
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
    Corrupt(#[from] Corrupt),
    /// The environment's fault: the system refused to wait.
    #[error("waiting for room: {0}")]
    System(#[source] io::Error),
}

/// Why no region was made.
#[derive(Debug, Error)]
pub enum CreateError {
    /// The environment's fault: this platform has no sealed shared memory.
    #[error("this platform has no sealed shared memory; use sockets")]
    Unsupported,
    /// The environment's fault: no memory, no descriptors, or a system older than Linux 5.1.
    #[error("{step}: {cause}")]
    System {
        /// What was being done.
        step: &'static str,
        /// What the system said.
        #[source]
        cause: io::Error,
    },
}

/// Why the peer's offer was not taken. Nothing of it is mapped or kept.
#[derive(Debug, Error)]
pub enum RefusedOffer {
    /// This platform has no sealed shared memory.
    #[error("this platform has no sealed shared memory; use sockets")]
    Unsupported,
    /// The words of the offer are not those of a region.
    #[error("the offer does not begin with a region's magic number")]
    Magic,
    /// The peer speaks another version.
    #[error("the peer's layout has version {theirs}, this one {ours}")]
    Version {
        /// The peer's.
        theirs: u32,
        /// This side's.
        ours: u32,
    },
    /// The capacity is none.
    #[error("the offer has a capacity of {0} bytes, which is none")]
    Capacity(u64),
    /// The capacity is more than this side allows.
    #[error("the offer's ring of {offered} is larger than allowed ({allowed})")]
    TooLarge {
        /// The peer's.
        offered: Capacity,
        /// What the terms allow.
        allowed: Capacity,
    },
    /// There is no bell of this number.
    #[error("the offer has an unknown kind of bell: {0}")]
    UnknownBell(u8),
    /// The terms do not allow to be asked for such a wake.
    #[error("the offer asks to be woken by {0}, which is not allowed here")]
    Bell(BellKind),
    /// The offer came with too few or too many descriptors.
    #[error("the offer came with {got} descriptors, not {expected}")]
    Descriptors {
        /// How many came.
        got: usize,
        /// How many belong to it.
        expected: usize,
    },
    /// The memory could be cut, grown, punched or unsealed later.
    #[error("the offered memory lacks seals: {0}")]
    Seals(String),
    /// The memory is not what rings are made of: a hole in huge pages is a bus error.
    #[error("the offered memory is not an ordinary memfd")]
    Kind,
    /// The memory is not as large as its capacity says.
    #[error("the offered memory has {got} bytes, not {expected}")]
    Size {
        /// What the system says.
        got: u64,
        /// What the capacity asks for.
        expected: u64,
    },
    /// The memory has holes, which this side would have to fill.
    #[error("the offered memory has holes: {allocated} of {expected} bytes are there")]
    Holes {
        /// What the system says.
        allocated: u64,
        /// What the capacity asks for.
        expected: u64,
    },
    /// The identity in the memory is not the one in the offer.
    #[error("the offered memory says that it is something else than the offer says")]
    Identity,
    /// A descriptor that should be a bell is none.
    #[error("a descriptor of the offer is no {0}")]
    NotABell(BellKind),
    /// The environment's fault.
    #[error("{step}: {cause}")]
    System {
        /// What was being done.
        step: &'static str,
        /// What the system said.
        #[source]
        cause: io::Error,
    },
}

/// Why an offer did not pass over a socket.
#[derive(Debug, Error)]
pub enum PassError {
    /// The peer closed the socket.
    #[error("the peer closed the socket")]
    Closed,
    /// The peer's fault: what came is shorter than an offer, or has more descriptors than one can have. It is left in the socket.
    #[error("what came is no whole offer: {bytes} bytes, {descriptors} descriptors, more than that: {cut}")]
    Broken {
        /// How many bytes were looked at.
        bytes: usize,
        /// How many descriptors were looked at.
        descriptors: usize,
        /// Whether there are more.
        cut: bool,
    },
    /// The environment's fault; `WouldBlock` on a socket that does not block, "too many open files" where this process has no descriptor
    /// left.
    #[error("passing an offer: {0}")]
    System(#[source] io::Error),
}
