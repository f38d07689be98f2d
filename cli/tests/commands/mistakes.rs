//! docs/book/src/how-to/mistakes.md: makes each mistake with real nodes. Each quoted line must be one that a terminal
//! or `sinew` showed.

use std::{collections::BTreeMap, path::Path};

use rustix::process::Signal;
use sinew_testkit::{Host, Hosts, NodeProcess, sandbox::after_shell, until};

use crate::{
    scenario::{Answer, Scenario, node_command},
    secured::make_keys,
};

const PAGE: &str = include_str!("../../../docs/book/src/how-to/mistakes.md");
const MISTAKES: usize = 12;
/// On the page, any text.
const ANY: &str = "...";

/// The quotes of one mistake: a command, and lines of its output. `./knee` is the terminal of the program with that
/// name.
type Quotes = Vec<(&'static str, Vec<&'static str>)>;

fn sections() -> impl Iterator<Item = &'static str> {
    PAGE.split("\n## ").skip(1)
}

fn quotes(title: &str) -> Quotes {
    let section = sections().find(|section| section.lines().next() == Some(title));
    let section = section.unwrap_or_else(|| panic!("the page has no section '{title}'"));
    let mut quotes = Quotes::new();
    let blocks = section.split("```").skip(1).step_by(2);
    for line in blocks.flat_map(|block| block.lines().skip(1)).filter(|line| !line.is_empty()) {
        match (line.strip_prefix("$ "), quotes.last_mut()) {
            (Some(command), _) => quotes.push((command, Vec::new())),
            (None, Some((_, lines))) => lines.push(line),
            (None, None) => panic!("a line of '{title}' has no command before it: {line}"),
        }
    }
    let has =
        |start: &str| quotes.iter().any(|(command, lines)| command.starts_with(start) && !lines.is_empty());
    assert!(has("./") && has("sinew "), "'{title}' quotes a terminal and a command: {quotes:?}");
    quotes
}

/// Returns whether a line matches its quote. Columns are as wide as their longest cell, so each space may stand for
/// several.
fn is_as_quoted(line: &str, quoted: &str) -> bool {
    let in_one_space = |text: &str| text.split_whitespace().collect::<Vec<_>>().join(" ");
    let (line, quoted) = (in_one_space(line), in_one_space(quoted));
    let mut parts = quoted.split(ANY);
    let Some(mut rest) = line.strip_prefix(parts.next().unwrap_or_default()) else { return false };
    let mut parts = parts.peekable();
    while let Some(part) = parts.next() {
        if parts.peek().is_none() {
            return rest.ends_with(part);
        }
        let Some(at) = rest.find(part) else { return false };
        rest = &rest[at + part.len()..];
    }
    rest.is_empty()
}

/// The robot of the page: a hip, which requires the knee, and a knee.
#[derive(Default)]
struct Robot {
    nodes: BTreeMap<&'static str, NodeProcess>,
}

impl Robot {
    /// Starts a node as a first program does: its log goes to its terminal.
    fn start(&mut self, scenario: &Scenario, node: &Node<'_>) -> &mut NodeProcess {
        let Node { name, address, changes, more, host } = *node;
        let config = scenario.configure(name, address, changes);
        let mut node = node_command();
        node.arg(config).arg("--default-log").args(more);
        let mut command = after_shell("exec 2>&1", &node);
        if let Some(host) = host {
            command = host.moved(&command);
        }
        command.env_remove("SINEW_LOG").env_remove("RUST_LOG");
        self.nodes.entry(name).or_insert_with(|| NodeProcess::start(name, command))
    }

