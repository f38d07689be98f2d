//! A robot under test: started, released, walked until it has converged, and watched while faults are injected.

use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::time::Duration;
use std::{fs, io};

use exoskeleton::robot::launch::children::Children;
use exoskeleton::robot::launch::console::{Console, View};
use exoskeleton::robot::launch::{BARRIER_PATIENCE, LINES_MAX};
use exoskeleton::robot::role::Role;
use exoskeleton::robot::topology::Topology;
use exoskeleton::run_folder;
use exoskeleton_model::joint::Joint;
use exoskeleton_model::message::{DriveState, GaitMode};
use exoskeleton_model::part::Part;
use exoskeleton_recording::flight::{FlightFolders, Frozen};
use rustix::process::Pid;
use sinew::Time;
use sinew_testkit::{Carried, Weather};

use crate::campaign::{FaultError, print_line};
use crate::hosts::{Hosts, Link};
use crate::operator::Operator;

/// Time between two checks of the statuses.
const LOOK_PERIOD: Duration = Duration::from_millis(5);
/// From the release to assistance: usually four strides, more when the phase is hard to find or the CPUs are
/// busy.
const WALK_PATIENCE: Duration = Duration::from_secs(120);
/// Time that the leg may be held before the operator acts.
const HELD_PATIENCE: Duration = Duration::from_secs(1);
/// Maximum number of strides to wait until all drives assist at a phase.
const TRIES_MAX: u32 = 10;
/// Strides with full assistance before the first fault.
const STRIDES_CONVERGED: u32 = 3;
/// Time in which assistance has risen to full.
const RAMP: Duration = Duration::from_millis(600);

/// A running robot.
pub(crate) struct Robot {
    children: Children,
    /// `None`: the nodes have no flight recorder. Behind the processes, which end first.
    flight: Option<FlightFolders>,
    /// `None`: all processes run on this host. Behind the processes, which end first.
    hosts: Option<Hosts>,
    line_sender: SyncSender<String>,
    lines: Receiver<String>,
    console: Console,
    operator: Option<Operator>,
    socket: PathBuf,
    stride: Option<Stride>,
}

/// The current stride.
#[derive(Debug, Clone, Copy)]
struct Stride {
    number: u32,
    began: Time,
    /// Length of the stride before.
    lasts: Option<Duration>,
}

impl Robot {
    /// Starts all five processes at once; without hosts of their own all on this one. `flight` is the flight recorder
    /// in the topology.
    pub(crate) fn start(
        topology: &Topology,
        (hosts, flight): (Option<Hosts>, Option<FlightFolders>),
        folder: &Path,
    ) -> Result<Self, FaultError> {
        let file = folder.join("topology.toml");
        run_folder::write_text(&file, &topology.to_toml())?;
        let (line_sender, lines) = sync_channel(LINES_MAX);
        let socket = topology.central.socket.clone().expect("a topology for this host has sockets");
        let mut robot = Self {
            children: Children::new(topology, file, folder.to_owned())?,
            flight,
            hosts,
            line_sender,
            lines,
            console: Console::start(topology)?,
            operator: None,
            socket,
            stride: None,
        };
        for role in Role::ALL {
            robot.start_role(role)?;
        }
        Ok(robot)
    }

    /// Starts a process that is not running.
    pub(crate) fn start_role(&mut self, role: Role) -> Result<Time, FaultError> {
        let at = Time::now();
        let hosts = self.hosts.as_ref();
        self.children.start(role, &self.line_sender, |command| match hosts {
            Some(hosts) => hosts.spawn(role, command),
            None => command.spawn(),
        })?;
        Ok(at)
    }

    /// Kills a process as a power cut would; returns the time.
    pub(crate) fn kill(&mut self, role: Role) -> Time {
        if role == Role::Node(Part::Central) {
            self.operator = None;
        }
        self.children.kill(role)
    }

    /// Cuts the link of a joint's node to the others, or reconnects it; returns the time.
    pub(crate) fn set_link(&mut self, joint: Joint, link: Link) -> Result<Time, FaultError> {
        let Some(hosts) = &mut self.hosts else {
            return Err(
                io::Error::other("all processes share this host: there is no link between them").into()
            );
        };
        let at = Time::now();
        hosts.set(Role::Node(Part::Joint(joint)), link)?;
        Ok(at)
    }

