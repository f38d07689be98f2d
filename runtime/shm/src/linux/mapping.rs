//! Mapped regions as typed memory. **All of Sinew's unsafe code about shared memory is in this file**, in
//! five blocks, but for one block about the files of journals (`journal/file.rs`).
//!
//! They rest on these facts:
//!
//! - M1. `MmapRaw` keeps `len()` bytes mapped at `as_ptr()`, page-aligned, until it is dropped; it is not
//!   dropped while any of the types here lives (`Arc`). `Mapping::new` checks that `len()` is header plus
//!   ring.
//! - M2. The file behind it cannot shrink or be punched: it has the seals SHRINK and FUTURE_WRITE, set by
//!   `memfd::create` or checked by `memfd::adopt`. So every byte stays there and no access is a bus error.
//! - M3. An own region is written by this process only: no other process can map it writable or write to it
//!   (seal FUTURE_WRITE, set before its descriptor leaves this process).
//! - M4. In an own region, the header is accessed only as atomics, and the ring only through the one
//!   `OwnRingMemory` that `OwnMemory::split` creates for it: it is neither `Clone` nor `Copy`.
//! - M5. A peer's region changes at any time. It is accessed only by relaxed atomic loads of 4 or 8 aligned
//!   bytes, each place always in the same size: header 4, counters and ring 8. These are defined on read-only mappings
//!   too. The word `Rung` is also slept at, which makes the kernel load it.
//! - M6. A page of bells is written by both sides, and accessed only as atomics of 4 bytes. It cannot shrink
//!   (seal SHRINK); a hole in it reads as zeros. A page with an announcement is like the header of a region: M3 for its
//!   owner, M5 for its peers.

use std::{
    slice,
    sync::{
        Arc,
        atomic::{AtomicU32, AtomicU64, Ordering},
    },
};

use memmap2::MmapRaw;

use super::bells::{REPORT_WORD, wake};
use crate::{
    layout::{COUNTERS, COUNTERS_AT, Capacity, HEADER_BYTES, MAGIC, VERSION, Word},
    memory::{OwnHeader, OwnRing, Peer},
    wait_set::{bit_of, report},
};

/// A region in this process's address space.
#[derive(Debug)]
pub(super) struct Mapping {
    raw: MmapRaw,
    ring_bytes: usize,
}

impl Mapping {
    /// Creates a region of this capacity; `None` when the mapping has another size.
    pub(super) fn new(raw: MmapRaw, capacity: Capacity) -> Option<Self> {
        let ring_bytes = capacity.bytes() as usize;
        (raw.len() == HEADER_BYTES + ring_bytes).then_some(Self { raw, ring_bytes })
    }

    fn header(&self) -> &[AtomicU32] {
        let start = self.raw.as_ptr().cast::<AtomicU32>();
        // SAFETY: M1: this many bytes are mapped there and aligned to a page; M4, M5 and M6: all access to
        // them in this process is atomic and of this size. Through a read-only mapping `PeerMemory` and
        // `identity` only load, relaxed.
        unsafe { slice::from_raw_parts(start, COUNTERS_AT / size_of::<AtomicU32>()) }
    }

    fn counters(&self) -> &[AtomicU64] {
        let start = self.raw.as_ptr().wrapping_add(COUNTERS_AT).cast::<AtomicU64>();
        // SAFETY: M1: this many bytes of the header's page are mapped there, aligned to 8; M4 and M5: all access
        // to them in this process is atomic and of this size. Through a read-only mapping `PeerCounters` only loads,
        // relaxed.
        unsafe { slice::from_raw_parts(start, COUNTERS) }
    }

    fn ring_words(&self) -> &[AtomicU64] {
        let start = self.raw.as_ptr().wrapping_add(HEADER_BYTES).cast::<AtomicU64>();
        // SAFETY: M1: this many bytes are mapped there, and the header's length keeps the alignment; M5: all
        // access to them in this process is atomic and of this size, since only `PeerMemory`, which has no
        // other access, calls this.
        unsafe { slice::from_raw_parts(start, self.ring_bytes / size_of::<AtomicU64>()) }
    }

    /// Creates a page of words without a ring; `None` when the mapping has another size.
    pub(super) fn page(raw: MmapRaw) -> Option<Self> {
        (raw.len() == HEADER_BYTES).then_some(Self { raw, ring_bytes: 0 })
    }

    /// A word of a page that both sides write.
    pub(super) fn shared_word(&self, index: usize) -> &AtomicU32 {
        &self.header()[index]
    }

    /// Words of such a page.
    pub(super) fn shared_words(&self, first: usize, count: usize) -> &[AtomicU32] {
        &self.header()[first..first + count]
    }

