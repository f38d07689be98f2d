//! The flight recorder of a walk: the spans that its nodes froze around faults, as files.
//!
//! Each node has its journal in a folder in memory, and copies the span of a fault into the run folder. Here these
//! copies become MCAP files, after the nodes have ended. A killed node has not copied anything: its span is written
//! out of its journal, which its next incarnation has kept, or which still lies in memory.

mod folders;

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use sinew::NodeAddress;
use sinew::inspect::{FrozenFacts, FrozenSpan};
use sinew_recorder::{
    Compression, FileOptions, FrozenRing, JournalReader, Owners, RecordingError, RingOrigin, Start,
};

pub use folders::FlightFolders;

/// Maximum number of files of a folder that are looked at.
const FILES_MAX: usize = 4_096;

/// The spans of a walk.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Frozen {
    /// By their begins.
    pub spans: Vec<SpanFiles>,
    /// Faults, each with its place.
    pub faults: Vec<String>,
}

/// The files of one span.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SpanFiles {
    /// The folder of the files.
    pub folder: PathBuf,
    /// The cause, for users.
    pub cause: String,
    /// The begin, in nanoseconds of the host's monotonic clock: the earliest one of all nodes.
    pub begin_ns: u64,
    /// The end: the latest one of all nodes.
    pub end_ns: u64,
    /// One file for each incarnation of a node that has messages of the span.
    pub files: Vec<SpanFile>,
}

/// A node's file of a span.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SpanFile {
    /// The name of the node.
    pub node: String,
    /// The file.
    pub path: PathBuf,
    /// The begin of the span as the node has frozen it, in nanoseconds of the host's monotonic clock.
    pub begin_ns: u64,
    /// The end of the span.
    pub end_ns: u64,
    /// The time of the first record.
    pub first_ns: u64,
    /// The time of the last record.
    pub last_ns: u64,
    /// Messages in the file.
    pub written: u64,
    /// Messages that the journal has lost.
    pub dropped: u64,
    /// Whether it is of an incarnation that was killed.
    pub has_died: bool,
}

/// A journal that nothing writes any more.
struct Ring {
    path: PathBuf,
    node: String,
    address: NodeAddress,
    facts: FrozenFacts,
    span: FrozenSpan,
}

/// Writes the spans in `frozen` as files, each span into a folder of its ID there. `journals` has a folder for each
/// node with its journal. To be called when all nodes of this host have ended. Copies that are files now are
/// removed.
#[must_use]
pub fn gather(frozen: &Path, journals: &Path) -> Frozen {
    let mut found = Frozen::default();
    let folders = paths(journals).into_iter().chain([frozen.to_owned()]);
    let rings = folders.flat_map(|folder| paths(&folder)).filter_map(|path| ring(&path));
    let (dead, kept): (Vec<_>, Vec<_>) = rings.partition(|ring| ring.span.has_died);
    let mut spans = BTreeMap::<&str, Vec<&Ring>>::new();
    kept.iter().for_each(|ring| spans.entry(&ring.span.id).or_default().push(ring));
    let mut unread: BTreeSet<&Path> = dead.iter().map(|ring| ring.path.as_path()).collect();
    for (id, rings) in spans {
        // At least one. All nodes have the same times, up to the error of their clocks.
        let FrozenSpan { begin_ns, end_ns, cause, .. } = &rings[0].span;
        let parts = rings.iter().map(|ring| (*ring, ring.span.begin_ns, ring.span.end_ns));
        // An incarnation that has frozen the span itself, and died later, has its file.
        let is_absent = |dead: &&Ring| !rings.iter().any(|kept| kept.is_of_the_incarnation_of(dead));
        let of_dead = dead.iter().filter(is_absent).map(|ring| (ring, *begin_ns, *end_ns));
        let parts = parts.chain(of_dead);
        for path in write(&frozen.join(id), cause, parts, &mut found) {
            unread.remove(path.as_path());
        }
    }
    // No living node has kept a span around its death: each may have had all spans that it keeps.
    for ring in dead.iter().filter(|ring| unread.contains(ring.path.as_path())) {
        let part = [(ring, 0, u64::MAX)];
        let _ = write(&frozen.join(&ring.span.id), &ring.span.cause, part.into_iter(), &mut found);
    }
    if found.faults.is_empty() {
        kept.iter().chain(&dead).for_each(|ring| remove(&ring.path));
    }
    found.spans.sort_by_key(|span| span.begin_ns);
    // It has spans, or there was no fault.
    let _ = fs::remove_dir(frozen);
    found
}

/// Writes the files of one span. Returns the journals of killed nodes that end within it: how a node died is in them.
fn write<'a>(
    folder: &Path,
    cause: &str,
    parts: impl Iterator<Item = (&'a Ring, u64, u64)>,
    found: &mut Frozen,
) -> Vec<PathBuf> {
    let mut read = Vec::new();
    let mut files: Vec<SpanFile> = Vec::new();
    for (ring, begin_ns, end_ns) in parts {
        match ring.write(folder, begin_ns, end_ns) {
            Ok(Some(file)) => {
                if ring.span.has_died && ring.ends_by(end_ns) {
                    read.push(ring.path.clone());
                }
                files.push(file);
            }
            Ok(None) => {}
            Err(why) => found.faults.push(format!("{}: {why}", ring.path.display())),
        }
    }
    let begin_ns = files.iter().map(|file| file.begin_ns).min();
    let end_ns = files.iter().map(|file| file.end_ns).max();
    if let (Some(begin_ns), Some(end_ns)) = (begin_ns, end_ns) {
        let (folder, cause) = (folder.to_owned(), cause.to_owned());
        found.spans.push(SpanFiles { folder, cause, begin_ns, end_ns, files });
    }
    read
}

