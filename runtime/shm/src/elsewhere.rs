//! Platforms without sealed shared memory: creating a region returns an error, and no other code here can
//! run.

use std::{
    convert::Infallible,
    io,
    os::fd::{BorrowedFd, OwnedFd},
    sync::atomic::{AtomicU32, Ordering},
    time::Duration,
};

use crate::{
    bell::{Bell, BellKind, BellState, Bells, Doorbell, Woken},
    error::{CreateError, OfferError, PassError},
    layout::{COUNTERS, Capacity, Word},
    memory::{OwnHeader, OwnRing, Peer},
    offer::{Descriptors, Offer, Received},
    wait::HangUp,
};

pub(crate) fn send(_: &Offer, _: BorrowedFd<'_>) -> Result<(), PassError> {
    Err(PassError::System(io::ErrorKind::Unsupported.into()))
}

pub(crate) fn receive(_: BorrowedFd<'_>) -> Result<Received, PassError> {
    Err(PassError::System(io::ErrorKind::Unsupported.into()))
}

pub(crate) fn keep_urgent_in_line(_: BorrowedFd<'_>) -> io::Result<()> {
    // Unix sockets have urgent bytes only on Linux.
    Ok(())
}

pub(crate) fn peer_pidfd(_: BorrowedFd<'_>) -> io::Result<OwnedFd> {
    Err(io::ErrorKind::Unsupported.into())
}

pub(crate) fn set_descriptors(_: BorrowedFd<'_>, _: Descriptors) -> io::Result<()> {
    Err(io::ErrorKind::Unsupported.into())
}

pub(crate) fn create(_: Capacity) -> Result<(OwnMemory, OwnedFd), CreateError> {
    Err(CreateError::Unsupported)
}

pub(crate) fn adopt(_: OwnedFd, _: Capacity) -> Result<PeerMemory, OfferError> {
    Err(OfferError::Unsupported)
}

/// Cannot exist on this platform.
#[derive(Clone, Debug)]
pub(crate) struct SharedPage(Infallible);

impl SharedPage {
    pub(crate) fn create() -> io::Result<Self> {
        Err(io::ErrorKind::Unsupported.into())
    }

    pub(crate) fn bells(&self) -> (Box<dyn Doorbell>, Box<dyn Doorbell>) {
        match self.0 {}
    }

    pub(crate) fn descriptor(&self) -> io::Result<OwnedFd> {
        match self.0 {}
    }

    pub(crate) fn message_word(&self) -> &AtomicU32 {
        match self.0 {}
    }

    pub(crate) fn reports(&self) -> &[AtomicU32] {
        match self.0 {}
    }
}

/// Cannot exist on this platform.
#[derive(Debug)]
pub(crate) struct Announcement(Infallible);

impl Announcement {
    pub(crate) fn create() -> io::Result<Self> {
        Err(io::ErrorKind::Unsupported.into())
    }

    pub(crate) fn descriptor(&self) -> io::Result<OwnedFd> {
        match self.0 {}
    }
}

impl OwnHeader for Announcement {
    fn store(&self, _: Word, _: u32, _: Ordering) {
        match self.0 {}
    }
}

pub(crate) fn bells(_: &Bell) -> Result<Bells, CreateError> {
    Err(CreateError::Unsupported)
}

/// This side's ends of a peer's bells.
pub(crate) struct Buttons {
    pub(crate) message: Box<dyn Doorbell>,
    pub(crate) room: Box<dyn Doorbell>,
    pub(crate) place: Option<PeerPlace>,
}

/// Cannot exist on this platform.
#[derive(Clone, Debug)]
pub(crate) struct PeerPlace(Infallible);

pub(crate) fn buttons(_: BellKind, _: u8, _: Vec<OwnedFd>) -> Result<Buttons, OfferError> {
    Err(OfferError::Unsupported)
}

pub(crate) fn which_ended<'a>(_: impl Iterator<Item = HangUp<'a>>) -> io::Result<Option<usize>> {
    Err(io::ErrorKind::Unsupported.into())
}

pub(crate) fn sleep_at(_: &AtomicU32, _: BellState, _: Duration) -> io::Result<Woken> {
    Err(io::ErrorKind::Unsupported.into())
}

/// Cannot exist on this platform.
pub(crate) struct FutexSet;

impl FutexSet {
    pub(crate) const fn new() -> Self {
        Self
    }

    pub(crate) fn add(&mut self, _: &AtomicU32, _: BellState) -> bool {
        false
    }

    pub(crate) fn sleep(&self, _: Duration) -> io::Result<Woken> {
        Err(io::ErrorKind::Unsupported.into())
    }
}

/// Cannot exist on this platform.
#[derive(Debug)]
pub(crate) struct OwnMemory(Infallible);

impl OwnMemory {
    pub(crate) fn split(self) -> (OwnHeaderMemory, OwnRingMemory) {
        match self.0 {}
    }

    #[cfg(any(test, feature = "hostile-peer"))]
    pub(crate) fn scribble(&mut self, _: u32, _: u32) {
        match self.0 {}
    }
}

/// Cannot exist on this platform.
#[derive(Debug)]
pub(crate) struct OwnHeaderMemory(Infallible);

impl OwnHeader for OwnHeaderMemory {
    fn store(&self, _: Word, _: u32, _: Ordering) {
        match self.0 {}
    }
}

/// Cannot exist on this platform.
#[derive(Debug)]
pub(crate) struct OwnRingMemory(Infallible);

impl OwnRingMemory {
    pub(crate) fn counters(&self) -> Counters {
        match self.0 {}
    }

    pub(crate) fn wake_rung(&self) {
        match self.0 {}
    }

    pub(crate) fn bytes(&self, _: u32, _: u32) -> &[u8] {
        match self.0 {}
    }

    pub(crate) fn bytes_mut(&mut self, _: u32, _: u32) -> &mut [u8] {
        match self.0 {}
    }
}

impl OwnHeader for OwnRingMemory {
    fn store(&self, _: Word, _: u32, _: Ordering) {
        match self.0 {}
    }
}

impl OwnRing for OwnRingMemory {
    fn put_mark(&mut self, _: u32, _: u64) {
        match self.0 {}
    }
}

/// Counters of this side that the peer can read, even after this process has ended. Nothing else depends on them.
#[derive(Clone, Debug)]
pub struct Counters(Infallible);

impl Counters {
    /// How many there are. Each is 0 at first.
    pub const LEN: usize = COUNTERS;

    /// Sets one.
    pub fn set(&self, _: usize, _: u64) {
        match self.0 {}
    }
}

/// The counters of the peer, which may hold anything.
#[derive(Clone, Debug)]
pub struct PeerCounters(Infallible);

impl PeerCounters {
    /// Returns all of them. Each is read once, and not all at the same moment.
    #[must_use]
    pub fn read(&self) -> [u64; Counters::LEN] {
        match self.0 {}
    }
}

/// Cannot exist on this platform.
#[derive(Clone, Debug)]
pub(crate) struct PeerMemory(Infallible);

impl PeerMemory {
    pub(crate) fn counters(&self) -> PeerCounters {
        match self.0 {}
    }

    pub(crate) fn at(self, _: Option<PeerPlace>) -> Self {
        self
    }

    pub(crate) fn rung(&self) -> &AtomicU32 {
        match self.0 {}
    }

    pub(crate) fn copy_out(&self, _: usize, _: &mut [u8]) {
        match self.0 {}
    }
}

impl Peer for PeerMemory {
    fn load(&self, _: Word) -> u32 {
        match self.0 {}
    }

    fn mark(&self, _: u32) -> u64 {
        match self.0 {}
    }
}
