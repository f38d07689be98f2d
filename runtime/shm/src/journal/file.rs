//! The file of a journal: made safely, and mapped; or written by calls, as a copy is. **The one unsafe block of
//! journals is here.**
//!
//! It rests on these facts:
//!
//! - J1. `MmapRaw` keeps `len()` bytes mapped at `as_ptr()`, aligned to a page, until it is dropped. `Map` owns it, and
//!   all that is borrowed from it borrows the `Map`.
//! - J2. Every access of this process to these bytes is an atomic access of 8 aligned bytes. So threads may write the
//!   same word at once, and another process of this user may change it: any value is valid.
//! - J3. All bytes of the file are allocated, and only this user can open it. If one of this user's programs cuts the
//!   file, an access ends this process (SIGBUS). It reads or writes nothing else.

use std::{
    ffi::{OsStr, OsString},
    fs::File,
    io,
    os::unix::fs::{FileExt, MetadataExt},
    path::Path,
    slice,
    sync::atomic::{AtomicU32, AtomicU64, Ordering},
};

use memmap2::{MmapOptions, MmapRaw};
use rustix::{
    fd::{AsFd, OwnedFd},
    fs::{
        AtFlags, FallocateFlags, FlockOperation, Mode, OFlags, fallocate, flock, fstat, openat, renameat,
        statat, unlinkat,
    },
    io::Errno,
};

use super::{
    core::Memory,
    error::{CopyJournalError, CreateJournalError},
    layout::{HEADER_BYTES, PLACE_WORDS, PLACES, RESERVED_AT, RING_AT, TABLE_AT},
};

/// The whole file as words.
#[derive(Debug)]
pub(crate) struct Map {
    raw: MmapRaw,
    /// Open as long as the journal: its lock tells readers that the writer lives.
    lock: File,
}

impl Map {
    fn words(&self) -> &[AtomicU64] {
        // SAFETY: J1: this many bytes are mapped there, aligned to a page; J2: all access to them is atomic and of this
        // size; J3.
        unsafe { slice::from_raw_parts(self.raw.as_ptr().cast::<AtomicU64>(), self.raw.len() / 8) }
    }

    /// Returns whether the file still has this name.
    pub(crate) fn is_at(&self, path: &Path) -> bool {
        match (self.lock.metadata(), path.symlink_metadata()) {
            (Ok(own), Ok(there)) => (own.dev(), own.ino()) == (there.dev(), there.ino()),
            _ => false,
        }
    }

    /// A word of the first page.
    pub(crate) fn header_word(&self, index: usize) -> &AtomicU64 {
        &self.words()[..HEADER_BYTES / 8][index]
    }
}

impl Memory for Map {
    fn reserved(&self) -> &AtomicU64 {
        self.header_word(RESERVED_AT / 8)
    }

    fn table(&self) -> &[AtomicU64] {
        &self.words()[TABLE_AT / 8..][..PLACES * PLACE_WORDS]
    }

    fn ring(&self) -> &[AtomicU64] {
        &self.words()[RING_AT / 8..]
    }
}

/// A file that has no name of its own yet.
pub(crate) struct NewFile<'a>(&'a File);

impl NewFile<'_> {
    pub(crate) fn put(&self, at: usize, bytes: &[u8]) -> io::Result<()> {
        self.0.write_all_at(bytes, at as u64)
    }

    /// Allocates the first bytes, so that a full disk is an error here, and sets the length of the file.
    pub(crate) fn reserve(&self, allocated: u64, length: u64) -> io::Result<()> {
        allocate(self.0, allocated)?;
        self.0.set_len(length)
    }
}

