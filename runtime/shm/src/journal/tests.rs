//! Journals as files: their creation, and files that are damaged.

use std::{
    fs::{self, OpenOptions},
    os::unix::fs::{FileExt, PermissionsExt, symlink},
    path::PathBuf,
    sync::atomic::{AtomicBool, Ordering},
};

use proptest::prelude::*;

use super::{
    ChannelKey, Copied, CreateJournalError, Journal, JournalHeaderError, JournalReader, Options,
    ReadJournalError, Start, copy_joined, copy_span,
    layout::{HEADER_BYTES, RING_AT, TABLE_AT, TABLE_BYTES},
    platform,
};

const KEY: ChannelKey = ChannelKey([7, 8, 9]);

/// A folder that is removed at the end.
struct Folder(PathBuf);

impl Folder {
    fn new(name: &str) -> Self {
        let path = std::env::temp_dir().join(format!("sinew-journal-{name}-{}", std::process::id()));
        // An earlier process of this number may have left it.
        let _ = fs::remove_dir_all(&path);
        fs::create_dir_all(&path).expect("the folder can be made");
        // Whatever the user's mask is.
        fs::set_permissions(&path, fs::Permissions::from_mode(0o700)).expect("the folder is its own");
        Self(path)
    }

    fn path(&self) -> PathBuf {
        self.0.join("knee.journal")
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = fs::remove_dir_all(&self.0);
    }
}

fn small() -> Options<'static> {
    Options { ring_bytes: 64 * 1024, identity: b"the knee", now: 5, wall_offset: -3, ..Options::default() }
}

fn numbers(reader: &mut JournalReader) -> Result<Vec<u64>, ReadJournalError> {
    let (mut payload, mut numbers) = (Vec::new(), Vec::new());
    while let Some(record) = reader.next(u64::MAX, &mut payload)? {
        numbers.push(record.number);
    }
    Ok(numbers)
}

#[test]
fn file_of_another_user_is_named_with_its_remedy() {
    const OWN: u32 = 1_000;
    const OTHER: u32 = 1_001;
    let cases = [
        // /dev/shm belongs to root.
        (OWN, OTHER, 0, true, true),
        (OWN, 0, 0, true, true),
        (OWN, OWN, 0, true, false),
        // In its own folder a user replaces the files of others, and root does so everywhere.
        (OWN, OTHER, OWN, true, false),
        (0, OTHER, OTHER, true, false),
        (OWN, OTHER, 0, false, false),
    ];
    for (own, owner, folder, is_sticky, is_taken) in cases {
        assert_eq!(platform::is_taken(own, owner, folder, is_sticky), is_taken, "{own} {owner} {folder}");
    }
    let path = PathBuf::from("/dev/shm/sinew-leg-10.0.0.2.journal");
    let text = CreateJournalError::Taken { path, owner: OTHER, own: OWN }.to_string();
    for part in ["/dev/shm/sinew-leg-10.0.0.2.journal", "number 1001", "number 1000", "choose a folder"] {
        assert!(text.contains(part), "{part}: {text}");
    }
}

#[test]
fn journal_is_its_users_and_has_its_identity() {
    let folder = Folder::new("identity");
    let journal = Journal::create(&folder.path(), &small()).unwrap();
    let metadata = fs::metadata(folder.path()).unwrap();
    assert_eq!(metadata.permissions().mode() & 0o777, 0o600);
    assert_eq!(metadata.len(), RING_AT as u64 + 64 * 1024);
    let reader = JournalReader::open(&folder.path(), Start::Oldest).unwrap();
    assert_eq!((reader.identity(), reader.created()), (&b"the knee"[..], 5));
    assert_eq!(reader.writer(), std::process::id());
    assert_eq!(reader.wall_offset().unwrap(), -3);
    journal.set_wall_offset(i64::MIN);
    assert_eq!(reader.wall_offset().unwrap(), i64::MIN);
    assert!(reader.is_writer_alive() && !reader.is_closed().unwrap());
    drop(journal);
    assert!(!reader.is_writer_alive() && reader.is_closed().unwrap());
    assert_eq!(fs::read_dir(&folder.0).unwrap().count(), 1, "no temporary file is left");
}

#[test]
fn symbolic_link_is_replaced_and_not_followed() {
    let folder = Folder::new("link");
    let victim = folder.0.join("victim");
    fs::write(&victim, "precious").unwrap();
    symlink(&victim, folder.path()).unwrap();
    assert!(matches!(
        JournalReader::open(&folder.path(), Start::Oldest),
        Err(ReadJournalError::System { .. })
    ));
    let _journal = Journal::create(&folder.path(), &small()).unwrap();
    assert_eq!(fs::read_to_string(&victim).unwrap(), "precious");
    assert!(fs::symlink_metadata(folder.path()).unwrap().is_file());
}

