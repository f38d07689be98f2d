//! Copies a span of a journal into a smaller journal, while the writers continue.

use std::{
    io,
    ops::RangeInclusive,
    path::{Path, PathBuf},
};

use super::{
    error::{CopyJournalError, CreateJournalError, ReadJournalError},
    layout::{
        CLOSED_AT, Head, Header, RESERVED_AT, RING_AT, RING_MAX, RING_MIN, State, TABLE_AT, WALL_OFFSET_AT,
        hasher, record_bytes, salt_of, stamp,
    },
    platform::{self, NewFile},
    reader::{JournalReader, Record, Start},
    writer::Options,
};

/// Maximum number of damaged parts that a copy leaves out. A journal with more of them is given up there.
const DAMAGED_MAX: u32 = 1_024;
/// Bytes of records that are written by one call.
const WAITING_BYTES: usize = 256 * 1024;

/// The records of a copy.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Copied {
    /// Records in the copy.
    pub records: u64,
    /// Bytes of the copy's ring.
    pub ring_bytes: u64,
    /// The earliest time of a record; 0 without any.
    pub first: u64,
    /// The latest time of a record; 0 without any.
    pub last: u64,
}

/// Copies the records with times within `span` from the journal at `source` to a new journal at `target`, for this user
/// alone. They keep their times, places and numbers, and the table of channels is copied whole.
///
/// The source is read twice, up to its end at that moment: for the size of the copy, and for its records. It
/// may be written meanwhile: overwritten records are missing in the copy, and their numbers show it.
///
/// The target is written by calls and is never mapped, so it may lie on a disk: a fault of the disk is an error. It has
/// its name when it is whole.
///
/// # Errors
/// The source cannot be read, or the target cannot be created or written. Then there is no new file.
///
/// # Examples
///
/// ```
/// use sinew_shm::journal::{ChannelKey, Journal, JournalReader, Options, Start, copy_span};
///
/// # let folder = std::env::temp_dir().join(format!("sinew-copy-doc-{}", std::process::id()));
/// # #[cfg(target_os = "linux")] {
/// # std::fs::create_dir_all(&folder)?;
/// # std::fs::set_permissions(&folder, std::os::unix::fs::PermissionsExt::from_mode(0o700))?;
/// let (source, target) = (folder.join("knee.journal"), folder.join("knee.frozen"));
/// let journal = Journal::create(&source, &Options { ring_bytes: 1 << 20, ..Options::default() })?;
/// (1..=9).for_each(|second| _ = journal.write(ChannelKey([1, 2, 3]), second, &[b"torque"]));
///
/// let copied = copy_span(&source, &target, &(3..=5))?;
/// assert_eq!((copied.records, copied.first, copied.last), (3, 3, 5));
/// let mut reader = JournalReader::open(&target, Start::Oldest)?;
/// assert_eq!(reader.next(0, &mut Vec::new())?.expect("it was copied").number, 3);
/// # std::fs::remove_dir_all(&folder)?;
/// # }
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn copy_span(
    source: &Path,
    target: &Path,
    span: &RangeInclusive<u64>,
) -> Result<Copied, CopyJournalError> {
    copy_joined(&[], source, target, span)
}

/// Same as [`copy_span`], with the records of former copies of the source, which may have lost them. A former copy that
/// cannot be read is left out.
///
/// A record that both have is copied from the former copy: the source loses further records meanwhile.
///
/// # Errors
/// As [`copy_span`].
pub fn copy_joined(
    former: &[PathBuf],
    source: &Path,
    target: &Path,
    span: &RangeInclusive<u64>,
) -> Result<Copied, CopyJournalError> {
    let parts = parts(former, source, span)?;
    let (mut bytes, mut longest) = (0_u64, 0_u64);
    for Part { path, times } in &parts {
        each_record::<ReadJournalError>(path, times, |_, payload| {
            let length = record_bytes(payload.len());
            bytes = bytes.saturating_add(length);
            longest = longest.max(length);
            Ok(())
        })?;
    }
    // The longest record fits into a quarter of the ring.
    let ring_bytes = bytes.max(longest.saturating_mul(4)).clamp(RING_MIN, RING_MAX).next_power_of_two();
    let reader = JournalReader::open(source, Start::Newest)?;
    let header = Header {
        ring_bytes,
        salt: salt_of(Options::default().random),
        created: reader.created(),
        writer: std::process::id(),
        identity: reader.identity().to_vec(),
    };
    let page = header.encode().ok_or(CreateJournalError::Identity(header.identity.len()))?;
    let wall_offset = reader.wall_offset()?;
    let mut copied = Copied { ring_bytes, ..Copied::default() };
    platform::write_file(target, |file| {
        let failed = |cause| CreateJournalError::System {
            path: target.to_owned(),
            step: "its bytes cannot be written",
            cause,
        };
        file.reserve(RING_AT as u64 + bytes, header.file_bytes()).map_err(failed)?;
        file.put(0, &page).map_err(failed)?;
        file.put(WALL_OFFSET_AT, &wall_offset.to_ne_bytes()).map_err(failed)?;
        let mut ring = Ring { file, salt: header.salt, room: ring_bytes, position: 0, waiting: Vec::new() };
        for Part { path, times } in &parts {
            each_record::<CopyJournalError>(path, times, |record, payload| {
                if ring.push(record, payload).map_err(failed)? {
                    copied.add(record.time);
                }
                Ok(())
            })?;
        }
        ring.flush().map_err(failed)?;
        // Last: each record that was copied has its place in the table.
        let table: Vec<u8> = reader.table()?.into_iter().flat_map(u64::to_ne_bytes).collect();
        file.put(TABLE_AT, &table).map_err(failed)?;
        file.put(RESERVED_AT, &ring.position.to_ne_bytes()).map_err(failed)?;
        file.put(CLOSED_AT, &1_u64.to_ne_bytes()).map_err(failed)?;
        Ok(())
    })?;
    Ok(copied)
}

