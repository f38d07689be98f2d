//! The stop of the whole system, pressed beside the walking robot: all drives stop, nothing moves after the release
//! before the person at central resets them, and nodes that all start anew come up stopped.

use std::collections::BTreeMap;
use std::io;
use std::path::{Path, PathBuf};
use std::process::Child;
use std::time::{Duration, Instant};

use exoskeleton::robot::edges::{GAIT, Release, Reset, STATUS, drive_name};
use exoskeleton::robot::topology::{NodePlace, Topology, for_this_host};
use exoskeleton_model::joint::Joint;
use exoskeleton_model::message::{DriveState, DriveStatus};
use sinew::stop::{AskStop, ReleaseStop, StopReport, StopState};
use sinew::{AppAddress, Endpoint, NodeAddress, NodeApi, Outcome, Payload, Registration, Tid};
use sinew_figures::{Alone, Figures, head};

use crate::{DEADLINE, SOCKETS, alone, end, folder, start};

/// The reason of the press, which is in the file of the stop.
const REASON: &str = "a test of the stop";
/// The joints first: central waits for them.
const NODES: [&str; 4] = ["hip", "knee", "ankle", "central"];
/// Time for an answer of a node.
const WITHIN: Duration = Duration::from_secs(20);
/// Statuses of each drive in which nothing may move.
const STATUSES: u32 = 100;
/// The environment variable that sets the number of presses of the long run.
const PRESSES_WANTED: &str = "SINEW_STOP_PRESSES";
const PRESSES: u32 = 100;
/// Statuses of all drives in a stride and more, so that presses come at many phases.
const STRIDE_STATUSES: u32 = 400;

/// The robot, each part in a process that this test has started.
struct Robot {
    folder: PathBuf,
    topology: Topology,
    file: String,
    parts: BTreeMap<&'static str, Child>,
}

impl Robot {
    fn start(folder: &Path) -> Self {
        let mut topology = for_this_host(1).expect("free ports");
        let place = |place: &mut NodePlace, name: &str| {
            place.socket = Some(folder.join(SOCKETS).join(format!("{name}.sock")));
            place.state = Some(folder.join(format!("{name}-state")));
        };
        for (joint, of) in Joint::ALL.into_iter().zip(&mut topology.joints) {
            place(of, joint.name());
        }
        place(&mut topology.central, "central");
        let path = folder.join("topology.toml");
        std::fs::write(&path, topology.to_toml()).expect("a file in this test's folder");
        let file = path.display().to_string();
        let mut robot = Self { folder: folder.to_owned(), topology, file, parts: BTreeMap::new() };
        robot.start_part("plant");
        NODES.into_iter().for_each(|node| robot.start_part(node));
        robot
    }

    fn start_part(&mut self, part: &'static str) {
        let words = ["node", part, "--stop-with-stdin", "--topology", &self.file];
        let mut child = start(&self.folder, &words);
        // A pipe that nothing reads would hold it up.
        let (mut out, mut log) = (child.stdout.take(), child.stderr.take());
        std::thread::spawn(move || out.as_mut().map(|out| io::copy(out, &mut io::sink())));
        std::thread::spawn(move || log.as_mut().map(|log| io::copy(log, &mut io::sink())));
        self.parts.insert(part, child);
    }

    /// Kills all nodes at once, and starts them again. The plant stays.
    fn restart_nodes(&mut self) {
        for node in NODES {
            let child = self.parts.get_mut(node).expect("it was started");
            child.kill().expect("it is a child of this process");
        }
        for node in NODES {
            let child = self.parts.remove(node).expect("it was started");
            let _ = end(child, node);
        }
        NODES.into_iter().for_each(|node| self.start_part(node));
    }

    fn end(mut self) {
        for (part, child) in std::mem::take(&mut self.parts) {
            let _ = end(child, part);
        }
    }

    /// Registers at the node of this part, as soon as it runs.
    fn endpoint(&self, place: &NodePlace) -> Endpoint {
        let socket = place.socket.as_ref().expect("it has one");
        let connect = || NodeApi::connect(socket)?.register_transport_address(Registration::new());
        let deadline = Instant::now() + DEADLINE;
        loop {
            match connect() {
                Ok(endpoint) => return endpoint,
                Err(why) => assert!(Instant::now() < deadline, "{}: {why}", socket.display()),
            }
            std::thread::sleep(Duration::from_millis(50));
        }
    }

    /// Returns the place of a node: the joints in turn, then central.
    fn place(&self, number: u32) -> &NodePlace {
        self.topology.joints.get(number as usize % NODES.len()).unwrap_or(&self.topology.central)
    }

