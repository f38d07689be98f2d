//! What is done in each step: when which fault is injected, and what the operator does about it. Nothing is judged here.

use std::io;
use std::time::Duration;

use rustix::process::{Signal, kill_process};
use sinew::{Outcome, Time};
use sinew_hosts::Weather;

use super::operator::Word;
use super::robot::Robot;
use super::step::Step;
use super::{FaultError, say};
use crate::joint::Joint;
use crate::message::{DriveState, GaitMode};
use crate::part::Part;
use crate::robot::launch::hosts::Link;
use crate::robot::role::Role;

/// The node that is pulled.
const KNEE: Role = Role::Node(Part::Joint(Joint::Knee));
const CENTRAL: Role = Role::Node(Part::Central);
/// Phase of a stride at which a node is pulled.
const PULL_PHASE: f64 = 0.62;
/// Phase at which central is killed.
const CENTRAL_PHASE: f64 = 0.30;
/// Phase at which the e-stop is pressed: the ankle pushes off, so there is a torque to take away.
const STOP_PHASE: f64 = 0.50;
/// Phase in which the ankle's own moment is about zero, so that zero is a sane torque.
const QUIET_PHASE: f64 = 0.78;
/// Phase from which on the ankle gives 30 Nm and more, so that the same with the other sign is insane.
const PUSH_PHASE: f64 = 0.36;
/// Phase at which the process of a drive hangs.
const HANG_PHASE: f64 = 0.62;
/// How long it hangs when it is let go on: less than its node's patience.
const HANG: Duration = Duration::from_millis(400);
/// From assistance to full assistance of one drive, and a little.
const REJOINED: Duration = Duration::from_millis(500);
/// How long a node is away.
const OUTAGE: Duration = Duration::from_secs(1);
/// How long it is watched after a release whether it walks as before: five seconds are allowed, the last stride counts whole.
const WATCHED: Duration = Duration::from_millis(6_500);
/// What a rough network does to packets: the share that is lost, per cent, beside a delay of this much, give or take.
const ROUGH: [(f64, &str); 3] =
    [(0.0, "none lost, 2 ms +- 1 ms"), (1.0, "1 % lost, 2 ms +- 1 ms"), (5.0, "5 % lost, 2 ms +- 1 ms")];
const ROUGH_DELAY: Duration = Duration::from_millis(2);
const ROUGH_JITTER: Duration = Duration::from_millis(1);
/// Strides in a clear network that those in a rough one are held against.
const STRIDES_CLEAR: u32 = 6;
const STRIDES_ROUGH: u32 = 12;
/// How long it is watched that nothing moves.
const STILL: Duration = Duration::from_secs(1);
/// Time for things to happen that are looked at afterwards.
const AFTERMATH: Duration = Duration::from_millis(300);
/// Words of a kind at least and at most, and the time between them.
const WORDS: u32 = 20;
const WORDS_MAX: u32 = 500;
const WORD_PERIOD: Duration = Duration::from_millis(3);
const RESET_PATIENCE: Duration = Duration::from_secs(60);
/// From [`PUSH_PHASE`] on, how long the same with the other sign is insane for sure; from [`QUIET_PHASE`] on, how long zero is sane.
const SURELY: Duration = Duration::from_millis(150);
/// Strides in which it is tried, at most: where the host has no time for the operator there are few words in each.
const STRIDES_MAX: u32 = 20;

/// One injected fault and what came of it, in the host's clock.
#[derive(Debug, Clone)]
pub(super) struct Injection {
    pub(super) step: Step,
    /// Which of several of the step.
    pub(super) label: String,
    /// When the fault was injected.
    pub(super) at: Time,
    /// When it was over and the robot walked as before.
    pub(super) until: Time,
    /// What else happened when.
    pub(super) marks: Vec<(Mark, Time)>,
    /// What the operator saw.
    pub(super) seen: Vec<(Seen, bool)>,
}

/// A moment within a step.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Mark {
    /// What was killed is started again.
    Started,
    /// What was stopped goes on.
    Continued,
    /// The network is clear, from here on.
    Clear,
    /// All parts are there, the leg is held.
    Held,
    /// The operator has released walking.
    Released,
    /// The drives assist again.
    Walking,
    /// The operator tried to release walking in spite of the e-stop.
    ResumeTried,
    /// The operator has begun to take the e-stop back.
    ResetBegun,
    /// Sane torques are given, from here on.
    Sane,
    /// Insane ones of a kind, from here on.
    NotANumber,
    /// 500 Nm.
    TooMuch,
    /// The sign is wrong.
    Reversed,
    /// The sequence number is of long ago.
    OldSequence,
    /// Somebody pretends to be central.
    Stranger,
    /// The insane words are over.
    WordsOver,
}