/// Creates a file of so many bytes, has `fill` write its first ones, and then gives it its name.
pub(crate) fn create(
    path: &Path,
    bytes: u64,
    keeps_previous: bool,
    fill: impl FnOnce(&NewFile<'_>) -> io::Result<()>,
) -> Result<Map, CreateJournalError> {
    let failed =
        |step| move |cause: io::Error| CreateJournalError::System { path: path.to_owned(), step, cause };
    let (folder, name) = open_folder(path)?;
    let (temporary, file) = new_file(&folder, name).map_err(failed("a file cannot be made"))?;
    let finish = || {
        flock(&file, FlockOperation::NonBlockingLockExclusive)
            .map_err(io::Error::from)
            .map_err(failed("the file cannot be locked"))?;
        allocate(&file, bytes).map_err(failed("its bytes cannot be allocated"))?;
        fill(&NewFile(&file)).map_err(failed("its first page cannot be written"))?;
        let length = usize::try_from(bytes)
            .map_err(|_| failed("it is too long")(io::ErrorKind::OutOfMemory.into()))?;
        // With all its pages, so that no writer waits for one.
        let raw = MmapOptions::new().len(length).populate().map_raw(&file).map_err(failed("mmap"))?;
        if keeps_previous {
            keep_previous(&folder, name).map_err(|cause| {
                let taken = check_name(&folder, &path.with_file_name(previous(name))).err();
                taken.unwrap_or_else(|| failed("the file that is there cannot be kept")(cause))
            })?;
        }
        renameat(&folder, &temporary, &folder, name)
            .map_err(io::Error::from)
            .map_err(failed("the file cannot be given its name"))?;
        Ok(raw)
    };
    match finish() {
        Ok(raw) => Ok(Map { raw, lock: file }),
        Err(error) => {
            // The first error is the one to report.
            let _ = unlinkat(&folder, &temporary, AtFlags::empty());
            Err(error)
        }
    }
}

/// Creates a file, has `fill` write it, and then gives it its name.
///
/// It is never mapped: on a disk that fails, a write through a mapping ends the process.
pub(crate) fn write_file(
    path: &Path,
    fill: impl FnOnce(&NewFile<'_>) -> Result<(), CopyJournalError>,
) -> Result<(), CopyJournalError> {
    let failed =
        |step| move |cause: io::Error| CreateJournalError::System { path: path.to_owned(), step, cause };
    let (folder, name) = open_folder(path)?;
    let (temporary, file) = new_file(&folder, name).map_err(failed("a file cannot be made"))?;
    let finish = || {
        fill(&NewFile(&file))?;
        file.sync_data().map_err(failed("its bytes cannot be stored"))?;
        renameat(&folder, &temporary, &folder, name)
            .map_err(io::Error::from)
            .map_err(failed("the file cannot be given its name"))?;
        Ok(())
    };
    finish().inspect_err(|_| {
        // The first error is the one to report.
        let _ = unlinkat(&folder, &temporary, AtFlags::empty());
    })
}

/// Opens the folder of a path, if no other user can replace its files. Returns the file's name, too.
fn open_folder(path: &Path) -> Result<(OwnedFd, &OsStr), CreateJournalError> {
    let failed =
        |step| move |cause: io::Error| CreateJournalError::System { path: path.to_owned(), step, cause };
    let refused = |why| CreateJournalError::Folder { path: path.to_owned(), why };
    let name = path.file_name().ok_or_else(|| refused("the path ends without a file name"))?;
    let folder =
        path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or_else(|| Path::new("."));
    let flags = OFlags::DIRECTORY | OFlags::RDONLY | OFlags::CLOEXEC;
    let folder = rustix::fs::open(folder, flags, Mode::empty())
        .map_err(io::Error::from)
        .map_err(failed("its folder cannot be opened"))?;
    check_folder(&folder).map_err(failed("its folder cannot be looked at"))?.map_err(refused)?;
    check_name(&folder, path)?;
    Ok((folder, name))
}

/// Refuses a path of which the folder does not let this user replace the file.
fn check_name(folder: &OwnedFd, path: &Path) -> Result<(), CreateJournalError> {
    let own = rustix::process::geteuid().as_raw();
    let name = path.file_name().unwrap_or_default();
    // Without such a file there is nothing to replace. Another failure is reported by the step that needs the name.
    let (Ok(there), Ok(around)) = (statat(folder, name, AtFlags::SYMLINK_NOFOLLOW), fstat(folder)) else {
        return Ok(());
    };
    let is_sticky = Mode::from_raw_mode(around.st_mode).contains(Mode::SVTX);
    if is_taken(own, there.st_uid, around.st_uid, is_sticky) {
        return Err(CreateJournalError::Taken { path: path.to_owned(), owner: there.st_uid, own });
    }
    Ok(())
}

/// Returns whether a folder keeps the file of `owner` from the user `own`: a sticky one lets a file be replaced by its
/// owner, by the owner of the folder, and by root.
pub(crate) const fn is_taken(own: u32, owner: u32, owner_of_folder: u32, is_sticky: bool) -> bool {
    is_sticky && own != 0 && own != owner && own != owner_of_folder
}

/// Returns why other users could replace files of this folder.
fn check_folder(folder: &OwnedFd) -> io::Result<Result<(), &'static str>> {
    let stat = fstat(folder)?;
    let mode = Mode::from_raw_mode(stat.st_mode);
    let is_shared = mode.intersects(Mode::WGRP | Mode::WOTH) && !mode.contains(Mode::SVTX);
    let is_trusted = stat.st_uid == rustix::process::geteuid().as_raw() || stat.st_uid == 0;
    Ok(if !is_trusted {
        Err("its folder belongs to another user; choose a folder of this user or of root")
    } else if is_shared {
        Err("other users can replace files in its folder; choose another one, or take their write permission")
    } else {
        Ok(())
    })
}

/// Numbers the files of this process.
static NUMBER: AtomicU32 = AtomicU32::new(0);

/// Creates a file that did not exist, for this user alone.
fn new_file(folder: &OwnedFd, name: &OsStr) -> io::Result<(OsString, File)> {
    let number = NUMBER.fetch_add(1, Ordering::Relaxed);
    let mut temporary = OsString::from(".");
    temporary.push(name);
    temporary.push(format!(".{}.{number}", std::process::id()));
    let flags = OFlags::RDWR | OFlags::CREATE | OFlags::EXCL | OFlags::NOFOLLOW | OFlags::CLOEXEC;
    let open = || openat(folder, &temporary, flags, Mode::RUSR | Mode::WUSR);
    let file = match open() {
        // A process with this number has died before its file had a name.
        Err(Errno::EXIST) => unlinkat(folder, &temporary, AtFlags::empty()).and_then(|()| open()),
        other => other,
    }?;
    Ok((temporary, File::from(file)))
}

/// Allocates all bytes, so that no write through the mapping finds a full disk.
fn allocate(file: &File, bytes: u64) -> io::Result<()> {
    match fallocate(file.as_fd(), FallocateFlags::empty(), 0, bytes) {
        Err(Errno::OPNOTSUPP | Errno::NOSYS) => {
            let zeros = vec![0; 1 << 20];
            let mut at = 0;
            while at < bytes {
                let length = zeros.len().min(usize::try_from(bytes - at).unwrap_or(usize::MAX));
                file.write_all_at(&zeros[..length], at)?;
                at += length as u64;
            }
            Ok(())
        }
        other => Ok(other?),
    }
}

/// Returns the name that the former file of this name is kept under.
fn previous(name: &OsStr) -> OsString {
    let mut previous = name.to_owned();
    previous.push(".previous");
    previous
}

/// Renames the file that has the name.
fn keep_previous(folder: &OwnedFd, name: &OsStr) -> io::Result<()> {
    match renameat(folder, name, folder, previous(name)) {
        Ok(()) | Err(Errno::NOENT) => Ok(()),
        Err(other) => Err(other.into()),
    }
}
