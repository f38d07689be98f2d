//! The actions of each step: the time and kind of the injected fault, and the operator's reaction. Nothing is
//! judged here.

use std::io;
use std::time::Duration;

use exoskeleton::robot::role::Role;
use exoskeleton_model::joint::Joint;
use exoskeleton_model::message::{DriveState, GaitMode};
use exoskeleton_model::part::Part;
use rustix::process::{Signal, kill_process};
use sinew::{Outcome, Time};
use sinew_testkit::Weather;

use crate::campaign::{FaultError, print_line};
use crate::hosts::Link;
use crate::operator::OperatorCommand;
use crate::robot::Robot;
use crate::step::Step;

/// The node that is lost.
const KNEE: Role = Role::Node(Part::Joint(Joint::Knee));
const CENTRAL: Role = Role::Node(Part::Central);
/// Phase of a stride at which a node is killed or cut off.
const PULL_PHASE: f64 = 0.62;
/// Phase at which central is killed.
const CENTRAL_PHASE: f64 = 0.30;
/// Phase at which the e-stop is pressed: the ankle pushes off, so there is a torque to remove.
const STOP_PHASE: f64 = 0.50;
/// Phase in which the ankle's own moment is about zero, so that zero is a sane torque.
const QUIET_PHASE: f64 = 0.78;
/// Phase from which on the ankle gives 30 Nm and more, so that the same with the other sign is insane.
const PUSH_PHASE: f64 = 0.36;
/// Phase at which the process of a drive hangs.
const HANG_PHASE: f64 = 0.62;
/// Length of a hang that ends by itself: below the node's limit.
const HANG: Duration = Duration::from_millis(400);
/// From assistance to full assistance of one drive, and a bit more.
const REJOINED: Duration = Duration::from_millis(500);
/// How long a node is away.
const OUTAGE: Duration = Duration::from_secs(1);
/// Time after a release in which the walk is compared with before: five seconds are allowed, the last stride
/// counts whole.
const WATCHED: Duration = Duration::from_millis(6_500);
/// The effects of a rough network on packets: the share of lost ones, per cent, and the text of loss and
/// delay.
const ROUGH: [(f64, &str); 3] =
    [(0.0, "none lost, 2 ms +- 1 ms"), (1.0, "1 % lost, 2 ms +- 1 ms"), (5.0, "5 % lost, 2 ms +- 1 ms")];
const ROUGH_DELAY: Duration = Duration::from_millis(2);
const ROUGH_JITTER: Duration = Duration::from_millis(1);
/// Strides in a clear network that those in a rough one are compared with.
const STRIDES_CLEAR: u32 = 6;
const STRIDES_ROUGH: u32 = 12;
/// Time in which nothing may move.
const STILL: Duration = Duration::from_secs(1);
/// Time for effects that are evaluated afterwards.
const AFTERMATH: Duration = Duration::from_millis(300);
/// Minimum and maximum number of commands of a kind, and the time between them.
const COMMANDS_MIN: u32 = 20;
const COMMANDS_MAX: u32 = 500;
const COMMAND_PERIOD: Duration = Duration::from_millis(3);
const RESET_PATIENCE: Duration = Duration::from_secs(60);
/// From [`PUSH_PHASE`] on, how long the same with the other sign is certainly insane; from [`QUIET_PHASE`]
/// on, how long zero is sane.
const SURELY: Duration = Duration::from_millis(150);
/// Maximum number of strides for the attempts: if the host has no time for the operator, each has few
/// commands.
const STRIDES_MAX: u32 = 20;

/// One injected fault and its effects, in the host's clock.
#[derive(Debug, Clone)]
pub(crate) struct Injection {
    pub(crate) step: Step,
    /// One of several injections of the step.
    pub(crate) label: String,
    /// Time of the injection.
    pub(crate) at: Time,
    /// Time at which it was over and the robot walked as before.
    pub(crate) until: Time,
    /// Times of other events.
    pub(crate) marks: Vec<(Mark, Time)>,
    /// The operator's observations.
    pub(crate) seen: Vec<(Seen, bool)>,
}

