//! Queries of the traces of a run over a span of time.

use std::cmp::Reverse;
use std::collections::BTreeSet;
use std::io;
use std::ops::Range;
use std::path::Path;

use exoskeleton::robot::launch::Traces;
use exoskeleton::robot::sensor::SENSOR_LATE;
use exoskeleton::robot::trace::{DriveRow, EventRow, GaitRow, PlantRow};
use exoskeleton_model::control::torque_law::TorqueLaw;
use exoskeleton_model::joint::Joint;
use exoskeleton_model::message::DriveState;
use exoskeleton_model::part::Part;
use exoskeleton_recording::flight::{Frozen, SpanFiles};
use sinew::Time;

/// Lateness of a loop above which its host delayed it, us.
const STALL_US: u32 = 5_000;
/// A stall explains events this long before and after a late tick: messages wait that long, too.
const STALL_AROUND_NS: u64 = 60_000_000;
/// Half a step of the devices' torque.
const ROUNDING_NM: f64 = 0.02;
/// From entering the safe state to soft damping, ns: 60 Nm at 2000 Nm/s, and late ticks.
const SAFE_RAMP_NS: u64 = 80_000_000;
const SAFE_DAMPING_NMS_RAD: f64 = 1.0;
const SAFE_SLACK_NM: f64 = 1.0;
/// Window around a tick in which the velocity is searched that the device may have damped.
const VELOCITY_AROUND_NS: u64 = 30_000_000;

/// From a loss to the last tick that may use data from before it, ns: inputs of 10 ms, twice through central,
/// and late ticks.
pub(crate) const SAFE_AT_LATEST_NS: u64 = 50_000_000;

/// A span of the host's clock, ns.
pub(crate) type Span = Range<u64>;

/// All traces.
pub(crate) struct Evidence {
    traces: Traces,
    /// Times at which the host delayed a loop, ns.
    stalls: Vec<u64>,
    frozen: Frozen,
}

/// Milliseconds from `from` to `t_ns`.
pub(crate) fn ms_after(from: Time, t_ns: u64) -> f64 {
    (t_ns as f64 - from.as_nanos() as f64) * 1e-6
}

/// From one moment to another.
pub(crate) const fn span(from: Time, to: Time) -> Span {
    from.as_nanos()..to.as_nanos()
}

/// A loss, as a node's discovery reported it.
pub(crate) struct Loss<'a> {
    /// Milliseconds from the start of the span.
    pub(crate) after_ms: f64,
    pub(crate) why: &'a str,
    /// Milliseconds within which a silence must be detected.
    pub(crate) bound_ms: Option<f64>,
}

impl<'a> Loss<'a> {
    /// Parses the record of the watch: `LinkDown, silent for 97000 us of 120000 us`.
    fn read(after_ms: f64, how: &'a str) -> Self {
        let (why, words) = how.split_once(", ").unwrap_or((how, ""));
        let bound_us = words.rsplit_once(" of ").and_then(|(_, bound)| bound.strip_suffix(" us"));
        let bound_ms = bound_us.and_then(|us| us.parse::<f64>().ok()).map(|us| us * 1e-3);
        Self { after_ms, why, bound_ms }
    }
}

/// Sorted values.
pub(crate) struct Quantiles(Vec<u32>);

impl Quantiles {
    /// Returns the value that a share of them does not exceed.
    pub(crate) fn at(&self, share: f64) -> Option<f64> {
        let last = self.0.len().checked_sub(1)?;
        self.0.get((last as f64 * share).round() as usize).map(|value| f64::from(*value))
    }
}

impl Evidence {
    pub(crate) fn read(folder: &Path, stop: Time, frozen: Frozen) -> io::Result<Self> {
        let traces = Traces::read(folder, stop)?;
        let late = |t_ns: u64, late_us: u32| (late_us > STALL_US).then_some(t_ns);
        let mut stalls: Vec<u64> =
            traces.plant.iter().filter_map(|row| late(row.t_ns, row.late_us)).collect();
        stalls.extend(traces.gait.iter().filter_map(|row| late(row.t_ns, row.late_us)));
        stalls.extend(traces.drives.iter().flatten().flatten().filter_map(|row| late(row.t_ns, row.late_us)));
        let events = traces.events.values().flatten();
        stalls.extend(events.filter(|event| event.what == SENSOR_LATE).map(|event| event.t_ns));
        stalls.sort_unstable();
        Ok(Self { traces, stalls, frozen })
    }