/// What the operator saw at once.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Seen {
    /// The release was refused while the e-stop was latched.
    ResumeRefused,
    /// Central and all drives have taken the reset.
    ResetTaken,
}

impl Injection {
    fn begun(step: Step, label: &str, at: Time) -> Self {
        say(&format!(
            "step {step}: {}{}",
            step.words(),
            if label.is_empty() { String::new() } else { format!(", {label}") }
        ));
        Self { step, label: label.to_owned(), at, until: at, marks: Vec::new(), seen: Vec::new() }
    }

    fn mark(&mut self, mark: Mark, at: Time) {
        self.marks.push((mark, at));
    }

    /// When something happened; the begin of the injection when it did not.
    pub(super) fn when(&self, mark: Mark) -> Option<Time> {
        self.marks.iter().find(|(marked, _)| *marked == mark).map(|(_, at)| *at)
    }

    /// How long the fault of this step had lasted when the step began, ns: a node returns after its outage.
    pub(super) const fn away_ns(&self) -> u64 {
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

    pub(super) fn has_seen(&self, what: Seen) -> bool {
        self.seen.contains(&(what, true))
    }
}

/// A robot that stands, all parts there, until it has walked enough for faults.
pub(super) fn walk_until_converged(robot: &mut Robot) -> Result<(), FaultError> {
    robot.wait_held()?;
    robot.release()?;
    say("released; walking until it has converged");
    robot.wait_converged()?;
    Ok(())
}

/// Does `step`. What was injected is in `out`, also when the robot did not get over it. `also` are the steps that come
/// later: a node that is pulled comes back in the next one.
pub(super) fn perform(
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

/// The process of the knee's drive hangs, and goes on after a while.
fn hang_drive(robot: &mut Robot, out: &mut Vec<Injection>) -> Result<(), FaultError> {
    let process = robot.drive_process(Joint::Knee)?;
    robot.walk_to_phase(HANG_PHASE)?;
    let at = Time::now();
    kill_process(process, Signal::STOP).map_err(io::Error::from)?;
    out.push(Injection::begun(Step::HangDrive, "SIGSTOP, SIGCONT", at));
    robot.pass_until(at + HANG)?;
    let injection = out.last_mut().expect("it was just pushed");
    injection.mark(Mark::Continued, Time::now());
    // It may have been replaced meanwhile; then there is nobody to go on.
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

/// Until the drive assists again, fully.
fn rejoin(robot: &mut Robot, out: &mut [Injection]) -> Result<(), FaultError> {
    let injection = out.last_mut().expect("it was just pushed");
    robot.pass_until(injection.at + AFTERMATH)?;
    injection.mark(Mark::Walking, robot.wait_walking()?);
    robot.pass_until(Time::now() + REJOINED)?;
    robot.wait_walking()?;
    injection.until = Time::now();
    Ok(())
}

/// The process of the knee's node is killed as a power cut would; it stays away.
fn pull_node(robot: &mut Robot, out: &mut Vec<Injection>) -> Result<(), FaultError> {
    robot.walk_to_phase(PULL_PHASE)?;
    let at = robot.kill(KNEE);
    let mut injection = Injection::begun(Step::PullNode, "SIGKILL", at);
    injection.until = at + OUTAGE;
    out.push(injection);
    robot.pass_until(at + OUTAGE)
}

/// It is started again, and nothing moves until the operator says so.
fn return_node(robot: &mut Robot, out: &mut Vec<Injection>) -> Result<(), FaultError> {
    let at = robot.start_role(KNEE)?;
    out.push(Injection::begun(Step::ReturnNode, "", at));
    let injection = out.last_mut().expect("it was just pushed");
    injection.mark(Mark::Started, at);
    hold_and_release(robot, injection)
}

/// The knee's node lives and reaches its device, and nobody hears it.
fn cut_link(robot: &mut Robot, out: &mut Vec<Injection>) -> Result<(), FaultError> {
    robot.walk_to_phase(PULL_PHASE)?;
    let at = robot.set_link(Joint::Knee, Link::Down)?;
    let mut injection = Injection::begun(Step::CutLink, "link down", at);
    injection.until = at + OUTAGE;
    out.push(injection);
    robot.pass_until(at + OUTAGE)
}

/// It is heard again, and nothing moves until the operator says so.
fn join_link(robot: &mut Robot, out: &mut Vec<Injection>) -> Result<(), FaultError> {
    let at = robot.set_link(Joint::Knee, Link::Up)?;
    out.push(Injection::begun(Step::JoinLink, "link up", at));
    hold_and_release(robot, out.last_mut().expect("it was just pushed"))
}

/// All that the nodes send each other is delayed, and a share of it lost; before that the same robot walks in clear weather.
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
        say(&format!("  {arrived} packets arrived, {lost} were lost"));
    }
    Ok(())
}

/// From all parts being there to walking: a second in which nothing moves, the release, the ramp, three strides or more.
fn hold_and_release(robot: &mut Robot, injection: &mut Injection) -> Result<(), FaultError> {
    let held = robot.wait_held()?;
    injection.mark(Mark::Held, held);
    robot.pass_until(held + STILL)?;
    injection.mark(Mark::Released, Time::now());
    robot.release()?;
    say("  nothing moved; the operator releases");
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
    say(&format!("  resume was pressed in spite of it: {outcome:?}"));
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
    give_at(QUIET_PHASE, robot, injection, Mark::Sane, &[Word::Torque(0.0)])?;
    // A number of long ago is one only right after one of now.
    give_at(QUIET_PHASE, robot, injection, Mark::OldSequence, &[Word::Torque(0.0), Word::OldSequence(5.0)])?;
    give(robot, injection, Mark::NotANumber, Word::Torque(f32::NAN))?;
    give(robot, injection, Mark::TooMuch, Word::Torque(500.0))?;
    give_at(PUSH_PHASE, robot, injection, Mark::Reversed, &[Word::Torque(40.0)])?;
    injection.mark(Mark::Stranger, Time::now());
    for _ in 0..WORDS {
        robot.operator()?.pretend_to_be_central()?;
        robot.pass_until(Time::now() + WORD_PERIOD)?;
    }
    robot.pass_until(Time::now() + AFTERMATH)?;
    injection.mark(Mark::WordsOver, Time::now());
    robot.wait_converged()?;
    injection.until = Time::now();
    Ok(())
}

/// Gives a word that is insane at any moment over and over, until the drive has counted one of the kind: of a stream the
/// newest wins, so that a word may be overtaken by the next.
fn give(robot: &mut Robot, injection: &mut Injection, kind: Mark, word: Word) -> Result<(), FaultError> {
    let before = counted(robot, kind);
    injection.mark(kind, Time::now());
    for number in 1..=WORDS_MAX {
        robot.operator()?.set_torque(Joint::Ankle, word)?;
        robot.pass_until(Time::now() + WORD_PERIOD)?;
        if number >= WORDS && counted(robot, kind) > before {
            break;
        }
    }
    // So that none of these words is counted as one of the next kind.
    robot.pass_until(Time::now() + AFTERMATH)
}

/// How many words of a kind the drive has counted.
fn counted(robot: &Robot, kind: Mark) -> Option<u32> {
    let drive = robot.view().drive(Joint::Ankle);
    drive.map(|drive| if kind == Mark::Sane { drive.commands_taken } else { drive.commands_refused })
}

/// Gives the words in turn in a phase in which they are sane, or insane, for sure, and no longer; in as many strides as it takes.
fn give_at(
    phase: f64,
    robot: &mut Robot,
    injection: &mut Injection,
    kind: Mark,
    words: &[Word],
) -> Result<(), FaultError> {
    let mut before = None;
    for _ in 0..STRIDES_MAX {
        robot.walk_to_phase(phase)?;
        let begun = Time::now();
        if before.is_none() {
            // A while after the words before: all of them are counted.
            before = counted(robot, kind);
            injection.mark(kind, begun);
        }
        for word in words.iter().cycle().take(WORDS as usize * words.len()) {
            if Time::now().since(begun) > SURELY {
                break;
            }
            robot.operator()?.set_torque(Joint::Ankle, *word)?;
            // One that is overtaken by the next is not seen at all.
            robot.pass_until(Time::now() + WORD_PERIOD)?;
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
