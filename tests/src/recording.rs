//! The claim: a recording delays no sender, and each message is in the file or counted as dropped.
//!
//! The first node has applications that send to one sink, each at a rate. `sinew record` records it.
//!
//! | file | content |
//! | --- | --- |
//! | `node` | the role of the recorded node |
//! | `accounts` | the counters of a file, by source |
//! | `report` | send times with and without a recording |
//! | `slow_writes.c` | a disk on which each write takes longer |

mod accounts;
mod node;
mod report;

use std::{
    path::{Path, PathBuf},
    process::Command,
    time::Duration,
};

use rustix::process::Signal;
use serde_json::Value;
use sinew_testkit::{
    NodeProcess, TestDirectory, numbers, own_group, preload::Preload, program, unique, until,
};

pub use self::{
    accounts::{Account, Accounts, messages_in, tallies_in},
    report::{Report, Round},
};
use crate::role;

/// The application that gets all messages.
const SINK: &str = "sink";

/// The name of a source.
#[must_use]
pub fn source(number: u64) -> String {
    format!("source.{number}")
}

/// The messages that each source sends.
#[derive(Clone, Copy, Debug)]
pub struct Load {
    /// Messages per second. A slow machine sends fewer.
    pub rate: u64,
    /// Bytes of filler in each.
    pub length: u64,
    /// Their number.
    pub count: u64,
}

/// Time that the sources needed.
#[derive(Clone, Debug)]
pub struct Sent {
    /// Median time of one call that sends.
    pub p50: Duration,
    /// 99th percentile.
    pub p99: Duration,
    /// Maximum.
    pub max: Duration,
    /// Time of all.
    pub took: Duration,
    /// Accepted and refused messages of each source.
    pub channels: Vec<[u64; 2]>,
}

impl Sent {
    fn line(&self) -> String {
        let times = [self.p50, self.p99, self.max, self.took].map(|time| time.as_nanos().to_string());
        let counts = self.channels.iter().flatten().map(u64::to_string);
        times.into_iter().chain(counts).collect::<Vec<_>>().join(" ")
    }

    fn read(line: &str) -> Self {
        let all = numbers(line);
        let [p50, p99, max, took, counts @ ..] = &all[..] else { panic!("{line:?} has no times") };
        let [p50, p99, max, took] = [p50, p99, max, took].map(|ns| Duration::from_nanos(*ns));
        let channels = counts.chunks_exact(2).map(|pair| [pair[0], pair[1]]).collect();
        Self { p50, p99, max, took, channels }
    }

    /// Accepted and refused messages of all sources.
    #[must_use]
    pub fn total(&self) -> u64 {
        self.channels.iter().flatten().sum()
    }
}

/// Runs the role of the recorded node.
pub(crate) fn run_node(arguments: &[String]) {
    node::run(arguments);
}

/// The command `sinew`.
///
/// # Panics
/// If it was not built.
#[must_use]
pub fn sinew() -> Command {
    let path = program("sinew");
    assert!(path.exists(), "there is no {}; build it: cargo build -p sinew-cli", path.display());
    let mut command = Command::new(path);
    command.env_remove("SINEW_SOCKET");
    command
}

/// A node with sources, and the folder of its files.
#[derive(Debug)]
pub struct Recorded {
    /// The folder.
    pub directory: TestDirectory,
    node: NodeProcess,
}

impl Recorded {
    /// Starts the node with so many sources. Its ring has `keep_bytes`, or the default.
    ///
    /// # Panics
    /// If it does not start.
    #[must_use]
    pub fn start(sources: u64, keep_bytes: Option<u64>) -> Self {
        let directory = TestDirectory::new();
        let ring = keep_bytes.map(|bytes| format!("[record]\nkeep_bytes = {bytes}\n")).unwrap_or_default();
        // The journal of a node is named by its project and its address.
        let text = format!(
            "[node]\nname = \"knee\"\naddress = \"127.0.0.1\"\nproject = \"recording-{}\"\n\
             [lncl]\nsocket = \"{}\"\n{ring}[ndl]\nmulticast = \"{}\"\nmdns_port = false\n",
            unique(),
            directory.join("knee.sock").display(),
            own_group()
        );
        let path = directory.write("knee.toml", &text);
        let mut command = role("recorded");
        command.arg(path).arg(sources.to_string());
        let mut node = NodeProcess::start("knee", command);
        node.wait_for(&["up"]);
        Self { directory, node }
    }

    /// Has each source send. A node that is too slow stops after one and a half times the time
    /// that the rate needs, and 10 s.
    ///
    /// # Panics
    /// If the node does not answer.
    pub fn send(&mut self, load: Load) -> Sent {
        let Load { rate, length, count } = load;
        Sent::read(&self.node.ask(&format!("{rate} {length} {count}")))
    }