    /// Applies this weather to the traffic between the nodes; returns the time, and the counts of the weather
    /// before.
    pub(crate) fn set_weather(&self, weather: Weather) -> Result<(Time, Carried), FaultError> {
        let Some(hosts) = &self.hosts else {
            return Err(
                io::Error::other("all processes share this host: there is no network between them").into()
            );
        };
        let at = Time::now();
        Ok((at, hosts.set_weather(weather)?))
    }

    /// The process of a joint's drive, a child of its node.
    pub(crate) fn drive_process(&self, joint: Joint) -> Result<Pid, FaultError> {
        let node = self.children.process_id(Role::Node(Part::Joint(joint)));
        node.and_then(child_of).ok_or(FaultError::NoProcess(joint))
    }

    /// Returns the operator, connected to central.
    pub(crate) fn operator(&mut self) -> Result<&mut Operator, FaultError> {
        if self.operator.is_none() {
            self.operator = Some(Operator::connect(&self.socket)?);
        }
        Ok(self.operator.as_mut().expect("it was just made"))
    }

    /// Returns the newest statuses.
    pub(crate) fn view(&self) -> View {
        self.console.view()
    }

    /// Waits for the barrier: all parts are ready and the leg is held with zero torque.
    pub(crate) fn wait_held(&mut self) -> Result<Time, FaultError> {
        self.wait_until("all parts are there and the leg is held", BARRIER_PATIENCE, is_held)
    }

    /// Presses "walk" as the operator, until it is accepted; returns the time.
    pub(crate) fn release(&mut self) -> Result<Time, FaultError> {
        let outcome = self.operator()?.release()?;
        if outcome != sinew::Outcome::Delivered {
            return Err(FaultError::NotReleased(outcome));
        }
        Ok(Time::now())
    }

    /// Waits until all drives assist, fully, and some strides more; returns the time at which they began to.
    pub(crate) fn wait_converged(&mut self) -> Result<Time, FaultError> {
        let began = self.wait_walking()?;
        self.pass_until(Time::now() + RAMP)?;
        self.wait_strides(STRIDES_CONVERGED)?;
        self.wait_walking()?;
        Ok(began)
    }

    /// Waits until all drives assist. On a host that stands still for longer than central may coast, walking
    /// has to be released again, and the operator does so.
    pub(crate) fn wait_walking(&mut self) -> Result<Time, FaultError> {
        let deadline = Time::now() + WALK_PATIENCE;
        let mut held_since = None;
        loop {
            self.pass(LOOK_PERIOD)?;
            let now = Time::now();
            let view = self.console.view();
            if is_walking(&view) {
                return Ok(now);
            }
            if !is_held(&view) {
                held_since = None;
            } else if now.since(*held_since.get_or_insert(now)) > HELD_PATIENCE {
                print_line(
                    "  the host stood still for too long and the leg is held; the operator releases anew",
                );
                self.release()?;
                held_since = None;
            }
            if now > deadline {
                return Err(FaultError::Never(
                    format!("all drives assist ({})", states(&view)),
                    WALK_PATIENCE,
                ));
            }
        }
    }

    /// Waits until the person is at `phase` of a stride while all drives assist.
    pub(crate) fn walk_to_phase(&mut self, phase: f64) -> Result<(), FaultError> {
        for _ in 0..TRIES_MAX {
            self.wait_walking()?;
            self.wait_phase(phase)?;
            if is_walking(&self.console.view()) {
                return Ok(());
            }
        }
        Err(FaultError::Never(format!("all drives assist at phase {phase}"), WALK_PATIENCE))
    }

    /// Waits for the start of the `count`-th stride from now on.
    pub(crate) fn wait_strides(&mut self, count: u32) -> Result<(), FaultError> {
        let from = self.stride.map_or(0, |stride| stride.number);
        let deadline = Time::now() + WALK_PATIENCE;
        while self.stride.is_none_or(|stride| stride.number < from + count) {
            self.pass(LOOK_PERIOD)?;
            if Time::now() > deadline {
                return Err(FaultError::Never("the next stride".to_owned(), WALK_PATIENCE));
            }
        }
        Ok(())
    }

