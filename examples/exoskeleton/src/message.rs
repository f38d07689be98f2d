//! The messages between sensors, drives and the central unit: what crosses an edge, with units.
//!
//! Plain values; the nodes decide how they travel. Times are nanoseconds of one common clock, as far as it is known.

use serde::{Deserialize, Serialize};

/// From a joint's sensor to its own drive and to central, each millisecond.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct JointSample {
    /// Counts up by one with each sample, wraps.
    pub seq: u32,
    /// When the device was read, ns.
    pub t_ns: u64,
    /// How much earlier it may have been, at most, ns: the error of the clocks between where it was made and here. `None`: not known, and
    /// `t_ns` is a time of the sender's clock. It is not sent; the receiver sets both.
    #[serde(skip)]
    pub t_error_ns: Option<u64>,
    /// Joint angle, rad.
    pub angle_rad: f32,
    /// Joint velocity, rad/s.
    pub velocity_rad_s: f32,
    /// Torque the device says it gives, Nm.
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
    /// When the sole was read, ns.
    pub t_ns: u64,
    /// How much earlier it may have been, at most, ns: the error of the clocks between where it was made and here. `None`: not known, and
    /// `t_ns` is a time of the sender's clock. It is not sent; the receiver sets both.
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

/// What the drives are asked to do.
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
    /// The e-stop was pressed: torque to zero, and stay there until reset (4).
    Stop,
}

/// From central to the three drives, each millisecond.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct GaitState {
    /// Counts up by one with each message of an epoch, wraps.
    pub seq: u32,
    /// When the state was computed, ns.
    pub t_ns: u64,
    /// How much earlier it may have been, at most, ns: the error of the clocks between where it was made and here. `None`: not known, and
    /// `t_ns` is a time of the sender's clock. It is not sent; the receiver sets both.
    #[serde(skip)]
    pub t_error_ns: Option<u64>,
    /// Estimated phase, cycles 0..1; 0 is heel strike.
    pub phase: f32,
    /// Estimated phase rate, cycles per second.
    pub phase_rate_hz: f32,
    /// Whether the foot carries load.
    pub stance: Stance,
    /// What the drives shall do.
    pub mode: GaitMode,
    /// Trust in the phase, 0..1; 1 is full.
    pub confidence: f32,
    /// Grows with each new start of central; older ones are refused.
    pub epoch: u32,
    /// Joints that walk without their drive's help; bit 0 hip, bit 1 knee, bit 2 ankle.
    pub degraded: u8,
}

/// From central or the operator to a drive, at will: the moment to feed forward in place of the drive's own curve.
///
/// A drive uses it for at most 10 ms, and only when it is close to what the drive itself holds right at that phase.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct TorqueSet {
    /// Counts up by one with each message, wraps.
    pub seq: u32,
    /// When it was computed, ns.
    pub t_ns: u64,
    /// How much earlier it may have been, at most, ns: the error of the clocks between where it was made and here. `None`: not known, and
    /// `t_ns` is a time of the sender's clock. It is not sent; the receiver sets both.
    #[serde(skip)]
    pub t_error_ns: Option<u64>,
    /// Moment to feed forward, Nm.
    pub torque_nm: f32,
    /// Grows with each new start of its sender; older ones are refused.
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

/// From each drive to central and the recorder, 200 times a second.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct DriveStatus {
    /// Counts up by one with each message, wraps.
    pub seq: u32,
    /// When the status was taken, ns.
    pub t_ns: u64,
    /// How much earlier it may have been, at most, ns: the error of the clocks between where it was made and here. `None`: not known, and
    /// `t_ns` is a time of the sender's clock. It is not sent; the receiver sets both.
    #[serde(skip)]
    pub t_error_ns: Option<u64>,
    /// State of the drive.
    pub state: DriveState,
    /// Bits of [`crate::control::faults::FaultBits`].
    pub faults: u16,
    /// Commanded torque, Nm.
    pub torque_nm: f32,
    /// Greatest age of an input at its use since the last status, us; `None`: none was used.
    pub age_max_us: Option<u32>,
    /// Ticks without fresh inputs since the start.
    pub misses: u32,
    /// Torques from outside that were taken since the start.
    pub commands_taken: u32,
    /// Torques from outside that were refused since the start.
    pub commands_refused: u32,
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
