//! The files of frozen spans: `sinew-PROJECT-NODE-ID.frozen`, a journal, and `.facts` beside it, which is written last.

use std::{
    collections::BTreeSet,
    fs::{self, OpenOptions},
    io::{self, Write as _},
    os::unix::fs::{FileExt as _, OpenOptionsExt as _},
    path::{Path, PathBuf},
    sync::Mutex,
};

use sinew_runtime::{lock, log, wire};
use sinew_shm::journal::{CopyJournalError, JournalReader, Start, copy_joined};

use sinew_record::{
    FROZEN_SPANS_MAX, FrozenFacts, FrozenPart, FrozenSpan,
    files::{self, Owners, open_own},
};

/// Maximum number of files of a folder that are looked at.
const FILES_MAX: usize = 65_536;

/// The frozen spans of one node.
#[derive(Debug)]
pub(crate) struct FrozenStore {
    folder: PathBuf,
    /// Begin of the names of its files, without the last `-`.
    base: String,
    spans_max: usize,
    /// The fetched spans with facts that could not be written: a full disk must get room again.
    fetched: BTreeSet<String>,
}

/// The copy of a span, until the store has it. It is made without the store: that takes as long as the disk does.
#[derive(Debug)]
pub(crate) struct Draft {
    /// The ring of the copy.
    target: PathBuf,
    /// The rings of the spans that it replaces, in the order of their times.
    former: Vec<PathBuf>,
}

impl Draft {
    /// Copies the span of the journal, with the records that the journal has lost and the replaced spans still have.
    /// Returns the number of records.
    pub(crate) fn copy(&self, journal: &Path, span: &FrozenSpan) -> Result<u64, FrozenError> {
        let times = span.begin_ns..=span.end_ns;
        let copied = copy_joined(&self.former, journal, &self.target, &times);
        let failed = |cause| FrozenError::Copy { id: span.id.clone(), cause };
        copied.map(|copied| copied.records).map_err(failed)
    }
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
    /// The files of the span cannot be written or renamed.
    #[error("the span {id} cannot be frozen: its files cannot be written: {cause}")]
    Files { id: String, cause: io::Error },
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