#[test]
fn folder_that_others_can_write_is_refused() {
    let folder = Folder::new("shared");
    fs::set_permissions(&folder.0, fs::Permissions::from_mode(0o777)).unwrap();
    let refused = Journal::create(&folder.path(), &small());
    assert!(matches!(refused, Err(CreateJournalError::Folder { .. })), "{refused:?}");
    // With the sticky bit, only the owner of a file replaces it.
    fs::set_permissions(&folder.0, fs::Permissions::from_mode(0o1777)).unwrap();
    Journal::create(&folder.path(), &small()).unwrap();
}

#[test]
fn file_that_is_replaced_is_kept_on_request() {
    let folder = Folder::new("previous");
    let first = Journal::create(&folder.path(), &small()).unwrap();
    first.write(KEY, 1, &[b"last words"]);
    drop(first);
    let options = Options { keeps_previous: true, ..small() };
    let _second = Journal::create(&folder.path(), &options).unwrap();
    let previous = folder.0.join("knee.journal.previous");
    assert_eq!(numbers(&mut JournalReader::open(&previous, Start::Oldest).unwrap()).unwrap(), [1]);
    assert_eq!(numbers(&mut JournalReader::open(&folder.path(), Start::Oldest).unwrap()).unwrap(), [0; 0]);
}

#[test]
fn sizes_out_of_range_are_refused() {
    let folder = Folder::new("sizes");
    for ring_bytes in [0, 65_535, (1 << 32) + 1, u64::MAX] {
        let refused = Journal::create(&folder.path(), &Options { ring_bytes, ..small() });
        assert!(matches!(refused, Err(CreateJournalError::Size(bytes)) if bytes == ring_bytes));
    }
    let identity = [0; 1025];
    let refused = Journal::create(&folder.path(), &Options { identity: &identity, ..small() });
    assert!(matches!(refused, Err(CreateJournalError::Identity(1025))));
    assert!(!folder.path().exists());
}

#[test]
fn payload_too_long_is_counted_and_not_written() {
    let folder = Folder::new("long");
    let journal = Journal::create(&folder.path(), &small()).unwrap();
    let long = vec![1; journal.payload_max() + 1];
    assert!(journal.write(KEY, 1, &[b"short"]));
    assert!(!journal.write(KEY, 2, &[&long]));
    assert!(journal.write(KEY, 3, &[&long[1..]]));
    journal.count(KEY, 10);
    let mut reader = JournalReader::open(&folder.path(), Start::Oldest).unwrap();
    assert_eq!(numbers(&mut reader).unwrap(), [1, 3]);
    let channels = reader.channels().unwrap();
    let [channel] = channels[..] else { panic!("{channels:?}") };
    assert_eq!((channel.key, channel.seen), (Some(KEY), 13));
    assert_eq!((channel.tally.missed(), channel.seen - channel.tally.last), (1, 10));
}

#[test]
fn parts_of_every_length_are_joined() {
    let folder = Folder::new("parts");
    let journal = Journal::create(&folder.path(), &small()).unwrap();
    let mut reader = JournalReader::open(&folder.path(), Start::Newest).unwrap();
    let bytes: Vec<u8> = (0..64).collect();
    let mut payload = Vec::new();
    // More than the ring: records continue at its start.
    for (one, two) in (0..2_000).map(|n| (n % 23, n % 41)) {
        journal.write(KEY, 0, &[&bytes[..one], &[], &bytes[one..two.max(one)], &bytes[two.max(one)..]]);
        reader.next(0, &mut payload).unwrap().unwrap();
        assert_eq!(payload, bytes);
    }
}

#[test]
fn copied_span_keeps_times_and_numbers() {
    let folder = Folder::new("copy");
    let target = folder.0.join("knee.frozen");
    let journal = Journal::create(&folder.path(), &small()).unwrap();
    let other = ChannelKey([1, 1, 1]);
    for time in 1..=100 {
        journal.write(KEY, time, &[&[7; 10]]);
        journal.write(other, time, &[&[8; 300]]);
    }
    let copied = copy_span(&folder.path(), &target, &(40..=59)).unwrap();
    assert_eq!(copied, Copied { records: 40, ring_bytes: 64 * 1024, first: 40, last: 59 });
    assert_eq!(fs::metadata(&target).unwrap().permissions().mode() & 0o777, 0o600);
    let mut reader = JournalReader::open(&target, Start::Oldest).unwrap();
    assert_eq!((reader.identity(), reader.wall_offset().unwrap()), (&b"the knee"[..], -3));
    assert!(!reader.is_writer_alive() && reader.is_closed().unwrap());
    let (mut payload, mut found) = (Vec::new(), Vec::new());
    while let Some(record) = reader.next(0, &mut payload).unwrap() {
        assert_eq!(record.number, record.time);
        found.push((record.time, payload.len()));
    }
    let expected: Vec<_> = (40..=59).flat_map(|time| [(time, 10), (time, 300)]).collect();
    assert_eq!(found, expected);
    let keys: Vec<_> = reader.channels().unwrap().into_iter().filter_map(|channel| channel.key).collect();
    assert!(keys.contains(&KEY) && keys.contains(&other), "{keys:?}");
    // And: overwritten records are left out
    let records: u64 = (0..1_000).map(|_| u64::from(journal.write(KEY, 200, &[&[9; 300]]))).sum();
    assert_eq!(copy_span(&folder.path(), &target, &(1..=100)).unwrap().records, 0);
    assert_eq!(records, 1_000);
}

