//! The whole robot on this host: five processes in shuffled order, one of them late; then the walk, and its report.

mod blame;
mod children;
mod collect;
mod console;
pub mod faults;
mod hosts;
mod keys;
mod plan;
mod screen;
mod witness;

use std::io;
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::time::Duration;

use sinew::Time;
use thiserror::Error;

use super::node::NodeError;
use super::plant::{self, PlantError};
use super::role::Role;
use super::topology::{self, Control, Topology};
use crate::intention::IntentionError;
use crate::metrics::Metrics;
use crate::output;
use crate::part::Kill;
use crate::report::{Disturbance, Report, RunDescription, RunMode};
use crate::run_folder;
use children::{Children, HostCpu};
use collect::{Collected, RunTimes};
use console::Console;
use plan::Plan;
use screen::Screen;
use witness::Witness;

pub use collect::RealTimeFigures;
pub use keys::KeyFaults;

/// Time between two looks at the CPU times of all processes.
const SAMPLE_PERIOD: Duration = Duration::from_millis(200);
/// Time between two pictures of the status screen.
const LOOK_PERIOD: Duration = Duration::from_millis(100);
/// Time for all to meet and to be released.
const BARRIER_PATIENCE: Duration = Duration::from_secs(60);
/// No stride lasts longer.
const STRIDE_PATIENCE: Duration = Duration::from_secs(4);
/// From the death of a killed node to its next life.
const OUTAGE: Duration = Duration::from_secs(1);
/// Lines of the plant that wait to be read: more than a long run has strides.
const LINES_MAX: usize = 256;
/// Runs of the same kind in one folder.
const RUNS_MAX: u32 = 10_000;

/// What to walk.
#[derive(Debug, Clone)]
pub struct LaunchOptions {
    /// Strides.
    pub strides: u32,
    /// Seed of the start order, of stride variation and of sensor noise.
    pub seed: u64,
    /// A recorded trial to walk; `None`: the built-in curves.
    pub trial: Option<PathBuf>,
    /// A node to kill, and when.
    pub kill: Option<Kill>,
    /// Silence after which a device damps by itself.
    pub device_watchdog: Option<Duration>,
    /// How the control loops run.
    pub control: Control,
    /// Directory of the robot's keys, made for the project [`PROJECT_WITH_KEYS`]; `None`: links between nodes are open.
    pub keys: Option<PathBuf>,
    /// Folder for the run folders.
    pub runs: PathBuf,
}

/// A walk that was walked.
#[derive(Debug, Clone)]
pub struct Walk {
    /// Figures against limits.
    pub report: Report,
    /// What only a real-time run can say.
    pub real_time: RealTimeFigures,
    /// Where it is all written.
    pub folder: PathBuf,
    /// The reason why a part of its record could not be written.
    pub unwritten: Option<String>,
}

