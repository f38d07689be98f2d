//! Frozen spans in a folder: their room, their replacement, and files of other nodes.

use std::{
    os::unix::fs::PermissionsExt as _,
    time::{Duration, SystemTime},
};

use sinew_record::RecordReport;
use sinew_runtime::tid::Incarnation;
use sinew_shm::journal::{ChannelKey, Journal, Options, ReadJournalError, each_record};

use super::*;

struct Folder(PathBuf);

impl Folder {
    fn new(name: &str) -> Self {
        let path = std::env::temp_dir().join(format!("sinew-store-{name}-{}", std::process::id()));
        let _ = fs::remove_dir_all(&path);
        fs::create_dir_all(&path).unwrap();
        fs::set_permissions(&path, fs::Permissions::from_mode(0o700)).unwrap();
        Self(path)
    }

    fn store(&self, spans_max: usize) -> FrozenStore {
        FrozenStore::new(self.0.clone(), "sinew-leg-10.0.0.2".to_owned(), spans_max)
    }

    fn journal(&self) -> Journal {
        let path = self.0.join("sinew-leg-10.0.0.2.journal");
        let options = Options { ring_bytes: 64 * 1024, ..Options::default() };
        let journal = Journal::create(&path, &options).unwrap();
        (1..=9).for_each(|time| assert!(journal.write(ChannelKey([1, 2, 3]), time, &[b"torque"])));
        journal
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = fs::remove_dir_all(&self.0);
    }
}

fn span(id: &str, begin_ns: u64) -> FrozenSpan {
    FrozenSpan { id: id.to_owned(), at_ns: begin_ns, begin_ns, end_ns: begin_ns + 2, ..FrozenSpan::default() }
}

fn freeze(store: &mut FrozenStore, journal: &Journal, of: &FrozenSpan) -> Result<u64, FrozenError> {
    replace(store, journal, of, &[])
}

fn replace(
    store: &mut FrozenStore,
    journal: &Journal,
    of: &FrozenSpan,
    replaces: &[&str],
) -> Result<u64, FrozenError> {
    let replaces: Vec<_> = replaces.iter().map(|id| (*id).to_owned()).collect();
    let facts = FrozenFacts { span: Some(of.clone()), ..FrozenFacts::default() };
    let records = store.draft(&of.id, &replaces)?.copy(journal.path(), of)?;
    store.keep(&facts, &replaces)?;
    Ok(records)
}

fn ids(store: &FrozenStore) -> Vec<String> {
    store.spans().into_iter().map(|span| span.id).collect()
}

#[test]
fn span_is_replaced_without_room_for_two() {
    let folder = Folder::new("replaced");
    let (mut store, journal) = (folder.store(1), folder.journal());
    freeze(&mut store, &journal, &span("a-2", 2)).unwrap();
    assert_eq!(replace(&mut store, &journal, &span("a-1", 3), &["a-2"]).unwrap(), 3);
    assert_eq!(ids(&store), ["a-1"]);
    // And: the same one with other times
    let longer = FrozenSpan { end_ns: 9, ..span("a-1", 3) };
    assert_eq!(replace(&mut store, &journal, &longer, &["a-1"]).unwrap(), 7);
    assert_eq!((ids(&store), store.spans()[0].end_ns), (vec!["a-1".to_owned()], 9));
    assert!(store.names(".draft").is_empty());
}

#[test]
fn intact_span_outlives_a_late_trigger() {
    let folder = Folder::new("late");
    let (mut store, journal) = (folder.store(1), folder.journal());
    freeze(&mut store, &journal, &span("a-2", 2)).unwrap();
    // The ring loses the records of the span.
    (0..2_000).for_each(|_| assert!(journal.write(ChannelKey([1, 2, 3]), 100, &[&[0; 200]])));
    assert_eq!(replace(&mut store, &journal, &span("a-1", 3), &["a-2"]).unwrap(), 2, "3 and 4 are there");
    assert_eq!(ids(&store), ["a-1"]);
    let ring = JournalReader::open(&store.path("a-1", "frozen"), Start::Oldest).unwrap();
    let tally = ring.channels().unwrap();
    assert_eq!(tally[0].seen, 2_009, "the table is that of the journal");
}

#[test]
fn failed_replacement_leaves_the_former_span() {
    let folder = Folder::new("failed");
    let (mut store, journal) = (folder.store(1), folder.journal());
    freeze(&mut store, &journal, &span("a-2", 2)).unwrap();
    fs::remove_file(journal.path()).unwrap();
    assert!(replace(&mut store, &journal, &span("a-1", 2), &["a-2"]).is_err());
    assert_eq!(ids(&store), ["a-2"]);
}

