//! What a sleeping side is woken by. Three ways behind one trait; a side chooses how it wants to be woken.

use std::{
    fmt, io,
    os::fd::{BorrowedFd, OwnedFd},
    sync::atomic::AtomicU32,
};

use crate::wait::Wait;

/// How a side wants to be woken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum BellKind {
    /// A futex on the word that changes. No descriptor; the quickest for a thread that blocks. Ringing never blocks.
    Futex,
    /// An eventfd for each direction: for a reactor. **Only for a peer that is trusted to leave it alone**: who has the
    /// descriptor can make it blocking and full, and then the next ring blocks.
    EventFd,
    /// A pair of sockets for each direction: for a reactor. Ringing never blocks, whatever the peer does.
    Socket,
}

impl BellKind {
    /// Descriptors of one bell.
    pub(crate) const fn descriptors(self) -> usize {
        match self {
            Self::Futex => 0,
            Self::EventFd | Self::Socket => 1,
        }
    }

    pub(crate) const fn number(self) -> u8 {
        match self {
            Self::Futex => 1,
            Self::EventFd => 2,
            Self::Socket => 3,
        }
    }

    pub(crate) const fn numbered(number: u8) -> Option<Self> {
        match number {
            1 => Some(Self::Futex),
            2 => Some(Self::EventFd),
            3 => Some(Self::Socket),
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
        })
    }
}

/// Both ends of a bell: the waiting side keeps one, the ringing side gets the other.
pub(crate) struct BellPair {
    pub(crate) ear: Box<dyn Doorbell>,
    pub(crate) button: Option<OwnedFd>,
}

/// What a sleep is about.
pub(crate) struct Sleeping<'a> {
    /// The word in the peer's region that changes.
    pub(crate) word: &'a AtomicU32,
    /// What it was when this side decided to sleep.
    pub(crate) seen: u32,
    pub(crate) wait: &'a Wait<'a>,
}

/// Why a sleep ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Woken {
    /// Something may have changed.
    Rung,
    TimedOut,
    HungUp,
}

/// One end of a bell. The side that waits calls `sleep`, the side that rings calls `ring`.
pub(crate) trait Doorbell: Send {
    /// Wakes who sleeps on `word`, which is in this side's region. Never blocks. A peer that is gone is no error here: that
    /// shows elsewhere.
    fn ring(&self, word: &AtomicU32);

    /// Sleeps until rung, until the wait's deadline, or until the peer is gone. May end early without a reason.
    fn sleep(&self, sleeping: &Sleeping<'_>) -> io::Result<Woken>;

    /// What a reactor waits for; `None` when there is no such thing.
    fn fd(&self) -> Option<BorrowedFd<'_>>;

    /// Forgets the rings so far. Never blocks.
    fn drain(&self);
}
