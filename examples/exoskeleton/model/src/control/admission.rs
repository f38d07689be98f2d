//! The inputs that a core accepts: finite, plausible, newer than the last, young enough. The rest is counted.

use super::faults::RefusedCount;
use crate::message::{GaitState, JointSample, TorqueSet};

/// Jump of a sequence number beyond which it counts as an older one.
const SEQUENCE_AHEAD_MAX: u32 = u32::MAX / 2;
const ANGLE_LARGEST_RAD: f32 = 3.2;
const VELOCITY_LARGEST_RAD_S: f32 = 50.0;
const TORQUE_LARGEST_NM: f32 = 500.0;
/// Above the limit of any device.
const COMMAND_LARGEST_NM: f32 = 60.0;
const PHASE_RATE_LARGEST_HZ: f32 = 5.0;

/// The time and order of an input among those of its sender.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Stamp {
    /// Time of creation, ns.
    pub t_ns: u64,
    /// Maximum error of that time toward earlier, ns; `None` if it is not known.
    pub t_error_ns: Option<u64>,
    /// Sequence number; wraps.
    pub seq: u32,
    /// Incarnation of its sender; newer ones precede older ones regardless of the sequence. 0 if the sender
    /// has none.
    pub epoch: u32,
}

impl Stamp {
    /// The earliest possible time of creation, ns; `None` if it is not known.
    #[must_use]
    pub fn earliest_ns(&self) -> Option<u64> {
        self.t_error_ns.map(|error_ns| self.t_ns.saturating_sub(error_ns))
    }

    /// The greatest possible age, ns; `None` if it is not known.
    #[must_use]
    pub fn age_at_most_ns(&self, now_ns: u64) -> Option<u64> {
        self.t_error_ns.map(|error_ns| now_ns.saturating_sub(self.t_ns).saturating_add(error_ns))
    }

    /// Whether it may be older than this; true for an unknown age.
    #[must_use]
    pub fn is_older_than(&self, limit_ns: u64, now_ns: u64) -> bool {
        self.age_at_most_ns(now_ns).is_none_or(|age_ns| age_ns > limit_ns)
    }
}

/// An input that can be judged before use.
pub trait Stamped: Copy {
    /// Time and order of creation.
    fn stamp(&self) -> Stamp;
    /// Whether all numbers are finite.
    fn is_finite(&self) -> bool;
    /// Whether a walking leg can have these values.
    fn is_plausible(&self) -> bool;
}

/// The reason for rejecting an input.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Refusal {
    NotFinite,
    OutOfRange,
    OldSequence,
    TooOld,
    FromFuture,
}

/// Keeps the newest admitted input of one kind.
#[derive(Debug, Clone)]
pub struct Admission<T> {
    age_max_ns: u64,
    newest: Option<T>,
    is_believed: bool,
    refused: RefusedCount,
}

impl<T: Stamped> Admission<T> {
    /// Admits inputs not older than `age_max_ns`.
    #[must_use]
    pub const fn new(age_max_ns: u64) -> Self {
        let refused = RefusedCount {
            not_finite: 0,
            out_of_range: 0,
            old_sequence: 0,
            too_old: 0,
            from_future: 0,
            opposed: 0,
        };
        Self { age_max_ns, newest: None, is_believed: true, refused }
    }

    /// Judges an input. The same input may be offered repeatedly; that does not count as a rejection. Returns
    /// whether a new input was admitted.
    pub fn offer(&mut self, now_ns: u64, input: &T) -> bool {
        if self.is_repeat(input) {
            return false;
        }
        match self.judge(now_ns, input) {
            Ok(()) => {
                self.newest = Some(*input);
                self.is_believed = true;
                true
            }
            Err(refusal) => {
                self.count(refusal);
                false
            }
        }
    }

    /// Rejects an input that is sane in itself but the opposite of the required direction.
    pub const fn refuse_opposed(&mut self) {
        self.refused.opposed = self.refused.opposed.saturating_add(1);
    }

    /// Discards the admitted input: its path is not trusted any more. Older ones stay rejected.
    pub const fn distrust(&mut self) {
        self.is_believed = false;
    }

    /// The newest admitted input if it is certainly within the age limit now, and was not discarded.
    #[must_use]
    pub fn fresh(&self, now_ns: u64) -> Option<&T> {
        let newest = self.newest.as_ref().filter(|_| self.is_believed);
        newest.filter(|input| !input.stamp().is_older_than(self.age_max_ns, now_ns))
    }

