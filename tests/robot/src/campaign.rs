//! The robot walks, a fault is injected, and the observations are compared with the claims.
//!
//! `step` lists the faults, `script` injects them and acts as the operator, `judge` reads the traces
//! afterwards and makes `claim`s of them. Nothing is judged while the robot walks, so that nothing disturbs
//! it.

use std::io;
use std::net::IpAddr;
use std::path::{Path, PathBuf};
use std::time::Duration;

use exoskeleton::output;
use exoskeleton::robot::launch::LaunchError;
use exoskeleton::robot::role::Role;
use exoskeleton::robot::topology::{self, DrivePlace, FlightRecorder, ReleaseBy, Topology};
use exoskeleton::run_folder;
use exoskeleton_model::joint::Joint;
use exoskeleton_model::lockstep::LockStepError;
use exoskeleton_model::part::Part;
use exoskeleton_recording::flight::FlightFolders;
use serde::Serialize;
use sinew::{NodeAddress, Outcome, Time};
use thiserror::Error;

use crate::claim::Claim;
use crate::evidence::Evidence;
use crate::hosts::{Hosts, Network};
use crate::operator::OperatorError;
use crate::robot::Robot;
use crate::script::{self, Injection};
use crate::step::Step;
use crate::{contrast, judge, picture};

/// Time for the last rows to reach the disk before a robot is stopped.
const SETTLE: Duration = Duration::from_millis(300);
/// Time between two queries of nodes that have a link to lose. Not less: a busy host answers late.
const LINK_PERIOD: Duration = Duration::from_millis(30);

/// The faults to inject, and their targets.
#[derive(Debug, Clone)]
pub(crate) struct FaultOptions {
    /// The steps, in this order.
    pub(crate) steps: Vec<Step>,
    /// Phases of the stride at which the knee's drive is killed.
    pub(crate) phases: Vec<f64>,
    /// Seed of stride variation and sensor noise.
    pub(crate) seed: u64,
    /// Silence after which a device damps by itself.
    pub(crate) device_watchdog: Duration,
    /// Whether the node's link is also cut, on hosts made of network namespaces; if they cannot be created
    /// the report says so.
    pub(crate) link_down: bool,
    /// Whether the nodes are also connected by a network that loses and delays packets; if it cannot be
    /// created the report says so.
    pub(crate) rough_network: bool,
    /// How the contrast is run; `None`: not at all.
    pub(crate) contrast: Option<ContrastRun>,
    /// Folder for the run folders.
    pub(crate) runs: PathBuf,
}

/// How the contrast is run: the ankle's drive falls silent, with and without a device watchdog.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum ContrastRun {
    /// Two more robots, in real time.
    RealTime,
    /// In virtual time, for shared machines.
    LockStep,
}

/// The results of a run.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct FaultReport {
    /// The seed.
    pub(crate) seed: u64,
    /// Silence after which a device damped by itself, ms.
    pub(crate) device_watchdog_ms: u64,
    /// All claims, step by step.
    pub(crate) claims: Vec<Claim>,
    /// Steps that could not be completed, and the reasons.
    pub(crate) failures: Vec<String>,
    /// Steps that were skipped, and the reasons.
    pub(crate) skipped: Vec<String>,
    /// Whether all claims held that must hold on every machine.
    pub(crate) functional_held: bool,
    /// Whether the limits of class C held, too.
    pub(crate) passed: bool,
    /// The folder with all files.
    pub(crate) folder: PathBuf,
}

