//! A node with an unread log: its standard error is a full pipe. A panicking actor is reported and restarted
//! all the same.

use sinew_tests::role;
use std::{
    io::{PipeReader, PipeWriter, Write},
    time::Instant,
};

use rustix::{
    fs::{OFlags, fcntl_setfl},
    process::Signal,
};
use sinew::prelude::Duration;
use sinew_testkit::{Loopback, NodeProcess, TestDirectory};

/// Time limit for the events after a panic: generous, because a backtrace is looked up, and less than the
/// deadline of each of the three lines.
const SOON: Duration = Duration::from_secs(45);

/// A full pipe, and its other end, which nothing reads.
fn full_pipe() -> (PipeWriter, PipeReader) {
    let (reader, mut writer) = std::io::pipe().expect("a pipe");
    fcntl_setfl(&writer, OFlags::NONBLOCK).expect("a pipe may not wait");
    while writer.write(&[b'.'; 4_096]).is_ok() {}
    while writer.write(b".").is_ok() {}
    fcntl_setfl(&writer, OFlags::empty()).expect("a pipe may wait");
    (writer, reader)
}

/// A node with a full standard error from the start.
struct Mute {
    node: NodeProcess,
    _directory: TestDirectory,
    _reader: PipeReader,
}

fn mute(backtrace: &str, arguments: &[&str]) -> Mute {
    let (directory, loopback) = (TestDirectory::new(), Loopback::new());
    let text = format!(
        "[node]\nname = \"mute\"\naddress = \"127.0.0.1\"\n[ndl]\nmulticast = \"{}\"\nmdns_port = false\n",
        loopback.group
    );
    let path = directory.write("mute.toml", &text);
    let (writer, reader) = full_pipe();
    let mut command = role("unread_log");
    command.arg(path).args(arguments).env("RUST_BACKTRACE", backtrace).stderr(writer);
    Mute { node: NodeProcess::start("mute", command), _directory: directory, _reader: reader }
}

/// The time in a line, in microseconds.
fn time(line: &str) -> u64 {
    line.rsplit(' ').next().and_then(|time| time.parse().ok()).unwrap_or_else(|| panic!("no time: {line}"))
}

impl Mute {
    /// Lets the hip panic, and waits for all events that must follow.
    fn panic_and_be_back(&mut self) -> u64 {
        self.node.send_line("panic");
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

/// Checks three deaths, and a clean end.
fn dies_and_is_back(backtrace: &str, arguments: &[&str]) {
    let mut mute = mute(backtrace, arguments);
    for what in ["started", "watching"] {
        mute.node.wait_for(&[what]);
    }
    for _ in 0..3 {
        mute.panic_and_be_back();
    }
    mute.node.signal(Signal::TERM);
    assert_eq!(mute.node.wait_for_exit(), Some(0), "it ends in order as well");
}

#[test]
fn panic_is_handled_with_an_unread_log() {
    dies_and_is_back("0", &["--subscriber"]);
}

#[test]
fn panic_with_backtrace_is_handled_with_an_unread_log() {
    dies_and_is_back("1", &["--subscriber"]);
}

#[test]
fn panic_is_handled_with_a_stuck_standard_hook() {
    dies_and_is_back("1", &[]);
}

#[test]
fn panic_in_a_process_is_handled_with_unread_log() {
    dies_and_is_back("0", &["--subscriber", "--place"]);
}