    /// The newest admitted input, of any age.
    #[must_use]
    pub const fn newest(&self) -> Option<&T> {
        self.newest.as_ref()
    }

    /// Age of the newest admitted input, ns, as far as it is known.
    #[must_use]
    pub fn age_ns(&self, now_ns: u64) -> Option<u64> {
        self.newest.as_ref().map(|input| now_ns.saturating_sub(input.stamp().t_ns))
    }

    /// Rejections so far.
    #[must_use]
    pub const fn refused(&self) -> &RefusedCount {
        &self.refused
    }

    fn is_repeat(&self, input: &T) -> bool {
        self.newest.as_ref().is_some_and(|held| held.stamp() == input.stamp())
    }

    fn judge(&self, now_ns: u64, input: &T) -> Result<(), Refusal> {
        if !input.is_finite() {
            return Err(Refusal::NotFinite);
        }
        if !input.is_plausible() {
            return Err(Refusal::OutOfRange);
        }
        let stamp = input.stamp();
        let is_known = stamp.t_error_ns.is_some();
        if is_known && stamp.t_ns > now_ns.saturating_add(self.age_max_ns) {
            return Err(Refusal::FromFuture);
        }
        if stamp.is_older_than(self.age_max_ns, now_ns) {
            return Err(Refusal::TooOld);
        }
        if self.follows(now_ns, input) { Ok(()) } else { Err(Refusal::OldSequence) }
    }

    /// Whether the input comes after the one held. A sender without epochs that restarted counts from zero
    /// again: it is accepted once its predecessor is over the age limit and its stamp is later.
    fn follows(&self, now_ns: u64, input: &T) -> bool {
        let Some(held) = &self.newest else { return true };
        let (input, held) = (input.stamp(), held.stamp());
        if input.epoch != held.epoch {
            return input.epoch > held.epoch;
        }
        let ahead = input.seq.wrapping_sub(held.seq);
        let later = input.t_ns > held.t_ns;
        later && ((1..=SEQUENCE_AHEAD_MAX).contains(&ahead) || self.fresh(now_ns).is_none())
    }

    const fn count(&mut self, refusal: Refusal) {
        let counter = match refusal {
            Refusal::NotFinite => &mut self.refused.not_finite,
            Refusal::OutOfRange => &mut self.refused.out_of_range,
            Refusal::OldSequence => &mut self.refused.old_sequence,
            Refusal::TooOld => &mut self.refused.too_old,
            Refusal::FromFuture => &mut self.refused.from_future,
        };
        *counter = counter.saturating_add(1);
    }
}

impl Stamped for JointSample {
    fn stamp(&self) -> Stamp {
        Stamp { t_ns: self.t_ns, t_error_ns: self.t_error_ns, seq: self.seq, epoch: 0 }
    }
    fn is_finite(&self) -> bool {
        self.angle_rad.is_finite() && self.velocity_rad_s.is_finite() && self.torque_nm.is_finite()
    }
    fn is_plausible(&self) -> bool {
        self.angle_rad.abs() <= ANGLE_LARGEST_RAD
            && self.velocity_rad_s.abs() <= VELOCITY_LARGEST_RAD_S
            && self.torque_nm.abs() <= TORQUE_LARGEST_NM
    }
}

impl Stamped for GaitState {
    fn stamp(&self) -> Stamp {
        Stamp { t_ns: self.t_ns, t_error_ns: self.t_error_ns, seq: self.seq, epoch: self.epoch }
    }
    fn is_finite(&self) -> bool {
        self.phase.is_finite() && self.phase_rate_hz.is_finite() && self.confidence.is_finite()
    }
    fn is_plausible(&self) -> bool {
        (0.0..=1.0).contains(&self.phase)
            && self.phase_rate_hz.abs() <= PHASE_RATE_LARGEST_HZ
            && (0.0..=1.0).contains(&self.confidence)
    }
}

impl Stamped for TorqueSet {
    fn stamp(&self) -> Stamp {
        Stamp { t_ns: self.t_ns, t_error_ns: self.t_error_ns, seq: self.seq, epoch: self.epoch }
    }
    fn is_finite(&self) -> bool {
        self.torque_nm.is_finite()
    }
    fn is_plausible(&self) -> bool {
        self.torque_nm.abs() <= COMMAND_LARGEST_NM
    }
}
