//! The readers of a journal's file.
//!
//! A reader calls the system for bytes of the file and maps nothing: a file that is cut meanwhile is an error, not a
//! signal.

use std::{
    fs::File,
    io,
    os::unix::fs::FileExt,
    path::{Path, PathBuf},
    time::Duration,
};

use rustix::{
    fs::{FlockOperation, Mode, OFlags, flock},
    io::Errno,
};

use super::{
    core::{
        channels::{ChannelKey, HASH, KEY, READY, SEEN},
        reader::{Found, Next, ReaderCore, ReaderCounts, Source},
    },
    error::ReadJournalError,
    layout::{
        CLOSED_AT, HEADER_BYTES, Header, PLACE_BYTES, PLACES, RESERVED_AT, RING_AT, TABLE_AT, TABLE_BYTES,
        WALL_OFFSET_AT,
    },
};

/// The record at which a reader begins.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Start {
    /// The oldest one that is there.
    Oldest,
    /// The first one that is written from now on.
    Newest,
}

/// A record, without its payload.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Record {
    /// The place of its channel in [`JournalReader::channels`].
    pub place: u16,
    /// Its number in the channel, from 1.
    pub number: u64,
    /// Its time, in nanoseconds of the writer's monotonic clock.
    pub time: u64,
    /// Its position in bytes since the start of the journal.
    pub position: u64,
}

/// The records that a reader had of one channel.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Tally {
    /// The lowest number that it read; 0 without any.
    pub first: u64,
    /// The highest one.
    pub last: u64,
    /// Records that it read.
    pub read: u64,
}

impl Tally {
    /// Returns the records between the first and the last number that this reader did not have.
    #[must_use]
    pub const fn missed(&self) -> u64 {
        if self.read == 0 { 0 } else { (self.last - self.first).saturating_add(1).saturating_sub(self.read) }
    }

    fn add(&mut self, number: u64) {
        self.first = if self.read == 0 { number } else { self.first.min(number) };
        self.last = self.last.max(number);
        self.read = self.read.saturating_add(1);
    }
}

/// A channel of the table.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Channel {
    /// Its place.
    pub place: u16,
    /// Its key. `None` for the place of all channels that found no place of their own.
    pub key: Option<ChannelKey>,
    /// Messages that its writer counted.
    pub seen: u64,
    /// The records that this reader had of it.
    pub tally: Tally,
}

/// A reader of a journal that may be written at the same time, or whose writer has died.
///
/// See the example of [the module](super).
#[derive(Debug)]
pub struct JournalReader {
    file: JournalFile,
    header: Header,
    core: ReaderCore,
    tallies: Box<[Tally]>,
}

impl JournalReader {
    /// Opens a journal.
    ///
    /// # Errors
    /// The file cannot be read, or is no journal, or is shorter than it states.
    pub fn open(path: &Path, start: Start) -> Result<Self, ReadJournalError> {
        let failed = |cause| ReadJournalError::System { path: path.to_owned(), cause };
        // A pipe of this name would otherwise block until it has a writer.
        let flags = OFlags::RDONLY | OFlags::NOFOLLOW | OFlags::NONBLOCK | OFlags::CLOEXEC;
        let file = rustix::fs::open(path, flags, Mode::empty()).map_err(|errno| failed(errno.into()))?;
        let file = File::from(file);
        let metadata = file.metadata().map_err(failed)?;
        if !metadata.is_file() {
            return Err(ReadJournalError::Kind(path.to_owned()));
        }
        let file = JournalFile { file, path: path.to_owned(), stated: HEADER_BYTES as u64 };
        let mut page = [0; HEADER_BYTES];
        file.read_at(0, &mut page)?;
        let header =
            Header::decode(&page).map_err(|why| ReadJournalError::Header { path: path.to_owned(), why })?;
        let file = JournalFile { stated: header.file_bytes(), ..file };
        if metadata.len() < file.stated {
            return Err(file.cut(metadata.len()));
        }
        let is_from_oldest = start == Start::Oldest;
        let core = ReaderCore::new(header.ring_bytes, header.salt, file.reserved()?, is_from_oldest);
        Ok(Self { file, header, core, tallies: vec![Tally::default(); PLACES].into() })
    }

    /// Sets the time that a record may stay unfinished before it is skipped and counted: its writer may have been
    /// preempted, or may be dead. Zero, the default, fits a dead writer. 20 ms fit a living one.
    pub fn set_patience(&mut self, patience: Duration) {
        self.core.patience = u64::try_from(patience.as_nanos()).unwrap_or(u64::MAX);
    }

    /// Returns the next record, and its payload in `payload` in place of former bytes. `None`: there is none yet. It
    /// never waits. `now` is in nanoseconds of a clock that does not go back.
    ///
    /// # Errors
    /// The file cannot be read, was cut, or is damaged. The next call continues.
    pub fn next(&mut self, now: u64, payload: &mut Vec<u8>) -> Result<Option<Record>, ReadJournalError> {
        match self.core.next(&self.file, now, payload)? {
            Next::Nothing => Ok(None),
            Next::Damaged(position) => {
                Err(ReadJournalError::Damaged { path: self.file.path.clone(), position })
            }
            Next::Record(Found { position, head }) => {
                if let Some(tally) = self.tallies.get_mut(usize::from(head.place)) {
                    tally.add(head.number);
                }
                let (place, number, time) = (head.place, head.number, head.time);
                Ok(Some(Record { place, number, time, position }))
            }
        }
    }

