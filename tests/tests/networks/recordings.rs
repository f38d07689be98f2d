//! Three hosts with different clocks, each recorded by itself: their files on one time line, beside the true times.

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
    process::Command,
};

use serde::Deserialize;
use serde_json::Value;
use sinew_bag::{
    Direction,
    read::{Item, Reader, Role},
};
use sinew_testkit::{
    Hosts, NodeProcess, TestDirectory, own_group, preload::Preload, sandbox::in_own_time_namespace, unique,
    until,
};
use sinew_tests::{recording::sinew, role};

const NAMES: [&str; 3] = ["hip", "knee", "ankle"];
/// The monotonic clock of each host is ahead of the machine's by these seconds.
const MONOTONIC_AHEAD_S: [u64; 3] = [10, 1_000, 50_000];
/// The wall clock of each host is ahead of the machine's by these seconds.
const WALL_AHEAD_S: [u64; 3] = [0, 5, 10];
const SECOND: i64 = 1_000_000_000;
/// Messages of each node that are compared at least: one is sent every 20 ms, for 4 s.
const COMPARED_MIN: usize = 20;

/// The payload `scenario.stamp`: the time of the sender before it sent this message, and after it had sent the last.
#[derive(Deserialize)]
struct Stamp {
    number: u64,
    before_ns: i64,
    last_after_ns: i64,
}

/// A message in the merged file.
struct Merged {
    /// The node that recorded it.
    node: usize,
    /// The node that sent it.
    source: usize,
    stamp: Stamp,
    log_ns: i64,
    publish_ns: i64,
}

/// Three hosts, and their clocks.
struct Robot {
    directory: TestDirectory,
    hosts: Hosts,
    clock: Preload,
}

impl Robot {
    /// `None`, with a printed reason, if no hosts or no such clocks can be made.
    fn new() -> Option<Self> {
        let directory = TestDirectory::new();
        let hosts = Hosts::new(3);
        let hosts = hosts.inspect_err(|why| println!("skipped: no hosts can be made here: {why}")).ok()?;
        let clock = Preload::wall_clock(&directory.join("."))?;
        in_own_time_namespace(&Command::new("true"), 1)?;
        Some(Self { directory, hosts, clock })
    }

    /// The same command on a host, with its clocks.
    fn on(&self, host: usize, command: &Command) -> Command {
        let shifted = in_own_time_namespace(command, MONOTONIC_AHEAD_S[host]).expect("it worked before");
        let mut moved = self.hosts.all()[host].moved(&shifted);
        moved.env(Preload::VARIABLE, self.clock.path());
        moved.env(Preload::WALL_AHEAD, WALL_AHEAD_S[host].to_string());
        moved
    }

    fn file(&self, host: usize) -> PathBuf {
        self.directory.join(&format!("{}.mcap", NAMES[host]))
    }

    /// `sinew` on a host.
    fn sinew(&self, host: usize, words: &[&str]) -> Command {
        let mut command = sinew();
        let socket = self.directory.join(&format!("{}.sock", NAMES[host]));
        command.arg("--socket").arg(socket).args(["--deadline-ms", "10000"]).args(words);
        self.on(host, &command)
    }

    /// Starts the nodes. Each sends stamps to the next one.
    fn start(&self) -> Vec<NodeProcess> {
        let (group, project) = (own_group(), unique());
        let start = |host: usize| {
            let (name, address) = (NAMES[host], host + 1);
            let text = format!(
                "[node]\nname = \"{name}\"\nproject = \"clocks-{project}\"\n[lncl]\nsocket = \"{}\"\n\
                 [ndl]\ninterface = \"10.77.0.{address}\"\nmulticast = \"{group}\"\n",
                self.directory.join(&format!("{name}.sock")).display()
            );
            let mut command = role("node_under_test");
            command.arg(self.directory.write(&format!("{name}.toml"), &text));
            command.args(["--stamps-to", NAMES[(host + 1) % NAMES.len()]]);
            NodeProcess::start(name, self.on(host, &command))
        };
        let mut nodes: Vec<_> = (0..NAMES.len()).map(start).collect();
        for node in &mut nodes {
            node.wait_for(&["started"]);
        }
        nodes
    }

