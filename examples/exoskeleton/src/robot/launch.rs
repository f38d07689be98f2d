//! The whole robot on this host: five processes in shuffled order, one of them late; then the walk, and its
//! report.

pub mod children;
mod collect;
pub mod console;
mod keys;
mod plan;
mod screen;

use std::io;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::time::Duration;

use exoskeleton_model::intention::IntentionError;
use exoskeleton_model::part::{Kill, Part};
use exoskeleton_model::record::Record;
use exoskeleton_recording::flight::{FlightFolders, Frozen};
use exoskeleton_recording::plot::Lateness;
use exoskeleton_recording::recorder::{Recorded, WalkRecorder};
use sinew::Time;
use sinew_figures::stalls::{HostCpu, Witness};
use thiserror::Error;

use super::edges;
use super::node::NodeError;
use super::plant::{self, PlantError};
use super::role::Role;
use super::topology::{self, Control, FlightRecorder, Topology};
use crate::output;
use crate::report::{Report, RunDescription};
use crate::run_folder;
use children::Children;
use collect::RunTimes;
use console::Console;
use plan::Plan;
use screen::Screen;

pub use collect::Traces;
pub use keys::KeysError;

/// Time between two readings of the CPU times of all processes.
const SAMPLE_PERIOD: Duration = Duration::from_millis(200);
/// Time between two pictures of the status screen.
const LOOK_PERIOD: Duration = Duration::from_millis(100);
/// Time for all parts to be ready and released.
pub const BARRIER_PATIENCE: Duration = Duration::from_secs(60);
/// Maximum length of a stride.
const STRIDE_PATIENCE: Duration = Duration::from_secs(4);
/// From the death of a killed node to its restart.
const OUTAGE: Duration = Duration::from_secs(1);
/// Capacity for unread lines of the plant: more than the strides of a long run.
pub const LINES_MAX: usize = 256;