    /// Returns all channels that have a place, with their counts at this moment.
    ///
    /// # Errors
    /// The file cannot be read.
    pub fn channels(&self) -> Result<Vec<Channel>, ReadJournalError> {
        let mut table = vec![0; TABLE_BYTES];
        self.file.read_at(TABLE_AT as u64, &mut table)?;
        let places = table.chunks_exact(PLACE_BYTES).zip(&self.tallies);
        let mut channels = Vec::new();
        for (place, (bytes, tally)) in (0_u16..).zip(places) {
            let word = |index: usize| {
                let mut word = [0; 8];
                word.copy_from_slice(&bytes[index * 8..][..8]);
                u64::from_ne_bytes(word)
            };
            let is_ready = word(HASH) != 0 && word(READY) != 0;
            let key = is_ready.then(|| ChannelKey([word(KEY), word(KEY + 1), word(KEY + 2)]));
            if word(SEEN) > 0 {
                channels.push(Channel { place, key, seen: word(SEEN), tally: *tally });
            }
        }
        Ok(channels)
    }

    /// Returns the words of the table of channels.
    pub(super) fn table(&self) -> Result<Vec<u64>, ReadJournalError> {
        let mut table = vec![0; TABLE_BYTES];
        self.file.read_at(TABLE_AT as u64, &mut table)?;
        Ok(table.as_chunks::<8>().0.iter().map(|word| u64::from_ne_bytes(*word)).collect())
    }

    /// Returns the bytes ever reserved in the ring.
    pub(super) fn reserved(&self) -> Result<u64, ReadJournalError> {
        self.file.reserved()
    }

    /// Returns the records that this reader had of a channel.
    #[must_use]
    pub fn tally(&self, place: u16) -> Tally {
        self.tallies.get(usize::from(place)).copied().unwrap_or_default()
    }

    /// Returns the events that cost this reader records.
    #[must_use]
    pub const fn counts(&self) -> ReaderCounts {
        self.core.counts
    }

    /// Returns whether the process that writes the journal is alive and has not closed it.
    #[must_use]
    pub fn is_writer_alive(&self) -> bool {
        // The writer holds this lock until it ends, however it ends.
        match flock(&self.file.file, FlockOperation::NonBlockingLockShared) {
            Ok(()) => {
                // It is released with the file at the latest.
                let _ = flock(&self.file.file, FlockOperation::Unlock);
                false
            }
            Err(error) => error == Errno::WOULDBLOCK,
        }
    }

    /// Returns whether the writer has closed the journal, which a killed one does not.
    ///
    /// # Errors
    /// The file cannot be read.
    pub fn is_closed(&self) -> Result<bool, ReadJournalError> {
        Ok(self.file.word(CLOSED_AT)? != 0)
    }

    /// Returns the creator's description.
    #[must_use]
    pub fn identity(&self) -> &[u8] {
        &self.header.identity
    }

    /// Returns the time of creation, in nanoseconds of the writer's monotonic clock.
    #[must_use]
    pub const fn created(&self) -> u64 {
        self.header.created
    }

    /// Returns the process that created the journal.
    #[must_use]
    pub const fn writer(&self) -> u32 {
        self.header.writer
    }

    /// Returns the bytes of the ring.
    #[must_use]
    pub const fn ring_bytes(&self) -> u64 {
        self.header.ring_bytes
    }

    /// Returns the nanoseconds to be added to a time of a record for that of the wall clock.
    ///
    /// # Errors
    /// The file cannot be read.
    pub fn wall_offset(&self) -> Result<i64, ReadJournalError> {
        Ok(self.file.word(WALL_OFFSET_AT)?.cast_signed())
    }
}

/// The file, and the length that its first page states.
#[derive(Debug)]
struct JournalFile {
    file: File,
    path: PathBuf,
    stated: u64,
}

impl JournalFile {
    fn read_at(&self, at: u64, into: &mut [u8]) -> Result<(), ReadJournalError> {
        self.file.read_exact_at(into, at).map_err(|cause| {
            if cause.kind() == io::ErrorKind::UnexpectedEof {
                return self.cut(self.file.metadata().map_or(0, |metadata| metadata.len()));
            }
            ReadJournalError::System { path: self.path.clone(), cause }
        })
    }

    fn word(&self, at: usize) -> Result<u64, ReadJournalError> {
        let mut word = [0; 8];
        self.read_at(at as u64, &mut word)?;
        Ok(u64::from_ne_bytes(word))
    }

    fn cut(&self, found: u64) -> ReadJournalError {
        ReadJournalError::Length { path: self.path.clone(), found, stated: self.stated }
    }
}

impl Source for JournalFile {
    type Error = ReadJournalError;

    fn reserved(&self) -> Result<u64, ReadJournalError> {
        self.word(RESERVED_AT)
    }

    fn read(&self, offset: u64, into: &mut [u8]) -> Result<(), ReadJournalError> {
        self.read_at(RING_AT as u64 + offset, into)
    }
}