#[test]
fn joined_copy_has_the_lost_records_of_former_ones() {
    let folder = Folder::new("joined");
    let [first, second, target] = ["first", "second", "third"].map(|name| folder.0.join(name));
    let journal = Journal::create(&folder.path(), &small()).unwrap();
    let write = |times: std::ops::RangeInclusive<u64>| {
        for time in times {
            assert!(journal.write(KEY, time, &[&[7; 300]]));
        }
    };
    write(1..=20);
    copy_span(&folder.path(), &first, &(5..=20)).unwrap();
    write(21..=30);
    copy_span(&folder.path(), &second, &(15..=30)).unwrap();
    // The ring loses all of these.
    write(31..=1_000);
    let former = [first, folder.0.join("absent"), second];
    let copied = copy_joined(&former, &folder.path(), &target, &(8..=995)).unwrap();
    let mut reader = JournalReader::open(&target, Start::Oldest).unwrap();
    let (mut payload, mut found) = (Vec::new(), Vec::new());
    while let Some(record) = reader.next(0, &mut payload).unwrap() {
        assert_eq!((record.number, payload.len()), (record.time, 300));
        found.push(record.time);
    }
    assert_eq!(copied.records, found.len() as u64);
    assert_eq!(found[..23], (8..=30).collect::<Vec<_>>()[..], "each once, in their order");
    let rest: Vec<_> = (found[23]..=995).collect();
    assert!(found[23] > 31 && found[23..] == rest[..]);
}

#[test]
fn former_copy_is_preferred_to_the_source() {
    let folder = Folder::new("preferred");
    let [first, second, other, target] =
        ["first", "second", "other", "third"].map(|name| folder.0.join(name));
    let write = |journal: &Journal, payload: &[u8]| {
        (1..=30).for_each(|time| assert!(journal.write(KEY, time, &[payload])));
    };
    // Given: another payload in the former copies than in the source, which has all records
    write(&Journal::create(&other, &small()).unwrap(), b"former");
    copy_span(&other, &first, &(5..=10)).unwrap();
    copy_span(&other, &second, &(20..=25)).unwrap();
    let journal = Journal::create(&folder.path(), &small()).unwrap();
    write(&journal, b"source");
    // When
    let copied = copy_joined(&[second, first], &folder.path(), &target, &(3..=28)).unwrap();
    // Then
    let mut reader = JournalReader::open(&target, Start::Oldest).unwrap();
    let (mut payload, mut found) = (Vec::new(), Vec::new());
    while let Some(record) = reader.next(0, &mut payload).unwrap() {
        let is_former = (5..=10).contains(&record.time) || (20..=25).contains(&record.time);
        assert_eq!(payload, if is_former { b"former" } else { b"source" }, "{}", record.time);
        found.push(record.time);
    }
    assert_eq!(found, (3..=28).collect::<Vec<_>>(), "each once, in their order");
    assert_eq!((copied.records, copied.first, copied.last), (26, 3, 28));
}

#[test]
fn longest_record_has_room_in_a_copy() {
    let folder = Folder::new("longest");
    let target = folder.0.join("knee.frozen");
    let options = Options { ring_bytes: 1 << 20, ..small() };
    let journal = Journal::create(&folder.path(), &options).unwrap();
    assert!(journal.write(KEY, 1, &[&vec![7; journal.payload_max()]]));
    assert_eq!(copy_span(&folder.path(), &target, &(0..=1)).unwrap().records, 1);
    assert!(copy_span(&target.with_extension("absent"), &target, &(0..=1)).is_err());
}

