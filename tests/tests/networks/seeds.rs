//! Nodes on a rough network, which loses and delays packets: by seeds alone they know who is there, start, meet and lose each other as they do by multicast.

use std::{fmt::Write, net::SocketAddrV4, panic::resume_unwind, thread, time::Duration};

use rustix::process::Signal;
use sinew_hosts::Weather;
use sinew_tests::{Hosts, OwnDirectory, Program, node_under_test, own_group, until};

const NAMES: [&str; 4] = ["central", "hip", "knee", "ankle"];
/// Which of them is lost, again and again.
const KNEE: usize = 2;
/// The others, who tell of it.
const OTHERS: [&str; 3] = ["central", "hip", "ankle"];
/// Three to four of them make a loss: within a second, and slower than a busy machine stands still.
const PERIOD_MS: u32 = 250;
/// A frame in twenty.
const LOSS: f64 = 0.05;
const DELAY: Duration = Duration::from_millis(5);
const JITTER: Duration = Duration::from_millis(2);
const ROUGH: Weather = Weather { loss: LOSS, delay: DELAY, jitter: JITTER };
/// Where the class of a loss is looked at. On a rough network that is a matter of chance: whose host is asked why a node is silent, and the
/// question is lost, is out of reach (NDL-4.6).
const CALM: Weather = Weather { loss: 0.0, ..ROUGH };

/// How nodes find each other.
#[derive(Clone, Copy, PartialEq, Eq)]
enum By {
    Multicast,
    /// Each lists those before it: of two that shall meet one has to.
    Seeds,
}

/// What is the same however nodes find each other.
#[derive(Debug, Default, PartialEq, Eq)]
struct Outcome {
    /// Whose application started, the first one first.
    started: Vec<&'static str>,
    /// What each said when the barrier opened.
    met: Vec<String>,
    /// Who said so, and the class of the loss; in the order of the losses.
    losses: Vec<(&'static str, String)>,
    /// Who said so, and which names it has with their readiness; in the order of what happened.
    directories: Vec<(&'static str, String)>,
}

impl Outcome {
    /// As each of `nodes` says it next.
    fn note_losses<'nodes>(&mut self, nodes: impl Iterator<Item = (&'static str, &'nodes mut Program)>) {
        for (name, node) in nodes {
            let line = node.wait_for(&["NodeLost", NAMES[KNEE]]);
            let why = line.split_once("why: ").and_then(|(_, rest)| rest.split_once(','));
            let (class, _) = why.unwrap_or_else(|| panic!("a loss says why: {line}"));
            self.losses.push((name, class.to_owned()));
        }
    }

    /// Once each of `nodes` has these names, all of them ready, and no others: they come to know it one after the other.
    fn note_directories<'nodes>(
        &mut self,
        nodes: impl Iterator<Item = (&'static str, &'nodes mut Program)>,
        there: &[&str],
    ) {
        let mut entries: Vec<String> = there.iter().map(|name| format!("{name}=true")).collect();
        entries.sort_unstable();
        let whole = format!("directory {}", entries.join(" "));
        for (name, node) in nodes {
            let said = until(&format!("'{whole}' of {name}"), || {
                node.tell("directory");
                let said = node.wait_for(&["directory "]);
                (said == whole).then_some(said)
            });
            self.directories.push((name, said));
        }
    }
}

/// All of them.
fn named(nodes: &mut [Program]) -> impl Iterator<Item = (&'static str, &mut Program)> {
    NAMES.into_iter().zip(nodes)
}

/// Those who tell of the knee.
fn others(nodes: &mut [Program]) -> impl Iterator<Item = (&'static str, &mut Program)> {
    named(nodes).filter(|(name, _)| *name != NAMES[KNEE])
}

/// Whose application started, the first one first, by the clock that all hosts of this machine share.
fn order_of_start(nodes: &mut [Program]) -> Vec<&'static str> {
    let mut started: Vec<(u64, &str)> = named(nodes)
        .map(|(name, node)| {
            let line = node.wait_for(&["clock_ns "]);
            let at = line.strip_prefix("clock_ns ").and_then(|nanos| nanos.parse().ok());
            (at.unwrap_or_else(|| panic!("it says when it started: {line}")), name)
        })
        .collect();
    started.sort_unstable();
    started.into_iter().map(|(_, name)| name).collect()
}

