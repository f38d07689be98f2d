//! A recording from the first question to the node up to the finished file.

#[cfg(test)]
mod tests;

use std::{
    fmt, io,
    path::{Path, PathBuf},
    time::Duration,
};

use sinew_bag::{BagError, BagWriter, Compression, Origin, Totals};
use sinew_client::Endpoint;
use sinew_model::config::{RecordCompression, RecordConfig};
use sinew_record::{AskRecord, RecordCounts, RecordReport, SCHEMAS_MAX, Selection};
use sinew_runtime::{
    log,
    tid::{AppAddress, NodeAddress, Tid},
    time::Time,
    wire::Kind,
};
use sinew_shm::journal::{JournalReader, ReadJournalError, Start};

use crate::{RecordingError, file_name, names::Names, recorder::Recorder, setup::Setup};

/// Pause after the journal was read to its end. Its 64 MiB, unless configured otherwise, last for far longer.
const PAUSE: Duration = Duration::from_millis(5);
/// Interval at which the recording is renewed at the node: its lease is 5 s.
pub(crate) const RENEWAL: Duration = Duration::from_secs(1);
/// Time limit of a further question: meanwhile the journal is not read.
pub(crate) const RENEWED_WITHIN: Duration = Duration::from_millis(300);
/// Maximum questions for names and structures between two renewals. Further channels have addresses in their topics,
/// and views as JSON.
const QUESTIONS_MAX: u32 = 64;
/// Time at the end for messages that are on their way into the journal.
const ARRIVAL: Duration = Duration::from_millis(200);
/// Time limit for the rest of the journal at the end.
const DRAINED_WITHIN: Duration = Duration::from_secs(10);
/// Maximum number of files with the same name and time: those of starts within one second.
const NUMBERS_MAX: u32 = 100;
/// Maximum number of faults that are kept.
const FAULTS_MAX: usize = 16;

/// The messages to record, and the file.
///
/// # Examples
///
/// ```
/// use sinew_recorder::{FileOptions, RecordingOptions};
///
/// let options = RecordingOptions {
///     path: Some("/var/log/{node}-{time}.mcap".into()),
///     file: FileOptions { split_bytes: Some(1 << 30), ..FileOptions::default() },
///     ..RecordingOptions::default()
/// };
/// assert!(options.selection.is_all());
/// ```
#[derive(Clone, Debug, Default)]
pub struct RecordingOptions {
    /// The file. `{node}` is replaced by the name of the node, and `{time}` by the time at which it begins, in UTC.
    /// Without a path it is `{node}-{time}.mcap` in the current folder.
    pub path: Option<PathBuf>,
    /// The messages to record. Default: all of the node.
    pub selection: Selection,
    /// The time after which it ends. Default: none.
    pub lasts: Option<Duration>,
    /// How the file is written: compression, sizes, parts, views.
    pub file: sinew_bag::Options,
    /// Whether messages are counted as dropped once the file has its maximum size. Otherwise the recording ends there.
    /// Default: it ends.
    pub goes_on_when_full: bool,
    /// The program and its version, for the metadata of the file. Default: none.
    pub program: String,
}

impl RecordingOptions {
    /// Returns the options of a node's configuration; `None` without `record.file`.
    #[must_use]
    pub fn configured(config: &RecordConfig) -> Option<Self> {
        let path = file_name::timed(config.file.as_deref()?);
        let compression = match config.compression {
            RecordCompression::Zstd => Compression::Zstd,
            RecordCompression::Lz4 => Compression::Lz4,
            RecordCompression::None => Compression::None,
        };
        let RecordConfig { split_bytes, split_time, max_bytes, .. } = *config;
        let file = sinew_bag::Options {
            compression,
            size_max: max_bytes,
            split_bytes,
            split_time,
            ..Default::default()
        };
        let (apps, types) = (config.apps.clone(), config.types.clone());
        let selection = Selection { apps, types, groups: Vec::new() };
        Some(Self { path: Some(path), selection, file, goes_on_when_full: true, ..Self::default() })
    }
}

/// The connection to the node that records: an [`Endpoint`], or a program's own one.
pub trait Connection {
    /// Asks the node.
    ///
    /// # Errors
    /// Why there is no answer, with a remedy.
    fn ask(&mut self, question: &AskRecord, within: Duration) -> Result<RecordReport, String>;