#[test]
fn fetched_spans_are_known_after_a_restart() {
    let folder = Folder::new("restart");
    let (mut store, journal) = (folder.store(3), folder.journal());
    for id in ["a-1", "a-2", "a-3"] {
        freeze(&mut store, &journal, &span(id, 2)).unwrap();
    }
    store.set_fetched("a-1").unwrap();
    store.set_fetched("a-3").unwrap();
    // It has room for fewer now.
    let mut store = folder.store(2);
    freeze(&mut store, &journal, &span("a-4", 2)).unwrap();
    assert_eq!(ids(&store).into_iter().collect::<BTreeSet<_>>(), ["a-2", "a-4"].map(String::from).into());
}

#[test]
fn oldest_spans_stay_until_they_are_fetched() {
    let folder = Folder::new("oldest");
    let (mut store, journal) = (folder.store(2), folder.journal());
    assert_eq!(freeze(&mut store, &journal, &span("a-1", 2)).unwrap(), 3);
    assert_eq!(freeze(&mut store, &journal, &span("a-2", 4)).unwrap(), 3);
    assert_eq!(store.is_full(), Some(2));
    let full = freeze(&mut store, &journal, &span("a-3", 6)).unwrap_err();
    assert!(full.to_string().contains("sinew record fetch"), "{full}");
    store.set_fetched("a-1").unwrap();
    assert_eq!(store.is_full(), None);
    freeze(&mut store, &journal, &span("a-3", 6)).unwrap();
    let ids: Vec<_> = store.spans().into_iter().map(|span| (span.id, span.is_fetched)).collect();
    assert_eq!(ids, [("a-2".to_owned(), false), ("a-3".to_owned(), false)]);
    assert!(matches!(store.set_fetched("a-1"), Err(FrozenError::Unknown(_))));
}

#[test]
fn file_is_read_in_parts_of_any_size() {
    let folder = Folder::new("parts");
    let (mut store, journal) = (folder.store(2), folder.journal());
    freeze(&mut store, &journal, &span("a-1", 2)).unwrap();
    let ring = fs::read(store.path("a-1", "frozen")).unwrap();
    let (mut bytes, mut offset) = (Vec::new(), 0);
    loop {
        let (part, length) = store.read("a-1", FrozenPart::Ring, offset, 10_000).unwrap();
        assert_eq!(length, ring.len() as u64);
        if part.is_empty() {
            break;
        }
        offset += part.len() as u64;
        bytes.extend(part);
    }
    assert!(bytes == ring);
    for wrong in ["a-2", "../a-1", "", "a-1.facts"] {
        let refused = store.read(wrong, FrozenPart::Ring, 0, 10);
        assert!(matches!(refused, Err(FrozenError::Unknown(_))), "{wrong}");
    }
    assert!(store.read("a-1", FrozenPart::Ring, u64::MAX, 10).unwrap().0.is_empty());
}

#[test]
fn ring_of_dead_node_is_kept_unless_closed() {
    let folder = Folder::new("dead");
    let mut store = folder.store(2);
    let journal = folder.journal();
    assert!(store.keep_dead_ring(journal.path()).is_none(), "its writer lives");
    let path = journal.path().to_owned();
    let bytes = fs::read(&path).unwrap();
    drop(journal);
    assert!(store.keep_dead_ring(&path).is_none(), "it was closed");
    // As SIGKILL leaves it: without the mark of the end.
    fs::write(&path, bytes).unwrap();
    let id = store.keep_dead_ring(&path).expect("it is there").unwrap();
    let spans = store.spans();
    assert!(spans.len() == 1 && spans[0].has_died && spans[0].id == id, "{spans:?}");
    assert!(!path.exists() && store.keep_dead_ring(&path).is_none());
}

#[test]
fn half_made_files_are_removed() {
    let folder = Folder::new("half");
    let mut store = folder.store(2);
    freeze(&mut store, &folder.journal(), &span("a-1", 2)).unwrap();
    fs::write(store.path("a-2", "frozen"), b"half").unwrap();
    fs::write(store.path("a-3", "facts"), b"\xc1").unwrap();
    let without_name = folder.0.join(".sinew-leg-10.0.0.2-a-4.frozen.77.0");
    fs::write(&without_name, b"half").unwrap();
    store.clean();
    assert!(!without_name.exists() && !store.path("a-3", "facts").exists());
    assert!(!store.path("a-2", "frozen").exists() && store.path("a-1", "frozen").exists());
    assert_eq!(store.spans().len(), 1);
}