struct Scenario {
    hosts: Hosts,
    directory: OwnDirectory,
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
        Some(Self { hosts, directory: OwnDirectory::new(), group: own_group(), by })
    }

    /// Each requires the one that is started after it, so that the order of starts has to be turned round.
    fn start(&self, index: usize, more: &[&str]) -> Program {
        let mut arguments = vec!["--says-directory"];
        if let Some(required) = NAMES.get(index + 1) {
            arguments.extend(["--requires", *required]);
        }
        arguments.extend(more);
        self.start_asking(index, PERIOD_MS, &arguments)
    }

    /// It asks every `period_ms`, and the group in any case: whether that is heard is the network's affair.
    fn start_asking(&self, index: usize, period_ms: u32, more: &[&str]) -> Program {
        let (name, address) = (NAMES[index], index + 1);
        let path = self.directory.join(&format!("{name}.toml"));
        let mut text = format!(
            "[node]\nname = \"{name}\"\nproject = \"seeds\"\n[ndl]\ninterface = \"10.77.0.{address}\"\nport = 6911\n\
             multicast = \"{}\"\nmdns_port = false\nperiod_ms = {period_ms}\n",
            self.group
        );
        if self.by == By::Seeds {
            let seeds: Vec<_> = (1..address).map(|other| format!("\"10.77.0.{other}:6911\"")).collect();
            writeln!(text, "seeds = [{}]", seeds.join(", ")).expect("a string takes any text");
        }
        std::fs::write(&path, text).expect("the test's own directory");
        node_under_test(Some(&self.hosts.all()[index]), &path, more)
    }

    /// All find all, start as they require each other, and meet; one is killed, is back, hangs, goes on, and stops in order.
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
        nodes[KNEE].freeze();
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
fn seeds_alone_give_the_same_membership_directory_starts_and_barrier_where_no_multicast_is_carried() {
    // Given: the same four nodes, in two networks of their own
    let Some(by_multicast) = Scenario::new(By::Multicast) else { return };
    let Some(by_seeds) = Scenario::new(By::Seeds) else { return };
    // When: the same happens to both, at the same time, so that the test lasts as long as one of them
    let [by_multicast, by_seeds] = thread::scope(|scope| {
        let runs = [&by_multicast, &by_seeds].map(|scenario| scope.spawn(move || scenario.run()));
        runs.map(|run| run.join().unwrap_or_else(|panic| resume_unwind(panic)))
    });
    // Then: who is required started first, all met, and each loss has the class of what was done
    assert_eq!(by_multicast.started, ["ankle", "knee", "hip", "central"]);
    assert_eq!(by_multicast.met, ["met 1"; NAMES.len()]);
    let losses = ["Crashed", "Hung", "Left"].map(|class| OTHERS.map(|name| (name, class.to_owned())));
    assert_eq!(by_multicast.losses, losses.as_flattened());
    // And: by seeds all is the same
    assert_eq!(by_seeds, by_multicast);
}

/// For figures, on a machine with CPUs to spare: how often a living node is lost, which it never should be, and how often its NDL is not heard.
/// `docs/TESTING.md` has the command.
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
        // The time that is measured; no state is hidden behind it.
        thread::sleep(Duration::from_secs(seconds));
        // All at once, so that no end is a loss to another one.
        nodes.iter().for_each(|node| node.signal(Signal::KILL));
        let (mut lost, mut unheard) = (0, 0);
        for mut node in nodes {
            assert_eq!(node.wait_for_end(), None);
            lost += node.said().iter().filter(|line| line.contains("NodeLost")).count();
            unheard += node.said().iter().filter(|line| line.contains("Unheard")).count();
        }
        println!(
            "{what}, {seconds} s, 4 nodes, 30 ms, {LOSS} lost: {lost} living nodes lost, {unheard} not heard"
        );
        assert_eq!(lost, 0, "{what}");
    }
}
