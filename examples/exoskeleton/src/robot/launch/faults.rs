//! `exoskeleton faults`: the robot walks, a fault is injected, and what happens is held against what is claimed.
//!
//! `step` says which faults, `script` injects them and does what an operator would, `judge` reads the traces
//! afterwards and makes `claim`s of them. Nothing is judged while the robot walks, so that nothing disturbs it.

mod claim;
mod contrast;
mod evidence;
mod judge;
mod operator;
mod robot;
mod script;
mod step;

use std::io;
use std::net::IpAddr;
use std::path::{Path, PathBuf};
use std::time::Duration;

use serde::Serialize;
use sinew::{NodeAddress, Outcome, Time};
use thiserror::Error;

use super::hosts::{Hosts, Network};
use super::{LaunchError, new_folder};
use crate::joint::Joint;
use crate::lockstep::LockStepError;
use crate::output;
use crate::part::Part;
use crate::plot;
use crate::robot::role::Role;
use crate::robot::topology::{self, DrivePlace, ReleaseBy, Topology};
use evidence::Evidence;
use robot::Robot;
use script::Injection;

pub use claim::{Claim, Expected, table};
pub use operator::OperatorError;
pub use step::Step;

/// Time for the last rows to reach the disk before a robot is stopped.
const SETTLE: Duration = Duration::from_millis(300);
/// Time between two queries of nodes that have a link to lose. Not less: a busy host answers late.
const LINK_PERIOD: Duration = Duration::from_millis(30);

/// Which faults to inject into what.
#[derive(Debug, Clone)]
pub struct FaultOptions {
    /// The steps, in this order.
    pub steps: Vec<Step>,
    /// Phases of the stride at which the knee's drive is killed.
    pub phases: Vec<f64>,
    /// Seed of stride variation and sensor noise.
    pub seed: u64,
    /// Silence after which a device damps by itself.
    pub device_watchdog: Duration,
    /// Whether the node is also pulled by its link, on hosts made of network namespaces; where they cannot be made the
    /// report says so.
    pub link_down: bool,
    /// Whether the nodes are also joined by a network that loses and delays packets; where that cannot be made the report says so.
    pub rough_network: bool,
    /// How the contrast is run; none: not.
    pub contrast: Option<ContrastRun>,
    /// Folder for the run folders.
    pub runs: PathBuf,
}

/// How the contrast is run: the ankle's drive falls silent, with and without a device watchdog.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ContrastRun {
    /// Two robots more, in real time.
    RealTime,
    /// In virtual time, for machines that others share.
    LockStep,
}

/// What came of it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FaultReport {
    /// The seed.
    pub seed: u64,
    /// Silence after which a device damped by itself, ms.
    pub device_watchdog_ms: u64,
    /// All claims, step by step.
    pub claims: Vec<Claim>,
    /// Steps that could not be done to their end, and why.
    pub failures: Vec<String>,
    /// Steps that were left out here, and why.
    pub skipped: Vec<String>,
    /// Whether everything held that has to hold on every machine.
    pub functional_held: bool,
    /// Whether the limits of class C held too.
    pub passed: bool,
    /// Where it is all written.
    pub folder: PathBuf,
}

/// Why a robot did not walk, or did not get over a fault.
#[derive(Debug, Error)]
pub enum FaultError {
    /// A file or a port could not be had.
    #[error("{0}")]
    System(#[from] io::Error),
    /// A process ended that nobody had told to.
    #[error(transparent)]
    Launch(#[from] LaunchError),
    /// The run in virtual time could not be done.
    #[error(transparent)]
    LockStep(#[from] LockStepError),
    /// The operator is not heard.
    #[error(transparent)]
    Operator(#[from] OperatorError),
    /// The drive has no process of its own.
    #[error("the drive of the {0} has no process of its own")]
    NoProcess(Joint),
    /// Something did not happen.
    #[error("never within {1:?}: {0}")]
    Never(String, Duration),
    /// Walking was not released.
    #[error("the release was not taken: {0:?}")]
    NotReleased(Outcome),
}

/// Injects all faults, one after the other, into one robot; into a new one after a fault that it did not get over.
///
/// # Errors
/// No robot walked at all.
pub fn run(options: &FaultOptions) -> Result<FaultReport, FaultError> {
    let folder = new_folder(&options.runs, &format!("faults-seed{}", options.seed))?;
    say("software e-stop and simulated leg: not a safety function, no clinical meaning");
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
        let robot = Robot::start(&topology(options)?, None, &folder)?;
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
        std::fs::write(folder.join("faults.svg"), plot::contrast(&contrast))?;
    }
    let held = |functional_only: bool| {
        let mut claims = report.claims.iter();
        report.failures.is_empty()
            && claims.all(|claim| claim.held || functional_only && !claim.expected.is_functional())
    };
    (report.functional_held, report.passed) = (held(true), held(false));
    Ok(report)
}

/// The steps that take a network of one's own: a robot with a host for each process.
fn on_hosts(options: &FaultOptions, network: Network, folder: &Path, report: &mut FaultReport) {
    let (what, steps, name) = match network {
        Network::Cables => ("steps 6 and 7 with a link that is cut", &Step::ON_HOSTS[..], "robot-on-hosts"),
        Network::Radio(_) => ("step 10", &Step::ON_RADIO[..], "robot-on-radio"),
    };
    let hosts = match Hosts::new(network) {
        Ok(hosts) => hosts,
        Err(why) => {
            let words = format!("{what}: no hosts can be made here, {why}");
            say(&words);
            report.skipped.push(words);
            return;
        }
    };
    let folder = folder.join(name);
    let walked = std::fs::create_dir(&folder).map_err(FaultError::from).and_then(|()| {
        let robot = Robot::start(&topology_on_hosts(options)?, Some(hosts), &folder)?;
        one_robot(options, robot, &folder, steps, report)
    });
    if let Err(error) = walked {
        report.failures.push(format!("{what}: {error}"));
    }
}

/// Walks a robot through the steps until one is too much for it; the steps that are left then.
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
            say(&format!("  {failure}"));
            report.failures.push(format!("step {step}: {failure}"));
            break;
        }
    }
    robot.pass_until(Time::now() + SETTLE)?;
    let stop = Time::now();
    robot.end();
    let evidence = Evidence::read(folder, stop)?;
    for (injection, failure) in &mut injections {
        if failure.is_some() {
            injection.until = stop;
        }
        judge::judge(&evidence, injection, failure.as_deref(), &mut report.claims);
    }
    Ok(left)
}

fn topology(options: &FaultOptions) -> io::Result<Topology> {
    let mut topology = topology::for_this_host(options.seed)?;
    topology.control.release = ReleaseBy::Operator;
    topology.plant.device_watchdog = Some(options.device_watchdog);
    topology.joints[Joint::Knee.index()].drive = DrivePlace::Process;
    Ok(topology)
}

/// Each process on its host. Who is cut off without a word is lost after three to four silent periods: these are short.
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

/// A line for whoever looks on.
fn say(line: &str) {
    output::print(&format!("{line}\n"));
}