    /// Waits until the person is at `phase` of a stride: by the clock, from the start of a stride and the
    /// length of the one before.
    fn wait_phase(&mut self, phase: f64) -> Result<(), FaultError> {
        self.wait_strides(1)?;
        let Some(Stride { began, lasts: Some(lasts), .. }) = self.stride else {
            return Err(FaultError::Never("a whole stride".to_owned(), WALK_PATIENCE));
        };
        self.pass_until(began + lasts.mul_f64(phase))
    }

    /// Waits until `holds` for the newest statuses; returns the time.
    pub(crate) fn wait_until(
        &mut self,
        what: &str,
        patience: Duration,
        mut holds: impl FnMut(&View) -> bool,
    ) -> Result<Time, FaultError> {
        let deadline = Time::now() + patience;
        loop {
            self.pass(LOOK_PERIOD)?;
            let view = self.console.view();
            if holds(&view) {
                return Ok(Time::now());
            }
            if Time::now() > deadline {
                let waiting = view.waiting().join("; ");
                return Err(FaultError::Never(format!("{what} ({waiting})"), patience));
            }
        }
    }

    /// Waits while the strides are counted and the processes watched.
    pub(crate) fn pass_until(&mut self, until: Time) -> Result<(), FaultError> {
        while Time::now() < until {
            self.pass(until.since(Time::now()).min(LOOK_PERIOD))?;
        }
        Ok(())
    }

    fn pass(&mut self, time: Duration) -> Result<(), FaultError> {
        let until = Time::now() + time;
        while let Ok(line) = self.lines.recv_timeout(until.since(Time::now())) {
            self.heed(&line);
        }
        Ok(self.children.check()?)
    }

    /// Handles a line of the plant: a stride begins.
    fn heed(&mut self, line: &str) {
        let number = line.strip_prefix("stride ").and_then(|number| number.parse::<u32>().ok());
        let Some(number) = number else { return };
        let began = Time::now();
        let lasts = self.stride.map(|last| began.since(last.began));
        self.stride = Some(Stride { number, began, lasts });
    }

    /// Stops all processes in order. Returns the spans that the nodes have frozen.
    pub(crate) fn end(mut self) -> Frozen {
        print_line("the robot is stopped");
        self.operator = None;
        self.console.stop();
        self.children.stop();
        self.flight.as_ref().map(FlightFolders::gather).unwrap_or_default()
    }
}

/// A process that this one has started itself.
fn child_of(parent: u32) -> Option<Pid> {
    let ids = fs::read_dir("/proc").ok()?.flatten();
    let mut ids = ids.filter_map(|entry| entry.file_name().to_str()?.parse::<i32>().ok());
    ids.find(|id| parent_of(*id) == Some(parent)).and_then(Pid::from_raw)
}

/// From `/proc/PID/stat`: the fourth field.
fn parent_of(id: i32) -> Option<u32> {
    let text = fs::read_to_string(format!("/proc/{id}/stat")).ok()?;
    text.rsplit_once(')')?.1.split_ascii_whitespace().nth(1)?.parse().ok()
}

fn is_held(view: &View) -> bool {
    let ready = |joint| view.drive(joint).is_some_and(|drive| drive.state == DriveState::Ready);
    view.gait().is_some_and(|gait| gait.mode == Some(GaitMode::Hold)) && Joint::ALL.into_iter().all(ready)
}

/// The visible state of the walk, to explain why not all drives assist.
fn states(view: &View) -> String {
    let state = |joint| match view.drive(joint) {
        Some(drive) => format!("{joint} {:?}", drive.state),
        None => format!("{joint} not heard"),
    };
    let gait = match view.gait().map(|gait| (gait.mode, gait.degraded)) {
        Some((Some(mode), degraded)) => format!("{mode:?}, {degraded:03b} degraded"),
        Some((None, _)) => "not begun".to_owned(),
        None => "not heard".to_owned(),
    };
    format!(
        "at last {}, gait {gait}; if drives change between Walk and Safe and no part is missing, this host may have too \
         little time for a leg at 1 kHz: build with --release, or end what else runs here",
        Joint::ALL.map(state).join(", ")
    )
}

fn is_walking(view: &View) -> bool {
    let walks = |joint| view.drive(joint).is_some_and(|drive| drive.state == DriveState::Walk);
    view.gait().is_some_and(|gait| gait.mode == Some(GaitMode::Walk) && gait.degraded == 0)
        && Joint::ALL.into_iter().all(walks)
}
