//! The motion that the person intends: joint angles with derivatives, muscle moments and contact load by
//! time.
//!
//! Before walking the person stands; at time 0 walking starts with a heel strike, blended in over
//! [`ONSET_S`].

use std::sync::Arc;

use thiserror::Error;

use crate::chance::Chance;
use crate::gait::curves::{self, STRIDE_DEVIATION_S, STRIDE_MEAN_S};
use crate::gait::trial::Trial;
use crate::joint::{Joint, PerJoint};

/// Time from standing to the full walking motion, seconds.
pub const ONSET_S: f64 = 1.0;
/// Strides at the beginning of a trial that are skipped: the belt is still accelerating.
const TRIAL_STRIDES_SKIPPED: usize = 2;
/// Strides for which durations are drawn; beyond them every stride has the mean duration (3.7 hours of walking).
const STRIDES_DRAWN_MAX: u32 = 10_000;
/// Quiet standing as recorded before the belt starts, rad: 3.7, 11.0 and 0.0 degrees.
const STANDING_RAD: PerJoint<f64> = [0.064_577, 0.191_986, 0.0];
/// Share of the body weight on this leg while standing on both.
const STANDING_LOAD_BW: f64 = 0.5;

/// The intended motion at one instant.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Intended {
    /// Joint angles, rad.
    pub angle_rad: PerJoint<f64>,
    /// Joint velocities, rad/s.
    pub velocity_rad_s: PerJoint<f64>,
    /// Joint accelerations, rad/s2.
    pub acceleration_rad_s2: PerJoint<f64>,
    /// Moments of a healthy person's muscles, Nm per kg of body mass.
    pub moment_nm_per_kg: PerJoint<f64>,
    /// Vertical load under the foot, body weights.
    pub vertical_load_bw: f64,
    /// Strides since walking began: the whole part counts, the rest is the true phase; 0 while standing.
    pub strides: f64,
    /// True strides per second; 0 while standing.
    pub rate_hz: f64,
}

/// The reason why an intention does not suffice for a run.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum IntentionError {
    /// The trial ends before the run does.
    #[error(
        "the trial holds {available} usable strides, the run wants {wanted}; use --strides {available} or a longer trial"
    )]
    TrialTooShort {
        /// Usable strides of the trial.
        available: u32,
        /// Strides requested.
        wanted: u32,
    },
}

/// The source of the intended motion.
#[derive(Debug, Clone)]
pub struct Intention {
    source: Source,
    onset_s: f64,
}

#[derive(Debug, Clone)]
enum Source {
    /// Mean curves at drawn stride durations.
    Curves(StrideClock),
    /// A recorded trial from `first_s` of its file on.
    Trial { trial: Arc<Trial>, first_s: f64, skipped: usize },
}

/// Motion of the joints before the onset is blended in.
struct Motion {
    angle: PerJoint<f64>,
    velocity: PerJoint<f64>,
    acceleration: PerJoint<f64>,
    load_bw: f64,
    strides: f64,
    rate_hz: f64,
}

impl Intention {
    /// Walks the built-in mean curves; stride durations vary as recorded (mean 1.328 s, deviation 0.028 s), drawn
    /// from `seed`.
    #[must_use]
    pub fn from_curves(seed: u64) -> Self {
        Self { source: Source::Curves(StrideClock::drawn(seed)), onset_s: ONSET_S }
    }

    /// Walks a recorded trial from its third heel strike on.
    #[must_use]
    pub fn from_trial(trial: Arc<Trial>) -> Self {
        let first_s = trial.heel_strikes_s()[TRIAL_STRIDES_SKIPPED];
        Self { source: Source::Trial { trial, first_s, skipped: TRIAL_STRIDES_SKIPPED }, onset_s: ONSET_S }
    }

    /// The same motion without the blend from standing: full walking from time 0, for comparison with a reference.
    #[must_use]
    pub fn without_onset(self) -> Self {
        Self { onset_s: 0.0, ..self }
    }

    /// The parts of the recorded trial that were omitted or bridged, a sentence each.
    #[must_use]
    pub fn notes(&self) -> &[String] {
        match &self.source {
            Source::Curves(_) => &[],
            Source::Trial { trial, .. } => trial.notes(),
        }
    }

