//! Nodes on a rough network, which loses and delays packets. With seeds alone they discover, start, meet and
//! lose each other in the same way as with multicast.

use std::{fmt::Write, net::SocketAddrV4, panic::resume_unwind, thread, time::Duration};

use rustix::process::Signal;
use sinew_testkit::Weather;
use sinew_testkit::{Hosts, NodeProcess, TestDirectory, own_group, until};
use sinew_tests::node_under_test;

const NAMES: [&str; 4] = ["central", "hip", "knee", "ankle"];
/// The node that is lost, again and again.
const KNEE: usize = 2;
/// The other nodes, which report its loss.
const OTHERS: [&str; 3] = ["central", "hip", "ankle"];
/// A loss takes three to four periods: within a second, and longer than a busy machine stalls.
const PERIOD_MS: u32 = 250;
/// One frame in twenty.
const LOSS: f64 = 0.05;
const DELAY: Duration = Duration::from_millis(5);
const JITTER: Duration = Duration::from_millis(2);
const ROUGH: Weather = Weather { loss: LOSS, delay: DELAY, jitter: JITTER };
/// For checks of the class of a loss. On a rough network that class is random: if the question to the host of
/// a silent node is lost, the node counts as out of reach (NDL-4.6).
const CALM: Weather = Weather { loss: 0.0, ..ROUGH };

/// How nodes find each other.
#[derive(Clone, Copy, PartialEq, Eq)]
enum By {
    Multicast,
    /// Each node lists those before it: of each pair one must list the other.
    Seeds,
}

/// Results that do not depend on the kind of discovery.
#[derive(Debug, Default, PartialEq, Eq)]
struct Outcome {
    /// The nodes in the order in which their applications started.
    started: Vec<&'static str>,
    /// The line of each node when the barrier opened.
    met: Vec<String>,
    /// Each reporting node with the class of the loss, in the order of the losses.
    losses: Vec<(&'static str, String)>,
    /// Each reporting node with the names in its directory and their readiness, in the order of the events.
    directories: Vec<(&'static str, String)>,
}

impl Outcome {
    /// Records the loss as each of `nodes` reports it next.
    fn note_losses<'nodes>(&mut self, nodes: impl Iterator<Item = (&'static str, &'nodes mut NodeProcess)>) {
        for (name, node) in nodes {
            let line = node.wait_for(&["NodeLost", NAMES[KNEE]]);
            let why = line.split_once("why: ").and_then(|(_, rest)| rest.split_once(','));
            let (class, _) = why.unwrap_or_else(|| panic!("a loss has a reason: {line}"));
            self.losses.push((name, class.to_owned()));
        }
    }

    /// Records the directories once each of `nodes` has exactly these names, all of them ready: the nodes
    /// learn of changes one after the other.
    fn note_directories<'nodes>(
        &mut self,
        nodes: impl Iterator<Item = (&'static str, &'nodes mut NodeProcess)>,
        there: &[&str],
    ) {
        let mut entries: Vec<String> = there.iter().map(|name| format!("{name}=true")).collect();
        entries.sort_unstable();
        let whole = format!("directory {}", entries.join(" "));
        for (name, node) in nodes {
            let line = until(&format!("'{whole}' of {name}"), || {
                node.send_line("directory");
                let line = node.wait_for(&["directory "]);
                (line == whole).then_some(line)
            });
            self.directories.push((name, line));
        }
    }
}

/// All nodes with their names.
fn named(nodes: &mut [NodeProcess]) -> impl Iterator<Item = (&'static str, &mut NodeProcess)> {
    NAMES.into_iter().zip(nodes)
}

/// The nodes that report the loss of the knee.
fn others(nodes: &mut [NodeProcess]) -> impl Iterator<Item = (&'static str, &mut NodeProcess)> {
    named(nodes).filter(|(name, _)| *name != NAMES[KNEE])
}

/// The nodes in the order in which their applications started, by the clock that all hosts of this machine
/// share.
fn order_of_start(nodes: &mut [NodeProcess]) -> Vec<&'static str> {
    let mut started: Vec<(u64, &str)> = named(nodes)
        .map(|(name, node)| {
            let line = node.wait_for(&["clock_ns "]);
            let at = line.strip_prefix("clock_ns ").and_then(|nanos| nanos.parse().ok());
            (at.unwrap_or_else(|| panic!("it has a start time: {line}")), name)
        })
        .collect();
    started.sort_unstable();
    started.into_iter().map(|(_, name)| name).collect()
}

struct Scenario {
    hosts: Hosts,
    directory: TestDirectory,
    group: SocketAddrV4,
    by: By,
}

impl Scenario {
    fn new(by: By) -> Option<Self> {
        let hosts =
            Hosts::on_radio(4, 11).inspect_err(|why| println!("skipped: no hosts can be made here: {why}"));
        let hosts = hosts.ok()?;
        hosts.set_weather(ROUGH);
        if by == By::Seeds {
            hosts.drop_multicast();
        }
        Some(Self { hosts, directory: TestDirectory::new(), group: own_group(), by })
    }

    /// Each node requires the one that is started after it, so the applications start in reverse order.
    fn start(&self, index: usize, more: &[&str]) -> NodeProcess {
        let mut arguments = vec!["--says-directory"];
        if let Some(required) = NAMES.get(index + 1) {
            arguments.extend(["--requires", *required]);
        }
        arguments.extend(more);
        self.start_asking(index, PERIOD_MS, &arguments)
    }

