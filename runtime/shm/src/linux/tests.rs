//! The mapped memory itself, and every invalid memory that a peer could offer instead.

use memmap2::{MmapOptions, MmapRaw};
use proptest::prelude::*;

use super::mapping::{Mapping, OwnMemory};
use crate::layout::{Capacity, Word};
use crate::memory::{OwnHeader, OwnRing, Peer};

/// Memory that is in no file, so that Miri can run the tests.
fn anonymous(capacity: Capacity) -> Mapping {
    let bytes = usize::try_from(capacity.region_bytes()).expect("it is small");
    let raw = MmapRaw::from(MmapOptions::new().len(bytes).map_anon().expect("a few pages"));
    Mapping::new(raw, capacity).expect("made for it")
}

const CASES: u32 = if cfg!(miri) { 8 } else { 300 };

proptest! {
    #![proptest_config(ProptestConfig { cases: CASES, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn bytes_are_copied_out_unchanged_from_any_position(from in 0..4096_usize, length in 0..200_usize) {
        let length = length.min(4096 - from);
        let mapping = anonymous(Capacity::MIN);
        let (_, mut ring) = OwnMemory::new(mapping).split();
        for (index, byte) in ring.bytes_mut(0, 4096).iter_mut().enumerate() {
            *byte = (index * 31 % 251) as u8;
        }
        let mut target = vec![0; length];
        ring.into_peer().copy_out(from, &mut target);
        let expected: Vec<u8> = (from..from + length).map(|index| (index * 31 % 251) as u8).collect();
        prop_assert_eq!(target, expected);
    }
}

#[test]
fn words_and_marks_agree_for_both_sides() {
    // given
    let (header, mut ring) = OwnMemory::new(anonymous(Capacity::MIN)).split();
    // when
    for (value, word) in
        [Word::Tail, Word::Head, Word::ConsumerSleep, Word::ProducerSleep, Word::Rung].into_iter().enumerate()
    {
        header.store(word, value as u32 + 1, std::sync::atomic::Ordering::Relaxed);
    }
    ring.put_mark(4088, 77);
    drop(header);
    // then
    let peer = ring.into_peer();
    assert_eq!(peer.load(Word::Tail), 1);
    assert_eq!(peer.load(Word::Head), 2);
    assert_eq!(peer.load(Word::ConsumerSleep), 3);
    assert_eq!(peer.load(Word::ProducerSleep), 4);
    assert_eq!(peer.mark(4088), 77);
}

#[test]
fn mapping_of_another_size_is_none() {
    let raw = MmapRaw::from(MmapOptions::new().len(4096).map_anon().expect("a page"));
    assert!(Mapping::new(raw, Capacity::MIN).is_none());
}

/// Tests that need a real memfd.
#[cfg(not(miri))]
mod memory {
    use std::{fs::File, os::fd::OwnedFd};

    use rustix::{
        fs::{FallocateFlags, MemfdFlags, SealFlags, fallocate, fcntl_add_seals, ftruncate, memfd_create},
        io::Errno,
    };

    use super::*;
    use crate::{
        error::OfferError,
        platform::{PeerMemory, adopt, create},
    };

    const SEALS: SealFlags =
        SealFlags::SHRINK.union(SealFlags::GROW).union(SealFlags::FUTURE_WRITE).union(SealFlags::SEAL);

    fn memory(bytes: u64, flags: MemfdFlags) -> OwnedFd {
        let memory = memfd_create("sinew-test", flags | MemfdFlags::ALLOW_SEALING).expect("a memfd");
        ftruncate(&memory, bytes).expect("a size");
        memory
    }

    fn filled() -> OwnedFd {
        let memory = memory(8192, MemfdFlags::CLOEXEC);
        fallocate(&memory, FallocateFlags::empty(), 0, 8192).expect("two pages");
        memory
    }

    fn refused(memory: OwnedFd) -> OfferError {
        adopt(memory, Capacity::MIN).expect_err("it is no region")
    }