/// The reason why a robot did not walk, or did not recover from a fault.
#[derive(Debug, Error)]
pub(crate) enum FaultError {
    /// A file or a port is not available.
    #[error("{0}")]
    System(#[from] io::Error),
    /// A process ended that was not told to.
    #[error(transparent)]
    Launch(#[from] LaunchError),
    /// The run in virtual time failed.
    #[error(transparent)]
    LockStep(#[from] LockStepError),
    /// The operator cannot reach central.
    #[error(transparent)]
    Operator(#[from] OperatorError),
    /// The drive has no process of its own.
    #[error("the drive of the {0} has no process of its own")]
    NoProcess(Joint),
    /// An expected event did not occur.
    #[error("never within {1:?}: {0}")]
    Never(String, Duration),
    /// Walking was not released.
    #[error("the release was not taken: {0:?}")]
    NotReleased(Outcome),
}

/// Injects all faults, one after the other, into one robot, and into a new one after a fault that it did not
/// recover from.
///
/// # Errors
/// No robot walked at all.
pub(crate) fn run(options: &FaultOptions) -> Result<FaultReport, FaultError> {
    let folder = run_folder::create(&options.runs, &format!("faults-seed{}", options.seed))?;
    print_line("software e-stop and simulated leg: not a safety function, no clinical meaning");
    let mut report = FaultReport {
        seed: options.seed,
        device_watchdog_ms: options.device_watchdog.as_millis() as u64,
        claims: Vec::new(),
        failures: Vec::new(),
        skipped: Vec::new(),
        functional_held: false,
        passed: false,
        folder: folder.clone(),
    };
    let mut left = options.steps.as_slice();
    for number in 1.. {
        if left.is_empty() {
            break;
        }
        let folder = folder.join(format!("robot-{number}"));
        std::fs::create_dir(&folder)?;
        let mut topology = topology(options)?;
        // A killed node is to be found in the records of all; the other steps save the time for that.
        let is_recorded = left.contains(&Step::PullNode);
        let flight = is_recorded.then(|| FlightFolders::create(&folder)).transpose()?;
        topology.record = flight.as_ref().map(FlightRecorder::from);
        let robot = Robot::start(&topology, (None, flight), &folder)?;
        left = one_robot(options, robot, &folder, left, &mut report)?;
    }
    if options.link_down {
        on_hosts(options, Network::Cables, &folder, &mut report);
    } else if options.steps.contains(&Step::PullNode) {
        let words = "steps 6 and 7 with a link that is cut: not asked for, see --only link-down";
        report.skipped.push(words.to_owned());
    }
    if options.rough_network {
        on_hosts(options, Network::Radio(options.seed), &folder, &mut report);
    }
    report.claims.sort_by_key(|claim| claim.step.map_or(u8::MAX, u8::from));
    if let Some(how) = options.contrast {
        let contrast = contrast::run(options, how, &folder, &mut report.claims)?;
        std::fs::write(folder.join("faults.svg"), picture::contrast(&contrast))?;
    }
    let held = |functional_only: bool| {
        let mut claims = report.claims.iter();
        report.failures.is_empty()
            && claims.all(|claim| claim.held || functional_only && !claim.expected.is_functional())
    };
    (report.functional_held, report.passed) = (held(true), held(false));
    Ok(report)
}

/// The steps that need a network of their own: a robot with a host for each process.
fn on_hosts(options: &FaultOptions, network: Network, folder: &Path, report: &mut FaultReport) {
    let (what, steps, name) = match network {
        Network::Cables => ("steps 6 and 7 with a link that is cut", &Step::ON_HOSTS[..], "robot-on-hosts"),
        Network::Radio(_) => ("step 10", &Step::ON_RADIO[..], "robot-on-radio"),
    };
    let hosts = match Hosts::new(network) {
        Ok(hosts) => hosts,
        Err(why) => {
            let words = format!("{what}: no hosts can be made here, {why}");
            print_line(&words);
            report.skipped.push(words);
            return;
        }
    };
    let folder = folder.join(name);
    let walked = std::fs::create_dir(&folder).map_err(FaultError::from).and_then(|()| {
        let robot = Robot::start(&topology_on_hosts(options)?, (Some(hosts), None), &folder)?;
        one_robot(options, robot, &folder, steps, report)
    });
    if let Err(error) = walked {
        report.failures.push(format!("{what}: {error}"));
    }
}

/// Walks a robot through the steps until it does not recover from one; returns the remaining steps.
fn one_robot<'a>(
    options: &FaultOptions,
    mut robot: Robot,
    folder: &Path,
    steps: &'a [Step],
    report: &mut FaultReport,
) -> Result<&'a [Step], FaultError> {
    script::walk_until_converged(&mut robot)?;
    let mut injections: Vec<(Injection, Option<String>)> = Vec::new();
    let mut left = steps;
    while let Some((step, later)) = left.split_first() {
        left = later;
        let mut injected = Vec::new();
        let outcome = script::perform(&mut robot, *step, &options.phases, &mut injected);
        let failure = outcome.err().map(|error| error.to_string());
        let last = injected.len().saturating_sub(1);
        injections.extend(
            injected
                .into_iter()
                .enumerate()
                .map(|(i, injection)| (injection, failure.clone().filter(|_| i == last))),
        );
        if let Some(failure) = failure {
            print_line(&format!("  {failure}"));
            report.failures.push(format!("step {step}: {failure}"));
            break;
        }
    }
    robot.pass_until(Time::now() + SETTLE)?;
    let stop = Time::now();
    let frozen = robot.end();
    output::print(&frozen.to_string());
    let evidence = Evidence::read(folder, stop, frozen)?;
    for (injection, failure) in &mut injections {
        if failure.is_some() {
            injection.until = stop;
        }
        judge::judge(&evidence, injection, failure.as_deref(), &mut report.claims);
    }
    Ok(left)
}

pub(crate) fn topology(options: &FaultOptions) -> io::Result<Topology> {
    let mut topology = topology::for_this_host(options.seed)?;
    topology.control.release = ReleaseBy::Operator;
    topology.plant.device_watchdog = Some(options.device_watchdog);
    topology.joints[Joint::Knee.index()].drive = DrivePlace::Process;
    Ok(topology)
}

/// Each process on its host. A node that is cut off is lost after three to four silent periods: these are
/// short.
fn topology_on_hosts(options: &FaultOptions) -> io::Result<Topology> {
    let mut topology = topology(options)?;
    topology.discovery.period = LINK_PERIOD;
    for part in Part::ALL {
        let address = Hosts::address_of(Role::Node(part));
        let place = match part {
            Part::Central => &mut topology.central,
            Part::Joint(joint) => &mut topology.joints[joint.index()],
        };
        (place.address, place.interface) = (NodeAddress::from(address), address.into());
    }
    topology.plant.address.set_ip(IpAddr::V4(Hosts::device_address_of(Role::Plant)));
    Ok(topology)
}

/// Prints a line of progress.
pub(crate) fn print_line(line: &str) {
    output::print(&format!("{line}\n"));
}
