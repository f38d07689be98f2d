//! What a sleeping side is woken by. Three ways behind one trait; a side chooses how it wants to be woken.

use std::{
    fmt, io,
    os::fd::{BorrowedFd, OwnedFd},
    sync::atomic::AtomicU32,
};

use crate::{platform, wait::Waiting};

/// How a side wants to be woken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum BellKind {
    /// A futex in a page that both sides write. The quickest for a thread that blocks; nothing for a reactor. Ringing never
    /// blocks.
    Futex,
    /// An eventfd for each direction: for a reactor. **Only for a peer that is trusted to leave it alone**: who has the
    /// descriptor can make it blocking and full, and then the next ring blocks.
    EventFd,
    /// A pair of sockets for each direction: for a reactor. Ringing never blocks, whatever the peer does.
    Socket,
}

impl BellKind {
    /// Descriptors of a region's two bells.
    pub(crate) const fn descriptors(self) -> usize {
        match self {
            Self::Futex => 1,
            Self::EventFd | Self::Socket => 2,
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

/// The bell of a region: one of its own, or one that several have.
#[derive(Clone, Debug)]
pub enum Bell {
    /// One of this kind, for this region alone.
    OfItsOwn(BellKind),
    /// One for all regions that are made with it: who waits for all of them sleeps at one place.
    Common(CommonBell),
}

/// A futex that several regions have. Who waits for all of them ([`Waiter`](crate::Waiter)) sleeps at one word, however many they are.
///
/// Each peer gets the page in which it is, and can write it: it can wake this side for nothing, and undo the ring of another
/// peer in the moment in which this side falls asleep. That message waits for the end of the nap then, 20 ms. Where this side finds it out it
/// sleeps for a while, each time longer, at words of which each has one writer.
#[derive(Clone, Debug)]
pub struct CommonBell(pub(crate) platform::SharedPage);

impl CommonBell {
    /// Makes one.
    ///
    /// # Errors
    /// What the system said.
    pub fn create() -> io::Result<Self> {
        platform::SharedPage::create().map(Self)
    }
}

impl Bell {
    /// The kind of it.
    #[must_use]
    pub const fn kind(&self) -> BellKind {
        match self {
            Self::OfItsOwn(kind) => *kind,
            Self::Common(_) => BellKind::Futex,
        }
    }
}

impl From<BellKind> for Bell {
    fn from(kind: BellKind) -> Self {
        Self::OfItsOwn(kind)
    }
}

/// A region's two bells: the waiting side keeps the ears, the ringing side gets the buttons.
pub(crate) struct Bells {
    pub(crate) message: Box<dyn Doorbell>,
    pub(crate) room: Box<dyn Doorbell>,
    pub(crate) buttons: Vec<OwnedFd>,
}

/// Why a sleep ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Woken {
    /// Something may have changed.
    Rung,
    TimedOut,
    HungUp,
}

/// What was heard of a bell before its ear's owner announced its sleep: a ring after this ends the sleep.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Heard(pub(crate) u32);

/// One end of a bell. The side that waits calls `listen`, announces its sleep, and calls `sleep`; the side that rings calls
/// `ring`.
pub(crate) trait Doorbell: Send {
    /// Wakes who sleeps. Never blocks. A peer that is gone is no error here: that shows elsewhere.
    fn ring(&self);

    /// What was heard so far; before the sleep is announced.
    fn listen(&self) -> Heard;

    /// Sleeps until rung after `heard`, until the wait's deadline, or until the peer is gone. May end early without a reason.
    fn sleep(&self, heard: Heard, waiting: &Waiting<'_>) -> io::Result<Woken>;

    /// The word that a ring changes; `None` when there is no such thing.
    fn word(&self) -> Option<&AtomicU32> {
        None
    }

    /// What a reactor waits for; `None` when there is no such thing.
    fn fd(&self) -> Option<BorrowedFd<'_>>;

    /// Forgets the rings so far. Never blocks.
    fn drain(&self);
}