/// Options of a walk.
#[derive(Debug, Clone)]
pub struct LaunchOptions {
    /// The run. Its seed is that of the start order, of stride variation and of sensor noise.
    pub run: RunDescription,
    /// A recorded trial to walk; `None`: the built-in curves.
    pub trial: Option<PathBuf>,
    /// A node to kill, and the time.
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

/// The results of a walk.
#[derive(Debug)]
pub struct Walk {
    /// Figures against limits.
    pub report: Report,
    /// The record, in which the report was judged.
    pub record: Record,
    /// Lateness of the drives' ticks.
    pub lateness: Lateness,
    /// The folder with the traces and logs.
    pub folder: PathBuf,
    /// The recording of all messages; `None`: it was not requested.
    pub recorded: Option<Recorded>,
    /// The messages around faults, as all nodes have frozen them; `None`: it was not requested.
    pub frozen: Option<Frozen>,
}

/// The reason why there was no walk.
#[derive(Debug, Error)]
pub enum LaunchError {
    /// A file or a port is not available.
    #[error("{0}")]
    System(#[from] io::Error),
    /// The trial is not usable.
    #[error(transparent)]
    Trial(#[from] PlantError),
    /// The trial is too short.
    #[error(transparent)]
    Intention(#[from] IntentionError),
    /// A process ended that was not ordered to.
    #[error("{role} ended by itself ({status}); its last lines, from {log}:\n{lines}")]
    Died {
        /// The process.
        role: Role,
        /// Its exit status.
        status: String,
        /// Its log.
        log: String,
        /// The end of its log.
        lines: String,
    },
    /// The barrier did not open.
    #[error("the robot does not walk after {0:?}; these wait:\n{1}")]
    NotReleased(Duration, String),
    /// The strides took too long.
    #[error("only {walked} of {wanted} strides were walked in {within:?}")]
    TooSlow {
        /// Strides walked.
        walked: u32,
        /// Strides requested.
        wanted: u32,
        /// Time limit for them.
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
    /// A process cannot be prepared.
    #[error(transparent)]
    Node(#[from] NodeError),
    /// Keys were requested, and those given are not the robot's.
    #[error(transparent)]
    Keys(#[from] KeysError),
}

/// Starts all five processes, walks, stops them, and reports.
///
/// # Errors
/// The robot did not walk to the last stride. All processes have ended then.
pub fn run(options: &LaunchOptions) -> Result<Walk, LaunchError> {
    let strides = options.run.strides;
    let mut topology = topology(options)?;
    if let Some(directory) = &options.keys {
        keys::check(&topology, directory)?;
    }
    let intention = plant::intention(topology.plant.trial.as_deref(), topology.plant.seed)?;
    intention.notes().iter().for_each(|note| output::print(&format!("--trial: {note}\n")));
    intention.check_strides(strides)?;
    let folder = run_folder::create(&options.runs, &run_folder::name(&options.run))?;
    let flight = options.control.record.then(|| FlightFolders::create(&folder)).transpose()?;
    topology.record = flight.as_ref().map(FlightRecorder::from);
    let mut launch = Launch::new(options, &topology, &folder)?;
    let walked = launch.walk();
    let (times, recorded) = launch.end();
    let frozen = flight.map(|folders| folders.gather());
    if let (Err(_), Some(frozen)) = (&walked, &frozen) {
        // They may show why it did not walk.
        output::print(&frozen.to_string());
    }
    walked?;
    let (report, record, lateness) = collect::read(&folder, &times, options.run.clone())?;
    Ok(Walk { report, record, lateness, folder, recorded, frozen })
}

/// The project of a robot with keys, which name it. Its multicast group separates the runs.
pub const PROJECT_WITH_KEYS: &str = "exoskeleton";

fn topology(options: &LaunchOptions) -> Result<Topology, LaunchError> {
    let mut topology = topology::for_this_host(options.run.seed)?;
    topology.control = options.control;
    topology.plant.device_watchdog = options.device_watchdog;
    if let Some(keys) = &options.keys {
        PROJECT_WITH_KEYS.clone_into(&mut topology.project);
        topology.keys = Some(std::path::absolute(keys)?);
    }
    topology.plant.trial = options.trial.as_deref().map(std::path::absolute).transpose()?;
    Ok(topology)
}

/// A run in progress.
struct Launch<'a> {
    options: &'a LaunchOptions,
    plan: Plan,
    children: Children,
    lines: Receiver<String>,
    line_sender: SyncSender<String>,
    console: Console,
    screen: Screen,
    times: RunTimes,
    strides: Option<u32>,
    witness: Witness,
    recorder: Option<WalkRecorder>,
}

impl<'a> Launch<'a> {
    fn new(options: &'a LaunchOptions, topology: &Topology, folder: &Path) -> Result<Self, LaunchError> {
        let file = folder.join("topology.toml");
        run_folder::write_text(&file, &topology.to_toml())?;
        let (line_sender, lines) = sync_channel(LINES_MAX);
        let now = Time::now();
        Ok(Self {
            options,
            plan: Plan::shuffled(options.run.seed, now),
            children: Children::new(topology, file, folder.to_owned())?,
            lines,
            line_sender,
            console: Console::start(topology)?,
            screen: Screen::new(options.run.strides, now),
            times: RunTimes { strides: options.run.strides, ..RunTimes::default() },
            strides: None,
            witness: Witness::start(options.control.realtime_priority)?,
            recorder: options.control.record.then(|| record(topology, folder)).transpose()?,
        })
    }

    /// Walks until the last stride.
    fn walk(&mut self) -> Result<(), LaunchError> {
        let mut deadline = Time::now() + BARRIER_PATIENCE;
        self.screen.print(&self.plan.description());
        loop {
            let now = Time::now();
            self.start_due(now)?;
            self.sample(now);
            self.children.check()?;
            let pause = self.plan.next_due().map_or(LOOK_PERIOD, |due| due.since(now).min(LOOK_PERIOD));
            // An error is a timeout: the channel is open while this holds a sender itself.
            if let Ok(line) = self.lines.recv_timeout(pause) {
                let has_begun = self.strides.is_none();
                self.heed(&line);
                if has_begun && self.strides.is_some() {
                    deadline = Time::now() + STRIDE_PATIENCE * self.options.run.strides;
                }
            }
            if self.strides >= Some(self.options.run.strides) {
                return Ok(());
            }
            self.screen.show(&self.console.view(), self.strides);
            if Time::now() > deadline {
                return Err(self.too_late());
            }
        }
    }

    /// Records the CPU times of all processes when they are due.
    fn sample(&mut self, now: Time) {
        let samples = &mut self.times.samples;
        if samples.last().is_none_or(|(at_ns, _)| now.since(Time::from_nanos(*at_ns)) >= SAMPLE_PERIOD) {
            samples.push(self.children.cpu_times());
        }
    }

    fn start_due(&mut self, now: Time) -> Result<(), LaunchError> {
        while let Some(role) = self.plan.take_due(now) {
            self.children.start(role, &self.line_sender, Command::spawn)?;
            let started = Time::now();
            if let Role::Node(_) = role {
                self.times.first_start.get_or_insert(started);
            }
            if let Some(outage) = self.times.outage.as_mut().filter(|outage| Role::Node(outage.part) == role)
            {
                outage.to = Some(started);
                self.screen.print(&format!("{role} is started again"));
            }
        }
        Ok(())
    }

    /// Handles a line of the plant.
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
            self.screen.print(&format!("{role} is killed as stride {} begins", kill.stride));
        }
    }

    fn too_late(&self) -> LaunchError {
        match self.strides {
            None => LaunchError::NotReleased(BARRIER_PATIENCE, self.console.view().waiting().join("\n")),
            Some(walked) => LaunchError::TooSlow {
                walked,
                wanted: self.options.run.strides,
                within: STRIDE_PATIENCE * self.options.run.strides,
            },
        }
    }

    /// Stops all processes, the plant last: it records the drives' ramps to zero. Then completes the recording.
    fn end(mut self) -> (RunTimes, Option<Recorded>) {
        self.times.stop = Time::now();
        self.times.cpu_to = Some(self.children.cpu_times());
        self.times.samples.extend(self.times.cpu_to.clone());
        self.times.host_to = HostCpu::now();
        self.times.testimonies = self.witness.end();
        self.screen.close();
        self.console.stop();
        self.recorder.iter().for_each(WalkRecorder::close);
        self.children.stop();
        (self.times, self.recorder.map(WalkRecorder::finish))
    }
}

/// Starts the recorders of all nodes, before these start.
fn record(topology: &Topology, folder: &Path) -> io::Result<WalkRecorder> {
    let socket = |part: Part| Some((part.name().to_owned(), topology.place(part).socket.clone()?));
    let nodes: Vec<_> = Part::ALL.into_iter().filter_map(socket).collect();
    WalkRecorder::start(&nodes, edges::names(), folder)
}