/// A moment within a step.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Mark {
    /// The killed process is started again.
    Started,
    /// The stopped process continues.
    Continued,
    /// The network is clear, from here on.
    Clear,
    /// All parts are ready, the leg is held.
    Held,
    /// The operator has released walking.
    Released,
    /// The drives assist again.
    Walking,
    /// The operator tried to release walking in spite of the e-stop.
    ResumeTried,
    /// The operator has begun to reset the e-stop.
    ResetBegun,
    /// Sane torques are sent, from here on.
    Sane,
    /// Insane ones of a kind, from here on.
    NotANumber,
    /// 500 Nm.
    TooMuch,
    /// The sign is wrong.
    Reversed,
    /// The sequence number is very old.
    OldSequence,
    /// An application impersonates central.
    Stranger,
    /// The insane commands are over.
    CommandsOver,
}

/// The operator's immediate observations.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Seen {
    /// The release was rejected while the e-stop was latched.
    ResumeRefused,
    /// Central and all drives have accepted the reset.
    ResetTaken,
}

impl Injection {
    fn begun(step: Step, label: &str, at: Time) -> Self {
        print_line(&format!(
            "step {step}: {}{}",
            step.words(),
            if label.is_empty() { String::new() } else { format!(", {label}") }
        ));
        Self { step, label: label.to_owned(), at, until: at, marks: Vec::new(), seen: Vec::new() }
    }

    fn mark(&mut self, mark: Mark, at: Time) {
        self.marks.push((mark, at));
    }

    /// Time of an event; `None` if it did not occur.
    pub(crate) fn when(&self, mark: Mark) -> Option<Time> {
        self.marks.iter().find(|(marked, _)| *marked == mark).map(|(_, at)| *at)
    }

    /// How long the fault of this step had lasted when the step began, ns: a node returns after its outage.
    pub(crate) const fn away_ns(&self) -> u64 {
        match self.step {
            Step::ReturnNode | Step::JoinLink => OUTAGE.as_nanos() as u64,
            Step::KillDrive
            | Step::HangDrive
            | Step::PullNode
            | Step::EmergencyStop
            | Step::InsaneCommands
            | Step::KillCentral
            | Step::CutLink
            | Step::RoughNetwork => 0,
        }
    }

    pub(crate) fn has_seen(&self, what: Seen) -> bool {
        self.seen.contains(&(what, true))
    }
}

/// From a robot that stands with all parts ready to one that has walked enough for faults.
pub(crate) fn walk_until_converged(robot: &mut Robot) -> Result<(), FaultError> {
    robot.wait_held()?;
    robot.release()?;
    print_line("released; walking until it has converged");
    robot.wait_converged()?;
    Ok(())
}

/// Performs `step`. The injections are in `out`, also when the robot did not recover. `also` are the later
/// steps: a node that is lost returns in the next one.
pub(crate) fn perform(
    robot: &mut Robot,
    step: Step,
    phases: &[f64],
    out: &mut Vec<Injection>,
) -> Result<(), FaultError> {
    match step {
        Step::KillDrive => phases.iter().try_for_each(|phase| kill_drive(robot, *phase, out)),
        Step::HangDrive => {
            hang_drive(robot, out)?;
            hang_drive_for_good(robot, out)
        }
        Step::PullNode => pull_node(robot, out),
        Step::ReturnNode => return_node(robot, out),
        Step::EmergencyStop => emergency_stop(robot, out),
        Step::InsaneCommands => insane_commands(robot, out),
        Step::KillCentral => kill_central(robot, out),
        Step::CutLink => cut_link(robot, out),
        Step::JoinLink => join_link(robot, out),
        Step::RoughNetwork => rough_network(robot, out),
    }
}