    #[test]
    fn offered_memory_cannot_be_changed_by_its_receiver() {
        // given
        let (_own, memory) = create(Capacity::MIN).expect("a region");
        // when, then
        assert_eq!(ftruncate(&memory, 0), Err(Errno::PERM));
        assert_eq!(ftruncate(&memory, 1 << 20), Err(Errno::PERM));
        let hole = FallocateFlags::PUNCH_HOLE | FallocateFlags::KEEP_SIZE;
        assert_eq!(fallocate(&memory, hole, 0, 4096), Err(Errno::PERM));
        assert_eq!(rustix::io::pwrite(&memory, b"x", 0), Err(Errno::PERM));
        assert_eq!(fcntl_add_seals(&memory, SealFlags::WRITE), Err(Errno::PERM));
        let mapped = MmapOptions::new().map_raw(&memory).map(|_| ()).map_err(|error| error.kind());
        assert_eq!(mapped, Err(std::io::ErrorKind::PermissionDenied));
        assert!(MmapOptions::new().map_raw_read_only(&memory).is_ok(), "it can be read");
    }

    #[test]
    fn reopened_memory_is_sealed_as_well() {
        let (_own, memory) = create(Capacity::MIN).expect("a region");
        let path = format!("/proc/self/fd/{}", std::os::fd::AsRawFd::as_raw_fd(&memory));
        let again: OwnedFd = File::options().read(true).write(true).open(path).expect("it is ours").into();
        assert_eq!(rustix::io::pwrite(&again, b"x", 0), Err(Errno::PERM));
        assert!(MmapOptions::new().map_raw(&again).is_err());
    }

    #[test]
    fn hole_reads_as_zeros_without_bus_error() {
        // given: memory of a kind that is rejected, because it can be punched
        let memory = filled();
        rustix::io::pwrite(&memory, &[7; 8], 4096).expect("not sealed");
        let raw = MmapOptions::new().len(8192).map_raw_read_only(&memory).expect("a mapping");
        let peer = PeerMemory::new(Mapping::new(raw, Capacity::MIN).expect("its size"));
        assert_eq!(peer.mark(0), u64::from_ne_bytes([7; 8]));
        // when
        fallocate(&memory, FallocateFlags::PUNCH_HOLE | FallocateFlags::KEEP_SIZE, 0, 8192).expect("no seal");
        // then
        assert_eq!(peer.mark(0), 0);
    }

    #[test]
    fn memory_without_a_seal_is_rejected_by_name() {
        for missing in [SealFlags::SHRINK, SealFlags::GROW, SealFlags::FUTURE_WRITE, SealFlags::SEAL] {
            let memory = filled();
            fcntl_add_seals(&memory, SEALS.difference(missing)).expect("a new memfd takes seals");
            let refused = refused(memory);
            assert!(matches!(refused, OfferError::Seals(_)), "{missing:?}: {refused}");
        }
    }

    #[test]
    fn file_that_is_no_memfd_is_rejected_unread() {
        let (pipe, _other) = rustix::pipe::pipe().expect("a pipe");
        assert!(matches!(refused(pipe), OfferError::Kind));
        let null = File::open("/dev/null").expect("it is there");
        assert!(matches!(refused(null.into()), OfferError::Kind));
        // Huge pages can be sealed too, and a hole in them causes a bus error.
        let huge = memfd_create("sinew-test", MemfdFlags::ALLOW_SEALING | MemfdFlags::HUGETLB);
        if let Ok(huge) = huge {
            fcntl_add_seals(&huge, SEALS).expect("huge pages take seals");
            assert!(matches!(refused(huge), OfferError::Kind));
        }
    }

    #[test]
    fn memory_with_other_size_holes_or_identity_is_rejected() {
        for bytes in [0, 4096, 8191, 8193, 1 << 20] {
            let memory = memory(bytes, MemfdFlags::CLOEXEC);
            fcntl_add_seals(&memory, SEALS).expect("a new memfd takes seals");
            assert!(matches!(refused(memory), OfferError::Size { got, expected: 8192 } if got == bytes));
        }
        let sparse = memory(8192, MemfdFlags::CLOEXEC);
        fcntl_add_seals(&sparse, SEALS).expect("a new memfd takes seals");
        assert!(matches!(refused(sparse), OfferError::Holes { allocated: 0, expected: 8192 }));
        let blank = filled();
        fcntl_add_seals(&blank, SEALS).expect("a new memfd takes seals");
        assert!(matches!(refused(blank), OfferError::Identity));
    }
}