/// Why there was no walk.
#[derive(Debug, Error)]
pub enum LaunchError {
    /// A file or a port could not be had.
    #[error("{0}")]
    System(#[from] io::Error),
    /// The trial is not usable.
    #[error(transparent)]
    Trial(#[from] PlantError),
    /// The trial is too short.
    #[error(transparent)]
    Intention(#[from] IntentionError),
    /// A stride is killed that is not walked.
    #[error(
        "--kill {kill} lies beyond the {strides} strides of the run; use an earlier stride or more strides"
    )]
    KillBeyondRun {
        /// The kill asked for.
        kill: Kill,
        /// Strides of the run.
        strides: u32,
    },
    /// A process ended that nobody had told to.
    #[error("{role} ended by itself ({status}); its last words, from {log}:\n{words}")]
    Died {
        /// The process.
        role: Role,
        /// How.
        status: String,
        /// Its log.
        log: String,
        /// The end of its log.
        words: String,
    },
    /// The barrier did not open.
    #[error("nobody walks after {0:?}; these wait:\n{1}")]
    NotReleased(Duration, String),
    /// The strides took too long.
    #[error("only {walked} of {wanted} strides were walked in {within:?}")]
    TooSlow {
        /// Strides walked.
        walked: u32,
        /// Strides wanted.
        wanted: u32,
        /// Time that they had.
        within: Duration,
    },
    /// A trace ends before the walk does.
    #[error(
        "the trace of {role} in {folder} ends {missing_s:.1} s before the walk does, so the walk cannot be judged; is the disk full?"
    )]
    TraceCut {
        /// The process.
        role: Role,
        /// The run folder.
        folder: String,
        /// Missing time, s.
        missing_s: f64,
    },
    /// A process cannot be made ready.
    #[error(transparent)]
    Node(#[from] NodeError),
    /// The robot is to have keys, and those are not its.
    #[error(transparent)]
    Keys(#[from] KeyFaults),
}

/// Starts all five processes, walks, stops them, and reports.
///
/// # Errors
/// It did not walk to the last stride. All processes have ended then.
pub fn run(options: &LaunchOptions) -> Result<Walk, LaunchError> {
    if let Some(kill) = options.kill.filter(|kill| kill.stride > options.strides) {
        return Err(LaunchError::KillBeyondRun { kill, strides: options.strides });
    }
    let topology = topology(options)?;
    if let Some(directory) = &options.keys {
        keys::check(&topology, directory)?;
    }
    let intention = plant::intention(&topology.plant)?;
    intention.notes().iter().for_each(|note| output::print(&format!("--trial: {note}\n")));
    intention.check_strides(options.strides)?;
    let folder = new_folder(&options.runs, &folder_name(options))?;
    let mut launch = Launch::new(options, &topology, &folder)?;
    let walked = launch.walk();
    let times = launch.end();
    walked?;
    let collected = Collected::read(&folder, &times)?;
    let [mut all, mut undisturbed] =
        [Metrics::of(&collected.record), Metrics::without_stalls(&collected.record)];
    // The rows are the plant's milliseconds; the limiter's rate shows in the drive's own time only.
    for metrics in [&mut all, &mut undisturbed] {
        metrics.torque_rate_max_nm_s = collected.torque_rate_max_nm_s;
    }
    let disturbance = Disturbance::of(&collected.record, &all, &undisturbed);
    let timing = Some(&collected.timing);
    let report = Report::of_disturbed(&description(options), &all, timing, &disturbance);
    let written = run_folder::write(&folder, &report, &collected.record, Some(&collected.lateness));
    let unwritten = written.err().map(|error| error.to_string());
    Ok(Walk { report, real_time: collected.figures, folder, unwritten })
}

/// The project of a robot with keys: they say whose they are. Its multicast group keeps each run apart.
pub const PROJECT_WITH_KEYS: &str = "exoskeleton";

fn topology(options: &LaunchOptions) -> Result<Topology, LaunchError> {
    let mut topology = topology::for_this_host(options.seed)?;
    topology.control = options.control;
    topology.plant.device_watchdog = options.device_watchdog;
    if let Some(keys) = &options.keys {
        PROJECT_WITH_KEYS.clone_into(&mut topology.project);
        topology.keys = Some(std::path::absolute(keys)?);
    }
    topology.plant.trial = match &options.trial {
        Some(path) => Some(std::path::absolute(path)?),
        None => None,
    };
    Ok(topology)
}

fn description(options: &LaunchOptions) -> RunDescription {
    let file_name = |path: &PathBuf| {
        path.file_name()
            .map_or_else(|| path.display().to_string(), |name| name.to_string_lossy().into_owned())
    };
    RunDescription {
        mode: RunMode::RealTime,
        strides: options.strides,
        seed: options.seed,
        trial: options.trial.as_ref().map(file_name),
        kill: options.kill.map(|kill| kill.to_string()),
    }
}

fn folder_name(options: &LaunchOptions) -> String {
    let source = if options.trial.is_some() { "trial" } else { "curves" };
    let kill =
        options.kill.map_or_else(String::new, |kill| format!("-kill-{}-at-{}", kill.part, kill.stride));
    format!("real-time-{source}-seed{}-{}strides{kill}", options.seed, options.strides)
}

/// A folder that no other run has: a real-time run is never the same twice.
fn new_folder(runs: &Path, name: &str) -> io::Result<PathBuf> {
    let at = |path: &Path, error: &io::Error| {
        io::Error::new(error.kind(), format!("cannot make {}: {error}", path.display()))
    };
    std::fs::create_dir_all(runs).map_err(|e| at(runs, &e))?;
    for number in 1..=RUNS_MAX {
        let folder = runs.join(format!("{name}-{number}"));
        match std::fs::create_dir(&folder) {
            Ok(()) => return std::path::absolute(folder),
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {}
            Err(error) => return Err(at(&folder, &error)),
        }
    }
    Err(io::Error::other(format!("{} holds {RUNS_MAX} runs of this kind; remove some", runs.display())))
}

/// A run under way.
struct Launch<'a> {
    options: &'a LaunchOptions,
    plan: Plan,
    children: Children,
    lines: Receiver<String>,
    say_line: SyncSender<String>,
    console: Console,
    screen: Screen,
    times: RunTimes,
    strides: Option<u32>,
    witness: Witness,
}

