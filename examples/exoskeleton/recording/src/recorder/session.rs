//! The recording of one incarnation of a node, through its client socket.

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use sinew::client::ApiError;
use sinew::inspect::{AskRecord, RecordReport, Selection};
use sinew::{AppAddress, Endpoint, NodeApi, Registration, Tid, Time};
use sinew_bag::{BagError, BagWriter, Compression, Options, Origin, Totals};
use sinew_recorder::{JournalReader, Names, ReadJournalError, Recorder, Setup, Start};
use thiserror::Error;

use super::KnownNames;

/// Maximum bytes of one file: a long walk must not fill the disk. Messages beyond it are counted as dropped.
const SIZE_MAX: u64 = 2 << 30;
/// Time limit for the registration, and for the first answer.
const BEGUN_WITHIN: Duration = Duration::from_secs(2);
/// Pause after the journal was read to its end: it keeps seconds.
const PAUSE: Duration = Duration::from_millis(5);
/// Time for the node to know the names of all applications. The journal keeps the messages meanwhile: they are few
/// before the walk.
const NAMED_WITHIN: Duration = Duration::from_secs(5);
/// Interval at which the node is asked for them.
const NAMED_PERIOD: Duration = Duration::from_millis(50);
/// Interval at which the recording is renewed at the node: its lease is 5 s.
const RENEWAL: Duration = Duration::from_secs(1);
/// Time limit of a renewal: meanwhile the journal is not read.
const RENEWED_WITHIN: Duration = Duration::from_millis(300);
/// Time at the end for messages that are on their way into the journal.
const ARRIVAL: Duration = Duration::from_millis(200);
/// Time limit for the rest of the journal at the end.
const DRAINED_WITHIN: Duration = Duration::from_secs(10);

/// The file of one incarnation.
#[derive(Debug)]
pub(super) struct NodeFile {
    pub(super) path: PathBuf,
    pub(super) totals: Totals,
}

