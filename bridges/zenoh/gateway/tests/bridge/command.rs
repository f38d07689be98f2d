//! The command line: help, and the check of a file.

use std::process::{Command, Output};

use sinew_testkit::TestDirectory;

use crate::stage::RULES;

fn run(arguments: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_sinew-zenoh-bridge"));
    command.args(arguments).env_remove("RUST_LOG").output().expect("it can be started")
}

fn text(output: &Output) -> String {
    String::from_utf8_lossy(&output.stdout).into_owned()
}

#[test]
fn check_prints_the_keys_and_starts_nothing() {
    let directory = TestDirectory::new();
    let head = "project = \"leg\"\nsocket = \"/nonexistent.sock\"\n";
    let good = directory.write("good.toml", &(head.to_owned() + RULES));
    let checked = run(&["--check", good.to_str().expect("a path is text")]);
    assert_eq!(checked.status.code(), Some(0), "{}", text(&checked));
    let line = "in   sinew/leg/n/knee.drive/robot.move json put: unconfirmed get: confirmed";
    assert!(text(&checked).lines().any(|found| found == line), "{}", text(&checked));

    let bad = directory.write("bad.toml", &(head.to_owned() + RULES + "tokens = true\n"));
    let refused = run(&["--check", bad.to_str().expect("a path is text")]);
    assert_eq!(refused.status.code(), Some(2));
    assert!(text(&refused).contains("unknown field `tokens`, expected one of"), "{}", text(&refused));
}

#[test]
fn help_names_each_key_of_the_file() {
    let help = text(&run(&["--help"]));
    let keys = "project socket name address requests queue mode connect listen scouting lease_ms to types encoding class \
                put get within_ms expires_after_ms age_max_ms protected group token reply apps nodes";
    for key in keys.split_whitespace() {
        assert!(help.contains(&format!("{key} =")), "{key}: {help}");
    }
    assert_eq!(run(&[]).status.code(), Some(2));
    assert_eq!(run(&["--chek", "x"]).status.code(), Some(2));
}
