//! A journal as plain atomics, for tests of the protocol.

use std::{convert::Infallible, sync::atomic::Ordering};

use super::{
    super::layout::{Head, PLACE_WORDS},
    AtomicU64, Memory,
    reader::Source,
    writer::{begin, finish, reserve},
};

pub(crate) const SALT: u64 = 0x5EED_0000_0000_0000;

/// The words that a file has.
#[derive(Debug)]
pub(crate) struct Model {
    reserved: AtomicU64,
    table: Vec<AtomicU64>,
    ring: Vec<AtomicU64>,
}

impl Model {
    pub(crate) fn new(places: usize, ring_bytes: u64) -> Self {
        let zeros = |count: usize| (0..count).map(|_| AtomicU64::new(0)).collect();
        Self {
            reserved: AtomicU64::new(0),
            table: zeros(places * PLACE_WORDS),
            ring: zeros(ring_bytes as usize / 8),
        }
    }

    pub(crate) fn write(&self, number: u64, payload: &[u8]) {
        let length = u32::try_from(payload.len()).unwrap();
        let reserved = reserve(self, Head { length, place: 0, number, time: number });
        begin(self, reserved, SALT);
        finish(self, reserved, &[payload], SALT);
    }
}

impl Memory for Model {
    fn reserved(&self) -> &AtomicU64 {
        &self.reserved
    }

    fn table(&self) -> &[AtomicU64] {
        &self.table
    }

    fn ring(&self) -> &[AtomicU64] {
        &self.ring
    }
}

impl Source for Model {
    type Error = Infallible;

    fn reserved(&self) -> Result<u64, Infallible> {
        Ok(self.reserved.load(Ordering::Relaxed))
    }

    fn read(&self, offset: u64, into: &mut [u8]) -> Result<(), Infallible> {
        for (target, word) in into.chunks_mut(8).zip(&self.ring[offset as usize / 8..]) {
            let word = word.load(Ordering::Relaxed).to_ne_bytes();
            target.copy_from_slice(&word[..target.len()]);
        }
        Ok(())
    }
}
