//! Memory without a name, sealed: its creation, and the checks of a peer's memory before it is mapped.

use std::{io, os::fd::OwnedFd};

use memmap2::MmapOptions;
use rustix::{
    fs::{
        FallocateFlags, MemfdFlags, SealFlags, fallocate, fcntl_add_seals, fcntl_get_seals, fstat, fstatfs,
        ftruncate, memfd_create,
    },
    io::Errno,
};

use super::mapping::{Mapping, OwnHeaderMemory, OwnMemory, PeerMemory};
use crate::{
    error::{CreateError, OfferError},
    layout::{Capacity, HEADER_BYTES, MAGIC, VERSION},
};

/// The file system type of tmpfs, and so of every ordinary memfd. Memory in huge pages reports another one.
const TMPFS_MAGIC: i64 = 0x0102_1994;

/// Without these a peer could remove memory that this side uses: by cutting it, by punching holes
/// (FUTURE_WRITE), or by unsealing it.
const NEEDED: SealFlags =
    SealFlags::SHRINK.union(SealFlags::GROW).union(SealFlags::FUTURE_WRITE).union(SealFlags::SEAL);

/// Creates a region: all of its memory is allocated now, and only this mapping can write it.
pub(crate) fn create(capacity: Capacity) -> Result<(OwnMemory, OwnedFd), CreateError> {
    let step = |step| move |errno: Errno| CreateError::System { step, cause: errno.into() };
    let memory = unnamed().map_err(step("making memory (memfd_create)"))?;
    let bytes = capacity.region_bytes();
    ftruncate(&memory, bytes).map_err(step("sizing memory (ftruncate)"))?;
    // Now, and not at the first access: a lack of memory is an error here, and a bus error there.
    fallocate(&memory, FallocateFlags::empty(), 0, bytes).map_err(step("reserving memory (fallocate)"))?;
    let mapped = |cause| CreateError::System { step: "mapping memory (mmap)", cause };
    let raw = options(capacity).and_then(|options| options.map_raw(&memory)).map_err(mapped)?;
    let mapping = Mapping::new(raw, capacity).ok_or_else(|| mapped(io::ErrorKind::InvalidData.into()))?;
    let own = OwnMemory::new(mapping);
    fcntl_add_seals(&memory, NEEDED).map_err(step("sealing memory (F_ADD_SEALS)"))?;
    Ok((own, memory))
}

/// Not executable where the system supports that (Linux 6.3).
fn unnamed() -> Result<OwnedFd, Errno> {
    let flags = MemfdFlags::CLOEXEC | MemfdFlags::ALLOW_SEALING;
    match memfd_create("sinew-ring", flags | MemfdFlags::NOEXEC_SEAL) {
        Err(Errno::INVAL) => memfd_create("sinew-ring", flags),
        other => other,
    }
}

/// Maps a peer's region read-only, if it is valid.
///
/// The order matters: the kernel itself returns the seals for every kind of file, while a request for the
/// size to the peer's own file system could block forever.
pub(crate) fn adopt(memory: OwnedFd, capacity: Capacity) -> Result<PeerMemory, OfferError> {
    let step = |step| move |errno: Errno| OfferError::System { step, cause: errno.into() };
    let seals = fcntl_get_seals(&memory).map_err(|_| OfferError::Kind)?;
    if !seals.contains(NEEDED) {
        return Err(OfferError::Seals(format!("{:?}", NEEDED.difference(seals))));
    }
    let kind = fstatfs(&memory).map_err(step("asking for the kind of the offered memory (fstatfs)"))?.f_type;
    if kind != TMPFS_MAGIC {
        return Err(OfferError::Kind);
    }
    let stat = fstat(&memory).map_err(step("asking for the size of the offered memory (fstat)"))?;
    let (expected, got) = (capacity.region_bytes(), u64::try_from(stat.st_size).unwrap_or(0));
    if got != expected {
        return Err(OfferError::Size { got, expected });
    }
    let allocated = u64::try_from(stat.st_blocks).unwrap_or(0).saturating_mul(512);
    if allocated < expected {
        return Err(OfferError::Holes { allocated, expected });
    }
    let mapped = |cause| OfferError::System { step: "mapping the offered memory (mmap)", cause };
    let raw = options(capacity).and_then(|options| options.map_raw_read_only(&memory)).map_err(mapped)?;
    let mapping = Mapping::new(raw, capacity).ok_or_else(|| mapped(io::ErrorKind::InvalidData.into()))?;
    if mapping.identity() != (MAGIC, VERSION, capacity.bytes()) {
        return Err(OfferError::Identity);
    }
    Ok(PeerMemory::new(mapping))
}

