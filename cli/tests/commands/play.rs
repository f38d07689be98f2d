//! `sinew play`: recorded messages are sent again, and a program is checked against its recording.

use std::{
    fs,
    path::{Path, PathBuf},
    process::Command,
};

use rustix::process::Signal;
use sinew::{AppAddress, NodeAddress, NodeApi, Registration, Tid, message::Kind};
use sinew_bag::{BagWriter, ChannelInfo, Class, Direction, Options, Origin, Party, Record};
use sinew_testkit::{NodeProcess, TestDirectory, program, until};

use crate::scenario::{Answer, Scenario, named, node_command, sinew};

/// Between two recorded messages, in nanoseconds: the period of a node that is tested.
const PERIOD_NS: u64 = 20_000_000;
/// The time of the first message, in nanoseconds.
const FIRST_NS: u64 = 1_000_000_000;

fn tid(app: u32) -> Tid {
    Tid::new(NodeAddress::from([127, 0, 0, 1]), AppAddress::new(0x1000 + app))
}

fn party(app: u32, name: &str) -> Party {
    let tid = tid(app);
    Party {
        tid: tid.bits(),
        text: tid.to_string(),
        name: Some(name.to_owned()),
        node: Some("127.0.0.1".to_owned()),
    }
}

/// The payload `{"number": number}`.
fn count(number: u64) -> Vec<u8> {
    let number = u8::try_from(number).expect("a small number");
    assert!(number < 0x80, "it has one byte");
    [b"\x81\xa6number", &[number][..]].concat()
}

/// Writes the recording of a hip that sends these counts to the knee.
fn recorded(directory: &TestDirectory, numbers: &[u64]) -> PathBuf {
    written(directory, numbers, &[])
}

/// Writes the recording of a hip that sends these counts to the knee, and these as protected commands.
fn written(directory: &TestDirectory, numbers: &[u64], commands: &[u64]) -> PathBuf {
    let ends = [(1, "hip"), (2, "knee")];
    file_of(directory, &[(ends, false, numbers), (ends, true, commands)])
}

/// A channel: source and destination with their numbers, whether it is protected, and its counts.
type Sent<'a> = ([(u32, &'a str); 2], bool, &'a [u64]);

