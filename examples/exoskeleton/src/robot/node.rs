//! One process of the robot, alone: `exoskeleton node ROLE --topology FILE`.

use std::fs::DirBuilder;
use std::io::{self, Read};
use std::os::unix::fs::DirBuilderExt as _;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::sync::{Arc, OnceLock};
use std::time::SystemTime;

use exoskeleton_model::central::Resume;
use exoskeleton_model::joint::Joint;
use exoskeleton_model::part::Part;
use exoskeleton_recording::flight::remove_own_journal;
use sinew::address::Incarnation;
use sinew::config::RecordConfig;
use sinew::prelude::*;
use sinew::signals::StopSignals;
use thiserror::Error;

use super::device::{JointDevice, UdpDevice};
use super::drive::{Burden, DriveParts};
use super::gait::GaitParts;
use super::plant::{self, PlantError};
use super::role::Role;
use super::sensor::DeviceMaker;
use super::topology::{ControlThread, DrivePlace, ReleaseBy, Topology, TopologyError};
use super::trace::{EventRow, Recording, TraceRow};
use super::watch::WatchParts;
use super::{coordinator, drive, gait, sensor, slots, watch};

/// Maximum tries to create a folder. At most the other nodes of the robot end meanwhile, each once.
const FOLDER_TRIES: usize = 8;

/// The command line of a process.
#[derive(Debug, Clone, clap::Args)]
pub struct NodeOptions {
    /// central, hip, knee, ankle or plant.
    pub role: Role,
    /// Which node of the robot is where; see `examples/exoskeleton/topology.toml`.
    #[arg(long, value_name = "FILE")]
    pub topology: PathBuf,
    /// Folder for its traces; without it there are none.
    #[arg(long, value_name = "DIR")]
    pub run_dir: Option<PathBuf>,
    /// Stop when the standard input ends: for a program that starts this one.
    #[arg(long)]
    pub stop_with_stdin: bool,
}