    /// The span around this moment that most nodes have frozen; the earliest one of several.
    pub(crate) fn frozen_around(&self, at: Time) -> Option<&SpanFiles> {
        let at_ns = at.as_nanos();
        let spans = self.frozen.spans.iter().filter(|span| (span.begin_ns..=span.end_ns).contains(&at_ns));
        let nodes = |span: &SpanFiles| {
            span.files.iter().map(|file| file.node.as_str()).collect::<BTreeSet<_>>().len()
        };
        spans.max_by_key(|span| (nodes(span), Reverse(span.begin_ns)))
    }

    pub(crate) fn plant(&self, span: Span) -> &[PlantRow] {
        cut(&self.traces.plant, span, |row| row.t_ns)
    }

    pub(crate) fn gait(&self, span: Span) -> &[GaitRow] {
        cut(&self.traces.gait, span, |row| row.t_ns)
    }

    /// Rows of all incarnations of a drive.
    pub(crate) fn drive(&self, joint: Joint, span: Span) -> impl Iterator<Item = &DriveRow> {
        let incarnations = &self.traces.drives[joint.index()];
        incarnations.iter().flat_map(move |incarnation| cut(incarnation, span.clone(), |row| row.t_ns))
    }

    /// Incarnations of drives that started in the span.
    pub(crate) fn incarnations_begun(&self, span: &Span) -> usize {
        let begun =
            |incarnation: &&Vec<DriveRow>| incarnation.first().is_some_and(|row| span.contains(&row.t_ns));
        self.traces.drives.iter().flatten().filter(begun).count()
    }

    pub(crate) fn events(&self, part: Part, span: Span) -> impl Iterator<Item = &EventRow> {
        let events = self.traces.events.get(&part).map_or(&[][..], Vec::as_slice);
        events.iter().filter(move |event| span.contains(&event.t_ns))
    }

    /// Whether the host stood still around this moment.
    pub(crate) fn stalled_around(&self, t_ns: u64) -> bool {
        let i = self.stalls.partition_point(|at| at + STALL_AROUND_NS < t_ns);
        self.stalls.get(i).is_some_and(|at| *at <= t_ns + STALL_AROUND_NS)
    }

    /// Milliseconds from `from` until the drive is in `state`.
    pub(crate) fn state_after_ms(&self, joint: Joint, from: Time, state: DriveState) -> Option<f64> {
        let first = self.drive(joint, from.as_nanos()..u64::MAX).find(|row| row.state == state);
        first.map(|row| ms_after(from, row.t_ns))
    }

    /// Milliseconds from a loss until the drive is safe because of it. A drive that was safe already, since
    /// its host stood still, may walk for a last moment: its inputs from before the loss are not old yet.
    pub(crate) fn safe_after_ms(&self, joint: Joint, from: Time) -> Option<f64> {
        let soon = from.as_nanos()..from.as_nanos() + SAFE_AT_LATEST_NS;
        let unsafe_at = self.drive(joint, soon).filter(|row| row.state != DriveState::Safe).last();
        let since = unsafe_at.map_or(from, |row| Time::from_nanos(row.t_ns));
        self.state_after_ms(joint, since, DriveState::Safe).map(|ms| ms + ms_after(from, since.as_nanos()))
    }

    /// Milliseconds until a drive first commands an assisting torque in a span in which it restarts or
    /// continues.
    pub(crate) fn output_after_ms(&self, joint: Joint, span: Span) -> Option<f64> {
        let from = Time::from_nanos(span.start);
        let mut was_away = false;
        for row in self.drive(joint, span) {
            // The rows before the fault took effect: the kill was sent, but the drive still ran.
            was_away |= row.state != DriveState::Walk || row.torque_nm.is_none();
            if was_away && row.state == DriveState::Walk && row.torque_nm.is_some() {
                return Some(ms_after(from, row.t_ns));
            }
        }
        None
    }

    /// Ticks more than 2 ms late.
    pub(crate) fn misses(&self, joints: &[Joint], span: &Span) -> usize {
        let late = |joint: &Joint| self.drive(*joint, span.clone()).filter(|row| row.late_us > 2_000).count();
        joints.iter().map(late).sum()
    }

    /// Milliseconds from `from` until the device of a joint damps by its own watchdog.
    pub(crate) fn watchdog_after_ms(&self, joint: Joint, span: Span) -> Option<f64> {
        let from = Time::from_nanos(span.start);
        let first = self.plant(span).iter().find(|row| row.watchdog[joint.index()]);
        first.map(|row| ms_after(from, row.t_ns))
    }

