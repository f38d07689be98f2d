//! `sinew logs`: the log lines of all nodes, in the order of time.
//!
//! Each node keeps its newest lines, and answers questions about them. The command asks all nodes one after the other,
//! and holds a line back until every node was read up to its time.

mod merge;
mod screen;
mod source;

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
    time::Duration,
};

use clap::{Args, ValueEnum};
use serde_json::Value;
use sinew::{
    AppAddress, NodeAddress, Tid, Time,
    inspect::{LogsReport, NodeReport},
};

use crate::{
    Report,
    record::{sizes, stop::StopRequest},
    system::{System, SystemError, chosen, in_words},
    unknown::Target,
};
use merge::Merge;
use screen::{Screen, Wall};
use source::Source;

/// Interval between two rounds of questions.
const PERIOD: Duration = Duration::from_millis(250);
/// Interval between two questions to the entry node about the nodes of the system and their clocks.
const NODES_PERIOD: Duration = Duration::from_secs(1);
/// Time limit for an answer while new lines are followed: a node that does not answer delays the lines of the others.
const FOLLOWED_WITHIN: Duration = Duration::from_millis(500);
/// Interval at which a node without an answer is asked again.
const RETRY_PERIOD: Duration = Duration::from_secs(2);
/// Maximum number of nodes that are read. Nodes that left are among them.
const NODES_MAX: usize = 4_096;
/// Maximum number of questions to a node in one round. The next round continues.
const QUESTIONS_MAX: usize = 64;

/// The arguments of `sinew logs`.
#[derive(Debug, Args)]
pub(crate) struct Order {
    /// Show new lines, too, until Ctrl-C
    #[arg(long, short)]
    follow: bool,
    /// Only of this node: its address or name
    #[arg(long, value_name = "NODE")]
    node: Option<String>,
    /// Only lines of this level and of more severe ones. A node keeps the lines that it logs: `log.level` of its
    /// configuration, or SINEW_LOG there
    #[arg(long, value_enum, default_value_t = LeastLevel::Trace)]
    level: LeastLevel,
    /// Only lines of the last so long, as in 10s or 5m. Without it: all that the nodes keep
    #[arg(long, value_name = "TIME", value_parser = sizes::time)]
    since: Option<Duration>,
    /// The end of the standard output and standard error of the processes that `sinew up` has started by this robot
    /// file, from all its hosts. Without a node's name 64 KiB of each, else 1 MiB
    #[arg(long, value_name = "FILE", conflicts_with_all = ["follow", "level", "since"])]
    robot: Option<PathBuf>,
}

impl Order {
    /// Returns the robot file, if the logs of its processes are asked for.
    pub(crate) fn robot(&self) -> Option<&Path> {
        self.robot.as_deref()
    }

    /// Returns the node that is asked for.
    pub(crate) fn node(&self) -> Option<&str> {
        self.node.as_deref()
    }
}

/// The least severe level that is shown.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum LeastLevel {
    /// Failures that need attention
    Error,
    /// Deviations after which operation continues
    Warn,
    /// Rare events that are in order
    Info,
    /// Events for fault analysis
    Debug,
    /// All lines
    Trace,
}

impl LeastLevel {
    const fn word(self) -> &'static str {
        match self {
            Self::Error => "error",
            Self::Warn => "warn",
            Self::Info => "info",
            Self::Debug => "debug",
            Self::Trace => "trace",
        }
    }
}

/// Shows the lines of the nodes, and with `--follow` new ones until the user ends it.
pub(crate) fn show(system: &mut System, order: &Order, is_json: bool) -> Result<Report, SystemError> {
    let stop = if order.follow { Some(listen()?) } else { None };
    let here = system.here()?;
    let began = Time::now();
    let mut reader = Reader::new(order, is_json, began);
    if !reader.set_nodes(&here) {
        return Err(system.unknown(order.node.as_deref().unwrap_or_default(), Target::Node));
    }
    let mut nodes_due = began + NODES_PERIOD;
    let is_over = || stop.as_ref().is_some_and(StopRequest::is_there);
    while let Some(has_more) = reader.round(system, &is_over) {
        system.discard();
        let is_last = is_over() || !(order.follow || has_more);
        if !reader.print(is_last) || is_last {
            break;
        }
        if !has_more {
            std::thread::sleep(PERIOD);
        }
        if Time::now() >= nodes_due {
            // Without an answer of the entry node the known nodes are asked again.
            if let Ok(here) = system.here() {
                reader.set_nodes(&here);
            }
            nodes_due = Time::now() + NODES_PERIOD;
        }
    }
    // All lines were shown as they were read.
    Ok(Report { text: String::new(), json: Value::Null, is_fine: reader.are_all_read() })
}