    /// The person at central: it also reads the statuses of the drives.
    fn person(&self) -> Person {
        let mut endpoint = self.endpoint(&self.topology.central);
        endpoint.join(STATUS).expect("the node answers");
        let drives = Joint::ALL.map(|joint| self.topology.joints[joint.index()].address);
        Person { endpoint, drives }
    }
}

struct Person {
    endpoint: Endpoint,
    /// The nodes of the drives.
    drives: [NodeAddress; 3],
}

impl Person {
    /// Reads the next status of a drive, and returns which one it is of.
    fn next_status(&mut self) -> Option<(usize, DriveStatus)> {
        let received = self.endpoint.receive(Duration::from_millis(100)).expect("central runs")?;
        let drive = self.drives.iter().position(|node| *node == received.source().node)?;
        (received.kind() == DriveStatus::KIND)
            .then(|| received.decode().expect("a status"))
            .map(|status| (drive, status))
    }

    /// Reads statuses until the last one of each drive has this state, and a stopped one no torque.
    #[track_caller]
    fn until_all(&mut self, wanted: DriveState) {
        let deadline = Instant::now() + DEADLINE;
        let mut states = [None; 3];
        while states != [Some(wanted); 3] {
            assert!(Instant::now() < deadline, "all drives are {wanted:?} within {DEADLINE:?}: {states:?}");
            if let Some((drive, status)) = self.next_status() {
                let is_at_rest = status.state != DriveState::EStop || status.torque_nm == 0.0;
                states[drive] = is_at_rest.then_some(status.state);
            }
        }
    }

    /// Reads many statuses of each drive, in none of which it moves.
    #[track_caller]
    fn nothing_moves(&mut self, when: &str) {
        let deadline = Instant::now() + DEADLINE;
        let mut counts = [0; 3];
        while counts.iter().any(|count| *count < STATUSES) {
            assert!(Instant::now() < deadline, "{when}: {counts:?} statuses within {DEADLINE:?}");
            let Some((drive, status)) = self.next_status() else { continue };
            assert!(
                status.state != DriveState::Walk && status.torque_nm == 0.0,
                "{when}: drive {drive}: {status:?}"
            );
            counts[drive] += 1;
        }
    }

    /// Reads so many statuses.
    #[track_caller]
    fn watch(&mut self, statuses: u32) {
        let (deadline, mut left) = (Instant::now() + DEADLINE, statuses);
        while left > 0 {
            assert!(Instant::now() < deadline, "{statuses} statuses within {DEADLINE:?}, {left} are missing");
            left -= u32::from(self.next_status().is_some());
        }
    }

    fn stop(&self) -> Tid {
        Tid::new(self.endpoint.tid().node, AppAddress::STOP)
    }

    fn status(&mut self) -> StopReport {
        let stop = self.stop();
        self.endpoint.message(stop, &AskStop {}).ask(WITHIN).expect("central answers")
    }

    fn release(&mut self) {
        let (stop, order) = (self.stop(), ReleaseStop { within_ms: 10_000 });
        let report: StopReport = self.endpoint.message(stop, &order).ask(WITHIN).expect("central answers");
        assert!(report.refused.is_none() && report.presses.is_empty(), "{report:?}");
    }

    fn order<P: Payload>(&mut self, name: &str, order: &P) -> Option<Outcome> {
        let to = self.endpoint.resolve(name, WITHIN).expect("central answers")?;
        Some(self.endpoint.message(to, order).confirmed(WITHIN).expect("central answers"))
    }

    /// Resets the stop at central and at each drive, and lets the leg walk. A drive that is not at rest yet refuses:
    /// then it is asked again.
    #[track_caller]
    fn walk_again(&mut self) {
        let deadline = Instant::now() + DEADLINE;
        loop {
            let mut outcomes = vec![self.order(GAIT, &Reset {})];
            outcomes.extend(Joint::ALL.map(|joint| self.order(&drive_name(joint), &Reset {})));
            outcomes.push(self.order(GAIT, &Release {}));
            if outcomes.iter().all(|outcome| *outcome == Some(Outcome::Delivered)) {
                return self.until_all(DriveState::Walk);
            }
            assert!(Instant::now() < deadline, "all are reset within {DEADLINE:?}: {outcomes:?}");
            std::thread::sleep(Duration::from_millis(100));
        }
    }
}

