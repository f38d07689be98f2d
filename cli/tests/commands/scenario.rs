//! Real nodes of a test's own, and the command itself.

use std::{
    net::SocketAddrV4,
    path::{Path, PathBuf},
    process::{Command, Output},
};

use serde_json::Value;
use sinew_tests::{OwnDirectory, Program, own_group, program, until};

/// Nodes of a test's own, each with a socket.
pub(crate) struct Scenario {
    pub(crate) directory: OwnDirectory,
    pub(crate) group: SocketAddrV4,
}

/// What the command said.
pub(crate) struct Answer {
    pub(crate) code: Option<i32>,
    pub(crate) out: String,
    pub(crate) err: String,
}

impl Answer {
    /// Runs it.
    pub(crate) fn of(command: &mut Command) -> Self {
        let Output { status, stdout, stderr } = command.output().expect("the command starts");
        let text = |bytes| String::from_utf8(bytes).expect("it writes text");
        Self { code: status.code(), out: text(stdout), err: text(stderr) }
    }

    pub(crate) fn json(&self) -> Value {
        serde_json::from_str(&self.out).unwrap_or_else(|error| panic!("{error}: {}{}", self.out, self.err))
    }
}

impl Scenario {
    pub(crate) fn new() -> Self {
        Self { directory: OwnDirectory::new(), group: own_group() }
    }

    pub(crate) fn socket(&self, name: &str) -> PathBuf {
        self.directory.join(&format!("{name}.sock"))
    }

    /// A node with the application of its name; returns when its layers are up.
    pub(crate) fn start(&self, name: &str, address: u8, more: &[&str]) -> Program {
        self.start_changed(name, address, &[], more)
    }

    /// The hip, which sends counts to the knee all the time, and the knee, which has the first of them.
    pub(crate) fn start_a_hip_that_sends_to_a_knee(&self) -> (Program, Program) {
        let mut hip = self.start("hip", 1, &["--requires", "knee", "--sends-to", "knee"]);
        let mut knee = self.start("knee", 2, &[]);
        hip.wait_for(&["started"]);
        knee.wait_for(&["count 5 "]);
        (hip, knee)
    }

    /// The hip, which runs, and the knee, which waits for an ankle that is not there.
    pub(crate) fn start_a_knee_that_waits_for_an_ankle(&self) -> (Program, Program) {
        let mut hip = self.start("hip", 1, &[]);
        hip.wait_for(&["started"]);
        let knee = self.start("knee", 2, &["--requires", "ankle"]);
        self.until("the knee waits", "hip", &["apps"], |said| {
            named(&said["apps"], "knee").is_some_and(|app| app["state"] == "waits")
        });
        (hip, knee)
    }

    /// As `start`, with these texts of its configuration replaced by others.
    pub(crate) fn start_changed(
        &self,
        name: &str,
        address: u8,
        changes: &[(&str, &str)],
        more: &[&str],
    ) -> Program {
        let path = self.configure(name, address, changes);
        let mut command = Command::new(node_program());
        command.arg(&path).args(more);
        let mut node = Program::start(name, command);
        node.wait_for(&["up"]);
        node
    }

    /// Writes the configuration of a node, with these texts of it replaced by others.
    pub(crate) fn configure(&self, name: &str, address: u8, changes: &[(&str, &str)]) -> PathBuf {
        let path = self.directory.join(&format!("{name}.toml"));
        let text = format!(
            "[node]\nname = \"{name}\"\naddress = \"127.0.0.{address}\"\nproject = \"cli\"\n\
             [lncl]\nsocket = \"{}\"\n[ndl]\nmulticast = \"{}\"\nmdns_port = false\n",
            self.socket(name).display(),
            self.group
        );
        let text = changes.iter().fold(text, |text, (from, to)| text.replace(from, to));
        std::fs::write(&path, text).expect("the test's own directory");
        path
    }

    /// Runs `sinew` through the socket of the node called `name`. A node of a machine that is slow has more time for its answer than the
    /// command gives it by itself.
    pub(crate) fn sinew(&self, name: &str, words: &[&str]) -> Answer {
        let socket = self.socket(name);
        let door = ["--socket", socket.to_str().expect("a short path")];
        let patience: &[&str] =
            if words.contains(&"--deadline-ms") { &[] } else { &["--deadline-ms", "10000"] };
        sinew(&[&door, patience, words].concat(), Path::new("/"))
    }

    /// Asks again until the JSON that comes is as it is to be.
    pub(crate) fn until(
        &self,
        what: &str,
        name: &str,
        words: &[&str],
        is_so: impl Fn(&Value) -> bool,
    ) -> Value {
        let words = [words, &["--json"]].concat();
        until(what, || Some(self.sinew(name, &words).json()).filter(&is_so))
    }
}

/// The program of the nodes.
pub(crate) fn node_program() -> PathBuf {
    let node = program("node_under_test");
    assert!(node.exists(), "there is no {}; build it: cargo build -p sinew-tests", node.display());
    node
}

pub(crate) fn sinew(words: &[&str], runtime_directory: &Path) -> Answer {
    let mut command = Command::new(env!("CARGO_BIN_EXE_sinew"));
    Answer::of(command.args(words).env("XDG_RUNTIME_DIR", runtime_directory).env_remove("SINEW_SOCKET"))
}

/// The element of `list` whose `name` is this one.
pub(crate) fn named<'a>(list: &'a Value, name: &str) -> Option<&'a Value> {
    list.as_array()?.iter().find(|one| one["name"] == name)
}
