//! Where in each period of the host's clock the loops tick, so that each finds the newest input, and the thread
//! of a joint wakes once for its sensor and its drive.
//!
//! ```text
//!  0        150      200                500                            1000 us
//!  plant    sensors  drives             central's gait                 plant
//!   readings ──►  samples ──►────────────►  commands ──► drives, in the next period
//! ```
//!
//! On hosts with clocks of their own the slots of one joint keep their order; those of different nodes do not.

use std::time::Duration;

use sinew::Time;

use super::PERIOD;

/// The plant's step, after which it sends the readings.
pub(super) const PLANT: Duration = Duration::ZERO;
/// A sensor's tick: the reading has come.
pub(super) const SENSOR: Duration = Duration::from_micros(150);
/// A drive's tick: the thread has just handled the sample, and has not slept since.
pub(super) const DRIVE: Duration = Duration::from_micros(200);
/// The tick of central's gait: the samples of all joints have come.
pub(super) const GAIT: Duration = Duration::from_micros(500);

/// Returns the first time after `now` in this slot.
pub(super) fn next(now: Time, slot: Duration) -> Time {
    let period_ns = PERIOD.as_nanos() as u64;
    let begun = Time::from_nanos(now.as_nanos() / period_ns * period_ns);
    let at = begun + slot;
    if at > now { at } else { at + PERIOD }
}