/// Writes the recording of the hip's node with these channels.
fn file_of(directory: &TestDirectory, all: &[Sent<'_>]) -> PathBuf {
    let path = directory.join("walk.mcap");
    let origin =
        Origin { node: "hip".into(), address: "127.0.0.1".into(), incarnation: 1, ..Origin::default() };
    let mut bag = BagWriter::create(&path, Options::default(), origin).expect("the test's own directory");
    let type_name = "scenario.count";
    for ([source, destination], is_protected, values) in all {
        let channel = bag.channel(&ChannelInfo {
            source: &party(source.0, source.1),
            destination: &party(destination.0, destination.1),
            type_name,
            kind: Kind::named(type_name).bits(),
            class: Class::Bulk,
            direction: Direction::Sent,
            is_protected: *is_protected,
            schema: None,
            refused: None,
            seen_before: 0,
        });
        let channel = channel.expect("there is room");
        for (number, value) in (1..).zip(*values) {
            let at_ns = FIRST_NS + (number - 1) * PERIOD_NS;
            let (sent_ns, handed_over_ns, payload) = (at_ns, at_ns, &count(*value)[..]);
            let record =
                Record { number, sequence: number, sent_ns, handed_over_ns, payload, ..Record::default() };
            bag.message(channel, &record).expect("there is room");
        }
    }
    bag.finish(2 * FIRST_NS).expect("there is room");
    path
}

fn text(path: &Path) -> &str {
    path.to_str().expect("a path of text")
}

/// Runs `sinew play --check` on a program. Its application `hip` sends a count to the knee in each period, from 1 on.
fn check(scenario: &Scenario, file: &Path, words: &[&str]) -> Answer {
    let config = scenario.configure("hip", 1, &[]);
    let program = node_command();
    let mut command = Command::new(env!("CARGO_BIN_EXE_sinew"));
    command.args(["play", "--check"]).arg(file).args(["--start-before", "20ms"]).args(words);
    command.arg("--").arg(program.get_program()).args(program.get_args());
    Answer::of(command.arg(&config).args(["--sends-to", "knee"]).env("TMPDIR", scenario.directory.join("")))
}

/// Starts the knee in this project, where the command's own node finds it by the default group.
fn start_knee(scenario: &Scenario, project: &str) -> NodeProcess {
    let group = format!("multicast = \"{}\"\n", scenario.group);
    let own = format!("project = \"{project}\"");
    scenario.start_changed("knee", 2, &[(&group, ""), ("project = \"cli\"", &own)], &[])
}

/// The project of one test.
fn project() -> String {
    format!("replay-{}", sinew_testkit::unique())
}

#[test]
fn recorded_messages_arrive_as_from_the_recorded_name() {
    let scenario = Scenario::new();
    let file = written(&scenario.directory, &[1, 2, 3], &[7]);
    let project = project();
    let mut knee = start_knee(&scenario, &project);
    knee.wait_for(&["started"]);
    // When: the command has a node of its own, in the same project
    let words =
        ["play", text(&file), "--project", &project, "--wait", "60s", "--deadline-ms", "10000", "--json"];
    let answer = sinew(&words, &scenario.directory.join(""));
    // Then
    assert_eq!(answer.code, Some(0), "{}{}", answer.out, answer.err);
    for number in [1, 7, 2, 3] {
        knee.wait_for(&[&format!("count {number} from 127.0.83.119/")]);
    }
    let json = answer.json();
    assert_eq!((&json["project"], &json["end"]), (&project.as_str().into(), &"complete".into()), "{json}");
    let channels = json["channels"].as_array().expect("a list");
    let counts = channels.iter().find(|one| one["channel"] == "/hip/scenario.count").expect("it was played");
    assert_eq!((&counts["sent"], &counts["rejected"], &counts["absent"]), (&3.into(), &0.into(), &0.into()));
    assert!(json["left_out"].as_object().is_some_and(serde_json::Map::is_empty), "its own project: {json}");
}

#[test]
fn message_to_a_played_source_has_no_receiver() {
    let scenario = Scenario::new();
    let (hip, knee) = ((1, "hip"), (2, "knee"));
    let file =
        file_of(&scenario.directory, &[([hip, knee], false, &[1, 2, 3]), ([knee, hip], false, &[4, 5])]);
    // When: both ends are sources, so the command has both names
    let project = project();
    let words = ["play", text(&file), "--project", &project, "--rate", "max", "--deadline-ms", "10000"];
    let answer = sinew(&[&words[..], &["--json"]].concat(), &scenario.directory.join(""));
    // Then
    assert_eq!(answer.code, Some(0), "{}{}", answer.out, answer.err);
    let json = answer.json();
    assert_eq!((&json["sent"], &json["absent"]), (&0.into(), &5.into()), "{json}");
    assert_eq!(json["played_itself"], serde_json::json!(["hip", "knee"]), "{json}");
}

#[test]
fn second_command_in_one_project_names_the_first() {
    let scenario = Scenario::new();
    let file = recorded(&scenario.directory, &[1]);
    let project = project();
    let command = || {
        let mut command = Command::new(env!("CARGO_BIN_EXE_sinew"));
        command.args(["play", text(&file), "--project", &project, "--wait", "60s"]);
        command.env("XDG_RUNTIME_DIR", scenario.directory.join(""));
        command
    };
    // Given: a command that waits for the knee. It has a socket when its node has one
    let mut first = NodeProcess::start("sinew play", command());
    until("the first command has its node", || {
        fs::read_dir(scenario.directory.join("sinew")).ok()?.next().map(|_| ())
    });
    // When
    let answer = Answer::of(&mut command());
    // Then
    assert_eq!(answer.code, Some(1), "{}{}", answer.out, answer.err);
    for words in [
        format!("another `sinew play` runs in the project {project}"),
        "127.0.83.119".to_owned(),
        format!("--project {project}-2"),
    ] {
        assert!(answer.err.contains(&words), "{words}: {}", answer.err);
    }
    first.signal(Signal::INT);
    assert_eq!(first.wait_for_exit(), Some(0));
}

#[test]
fn protected_commands_are_left_out_of_a_live_node() {
    let scenario = Scenario::new();
    let file = written(&scenario.directory, &[4, 5], &[7]);
    let mut knee = scenario.start("knee", 2, &[]);
    knee.wait_for(&["started"]);
    // When
    let answer = scenario.sinew("knee", &["play", text(&file), "--live", "--rate", "max", "--json"]);
    // Then
    assert_eq!(answer.code, Some(0), "{}{}", answer.out, answer.err);
    knee.wait_for(&["count 5 "]);
    let json = answer.json();
    assert_eq!((&json["left_out"]["protected"], &json["sent"]), (&1.into(), &2.into()), "{json}");
    let answer = scenario.sinew("knee", &["play", text(&file), "--live", "--from", "15ms"]);
    assert_eq!(answer.code, Some(0), "{}{}", answer.out, answer.err);
    assert!(
        answer.out.contains("1 messages of 1 sources sent") && answer.out.contains("project cli"),
        "{}",
        answer.out
    );
}

#[test]
fn loop_without_any_message_to_send_ends() {
    let scenario = Scenario::new();
    let file = written(&scenario.directory, &[], &[7, 8]);
    let _knee = scenario.start("knee", 2, &[]);
    let answer =
        scenario.sinew("knee", &["play", text(&file), "--live", "--loop", "--rate", "max", "--json"]);
    assert_eq!(answer.code, Some(0), "{}{}", answer.out, answer.err);
    assert_eq!(answer.json()["left_out"]["protected"], 2, "{}", answer.out);
}

#[test]
fn name_of_a_living_application_is_refused() {
    let scenario = Scenario::new();
    let file = recorded(&scenario.directory, &[1]);
    let _knee = scenario.start("knee", 2, &[]);
    let api = NodeApi::connect(scenario.socket("knee")).expect("the knee's socket");
    let hip = api.register_transport_address(Registration::new().name("hip")).expect("it is registered");
    let json =
        scenario.until("the hip is known", "knee", &["apps"], |json| named(&json["apps"], "hip").is_some());
    // When
    let answer = scenario.sinew("knee", &["play", text(&file), "--live"]);
    // Then
    assert_eq!(answer.code, Some(1), "{json}: {}{}", answer.out, answer.err);
    for words in ["an application called hip is there", &hip.tid().to_string(), "--source"] {
        assert!(answer.err.contains(words), "{words}: {}", answer.err);
    }
    // And: it is played where it is left out
    let answer = scenario.sinew("knee", &["play", text(&file), "--live", "--source", "ankle"]);
    assert!(answer.code == Some(0) && answer.out.contains("0 messages"), "{}{}", answer.out, answer.err);
}

#[test]
fn program_that_sends_the_recorded_messages_is_identical() {
    let scenario = Scenario::new();
    let file = recorded(&scenario.directory, &[1, 2, 3, 4, 5]);
    let answer = check(&scenario, &file, &[]);
    assert_eq!(answer.code, Some(0), "{}{}", answer.out, answer.err);
    assert_eq!(answer.out, "identical: 5 messages of 1 sources\n", "{}", answer.err);
}

#[test]
fn first_message_that_differs_is_named() {
    let scenario = Scenario::new();
    let file = recorded(&scenario.directory, &[1, 2, 9, 9]);
    let answer = check(&scenario, &file, &[]);
    assert_eq!(answer.code, Some(1), "{}{}", answer.out, answer.err);
    let expected = "the first difference: message 3 of hip, scenario.count to knee at 1.040000000s: `number` was 9 and is 3\n";
    assert_eq!(answer.out, expected, "{}", answer.err);
    let json = check(&scenario, &file, &["--json"]).json();
    assert_eq!((&json["result"], &json["number"]), (&"differs".into(), &3.into()), "{json}");
    // And: a field that is not compared does not differ
    let answer = check(&scenario, &file, &["--ignore", "number", "--app", "hip"]);
    assert_eq!(
        (answer.code, &*answer.out),
        (Some(0), "identical: 4 messages of 1 sources\n"),
        "{}",
        answer.err
    );
}

#[test]
fn check_of_a_cut_file_is_no_proof() {
    let scenario = Scenario::new();
    let file = recorded(&scenario.directory, &[1, 2, 3]);
    let bytes = fs::read(&file).expect("it was written");
    fs::write(&file, &bytes[..bytes.len() - 20]).expect("the test's own directory");
    let answer = check(&scenario, &file, &[]);
    assert_eq!(answer.code, Some(1), "{}{}", answer.out, answer.err);
    for words in ["not whole: 3 messages", "unfinished: the file ends at byte"] {
        assert!(answer.out.contains(words), "{words}: {}", answer.out);
    }
    // And: an end before the missing one is proved
    let mut command = Command::new(env!("CARGO_BIN_EXE_sinew"));
    let program = node_command();
    command.args(["play", "--check"]).arg(&file).args(["--start-before", "20ms", "--to", "25ms", "--"]);
    command.arg(program.get_program()).args(program.get_args()).arg(scenario.configure("hip", 1, &[]));
    let answer = Answer::of(command.args(["--sends-to", "knee"]));
    assert!(answer.code == Some(0) && answer.out.starts_with("identical"), "{}{}", answer.out, answer.err);
}

#[test]
fn check_without_a_common_application_names_both_sides() {
    let scenario = Scenario::new();
    let file = recorded(&scenario.directory, &[1]);
    let answer = check(&scenario, &file, &["--app", "ankle"]);
    assert!(answer.code == Some(1) && answer.err.contains("it has: hip, knee"), "{}", answer.err);
    // And: the program has another name
    let config = scenario.configure("ankle", 3, &[]);
    let program = node_command();
    let mut command = Command::new(env!("CARGO_BIN_EXE_sinew"));
    command
        .args(["play", "--check"])
        .arg(&file)
        .arg("--")
        .arg(program.get_program())
        .args(program.get_args());
    let answer = Answer::of(command.arg(config));
    assert!(answer.code == Some(1) && answer.err.contains("node ankle: ankle"), "{}", answer.err);
    // And: there is no such program
    let mut command = Command::new(env!("CARGO_BIN_EXE_sinew"));
    command.args(["play", "--check"]).arg(&file).arg("--").arg(scenario.directory.join("none"));
    let answer = Answer::of(&mut command);
    assert!(answer.code == Some(1) && answer.err.contains("cannot be run"), "{}", answer.err);
}

#[test]
fn variable_that_was_left_behind_stops_no_node() {
    let scenario = Scenario::new();
    let mut command = Command::new(program("sinew-node"));
    command.arg(scenario.configure("knee", 2, &[])).env("SINEW_PLAY_CHECK", scenario.directory.join("gone"));
    let mut knee = NodeProcess::start("sinew-node", command);
    knee.wait_for(&["up"]);
    knee.signal(Signal::TERM);
    assert_eq!(knee.wait_for_exit(), Some(0));
}

#[test]
fn wrong_words_are_refused_with_a_remedy() {
    for (words, part) in [
        (&["walk.mcap", "--rate", "0"][..], "`max`"),
        (&["walk.mcap", "--project", "walker"], "--live"),
        (&["walk.mcap", "--from", "2s", "--to", "1s"], "--to is not later"),
        (&["--check", "walk.mcap"], "PROGRAM"),
        (&["walk.mcap", "--app", "knee"], "--check"),
    ] {
        let answer = sinew(&[&["play"][..], words].concat(), Path::new("/"));
        assert!(answer.code == Some(2) && answer.err.contains(part), "{words:?}: {}", answer.err);
    }
    let answer = sinew(&["play", "there-is-none.mcap"], Path::new("/"));
    assert!(answer.code == Some(1) && answer.err.contains("there-is-none.mcap"), "{}", answer.err);
}
