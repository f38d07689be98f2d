//! The messages between sensors, drives and the central unit, with units.
//!
//! Plain values, and their classes and names. Times are nanoseconds of one common clock, as far as it is
//! known.

use std::time::Duration;

use serde::{Deserialize, Serialize};
use sinew::protection::Protection;
use sinew::{Class, Payload};

use crate::control::torque_law::Gains;

/// From a joint's sensor to its own drive and to central, each millisecond.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct JointSample {
    /// Counts up by one with each sample, wraps.
    pub seq: u32,
    /// Time at which the device was read, ns.
    pub t_ns: u64,
    /// Maximum error of `t_ns` toward earlier, ns: that of the clocks between its source and here. `None`:
    /// not known, and `t_ns` is in the sender's clock. It is not sent; the receiver sets both.
    #[serde(skip)]
    pub t_error_ns: Option<u64>,
    /// Joint angle, rad.
    pub angle_rad: f32,
    /// Joint velocity, rad/s.
    pub velocity_rad_s: f32,
    /// Torque that the device reports, Nm.
    pub torque_nm: f32,
    /// Temperature of the motor, degrees Celsius.
    pub temperature_c: i8,
    /// Device flags; bit 0: the device's own watchdog has taken over.
    pub flags: u8,
}

/// From the ankle's sensor to central, each millisecond.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct FootLoad {
    /// Counts up by one with each sample, wraps.
    pub seq: u32,
    /// Time at which the sole was read, ns.
    pub t_ns: u64,
    /// Maximum error of `t_ns` toward earlier, ns: that of the clocks between its source and here. `None`:
    /// not known, and `t_ns` is in the sender's clock. It is not sent; the receiver sets both.
    #[serde(skip)]
    pub t_error_ns: Option<u64>,
    /// Vertical load under the heel, N.
    pub heel_n: f32,
    /// Vertical load under the forefoot, N.
    pub toe_n: f32,
}

/// Whether the foot carries load.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(into = "u8", try_from = "u8")]
pub enum Stance {
    /// In the air (0).
    Swing,
    /// On the ground (1).
    Stance,
}

/// The command for the drives.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(into = "u8", try_from = "u8")]
pub enum GaitMode {
    /// Complete but not released: torque zero (0).
    Hold,
    /// Released; the phase estimate is still settling: torque zero (1).
    Sync,
    /// Assist at the estimated phase (2).
    Walk,
    /// A part is missing: damp softly (3).
    Safe,
    /// The e-stop was pressed: ramp the torque to zero and keep it there until reset (4).
    Stop,
}

/// From central to the three drives, each millisecond.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct GaitState {
    /// Counts up by one with each message of an epoch, wraps.
    pub seq: u32,
    /// Time at which the state was computed, ns.
    pub t_ns: u64,
    /// Maximum error of `t_ns` toward earlier, ns: that of the clocks between its source and here. `None`:
    /// not known, and `t_ns` is in the sender's clock. It is not sent; the receiver sets both.
    #[serde(skip)]
    pub t_error_ns: Option<u64>,
    /// Estimated phase, cycles 0..1; 0 is heel strike.
    pub phase: f32,
    /// Estimated phase rate, cycles per second.
    pub phase_rate_hz: f32,
    /// Whether the foot carries load.
    pub stance: Stance,
    /// The command for the drives.
    pub mode: GaitMode,
    /// Trust in the phase, 0..1; 1 is full.
    pub confidence: f32,
    /// Grows with each new start of central; older ones are rejected.
    pub epoch: u32,
    /// Joints that walk without their drive's assistance; bit 0 hip, bit 1 knee, bit 2 ankle.
    pub degraded: u8,
}

/// From central or the operator to a drive, at any time: the moment to feed forward in place of the drive's
/// own curve.
///
/// A drive uses it for at most 10 ms, and only if it is close to its own value at that phase.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct TorqueSet {
    /// Counts up by one with each message, wraps.
    pub seq: u32,
    /// Time at which it was computed, ns.
    pub t_ns: u64,
    /// Maximum error of `t_ns` toward earlier, ns: that of the clocks between its source and here. `None`:
    /// not known, and `t_ns` is in the sender's clock. It is not sent; the receiver sets both.
    #[serde(skip)]
    pub t_error_ns: Option<u64>,
    /// Moment to feed forward, Nm.
    pub torque_nm: f32,
    /// Grows with each new start of its sender; older ones are rejected.
    pub epoch: u32,
}

/// State of a drive.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(into = "u8", try_from = "u8")]
pub enum DriveState {
    /// Inputs not yet complete; nothing is sent to the device (0).
    Init,
    /// Inputs fresh, not assisting: torque zero (1).
    Ready,
    /// Assisting (2).
    Walk,
    /// Inputs lost or a part missing: torque ramps to soft damping (3).
    Safe,
    /// Stopped; torque ramps to zero and stays there until reset (4).
    EStop,
}

/// From each drive to central, 200 times a second, and to its watchers, 20 times a second.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct DriveStatus {
    /// Counts up by one with each message, wraps.
    pub seq: u32,
    /// Time of the status, ns.
    pub t_ns: u64,
    /// Maximum error of `t_ns` toward earlier, ns: that of the clocks between its source and here. `None`:
    /// not known, and `t_ns` is in the sender's clock. It is not sent; the receiver sets both.
    #[serde(skip)]
    pub t_error_ns: Option<u64>,
    /// State of the drive.
    pub state: DriveState,
    /// Bits of [`crate::control::faults::FaultBits`].
    pub faults: u16,
    /// Commanded torque, Nm.
    pub torque_nm: f32,
    /// Maximum age of an input at its use since the last status, us; `None`: none was used.
    pub age_max_us: Option<u32>,
    /// Ticks without fresh inputs since the start.
    pub misses: u32,
    /// Torques from outside that were accepted since the start.
    pub commands_taken: u32,
    /// Torques from outside that were rejected since the start.
    pub commands_refused: u32,
}

