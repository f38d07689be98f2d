//! The recording of a walk: a thread for each node in the process that starts the nodes, and one file of all.

mod session;

use std::fmt;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use sinew::message::Kind;

use session::NodeFile;

/// Name of the file with the messages of all nodes.
pub const MERGED: &str = "walk.mcap";
/// Time between two attempts to reach a node that does not run: a drive starts some 10 ms after its node.
const RETRY: Duration = Duration::from_millis(10);
/// Maximum number of incarnations of one node in one run.
const INCARNATIONS_MAX: u32 = 100;
/// Maximum number of faults that are kept for one node.
const FAULTS_MAX: usize = 8;
/// Below all control loops.
const NICENESS: i32 = 10;

/// The recorders of a walk. They write `NODE-N.mcap` for the N-th incarnation of each node.
#[derive(Debug)]
pub struct WalkRecorder {
    folder: PathBuf,
    orders: Arc<Orders>,
    threads: Vec<JoinHandle<NodeRecords>>,
}

/// The names that the topics of a recording have.
#[derive(Debug, Clone, Default)]
pub struct KnownNames {
    /// Applications of all nodes. A recorder writes nothing before its node knows them, for 5 s at most: meanwhile the
    /// node keeps the messages.
    pub apps: Vec<String>,
    /// Groups.
    pub groups: Vec<&'static str>,
    /// Payload types.
    pub types: Vec<(Kind, &'static str)>,
}

/// The orders to all threads.
#[derive(Debug, Default)]
struct Orders {
    /// No further recording begins.
    close: AtomicBool,
    /// The recordings end, also those of nodes that run.
    stop: AtomicBool,
}

/// The files of one node.
#[derive(Debug, Default)]
struct NodeRecords {
    files: Vec<NodeFile>,
    faults: Vec<String>,
}

/// The result of a recording.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Recorded {
    /// The file of all nodes; `None`: nothing was recorded, or the files could not be merged.
    pub merged: Option<PathBuf>,
    /// The files of the nodes.
    pub files: Vec<PathBuf>,
    /// Messages in the files of the nodes.
    pub written: u64,
    /// Messages that are in no file.
    pub dropped: u64,
    /// How wrong the times of a node may be in the merged file, ns: of the worst one.
    pub bound_ns: u64,
    /// Faults, each with its place.
    pub faults: Vec<String>,
}

impl WalkRecorder {
    /// Starts a thread for each of these nodes, with its name and its client socket. A node that does not run yet, or
    /// that is started again, is recorded as soon as its socket is there.
    ///
    /// # Errors
    /// The system provides no thread.
    pub fn start(nodes: &[(String, PathBuf)], names: KnownNames, folder: &Path) -> io::Result<Self> {
        let (orders, names) = (Arc::<Orders>::default(), Arc::new(names));
        // Those that run already end if a later one cannot be started.
        let mut recorder = Self { folder: folder.to_owned(), orders: orders.clone(), threads: Vec::new() };
        for (name, socket) in nodes {
            let (name, socket, folder) = (name.clone(), socket.clone(), folder.to_owned());
            let (orders, names) = (orders.clone(), names.clone());
            let record = move || record_node(&name, &socket, &folder, (&names, &orders));
            let thread = std::thread::Builder::new().name("recorder".to_owned()).spawn(record)?;
            recorder.threads.push(thread);
        }
        Ok(recorder)
    }

    /// Begins no further recording: the nodes are about to end. Those in progress go on.
    pub fn close(&self) {
        // SYNC: Relaxed, no other data depends on the flag.
        self.orders.close.store(true, Ordering::Relaxed);
    }

    /// Ends the recording, and merges the files. To be called when the nodes have ended: each recorder then reads the
    /// rest of its journal, for 10 s at most.
    #[must_use]
    pub fn finish(mut self) -> Recorded {
        let mut recorded = Recorded::default();
        for NodeRecords { files, faults } in self.end() {
            recorded.faults.extend(faults);
            for NodeFile { path, totals } in files {
                recorded.written += totals.written;
                recorded.dropped += totals.dropped;
                recorded.files.push(path);
            }
        }
        if recorded.files.is_empty() {
            return recorded;
        }
        let path = self.folder.join(MERGED);
        match sinew_bag::merge(&recorded.files, &path) {
            Ok(merged) => {
                recorded.bound_ns = merged.nodes.iter().map(|node| node.bound_ns).max().unwrap_or(0);
                recorded.faults.extend(merged.damage.into_iter().chain(merged.unfinished));
                recorded.merged = Some(path);
            }
            Err(error) => recorded.faults.push(format!("the files are not merged: {error}")),
        }
        recorded
    }

    /// Ends the threads, and returns the files of each node.
    fn end(&mut self) -> Vec<NodeRecords> {
        self.close();
        // SYNC: Relaxed, no other data depends on the flag.
        self.orders.stop.store(true, Ordering::Relaxed);
        let threads = std::mem::take(&mut self.threads).into_iter();
        let panicked =
            |_| NodeRecords { faults: vec!["a recorder panicked".to_owned()], ..NodeRecords::default() };
        threads.map(|thread| thread.join().unwrap_or_else(panicked)).collect()
    }
}

impl Drop for WalkRecorder {
    fn drop(&mut self) {
        // The files stay as they are.
        drop(self.end());
    }
}

/// Records a node, incarnation by incarnation.
fn record_node(
    name: &str,
    socket: &Path,
    folder: &Path,
    (names, orders): (&KnownNames, &Orders),
) -> NodeRecords {
    // A higher priority than requested is no reason to record nothing.
    let _ = rustix::process::setpriority_process(None, NICENESS);
    let mut records = NodeRecords::default();
    let mut number = 1;
    while !orders.close.load(Ordering::Relaxed) && number <= INCARNATIONS_MAX {
        let path = folder.join(format!("{name}-{number}.mcap"));
        let mut fault = |fault: String| {
            let fault = format!("{name}: {fault}");
            if records.faults.len() < FAULTS_MAX && !records.faults.contains(&fault) {
                records.faults.push(fault);
            }
        };
        match session::begin(socket, &path, names) {
            Ok(Some(session)) => {
                number += 1;
                records.files.push(session::run(session, names, &orders.stop, &mut fault));
            }
            Ok(None) => {}
            Err(error) => fault(error.to_string()),
        }
        if !orders.close.load(Ordering::Relaxed) {
            std::thread::sleep(RETRY);
        }
    }
    records
}

impl fmt::Display for Recorded {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { merged, files, written, dropped, bound_ns, faults } = self;
        match (merged, files.first()) {
            (Some(path), _) => {
                let (path, bound_us) = (path.display(), bound_ns / 1000);
                writeln!(
                    f,
                    "recorded: {path}, {written} messages, {dropped} dropped, times within {bound_us} us"
                )?;
                writeln!(f, "replay it: exoskeleton --replay {path}")?;
            }
            (None, Some(first)) => {
                writeln!(f, "recorded: {} and the files beside it, not merged", first.display())?
            }
            (None, None) => writeln!(f, "not recorded")?,
        }
        faults.iter().try_for_each(|fault| writeln!(f, "  {fault}"))
    }
}