impl<'a> Launch<'a> {
    fn new(options: &'a LaunchOptions, topology: &Topology, folder: &Path) -> Result<Self, LaunchError> {
        let file = folder.join("topology.toml");
        std::fs::write(&file, topology.to_toml()).map_err(|error| {
            io::Error::new(error.kind(), format!("cannot write {}: {error}", file.display()))
        })?;
        let (say_line, lines) = sync_channel(LINES_MAX);
        let now = Time::now();
        Ok(Self {
            options,
            plan: Plan::shuffled(options.seed, now),
            children: Children::new(topology, file, folder.to_owned(), None)?,
            lines,
            say_line,
            console: Console::start(topology)?,
            screen: Screen::new(options.strides, now),
            times: RunTimes { strides: options.strides, ..RunTimes::default() },
            strides: None,
            witness: Witness::start(options.control.realtime_priority)?,
        })
    }

    /// Until the last stride.
    fn walk(&mut self) -> Result<(), LaunchError> {
        let mut deadline = Time::now() + BARRIER_PATIENCE;
        self.screen.say(&self.plan.words());
        loop {
            let now = Time::now();
            self.start_due(now)?;
            self.sample(now);
            self.children.check()?;
            let pause = self.plan.next_due().map_or(LOOK_PERIOD, |due| due.since(now).min(LOOK_PERIOD));
            match self.lines.recv_timeout(pause) {
                Ok(line) => {
                    let has_begun = self.strides.is_none();
                    self.heed(&line);
                    if has_begun && self.strides.is_some() {
                        deadline = Time::now() + STRIDE_PATIENCE * self.options.strides;
                    }
                }
                Err(RecvTimeoutError::Timeout) => {}
                // Not while this holds a sender itself.
                Err(RecvTimeoutError::Disconnected) => {}
            }
            if self.strides.is_some_and(|strides| strides >= self.options.strides) {
                return Ok(());
            }
            self.screen.show(&self.console.view(), self.strides);
            if Time::now() > deadline {
                return Err(self.too_late());
            }
        }
    }

    /// Notes the CPU times of all processes, if it is time.
    fn sample(&mut self, now: Time) {
        let samples = &mut self.times.samples;
        if samples.last().is_none_or(|(at, _)| now.since(*at) >= SAMPLE_PERIOD) {
            samples.push(self.children.cpu_times());
        }
    }

    fn start_due(&mut self, now: Time) -> Result<(), LaunchError> {
        while let Some(role) = self.plan.take_due(now) {
            self.children.start(role, &self.say_line)?;
            let started = Time::now();
            if let Role::Node(_) = role {
                self.times.first_start.get_or_insert(started);
            }
            if let Some(outage) = self.times.outage.as_mut().filter(|outage| Role::Node(outage.part) == role)
            {
                outage.to = Some(started);
                self.screen.say(&format!("{role} is started again"));
            }
        }
        Ok(())
    }

    /// A line of the plant's.
    fn heed(&mut self, line: &str) {
        let Some(stride) = line.strip_prefix("stride ").and_then(|number| number.parse::<u32>().ok()) else {
            return;
        };
        if self.strides.is_none() {
            self.times.cpu_from = Some(self.children.cpu_times());
            self.times.host_from = HostCpu::now();
        }
        self.strides = Some(stride);
        let Some(kill) = self.options.kill.filter(|_| self.times.outage.is_none()) else { return };
        if stride + 1 >= kill.stride {
            let role = Role::Node(kill.part);
            let killed = self.children.kill(role);
            self.times.outage = Some(collect::KillTimes { part: kill.part, from: killed, to: None });
            self.plan.add(role, killed + OUTAGE);
            self.screen.say(&format!("{role} is killed as stride {} begins", kill.stride));
        }
    }

    fn too_late(&self) -> LaunchError {
        match self.strides {
            None => LaunchError::NotReleased(BARRIER_PATIENCE, self.console.view().waiting().join("\n")),
            Some(walked) => LaunchError::TooSlow {
                walked,
                wanted: self.options.strides,
                within: STRIDE_PATIENCE * self.options.strides,
            },
        }
    }

    /// Stops everybody, the plant last: it is to see how the drives let go.
    fn end(mut self) -> RunTimes {
        self.times.stop = Time::now();
        self.times.cpu_to = Some(self.children.cpu_times());
        self.times.samples.extend(self.times.cpu_to.clone());
        self.times.host_to = HostCpu::now();
        self.times.testimonies = self.witness.end();
        self.screen.close();
        self.console.stop();
        self.children.stop();
        self.times
    }
}