/// Waits until each node has the stop on its disk: a node has the file, without a press, from its start on.
fn wait_until_kept(folder: &Path) {
    let has_press = |path: &Path| {
        let content = std::fs::read(path).unwrap_or_default();
        content.windows(REASON.len()).any(|bytes| bytes == REASON.as_bytes())
    };
    let is_kept = |node: &str| {
        let mut entries =
            std::fs::read_dir(folder.join(format!("{node}-state"))).into_iter().flatten().flatten();
        entries
            .any(|entry| entry.file_name().to_string_lossy().starts_with("stop-") && has_press(&entry.path()))
    };
    let deadline = Instant::now() + DEADLINE;
    while !NODES.iter().all(|node| is_kept(node)) {
        assert!(Instant::now() < deadline, "all nodes have written the stop within {DEADLINE:?}");
        std::thread::sleep(Duration::from_millis(20));
    }
}

#[test]
fn stop_of_the_walking_robot_lasts_until_its_reset() {
    let _alone = alone();
    let folder = folder("stop");
    let mut robot = Robot::start(&folder);
    let mut person = robot.person();
    person.until_all(DriveState::Walk);
    assert_eq!(person.status().state, StopState::Released);

    // when: the stop is pressed at the knee
    let mut button = robot.endpoint(&robot.topology.joints[Joint::Knee.index()]);
    let report = button.press_stop(REASON, WITHIN).expect("the knee answers");

    // then
    assert!(report.is_confirmed() && report.nodes.len() == 4, "{report:?}");
    let outputs: u32 = report.nodes.iter().map(|node| node.outputs).sum();
    assert!(outputs >= 3, "a guarded output at each joint: {report:?}");
    person.until_all(DriveState::EStop);
    person.nothing_moves("while it is stopped");

    // and: neither a reset nor an application of another node ends it
    let reset = person.order(&drive_name(Joint::Knee), &Reset {});
    assert!(matches!(reset, Some(Outcome::Rejected(_))), "{reset:?}");
    let order = ReleaseStop { within_ms: 10 };
    let asked = button.message(person.stop(), &order).ask::<StopReport>(WITHIN).expect("central answers");
    assert!(asked.refused.is_some() && asked.state == StopState::Stopped, "{asked:?}");

    // when: all nodes are killed, and start anew
    wait_until_kept(&folder);
    drop((person, button));
    robot.restart_nodes();

    // then: they come up stopped
    let mut person = robot.person();
    assert_eq!(person.status().state, StopState::Stopped);
    person.until_all(DriveState::EStop);
    person.nothing_moves("after the restart");

    // when: the stop is released
    person.release();

    // then
    person.nothing_moves("after the release");
    person.walk_again();
    drop(person);
    robot.end();
    let _ = std::fs::remove_dir_all(&folder);
}

/// The times of one node over all presses.
#[derive(Default)]
struct Times {
    /// From the press until its confirmation was at the node of the press: then its output was safe.
    confirmed: Figures,
    /// From its own knowledge of the press until its outputs were safe.
    safe: Figures,
}

#[test]
#[ignore = "it walks as many times as SINEW_STOP_PRESSES says, some seconds each"]
fn each_press_on_the_walking_robot_is_confirmed() {
    let wanted = std::env::var(PRESSES_WANTED).ok();
    let presses = wanted.map_or(PRESSES, |wanted| wanted.parse().expect("a number of presses"));
    let _alone = alone();
    let folder = folder("presses");
    let robot = Robot::start(&folder);
    let mut person = robot.person();
    let mut nodes: BTreeMap<String, Times> = BTreeMap::new();
    person.until_all(DriveState::Walk);
    for number in 0..presses {
        person.watch(number * 37 % STRIDE_STATUSES);
        // when
        let mut button = robot.endpoint(robot.place(number));
        let report = button.press_stop(REASON, WITHIN).expect("its node answers");
        // then
        assert!(report.is_confirmed() && report.nodes.len() == NODES.len(), "press {number}: {report:?}");
        for node in report.nodes {
            let times = nodes.entry(node.name).or_default();
            let recorded = [(&mut times.confirmed, node.confirmed_us), (&mut times.safe, node.safe_us)];
            for (figures, micros) in recorded {
                figures.record(Duration::from_micros(micros.expect("it has confirmed")));
            }
        }
        person.until_all(DriveState::EStop);
        person.release();
        person.nothing_moves("after the release");
        person.walk_again();
    }
    drop(person);
    robot.end();
    let _ = std::fs::remove_dir_all(&folder);
    head();
    for (case, Times { confirmed, safe }) in &nodes {
        for (figure, seen) in [("press to confirmation", confirmed), ("own knowledge to safe outputs", safe)]
        {
            Alone { bench: "stop_of_the_robot", case, figure, seen, counts: &[] }.report();
        }
    }
}