    /// Returns the address of the node.
    fn node(&self) -> NodeAddress;

    /// Returns the addresses of the recorder. Their messages are not recorded.
    fn own(&self) -> Vec<Tid>;

    /// Returns the time limit of the first question. Default: 2 s.
    fn patience(&self) -> Duration {
        Duration::from_secs(2)
    }
}

impl Connection for Endpoint {
    fn ask(&mut self, question: &AskRecord, within: Duration) -> Result<RecordReport, String> {
        let to = Tid::new(self.tid().node, AppAddress::INSPECT);
        self.message(to, question).ask(within).map_err(|error| error.to_string())
    }

    fn node(&self) -> NodeAddress {
        self.tid().node
    }

    fn own(&self) -> Vec<Tid> {
        vec![self.tid()]
    }
}

/// Why a recording has ended.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum End {
    /// Its owner has ended it.
    Asked,
    /// [`RecordingOptions::lasts`] is over.
    Time,
    /// The file has its maximum size.
    Full,
    /// The node has stopped, or has ended the recording.
    Closed,
    /// The node was killed.
    NodeDied,
    /// The journal cannot be read any more, for this reason.
    Unreadable(String),
}

impl End {
    /// Returns the word for programs.
    #[must_use]
    pub const fn word(&self) -> &'static str {
        match self {
            Self::Asked => "asked",
            Self::Time => "time",
            Self::Full => "full",
            Self::Closed => "closed",
            Self::NodeDied => "node_died",
            Self::Unreadable(_) => "unreadable",
        }
    }
}

impl fmt::Display for End {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let rest = "the file has all messages up to then that the journal still had";
        match self {
            Self::Asked => f.write_str("it was ended"),
            Self::Time => f.write_str("its time is over"),
            Self::Full => f.write_str("the recording has its maximum size"),
            Self::Closed => write!(f, "the node has stopped, or has ended this recording; {rest}"),
            Self::NodeDied => write!(f, "the node has died; {rest}"),
            Self::Unreadable(why) => write!(f, "{why}; the file has the messages before"),
        }
    }
}

/// The result of a recording.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Summary {
    /// The file; further parts have a number before the ending.
    pub file: PathBuf,
    /// The name of the node.
    pub node: String,
    /// Why it has ended.
    pub end: End,
    /// The counters.
    pub totals: Totals,
    /// Faults of the file and of the journal, at most 16. Their messages are counted as dropped.
    pub faults: Vec<String>,
}

impl Summary {
    /// Returns whether the recording was ended by its owner, its time or its node, without a fault.
    #[must_use]
    pub fn is_whole(&self) -> bool {
        self.faults.is_empty() && !matches!(self.end, End::Full | End::Unreadable(_))
    }
}

/// A recording on the thread of its owner, which calls [`step`](Self::step) in a loop and [`finish`](Self::finish) at
/// the end. [`Recording`](crate::Recording) does it on a thread of its own.
#[derive(Debug)]
pub struct Session<C> {
    connection: C,
    question: AskRecord,
    lasts: Option<Duration>,
    recorder: Recorder,
    file: PathBuf,
    node: String,
    began: Time,
    /// When the next question is due.
    renewal: Time,
    /// Whether the node has answered the last question.
    answers: bool,
    /// Questions for names and structures since the last renewal.
    questions: u32,
    goes_on_when_full: bool,
    was_full: bool,
    faults: Vec<String>,
}

impl<C: Connection> Session<C> {
    /// Starts the recording at the node, and creates the file.
    ///
    /// # Errors
    /// The node does not record, its journal cannot be read, or the file cannot be made. Nothing is recorded then.
    pub fn begin(mut connection: C, options: RecordingOptions) -> Result<Self, RecordingError> {
        options.selection.check()?;
        let question = AskRecord { selection: options.selection.clone(), ..AskRecord::default() };
        let within = connection.patience();
        let first = ask(&mut connection, &question, within)?;
        match open(&connection, &options, &first) {
            Ok((recorder, file)) => {
                let began = Time::now();
                Ok(Self {
                    connection,
                    question,
                    lasts: options.lasts,
                    recorder,
                    file,
                    node: first.name,
                    began,
                    renewal: began + RENEWAL,
                    answers: true,
                    questions: 0,
                    goes_on_when_full: options.goes_on_when_full,
                    was_full: false,
                    faults: Vec::new(),
                })
            }
            Err(why) => {
                leave(&mut connection, None);
                Err(why)
            }
        }
    }