    /// Reads the first words: magic, version, capacity. Each is read once.
    pub(super) fn identity(&self) -> (u64, u32, u32) {
        let word = |index: usize| self.header()[index].load(Ordering::Relaxed);
        (u64::from(word(0)) | u64::from(word(1)) << 32, word(2), word(3))
    }
}

/// This side's region before it is connected.
#[derive(Debug)]
pub(crate) struct OwnMemory(Arc<Mapping>);

impl OwnMemory {
    /// Wraps a writable mapping of zeros and writes the identity into it.
    ///
    /// The caller has created the file, and seals it (M2, M3) before the peer receives it.
    pub(super) fn new(mapping: Mapping) -> Self {
        let header = mapping.header();
        let capacity = u32::try_from(mapping.ring_bytes).expect("a capacity has 32 bits");
        let words = [MAGIC as u32, (MAGIC >> 32) as u32, VERSION, capacity];
        for (place, word) in header.iter().zip(words) {
            place.store(word, Ordering::Relaxed);
        }
        Self(Arc::new(mapping))
    }

    /// Splits into the header, for the consumer, and header and ring, for the producer. There is one of each
    /// (M4).
    pub(crate) fn split(self) -> (OwnHeaderMemory, OwnRingMemory) {
        (OwnHeaderMemory(Arc::clone(&self.0)), OwnRingMemory(OwnHeaderMemory(self.0)))
    }

    #[cfg(any(test, feature = "hostile-peer"))]
    pub(crate) fn scribble(&mut self, place: u32, value: u32) {
        let place = place as usize % (self.0.raw.len() / 4);
        match place.checked_sub(HEADER_BYTES / 4) {
            None => match place.checked_sub(COUNTERS_AT / 4) {
                None => self.0.header()[place].store(value, Ordering::Relaxed),
                Some(word) => {
                    let counter = self.0.counters().get(word / 2);
                    counter.into_iter().for_each(|counter| counter.store(value.into(), Ordering::Relaxed));
                }
            },
            Some(word) => {
                // A view for this call only; no other view exists before `split`.
                let mut ring = OwnRingMemory(OwnHeaderMemory(Arc::clone(&self.0)));
                let position = u32::try_from(word * 4).expect("a capacity has 32 bits");
                ring.bytes_mut(position, 4).copy_from_slice(&value.to_ne_bytes());
            }
        }
    }
}

/// The header of this side's region.
#[derive(Debug)]
pub(crate) struct OwnHeaderMemory(Arc<Mapping>);

impl OwnHeaderMemory {
    /// Wraps a page that this side alone can write (M3).
    pub(super) fn of_page(page: Mapping) -> Self {
        Self(Arc::new(page))
    }

    fn word(&self, word: Word) -> &AtomicU32 {
        &self.0.header()[word.index()]
    }
}

impl OwnHeader for OwnHeaderMemory {
    fn store(&self, word: Word, value: u32, order: Ordering) {
        self.word(word).store(value, order);
    }
}

/// The ring of this side's region, and its header.
#[derive(Debug)]
pub(crate) struct OwnRingMemory(OwnHeaderMemory);

impl OwnRingMemory {
    pub(crate) fn counters(&self) -> Counters {
        Counters(Arc::clone(&self.0.0))
    }

    /// Wakes the sleeper at the word in which this side reports its rings.
    pub(crate) fn wake_rung(&self) {
        wake(self.0.word(Word::Rung));
    }

    /// Bytes of the ring.
    pub(crate) fn bytes(&self, position: u32, length: u32) -> &[u8] {
        let mapping = &self.0.0;
        let start = mapping.raw.as_ptr().wrapping_add(HEADER_BYTES);
        // SAFETY: M1: this many bytes are mapped there; M3 and M4: no code writes them while `self` is
        // borrowed.
        let ring = unsafe { slice::from_raw_parts(start, mapping.ring_bytes) };
        &ring[position as usize..][..length as usize]
    }

    /// Bytes of the ring, to be written. The peer may read them at any time, which changes nothing for this
    /// side.
    pub(crate) fn bytes_mut(&mut self, position: u32, length: u32) -> &mut [u8] {
        let mapping = &self.0.0;
        let start = mapping.raw.as_mut_ptr().wrapping_add(HEADER_BYTES);
        // SAFETY: M1: this many bytes are mapped there, writable as this is an own region; M3 and M4: no
        // other code in this process has access to them while `self` is borrowed, and no other process writes
        // them.
        let ring = unsafe { slice::from_raw_parts_mut(start, mapping.ring_bytes) };
        &mut ring[position as usize..][..length as usize]
    }
}

/// Counters of this side that the peer can read, even after this process has ended. Nothing else depends on them.
#[derive(Clone, Debug)]
pub struct Counters(Arc<Mapping>);

impl Counters {
    /// How many there are. Each is 0 at first.
    pub const LEN: usize = COUNTERS;

