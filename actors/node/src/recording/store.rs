//! The files of frozen spans: `sinew-PROJECT-NODE-ID.frozen`, a journal, and `.facts` beside it, which is written last.

use std::{
    collections::BTreeSet,
    fs::{self, File, OpenOptions},
    io::{self, Read as _, Write as _},
    os::unix::fs::{FileExt as _, MetadataExt as _, OpenOptionsExt as _},
    path::{Path, PathBuf},
};

use sinew_runtime::wire;
use sinew_shm::journal::{CopyJournalError, JournalReader, Start, copy_span};

use crate::inspect::{FROZEN_SPANS_MAX, FrozenFacts, FrozenPart, FrozenSpan};

/// Maximum bytes of a file with facts. A longer one is not read.
const FACTS_BYTES_MAX: u64 = 4 << 20;
/// Maximum number of files of a folder that are looked at.
const FILES_MAX: usize = 65_536;

/// The frozen spans of one node.
#[derive(Debug)]
pub(crate) struct FrozenStore {
    folder: PathBuf,
    /// Begin of the names of its files, without the last `-`.
    base: String,
    spans_max: usize,
    /// The spans that were fetched since the node's start.
    fetched: BTreeSet<String>,
}

/// Why a span was not frozen, or cannot be read.
#[derive(Debug, thiserror::Error)]
pub(crate) enum FrozenError {
    /// There is no room.
    #[error(
        "there is no room for the span {id}: {max} are kept until they are fetched; run `sinew record fetch`, or raise record.frozen_max"
    )]
    Full { id: String, max: usize },
    /// The span cannot be copied.
    #[error("the span {id} cannot be frozen: {cause}")]
    Copy { id: String, cause: CopyJournalError },
    /// The file with facts cannot be written.
    #[error("the span {id} cannot be frozen: its facts cannot be written: {cause}")]
    Facts { id: String, cause: io::Error },
    /// There is no such span.
    #[error("there is no frozen span {0}; `sinew record fetch` lists them")]
    Unknown(String),
    /// A file cannot be read.
    #[error("the frozen span {id} cannot be read: {cause}")]
    Read { id: String, cause: io::Error },
}

impl FrozenStore {
    pub(crate) const fn new(folder: PathBuf, base: String, spans_max: usize) -> Self {
        Self { folder, base, spans_max, fetched: BTreeSet::new() }
    }

    /// Removes journals without facts, and files without their name: their node was killed while it made them.
    pub(crate) fn clean(&self) {
        for name in self.names_after(&format!(".{}-", self.base), "") {
            // It stays if the folder refuses that.
            let _ = fs::remove_file(self.folder.join(name));
        }
        for name in self.names(".frozen") {
            let ring = self.folder.join(&name);
            if !ring.with_extension("facts").exists() {
                // It stays if the folder refuses that.
                let _ = fs::remove_file(ring);
            }
        }
    }

    /// Returns the frozen spans, at most as many as one answer has.
    pub(crate) fn spans(&self) -> Vec<FrozenSpan> {
        let names = self.names(".facts").into_iter().take(FROZEN_SPANS_MAX);
        let mut spans: Vec<_> = names.filter_map(|name| self.span(&name)).collect();
        spans.sort_by_key(|span| (span.at_ns, span.end_ns));
        spans
    }

    /// Copies a span of the journal.
    pub(crate) fn freeze(
        &self,
        journal: &Path,
        span: &FrozenSpan,
        facts: &FrozenFacts,
    ) -> Result<u64, FrozenError> {
        let id = || span.id.clone();
        let ring = self.path(&span.id, "frozen");
        let copied = copy_span(journal, &ring, &(span.begin_ns..=span.end_ns))
            .map_err(|cause| FrozenError::Copy { id: id(), cause })?;
        self.announce(&span.id, facts)?;
        Ok(copied.records)
    }

