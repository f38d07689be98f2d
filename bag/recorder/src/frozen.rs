//! Writes a frozen span, or the ring of a dead node, into a file.

use std::{
    ops::RangeInclusive,
    path::{Path, PathBuf},
};

use sinew_bag::{BagWriter, Options, Origin, Totals};
use sinew_record::{
    FrozenFacts, RecordReport, Selection,
    files::{Owners, read_facts},
};
use sinew_runtime::tid::NodeAddress;
use sinew_shm::journal::{JournalReader, ReadJournalError, Start};

use crate::{error::RecordingError, names::Names, recorder::Recorder, setup::Setup, span::Span};

/// A journal without a living writer: a frozen span, or the ring of a dead node.
///
/// # Examples
///
/// ```no_run
/// use std::path::Path;
///
/// use sinew_recorder::{FileOptions, FrozenRing, Owners, read_facts};
/// use sinew_runtime::tid::NodeAddress;
///
/// let path = Path::new("/var/log/sinew-walker-10.0.0.2-10.0.0.2-1f-1.frozen");
/// let facts = read_facts(&path.with_extension("facts"), Owners::ThisUser)?;
/// let span = facts.span.unwrap_or_default();
/// let ring = FrozenRing {
///     path,
///     report: &facts.report,
///     address: NodeAddress::from([10, 0, 0, 2]),
///     times: span.begin_ns..=span.end_ns,
///     has_clocks: true,
/// };
/// let written = ring.write("knee.mcap".into(), FileOptions::default(), "walker 1.0")?;
/// println!("{} messages", written.totals.written);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Clone, Debug)]
pub struct FrozenRing<'a> {
    /// The journal.
    pub path: &'a Path,
    /// The names and the clocks that the node knew.
    pub report: &'a RecordReport,
    /// The address of the node, if the report has none.
    pub address: NodeAddress,
    /// The times to write, in nanoseconds of the monotonic clock of the node's host.
    pub times: RangeInclusive<u64>,
    /// Whether the clocks of the report are those of the end of the span. The ring of a dead node has its own, each
    /// second.
    pub has_clocks: bool,
}

/// The content of a file that was written by [`FrozenRing::write`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FrozenFile {
    /// Messages seen, written and dropped.
    pub totals: Totals,
    /// The time of the first record, in nanoseconds of the monotonic clock of the node's host; 0 without any.
    pub first_ns: u64,
    /// The time of the last record; 0 without any.
    pub last_ns: u64,
}

impl FrozenRing<'_> {
    /// Writes the records of these times into a file. `program` is the name and the version of the caller.
    ///
    /// # Errors
    /// The journal cannot be read, or the file cannot be written.
    pub fn write(
        &self,
        file: PathBuf,
        options: Options,
        program: &str,
    ) -> Result<FrozenFile, RecordingError> {
        let Self { path, report, address, times, has_clocks } = self;
        let span = Span::scan(path, times)?;
        let reader = JournalReader::open(path, Start::Oldest)?;
        let node = report.node.unwrap_or(*address);
        let origin = Origin {
            node: report.name.clone(),
            address: node.to_string(),
            incarnation: report.incarnation.map_or(0, |incarnation| incarnation.0),
            version: program.to_owned(),
            wall_offset_ns: reader.wall_offset()?,
            began_ns: if span.records == 0 { *times.start() } else { span.first_ns },
        };
        let bag = BagWriter::create(file, options, origin)?;
        let mut names = Names::default();
        // All that the node knew of its types is in the report.
        let kinds: Vec<_> = report.types.iter().map(|one| one.kind).collect();
        names.learn(report, &kinds);
        let setup = Setup { node, selection: Selection::default(), names, left_out: Vec::new() };
        let mut recorder = Recorder::of_span(reader, bag, setup, &span);
        if *has_clocks {
            recorder.clocks(span.last_ns, &report.clocks);
        }
        loop {
            match recorder.pump(span.last_ns) {
                Ok(true) => break,
                // Messages that are missing are counted by their numbers.
                Ok(false) | Err(ReadJournalError::Damaged { .. }) => {}
                Err(why) => return Err(why.into()),
            }
        }
        let fault = recorder.take_fault();
        let totals = recorder.finish(span.last_ns)?;
        if let Some(why) = fault {
            return Err(why.into());
        }
        Ok(FrozenFile { totals, first_ns: span.first_ns, last_ns: span.last_ns })
    }
}

/// The node that wrote a journal, and the facts beside it. Nothing writes the journal any more.
///
/// # Examples
///
/// ```no_run
/// use std::path::Path;
///
/// use sinew_recorder::{Owners, RingOrigin};
///
/// let path = Path::new("/dev/shm/sinew-walker-10.0.0.2.journal");
/// if let Some(origin) = RingOrigin::read(path, Owners::ThisUser) {
///     println!("{} at {} was killed", origin.node, origin.address);
/// }
/// ```
#[derive(Clone, Debug)]
pub struct RingOrigin {
    /// The name of the node.
    pub node: String,
    /// Its address.
    pub address: NodeAddress,
    /// Its project.
    pub project: String,
    /// The facts; without a file of them, the name of the node alone.
    pub facts: FrozenFacts,
    /// The number of the incarnation; without facts, the time of the journal's creation.
    pub incarnation: u64,
    /// The time of the journal's creation, in nanoseconds of the monotonic clock of the node's host.
    pub created_ns: u64,
    /// Wall clock minus monotonic clock, in nanoseconds.
    pub wall_offset_ns: i64,
}

impl RingOrigin {
    /// Reads the origin of a frozen span, or of the journal of a killed node, and the facts of these users beside it.
    /// `None`: it is no journal, a node writes it, or its node has ended in order.
    #[must_use]
    pub fn read(path: &Path, owners: Owners) -> Option<Self> {
        let reader = JournalReader::open(path, Start::Newest).ok()?;
        let identity = String::from_utf8(reader.identity().to_vec()).ok()?;
        let mut lines = identity.lines();
        let (node, address) = (lines.next()?.to_owned(), lines.next()?.parse().ok()?);
        let project = lines.next()?.to_owned();
        // A kept ring may be a copy, which was closed.
        let is_kept = path.extension().is_some_and(|ending| ending == "frozen");
        if reader.is_writer_alive() || (!is_kept && reader.is_closed().ok()?) {
            return None;
        }
        let mut facts = read_facts(&path.with_extension("facts"), owners).unwrap_or_default();
        facts.report.name.clone_from(&node);
        let incarnation = facts.report.incarnation.map_or_else(|| reader.created(), |number| number.0);
        let (created_ns, wall_offset_ns) = (reader.created(), reader.wall_offset().ok()?);
        Some(Self { node, address, project, facts, incarnation, created_ns, wall_offset_ns })
    }

    /// Returns the ID of the whole journal of a killed node. The node hands it out by this ID after its next start.
    #[must_use]
    pub fn id(&self) -> String {
        format!("died-{:x}", self.incarnation)
    }
}