    /// Starts the second node after the first one has started. The mistake may end the second one at once.
    fn of(scenario: &Scenario, [first, second]: [Node<'_>; 2]) -> Self {
        let mut robot = Self::default();
        robot.start(scenario, &first).wait_for(&["the node has started"]);
        robot.start(scenario, &second);
        robot
    }

    /// Waits until every quoted line of the page was shown.
    fn shows(&mut self, title: &str, run: impl Fn(&[&str]) -> Answer) {
        for (command, lines) in quotes(title) {
            let mut shown = Vec::new();
            let missing = |shown: &[String]| {
                let is_missing = |quoted: &&&str| !shown.iter().any(|line| is_as_quoted(line, quoted));
                lines.iter().filter(is_missing).copied().collect::<Vec<_>>()
            };
            let what = format!("'{title}', `{command}` as quoted");
            let outcome = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| {
                until(&what, || {
                    shown = match command.strip_prefix("./") {
                        Some(name) => {
                            self.nodes.get_mut(name).expect("a node of the page").poll_output().to_vec()
                        }
                        None => {
                            let words: Vec<_> = command.split(' ').skip(1).collect();
                            let Answer { out, err, .. } = run(&words);
                            out.lines().chain(err.lines()).map(str::to_owned).collect()
                        }
                    };
                    missing(&shown).is_empty().then_some(())
                });
            }));
            let missing = missing(&shown);
            assert!(outcome.is_ok(), "{what}: missing\n{}\nshown:\n{}", missing.join("\n"), shown.join("\n"));
        }
    }
}

/// The parameters for starting a node of the page.
#[derive(Clone, Copy)]
struct Node<'a> {
    name: &'static str,
    address: u8,
    changes: &'a [(&'a str, &'a str)],
    more: &'a [&'a str],
    host: Option<&'a Host>,
}

const HIP: Node<'static> =
    Node { name: "hip", address: 1, changes: &[], more: &["--requires", "knee"], host: None };
const KNEE: Node<'static> = Node { name: "knee", address: 2, changes: &[], more: &[], host: None };

/// Checks a mistake on one host, as seen from the hip.
fn check(title: &str, hip: Node<'_>, knee: Node<'_>, mistake: impl FnOnce(&mut Robot)) {
    let scenario = Scenario::new();
    let mut robot = Robot::of(&scenario, [hip, knee]);
    mistake(&mut robot);
    robot.shows(title, |words| scenario.sinew("hip", words));
}

fn nothing(_: &mut Robot) {}

#[test]
fn page_has_a_section_for_each_tested_mistake() {
    assert_eq!(sections().count(), MISTAKES);
}

#[test]
fn quoted_line_matches_any_text_for_its_wildcards() {
    for (quoted, line, is_so) in [
        ("... WARN a: b", "12:00 WARN a: b", true),
        ("a  fine  up ...", "a      fine   up 3 s", true),
        ("... lost ... ago: it", "was lost 3 s ago: it", true),
        ("... WARN a: b", "12:00 WARN a: b c", false),
        ("a ... c", "b a x c", false),
        ("a", "a b", false),
    ] {
        assert_eq!(is_as_quoted(line, quoted), is_so, "{quoted} | {line}");
    }
}

#[test]
fn forgotten_handler_is_shown_as_on_the_page() {
    let hip = Node { more: &["--requires", "knee", "--sends-to", "knee"], ..HIP };
    check("1. A forgotten handler", hip, Node { more: &["--forgets-a-handler"], ..KNEE }, nothing);
}

#[test]
fn wrong_type_is_shown_as_on_the_page() {
    let hip = Node { more: &["--requires", "knee", "--sends-text-to", "knee"], ..HIP };
    check("2. A type that differs", hip, KNEE, nothing);
}

#[test]
fn misspelt_requirement_is_shown_as_on_the_page() {
    check("3. A misspelt requirement", Node { more: &["--requires", "kneee"], ..HIP }, KNEE, nothing);
}

#[test]
fn circular_requirements_are_shown_as_on_the_page() {
    check("4. Requirements in a circle", HIP, Node { more: &["--requires", "hip"], ..KNEE }, nothing);
}

#[test]
fn killed_process_is_shown_as_on_the_page() {
    check("5. A process that is killed", HIP, KNEE, |robot| {
        robot.nodes.get_mut("hip").expect("it runs").wait_for(&["started 127"]);
        robot.nodes["knee"].signal(Signal::KILL);
    });
}