    /// Checks that `wanted` strides can be walked.
    ///
    /// # Errors
    /// [`IntentionError::TrialTooShort`] if the trial ends earlier.
    pub fn check_strides(&self, wanted: u32) -> Result<(), IntentionError> {
        match &self.source {
            Source::Curves(_) => Ok(()),
            Source::Trial { trial, skipped, .. } => {
                let available = u32::try_from(trial.heel_strikes_s().len() - 1 - skipped).unwrap_or(u32::MAX);
                if wanted <= available {
                    Ok(())
                } else {
                    Err(IntentionError::TrialTooShort { available, wanted })
                }
            }
        }
    }

    /// The intended motion `time_s` after walking began; standing before that. After its last heel strike a trial
    /// freezes in its last posture.
    #[must_use]
    pub fn at(&self, time_s: f64) -> Intended {
        if time_s < 0.0 {
            return standing();
        }
        let motion = self.motion(time_s);
        let [blend, rate, bend] = onset(time_s, self.onset_s);
        let mut intended = Intended {
            strides: motion.strides,
            rate_hz: motion.rate_hz,
            vertical_load_bw: STANDING_LOAD_BW * (1.0 - blend) + motion.load_bw * blend,
            ..standing()
        };
        for joint in Joint::ALL {
            let i = joint.index();
            let away = motion.angle[i] - STANDING_RAD[i];
            intended.angle_rad[i] += blend * away;
            intended.velocity_rad_s[i] = rate * away + blend * motion.velocity[i];
            intended.acceleration_rad_s2[i] =
                bend * away + 2.0 * rate * motion.velocity[i] + blend * motion.acceleration[i];
            intended.moment_nm_per_kg[i] = blend * curves::moment_nm_per_kg(joint, motion.strides);
        }
        intended
    }

    fn motion(&self, time_s: f64) -> Motion {
        match &self.source {
            Source::Curves(clock) => clock.motion(time_s),
            Source::Trial { trial, first_s, skipped } => trial_motion(trial, first_s + time_s, *skipped),
        }
    }
}

/// Standing: the ground and the other leg carry this one, so the joints need no moment.
fn standing() -> Intended {
    Intended {
        angle_rad: STANDING_RAD,
        velocity_rad_s: [0.0; 3],
        acceleration_rad_s2: [0.0; 3],
        moment_nm_per_kg: [0.0; 3],
        vertical_load_bw: STANDING_LOAD_BW,
        strides: 0.0,
        rate_hz: 0.0,
    }
}

/// Smooth step from 0 to 1 over `onset_s` with its first and second derivative by time.
fn onset(time_s: f64, onset_s: f64) -> [f64; 3] {
    if time_s >= onset_s {
        return [1.0, 0.0, 0.0];
    }
    let x = time_s / onset_s;
    [
        x * x * x * (10.0 + x * (-15.0 + 6.0 * x)),
        30.0 * x * x * (1.0 - x) * (1.0 - x) / onset_s,
        60.0 * x * (1.0 - x) * (1.0 - 2.0 * x) / (onset_s * onset_s),
    ]
}

fn trial_motion(trial: &Trial, file_s: f64, skipped: usize) -> Motion {
    let last_s = trial.heel_strikes_s()[trial.heel_strikes_s().len() - 1];
    let ended = file_s >= last_s;
    let points = Joint::ALL.map(|joint| trial.angle_rad(joint, file_s.min(last_s)));
    let (strides, rate_hz) = trial.strides_at(file_s);
    Motion {
        angle: points.map(|p| p.value),
        velocity: points.map(|p| if ended { 0.0 } else { p.slope }),
        acceleration: points.map(|p| if ended { 0.0 } else { p.curvature }),
        load_bw: trial.vertical_load_bw(file_s.min(last_s)),
        strides: strides - skipped as f64,
        rate_hz,
    }
}

/// Phase by time with drawn stride durations; phase, rate and its derivative are continuous.
#[derive(Debug, Clone)]
struct StrideClock {
    /// Start of each stride, seconds; rising.
    starts_s: Vec<f64>,
}