/// The process of the knee's drive is killed; its node starts another.
fn kill_drive(robot: &mut Robot, phase: f64, out: &mut Vec<Injection>) -> Result<(), FaultError> {
    let process = robot.drive_process(Joint::Knee)?;
    robot.walk_to_phase(phase)?;
    let at = Time::now();
    kill_process(process, Signal::KILL).map_err(io::Error::from)?;
    out.push(Injection::begun(Step::KillDrive, "SIGKILL", at));
    rejoin(robot, out)
}

/// The process of the knee's drive hangs, and continues after a while.
fn hang_drive(robot: &mut Robot, out: &mut Vec<Injection>) -> Result<(), FaultError> {
    let process = robot.drive_process(Joint::Knee)?;
    robot.walk_to_phase(HANG_PHASE)?;
    let at = Time::now();
    kill_process(process, Signal::STOP).map_err(io::Error::from)?;
    out.push(Injection::begun(Step::HangDrive, "SIGSTOP, SIGCONT", at));
    robot.pass_until(at + HANG)?;
    let injection = out.last_mut().expect("it was just pushed");
    injection.mark(Mark::Continued, Time::now());
    // It may have been replaced meanwhile; then there is no process to continue.
    let _ = kill_process(process, Signal::CONT);
    rejoin(robot, out)
}

/// The process of the knee's drive hangs for good; its node kills it and starts another.
fn hang_drive_for_good(robot: &mut Robot, out: &mut Vec<Injection>) -> Result<(), FaultError> {
    let process = robot.drive_process(Joint::Knee)?;
    robot.walk_to_phase(HANG_PHASE)?;
    let at = Time::now();
    kill_process(process, Signal::STOP).map_err(io::Error::from)?;
    out.push(Injection::begun(Step::HangDrive, "SIGSTOP for good", at));
    rejoin(robot, out)
}

/// Waits until the drive assists again, fully.
fn rejoin(robot: &mut Robot, out: &mut [Injection]) -> Result<(), FaultError> {
    let injection = out.last_mut().expect("it was just pushed");
    robot.pass_until(injection.at + AFTERMATH)?;
    injection.mark(Mark::Walking, robot.wait_walking()?);
    robot.pass_until(Time::now() + REJOINED)?;
    robot.wait_walking()?;
    injection.until = Time::now();
    Ok(())
}

/// Kills the process of the knee's node as a power cut would; it stays away.
fn pull_node(robot: &mut Robot, out: &mut Vec<Injection>) -> Result<(), FaultError> {
    robot.walk_to_phase(PULL_PHASE)?;
    let at = robot.kill(KNEE);
    let mut injection = Injection::begun(Step::PullNode, "SIGKILL", at);
    injection.until = at + OUTAGE;
    out.push(injection);
    robot.pass_until(at + OUTAGE)
}

/// Starts it again; nothing moves until the operator releases.
fn return_node(robot: &mut Robot, out: &mut Vec<Injection>) -> Result<(), FaultError> {
    let at = robot.start_role(KNEE)?;
    out.push(Injection::begun(Step::ReturnNode, "", at));
    let injection = out.last_mut().expect("it was just pushed");
    injection.mark(Mark::Started, at);
    hold_and_release(robot, injection)
}

/// The knee's node runs and reaches its device, but no other node receives from it.
fn cut_link(robot: &mut Robot, out: &mut Vec<Injection>) -> Result<(), FaultError> {
    robot.walk_to_phase(PULL_PHASE)?;
    let at = robot.set_link(Joint::Knee, Link::Down)?;
    let mut injection = Injection::begun(Step::CutLink, "link down", at);
    injection.until = at + OUTAGE;
    out.push(injection);
    robot.pass_until(at + OUTAGE)
}