    /// The node sends a query each `period_ms`, and also to the multicast group; whether these arrive depends
    /// on the network.
    fn start_asking(&self, index: usize, period_ms: u32, more: &[&str]) -> NodeProcess {
        let (name, address) = (NAMES[index], index + 1);
        let mut text = format!(
            "[node]\nname = \"{name}\"\nproject = \"seeds\"\n[ndl]\ninterface = \"10.77.0.{address}\"\nport = 6911\n\
             multicast = \"{}\"\nmdns_port = false\nperiod_ms = {period_ms}\n",
            self.group
        );
        if self.by == By::Seeds {
            let seeds: Vec<_> = (1..address).map(|other| format!("\"10.77.0.{other}:6911\"")).collect();
            writeln!(text, "seeds = [{}]", seeds.join(", ")).expect("a string takes any text");
        }
        let path = self.directory.write(&format!("{name}.toml"), &text);
        node_under_test(Some(&self.hosts.all()[index]), &path, more)
    }

    /// All nodes find each other, start in the order of their requirements, and meet. One is killed,
    /// restarts, hangs, continues, and stops in order.
    fn run(&self) -> Outcome {
        let mut outcome = Outcome::default();
        let meets: Vec<&str> = NAMES.into_iter().flat_map(|name| ["--meets", name]).collect();
        let mut nodes: Vec<_> = (0..NAMES.len()).map(|index| self.start(index, &meets)).collect();
        for (name, node) in named(&mut nodes) {
            for other in NAMES.iter().filter(|other| **other != name) {
                node.wait_for(&["NodeFound", other]);
            }
        }
        outcome.started = order_of_start(&mut nodes);
        outcome.met = nodes.iter_mut().map(|node| node.wait_for(&["met "])).collect();
        outcome.note_directories(named(&mut nodes), &NAMES);

        self.hosts.set_weather(CALM);
        nodes[KNEE].signal(Signal::KILL);
        outcome.note_losses(others(&mut nodes));
        outcome.note_directories(others(&mut nodes), &OTHERS);

        self.hosts.set_weather(ROUGH);
        // The others do not wait at the barrier again.
        nodes[KNEE] = self.start(KNEE, &[]);
        for (_, node) in others(&mut nodes) {
            node.wait_for(&["NodeRestarted", NAMES[KNEE]]);
        }
        for other in OTHERS {
            nodes[KNEE].wait_for(&["NodeFound", other]);
        }
        outcome.note_directories(named(&mut nodes), &NAMES);

        self.hosts.set_weather(CALM);
        nodes[KNEE].pause();
        outcome.note_losses(others(&mut nodes));
        outcome.note_directories(others(&mut nodes), &OTHERS);
        nodes[KNEE].signal(Signal::CONT);
        for (_, node) in others(&mut nodes) {
            node.wait_for(&["NodeFound", NAMES[KNEE]]);
        }
        outcome.note_directories(named(&mut nodes), &NAMES);

        nodes[KNEE].signal(Signal::TERM);
        outcome.note_losses(others(&mut nodes));
        outcome.note_directories(others(&mut nodes), &OTHERS);
        outcome
    }
}

#[test]
fn seeds_alone_give_the_same_results_as_multicast() {
    // Given: the same four nodes, in two networks of their own
    let Some(by_multicast) = Scenario::new(By::Multicast) else { return };
    let Some(by_seeds) = Scenario::new(By::Seeds) else { return };
    // When: the same events happen to both, at the same time, so that the test takes as long as one of them
    let [by_multicast, by_seeds] = thread::scope(|scope| {
        let runs = [&by_multicast, &by_seeds].map(|scenario| scope.spawn(move || scenario.run()));
        runs.map(|run| run.join().unwrap_or_else(|panic| resume_unwind(panic)))
    });
    // Then: required applications started first, all met, and each loss has the class of its cause
    assert_eq!(by_multicast.started, ["ankle", "knee", "hip", "central"]);
    assert_eq!(by_multicast.met, ["met 1"; NAMES.len()]);
    let losses = ["Crashed", "Hung", "Left"].map(|class| OTHERS.map(|name| (name, class.to_owned())));
    assert_eq!(by_multicast.losses, losses.as_flattened());
    // And: with seeds the results are the same
    assert_eq!(by_seeds, by_multicast);
}

/// Measures, on a machine with idle CPUs, how often a living node is lost, which should never happen, and how
/// often its NDL is not heard. `docs/book/src/contributing/testing.md` has the command.
#[test]
#[ignore = "takes as long as SINEW_ROUGH_SECONDS says, twice"]
fn no_living_node_is_lost_on_a_rough_network() {
    let seconds = std::env::var("SINEW_ROUGH_SECONDS").map_or(60, |text| text.parse().expect("a number"));
    for (what, more) in [("at rest", &[][..]), ("sending", &["--sends-to", "central"][..])] {
        let Some(scenario) = Scenario::new(By::Multicast) else { return };
        let start = |index| scenario.start_asking(index, 30, if index == 0 { &[] } else { more });
        let mut nodes: Vec<_> = (0..NAMES.len()).map(start).collect();
        for (at, node) in nodes.iter_mut().enumerate() {
            for other in NAMES.iter().filter(|other| **other != NAMES[at]) {
                node.wait_for(&["NodeFound", other]);
            }
        }
        // The measured time; not a wait for a state.
        thread::sleep(Duration::from_secs(seconds));
        // All at once, so that no end is a loss to another node.
        nodes.iter().for_each(|node| node.signal(Signal::KILL));
        let (mut lost, mut unheard) = (0, 0);
        for mut node in nodes {
            assert_eq!(node.wait_for_exit(), None);
            lost += node.output().iter().filter(|line| line.contains("NodeLost")).count();
            unheard += node.output().iter().filter(|line| line.contains("Unheard")).count();
        }
        println!(
            "{what}, {seconds} s, 4 nodes, 30 ms, {LOSS} lost: {lost} living nodes lost, {unheard} not heard"
        );
        assert_eq!(lost, 0, "{what}");
    }
}