    /// Waits until each node has measured the clocks of the others.
    fn wait_for_clocks(&self) {
        for host in 0..NAMES.len() {
            until("the clocks of the others are known", || {
                let output = self.sinew(host, &["nodes", "--json"]).output().expect("it starts");
                let json: Value = serde_json::from_slice(&output.stdout).ok()?;
                let all = json["nodes"].as_array()?;
                let known = all.iter().filter(|node| node["clock_offset_ns"].is_i64()).count();
                (all.len() == NAMES.len() && known >= NAMES.len() - 1).then_some(())
            });
        }
    }

    /// Records all nodes at the same time.
    fn record(&self) {
        let start = |host: usize| {
            let file = self.file(host).display().to_string();
            let words = ["record", &*file, "--type", "scenario.stamp", "--for", "4s", "--json"];
            NodeProcess::start("sinew record", self.sinew(host, &words))
        };
        let recorders: Vec<_> = (0..NAMES.len()).map(start).collect();
        for mut recorder in recorders {
            assert_eq!(recorder.wait_for_exit(), Some(0), "{:?}", recorder.output());
        }
    }
}

/// Runs `sinew bag` with the three files.
fn bag(robot: &Robot, order: &str, words: &[&str]) {
    let mut command = sinew();
    command.args(["bag", order]).args((0..NAMES.len()).map(|host| robot.file(host))).args(words);
    let output = command.output().expect("it starts");
    let text =
        [output.stdout, output.stderr].map(|bytes| String::from_utf8_lossy(&bytes).into_owned()).concat();
    assert_eq!(output.status.code(), Some(0), "{text}");
}

/// Returns the node with this address.
fn node_at(address: &str) -> usize {
    let last = address.rsplit('.').next().and_then(|last| last.parse::<usize>().ok());
    last.and_then(|last| last.checked_sub(1)).unwrap_or_else(|| panic!("{address:?} is no host's"))
}

/// Reads a file: the stamps of a merged one, in the order of their times, and the metadata records.
fn read(path: &Path, is_merged: bool) -> (Vec<Merged>, BTreeMap<String, BTreeMap<String, String>>) {
    let mut reader = Reader::open(path).expect("it can be opened");
    let (mut stamps, mut metadata, mut last_ns) = (Vec::new(), BTreeMap::new(), 0);
    while let Some(item) = reader.next_item().expect("it is whole") {
        match item {
            Item::Metadata(name, fields) => {
                metadata.insert(name, fields);
            }
            Item::Message(message) => {
                let channel = &message.channel;
                assert!(!is_merged || message.log_ns >= last_ns, "{}: {}", channel.topic, message.log_ns);
                last_ns = message.log_ns;
                let is_stamp = channel.role() == Role::Raw && channel.value("type") == "scenario.stamp";
                if is_merged && is_stamp && channel.value("refused").is_empty() {
                    let node = node_at(channel.value("node"));
                    let source = node_at(channel.value("source_node"));
                    let is_sent = channel.direction() == Some(Direction::Sent);
                    assert_eq!(is_sent, node == source, "{}", channel.topic);
                    let stamp = rmp_serde::from_slice(message.data).expect("it is a stamp");
                    let [log_ns, publish_ns] = [message.log_ns, message.publish_ns].map(|ns| ns as i64);
                    stamps.push(Merged { node, source, stamp, log_ns, publish_ns });
                }
            }
        }
    }
    (stamps, metadata)
}

/// Returns the wall clock of each node minus its monotonic clock, as its own file states it.
fn wall_offsets(robot: &Robot) -> [i64; 3] {
    [0, 1, 2].map(|host| {
        let (_, metadata) = read(&robot.file(host), false);
        metadata["sinew"]["wall_offset_ns"].parse().expect("a number")
    })
}

