//! Platforms without journals: creating one returns an error.

use std::{convert::Infallible, fs::File, io, path::Path, sync::atomic::AtomicU64};

use super::{
    core::Memory,
    error::{CopyJournalError, CreateJournalError},
};

/// Cannot exist on this platform.
#[derive(Debug)]
pub(crate) struct Map(Infallible);

impl Map {
    pub(crate) fn is_at(&self, _: &Path) -> bool {
        match self.0 {}
    }

    pub(crate) fn header_word(&self, _: usize) -> &AtomicU64 {
        match self.0 {}
    }
}

impl Memory for Map {
    fn reserved(&self) -> &AtomicU64 {
        match self.0 {}
    }

    fn table(&self) -> &[AtomicU64] {
        match self.0 {}
    }

    fn ring(&self) -> &[AtomicU64] {
        match self.0 {}
    }
}

/// Cannot exist on this platform.
pub(crate) struct NewFile<'a>(Infallible, &'a File);

impl NewFile<'_> {
    pub(crate) fn put(&self, _: usize, _: &[u8]) -> io::Result<()> {
        match self.0 {}
    }

    pub(crate) fn reserve(&self, _: u64, _: u64) -> io::Result<()> {
        match self.0 {}
    }
}

pub(crate) fn write_file(
    _: &Path,
    _: impl FnOnce(&NewFile<'_>) -> Result<(), CopyJournalError>,
) -> Result<(), CopyJournalError> {
    Err(CreateJournalError::Unsupported.into())
}

pub(crate) fn create(
    _: &Path,
    _: u64,
    _: bool,
    _: impl FnOnce(&NewFile<'_>) -> io::Result<()>,
) -> Result<Map, CreateJournalError> {
    Err(CreateJournalError::Unsupported)
}