    /// The first report of `part`'s discovery on the loss of `lost`.
    pub(crate) fn node_lost(&self, part: Part, lost: Part, span: Span) -> Option<Loss<'_>> {
        let from = Time::from_nanos(span.start);
        let mut events = self.events(part, span);
        let first = events.find(|event| event.what == "node_lost" && event.whom == lost.name())?;
        Some(Loss::read(ms_after(from, first.t_ns), &first.how))
    }

    /// Number of times that a drive left `Walk` for `Safe` although the host did not stand still.
    pub(crate) fn unexplained_safe(&self, joints: &[Joint], span: &Span) -> usize {
        let entered = |joint: &Joint| {
            let rows: Vec<&DriveRow> = self.drive(*joint, span.clone()).collect();
            let entries = rows.windows(2).filter(|pair| {
                pair[0].state == DriveState::Walk
                    && pair[1].state == DriveState::Safe
                    && !self.stalled_around(pair[1].t_ns)
            });
            entries.count()
        };
        joints.iter().map(entered).sum()
    }

    /// Ages of the gait states that the drives used, us.
    pub(crate) fn gait_ages_us(&self, span: &Span) -> Quantiles {
        let rows = Joint::ALL.into_iter().flat_map(|joint| self.drive(joint, span.clone()));
        let mut ages: Vec<u32> = rows.filter_map(|row| row.gait_age_us).collect();
        ages.sort_unstable();
        Quantiles(ages)
    }

    /// Share of the ticks of these drives in `state`, per cent, of the drive with the smallest; without those
    /// around a stall of the host.
    pub(crate) fn share_in_percent(&self, state: DriveState, joints: &[Joint], span: &Span) -> f64 {
        let share = |joint: &Joint| {
            let rows = self.drive(*joint, span.clone()).filter(|row| !self.stalled_around(row.t_ns));
            let (mut all, mut others) = (0_u32, 0_u32);
            for row in rows {
                all += 1;
                others += u32::from(row.state != state);
            }
            100.0 - 100.0 * f64::from(others) / f64::from(all.max(1))
        };
        joints.iter().map(share).fold(100.0, f64::min)
    }

    /// Ticks of these drives in another state than `state`.
    pub(crate) fn ticks_not_in(&self, state: DriveState, joints: &[Joint], span: &Span) -> usize {
        let others =
            |joint: &Joint| self.drive(*joint, span.clone()).filter(|row| row.state != state).count();
        joints.iter().map(others).sum()
    }

    /// Maximum torque that any drive commanded, Nm. Not right after a stall of the host: then the device has
    /// damped by itself, and its torque is ramped to zero.
    pub(crate) fn torque_max_nm(&self, span: &Span) -> f64 {
        Joint::ALL
            .into_iter()
            .flat_map(|joint| self.drive(joint, span.clone()))
            .filter(|row| !self.stalled_around(row.t_ns))
            .filter_map(|row| row.torque_nm)
            .map(f64::abs)
            .fold(0.0, f64::max)
    }

    /// Maximum gain of assistance of any drive, 0..1.
    pub(crate) fn gain_max(&self, span: &Span) -> f64 {
        let rows = Joint::ALL.into_iter().flat_map(|joint| self.drive(joint, span.clone()));
        rows.map(|row| row.assist_gain).fold(0.0, f64::max)
    }

    /// Fastest change of a torque in the drives' own time, Nm/s; a new incarnation reads its device first.
    pub(crate) fn torque_rate_max_nm_s(&self, span: &Span) -> f64 {
        let rate = |pair: &[DriveRow]| {
            let change = (pair[1].torque_nm? - pair[0].torque_nm?).abs();
            let dt_ns = pair[1].t_ns.checked_sub(pair[0].t_ns).filter(|dt_ns| *dt_ns > 0)?;
            Some(change / (dt_ns as f64 * 1e-9))
        };
        let incarnations = self.traces.drives.iter().flatten();
        incarnations
            .flat_map(|incarnation| {
                cut(incarnation, span.clone(), |row| row.t_ns).windows(2).filter_map(rate)
            })
            .fold(0.0, f64::max)
    }

    /// Maximum change of a device's torque within a millisecond, Nm. Not around a stall of the host, after
    /// which the plant merges many milliseconds into one.
    pub(crate) fn device_step_max_nm(&self, span: Span) -> f64 {
        let step = |pair: &[PlantRow]| {
            let steps = pair[0].applied_nm.iter().zip(pair[1].applied_nm).map(|(a, b)| (b - a).abs());
            steps.fold(0.0, f64::max)
        };
        let pairs = self.plant(span).windows(2).filter(|pair| !self.stalled_around(pair[1].t_ns));
        pairs.map(step).fold(0.0, f64::max)
    }

    /// Samples of a device above its limit, or of a command above it.
    pub(crate) fn above_limit(&self, span: &Span) -> usize {
        let limit = |joint: Joint| TorqueLaw::standard(joint).limit_nm + ROUNDING_NM;
        let given = self.plant(span.clone()).iter().map(|row| {
            Joint::ALL.into_iter().filter(|joint| row.applied_nm[joint.index()].abs() > limit(*joint)).count()
        });
        let commanded = Joint::ALL.into_iter().map(|joint| {
            let above = |row: &&DriveRow| row.torque_nm.is_some_and(|torque| torque.abs() > limit(joint));
            self.drive(joint, span.clone()).filter(above).count()
        });
        given.sum::<usize>() + commanded.sum::<usize>()
    }

    /// Torques, applied or commanded, that are NaN or infinite.
    pub(crate) fn not_finite(&self, span: &Span) -> usize {
        let given = self.plant(span.clone()).iter().flat_map(|row| row.applied_nm);
        let commanded = Joint::ALL.into_iter().flat_map(|joint| self.drive(joint, span.clone()));
        given.filter(|torque| !torque.is_finite()).count()
            + commanded.filter_map(|row| row.torque_nm).filter(|torque| !torque.is_finite()).count()
    }

    /// Samples of the torque of these drives' devices that exceed soft damping and 1 Nm. Counted for drives
    /// that are safe from the start of the span on, once their ramps are over. Not around a stall of the
    /// host, in which a device holds its torque. The drive's own record is no proof: it has no torque for a
    /// device that it ordered to damp.
    pub(crate) fn undamped(&self, joints: &[Joint], span: &Span) -> usize {
        let rows = self.plant(span.start.saturating_add(SAFE_RAMP_NS)..span.end);
        if rows.is_empty() {
            // No samples are no proof either.
            return joints.len();
        }
        let rows = rows.iter().filter(|row| !self.stalled_around(row.t_ns));
        let exceeds = |row: &PlantRow, joint: Joint| {
            row.applied_nm[joint.index()].abs() > self.damping_max_nm(joint, row.t_ns)
        };
        rows.map(|row| joints.iter().filter(|joint| exceeds(row, **joint)).count()).sum()
    }

    /// Samples of a device that damps by itself that exceed soft damping and 1 Nm, each time once its ramp is
    /// over.
    pub(crate) fn undamped_device(&self, joint: Joint, span: Span) -> usize {
        let rows = self.plant(span);
        let i = joint.index();
        if !rows.iter().any(|row| row.watchdog[i]) {
            // No samples are no proof.
            return rows.len().max(1);
        }
        let damping = rows.chunk_by(|a, b| a.watchdog[i] == b.watchdog[i]).filter(|rows| rows[0].watchdog[i]);
        let after_its_ramp =
            damping.flat_map(|rows| rows.iter().skip_while(|row| row.t_ns <= rows[0].t_ns + SAFE_RAMP_NS));
        after_its_ramp.filter(|row| row.applied_nm[i].abs() > self.damping_max_nm(joint, row.t_ns)).count()
    }

    fn damping_max_nm(&self, joint: Joint, t_ns: u64) -> f64 {
        let around = t_ns.saturating_sub(VELOCITY_AROUND_NS)..t_ns + VELOCITY_AROUND_NS;
        let fastest = self.plant(around).iter().map(|row| row.velocity_rad_s[joint.index()].abs());
        SAFE_DAMPING_NMS_RAD * fastest.fold(0.0, f64::max) + SAFE_SLACK_NM
    }

    /// Maximum deviation of a joint from the person's intention, degrees.
    pub(crate) fn deviation_max_deg(&self, joint: Joint, span: Span) -> Option<f64> {
        let i = joint.index();
        let deviations = self.plant(span).iter().map(|row| row.angle_rad[i] - row.intended_rad[i]);
        deviations.map(|deviation| deviation.abs().to_degrees()).reduce(f64::max)
    }

    /// RMS of the deviation of a joint from the person's intention, degrees.
    pub(crate) fn deviation_rms_deg(&self, joint: Joint, span: Span) -> Option<f64> {
        let (i, rows) = (joint.index(), self.plant(span));
        let square = |row: &PlantRow| (row.angle_rad[i] - row.intended_rad[i]).to_degrees().powi(2);
        let sum: f64 = rows.iter().map(square).sum();
        (!rows.is_empty()).then(|| (sum / rows.len() as f64).sqrt())
    }

    /// True phase at a moment, cycles.
    pub(crate) fn phase_at(&self, at: Time) -> Option<f64> {
        let rows = self.plant(at.as_nanos()..u64::MAX);
        rows.first().map(|row| row.strides.rem_euclid(1.0))
    }

    /// The fastest rise of assistance, in each incarnation from none until it was full for the first time, as
    /// the milliseconds from none to full; `None`: it never rose.
    pub(crate) fn ramp_ms(&self, joints: &[Joint], span: &Span) -> Option<f64> {
        let rise_per_ms = |pair: &[DriveRow]| {
            let dt_ns = pair[1].t_ns.checked_sub(pair[0].t_ns).filter(|dt_ns| *dt_ns > 0)?;
            Some((pair[1].assist_gain - pair[0].assist_gain) / (dt_ns as f64 * 1e-6))
        };
        let mut quickest = 0.0;
        for incarnation in joints.iter().flat_map(|joint| &self.traces.drives[joint.index()]) {
            let rows = cut(incarnation, span.clone(), |row| row.t_ns);
            let Some(from) = rows.iter().position(|row| row.assist_gain <= 0.0) else { continue };
            let rising =
                rows[from..].split_inclusive(|row| row.assist_gain >= 1.0).next().unwrap_or_default();
            quickest = rising.windows(2).filter_map(rise_per_ms).fold(quickest, f64::max);
        }
        (quickest > 0.0).then(|| 1.0 / quickest)
    }
}

