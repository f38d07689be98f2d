//! The limits of a type of protected payloads.

use std::time::Duration;

/// The limits of errors that a receiver of protected messages tolerates.
///
/// # Examples
///
/// ```
/// use sinew::{prelude::*, protection::Protection, serde::{Deserialize, Serialize}};
///
/// #[derive(Serialize, Deserialize)]
/// #[serde(crate = "sinew::serde")]
/// struct Torque { newton_metres: f32 }
///
/// impl Payload for Torque {
///     const NAME: &'static str = "demo.torque";
///     const CLASS: Class = Class::Stream;
///     /// One each 5 ms, of which no more than one in a row may be missing.
///     const PROTECTION: Option<Protection> =
///         Some(Protection { lost_max: 1, ..Protection::of_period(Duration::from_millis(5)) });
/// }
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Protection {
    /// Maximum time from one good message to the next.
    pub within: Duration,
    /// Maximum age of a message, measured in the receiver's clock: from an echo that it sent to the arrival
    /// of the message that quotes it. So it includes the latency of the echo, the time until the sender sends
    /// next, the latency of the message, and the echo's period.
    pub age_max: Duration,
    /// Maximum number of consecutive messages that may be missing.
    pub lost_max: u64,
    /// Maximum number of bad messages among the last 64; none of them is used.
    pub bad_max: u32,
    /// Consecutive good messages before the output may be armed, at least 1: with no bad one among them, and
    /// each less than `within` after the previous.
    pub good_min: u32,
}

impl Protection {
    /// Returns limits for one message per `period`. Two may be late or missing, one in 64 may be bad, and the
    /// output may be armed after eight good ones.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::{prelude::*, protection::Protection};
    ///
    /// let limits = Protection::of_period(Duration::from_millis(5));
    /// assert_eq!(limits.within, Duration::from_millis(15));
    /// assert_eq!(limits.age_max, Duration::from_millis(40));
    /// ```
    #[must_use]
    pub const fn of_period(period: Duration) -> Self {
        let within = period.saturating_mul(3);
        let age_max = period.saturating_mul(8);
        Self { within, age_max, lost_max: 2, bad_max: 1, good_min: 8 }
    }

    /// Returns the time between two echoes: a quarter of the maximum age.
    #[must_use]
    pub const fn echo_period(&self) -> Duration {
        Duration::from_nanos((self.age_max.as_nanos() / 4) as u64)
    }
}