fn ahead_ns(host: usize) -> i64 {
    MONOTONIC_AHEAD_S[host] as i64 * SECOND
}

/// Compares the times of the merged file with the true ones.
fn compare(merged: &[Merged], bounds: [i64; 3], reference_wall_ns: i64) {
    // A time of a host's monotonic clock, on the wall clock of the first host.
    let truth = |host: usize, at_ns: i64| at_ns - ahead_ns(host) + ahead_ns(0) + reference_wall_ns;
    let sent = || merged.iter().filter(|message| message.node == message.source);
    let ends: BTreeMap<_, _> =
        sent().map(|Merged { node, stamp, .. }| ((*node, stamp.number - 1), stamp.last_after_ns)).collect();
    let mut compared = [0; 3];
    let mut line = Vec::new();
    for Merged { node, stamp, publish_ns, .. } in sent() {
        let Some(end_ns) = ends.get(&(*node, stamp.number)) else { continue };
        // It was sent between these two times, in truth.
        let (from, to) = (truth(*node, stamp.before_ns), truth(*node, *end_ns));
        let bound = bounds[*node];
        assert!(
            (from - bound..=to + bound).contains(publish_ns),
            "{} of {}: {publish_ns} is not within {from} to {to}, bound {bound}",
            stamp.number,
            NAMES[*node]
        );
        compared[*node] += 1;
        line.push((*publish_ns, from, to, bound));
    }
    assert!(compared.iter().all(|count| *count >= COMPARED_MIN), "{compared:?}");
    // Two messages have the true order, unless they are nearer to each other than both bounds.
    line.sort_unstable();
    let mut latest = i64::MIN;
    for (_, from, to, bound) in &line {
        assert!(latest <= to + bound, "{latest} is before {to}, bound {bound}");
        latest = latest.max(from - bound);
    }
    // And no message was received before it was sent.
    let received: Vec<_> = merged.iter().filter(|message| message.node != message.source).collect();
    assert!(received.len() >= COMPARED_MIN, "{} were received", received.len());
    for Merged { node, source, stamp, log_ns, .. } in received {
        let from = truth(*source, stamp.before_ns);
        assert!(*log_ns >= from - bounds[*node], "{} of {} came too early", stamp.number, NAMES[*source]);
    }
}

#[test]
fn hosts_with_different_clocks_have_one_time_line() {
    // Given: three hosts, and the clocks of each are others
    let Some(robot) = Robot::new() else { return };
    let _nodes = robot.start();
    robot.wait_for_clocks();
    // When: each is recorded, and the files are merged
    robot.record();
    bag(&robot, "check", &[]);
    let out = robot.directory.join("robot.mcap");
    bag(&robot, "merge", &["--out", &out.display().to_string()]);
    // Then: the wall clocks were 5 s apart
    let offsets = wall_offsets(&robot);
    let wall = [0, 1, 2].map(|host: usize| offsets[host] + ahead_ns(host));
    for (host, ahead_s) in WALL_AHEAD_S.into_iter().enumerate() {
        let wrong = wall[host] - wall[0] - ahead_s as i64 * SECOND;
        assert!(wrong.abs() < SECOND, "the wall clock of {} is wrong by {wrong} ns", NAMES[host]);
    }
    // And: the stated bounds are smaller than that
    let (merged, metadata) = read(&out, true);
    let bounds = [1, 2, 3].map(|host| {
        let text = &metadata["sinew.merged"][&format!("bound_ns 10.77.0.{host}")];
        text.parse::<i64>().expect("a number")
    });
    assert!(bounds.iter().all(|bound| *bound < 5 * SECOND), "{bounds:?}");
    assert_eq!(bounds[0], 0, "the clock is that of the first file's node");
    // And: all times are true within them
    compare(&merged, bounds, offsets[0]);
}