#[test]
fn cut_file_is_an_error_and_no_signal() {
    let folder = Folder::new("cut");
    let journal = Journal::create(&folder.path(), &small()).unwrap();
    journal.write(KEY, 1, &[b"gone"]);
    drop(journal);
    let mut reader = JournalReader::open(&folder.path(), Start::Oldest).unwrap();
    let file = OpenOptions::new().write(true).open(folder.path()).unwrap();
    file.set_len(TABLE_AT as u64 + 100).unwrap();
    assert!(matches!(numbers(&mut reader), Err(ReadJournalError::Length { .. })));
    assert!(matches!(reader.channels(), Err(ReadJournalError::Length { .. })));
    let again = JournalReader::open(&folder.path(), Start::Oldest);
    assert!(matches!(again, Err(ReadJournalError::Length { .. })));
    file.set_len(10).unwrap();
    assert!(JournalReader::open(&folder.path(), Start::Oldest).is_err());
}

#[test]
fn changed_first_page_is_refused() {
    let folder = Folder::new("page");
    drop(Journal::create(&folder.path(), &small()).unwrap());
    let file = OpenOptions::new().read(true).write(true).open(folder.path()).unwrap();
    for (at, why) in [
        (0, JournalHeaderError::Magic),
        (8, JournalHeaderError::Version(0)),
        (16, JournalHeaderError::Checksum),
        (130, JournalHeaderError::Checksum),
    ] {
        let mut before = [0];
        file.read_exact_at(&mut before, at).unwrap();
        file.write_all_at(&[before[0] ^ 1], at).unwrap();
        let Err(ReadJournalError::Header { why: found, .. }) =
            JournalReader::open(&folder.path(), Start::Oldest)
        else {
            panic!("byte {at} is wrong")
        };
        assert_eq!(found, why);
        file.write_all_at(&before, at).unwrap();
    }
    JournalReader::open(&folder.path(), Start::Oldest).unwrap();
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 60, failure_persistence: None, ..ProptestConfig::default() })]

    /// Any bytes of a file may be others: the result is records, nothing or an error.
    #[test]
    fn any_file_is_read_or_refused(
        changes in proptest::collection::vec((any::<u32>(), any::<[u8; 8]>(), 0..4_u8), 1..40),
    ) {
        let folder = Folder::new(&format!("any-{}", changes.len()));
        let journal = Journal::create(&folder.path(), &small()).unwrap();
        for number in 0..600_u16 {
            journal.write(ChannelKey([u64::from(number % 5), 0, 0]), 0, &[&[7; 300][..usize::from(number) % 300]]);
        }
        drop(journal);
        let file = OpenOptions::new().write(true).open(folder.path()).unwrap();
        for (at, bytes, part) in changes {
            let at = u64::from(at);
            let at = match part {
                0 => at % HEADER_BYTES as u64,
                1 => TABLE_AT as u64 + at % TABLE_BYTES as u64,
                2 => 2048,
                _ => RING_AT as u64 + at % (64 * 1024 - 8),
            };
            file.write_all_at(&bytes, at).unwrap();
            let Ok(mut reader) = JournalReader::open(&folder.path(), Start::Oldest) else { continue };
            let read = numbers(&mut reader);
            prop_assert!(read.map_or(0, |numbers| numbers.len()) <= 64 * 1024 / 64);
            reader.channels().unwrap();
        }
    }
}

/// Sets the flag when it is dropped.
struct SetOnDrop<'a>(&'a AtomicBool);

impl Drop for SetOnDrop<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

#[test]
fn copy_survives_a_target_that_is_cut() {
    let folder = Folder::new("cut-copy");
    let target = folder.0.join("knee.frozen");
    let options = Options { ring_bytes: 1 << 20, ..small() };
    let journal = Journal::create(&folder.path(), &options).unwrap();
    (0..1_000).for_each(|time| assert!(journal.write(KEY, time, &[&[7; 900]])));
    let is_over = AtomicBool::new(false);
    std::thread::scope(|scope| {
        scope.spawn(|| {
            while !is_over.load(Ordering::Relaxed) {
                for file in fs::read_dir(&folder.0).unwrap() {
                    let path = file.unwrap().path();
                    // As a disk that loses its blocks: an access through a mapping ends the process.
                    if path.to_string_lossy().contains("knee.frozen")
                        && let Ok(file) = OpenOptions::new().write(true).open(path)
                    {
                        file.set_len(0).unwrap();
                    }
                }
            }
        });
        // Also after a panic: otherwise the scope would never end.
        let over = SetOnDrop(&is_over);
        let copied: Vec<_> = (0..30).map(|_| copy_span(&folder.path(), &target, &(0..=1_000))).collect();
        drop(over);
        assert!(copied.iter().all(Result::is_ok), "{copied:?}");
    });
}

#[test]
fn failed_copy_leaves_no_file() {
    let folder = Folder::new("failed-copy");
    let target = folder.0.join("knee.frozen");
    let fails = |_: &platform::NewFile<'_>| Err(CreateJournalError::Size(0).into());
    assert!(platform::write_file(&target, fails).is_err());
    assert_eq!(fs::read_dir(&folder.0).unwrap().count(), 0);
}
