//! `sinew up`, `status`, `logs --robot` and `down` with real nodes on this host.

use std::{
    fs,
    io::Write as _,
    net::TcpListener,
    path::{Path, PathBuf},
    process::Command,
};

use serde_json::Value;
use sinew_testkit::program;

use crate::scenario::{Answer, Scenario, named};

/// A robot of two nodes, each with an application of its own name. The files of all robots are in a folder of the
/// test, and the robot is down when the test ends, also when it fails.
struct Robot {
    scenario: Scenario,
}

impl Robot {
    fn new() -> Self {
        Self { scenario: Scenario::new() }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.scenario.directory.join(name)
    }

    /// Writes the robot file with these tables of nodes. Returns its path.
    fn write(&self, settings: &str, nodes: &str) -> PathBuf {
        let state = self.path("state");
        let text = format!(
            "[robot]\nname = \"leg\"\nready_within_ms = 60000\n{settings}\n[host.here]\nfolder = \"{}\"\n{nodes}",
            state.display()
        );
        self.scenario.directory.write("robot.toml", &text)
    }

    /// The table of a node under test, with further options of its program and further keys.
    fn node(&self, name: &str, address: u8, more: &[&str], keys: &str) -> String {
        let config = self.scenario.configure(name, address, &[]);
        let words = ["--role", "node_under_test", &format!("{name}.toml")].map(str::to_owned);
        let words: Vec<_> = words.into_iter().chain(more.iter().map(|word| (*word).to_owned())).collect();
        let (program, config) = (self.path("program"), config.display());
        format!(
            "[node.{name}]\nprogram = \"{}\"\nconfig = \"{config}\"\narguments = {words:?}\n{keys}\n",
            program.display()
        )
    }

    /// Copies the program of the nodes, so that a test can change it.
    fn copy_program(&self) {
        fs::copy(program("scenarios"), self.path("program")).expect("build it: cargo build -p sinew-tests");
    }

    fn sinew(&self, words: &[&str]) -> Answer {
        let mut command = Command::new(env!("CARGO_BIN_EXE_sinew"));
        Answer::of(command.args(words).current_dir(self.path("")))
    }

    fn status(&self) -> Value {
        self.sinew(&["status", "--json"]).json()
    }

    /// Returns the process of a node that is ready.
    fn process(&self, name: &str) -> u64 {
        let status = self.status();
        let node = named(&status["nodes"], name).unwrap_or_else(|| panic!("no {name}: {status}"));
        assert_eq!(node["state"], "ready", "{status}");
        node["process"].as_u64().unwrap_or_else(|| panic!("{name} has no process: {status}"))
    }
}

impl Drop for Robot {
    fn drop(&mut self) {
        // A test that has failed leaves no processes.
        let _ = self.sinew(&["down"]);
    }
}

/// Whether a process runs: one that has ended may still wait for its parent.
pub(crate) fn runs(process: u64) -> bool {
    let stat = fs::read_to_string(format!("/proc/{process}/stat")).unwrap_or_default();
    stat.rsplit_once(')').is_some_and(|(_, rest)| !rest.trim_start().starts_with('Z'))
}