impl StrideClock {
    fn drawn(seed: u64) -> Self {
        let mut chance = Chance::for_purpose(seed, 1);
        let mut starts_s = vec![0.0];
        let mut now_s = 0.0;
        for _ in 0..STRIDES_DRAWN_MAX {
            now_s += STRIDE_MEAN_S + STRIDE_DEVIATION_S * chance.normal().clamp(-3.0, 3.0);
            starts_s.push(now_s);
        }
        Self { starts_s }
    }

    fn motion(&self, time_s: f64) -> Motion {
        let [strides, rate_hz, rate_change] = self.phase(time_s);
        let points = Joint::ALL.map(|joint| curves::angle_rad(joint, strides));
        Motion {
            angle: points.map(|p| p.value),
            velocity: points.map(|p| p.slope * rate_hz),
            acceleration: points.map(|p| p.curvature * rate_hz * rate_hz + p.slope * rate_change),
            load_bw: curves::vertical_load_bw(strides),
            strides,
            rate_hz,
        }
    }

    /// Strides since the start, strides per second, and its change per second: a quintic in each stride that
    /// joins its neighbours with the mean of both rates and no acceleration.
    fn phase(&self, time_s: f64) -> [f64; 3] {
        let i = self.starts_s.partition_point(|s| *s <= time_s).clamp(1, self.starts_s.len() - 1) - 1;
        let duration = self.duration_s(i);
        // At the ends the neighbour is missing; the stride then counts as its own neighbour.
        let before = self.duration_s(i.saturating_sub(1));
        let after = self.duration_s((i + 1).min(self.starts_s.len() - 2));
        let enter = 0.5 * (1.0 + duration / before);
        let leave = 0.5 * (1.0 + duration / after);
        let x = (time_s - self.starts_s[i]) / duration;
        let c3 = 10.0 - 6.0 * enter - 4.0 * leave;
        let c4 = -15.0 + 8.0 * enter + 7.0 * leave;
        let c5 = 6.0 - 3.0 * enter - 3.0 * leave;
        let value = x * (enter + x * x * (c3 + x * (c4 + x * c5)));
        let rate = enter + x * x * (3.0 * c3 + x * (4.0 * c4 + x * 5.0 * c5));
        let change = x * (6.0 * c3 + x * (12.0 * c4 + x * 20.0 * c5));
        [i as f64 + value, rate / duration, change / (duration * duration)]
    }

    fn duration_s(&self, stride: usize) -> f64 {
        self.starts_s[stride + 1] - self.starts_s[stride]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn phase_and_rate_are_continuous_and_rise() {
        let clock = StrideClock::drawn(3);
        let mut before = clock.phase(0.0);
        for ms in 1..30_000 {
            let now = clock.phase(f64::from(ms) * 1e-3);
            assert!(now[1] > 0.6 && now[1] < 0.9, "rate {} at {ms} ms", now[1]);
            assert!((now[0] - before[0] - 1e-3 * now[1]).abs() < 1e-6);
            assert!((now[1] - before[1]).abs() < 1e-3);
            before = now;
        }
    }

    #[test]
    fn velocity_and_acceleration_are_the_derivatives_of_the_angle() {
        let trial = Trial::parse(include_str!("../../data/gait_trial_moore2015_s15_pre.csv")).unwrap();
        for intention in [Intention::from_curves(1), Intention::from_trial(Arc::new(trial))] {
            for time_s in [0.3, 0.9, 1.7, 7.123] {
                let h = 1e-5;
                let (a, b, c) = (intention.at(time_s - h), intention.at(time_s), intention.at(time_s + h));
                for i in 0..3 {
                    let velocity = (c.angle_rad[i] - a.angle_rad[i]) / (2.0 * h);
                    let acceleration = (c.velocity_rad_s[i] - a.velocity_rad_s[i]) / (2.0 * h);
                    assert!((velocity - b.velocity_rad_s[i]).abs() < 1e-4);
                    assert!((acceleration - b.acceleration_rad_s2[i]).abs() < 2e-2, "{acceleration}");
                }
            }
        }
    }

    #[test]
    fn standing_person_does_not_move_and_needs_no_moment() {
        let intended = Intention::from_curves(1).at(-0.5);
        assert_eq!(
            (intended.velocity_rad_s, intended.moment_nm_per_kg, intended.strides),
            ([0.0; 3], [0.0; 3], 0.0)
        );
    }
}