    /// Moves records from the journal to the file, and renews the recording at the node each second. Returns the end,
    /// once there is one. It sleeps for some milliseconds where nothing is to do, and asks the node for at most 300 ms.
    pub fn step(&mut self) -> Option<End> {
        let now = Time::now();
        let is_empty = match self.pump(now) {
            Ok(is_empty) => is_empty,
            Err(why) => return Some(End::Unreadable(why)),
        };
        if let Some(end) = self.end(now) {
            return Some(end);
        }
        if now >= self.renewal {
            (self.renewal, self.questions) = (now + RENEWAL, 0);
            self.renew(Vec::new());
        }
        if is_empty {
            std::thread::sleep(PAUSE);
        }
        None
    }

    /// Asks the node for names now, for at most 300 ms, and returns whether it has answered. Messages wait for names by
    /// themselves, but only once for each application. Call this before the first [`step`](Self::step) until
    /// [`names_mut`](Self::names_mut) has those that the topics must have; the journal keeps the messages meanwhile.
    pub fn refresh_names(&mut self) -> bool {
        self.renewal = Time::now() + RENEWAL;
        self.renew(Vec::new());
        self.answers
    }

    /// Returns the names, to which the owner adds those that the node does not know, such as those of groups.
    pub const fn names_mut(&mut self) -> &mut Names {
        self.recorder.names_mut()
    }

    /// Reads the rest of the journal, finishes the file, and ends the recording at the node: within 10.5 s, unless a
    /// write to the file hangs.
    pub fn finish(mut self, end: End) -> Summary {
        let began = Time::now();
        let mut is_over = self.recorder.stop().is_err();
        while !is_over {
            let now = Time::now();
            let pumped = self.pump(now);
            let has_waited = now.since(began) >= ARRIVAL && pumped == Ok(true);
            is_over = pumped.is_err()
                || self.recorder.is_drained()
                || has_waited
                || now.since(began) >= DRAINED_WITHIN;
            if !is_over && pumped == Ok(true) {
                std::thread::sleep(PAUSE);
            }
        }
        let Self { mut connection, recorder, file, node, mut faults, .. } = self;
        let totals = recorder.totals();
        let totals = recorder.finish(Time::now().as_nanos()).unwrap_or_else(|fault| {
            note(&mut faults, fault.to_string());
            totals
        });
        // Without it the recording would end 5 s later. A node that has died does not answer.
        leave(&mut connection, Some(counts(&totals)));
        Summary { file, node, end, totals, faults }
    }

    /// Returns the file: that of the first part.
    #[must_use]
    pub fn file(&self) -> &Path {
        &self.file
    }

    /// Returns the counters so far.
    #[must_use]
    pub fn totals(&self) -> Totals {
        self.recorder.totals()
    }

    /// Returns how long it has recorded.
    #[must_use]
    pub fn lasts(&self) -> Duration {
        Time::now().since(self.began)
    }

    /// Returns the faults so far, at most 16.
    #[must_use]
    pub fn faults(&self) -> &[String] {
        &self.faults
    }

    /// Returns whether the journal was read to its end, or why it cannot be read any more.
    fn pump(&mut self, now: Time) -> Result<bool, String> {
        let pumped = self.recorder.pump(now.as_nanos());
        if let Some(fault) = self.recorder.take_fault() {
            note(&mut self.faults, fault.to_string());
        }
        if self.goes_on_when_full && self.recorder.is_full() && !std::mem::replace(&mut self.was_full, true) {
            // The user has set this limit: it is no fault.
            log::warn!("{}: further messages are counted as dropped; raise its limit", End::Full);
        }
        self.ask_for_names();
        match pumped {
            Ok(is_empty) => Ok(is_empty),
            Err(fault @ ReadJournalError::Damaged { .. }) => {
                note(&mut self.faults, fault.to_string());
                Ok(true)
            }
            Err(fault) => Err(fault.to_string()),
        }
    }

    fn end(&self, now: Time) -> Option<End> {
        if self.lasts.is_some_and(|lasts| now.since(self.began) >= lasts) {
            return Some(End::Time);
        }
        if self.recorder.is_full() && !self.goes_on_when_full {
            return Some(End::Full);
        }
        if self.recorder.is_writer_alive() {
            return None;
        }
        Some(if self.recorder.is_closed().unwrap_or(false) { End::Closed } else { End::NodeDied })
    }