fn listen() -> Result<StopRequest, SystemError> {
    StopRequest::listen()
        .map_err(|why| SystemError::View(format!("Ctrl-C cannot be handled: {why}; free descriptors")))
}

/// The nodes, and the lines that are not shown yet.
struct Reader<'o> {
    order: &'o Order,
    screen: Screen,
    /// Older lines are not shown.
    since_ns: u64,
    /// Without `--follow`: a node is read up to here.
    began: Time,
    sources: BTreeMap<NodeAddress, Source>,
    merge: Merge,
}

impl<'o> Reader<'o> {
    fn new(order: &'o Order, is_json: bool, began: Time) -> Self {
        let since_ns = order.since.map_or(0, |since| (began - since).as_nanos());
        let (sources, merge) = (BTreeMap::new(), Merge::default());
        Self { order, screen: Screen { is_json }, since_ns, began, sources, merge }
    }

    /// Adds new nodes, and the latest measurements of all clocks. Returns whether any node is wanted.
    fn set_nodes(&mut self, here: &NodeReport) -> bool {
        let wanted = chosen(here, self.order.node.as_deref()).unwrap_or_default();
        for (node, name) in &wanted {
            if self.sources.len() >= NODES_MAX && !self.sources.contains_key(node) {
                continue;
            }
            let new = || Source::new(*node, name.clone());
            let source = self.sources.entry(*node).or_insert_with(new);
            let measured = here.peers.iter().find(|peer| peer.node == *node).and_then(|peer| peer.offset_ns);
            source.offset_ns = if *node == here.node { Some(0) } else { measured };
        }
        !wanted.is_empty()
    }

    /// Reads each node up to now. Returns whether there are further lines; `None` if there is no reader any more.
    fn round(&mut self, system: &mut System, is_over: &dyn Fn() -> bool) -> Option<bool> {
        let mut has_more = false;
        for node in self.sources.keys().copied().collect::<Vec<_>>() {
            if is_over() {
                break;
            }
            has_more |= self.read(system, node);
            if self.merge.is_full() && !self.print(false) {
                return None;
            }
        }
        Some(has_more)
    }

    /// Reads a node up to now. Returns whether it has further lines.
    fn read(&mut self, system: &mut System, node: NodeAddress) -> bool {
        let within = if self.order.follow { system.within.min(FOLLOWED_WITHIN) } else { system.within };
        let to = Tid::new(node, AppAddress::INSPECT);
        let source = self.sources.get_mut(&node).filter(|source| Time::now() >= source.due);
        let Some(source) = source else { return false };
        for _ in 0..QUESTIONS_MAX {
            let question = source.question(self.order.level.word());
            match system.endpoint.message(to, &question).ask::<LogsReport>(within) {
                Ok(report) => {
                    let entries = source.take(report, Time::now());
                    entries.into_iter().for_each(|entry| self.merge.push(entry));
                    if source.fault.take().is_some() {
                        self.screen.state(&node.to_string(), &source.name, None);
                    }
                }
                Err(error) => {
                    let why = in_words(&error);
                    if source.fault.is_none() {
                        self.screen.state(&node.to_string(), &source.name, Some(&why));
                    }
                    (source.fault, source.more) = (Some(why), false);
                    source.due = Time::now() + RETRY_PERIOD;
                }
            }
            if !source.more {
                break;
            }
        }
        // A node that logs faster than it is read is not read without end.
        source.more && (self.order.follow || source.read_ns < self.began.as_nanos())
    }

    /// Prints the lines up to the time up to which all nodes were read, or all lines. Returns whether there is still a
    /// reader.
    fn print(&mut self, is_last: bool) -> bool {
        let read = self.sources.values().filter(|source| source.fault.is_none());
        let until_ns =
            if is_last { u64::MAX } else { read.map(|source| source.read_ns).min().unwrap_or(u64::MAX) };
        let wall = Wall::now();
        for entry in self.merge.release(until_ns) {
            let name = self.sources.get(&entry.node).map_or("", |source| source.name.as_str());
            if entry.at_ns >= self.since_ns && !self.screen.entry(wall, name, &entry) {
                return false;
            }
        }
        true
    }

    fn are_all_read(&self) -> bool {
        self.sources.values().all(|source| source.fault.is_none())
    }
}