/// Reconnects it; nothing moves until the operator releases.
fn join_link(robot: &mut Robot, out: &mut Vec<Injection>) -> Result<(), FaultError> {
    let at = robot.set_link(Joint::Knee, Link::Up)?;
    out.push(Injection::begun(Step::JoinLink, "link up", at));
    hold_and_release(robot, out.last_mut().expect("it was just pushed"))
}

/// Delays all traffic between the nodes and loses a share of it; before that the same robot walks in clear
/// weather.
fn rough_network(robot: &mut Robot, out: &mut Vec<Injection>) -> Result<(), FaultError> {
    for (percent, label) in ROUGH {
        robot.set_weather(Weather::default())?;
        robot.wait_converged()?;
        let clear = Time::now();
        robot.wait_strides(STRIDES_CLEAR)?;
        let weather = Weather { loss: percent / 100.0, delay: ROUGH_DELAY, jitter: ROUGH_JITTER };
        let (at, before) = robot.set_weather(weather)?;
        out.push(Injection::begun(Step::RoughNetwork, label, at));
        let injection = out.last_mut().expect("it was just pushed");
        injection.mark(Mark::Clear, clear);
        robot.wait_strides(STRIDES_ROUGH)?;
        let (until, after) = robot.set_weather(Weather::default())?;
        injection.until = until;
        let (arrived, lost) = (after.arrived - before.arrived, after.lost - before.lost);
        print_line(&format!("  {arrived} packets arrived, {lost} were lost"));
    }
    Ok(())
}

/// From all parts ready to walking: a second in which nothing moves, the release, the ramp, three strides or
/// more.
fn hold_and_release(robot: &mut Robot, injection: &mut Injection) -> Result<(), FaultError> {
    let held = robot.wait_held()?;
    injection.mark(Mark::Held, held);
    robot.pass_until(held + STILL)?;
    injection.mark(Mark::Released, Time::now());
    robot.release()?;
    print_line("  nothing moved; the operator releases");
    let walking = robot.wait_converged()?;
    injection.mark(Mark::Walking, walking);
    robot.pass_until(walking + WATCHED)?;
    injection.until = Time::now();
    Ok(())
}

fn emergency_stop(robot: &mut Robot, out: &mut Vec<Injection>) -> Result<(), FaultError> {
    robot.operator()?;
    robot.walk_to_phase(STOP_PHASE)?;
    let at = Time::now();
    robot.operator()?.stop()?;
    out.push(Injection::begun(Step::EmergencyStop, "", at));
    let injection = out.last_mut().expect("it was just pushed");
    robot.pass_until(at + AFTERMATH)?;
    injection.mark(Mark::ResumeTried, Time::now());
    let outcome = robot.operator()?.release()?;
    injection.seen.push((Seen::ResumeRefused, matches!(outcome, Outcome::Rejected(_))));
    print_line(&format!("  resume was pressed in spite of it: {outcome:?}"));
    robot.pass_until(Time::now() + STILL)?;
    injection.mark(Mark::ResetBegun, Time::now());
    let taken = robot.operator()?.reset()?;
    injection.seen.push((Seen::ResetTaken, taken));
    robot.wait_until("the e-stop is taken back", RESET_PATIENCE, |view| {
        view.gait().is_some_and(|gait| gait.mode != Some(GaitMode::Stop))
            && Joint::ALL
                .into_iter()
                .all(|joint| view.drive(joint).is_some_and(|drive| drive.state != DriveState::EStop))
    })?;
    hold_and_release(robot, injection)
}