#[test]
fn robot_goes_up_changes_and_leaves_nothing() {
    // Given: a hip that waits for the knee, and is started after it
    let robot = Robot::new();
    robot.copy_program();
    let hip = robot.node("hip", 1, &["--requires", "knee"], "after = [\"knee\"]");
    let knee = robot.node("knee", 2, &[], "");
    robot.write("", &format!("{hip}{knee}"));
    // When: a dry run
    let dry = robot.sinew(&["up", "--dry-run", "--json"]);
    let steps = |json: &Value| -> Vec<String> {
        let rows = json["plan"].as_array().expect("a list").iter();
        rows.map(|row| format!("{} {}", row["node"], row["step"]).replace('"', "")).collect()
    };
    assert_eq!(steps(&dry.json()), ["hip start", "knee start"]);
    assert!(dry.code == Some(0) && !robot.path("state").exists(), "{}", dry.err);
    // When: from nothing
    let up = robot.sinew(&["up"]);
    assert!(
        up.code == Some(0) && up.out.ends_with("released: all 2 nodes are ready\n"),
        "{}{}",
        up.out,
        up.err
    );
    let (first, second) = (up.out.find("knee: started"), up.out.find("hip: started"));
    assert!(first.is_some() && first < second, "the order is not that of `after`: {}", up.out);
    let (hip, knee) = (robot.process("hip"), robot.process("knee"));
    // Then: a second time changes nothing
    let again = robot.sinew(&["up", "--json"]);
    assert_eq!(
        (again.code, steps(&again.json())),
        (Some(0), vec!["hip keep".to_owned(), "knee keep".to_owned()])
    );
    assert_eq!((robot.process("hip"), robot.process("knee")), (hip, knee));
    // When: the program of one node changes
    let other = robot.path("other");
    fs::copy(robot.path("program"), &other).expect("the test's own directory");
    let appended =
        fs::OpenOptions::new().append(true).open(&other).and_then(|mut file| file.write_all(b"new"));
    appended.expect("the test's own file");
    let file = fs::read_to_string(robot.path("robot.toml")).expect("the test's own file");
    let (before, after) = file.split_once("[node.knee]").expect("it has a knee");
    let (of, to) = (robot.path("program").display().to_string(), other.display().to_string());
    let changed = format!("{before}[node.knee]{}", after.replace(&of, &to));
    let _ = robot.scenario.directory.write("robot.toml", &changed);
    let change = robot.sinew(&["up"]);
    assert!(
        change.code == Some(0) && change.out.contains("its program changed"),
        "{}{}",
        change.out,
        change.err
    );
    assert_eq!(robot.process("hip"), hip, "only what changed is started again");
    assert!(robot.process("knee") != knee && !runs(knee));
    let logs = robot.sinew(&["logs", "--robot", "robot.toml", "--node", "knee"]);
    assert!(logs.out.starts_with("--- knee on here\n") && logs.out.contains("started"), "{}", logs.out);
    // When: down
    let knee = robot.process("knee");
    let down = robot.sinew(&["down"]);
    assert!(down.code == Some(0) && down.out.ends_with("leg: nothing is left\n"), "{}{}", down.out, down.err);
    assert!(!runs(hip) && !runs(knee));
    assert!(!robot.path("state").exists() && !robot.scenario.socket("knee").exists());
    let status = robot.sinew(&["status"]);
    assert!(status.code == Some(1) && status.out.contains("it was not started"), "{}", status.out);
}

#[test]
fn blocked_start_names_application_and_cause() {
    let robot = Robot::new();
    robot.copy_program();
    let knee = robot.node("knee", 2, &["--requires", "ankle"], "");
    let path = robot.write("", &knee);
    let text = fs::read_to_string(&path).expect("the test's own file").replace("60000", "3000");
    let _ = robot.scenario.directory.write("robot.toml", &text);
    let up = robot.sinew(&["up"]);
    assert_eq!(up.code, Some(1), "{}", up.out);
    for words in ["not ready within 3s", "knee: knee: has waited", "ankle (not there)", "sinew down"] {
        assert!(up.err.contains(words), "{words}: {}", up.err);
    }
    // The node runs on, so that the ankle can come.
    let status = robot.status();
    assert_eq!(named(&status["nodes"], "knee").expect("it was started")["state"], "waits", "{status}");
}

#[test]
fn ended_process_is_named_with_its_last_lines() {
    let robot = Robot::new();
    let script = "arguments = [\"-c\", \"echo no encoder at /dev/ttyUSB0; exit 1\"]\nsocket = \"none.sock\"";
    robot.write("", &format!("[node.knee]\ninstalled = \"/bin/sh\"\n{script}\n"));
    let up = robot.sinew(&["up"]);
    assert_eq!(up.code, Some(1), "{}", up.out);
    for words in ["knee: its process has ended", "no encoder at /dev/ttyUSB0"] {
        assert!(up.err.contains(words), "{words}: {}", up.err);
    }
    // A program that the system cannot execute is an error of its own.
    let missing = script.replace("none", "other");
    robot.write("", &format!("[node.knee]\ninstalled = \"/none/at/all\"\n{missing}\n"));
    let up = robot.sinew(&["up"]);
    assert!(up.err.contains("/none/at/all: it cannot be executed: No such file"), "{}", up.err);
}