    /// `sinew record FILE --json` with further words, as a command.
    #[must_use]
    pub fn recorder(&self, file: &Path, words: &[&str]) -> Command {
        let mut command = sinew();
        command.arg("--socket").arg(self.directory.join("knee.sock")).args(["--deadline-ms", "10000"]);
        command.arg("record").arg(file).arg("--json").args(words);
        command
    }

    /// Ends the node.
    ///
    /// # Panics
    /// If it does not end well.
    pub fn stop(self) {
        let status = self.node.stop();
        assert!(status.success(), "the node ended with {status}");
    }
}

/// A running `sinew record`.
#[derive(Debug)]
pub struct Recorder {
    /// The process.
    pub process: NodeProcess,
    /// The first file.
    pub file: PathBuf,
}

impl Recorder {
    /// Starts it. Returns when it records: the file has a tally beside that of its beginning.
    ///
    /// # Panics
    /// If it does not begin.
    #[must_use]
    pub fn start(command: Command, file: &Path) -> Self {
        let process = NodeProcess::start("sinew record", command);
        until("it records", || (tallies_in(file) > 1).then_some(()));
        Self { process, file: file.to_owned() }
    }

    /// Ends the recording. Returns the exit code of the command, and the JSON that it prints.
    ///
    /// # Panics
    /// If it does not end, or prints no JSON.
    pub fn finish(&mut self) -> (Option<i32>, Value) {
        self.process.signal(Signal::TERM);
        let code = self.process.wait_for_exit();
        let text = self.process.output().join("\n");
        let json = serde_json::from_str(&text).unwrap_or_else(|error| panic!("{error}: {text}"));
        (code, json)
    }
}

/// A disk on which each write to a recording takes longer.
#[derive(Debug)]
pub struct SlowWrites {
    library: Preload,
    count: PathBuf,
}

impl SlowWrites {
    /// Compiles the library into `directory`.
    ///
    /// # Panics
    /// If there is no C compiler called `cc`.
    #[must_use]
    pub fn new(directory: &TestDirectory) -> Self {
        let library =
            Preload::build(&directory.join("."), "slow_writes", include_str!("recording/slow_writes.c"));
        let count = directory.write("slow_writes.count", "\0\0\0\0\0\0\0\0");
        Self { library, count }
    }

    /// Gives the command such a disk.
    pub fn apply(&self, command: &mut Command, takes: Duration) {
        command.env(Preload::VARIABLE, self.library.path());
        command.env("SINEW_SLOW_MS", takes.as_millis().to_string()).env("SINEW_SLOW_COUNT", &self.count);
    }

    /// Returns how many writes were slow.
    ///
    /// # Panics
    /// If the file of the count is gone.
    #[must_use]
    pub fn count(&self) -> i64 {
        let bytes = std::fs::read(&self.count).expect("it is there");
        bytes.first_chunk().copied().map_or(0, i64::from_ne_bytes)
    }
}

/// The parameters of a run.
#[derive(Clone, Debug)]
pub struct Plan {
    /// Sources, each with a channel.
    pub sources: u64,
    /// The messages that each sends in a round.
    pub load: Load,
    /// Rounds without and with a recording, in turns.
    pub rounds: u32,
    /// Time that each write takes longer. Zero: an ordinary disk.
    pub write_takes: Duration,
    /// Bytes of the node's ring.
    pub keep_bytes: Option<u64>,
}

/// Records in each second round, and measures the calls that send in all.
///
/// # Panics
/// If the node or the recorder does not start, or a file cannot be read.
#[must_use]
pub fn run(plan: &Plan) -> Report {
    let mut node = Recorded::start(plan.sources, plan.keep_bytes);
    let slow = (!plan.write_takes.is_zero()).then(|| SlowWrites::new(&node.directory));
    let mut rounds = Vec::new();
    for number in 0..plan.rounds {
        let without = node.send(plan.load);
        let file = node.directory.join(&format!("round-{number}.mcap"));
        let mut command = node.recorder(&file, &[]);
        if let Some(slow) = &slow {
            slow.apply(&mut command, plan.write_takes);
        }
        let mut recorder = Recorder::start(command, &file);
        let with = node.send(plan.load);
        let (code, summary) = recorder.finish();
        let accounts = Accounts::of(&[&file]);
        let mut faults = accounts.differences(&with.channels);
        if code != Some(0) {
            faults.push(format!("sinew record ended with {code:?}: {}", summary["faults"]));
        }
        rounds.push(Round { without, with, dropped: accounts.dropped(), faults });
        std::fs::remove_file(&file).expect("it was written");
    }
    node.stop();
    Report { plan: plan.clone(), rounds }
}
