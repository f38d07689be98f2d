//! Nodes on a rough network, which loses and delays packets: by seeds alone they come to know who is there as they do by multicast.

use std::{fmt::Write, net::SocketAddrV4, time::Duration};

use rustix::process::Signal;
use sinew_hosts::Weather;
use sinew_tests::{Hosts, OwnDirectory, Program, node_under_test, own_group};

const NAMES: [&str; 4] = ["central", "hip", "knee", "ankle"];
/// A frame in twenty.
const LOSS: f64 = 0.05;
const DELAY: Duration = Duration::from_millis(5);
const JITTER: Duration = Duration::from_millis(2);

/// How nodes find each other.
#[derive(Clone, Copy, PartialEq, Eq)]
enum By {
    Multicast,
    /// Each lists those before it: of two that shall meet one has to.
    Seeds,
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
        hosts.set_weather(Weather { loss: LOSS, delay: DELAY, jitter: JITTER });
        if by == By::Seeds {
            hosts.drop_multicast();
        }
        Some(Self { hosts, directory: OwnDirectory::new(), group: own_group(), by })
    }

    fn start(&self, index: usize) -> Program {
        self.start_asking(index, 100, &[])
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

    /// All find all, whoever starts last; one is killed, and is back; one stops in order.
    fn run(&self) {
        let mut nodes: Vec<_> = (0..NAMES.len()).map(|index| self.start(index)).collect();
        for (at, node) in nodes.iter_mut().enumerate() {
            for other in NAMES.iter().filter(|other| **other != NAMES[at]) {
                node.wait_for(&["NodeFound", other]);
            }
        }
        let mut knee = nodes.remove(2);
        knee.signal(Signal::KILL);
        let others = ["central", "hip", "ankle"];
        for node in &mut nodes {
            node.wait_for(&["NodeLost", "knee"]);
        }
        knee = self.start(2);
        for (node, name) in nodes.iter_mut().zip(others) {
            node.wait_for(&["NodeRestarted", "knee"]);
            knee.wait_for(&["NodeFound", name]);
        }
        knee.signal(Signal::TERM);
        for node in &mut nodes {
            // A goodbye is one datagram to each, and may be lost; then the end of the connection says it.
            node.wait_for(&["NodeLost", "knee"]);
        }
    }
}

#[test]
fn seeds_alone_give_the_same_membership_where_no_multicast_is_carried() {
    for by in [By::Multicast, By::Seeds] {
        let Some(scenario) = Scenario::new(by) else { return };
        scenario.run();
    }
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
        std::thread::sleep(Duration::from_secs(seconds));
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