    /// Sets one.
    ///
    /// # Panics
    /// If `index` is not below [`LEN`](Self::LEN).
    #[inline]
    pub fn set(&self, index: usize, value: u64) {
        // SYNC: Relaxed: no other data depends on it.
        self.0.counters()[index].store(value, Ordering::Relaxed);
    }
}

/// The counters of the peer, which may hold anything.
#[derive(Clone, Debug)]
pub struct PeerCounters(Arc<Mapping>);

impl PeerCounters {
    /// Returns all of them. Each is read once, and not all at the same moment.
    #[must_use]
    pub fn read(&self) -> [u64; Counters::LEN] {
        let counters = self.0.counters();
        std::array::from_fn(|index| counters[index].load(Ordering::Relaxed))
    }
}

#[cfg(all(test, not(loom)))]
impl OwnRingMemory {
    /// The same memory as a peer sees it. It is not written any more.
    pub(super) fn into_peer(self) -> PeerMemory {
        PeerMemory { region: self.0.0, place: None }
    }
}

impl OwnHeader for OwnRingMemory {
    fn store(&self, word: Word, value: u32, order: Ordering) {
        self.0.store(word, value, order);
    }
}

impl OwnRing for OwnRingMemory {
    fn put_mark(&mut self, position: u32, bits: u64) {
        self.bytes_mut(position, 8).copy_from_slice(&bits.to_ne_bytes());
    }
}

/// The peer's region: read-only, and never trusted.
#[derive(Clone, Debug)]
pub(crate) struct PeerMemory {
    region: Arc<Mapping>,
    place: Option<PeerPlace>,
}

/// The place of this side's ring in the peer's set.
#[derive(Clone, Debug)]
pub(crate) struct PeerPlace {
    /// Has the bits, which all peers of the set write.
    shared: Arc<Mapping>,
    /// Has the announcement of the peer's sleep, which the peer alone writes.
    announcement: Arc<Mapping>,
    slot: u8,
}

impl PeerPlace {
    pub(super) const fn new(shared: Arc<Mapping>, announcement: Arc<Mapping>, slot: u8) -> Self {
        Self { shared, announcement, slot }
    }

    fn report(&self) {
        let (word, bit) = bit_of(self.slot);
        let word = self.shared.shared_word(REPORT_WORD + word);
        report(
            || word.load(Ordering::Relaxed) & bit != 0,
            || {
                word.fetch_or(bit, Ordering::Release);
            },
        );
    }
}

impl PeerMemory {
    pub(super) fn new(mapping: Mapping) -> Self {
        Self { region: Arc::new(mapping), place: None }
    }

    /// The same, where the peer waits for several rings.
    pub(crate) fn at(self, place: Option<PeerPlace>) -> Self {
        Self { place, ..self }
    }

    pub(crate) fn counters(&self) -> PeerCounters {
        PeerCounters(Arc::clone(&self.region))
    }

    /// The word in which the peer reports its rings: to be loaded, relaxed, and slept at.
    pub(crate) fn rung(&self) -> &AtomicU32 {
        &self.region.header()[Word::Rung.index()]
    }

    /// Copies bytes of the ring, each read once, in words of 8. The compiler cannot tear any of these loads.
    /// A concurrent write of the peer decides only which bytes are copied.
    ///
    /// # Panics
    /// When the bytes do not lie within the ring: the core has checked that they do.
    pub(crate) fn copy_out(&self, position: usize, target: &mut [u8]) {
        let words = &self.region.ring_words()[position / 8..(position + target.len()).div_ceil(8)];
        let skew = position % 8;
        let (lead, target) = target.split_at_mut(target.len().min((8 - skew) % 8));
        let words = if lead.is_empty() {
            words
        } else {
            let word = words[0].load(Ordering::Relaxed).to_ne_bytes();
            lead.copy_from_slice(&word[skew..][..lead.len()]);
            &words[1..]
        };
        let (whole, tail) = target.as_chunks_mut::<8>();
        for (bytes, word) in whole.iter_mut().zip(words) {
            *bytes = word.load(Ordering::Relaxed).to_ne_bytes();
        }
        if !tail.is_empty() {
            let word = words[whole.len()].load(Ordering::Relaxed).to_ne_bytes();
            tail.copy_from_slice(&word[..tail.len()]);
        }
    }
}

impl Peer for PeerMemory {
    fn load(&self, word: Word) -> u32 {
        let page = match &self.place {
            Some(place) if word == Word::ConsumerSleep => &place.announcement,
            Some(_) | None => &self.region,
        };
        page.header()[word.index()].load(Ordering::Relaxed)
    }

    fn mark(&self, position: u32) -> u64 {
        self.region.ring_words()[position as usize / 8].load(Ordering::Relaxed)
    }

    fn report_message(&self) -> bool {
        self.place.as_ref().map(PeerPlace::report).is_some()
    }
}