#[test]
fn crash_loop_is_shown_as_on_the_page() {
    let hip = Node { more: &["--requires", "knee", "--sends-to", "knee"], ..HIP };
    check("6. A crash loop", hip, Node { more: &["--panics"], ..KNEE }, nothing);
}

#[test]
fn stopped_process_is_shown_as_on_the_page() {
    check("7. A process that stands still", HIP, KNEE, |robot| {
        robot.nodes.get_mut("hip").expect("it runs").wait_for(&["started 127"]);
        robot.nodes["knee"].pause();
    });
}

#[test]
fn wrong_project_is_shown_as_on_the_page() {
    let changes = [("project = \"cli\"", "project = \"arm\"")];
    check("10. A wrong project", HIP, Node { changes: &changes, ..KNEE }, nothing);
}

#[test]
fn wrong_keys_are_shown_as_on_the_page() {
    let scenario = Scenario::new();
    let of = |directory: &str, name: &str| {
        make_keys(&scenario, directory, &["hip=127.0.0.1", "knee=127.0.0.2"]);
        let keys = scenario.directory.join(&format!("{directory}/nodes/{name}"));
        format!("[security]\nkeys = \"{}\"\n[lncl]", keys.display())
    };
    let (own, other) = (of("keys", "hip"), of("other", "knee"));
    let (own, other) = ([("[lncl]", &*own)], [("[lncl]", &*other)]);
    let mut robot = Robot::of(&scenario, [Node { changes: &own, ..HIP }, Node { changes: &other, ..KNEE }]);
    robot.shows("11. Wrong keys", |words| scenario.sinew("hip", words));
}

#[test]
fn duplicate_address_is_shown_as_on_the_page() {
    check("12. One address for two nodes", HIP, Node { address: 1, ..KNEE }, nothing);
}

/// Checks a mistake with the hip and the knee on two hosts, and this interface for the knee. The command runs on the
/// hip's host, without a socket of the knee.
fn check_on_hosts(title: &str, hosts: Result<Hosts, String>, knee_interface: &str) {
    let Ok(hosts) = hosts.inspect_err(|why| println!("skipped: no hosts can be made here: {why}")) else {
        return;
    };
    let scenario = Scenario::new();
    std::fs::create_dir(scenario.directory.join("knee")).expect("the test's own directory");
    let (hip_socket, knee_socket) = (scenario.socket("hip"), scenario.socket("knee/knee"));
    let own_socket = scenario.socket("knee");
    let paths = [&own_socket, &knee_socket].map(|path| path.to_str().expect("a short path"));
    let hip_changes = [("127.0.0.1", "10.77.0.1"), ("[ndl]", "[ndl]\ninterface = \"10.77.0.1\"")];
    let knee_changes = [("127.0.0.2", "10.77.0.2"), ("[ndl]", knee_interface), (paths[0], paths[1])];
    let [hip_host, knee_host] = hosts.all() else { panic!("two hosts") };
    let hip = Node { changes: &hip_changes, host: Some(hip_host), ..HIP };
    let knee = Node { changes: &knee_changes, host: Some(knee_host), ..KNEE };
    let mut robot = Robot::of(&scenario, [hip, knee]);
    robot.shows(title, |words| {
        let mut command = hip_host.command(Path::new(env!("CARGO_BIN_EXE_sinew")));
        command.arg("--socket").arg(&hip_socket).args(["--deadline-ms", "10000"]).args(words);
        Answer::of(command.env("XDG_RUNTIME_DIR", "/").env_remove("SINEW_SOCKET"))
    });
}

#[test]
fn wrong_interface_is_shown_as_on_the_page() {
    check_on_hosts("8. A wrong interface", Hosts::new(2), "[ndl]");
}

#[test]
fn network_without_multicast_is_shown_as_on_the_page() {
    let hosts = Hosts::on_radio(2, 31).inspect(Hosts::drop_multicast);
    check_on_hosts("9. No multicast", hosts, "[ndl]\ninterface = \"10.77.0.2\"");
}
