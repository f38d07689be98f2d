//! The drives, computed again from a recording: the same inputs give the same torques, bit by bit.
//!
//! Each [`DriveTick`] names the inputs that a tick has used, with the times that the drive has computed with, and the
//! gains. So the tick can be computed again at its own time, on the recorded samples and gait states. No timer and no
//! order of messages has an influence. The core of the drive
//! ([`DriveCore`](exoskeleton_model::control::drive::DriveCore)) runs, without the shell around it: guards accept only
//! messages that quote their own clock, which no replay has.
//!
//! [`replay`] reads the file itself, and reports gaps in it. [`spec`] is the same core as an application, for
//! `sinew play --check`, and [`check_drive`] is its process.

pub mod check_drive;
mod drive;
mod inputs;
mod program;

use std::collections::VecDeque;
use std::fmt;
use std::path::{Path, PathBuf};

use exoskeleton_model::joint::{Joint, PerJoint};
use exoskeleton_model::message::{DriveState, DriveTick};
use sinew::Tid;
use sinew_bag::BagError;
use sinew_bag::read::Ordered;
use thiserror::Error;

pub use program::{ReplayedDrive, spec};

use drive::DriveReplay;
use inputs::Inputs;

/// Time by which a tick is computed behind the newest message, ns: the record of an input may be later than that of
/// the tick which has used it, as it is written after the input was handed over.
const BEHIND_NS: u64 = 20_000_000;
/// Maximum number of ticks that wait for that: some 20 for each drive, or many that have one time in the file.
const WAITING_MAX: usize = 65_536;

/// The result of a replay.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Replayed {
    /// The results of each joint.
    pub joints: PerJoint<JointResult>,
    /// Damage of the file, which was skipped, and the end that it lacks.
    pub damage: Vec<String>,
}

/// The replay of one joint's drive.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct JointResult {
    /// Recorded ticks.
    pub ticks: u64,
    /// Ticks that were computed again. Ticks at rest are left out where the recording lacks their inputs.
    pub compared: u64,
    /// Ticks with the same torque, gain of assistance and state, bit by bit.
    pub identical: u64,
    /// The first tick that differs.
    pub first_difference: Option<Difference>,
    /// The reason why ticks cannot be computed again, from some tick on until the drive is at rest.
    pub gap: Option<String>,
}

/// A tick that differs.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Difference {
    /// Its number.
    pub tick: u32,
    /// Time since the first recorded tick of any drive, seconds.
    pub at_s: f64,
    /// The recorded result.
    pub recorded: TickResult,
    /// The result of the replay.
    pub now: TickResult,
}

/// The result of a tick.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TickResult {
    /// Computed torque, Nm.
    pub torque_nm: Option<f64>,
    /// Gain of assistance, 0..1.
    pub assist_gain: f64,
    /// State after the tick.
    pub state: DriveState,
}

/// The reason why nothing was replayed.
#[derive(Debug, Error)]
pub enum ReplayError {
    /// The file cannot be read.
    #[error(transparent)]
    File(#[from] BagError),
    /// It has no ticks.
    #[error(
        "{} has no ticks of drives: replay the file of a walk, `walk.mcap` or that of a joint's node, which was recorded by `exoskeleton`",
        .0.display()
    )]
    NoTicks(PathBuf),
}

/// A tick that waits for the records of its inputs.
#[derive(Debug)]
struct WaitingTick {
    log_ns: u64,
    drive: Tid,
    tick: DriveTick,
}

/// Computes the drives of a recording again, with the gains of each tick multiplied by `gain_factor`. The file is that
/// of a whole walk or of one node.
///
/// # Errors
/// The file cannot be read, or has no ticks of drives.
pub fn replay(path: &Path, gain_factor: f64) -> Result<Replayed, ReplayError> {
    let mut file = Ordered::open(path)?;
    let mut drives = Joint::ALL.map(|joint| DriveReplay::new(joint, gain_factor));
    let mut inputs = Inputs::default();
    let mut waiting: VecDeque<WaitingTick> = VecDeque::new();
    let mut run =
        |waiting: &mut VecDeque<WaitingTick>, inputs: &Inputs, is_due: &dyn Fn(&WaitingTick) -> bool| {
            while let Some(next) = waiting.pop_front_if(|next| is_due(next)) {
                if let Some(drive) = drives.get_mut(usize::from(next.tick.joint)) {
                    drive.run(&next.tick, inputs.of(next.drive));
                }
            }
        };
    while let Some(message) = file.next_message()? {
        let until_ns = message.log_ns.saturating_sub(BEHIND_NS);
        let is_full = waiting.len() >= WAITING_MAX;
        run(&mut waiting, &inputs, &|next| is_full || next.log_ns < until_ns);
        if let Some((drive, tick)) = inputs.take(&message) {
            waiting.push_back(WaitingTick { log_ns: message.log_ns, drive, tick });
        }
    }
    run(&mut waiting, &inputs, &|_| true);
    let began_ns = drives.iter().filter_map(DriveReplay::began_ns).min();
    let Some(began_ns) = began_ns else { return Err(ReplayError::NoTicks(path.to_owned())) };
    let damage = file.damage().iter().map(String::as_str).chain(file.missing_end());
    let damage = damage.map(str::to_owned).collect();
    Ok(Replayed { joints: drives.map(|drive| drive.result(began_ns)), damage })
}

