//! Every command with its output on a full disk, or on a pipe without a reader.

use std::{
    fs::File,
    process::{Command, Stdio},
};

use crate::scenario::{Answer, Scenario};

/// One invocation of each command that ends by itself, for a node called `hip`.
const COMMANDS: [&[&str]; 20] = [
    &["--help"],
    &["--version"],
    &["watch", "--help"],
    &["completions", "bash"],
    &["man", "."],
    &["keys", "init", "walker", "hip=127.0.0.1"],
    &["keys", "show"],
    &["nodes"],
    &["nodes", "--json"],
    &["apps"],
    &["tree"],
    &["ping", "hip", "--count", "1"],
    &["send", "hip", "demo.nothing", "{}"],
    &["watch", "hip", "--json"],
    &["why", "hip", "hip"],
    &["schema", "demo.nothing"],
    &["barriers"],
    &["audit"],
    &["contracts"],
    &["doctor"],
];

/// Runs a command with this standard output and standard error.
fn run(scenario: &Scenario, words: &[&str], out: Stdio, err: Stdio) -> Answer {
    let mut command = Command::new(env!("CARGO_BIN_EXE_sinew"));
    let asks_no_node = matches!(words[0], "keys" | "completions" | "man") || words.contains(&"--help");
    if !asks_no_node {
        command.arg("--socket").arg(scenario.socket("hip"));
    }
    let answer = command
        .args(words)
        .current_dir(scenario.directory.join("."))
        .stdin(Stdio::null())
        .stdout(out)
        .stderr(err)
        .output()
        .expect("the command starts");
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    Answer { code: answer.status.code(), out: text(&answer.stdout), err: text(&answer.stderr) }
}

fn full_disk() -> Stdio {
    File::options().write(true).open("/dev/full").expect("Linux has it").into()
}

/// The write end of a pipe with its read end closed.
fn closed_pipe() -> Stdio {
    let (reader, writer) = std::io::pipe().expect("a pipe");
    drop(reader);
    writer.into()
}

#[test]
fn every_command_reports_a_full_disk() {
    let scenario = Scenario::new();
    let mut hip = scenario.start("hip", 1, &[]);
    hip.wait_for(&["started"]);
    for words in COMMANDS {
        let answer = run(&scenario, words, full_disk(), Stdio::piped());
        assert!(!matches!(answer.code, None | Some(0 | 101)), "{words:?}: {:?} {}", answer.code, answer.err);
        assert!(
            answer.err.contains("standard output is incomplete: No space left"),
            "{words:?}: {}",
            answer.err
        );
    }
    let fine = run(&scenario, &["nodes", "--json"], full_disk(), Stdio::piped());
    assert_eq!(fine.code, Some(4), "{}", fine.err);
}

#[test]
fn every_command_ends_quietly_on_a_closed_pipe() {
    let scenario = Scenario::new();
    let mut hip = scenario.start("hip", 1, &[]);
    hip.wait_for(&["started"]);
    for words in COMMANDS {
        let answer = run(&scenario, words, closed_pipe(), Stdio::piped());
        assert!(!matches!(answer.code, None | Some(4 | 101)), "{words:?}: {:?} {}", answer.code, answer.err);
        assert!(!answer.err.contains("standard output"), "{words:?}: {}", answer.err);
        // Also with standard error on a closed pipe.
        let mute = run(&scenario, words, closed_pipe(), closed_pipe());
        assert!(!matches!(mute.code, None | Some(4 | 101)), "{words:?}: {:?}", mute.code);
    }
    let wrong = run(&scenario, &["nodes", "--wrong"], Stdio::piped(), full_disk());
    assert_eq!(wrong.code, Some(2), "{}", wrong.out);
    let no_node = run(&scenario, &["--socket", "/nowhere.sock", "nodes"], full_disk(), full_disk());
    assert!(matches!(no_node.code, Some(2 | 3)), "{:?}", no_node.code);
}
