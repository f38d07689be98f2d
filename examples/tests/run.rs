//! Each example runs as a process of its own, prints the documented output, and ends.

use std::{
    fs::{self, File},
    ops::{Deref, DerefMut},
    path::PathBuf,
    process::Command,
    sync::OnceLock,
};

use sinew_testkit::{NodeProcess, TestDirectory, program};

/// A directory of this test for the sockets of its programs.
struct Scenario(TestDirectory);

impl Scenario {
    fn new() -> Self {
        keep_other_runs_out();
        Self(TestDirectory::new())
    }

    /// Starts an example. Its log goes into a file with the name `as_whom`.
    fn start(&self, example: &str, arguments: &[&str], as_whom: &str) -> Example {
        let path = program("examples").join(example);
        assert!(path.is_file(), "{path:?} is not built: cargo build --workspace --examples");
        let log = self.0.join(&format!("{as_whom}.log"));
        let mut command = Command::new(path);
        command.args(arguments).env("TMPDIR", self.0.join("")).env_remove("SINEW_LOG").env_remove("RUST_LOG");
        command.stderr(File::create(&log).expect("the directory is there"));
        Example { process: NodeProcess::start(as_whom, command), log }
    }

    /// Runs an example until it exits successfully. Returns the lines that it printed.
    fn run(&self, example: &str) -> Vec<String> {
        let mut example = self.start(example, &[], example);
        assert_eq!(example.wait_for_exit(), Some(0), "{}", example.all());
        example.output().to_vec()
    }
}

/// Without this, nodes of two parallel test runs would discover each other, and have the same addresses.
fn keep_other_runs_out() {
    static LOCK: OnceLock<Option<File>> = OnceLock::new();
    LOCK.get_or_init(|| {
        let file = File::create(std::env::temp_dir().join("sinew-examples.lock")).ok()?;
        file.lock().ok()?;
        Some(file)
    });
}

/// A running example.
struct Example {
    process: NodeProcess,
    log: PathBuf,
}

impl Example {
    /// Returns its standard output and its log.
    fn all(&self) -> String {
        let log = fs::read_to_string(&self.log).expect("it is there");
        format!("{}\n{log}", self.output().join("\n"))
    }
}

impl Deref for Example {
    type Target = NodeProcess;

    fn deref(&self) -> &NodeProcess {
        &self.process
    }
}

impl DerefMut for Example {
    fn deref_mut(&mut self) -> &mut NodeProcess {
        &mut self.process
    }
}

#[test]
fn hello_prints_five_commands() {
    let bends: Vec<_> = (1..=5).map(|number| format!("the knee bends to {number}0 degrees")).collect();
    assert_eq!(Scenario::new().run("hello"), bends);
}

#[test]
fn ask_prints_outcomes_and_a_reply() {
    let printed = [
        "move to 30 degrees: Delivered",
        "move to 300 degrees: Rejected(ByHandler)",
        "the knee is at 30 degrees",
    ];
    assert_eq!(Scenario::new().run("ask"), printed);
}

#[test]
fn stream_prints_all_commands_and_the_newest_position() {
    let printed = ["command 1", "command 2", "command 3", "command 4", "command 5", "position 5"];
    assert_eq!(Scenario::new().run("stream"), printed);
}

#[test]
fn group_stops_three_drives() {
    let mut printed = Scenario::new().run("group");
    printed.sort();
    let expected = ["3 of 3 drives have confirmed", "the ankle stops", "the hip stops", "the knee stops"];
    assert_eq!(printed, expected);
}

#[test]
fn barrier_holds_all_until_each_is_calibrated() {
    let printed = Scenario::new().run("barrier");
    let (before, after) = printed.split_at(3);
    assert_eq!(before, ["the hip is calibrated", "the knee is calibrated", "the ankle is calibrated"]);
    let mut walking = after.to_vec();
    walking.sort();
    assert_eq!(walking, ["the ankle walks", "the hip walks", "the knee walks"]);
}

#[test]
fn supervisor_restarts_both_and_keeps_the_second_command() {
    let printed = [
        "the motor starts",
        "the controller starts",
        "move to 300 degrees: Failed",
        "the motor starts",
        "the controller starts",
        "the controller moves to 30 degrees",
        "move to 30 degrees: Delivered",
    ];
    assert_eq!(Scenario::new().run("supervisor"), printed);
}

#[test]
fn own_process_restarts_only_after_sigkill() {
    let scenario = Scenario::new();
    let printed = scenario.run("own_process");
    let [first, end, second] = &printed[..] else { panic!("{printed:?}") };
    assert!(first.starts_with("life 1 of the camera is process "), "{first}");
    assert_eq!(end, "the camera ended: its process ended: killed by signal 9 (SIGKILL)");
    assert!(second.starts_with("life 2 of the camera is process "), "{second}");
    let process = |line: &String| line.rsplit(' ').next().map(str::to_owned);
    assert_ne!(process(first), process(second));
    // With the same address as the previous node.
    let mut node = scenario.start("own_process", &["--for", "1"], "node");
    assert_eq!(node.wait_for_exit(), Some(0), "{}", node.all());
    let printed = node.output();
    assert!(matches!(printed, [line] if line.starts_with("life 1 ")), "{printed:?}");
}