#[test]
fn faults_of_files_are_found_before_any_change() {
    let robot = Robot::new();
    robot.copy_program();
    fs::create_dir(robot.path("keys")).expect("the test's own directory");
    let hip = robot.node("hip", 1, &[], "keys = false");
    let knee = robot.node("knee", 2, &[], "files = [\"map.bin\", \"/dev/zero\"]");
    robot.write("keys = \"keys\"", &format!("{hip}{knee}"));
    let up = robot.sinew(&["up"]);
    assert_eq!(up.code, Some(1), "{}", up.out);
    let [map, keys] = ["map.bin", "keys/nodes/knee"].map(|path| robot.path(path).display().to_string());
    let lacks = format!("knee: its keys {keys}: No such file");
    for words in ["nothing was changed:", &map, "/dev/zero: it is no file", &lacks, "sinew keys init"] {
        assert!(up.err.contains(words), "{words}: {}", up.err);
    }
    assert!(!robot.path("state").exists());
    let typo = robot
        .scenario
        .directory
        .write("robot.toml", "[robot]\nname = \"leg\"\n[node.knee]\nprogramm = \"x\"\n");
    let up = robot.sinew(&["up", typo.to_str().expect("a short path")]);
    assert!(up.code == Some(1) && up.err.contains("write program, the nearest one"), "{}", up.err);
}

#[test]
fn taken_port_is_named_before_any_change() {
    let robot = Robot::new();
    robot.copy_program();
    let listener = TcpListener::bind("127.0.0.2:0").expect("loopback has free ports");
    let port = listener.local_addr().expect("it is bound").port();
    let knee = robot.node("knee", 2, &[], "");
    let interface = ("[ndl]", "[ndl]\ninterface = \"127.0.0.2\"");
    let gncl = format!("[gncl]\nport = {port}\n[ndl]\ninterface = \"127.0.0.2\"");
    robot.scenario.configure("knee", 2, &[(interface.0, &gncl)]);
    robot.write("", &knee);
    let up = robot.sinew(&["up"]);
    assert_eq!(up.code, Some(1), "{}", up.out);
    let words = format!("knee: TCP port 127.0.0.2:{port} is taken by process {} (", std::process::id());
    assert!(up.err.contains("nothing was changed:") && up.err.contains(&words), "{}", up.err);
    assert!(!robot.path("state").exists(), "a start that changes nothing leaves a folder");
}

#[test]
fn units_are_written_and_nothing_is_started() {
    let robot = Robot::new();
    robot.copy_program();
    let knee = robot.node("knee", 2, &[], "realtime_priority_max = 95");
    robot.write("", &knee);
    let up = robot.sinew(&["up", "--systemd"]);
    assert!(up.code == Some(0) && up.out.contains("systemctl link"), "{}{}", up.out, up.err);
    let units = robot.path("state/robots/leg/units");
    let unit = fs::read_to_string(units.join("sinew-leg-knee.service")).expect("it was written");
    for line in ["Type=notify", "WatchdogSec=5", "LimitRTPRIO=95"] {
        assert!(unit.lines().any(|is| is == line), "{line}: {unit}");
    }
    assert!(is_verified(&units), "{unit}");
    let status = robot.status();
    assert_eq!(named(&status["nodes"], "knee").expect("it has files")["process"], Value::Null, "{status}");
    let down = robot.sinew(&["down"]);
    assert!(down.code == Some(0) && !robot.path("state").exists(), "{}{}", down.out, down.err);
}

/// Returns whether systemd accepts the units in a folder; also true, with a printed reason, if it is not there.
fn is_verified(units: &Path) -> bool {
    let mut command = Command::new("systemd-analyze");
    command.args(["verify", "--man=no"]);
    command.args(["sinew-leg-knee.service", "sinew-leg.target"].map(|unit| units.join(unit)));
    let Ok(output) = command.output() else {
        println!("skipped: there is no systemd-analyze");
        return true;
    };
    output.status.success()
}
