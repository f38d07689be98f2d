//! Where in each period of the host's clock the loops tick, so that each finds young inputs.
//!
//! ```text
//!  0          150         300          400                       1000 us
//!  plant      sensors     gait         drives                    plant
//!   readings ──► samples ──► commands ──► torques ─────────────────►
//! ```
//!
//! With phases by chance each input is up to a period old. Timers that are due fire before messages, so each
//! slot is later than the one before it by more than a usual wake (60 us) and a tick.
//!
//! On hosts with clocks of their own, only the slots of one node keep their distance.

use std::time::Duration;

use sinew::Time;

use super::PERIOD;

/// The plant's step, after which it sends the readings.
pub const PLANT: Duration = Duration::ZERO;
/// A sensor's tick: the reading has come.
pub const SENSOR: Duration = Duration::from_micros(150);
/// The tick of central's gait: the samples of all joints have come.
pub const GAIT: Duration = Duration::from_micros(300);
/// A drive's tick: the sample and central's command have come.
pub const DRIVE: Duration = Duration::from_micros(400);

/// Returns the first time after `now` in this slot.
pub(super) fn next(now: Time, slot: Duration) -> Time {
    let period_ns = PERIOD.as_nanos() as u64;
    let begun = Time::from_nanos(now.as_nanos() / period_ns * period_ns);
    let at = begun + slot;
    if at > now { at } else { at + PERIOD }
}