    /// Keeps the ring of a former incarnation that has died, if there is one at `journal`. Returns its ID.
    pub(crate) fn keep_dead_ring(&mut self, journal: &Path) -> Option<Result<String, FrozenError>> {
        let reader = JournalReader::open(journal, Start::Newest).ok()?;
        if !is_own(journal) || reader.is_writer_alive() || reader.is_closed().unwrap_or(true) {
            return None;
        }
        let facts = journal.with_extension("facts");
        let mut facts = read_facts(&facts).unwrap_or_default();
        let incarnation = facts.report.incarnation.map_or_else(|| reader.created(), |number| number.0);
        let id = format!("died-{incarnation:x}");
        let span = FrozenSpan {
            id: id.clone(),
            cause: "the node has died".to_owned(),
            bound_ns: u64::MAX,
            end_ns: u64::MAX,
            has_died: true,
            ..FrozenSpan::default()
        };
        if let Err(why) = self.make_room(&id) {
            return Some(Err(why));
        }
        facts.span = Some(span);
        let ring = self.path(&id, "frozen");
        // Another file system refuses the new name.
        let kept =
            fs::rename(journal, &ring).or_else(|_| copy_span(journal, &ring, &(0..=u64::MAX)).map(drop));
        let kept = kept.map_err(|cause| FrozenError::Copy { id: id.clone(), cause });
        Some(kept.and_then(|()| self.announce(&id, &facts)).map(|()| id))
    }

    /// Makes room for one more span: the oldest fetched one is removed if there are as many as may.
    pub(crate) fn make_room(&mut self, id: &str) -> Result<(), FrozenError> {
        let spans = self.spans();
        if spans.len() < self.spans_max {
            return Ok(());
        }
        match spans.iter().find(|span| span.is_fetched) {
            Some(span) if spans.len() == self.spans_max && self.spans_max > 0 => {
                self.discard(&span.id);
                Ok(())
            }
            Some(_) | None => Err(FrozenError::Full { id: id.to_owned(), max: self.spans_max }),
        }
    }

    /// Removes a span.
    pub(crate) fn discard(&mut self, id: &str) {
        self.fetched.remove(id);
        for extension in ["facts", "frozen"] {
            // It stays if the folder refuses that, or there is none.
            let _ = fs::remove_file(self.path(id, extension));
        }
    }

    /// Notes that a span was fetched.
    pub(crate) fn set_fetched(&mut self, id: &str) -> Result<(), FrozenError> {
        if !self.spans().iter().any(|span| span.id == id) {
            return Err(FrozenError::Unknown(id.to_owned()));
        }
        self.fetched.insert(id.to_owned());
        Ok(())
    }

    /// Returns bytes of a file from this offset, and the length of the file.
    pub(crate) fn read(
        &self,
        id: &str,
        part: FrozenPart,
        offset: u64,
        bytes_max: usize,
    ) -> Result<(Vec<u8>, u64), FrozenError> {
        // The ID is one of a name in the folder, and so has no path in it.
        if !self.names(".facts").contains(&format!("{}-{id}.facts", self.base)) {
            return Err(FrozenError::Unknown(id.to_owned()));
        }
        let extension = match part {
            FrozenPart::Facts => "facts",
            FrozenPart::Ring => "frozen",
        };
        let read = || {
            let file = open(&self.path(id, extension))?;
            let length = file.metadata()?.len();
            let rest = length.saturating_sub(offset).min(bytes_max as u64);
            let mut bytes = vec![0; usize::try_from(rest).unwrap_or(bytes_max)];
            file.read_exact_at(&mut bytes, offset)?;
            Ok((bytes, length))
        };
        read().map_err(|cause| FrozenError::Read { id: id.to_owned(), cause })
    }

    fn announce(&self, id: &str, facts: &FrozenFacts) -> Result<(), FrozenError> {
        write_facts(&self.path(id, "facts"), facts)
            .map_err(|cause| FrozenError::Facts { id: id.to_owned(), cause })
    }

    fn path(&self, id: &str, extension: &str) -> PathBuf {
        self.folder.join(format!("{}-{id}.{extension}", self.base))
    }

    /// Returns the names of this node's files with such an end.
    fn names(&self, end: &str) -> BTreeSet<String> {
        self.names_after(&format!("{}-", self.base), end)
    }