#[test]
fn ring_of_a_dead_node_waits_beside_the_journal() {
    let folder = Folder::new("beside");
    let disk = folder.0.join("disk");
    let journal = folder.journal();
    let (path, bytes) = (journal.path().to_owned(), fs::read(journal.path()).unwrap());
    drop(journal);
    fs::write(&path, bytes).unwrap();
    // The folder refuses the new name, as one of another file system does.
    let mut store = FrozenStore::new(disk.clone(), "sinew-leg-10.0.0.2".to_owned(), 1);
    let id = store.keep_dead_ring(&path).expect("it is there").unwrap();
    assert!(!path.exists() && store.spans().is_empty());
    let (beside, dead) = store.beside(&path);
    assert_eq!(dead, std::slice::from_ref(&id));
    // And: another thread moves it
    fs::create_dir(&disk).unwrap();
    fs::set_permissions(&disk, fs::Permissions::from_mode(0o700)).unwrap();
    let store = Mutex::new(store);
    move_ring(&beside, &store, &id).unwrap();
    let spans = store.lock().unwrap().spans();
    assert!(spans.len() == 1 && spans[0].has_died && spans[0].id == id, "{spans:?}");
    assert!(store.lock().unwrap().beside(&path).1.is_empty());
    let (moved, mut records) = (disk.join(format!("sinew-leg-10.0.0.2-{id}.frozen")), 0);
    let count = each_record::<ReadJournalError>(&moved, &(0..=9), |_, _| {
        records += 1;
        Ok(())
    });
    assert!(count.is_ok() && records == 9, "{count:?}: {records}");
}

#[test]
fn fetched_span_gives_its_place_without_a_written_mark() {
    let folder = Folder::new("unwritten");
    let (mut store, journal) = (folder.store(1), folder.journal());
    freeze(&mut store, &journal, &span("a-1", 2)).unwrap();
    // A folder in place of the temporary file, as a full disk: the facts cannot be written.
    let temporary = folder.0.join(format!(".sinew-leg-10.0.0.2-a-1.facts.{}", std::process::id()));
    fs::create_dir(&temporary).unwrap();
    assert!(store.set_fetched("a-1").is_err());
    assert!(store.spans()[0].is_fetched);
    fs::remove_dir(&temporary).unwrap();
    freeze(&mut store, &journal, &span("a-2", 4)).unwrap();
    assert_eq!(ids(&store), ["a-2"]);
}

#[test]
fn failed_facts_leave_no_draft() {
    let folder = Folder::new("no-draft");
    let (mut store, journal) = (folder.store(1), folder.journal());
    let temporary = folder.0.join(format!(".sinew-leg-10.0.0.2-a-1.facts.{}", std::process::id()));
    fs::create_dir(temporary).unwrap();
    assert!(freeze(&mut store, &journal, &span("a-1", 2)).is_err());
    assert!(store.names(".draft").is_empty() && ids(&store).is_empty());
}

#[test]
fn rings_beside_the_journal_are_bounded() {
    let folder = Folder::new("bounded");
    let mut store = FrozenStore::new(folder.0.join("absent"), "sinew-leg-10.0.0.2".to_owned(), 2);
    let mut kept = Vec::new();
    let mut path = PathBuf::new();
    for incarnation in 1..=4 {
        let journal = folder.journal();
        path = journal.path().to_owned();
        let bytes = fs::read(&path).unwrap();
        drop(journal);
        fs::write(&path, bytes).unwrap();
        let report = RecordReport { incarnation: Some(Incarnation(incarnation)), ..RecordReport::default() };
        write_facts(&path.with_extension("facts"), &FrozenFacts { span: None, report }).unwrap();
        let id = store.keep_dead_ring(&path).expect("it is there").unwrap();
        // The times of files are coarse.
        let written = SystemTime::UNIX_EPOCH + Duration::from_secs(1_000 + incarnation);
        let facts = fs::File::options().write(true).open(folder.store(2).path(&id, "facts")).unwrap();
        facts.set_modified(written).unwrap();
        kept.push(id);
    }
    let (_, dead) = store.beside(&path);
    assert_eq!(dead, kept[2..]);
}