/// The reason why a node is not recorded.
#[derive(Debug, Error)]
pub(super) enum SessionError {
    /// The node does not answer.
    #[error("the node does not record: {0}; a node that is ending is no fault")]
    Node(#[from] ApiError),
    /// The node refuses.
    #[error("the node does not record: {0}")]
    Refused(String),
    /// Its journal is not readable.
    #[error(transparent)]
    Journal(#[from] ReadJournalError),
    /// The file cannot be created.
    #[error(transparent)]
    File(#[from] BagError),
}

/// A running recording.
pub(super) struct Session<'n> {
    endpoint: Endpoint,
    recorder: Recorder,
    path: PathBuf,
    names: &'n KnownNames,
}

impl<'n> Session<'n> {
    /// Starts the recording of the node at this socket; `None`: no node is there.
    pub(super) fn begin(
        socket: &Path,
        path: &Path,
        known: &'n KnownNames,
    ) -> Result<Option<Self>, SessionError> {
        let Ok(node) = NodeApi::connect(socket) else { return Ok(None) };
        let registration = Registration::new().deadline(BEGUN_WITHIN).without_reconnect();
        let mut endpoint = node.register_transport_address(registration)?;
        let first = ask(&mut endpoint, BEGUN_WITHIN)?;
        let Some(journal) = &first.path else {
            return Err(SessionError::Refused("it names no journal".to_owned()));
        };
        let reader = JournalReader::open(Path::new(journal), Start::Newest)?;
        let node = first.node.unwrap_or_else(|| endpoint.tid().node);
        let now_ns = Time::now().as_nanos();
        let origin = Origin {
            node: first.name.clone(),
            address: node.to_string(),
            incarnation: first.incarnation.map_or(0, |incarnation| incarnation.0),
            version: concat!("exoskeleton ", env!("CARGO_PKG_VERSION")).to_owned(),
            wall_offset_ns: first.wall_offset_ns,
            began_ns: now_ns,
        };
        // The robot walks on the same CPUs: the least work counts, not the smallest file. A file of this name is
        // that of an attempt which failed below.
        let options = Options {
            compression: Compression::Lz4,
            size_max: Some(SIZE_MAX),
            replace: true,
            ..Options::default()
        };
        let bag = BagWriter::create(path, options, origin)?;
        let mut names = Names::default();
        known.groups.iter().for_each(|group| names.add_app(Tid::group(group), group));
        known.types.iter().for_each(|(kind, name)| names.add_type(*kind, name));
        learn(&mut names, &first);
        let setup = Setup { node, selection: Selection::default(), names, left_out: vec![endpoint.tid()] };
        let mut recorder = Recorder::begin(reader, bag, setup)?;
        recorder.clocks(now_ns, &first.clocks);
        Ok(Some(Self { endpoint, recorder, path: path.to_owned(), names: known }))
    }

    /// Records until the node ends or `stop` is set, and finishes the file.
    pub(super) fn run(mut self, stop: &AtomicBool, fault: &mut impl FnMut(String)) -> NodeFile {
        self.await_names(stop);
        let mut renewal = Time::now() + RENEWAL;
        while !stop.load(Ordering::Relaxed) && self.recorder.is_writer_alive() {
            let now = Time::now();
            let Some(is_empty) = self.pump(now, fault) else { break };
            if now >= renewal {
                renewal = now + RENEWAL;
                // A node ends the recording after 5 s without a renewal.
                if let Ok(report) = ask(&mut self.endpoint, RENEWED_WITHIN) {
                    learn(self.recorder.names_mut(), &report);
                }
            }
            if is_empty {
                std::thread::sleep(PAUSE);
            }
        }
        self.finish(fault)
    }

    /// Asks for names until the node knows all applications. A channel keeps the names of its first message.
    fn await_names(&mut self, stop: &AtomicBool) {
        let until = Time::now() + NAMED_WITHIN;
        while Time::now() < until && !stop.load(Ordering::Relaxed) && self.recorder.is_writer_alive() {
            if let Ok(report) = ask(&mut self.endpoint, RENEWED_WITHIN) {
                learn(self.recorder.names_mut(), &report);
                let is_known = |name: &String| report.apps.iter().any(|app| app.name == *name);
                if self.names.apps.iter().all(is_known) {
                    return;
                }
            }
            std::thread::sleep(NAMED_PERIOD);
        }
    }

    /// Returns whether the journal was read to its end; `None`: it cannot be read any more.
    fn pump(&mut self, now: Time, fault: &mut impl FnMut(String)) -> Option<bool> {
        let pumped = self.recorder.pump(now.as_nanos());
        if let Some(error) = self.recorder.take_fault() {
            fault(error.to_string());
        }
        match pumped {
            Ok(is_empty) => Some(is_empty),
            Err(error @ ReadJournalError::Damaged { .. }) => {
                fault(error.to_string());
                Some(true)
            }
            Err(error) => {
                fault(error.to_string());
                None
            }
        }
    }

    /// Reads the rest of the journal, and finishes the file.
    fn finish(mut self, fault: &mut impl FnMut(String)) -> NodeFile {
        let began = Time::now();
        let mut is_over = self.recorder.stop().is_err();
        while !is_over {
            let now = Time::now();
            let pumped = self.pump(now, fault);
            let waited = now.since(began);
            let has_waited = waited >= ARRIVAL && pumped == Some(true);
            is_over =
                pumped.is_none() || self.recorder.is_drained() || has_waited || waited >= DRAINED_WITHIN;
            if !is_over && pumped == Some(true) {
                std::thread::sleep(PAUSE);
            }
        }
        let so_far = self.recorder.totals();
        let finished = self.recorder.finish(Time::now().as_nanos());
        let totals = finished.unwrap_or_else(|error| {
            fault(error.to_string());
            so_far
        });
        NodeFile { path: self.path, totals }
    }
}

/// Starts or renews the recording at the node.
fn ask(endpoint: &mut Endpoint, within: Duration) -> Result<RecordReport, SessionError> {
    let to = Tid::new(endpoint.tid().node, AppAddress::INSPECT);
    let report: RecordReport = endpoint.message(to, &AskRecord::default()).ask(within)?;
    match report.refused {
        Some(why) => Err(SessionError::Refused(why)),
        None => Ok(report),
    }
}

/// Adds the names that the node has reported.
fn learn(names: &mut Names, report: &RecordReport) {
    report.apps.iter().for_each(|app| names.add_app(app.tid, &app.name));
    report.types.iter().for_each(|one| names.add_type(one.kind, &one.name));
    if let Some(node) = report.node {
        names.add_node(node, &report.name);
    }
}
