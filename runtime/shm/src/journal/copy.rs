//! Copies a span of a journal into a smaller journal, while the writers continue.

use std::{ops::RangeInclusive, path::Path};

use super::{
    error::{CopyJournalError, ReadJournalError},
    layout::{RING_MAX, RING_MIN, record_bytes},
    reader::{JournalReader, Record, Start},
    writer::{Journal, Options},
};

/// Maximum number of damaged parts that a copy leaves out. A journal with more of them is given up there.
const DAMAGED_MAX: u32 = 1_024;

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
/// # Errors
/// The source cannot be read, or the target cannot be created. Then there is no new file.
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
    let (mut bytes, mut longest) = (0_u64, 0_u64);
    each_record(source, span, |_, payload| {
        let length = record_bytes(payload.len());
        bytes = bytes.saturating_add(length);
        longest = longest.max(length);
    })?;
    // The longest record fits into a quarter of the ring.
    let ring_bytes = bytes.max(longest.saturating_mul(4)).clamp(RING_MIN, RING_MAX);
    let reader = JournalReader::open(source, Start::Newest)?;
    let options = Options {
        ring_bytes,
        identity: reader.identity(),
        now: reader.created(),
        wall_offset: reader.wall_offset()?,
        ..Options::default()
    };
    let journal = Journal::create(target, &options)?;
    let mut copied = Copied { ring_bytes: ring_bytes.next_power_of_two(), ..Copied::default() };
    let read = each_record(source, span, |record, payload| {
        if journal.copy_record(record, payload) {
            copied.add(record.time);
        }
    });
    // Last: each record that was copied has its place in the table.
    match read.and_then(|()| reader.table()) {
        Ok(table) => journal.copy_table(&table),
        Err(why) => {
            journal.remove();
            return Err(why.into());
        }
    }
    Ok(copied)
}

/// Calls `each` with the records within the span that were written before this call.
fn each_record(
    source: &Path,
    span: &RangeInclusive<u64>,
    mut each: impl FnMut(&Record, &[u8]),
) -> Result<(), ReadJournalError> {
    let mut reader = JournalReader::open(source, Start::Oldest)?;
    let (end, mut payload, mut damaged) = (reader.reserved()?, Vec::new(), 0);
    loop {
        match reader.next(0, &mut payload) {
            Ok(Some(record)) if record.position >= end => return Ok(()),
            Ok(Some(record)) => {
                if span.contains(&record.time) {
                    each(&record, &payload);
                }
            }
            Ok(None) => return Ok(()),
            Err(ReadJournalError::Damaged { .. }) if damaged < DAMAGED_MAX => damaged += 1,
            Err(why) => return Err(why),
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