    /// Removes journals without facts, facts without a journal, copies that no span has, and files without their name:
    /// their node was killed while it made them.
    pub(crate) fn clean(&self) {
        let drafts = self.names(".draft");
        for name in drafts.into_iter().chain(self.names_after(&format!(".{}-", self.base), "")) {
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
        for name in self.names(".facts") {
            let facts = self.folder.join(&name);
            if !facts.with_extension("frozen").exists() {
                // It stays if the folder refuses that.
                let _ = fs::remove_file(facts);
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

    /// Makes room for the copy of a span, which replaces others. Those stay until the copy is there.
    pub(crate) fn draft(&mut self, id: &str, replaces: &[String]) -> Result<Draft, FrozenError> {
        self.make_room(id, replaces)?;
        let spans = self.spans().into_iter().filter(|span| replaces.contains(&span.id));
        let former = spans.map(|span| self.path(&span.id, "frozen")).collect();
        Ok(Draft { target: self.path(id, "draft"), former })
    }

    /// Takes the copy of a span, and removes the spans that it replaces.
    pub(crate) fn keep(&mut self, facts: &FrozenFacts, replaces: &[String]) -> Result<(), FrozenError> {
        let id = facts.span.as_ref().map(|span| span.id.clone()).unwrap_or_default();
        let ring = self.path(&id, "frozen");
        let failed = |cause| FrozenError::Files { id: id.clone(), cause };
        // The facts first: without its ring a span does not count, and a ring without facts is removed.
        let draft = self.path(&id, "draft");
        let renamed = || fs::rename(&draft, &ring).map_err(failed);
        let kept = self.announce(&id, facts).and_then(|()| renamed());
        // It is there only after an error.
        let _ = fs::remove_file(&draft);
        kept?;
        self.fetched.remove(&id);
        replaces.iter().filter(|former| **former != id).for_each(|former| self.discard(former));
        Ok(())
    }

    /// Keeps the ring of a former incarnation that has died, if there is one at `journal`. Returns its ID.
    ///
    /// It copies nothing, because the node waits. Where the folder is of another file system, the ring gets its new
    /// name beside the journal: [`beside`](Self::beside).
    pub(crate) fn keep_dead_ring(&mut self, journal: &Path) -> Option<Result<String, FrozenError>> {
        // Nothing of another user's file is read.
        let reader = is_own(journal).then(|| JournalReader::open(journal, Start::Newest).ok())??;
        if reader.is_writer_alive() || reader.is_closed().unwrap_or(true) {
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
        if let Err(why) = self.make_room(&id, &[]) {
            return Some(Err(why));
        }
        facts.span = Some(span);
        let beside = Self::new(folder_of(journal), self.base.clone(), self.spans_max);
        let kept = self.adopt(journal, &id, &facts).or_else(|why| {
            if beside.folder == self.folder {
                return Err(why);
            }
            // This folder may be absent or full for long, and that of the journal is memory.
            beside.discard_dead(&id, self.spans_max.saturating_sub(self.spans().len()).max(1));
            beside.adopt(journal, &id, &facts)
        });
        Some(kept.map(|()| id))
    }

    /// Removes the oldest rings of dead incarnations, so that there are at most `rings_max` with that of `id`.
    fn discard_dead(&self, id: &str, rings_max: usize) {
        let mut dead: Vec<_> = self
            .spans()
            .into_iter()
            .filter(|span| span.has_died && span.id != id)
            .map(|span| span.id)
            .collect();
        // Their facts were written last when their next incarnation started.
        let written =
            |id: &String| fs::metadata(self.path(id, "facts")).and_then(|file| file.modified()).ok();
        dead.sort_by_cached_key(written);
        let surplus = (dead.len() + 1).saturating_sub(rings_max);
        for id in &dead[..surplus.min(dead.len())] {
            log::warn!(
                id,
                "the ring of a former dead incarnation is removed from record.folder: record.frozen_folder has not taken it"
            );
            self.discard(id);
        }
    }

    /// Renames a ring to that of a span.
    fn adopt(&self, ring: &Path, id: &str, facts: &FrozenFacts) -> Result<(), FrozenError> {
        self.announce(id, facts)?;
        fs::rename(ring, self.path(id, "frozen")).map_err(|cause| {
            // The first error is the one to report.
            let _ = fs::remove_file(self.path(id, "facts"));
            FrozenError::Files { id: id.to_owned(), cause }
        })
    }

    /// Returns the store of the folder with the journal, and the rings of dead incarnations in it that have to be moved
    /// to this one.
    pub(crate) fn beside(&self, journal: &Path) -> (Self, Vec<String>) {
        let beside = Self::new(folder_of(journal), self.base.clone(), self.spans_max);
        let mut dead = Vec::new();
        if beside.folder != self.folder {
            dead.extend(beside.spans().into_iter().filter(|span| span.has_died).map(|span| span.id));
        }
        (beside, dead)
    }

    /// Returns the ring of a span, and its facts.
    pub(crate) fn files(&self, id: &str) -> Result<(PathBuf, FrozenFacts), FrozenError> {
        self.check(id)?;
        let facts = read_facts(&self.path(id, "facts"));
        let facts = facts.map_err(|cause| FrozenError::Read { id: id.to_owned(), cause })?;
        Ok((self.path(id, "frozen"), facts))
    }

    /// Makes room for one more span, in addition to those that it replaces: the oldest fetched ones are removed.
    fn make_room(&self, id: &str, replaces: &[String]) -> Result<(), FrozenError> {
        let mut spans = self.spans();
        spans.retain(|span| span.id != id && !replaces.contains(&span.id));
        let surplus = (spans.len() + 1).saturating_sub(self.spans_max);
        let fetched: Vec<_> = spans.iter().filter(|span| span.is_fetched).take(surplus).collect();
        fetched.iter().for_each(|span| self.discard(&span.id));
        if fetched.len() < surplus {
            return Err(FrozenError::Full { id: id.to_owned(), max: self.spans_max });
        }
        Ok(())
    }

    /// Returns the number of spans if there is no room for one more.
    pub(crate) fn is_full(&self) -> Option<usize> {
        let spans = self.spans();
        let is_full = spans.len() >= self.spans_max && !spans.iter().any(|span| span.is_fetched);
        is_full.then_some(spans.len())
    }

    /// Removes a span.
    pub(crate) fn discard(&self, id: &str) {
        for extension in ["facts", "frozen"] {
            // It stays if the folder refuses that, or there is none.
            let _ = fs::remove_file(self.path(id, extension));
        }
    }

    /// Notes that a span was fetched, beside its ring: the next incarnation of the node has to know it. If that cannot
    /// be written, this incarnation knows it nevertheless.
    pub(crate) fn set_fetched(&mut self, id: &str) -> Result<(), FrozenError> {
        self.check(id)?;
        let path = self.path(id, "facts");
        let mut facts = read_facts(&path).map_err(|cause| FrozenError::Read { id: id.to_owned(), cause })?;
        match &mut facts.span {
            Some(span) if !span.is_fetched => {
                span.is_fetched = true;
                let written = self.announce(id, &facts);
                if written.is_err() {
                    let present: BTreeSet<_> = self.spans().into_iter().map(|span| span.id).collect();
                    self.fetched.retain(|other| present.contains(other));
                    self.fetched.insert(id.to_owned());
                }
                written
            }
            Some(_) | None => Ok(()),
        }
    }

    /// Checks that there is such a span. An ID from outside may be any text.
    fn check(&self, id: &str) -> Result<(), FrozenError> {
        // Then it has no path in it, and names no other file.
        let is_id = !id.is_empty() && id.chars().all(|c| c.is_ascii_alphanumeric() || c == '.' || c == '-');
        if is_id && is_own(&self.path(id, "facts")) && is_own(&self.path(id, "frozen")) {
            Ok(())
        } else {
            Err(FrozenError::Unknown(id.to_owned()))
        }
    }

    /// Returns bytes of a file from this offset, and the length of the file.
    pub(crate) fn read(
        &self,
        id: &str,
        part: FrozenPart,
        offset: u64,
        bytes_max: usize,
    ) -> Result<(Vec<u8>, u64), FrozenError> {
        self.check(id)?;
        let extension = match part {
            FrozenPart::Facts => "facts",
            FrozenPart::Ring => "frozen",
        };
        let read = || {
            let file = open_own(&self.path(id, extension), Owners::ThisUser)?;
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
            .map_err(|cause| FrozenError::Files { id: id.to_owned(), cause })
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
        let is_fetched = span.is_fetched || self.fetched.contains(&span.id);
        Some(FrozenSpan { bytes: ring.symlink_metadata().ok()?.len(), is_fetched, ..span })
    }
}

/// Moves the ring of a dead incarnation to the store. It is copied without the store's lock.
pub(crate) fn move_ring(from: &FrozenStore, to: &Mutex<FrozenStore>, id: &str) -> Result<(), FrozenError> {
    let (ring, facts) = from.files(id)?;
    let draft = lock(to).draft(id, &[])?;
    let span = facts.span.clone().unwrap_or_default();
    draft.copy(&ring, &span)?;
    lock(to).keep(&facts, &[])?;
    from.discard(id);
    Ok(())
}

fn folder_of(journal: &Path) -> PathBuf {
    journal.parent().unwrap_or_else(|| Path::new(".")).to_owned()
}

fn is_own(path: &Path) -> bool {
    files::is_own(path, Owners::ThisUser)
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
    files::read_facts(path, Owners::ThisUser)
}

#[cfg(test)]
mod tests;