/// The records of one journal that are copied.
struct Part<'a> {
    path: &'a Path,
    times: RangeInclusive<u64>,
}

/// Returns the parts of a copy, in the order of their times. No time is in two of them, so no record is copied twice: a
/// record has the same time in all these journals.
fn parts<'a>(
    former: &'a [PathBuf],
    source: &'a Path,
    span: &RangeInclusive<u64>,
) -> Result<Vec<Part<'a>>, ReadJournalError> {
    // One that cannot be read, or has no record of the span, has nothing to keep.
    let times = |path: &'a PathBuf| Some((times_in(path, span).ok()??, path));
    let mut kept: Vec<_> = former.iter().filter_map(times).collect();
    kept.sort_unstable();
    // Earlier times are not read from the source: it may have lost their records.
    let oldest =
        if kept.is_empty() { Some(*span.start()) } else { times_in(source, span)?.map(|times| times.0) };
    let from_source = |times: RangeInclusive<u64>| {
        let has_some = !times.is_empty() && oldest.is_some_and(|oldest| oldest <= *times.end());
        has_some.then_some(Part { path: source, times })
    };
    let (mut parts, mut next) = (Vec::new(), Some(*span.start()));
    for ((first, last), path) in kept {
        let Some(begin) = next.filter(|begin| *begin <= last) else { continue };
        if begin < first {
            parts.extend(from_source(begin..=first - 1));
        }
        parts.push(Part { path, times: begin.max(first)..=last });
        next = last.checked_add(1);
    }
    parts.extend(next.and_then(|begin| from_source(begin..=*span.end())));
    Ok(parts)
}

/// Returns the earliest and the latest time of a record within `span`, if there is one.
fn times_in(path: &Path, span: &RangeInclusive<u64>) -> Result<Option<(u64, u64)>, ReadJournalError> {
    let mut times = None;
    each_record::<ReadJournalError>(path, span, |record, _| {
        let (first, last) = times.unwrap_or((record.time, record.time));
        times = Some((first.min(record.time), last.max(record.time)));
        Ok(())
    })?;
    Ok(times)
}

/// The ring of a copy. Its records lie one after the other, from its start.
struct Ring<'a> {
    file: &'a NewFile<'a>,
    salt: u64,
    /// Bytes of the ring. The second reading may find some more records than the first one.
    room: u64,
    /// Bytes of the records so far.
    position: u64,
    /// The last of them, which are not in the file yet.
    waiting: Vec<u8>,
}

impl Ring<'_> {
    /// Adds a record with its place and its number. Returns `false` if there is no room.
    fn push(&mut self, record: &Record, payload: &[u8]) -> io::Result<bool> {
        let bytes = record_bytes(payload.len());
        let Ok(length) = u32::try_from(payload.len()) else { return Ok(false) };
        if self.position + bytes > self.room {
            return Ok(false);
        }
        let Record { place, number, time, .. } = *record;
        let head = Head { length, place, number, time };
        let mut crc = hasher(self.position, &head);
        crc.update(payload);
        let begin = self.waiting.len();
        let [first, second, third] = head.words();
        let words =
            [stamp(self.position, State::Written, self.salt), first, second, third, crc.finalize().into()];
        words.iter().for_each(|word| self.waiting.extend(word.to_ne_bytes()));
        self.waiting.extend(payload);
        self.waiting.resize(begin + bytes as usize, 0);
        self.position += bytes;
        if self.waiting.len() >= WAITING_BYTES {
            self.flush()?;
        }
        Ok(true)
    }

    fn flush(&mut self) -> io::Result<()> {
        let begin = RING_AT + self.position as usize - self.waiting.len();
        self.file.put(begin, &self.waiting)?;
        self.waiting.clear();
        Ok(())
    }
}

/// Calls `each` with the records with times within `span` that were written before this call. Damaged parts are left
/// out.
///
/// # Errors
/// The journal cannot be read, or has over 1,024 damaged parts; or the error of `each`, which is not called again.
pub fn each_record<E: From<ReadJournalError>>(
    source: &Path,
    span: &RangeInclusive<u64>,
    mut each: impl FnMut(&Record, &[u8]) -> Result<(), E>,
) -> Result<(), E> {
    let mut reader = JournalReader::open(source, Start::Oldest)?;
    let (end, mut payload, mut damaged) = (reader.reserved()?, Vec::new(), 0);
    loop {
        match reader.next(0, &mut payload) {
            Ok(Some(record)) if record.position >= end => return Ok(()),
            Ok(Some(record)) => {
                if span.contains(&record.time) {
                    each(&record, &payload)?;
                }
            }
            Ok(None) => return Ok(()),
            Err(ReadJournalError::Damaged { .. }) if damaged < DAMAGED_MAX => damaged += 1,
            Err(why) => return Err(why.into()),
        }
    }
}

impl Copied {
    fn add(&mut self, time: u64) {
        self.first = if self.records == 0 { time } else { self.first.min(time) };
        self.last = self.last.max(time);
        self.records += 1;
    }
}
