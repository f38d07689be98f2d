//! Runs of the built program with output to a full disk, or to a pipe without a reader.

use std::fs::File;
use std::path::Path;
use std::process::{Command, Output, Stdio};

use exoskeleton::robot::topology::for_this_host;
use sinew_robot_tests::process::folder;

const PROGRAM: &str = env!("CARGO_BIN_EXE_exoskeleton");

const WALK: [&str; 7] = ["--lock-step", "--strides", "8", "--runs", "runs", "--report", "report.json"];

fn run(folder: &Path, arguments: &[&str], out: Stdio, err: Stdio) -> Output {
    let mut command = Command::new(PROGRAM);
    command.args(arguments).current_dir(folder).stdin(Stdio::null()).stdout(out).stderr(err);
    command.output().expect("the program that was just built starts")
}

fn full_disk() -> Stdio {
    File::options().write(true).open("/dev/full").expect("Linux has it").into()
}

/// The write end of a pipe without a reader.
fn closed_pipe() -> Stdio {
    let (reader, writer) = std::io::pipe().expect("a pipe");
    drop(reader);
    writer.into()
}

fn assert_recorded(folder: &Path) {
    let run = folder.join("runs/lock-step-curves-seed1-8strides");
    for file in
        [run.join("gait.svg"), run.join("run.csv"), run.join("report.json"), folder.join("report.json")]
    {
        assert!(std::fs::metadata(&file).is_ok_and(|file| file.len() > 0), "{}", file.display());
        std::fs::remove_file(file).expect("it is there");
    }
}

#[test]
fn walk_without_a_reader_ends_quietly_with_all_records() {
    let folder = folder("pipe");
    for err in [Stdio::piped(), closed_pipe()] {
        let output = run(&folder, &WALK, closed_pipe(), err);
        assert_eq!((output.status.code(), output.stderr.as_slice()), (Some(0), &b""[..]));
        assert_recorded(&folder);
    }
    std::fs::remove_dir_all(&folder).unwrap();
}

#[test]
fn walk_with_full_output_is_recorded_and_fails() {
    let folder = folder("full");
    let output = run(&folder, &WALK, full_disk(), Stdio::piped());
    let words = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{words}");
    assert!(words.contains("standard output is incomplete: No space left"), "{words}");
    assert_recorded(&folder);
    std::fs::remove_dir_all(&folder).unwrap();
}

#[test]
fn full_disk_loses_only_the_named_report() {
    let folder = folder("report");
    let mut walk = WALK;
    walk[6] = "/dev/full";
    let output = run(&folder, &walk, Stdio::piped(), Stdio::piped());
    let words = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{words}");
    assert!(words.contains("cannot write /dev/full: No space left"), "{words}");
    assert!(folder.join("runs/lock-step-curves-seed1-8strides/gait.svg").exists());
    std::fs::remove_dir_all(&folder).unwrap();
}

#[test]
fn other_commands_exit_without_panic_on_a_full_disk() {
    let folder = folder("others");
    let topology = folder.join("topology.toml");
    std::fs::write(&topology, for_this_host(1).expect("free ports").to_toml()).unwrap();
    let file = topology.to_str().unwrap();
    let plant = ["node", "plant", "--stop-with-stdin", "--topology", file];
    for arguments in [&["--help"][..], &["--version"], &["node", "--help"], &plant] {
        let output = run(&folder, arguments, full_disk(), Stdio::piped());
        let words = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{arguments:?}: {words}");
        assert!(words.contains("standard output is incomplete"), "{arguments:?}: {words}");
        let output = run(&folder, arguments, closed_pipe(), full_disk());
        assert_eq!(output.status.code(), Some(0), "{arguments:?}");
    }
    // A node logs to standard error alone.
    let output =
        run(&folder, &["node", "hip", "--stop-with-stdin", "--topology", file], closed_pipe(), closed_pipe());
    assert_eq!(output.status.code(), Some(0));
    for arguments in [&["--wrong"][..], &["--lock-step", "--trial", "nowhere.csv"]] {
        let output = run(&folder, arguments, closed_pipe(), full_disk());
        assert!(matches!(output.status.code(), Some(1 | 2)), "{arguments:?}: {:?}", output.status);
    }
    std::fs::remove_dir_all(&folder).unwrap();
}