/// Creates a page that only this side can write, for the announcement of its sleep.
pub(super) fn create_own_page() -> io::Result<(OwnHeaderMemory, OwnedFd)> {
    let memory = unnamed()?;
    ftruncate(&memory, HEADER_BYTES as u64)?;
    fallocate(&memory, FallocateFlags::empty(), 0, HEADER_BYTES as u64)?;
    let mapping = Mapping::page(MmapOptions::new().len(HEADER_BYTES).populate().map_raw(&memory)?);
    fcntl_add_seals(&memory, NEEDED)?;
    Ok((OwnHeaderMemory::of_page(mapping.ok_or(io::ErrorKind::InvalidData)?), memory))
}

/// Maps a peer's page that only the peer can write, if it is valid; `None` if not.
pub(super) fn adopt_own_page(memory: &OwnedFd) -> io::Result<Option<Mapping>> {
    if !is_page(memory, NEEDED)? {
        return Ok(None);
    }
    Ok(Mapping::page(MmapOptions::new().len(HEADER_BYTES).populate().map_raw_read_only(memory)?))
}

/// Whether it is memory of one page with these seals.
fn is_page(memory: &OwnedFd, needed: SealFlags) -> io::Result<bool> {
    let sealed = fcntl_get_seals(memory).is_ok_and(|seals| seals.contains(needed));
    Ok(sealed && fstatfs(memory)?.f_type == TMPFS_MAGIC && fstat(memory)?.st_size == HEADER_BYTES as i64)
}

/// A page that both sides write and neither trusts still must not shrink.
const NEEDED_OF_PAGE: SealFlags = SealFlags::SHRINK.union(SealFlags::GROW).union(SealFlags::SEAL);

/// Creates a page of bells: both sides write it.
pub(super) fn create_page() -> io::Result<(Mapping, OwnedFd)> {
    let memory = unnamed()?;
    ftruncate(&memory, HEADER_BYTES as u64)?;
    fallocate(&memory, FallocateFlags::empty(), 0, HEADER_BYTES as u64)?;
    fcntl_add_seals(&memory, NEEDED_OF_PAGE)?;
    let mapping = Mapping::page(MmapOptions::new().len(HEADER_BYTES).populate().map_raw(&memory)?);
    Ok((mapping.ok_or(io::ErrorKind::InvalidData)?, memory))
}

/// Maps a peer's page of bells, if it is valid; `None` if not.
pub(super) fn adopt_page(memory: &OwnedFd) -> io::Result<Option<Mapping>> {
    if !is_page(memory, NEEDED_OF_PAGE)? {
        return Ok(None);
    }
    Ok(Mapping::page(MmapOptions::new().len(HEADER_BYTES).populate().map_raw(memory)?))
}

/// Mapped with all its pages: the first message causes no page fault.
fn options(capacity: Capacity) -> io::Result<MmapOptions> {
    let bytes = usize::try_from(capacity.region_bytes()).map_err(|_| io::ErrorKind::OutOfMemory)?;
    let mut options = MmapOptions::new();
    options.len(bytes).populate();
    Ok(options)
}