impl Ring {
    fn is_of_the_incarnation_of(&self, other: &Self) -> bool {
        let identity = |ring: &Self| (ring.address, ring.facts.report.incarnation);
        identity(self) == identity(other)
    }

    /// Returns whether the journal has no record after this time.
    fn ends_by(&self, end_ns: u64) -> bool {
        let all = sinew_recorder::Span::scan(&self.path, &(0..=u64::MAX));
        all.is_ok_and(|all| all.last_ns <= end_ns)
    }

    /// Writes the records of these times; `None`: it has none.
    fn write(&self, folder: &Path, begin_ns: u64, end_ns: u64) -> Result<Option<SpanFile>, RecordingError> {
        let times = begin_ns..=end_ns;
        let has_died = self.span.has_died;
        let scanned = sinew_recorder::Span::scan(&self.path, &times)?;
        if scanned.records == 0 {
            return Ok(None);
        }
        let name = if has_died { format!("{}-{}", self.node, self.span.id) } else { self.node.clone() };
        let path = folder.join(name + ".mcap");
        let (report, address, has_clocks) = (&self.facts.report, self.address, !has_died);
        let ring = FrozenRing { path: &self.path, report, address, times, has_clocks };
        fs::create_dir_all(folder)
            .map_err(|cause| sinew_bag::BagError::Write { path: folder.to_owned(), cause })?;
        let options = FileOptions { compression: Compression::Lz4, replace: true, ..FileOptions::default() };
        let written =
            ring.write(path.clone(), options, concat!("exoskeleton ", env!("CARGO_PKG_VERSION")))?;
        let (first_ns, last_ns) = (written.first_ns, written.last_ns);
        // A whole journal has the times of its records.
        let (begin_ns, end_ns) = if end_ns == u64::MAX { (first_ns, last_ns) } else { (begin_ns, end_ns) };
        let (written, dropped) = (written.totals.written, written.totals.dropped);
        let node = self.node.clone();
        Ok(Some(SpanFile { node, path, begin_ns, end_ns, first_ns, last_ns, written, dropped, has_died }))
    }
}

/// Returns the frozen journal at this path, or the journal of a killed node.
fn ring(path: &Path) -> Option<Ring> {
    let ending = path.extension()?;
    let is_journal = ending == "journal";
    if !is_journal && ending != "frozen" {
        return None;
    }
    let origin = RingOrigin::read(path, Owners::ThisUser)?;
    let id = origin.id();
    let RingOrigin { node, address, mut facts, .. } = origin;
    let span = match facts.span.take() {
        Some(span) => span,
        None if is_journal => {
            FrozenSpan { id, cause: format!("{node} has died"), has_died: true, ..FrozenSpan::default() }
        }
        // It was not finished.
        None => return None,
    };
    is_file_name(&node).then_some(())?;
    is_file_name(&span.id).then_some(Ring { path: path.to_owned(), node, address, facts, span })
}

/// Returns whether a text from a file names no other folder.
fn is_file_name(text: &str) -> bool {
    !text.starts_with('.') && text.chars().all(|c| c.is_ascii_alphanumeric() || c == '.' || c == '-')
}

/// Returns the paths in a folder, in their order; none without the folder.
fn paths(folder: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(folder).into_iter().flatten().take(FILES_MAX);
    let mut paths: Vec<_> = entries.filter_map(|entry| Some(entry.ok()?.path())).collect();
    paths.sort();
    paths
}

/// Removes a journal and its facts.
fn remove(journal: &Path) {
    for path in [journal, &journal.with_extension("facts")] {
        // It stays if the folder refuses that.
        let _ = fs::remove_file(path);
    }
}

/// Removes the journal that this process has written into `folder`, and the folder. To be called when its node has
/// ended. The journal of an earlier process that was killed stays.
///
/// # Errors
/// The system's error. Then the folder stays.
pub fn remove_own_journal(folder: &Path) -> io::Result<()> {
    let own = std::process::id();
    for path in paths(folder).iter().filter(|path| path.extension().is_some_and(|ending| ending == "journal"))
    {
        if JournalReader::open(path, Start::Newest).is_ok_and(|reader| reader.writer() == own) {
            remove(path);
        }
    }
    fs::remove_dir(folder)
}

impl fmt::Display for Frozen {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for SpanFiles { folder, cause, begin_ns, end_ns, files } in &self.spans {
            let (count, seconds) = (files.len(), end_ns.saturating_sub(*begin_ns) as f64 * 1e-9);
            let files = if count == 1 { "file" } else { "files" };
            writeln!(f, "frozen: {count} {files}, span {seconds:.1} s, {cause}: {}", folder.display())?;
        }
        self.faults.iter().try_for_each(|fault| writeln!(f, "  {fault}"))
    }
}