impl Replayed {
    /// Returns the number of ticks, of all joints, that were left out: the recording lacks their inputs or the state
    /// before them.
    #[must_use]
    pub fn left_out(&self) -> u64 {
        self.joints.iter().map(|joint| joint.ticks.saturating_sub(joint.compared)).sum()
    }

    /// Returns the reason why ticks were left out, for the line under the table.
    fn why_left_out(&self) -> &'static str {
        if self.joints.iter().all(|joint| joint.gap.is_none()) {
            "of drives at rest: the recording lacks their inputs or the state before them"
        } else {
            "of drives at rest, or for the reasons above"
        }
    }

    /// Whether the recorded ticks were computed again, each with the same result, and the file is whole.
    #[must_use]
    pub fn is_same(&self) -> bool {
        if !self.damage.is_empty() {
            return false;
        }
        let is_whole = |joint: &JointResult| joint.identical == joint.compared && joint.gap.is_none();
        self.joints.iter().all(is_whole) && self.joints.iter().any(|joint| joint.compared > 0)
    }
}

impl TickResult {
    /// Returns the recorded result.
    const fn of(tick: &DriveTick) -> Self {
        let DriveTick { torque_nm, assist_gain, state, .. } = *tick;
        Self { torque_nm, assist_gain, state }
    }

    /// Whether both have the same bits.
    fn is(&self, other: &Self) -> bool {
        let bits =
            |result: &Self| (result.torque_nm.map(f64::to_bits), result.assist_gain.to_bits(), result.state);
        bits(self) == bits(other)
    }
}

impl fmt::Display for TickResult {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.torque_nm {
            Some(torque_nm) => write!(f, "{torque_nm:?} Nm")?,
            None => write!(f, "no torque")?,
        }
        write!(f, " ({:?}, gain {:?})", self.state, self.assist_gain)
    }
}

impl fmt::Display for Replayed {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{:6} {:>9} {:>9} {:>9}  first difference", "joint", "torques", "compared", "identical")?;
        for joint in Joint::ALL {
            let JointResult { ticks, compared, identical, first_difference, gap } =
                &self.joints[joint.index()];
            write!(f, "{:6} {ticks:>9} {compared:>9} {identical:>9}  ", joint.name())?;
            match first_difference {
                Some(Difference { tick, at_s, recorded, now }) => {
                    writeln!(f, "tick {tick}, at {at_s:.6} s: recorded {recorded}, now {now}")?;
                }
                None => writeln!(f, "none")?,
            }
            if let Some(gap) = gap {
                writeln!(f, "{:6} not compared: {gap}", "")?;
            }
        }
        let left_out = self.left_out();
        if left_out > 0 {
            writeln!(f, "left out: {left_out} ticks {}", self.why_left_out())?;
        }
        self.damage.iter().try_for_each(|damage| writeln!(f, "{damage}"))?;
        if self.is_same() {
            return writeln!(f, "SAME: each compared torque was computed again, with the same bits");
        }
        if self.joints.iter().any(|joint| joint.first_difference.is_some()) {
            return writeln!(f, "DIFFERENT: see the first difference above");
        }
        if !self.damage.is_empty() {
            return writeln!(
                f,
                "INCOMPLETE: no compared torque differs; the file is damaged or cut off, see above"
            );
        }
        writeln!(f, "INCOMPLETE: no compared torque differs; the recording lacks inputs of the others")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn words(gap: Option<String>) -> String {
        let joint =
            |compared| JointResult { ticks: 10, compared, identical: compared, ..JointResult::default() };
        let joints = [JointResult { gap, ..joint(7) }, joint(10), joint(8)];
        Replayed { joints, damage: Vec::new() }.to_string()
    }

    #[test]
    fn file_with_damage_is_never_the_same() {
        let joint = JointResult { ticks: 10, compared: 10, identical: 10, ..JointResult::default() };
        let joints = [joint.clone(), joint.clone(), joint];
        let whole = Replayed { joints, damage: Vec::new() };
        assert!(whole.is_same() && whole.to_string().contains("SAME"), "{whole}");
        let cut = Replayed { damage: vec!["walk.mcap: unfinished".to_owned()], ..whole };
        let words = cut.to_string();
        assert!(!cut.is_same() && words.contains("walk.mcap: unfinished"), "{words}");
        assert!(words.contains("INCOMPLETE") && !words.contains("SAME"), "{words}");
    }

    #[test]
    fn ticks_that_are_left_out_are_stated() {
        let same = words(None);
        assert!(same.contains("left out: 5 ticks of drives at rest: the recording lacks"), "{same}");
        assert!(same.contains("SAME"), "{same}");
        let incomplete = words(Some("sample 3 is not in the recording".to_owned()));
        assert!(
            incomplete.contains("left out: 5 ticks of drives at rest, or for the reasons above"),
            "{incomplete}"
        );
        assert!(incomplete.contains("INCOMPLETE"), "{incomplete}");
    }
}