/// The reason why a process of the robot does not run.
#[derive(Debug, Error)]
pub enum NodeError {
    /// The topology is invalid.
    #[error("{path}: {faults}")]
    Topology {
        /// The file.
        path: String,
        /// Its faults.
        faults: TopologyError,
    },
    /// A trace cannot be started.
    #[error("no trace can be written: {0}")]
    Trace(io::Error),
    /// A folder of the flight recorder cannot be created.
    #[error(
        "the folder {path} of the flight recorder cannot be created: {cause}; name another one in [record] of the topology"
    )]
    Folder {
        /// The folder.
        path: String,
        /// The cause.
        cause: io::Error,
    },
    /// The node does not start.
    #[error(transparent)]
    Start(#[from] StartError),
    /// The plant does not start, or ended early.
    #[error(transparent)]
    Plant(#[from] PlantError),
    /// The system provides no thread.
    #[error("no thread: {0}; raise `ulimit -u`")]
    Thread(io::Error),
}

/// Runs a process of the robot until SIGINT, SIGTERM or SIGHUP. It logs to standard error.
///
/// # Errors
/// It did not start, or the plant ended early.
pub fn run(options: &NodeOptions) -> Result<ExitCode, NodeError> {
    log_to_stderr();
    let topology = Topology::read(&options.topology)
        .map_err(|faults| NodeError::Topology { path: options.topology.display().to_string(), faults })?;
    match options.role {
        Role::Node(part) => run_node(part, &topology, options),
        Role::Plant => {
            let stop = Arc::new(AtomicBool::new(false));
            stop_on_signals(stop.clone())?;
            if options.stop_with_stdin {
                let stop = stop.clone();
                // SYNC: Relaxed, no other data depends on the flag.
                when_stdin_ends(move || stop.store(true, Ordering::Relaxed))?;
            }
            plant::run(&topology.plant, options.run_dir.as_deref(), &stop)?;
            Ok(ExitCode::SUCCESS)
        }
    }
}

/// `RUST_LOG` sets the log filter; without it everything from `info` on.
fn log_to_stderr() {
    let filter = tracing_subscriber::EnvFilter::try_from_default_env()
        .unwrap_or_else(|_| tracing_subscriber::EnvFilter::new("info"));
    let log = tracing_subscriber::fmt().with_env_filter(filter).with_writer(io::stderr).with_ansi(false);
    // It would report a failing standard error on standard error, and panic.
    log.log_internal_errors(false).init();
}

/// Runs a node with all that its part of the robot needs.
fn run_node(part: Part, topology: &Topology, options: &NodeOptions) -> Result<ExitCode, NodeError> {
    let incarnation = incarnation();
    let events = record::<EventRow>(options, &format!("{part}-events"))?;
    let watched = Arc::new(OnceLock::new());
    let watch = watch::spec(part, WatchParts { node: watched.clone(), events: events.trace() });
    let config = topology.node_config(part);
    let record_config = config.record.clone();
    create_folders(&record_config)?;
    let builder = Node::builder(part.name()).config(config).incarnation(incarnation).app(watch);
    let (builder, finish_trace): (NodeBuilder, Box<dyn FnOnce() -> u64>) = match part {
        Part::Central => {
            let trace = record(options, part.name())?;
            let epoch = Arc::new(AtomicU32::new((incarnation.0 / 1_000_000) as u32));
            let joints = topology.joints.each_ref().map(|place| place.address);
            let release = topology.control.release;
            let resume = match release {
                ReleaseBy::Itself => Resume::ByItself,
                ReleaseBy::Operator => Resume::ByOperator,
            };
            let (trace_of, events_of, slot) = (trace.trace(), events.trace(), slots::GAIT);
            let parts = GaitParts { joints, epoch, slot, trace: trace_of, events: events_of, resume };
            let builder = builder.app(gait::spec(parts, place(topology)));
            let builder = match release {
                ReleaseBy::Itself => builder.app(coordinator::spec()),
                ReleaseBy::Operator => builder,
            };
            (builder, Box::new(move || trace.finish()))
        }
        Part::Joint(joint) => {
            let trace = record(options, part.name())?;
            let device = device_maker(joint, topology);
            let parts = DriveParts {
                joint,
                device: device.clone(),
                slot: slots::DRIVE,
                trace: trace.trace(),
                events: events.trace(),
                figures: options.run_dir.as_ref().map(|folder| folder.join(format!("{joint}-figures.json"))),
                burden: Burden::planted(joint),
                sends_ticks: topology.control.record,
            };
            let builder = builder
                .app(sensor::spec(joint, device, slots::SENSOR, events.trace(), place(topology)))
                .app(drive::spec(parts, drive_place(joint, topology)));
            (builder, Box::new(move || trace.finish()))
        }
    };
    let node = builder.start()?;
    let handle = node.handle();
    // Nothing else sets it.
    let _ = watched.set(handle.clone());
    if options.stop_with_stdin {
        when_stdin_ends(move || handle.stop())?;
    }
    let code = node.run();
    for lost in [finish_trace(), events.finish()].into_iter().filter(|lost| *lost > 0) {
        tracing::warn!(lost, "rows of a trace were lost: the disk was too slow");
    }
    remove_journal(&record_config);
    Ok(code)
}

/// Creates the folders of the flight recorder, for this user alone.
fn create_folders(config: &RecordConfig) -> Result<(), NodeError> {
    for folder in [&config.folder, &config.frozen_folder].into_iter().flatten() {
        let created = create_again(|| DirBuilder::new().recursive(true).mode(0o700).create(folder));
        created.map_err(|cause| NodeError::Folder { path: folder.display().to_string(), cause })?;
    }
    Ok(())
}

/// Creates a folder and those around it. A node that ends just now may remove the folder around those of all nodes
/// before this one is in it: then both are created again.
fn create_again(mut create: impl FnMut() -> io::Result<()>) -> io::Result<()> {
    for _ in 1..FOLDER_TRIES {
        match create() {
            Err(error) if error.kind() == io::ErrorKind::NotFound => {}
            other => return other,
        }
    }
    create()
}

/// Removes the journal of the flight recorder after the node's end, also where the process that started it was killed.
/// The last node removes the folder around those of all nodes.
fn remove_journal(config: &RecordConfig) {
    let Some(folder) = &config.folder else { return };
    // It stays with the journal of an earlier incarnation that was killed, which is not moved yet.
    if remove_own_journal(folder).is_ok()
        && let Some(all) = folder.parent()
    {
        // It stays with the folders of other nodes.
        let _ = std::fs::remove_dir(all);
    }
}

fn record<R: TraceRow>(options: &NodeOptions, name: &str) -> Result<Recording<R>, NodeError> {
    Recording::begin(options.run_dir.as_deref(), name).map_err(NodeError::Trace)
}

fn place(topology: &Topology) -> Place {
    let control = topology.control;
    let place = match control.thread {
        ControlThread::Io => Place::io(),
        ControlThread::Own => Place::thread("control"),
    };
    control.realtime_priority.into_iter().fold(place, Place::realtime)
}

fn drive_place(joint: Joint, topology: &Topology) -> Place {
    match topology.joints[joint.index()].drive {
        DrivePlace::Node => place(topology),
        DrivePlace::Process => {
            topology.control.realtime_priority.into_iter().fold(Place::process(), Place::realtime)
        }
    }
}

fn device_maker(joint: Joint, topology: &Topology) -> DeviceMaker {
    let plant = topology.plant.address;
    Arc::new(move || -> Box<dyn JointDevice> {
        // The application fails with this text, and its supervisor tries again within its limit.
        let device = UdpDevice::connect(joint, plant).unwrap_or_else(|e| {
            panic!("no way to the {joint} device at {plant}: {e}; is this host's route to it up?")
        });
        Box::new(device)
    })
}

/// Larger than that of any earlier run, as long as the host's clock does not go back.
#[expect(
    clippy::disallowed_methods,
    reason = "read once, at the start: a later incarnation needs a larger number"
)]
fn incarnation() -> Incarnation {
    let since_1970 = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
    Incarnation(u64::try_from(since_1970.as_micros()).unwrap_or(u64::MAX))
}

fn when_stdin_ends(act: impl FnOnce() + Send + 'static) -> Result<(), NodeError> {
    let wait = move || {
        let mut byte = [0];
        // The parent process writes nothing; an error is an end, too.
        while matches!(io::stdin().read(&mut byte), Ok(1)) {}
        act();
    };
    std::thread::Builder::new().name("stdin".to_owned()).spawn(wait).map_err(NodeError::Thread)?;
    Ok(())
}

/// For the plant, which is no node and has no runtime that handles signals.
fn stop_on_signals(stop: Arc<AtomicBool>) -> Result<(), NodeError> {
    let runtime =
        tokio::runtime::Builder::new_current_thread().enable_all().build().map_err(NodeError::Thread)?;
    let wait = move || {
        runtime.block_on(async {
            match StopSignals::listen() {
                Ok(mut signals) => drop(signals.recv().await),
                Err(error) => {
                    tracing::error!(%error, "signals cannot be handled: they will end the plant at once");
                    return;
                }
            }
            // SYNC: Relaxed, no other data depends on the flag.
            stop.store(true, Ordering::Relaxed);
        });
    };
    std::thread::Builder::new().name("signals".to_owned()).spawn(wait).map_err(NodeError::Thread)?;
    Ok(())
}

#[cfg(test)]
#[path = "../../tests/unit/node.rs"]
mod tests;
