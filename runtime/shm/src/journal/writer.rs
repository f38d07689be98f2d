//! The journal that a process writes.

use std::{
    path::{Path, PathBuf},
    sync::atomic::{AtomicU64, Ordering},
};

use super::{
    core::{
        Memory,
        channels::{self, ChannelKey},
        writer::{begin, finish, reserve},
    },
    error::CreateJournalError,
    layout::{Head, Header, RING_MAX, RING_MIN, payload_max, salt_of},
    platform::{self, Map},
};

/// The properties of a new journal.
#[derive(Clone, Debug)]
pub struct Options<'a> {
    /// Bytes of the ring: 64 KiB to 4 GiB, rounded up to a power of two. The file has 260 KiB more. Default: 64 MiB.
    pub ring_bytes: u64,
    /// The creator's own description, for readers: at most [`IDENTITY_MAX`](super::IDENTITY_MAX) bytes.
    pub identity: &'a [u8],
    /// The time of creation, in nanoseconds of the monotonic clock.
    pub now: u64,
    /// Nanoseconds from the monotonic clock to the wall clock: [`Journal::set_wall_offset`].
    pub wall_offset: i64,
    /// A random number that senders cannot know.
    pub random: u64,
    /// Whether a file that is at the path is kept, with `.previous` after its name. Otherwise it is replaced.
    pub keeps_previous: bool,
}

impl Default for Options<'_> {
    fn default() -> Self {
        Self {
            ring_bytes: 64 << 20,
            identity: &[],
            now: 0,
            wall_offset: 0,
            random: random(),
            keeps_previous: false,
        }
    }
}

/// Returns a random number: the keys of a hash map are seeded by the system.
fn random() -> u64 {
    use std::hash::{BuildHasher, RandomState};
    RandomState::new().hash_one(0)
}

/// A ring in a file, to which every thread of this process can write.
///
/// The file stays when the journal is dropped, or when its process is killed. `now` and the times of records are
/// nanoseconds of the host's monotonic clock.
#[derive(Debug)]
pub struct Journal {
    map: Map,
    salt: u64,
    payload_max: usize,
    path: PathBuf,
}

impl Journal {
    /// Creates the file at `path`, for this user alone. All of its bytes are allocated now, so that a full disk is an
    /// error here and not a fault of a later write.
    ///
    /// # Errors
    /// The size, the folder, or the system's reason. A file that was at the path is still there.
    pub fn create(path: &Path, options: &Options<'_>) -> Result<Self, CreateJournalError> {
        let ring_bytes = options.ring_bytes.checked_next_power_of_two().unwrap_or(0);
        if !(RING_MIN..=RING_MAX).contains(&ring_bytes) || options.ring_bytes < RING_MIN {
            return Err(CreateJournalError::Size(options.ring_bytes));
        }
        let header = Header {
            ring_bytes,
            salt: salt_of(options.random),
            created: options.now,
            writer: std::process::id(),
            identity: options.identity.to_vec(),
        };
        let page = header.encode().ok_or(CreateJournalError::Identity(options.identity.len()))?;
        let map = platform::create(path, header.file_bytes(), options.keeps_previous, |file| {
            file.put(0, &page)?;
            file.put(super::layout::WALL_OFFSET_AT, &options.wall_offset.to_ne_bytes())
        })?;
        Ok(Self { map, salt: header.salt, payload_max: payload_max(ring_bytes), path: path.to_owned() })
    }

    /// Removes the file, unless another one has its name now. Readers that have it open read it to its end.
    pub fn remove(&self) {
        if self.map.is_at(&self.path) {
            // It stays if its folder refuses that.
            let _ = std::fs::remove_file(&self.path);
        }
    }

    /// Returns the path at which the file was created.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Returns the bytes of the longest payload that is written. Longer ones are counted.
    #[must_use]
    pub const fn payload_max(&self) -> usize {
        self.payload_max
    }

    /// Writes a record: all parts, one after the other. Returns `false` if it is too long; then it is only counted.
    ///
    /// It never waits, allocates nothing and calls no system. It replaces the oldest records.
    pub fn write(&self, key: ChannelKey, now: u64, parts: &[&[u8]]) -> bool {
        let length = parts.iter().map(|part| part.len()).sum::<usize>();
        let (place, number) = channels::count(self.map.table(), key, 1);
        // Longer than a quarter of the ring, it would replace too much at once.
        let Ok(length) = u32::try_from(length) else { return false };
        if length as usize > self.payload_max {
            return false;
        }
        let reserved = reserve(&self.map, Head { length, place, number, time: now });
        begin(&self.map, reserved, self.salt);
        finish(&self.map, reserved, parts, self.salt);
        true
    }

    /// Counts messages of a channel that are not written.
    pub fn count(&self, key: ChannelKey, messages: u64) {
        channels::count(self.map.table(), key, messages);
    }

    /// Returns the bytes of all records so far, with their heads.
    #[must_use]
    pub fn written_bytes(&self) -> u64 {
        self.map.reserved().load(Ordering::Relaxed)
    }

    /// Sets the nanoseconds that a time of a record is behind the wall clock.
    pub fn set_wall_offset(&self, nanoseconds: i64) {
        // SYNC: Relaxed: readers need no order between this and a record.
        self.word(super::layout::WALL_OFFSET_AT).store(nanoseconds.cast_unsigned(), Ordering::Relaxed);
    }

    fn word(&self, at: usize) -> &AtomicU64 {
        self.map.header_word(at / 8)
    }
}

impl Drop for Journal {
    fn drop(&mut self) {
        // SYNC: Release: a reader that sees this finds all records.
        self.word(super::layout::CLOSED_AT).store(1, Ordering::Release);
    }
}
