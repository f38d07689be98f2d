//! Wakes of a sleeping side. Three kinds behind one trait; each side chooses the kind for its own wakes.

use std::{
    fmt, io,
    os::fd::{BorrowedFd, OwnedFd},
    sync::atomic::AtomicU32,
};

use crate::{
    wait::Waiting,
    wait_set::{Slot, WaitSet},
};

/// How a side is to be woken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum BellKind {
    /// A futex in a page that both sides write. The fastest for a thread that blocks; of no use to a reactor.
    /// Ringing never blocks.
    Futex,
    /// An eventfd for each direction: for a reactor. **Only for a trusted peer**: a holder of the descriptor
    /// can make it blocking and full, and then the next ring blocks.
    EventFd,
    /// A socket pair for each direction: for a reactor. Ringing never blocks, for any behaviour of the peer.
    Socket,
    /// A futex for all regions of a [`WaitSet`].
    Set,
}

impl BellKind {
    /// Descriptors of a region's two bells.
    pub(crate) const fn descriptors(self) -> usize {
        match self {
            Self::Futex => 1,
            Self::EventFd | Self::Socket | Self::Set => 2,
        }
    }

    pub(crate) const fn number(self) -> u8 {
        match self {
            Self::Futex => 1,
            Self::EventFd => 2,
            Self::Socket => 3,
            Self::Set => 4,
        }
    }

    pub(crate) const fn numbered(number: u8) -> Option<Self> {
        match number {
            1 => Some(Self::Futex),
            2 => Some(Self::EventFd),
            3 => Some(Self::Socket),
            4 => Some(Self::Set),
            _ => None,
        }
    }
}

impl fmt::Display for BellKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Futex => "futex",
            Self::EventFd => "eventfd",
            Self::Socket => "socket",
            Self::Set => "set",
        })
    }
}

/// The bell of a region: its own, or that of a set of regions.
#[derive(Clone, Debug)]
pub enum Bell {
    /// A bell of this kind, for this region alone. Not [`BellKind::Set`].
    OfItsOwn(BellKind),
    /// The bell of a set: a thread that waits for all its regions sleeps at one place.
    Set(WaitSet),
}

impl Bell {
    /// Returns the kind of the bell.
    #[must_use]
    pub const fn kind(&self) -> BellKind {
        match self {
            Self::OfItsOwn(kind) => *kind,
            Self::Set(_) => BellKind::Set,
        }
    }
}

impl From<BellKind> for Bell {
    fn from(kind: BellKind) -> Self {
        Self::OfItsOwn(kind)
    }
}

/// A region's two bells: the waiting side keeps the listening ends, the ringing side receives the buttons.
pub(crate) struct Bells {
    pub(crate) message: Box<dyn Doorbell>,
    pub(crate) room: Box<dyn Doorbell>,
    pub(crate) buttons: Vec<OwnedFd>,
    /// The place in a set.
    pub(crate) slot: Option<Slot>,
}

/// Why a sleep ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Woken {
    /// A wake; the state may have changed.
    Rung,
    TimedOut,
    HungUp,
}

/// The state of a bell, read before the sleep is announced: a later ring ends the sleep.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct BellState(pub(crate) u32);

/// One end of a bell. The waiting side calls `listen`, announces its sleep, and calls `sleep`; the ringing
/// side calls `ring`.
pub(crate) trait Doorbell: Send {
    /// Wakes the sleeper. Never blocks. A peer that is gone is not an error here: other calls report it.
    fn ring(&self);

    /// Returns the state of the bell so far; to be called before the sleep is announced.
    fn listen(&self) -> BellState;

    /// Sleeps until rung after `seen`, until the wait's deadline, or until the peer is gone. May end early
    /// without a reason.
    fn sleep(&self, seen: BellState, waiting: &Waiting<'_>) -> io::Result<Woken>;

    /// Returns the word that a ring changes; `None` if this kind has none.
    fn word(&self) -> Option<&AtomicU32> {
        None
    }

    /// Returns the descriptor for a reactor; `None` if this kind has none.
    fn fd(&self) -> Option<BorrowedFd<'_>>;

    /// Discards the rings so far. Never blocks.
    fn drain(&self);
}
