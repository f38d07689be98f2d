//! Real nodes of a test, and the command itself.

use std::{
    net::SocketAddrV4,
    path::{Path, PathBuf},
    process::{Command, Output},
};

use serde_json::Value;
use sinew_testkit::{NodeProcess, TestDirectory, own_group, program, until};

/// Nodes of one test, each with a socket.
pub(crate) struct Scenario {
    pub(crate) directory: TestDirectory,
    pub(crate) group: SocketAddrV4,
}

/// The exit code and the output of the command.
pub(crate) struct Answer {
    pub(crate) code: Option<i32>,
    pub(crate) out: String,
    pub(crate) err: String,
}

impl Answer {
    /// Runs the command.
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
        Self { directory: TestDirectory::new(), group: own_group() }
    }

    pub(crate) fn socket(&self, name: &str) -> PathBuf {
        self.directory.join(&format!("{name}.sock"))
    }

    /// Starts a node with an application of the same name. Returns when its layers are up.
    pub(crate) fn start(&self, name: &str, address: u8, more: &[&str]) -> NodeProcess {
        self.start_changed(name, address, &[], more)
    }

    /// Starts the hip, which sends counts to the knee all the time, and the knee. Returns when the knee has received
    /// the first counts.
    pub(crate) fn start_a_hip_that_sends_to_a_knee(&self) -> (NodeProcess, NodeProcess) {
        let mut hip = self.start("hip", 1, &["--requires", "knee", "--sends-to", "knee"]);
        let mut knee = self.start("knee", 2, &[]);
        hip.wait_for(&["started"]);
        knee.wait_for(&["count 5 "]);
        (hip, knee)
    }

    /// Starts the hip, which runs, and the knee, which waits for an absent ankle.
    pub(crate) fn start_a_knee_that_waits_for_an_ankle(&self) -> (NodeProcess, NodeProcess) {
        let mut hip = self.start("hip", 1, &[]);
        hip.wait_for(&["started"]);
        let knee = self.start("knee", 2, &["--requires", "ankle"]);
        self.until("the knee waits", "hip", &["apps"], |json| {
            named(&json["apps"], "knee").is_some_and(|app| app["state"] == "waits")
        });
        (hip, knee)
    }

    /// Same as `start`, with these texts of its configuration replaced.
    pub(crate) fn start_changed(
        &self,
        name: &str,
        address: u8,
        changes: &[(&str, &str)],
        more: &[&str],
    ) -> NodeProcess {
        let path = self.configure(name, address, changes);
        let mut command = node_command();
        command.arg(&path).args(more);
        let mut node = NodeProcess::start(name, command);
        node.wait_for(&["up"]);
        node
    }

    /// Writes the configuration of a node, with these texts replaced. `place` is its name, after the directory of its
    /// files if it has a separate one.
    pub(crate) fn configure(&self, place: &str, address: u8, changes: &[(&str, &str)]) -> PathBuf {
        let name = place.rsplit('/').next().unwrap_or(place);
        let text = format!(
            "[node]\nname = \"{name}\"\naddress = \"127.0.0.{address}\"\nproject = \"cli\"\n\
             [lncl]\nsocket = \"{}\"\n[ndl]\nmulticast = \"{}\"\nmdns_port = false\n",
            self.socket(place).display(),
            self.group
        );
        let text = changes.iter().fold(text, |text, (from, to)| text.replace(from, to));
        self.directory.write(&format!("{place}.toml"), &text)
    }

    /// Runs `sinew` through the socket of the node called `name`. Nodes get more time to answer than the command's
    /// default, because the machine may be slow.
    pub(crate) fn sinew(&self, name: &str, words: &[&str]) -> Answer {
        let socket = self.socket(name);
        let door = ["--socket", socket.to_str().expect("a short path")];
        let patience: &[&str] =
            if words.contains(&"--deadline-ms") { &[] } else { &["--deadline-ms", "10000"] };
        sinew(&[&door, patience, words].concat(), Path::new("/"))
    }

    /// Repeats the command until its JSON satisfies the condition.
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

/// A command that starts a node.
pub(crate) fn node_command() -> Command {
    let scenarios = program("scenarios");
    assert!(scenarios.exists(), "there is no {}; build it: cargo build -p sinew-tests", scenarios.display());
    let mut command = Command::new(scenarios);
    command.args(["--role", "node_under_test"]);
    command
}

pub(crate) fn sinew(words: &[&str], runtime_directory: &Path) -> Answer {
    let mut command = Command::new(env!("CARGO_BIN_EXE_sinew"));
    Answer::of(command.args(words).env("XDG_RUNTIME_DIR", runtime_directory).env_remove("SINEW_SOCKET"))
}

/// Returns the element of `list` with this `name`.
pub(crate) fn named<'a>(list: &'a Value, name: &str) -> Option<&'a Value> {
    list.as_array()?.iter().find(|one| one["name"] == name)
}

/// Returns the blocked steps of `sinew why`, as text.
pub(crate) fn blocked(json: &Value) -> String {
    let steps = json["steps"].as_array().expect("a list").iter();
    let blocked = steps.filter(|step| step["status"] == "blocked");
    blocked
        .map(|step| format!("{}: {} - {}\n", step["step"], step["detail"], step["suggested_fix"]))
        .collect()
}
