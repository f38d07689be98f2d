//! Nobody reads what a node logs: its standard error is a pipe that is full. Who panics is dead and back all the same.

use std::{
    io::{PipeReader, PipeWriter, Write},
    process::Command,
    time::Instant,
};

use rustix::{
    fs::{OFlags, fcntl_setfl},
    process::Signal,
};
use sinew::prelude::Duration;
use sinew_tests::{Ground, OwnDirectory, Program, program};

/// Time for what follows a panic: generous, as a backtrace is looked up in it, and less than the deadline that each of the three words has.
const SOON: Duration = Duration::from_secs(45);

/// A pipe that takes nothing, and its other end, from which nobody reads.
fn full_pipe() -> (PipeWriter, PipeReader) {
    let (reader, mut writer) = std::io::pipe().expect("a pipe");
    fcntl_setfl(&writer, OFlags::NONBLOCK).expect("a pipe may not wait");
    while writer.write(&[b'.'; 4_096]).is_ok() {}
    while writer.write(b".").is_ok() {}
    fcntl_setfl(&writer, OFlags::empty()).expect("a pipe may wait");
    (writer, reader)
}

/// A node whose standard error is full from its first instant.
struct Mute {
    node: Program,
    _directory: OwnDirectory,
    _reader: PipeReader,
}

fn mute(backtrace: &str, arguments: &[&str]) -> Mute {
    let (directory, ground) = (OwnDirectory::new(), Ground::new());
    let path = directory.join("mute.toml");
    let text = format!(
        "[node]\nname = \"mute\"\naddress = \"127.0.0.1\"\n[ndl]\nmulticast = \"{}\"\nmdns_port = false\n",
        ground.group
    );
    std::fs::write(&path, text).expect("the test's own directory");
    let (writer, reader) = full_pipe();
    let mut command = Command::new(program("unread_log"));
    command.arg(path).args(arguments).env("RUST_BACKTRACE", backtrace).stderr(writer);
    Mute { node: Program::start("mute", command), _directory: directory, _reader: reader }
}

/// The time that a line says, in microseconds.
fn time(line: &str) -> u64 {
    line.rsplit(' ').next().and_then(|time| time.parse().ok()).unwrap_or_else(|| panic!("no time: {line}"))
}

impl Mute {
    /// Lets the hip panic, and waits for all that has to follow.
    fn panic_and_be_back(&mut self) -> u64 {
        self.node.tell("panic");
        let panicked = time(&self.node.wait_for(&["panics"]));
        let began = Instant::now();
        let [will, _, back] = ["will", "down Panic", "started"].map(|what| {
            let after = time(&self.node.wait_for(&[what])) - panicked;
            println!("{what} after {after} us");
            after
        });
        assert!(began.elapsed() < SOON, "that was brought about by a deadline: {:?}", began.elapsed());
        will.max(back)
    }
}

/// Three deaths, and an end in order.
fn dies_and_is_back(backtrace: &str, arguments: &[&str]) {
    let mut mute = mute(backtrace, arguments);
    for what in ["started", "watching"] {
        mute.node.wait_for(&[what]);
    }
    for _ in 0..3 {
        mute.panic_and_be_back();
    }
    mute.node.signal(Signal::TERM);
    assert_eq!(mute.node.wait_for_end(), Some(0), "it ends in order as well");
}

#[test]
fn who_panics_is_dead_and_back_where_nobody_reads_the_log() {
    dies_and_is_back("0", &["--subscriber"]);
}

#[test]
fn who_panics_is_dead_and_back_where_nobody_reads_the_log_and_backtraces_are_wanted() {
    dies_and_is_back("1", &["--subscriber"]);
}

#[test]
fn who_panics_is_dead_and_back_where_the_standard_panic_hook_is_stuck() {
    dies_and_is_back("1", &[]);
}

#[test]
fn who_panics_in_a_process_of_its_own_is_dead_and_back_where_nobody_reads_the_log() {
    dies_and_is_back("0", &["--subscriber", "--place"]);
}