#[test]
fn guarded_motor_moves_once_armed_and_ends_safe() {
    let printed = Scenario::new().run("guarded_motor");
    let [first, moves @ .., last] = &printed[..] else { panic!("{printed:?}") };
    assert_eq!(first, "the motor is armed");
    assert!(!moves.is_empty() && moves.iter().all(|line| line.starts_with("the motor has ")), "{printed:?}");
    assert_eq!(last, "the motor is safe: no good message came in time");
}

#[test]
fn illegal_gains_are_refused_and_legal_ones_reached() {
    let printed = Scenario::new().run("gains");
    let [refused, applied, reached] = &printed[..] else { panic!("{printed:?}") };
    assert_eq!(refused, "refused: assistance = 1.4 is outside 0.0 to 1.0");
    assert!(applied.starts_with("applied at tick "), "{applied}");
    assert_eq!(reached, "the knee assists with 0.5");
}

#[test]
fn client_thread_moves_the_knee_and_receives_its_angle() {
    let printed = [
        "gait: the move was Delivered",
        "gait: the knee answers 30 degrees",
        "gait: the knee sent 30 degrees",
    ];
    assert_eq!(Scenario::new().run("client_thread"), printed);
}

#[test]
fn client_task_is_answered_within_the_limit() {
    let printed = [
        "asked for 10 Nm, the drive applies 10 Nm",
        "asked for 30 Nm, the drive applies 30 Nm",
        "asked for 50 Nm, the drive applies 40 Nm",
    ];
    assert_eq!(Scenario::new().run("client_task"), printed);
}

#[test]
fn misspelt_keys_of_the_settings_file_are_named() {
    let scenario = Scenario::new();
    assert_eq!(scenario.run("settings"), ["the knee has a gain of 12.5 and a limit of 40 Nm"]);
    let file = scenario.0.join("wrong.toml");
    fs::write(&file, "[node]\nname = 'settings'\n[app.knee]\nkp = 12.5\nlimit_mn = 40.0\n")
        .expect("it is ours");
    let path = file.to_str().expect("it is text");
    let mut wrong = scenario.start("settings", &[path], "wrong");
    assert_eq!(wrong.wait_for_exit(), Some(1), "{}", wrong.all());
    assert!(wrong.all().contains("app.knee.limit_mn") && wrong.all().contains("line 5"), "{}", wrong.all());
}

#[test]
fn two_nodes_reconnect_after_one_was_killed() {
    let scenario = Scenario::new();
    let mut hip = scenario.start("two_nodes", &["hip", "--for", "60"], "hip");
    let mut knee = scenario.start("two_nodes", &["knee", "--for", "60"], "knee");
    hip.wait_for(&["the hip starts: the knee is ready"]);
    knee.wait_for(&["the hip (127.0.0.2/"]);
    knee.kill();
    hip.wait_for(&["the hip has lost the knee"]);
    let mut knee = scenario.start("two_nodes", &["knee", "--for", "2"], "knee again");
    hip.wait_for(&["the hip has the knee again"]);
    knee.wait_for(&["the hip (127.0.0.2/"]);
    assert_eq!(knee.wait_for_exit(), Some(0), "{}", knee.all());
}

#[test]
fn two_nodes_require_a_node_name() {
    let scenario = Scenario::new();
    let mut none = scenario.start("two_nodes", &[], "none");
    assert_eq!(none.wait_for_exit(), Some(1));
    assert!(none.all().contains("hip or knee"), "{}", none.all());
}

#[test]
fn knee_has_a_sensor_that_streams_to_its_drive() {
    let scenario = Scenario::new();
    let path = scenario.0.join("sinew-knee.sock");
    let builder = sinew::Node::builder("knee").configure(|config| {
        config.project = "examples".to_owned();
        config.lncl.socket = Some(path.clone());
    });
    let _node = builder.start().expect("its layers start");
    let socket = path.to_str().expect("it is text");
    let mut drive = scenario.start("knee", &["drive", socket], "drive");
    let mut sensor = scenario.start("knee", &["sensor", socket], "sensor");
    assert_eq!(sensor.wait_for_exit(), Some(0), "{}", sensor.all());
    assert_eq!(sensor.output(), ["calibrate: Delivered"]);
    drive.wait_for(&["calibrated: zero is at 0.5 degrees"]);
    drive.wait_for(&["the sensor is at "]); // not each value arrives: newest wins
}