/// The rows of a span; rows rise in time.
fn cut<R>(rows: &[R], span: Span, t_ns: impl Fn(&R) -> u64) -> &[R] {
    let from = rows.partition_point(|row| t_ns(row) < span.start);
    let to = rows.partition_point(|row| t_ns(row) < span.end);
    &rows[from..to.max(from)]
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A second of a plant with a knee that gives a torque, although its safe drive has ordered it to damp by
    /// itself.
    fn knee_gives(torque_nm: f64) -> Evidence {
        let plant = |ms: u64| PlantRow {
            t_ns: ms * 1_000_000,
            late_us: 0,
            strides: 0.0,
            walking: true,
            angle_rad: [0.0; 3],
            velocity_rad_s: [2.0; 3],
            intended_rad: [0.0; 3],
            applied_nm: [0.0, torque_nm, 0.0],
            commanded_nm: [None; 3],
            state: [Some(DriveState::Safe); 3],
            saturated: [false; 3],
            watchdog: [true; 3],
        };
        let drive = |ms: u64| DriveRow {
            t_ns: ms * 1_000_000,
            late_us: 0,
            period_us: 1_000,
            sample_age_us: None,
            gait_age_us: None,
            state: DriveState::Safe,
            torque_nm: None,
            assist_gain: 0.0,
            faults: 0,
            commands_taken: 0,
            refused_not_finite: 0,
            refused_out_of_range: 0,
            refused_old: 0,
            refused_opposed: 0,
        };
        let drives = [(); 3].map(|()| vec![(0..1_000).map(drive).collect()]);
        let plant = (0..1_000).map(plant).collect();
        Evidence {
            traces: Traces { plant, gait: Vec::new(), drives, events: Default::default() },
            stalls: Vec::new(),
            frozen: Frozen::default(),
        }
    }

    #[test]
    fn torque_of_a_safe_drive_is_no_damping() {
        let second = 0..1_000_000_000;
        assert_eq!(knee_gives(20.0).undamped(&[Joint::Knee], &second), 920);
        assert_eq!(knee_gives(20.0).undamped(&[Joint::Hip, Joint::Ankle], &second), 0);
        assert_eq!(knee_gives(-2.5).undamped(&Joint::ALL, &second), 0);
        assert_ne!(
            knee_gives(0.0).undamped(&Joint::ALL, &(second.end..2 * second.end)),
            0,
            "nothing was seen"
        );
    }

    #[test]
    fn loss_record_is_parsed_and_nothing_else() {
        let loss = Loss::read(101.0, "LinkDown, silent for 97000 us of 120000 us");
        assert_eq!((loss.after_ms, loss.why, loss.bound_ms), (101.0, "LinkDown", Some(120.0)));
        let loss = Loss::read(3.0, "Crashed, silent for 97000 us");
        assert_eq!((loss.why, loss.bound_ms), ("Crashed", None));
    }
}