fn insane_commands(robot: &mut Robot, out: &mut Vec<Injection>) -> Result<(), FaultError> {
    robot.operator()?;
    robot.walk_to_phase(QUIET_PHASE)?;
    let at = Time::now();
    out.push(Injection::begun(Step::InsaneCommands, "ankle", at));
    let injection = out.last_mut().expect("it was just pushed");
    send_in_phase(QUIET_PHASE, robot, injection, Mark::Sane, &[OperatorCommand::Torque(0.0)])?;
    // A very old number is one only right after a current one.
    send_in_phase(
        QUIET_PHASE,
        robot,
        injection,
        Mark::OldSequence,
        &[OperatorCommand::Torque(0.0), OperatorCommand::OldSequence(5.0)],
    )?;
    send_repeatedly(robot, injection, Mark::NotANumber, OperatorCommand::Torque(f32::NAN))?;
    send_repeatedly(robot, injection, Mark::TooMuch, OperatorCommand::Torque(500.0))?;
    send_in_phase(PUSH_PHASE, robot, injection, Mark::Reversed, &[OperatorCommand::Torque(40.0)])?;
    injection.mark(Mark::Stranger, Time::now());
    for _ in 0..COMMANDS_MIN {
        robot.operator()?.impersonate_central()?;
        robot.pass_until(Time::now() + COMMAND_PERIOD)?;
    }
    robot.pass_until(Time::now() + AFTERMATH)?;
    injection.mark(Mark::CommandsOver, Time::now());
    robot.wait_converged()?;
    injection.until = Time::now();
    Ok(())
}

/// Sends a command that is insane at any moment repeatedly, until the drive has counted one of the kind: of a
/// stream the newest wins, so that a command may be replaced by the next.
fn send_repeatedly(
    robot: &mut Robot,
    injection: &mut Injection,
    kind: Mark,
    command: OperatorCommand,
) -> Result<(), FaultError> {
    let before = counted(robot, kind);
    injection.mark(kind, Time::now());
    for number in 1..=COMMANDS_MAX {
        robot.operator()?.set_torque(Joint::Ankle, command)?;
        robot.pass_until(Time::now() + COMMAND_PERIOD)?;
        if number >= COMMANDS_MIN && counted(robot, kind) > before {
            break;
        }
    }
    // So that none of these commands is counted as one of the next kind.
    robot.pass_until(Time::now() + AFTERMATH)
}

/// Number of commands of a kind that the drive has counted.
fn counted(robot: &Robot, kind: Mark) -> Option<u32> {
    let drive = robot.view().drive(Joint::Ankle);
    drive.map(|drive| if kind == Mark::Sane { drive.commands_taken } else { drive.commands_refused })
}

/// Sends the commands in turn in a phase in which they are certainly sane, or insane; uses as many strides as
/// needed.
fn send_in_phase(
    phase: f64,
    robot: &mut Robot,
    injection: &mut Injection,
    kind: Mark,
    commands: &[OperatorCommand],
) -> Result<(), FaultError> {
    let mut before = None;
    for _ in 0..STRIDES_MAX {
        robot.walk_to_phase(phase)?;
        let begun = Time::now();
        if before.is_none() {
            // A while after the commands before: all of them are counted.
            before = counted(robot, kind);
            injection.mark(kind, begun);
        }
        for command in commands.iter().cycle().take(COMMANDS_MIN as usize * commands.len()) {
            if Time::now().since(begun) > SURELY {
                break;
            }
            robot.operator()?.set_torque(Joint::Ankle, *command)?;
            // A command that is replaced by the next is not seen at all.
            robot.pass_until(Time::now() + COMMAND_PERIOD)?;
        }
        robot.pass_until(Time::now() + AFTERMATH)?;
        if counted(robot, kind) > before {
            break;
        }
    }
    Ok(())
}

fn kill_central(robot: &mut Robot, out: &mut Vec<Injection>) -> Result<(), FaultError> {
    robot.walk_to_phase(CENTRAL_PHASE)?;
    let at = robot.kill(CENTRAL);
    out.push(Injection::begun(Step::KillCentral, "SIGKILL", at));
    let injection = out.last_mut().expect("it was just pushed");
    robot.pass_until(at + OUTAGE)?;
    injection.mark(Mark::Started, robot.start_role(CENTRAL)?);
    hold_and_release(robot, injection)
}