/// An input that a drive has used in a tick.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct UsedInput {
    /// Its sequence number.
    pub seq: u32,
    /// The epoch of central; 0 for a sample.
    pub epoch: u32,
    /// When it was sent, ns of this drive's clock: the time that the drive has computed with.
    pub t_ns: u64,
    /// Maximum error of `t_ns` toward earlier, ns; `None`: not known.
    pub t_error_ns: Option<u64>,
}

impl From<&JointSample> for UsedInput {
    fn from(sample: &JointSample) -> Self {
        let JointSample { seq, t_ns, t_error_ns, .. } = *sample;
        Self { seq, epoch: 0, t_ns, t_error_ns }
    }
}

impl From<&GaitState> for UsedInput {
    fn from(gait: &GaitState) -> Self {
        let GaitState { seq, epoch, t_ns, t_error_ns, .. } = *gait;
        Self { seq, epoch, t_ns, t_error_ns }
    }
}

/// From each drive to the group `exo.ticks`, each millisecond of a run that is recorded: the inputs of a tick and its
/// result. With it, and with the inputs themselves, the tick can be computed again.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct DriveTick {
    /// The joint: 0 hip, 1 knee, 2 ankle.
    pub joint: u8,
    /// The number of the tick since the drive's start, from 1.
    pub seq: u32,
    /// Time of the tick, ns of this host's monotonic clock.
    pub t_ns: u64,
    /// Its lateness, us.
    pub late_us: u32,
    /// State of the drive before the tick.
    pub before: DriveState,
    /// Whether central's commands did not count.
    pub is_shut: bool,
    /// The joint sample that was used.
    pub sample: Option<UsedInput>,
    /// The gait state that was used.
    pub gait: Option<UsedInput>,
    /// The gains that were used; `None`: the standard ones of the joint.
    pub gains: Option<Gains>,
    /// Computed torque, Nm; `None` while the drive does not know its device's torque. It reaches the device while
    /// central's commands count, or on its way to zero.
    pub torque_nm: Option<f64>,
    /// Gain of assistance, 0..1.
    pub assist_gain: f64,
    /// State of the drive after the tick.
    pub state: DriveState,
    /// When the device was ordered to damp by itself in this tick, ns; `None`: it was not.
    pub damped_at_ns: Option<u64>,
}

impl Payload for JointSample {
    const NAME: &'static str = "exo.joint_sample";
    const CLASS: Class = Class::Stream;
}

impl Payload for FootLoad {
    const NAME: &'static str = "exo.foot_load";
    const CLASS: Class = Class::Stream;
}

impl Payload for GaitState {
    const NAME: &'static str = "exo.gait_state";
    const CLASS: Class = Class::Stream;
    /// It causes torque, so it is protected from central's gait to each drive. A drive uses a command for 10
    /// ms, as the next one may be late or lost. The drive's clock that central quotes is at most one echo
    /// period, the network latency and one tick of its own (1 ms) old.
    const PROTECTION: Option<Protection> = Some(Protection {
        within: Duration::from_millis(10),
        age_max: Duration::from_millis(60),
        lost_max: 9,
        bad_max: 1,
        good_min: 8,
    });
}

/// Not protected end to end, although it affects torque: a guard knows one sender, and any application on
/// central's node may send this. So the limit is in the drive, not at the sender.
///
/// - [`DriveCore::command`](crate::control::drive::DriveCore::command) rejects a moment that is further than
///   10 Nm (`command_apart_max_nm`) from the drive's own feed-forward.
/// - Each tick limits the newest one to that range again, as the phase advances.
/// - It counts for 10 ms (`input_age_max_ns`), and only in WALK, which needs the open guard of [`GaitState`].
/// - The limits of the joint's torque and of its rate apply.
/// - A sender outside central's node is rejected.
///
/// So a damaged one changes a joint's moment by at most 10 Nm, and cannot make a drive assist that does not.
/// The same holds for one forged past the node's checksum, TLS and access list. See the example's README.md,
/// "Safety states".
impl Payload for TorqueSet {
    const NAME: &'static str = "exo.torque_set";
    const CLASS: Class = Class::Stream;
}

impl Payload for DriveStatus {
    const NAME: &'static str = "exo.drive_status";
    const CLASS: Class = Class::Stream;
}

impl Payload for DriveTick {
    const NAME: &'static str = "exo.drive_tick";
    const CLASS: Class = Class::Stream;
}

macro_rules! wire_byte {
    ($kind:ident: $($value:literal => $variant:ident),+) => {
        impl From<$kind> for u8 {
            fn from(value: $kind) -> Self {
                match value { $($kind::$variant => $value),+ }
            }
        }
        impl TryFrom<u8> for $kind {
            type Error = String;
            fn try_from(byte: u8) -> Result<Self, String> {
                match byte {
                    $($value => Ok(Self::$variant),)+
                    other => Err(format!(concat!("{} is no ", stringify!($kind)), other)),
                }
            }
        }
    };
}

wire_byte!(Stance: 0 => Swing, 1 => Stance);
wire_byte!(GaitMode: 0 => Hold, 1 => Sync, 2 => Walk, 3 => Safe, 4 => Stop);
wire_byte!(DriveState: 0 => Init, 1 => Ready, 2 => Walk, 3 => Safe, 4 => EStop);