    fn names_after(&self, begin: &str, end: &str) -> BTreeSet<String> {
        let Ok(files) = fs::read_dir(&self.folder) else { return BTreeSet::new() };
        files
            .take(FILES_MAX)
            .filter_map(|file| file.ok()?.file_name().into_string().ok())
            .filter(|name| name.starts_with(begin) && name.ends_with(end))
            .collect()
    }

    /// Returns the span with facts in this file, if it has its journal.
    fn span(&self, name: &str) -> Option<FrozenSpan> {
        let path = self.folder.join(name);
        let span = read_facts(&path).ok()?.span?;
        let ring = path.with_extension("frozen");
        if name != format!("{}-{}.facts", self.base, span.id) || !is_own(&ring) {
            return None;
        }
        let (bytes, is_fetched) = (ring.symlink_metadata().ok()?.len(), self.fetched.contains(&span.id));
        Some(FrozenSpan { bytes, is_fetched, ..span })
    }
}

/// Returns whether it is an ordinary file of this user: another one may write into `/dev/shm`, too.
fn is_own(path: &Path) -> bool {
    let own = rustix::process::geteuid().as_raw();
    path.symlink_metadata().is_ok_and(|metadata| metadata.is_file() && metadata.uid() == own)
}

fn open(path: &Path) -> io::Result<File> {
    if !is_own(path) {
        return Err(io::Error::new(io::ErrorKind::PermissionDenied, "it is no file of this user"));
    }
    File::open(path)
}

/// Writes facts beside a journal, for this user alone. A former file is replaced at once.
pub(crate) fn write_facts(path: &Path, facts: &FrozenFacts) -> io::Result<()> {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let temporary = path.with_file_name(format!(".{name}.{}", std::process::id()));
    let create = || OpenOptions::new().write(true).create_new(true).mode(0o600).open(&temporary);
    let mut file = match create() {
        // A process with this number has died before the file had its name.
        Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {
            fs::remove_file(&temporary).and_then(|()| create())
        }
        other => other,
    }?;
    let written = file.write_all(&wire::encode(facts)).and_then(|()| fs::rename(&temporary, path));
    written.inspect_err(|_| {
        // The first error is the one to report.
        let _ = fs::remove_file(&temporary);
    })
}

/// Reads facts beside a journal.
pub(crate) fn read_facts(path: &Path) -> io::Result<FrozenFacts> {
    let mut bytes = Vec::new();
    open(path)?.take(FACTS_BYTES_MAX).read_to_end(&mut bytes)?;
    wire::decode(&bytes).map_err(|why| io::Error::new(io::ErrorKind::InvalidData, why.to_string()))
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt as _;

    use sinew_shm::journal::{ChannelKey, Journal, Options};

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
        FrozenSpan {
            id: id.to_owned(),
            at_ns: begin_ns,
            begin_ns,
            end_ns: begin_ns + 2,
            ..FrozenSpan::default()
        }
    }

    fn freeze(store: &mut FrozenStore, journal: &Journal, of: &FrozenSpan) -> Result<u64, FrozenError> {
        store.make_room(&of.id)?;
        let facts = FrozenFacts { span: Some(of.clone()), ..FrozenFacts::default() };
        store.freeze(journal.path(), of, &facts)
    }

    #[test]
    fn oldest_spans_stay_until_they_are_fetched() {
        let folder = Folder::new("oldest");
        let (mut store, journal) = (folder.store(2), folder.journal());
        assert_eq!(freeze(&mut store, &journal, &span("a-1", 2)).unwrap(), 3);
        assert_eq!(freeze(&mut store, &journal, &span("a-2", 4)).unwrap(), 3);
        let full = freeze(&mut store, &journal, &span("a-3", 6)).unwrap_err();
        assert!(full.to_string().contains("sinew record fetch"), "{full}");
        store.set_fetched("a-1").unwrap();
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
    fn ring_of_a_dead_node_is_kept_and_a_closed_one_is_not() {
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
        assert!(!without_name.exists());
        assert!(!store.path("a-2", "frozen").exists() && store.path("a-1", "frozen").exists());
        assert_eq!(store.spans().len(), 1);
    }
}