    /// Asks for names and structures, if the first message of a channel waits for them. spec: BAG-6
    fn ask_for_names(&mut self) {
        if self.recorder.is_waiting() && self.answers && self.questions < QUESTIONS_MAX {
            self.questions += 1;
            let wanted = self.recorder.wanted(SCHEMAS_MAX);
            self.renew(wanted);
        }
    }

    /// Renews the recording at the node. If the node does not answer for 5 s it ends the recording, which the journal
    /// shows.
    fn renew(&mut self, schemas: Vec<Kind>) {
        self.question.schemas = schemas;
        self.question.counts = Some(counts(&self.recorder.totals()));
        let within = RENEWED_WITHIN.min(self.connection.patience());
        let answer = ask(&mut self.connection, &self.question, within);
        self.answers = answer.is_ok();
        if let Ok(report) = answer {
            self.recorder.names_mut().learn(&report, &self.question.schemas);
        }
    }
}

/// Returns the counters that the node reports for this program.
const fn counts(totals: &Totals) -> RecordCounts {
    RecordCounts { seen: totals.seen, dropped: totals.dropped }
}

/// Starts or renews the recording at the node.
pub(crate) fn ask<C: Connection>(
    connection: &mut C,
    question: &AskRecord,
    within: Duration,
) -> Result<RecordReport, RecordingError> {
    let report = connection.ask(question, within).map_err(RecordingError::NoAnswer)?;
    match report.refused {
        Some(why) => Err(RecordingError::Refused(why)),
        None => Ok(report),
    }
}

/// Ends the recording at the node, with the last counters of a file.
pub(crate) fn leave<C: Connection>(connection: &mut C, counts: Option<RecordCounts>) {
    let within = RENEWED_WITHIN.min(connection.patience());
    // The answer says nothing.
    let _ = connection.ask(&AskRecord { ends: true, counts, ..AskRecord::default() }, within);
}

/// Opens the journal, and creates the file.
fn open<C: Connection>(
    connection: &C,
    options: &RecordingOptions,
    first: &RecordReport,
) -> Result<(Recorder, PathBuf), RecordingError> {
    let Some(path) = &first.path else {
        return Err(RecordingError::NoAnswer("it names no journal; update it".to_owned()));
    };
    let reader = JournalReader::open(Path::new(path), Start::Newest)?;
    let node = first.node.unwrap_or_else(|| connection.node());
    let now = Time::now().as_nanos();
    let origin = Origin {
        node: first.name.clone(),
        address: node.to_string(),
        incarnation: first.incarnation.map_or(0, |incarnation| incarnation.0),
        version: options.program.clone(),
        wall_offset_ns: first.wall_offset_ns,
        began_ns: now,
    };
    let bag = create(options, &origin)?;
    let file = bag.path();
    let selection = options.selection.clone();
    let mut names = Names::default();
    for group in &selection.groups {
        names.add_app(Tid::group(group), group);
    }
    names.learn(first, &[]);
    let setup = Setup { node, selection, names, left_out: connection.own() };
    let mut recorder = Recorder::begin(reader, bag, setup)?;
    recorder.clocks(now, &first.clocks);
    Ok((recorder, file))
}

/// Creates the file. If its name has the time and exists, the file gets the first free number: another recording began
/// in the same second.
fn create(options: &RecordingOptions, origin: &Origin) -> Result<BagWriter, BagError> {
    let path = options.path.as_deref();
    let file = file_name::filled(path, &origin.node, origin.wall_ns(origin.began_ns));
    let numbers = if file_name::has_time(path) { NUMBERS_MAX } else { 1 };
    let mut number = 1;
    loop {
        let name = file_name::numbered(&file, number);
        let created = BagWriter::create(name, options.file.clone(), origin.clone());
        let exists = matches!(
            &created,
            Err(BagError::Write { cause, .. }) if cause.kind() == io::ErrorKind::AlreadyExists
        );
        if !exists || number >= numbers {
            return created;
        }
        number += 1;
    }
}

fn note(faults: &mut Vec<String>, fault: String) {
    if faults.len() < FAULTS_MAX {
        faults.push(fault);
    }
}
