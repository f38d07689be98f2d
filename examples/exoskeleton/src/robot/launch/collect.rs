//! Combines the traces of all processes into one record and its figures.

use std::collections::BTreeMap;
use std::io;
use std::path::Path;

use exoskeleton_model::joint::{Joint, PerJoint};
use exoskeleton_model::message::DriveState;
use exoskeleton_model::metrics::{Counting, Metrics};
use exoskeleton_model::part::Part;
use exoskeleton_model::record::{JointRow, Outage, Record, Row, Stall};
use exoskeleton_recording::plot::Lateness;
use sinew::Time;
use sinew_figures::stalls::{CpuTimes, Evidence, HostCpu, HostStall, Testimony, merged};

use super::LaunchError;
use crate::report::{
    HostFigures, KillFigures, LoopSummary, RealTimeFigures, Report, RunDescription, Timing, UnstalledFigures,
};
use crate::robot::figures::{LoopFigures, percentiles_of};
use crate::robot::role::Role;
use crate::robot::trace::{DriveRow, EventRow, GaitRow, PlantRow, read_incarnations};

/// Maximum age of a command of central that is still current, ns.
const NEWS_NS: u64 = 5_000_000;

/// A trace that ends this long before the walk was cut off, ns: its rows are at most a tenth of a second
/// late, longer after a stall.
const TRACE_CUT_NS: u64 = 2_000_000_000;

/// The times of a kill, in the host's clock.
#[derive(Debug, Clone, Copy)]
pub(super) struct KillTimes {
    pub(super) part: Part,
    pub(super) from: Time,
    pub(super) to: Option<Time>,
}

/// The launcher's record of the run, in the host's clock.
#[derive(Debug, Default)]
pub(super) struct RunTimes {
    pub(super) strides: u32,
    pub(super) first_start: Option<Time>,
    pub(super) stop: Time,
    pub(super) outage: Option<KillTimes>,
    pub(super) cpu_from: Option<CpuTimes>,
    pub(super) cpu_to: Option<CpuTimes>,
    /// CPU times of all processes, five times a second.
    pub(super) samples: Vec<CpuTimes>,
    pub(super) host_from: Option<HostCpu>,
    pub(super) host_to: Option<HostCpu>,
    pub(super) testimonies: Vec<Testimony>,
}

impl RunTimes {
    /// Seconds of the run at this time of the host's clock, ns.
    fn seconds(&self, t_ns: u64) -> f64 {
        let start_ns = self.first_start.unwrap_or(Time::ZERO).as_nanos();
        (i128::from(t_ns) - i128::from(start_ns)) as f64 * 1e-9
    }
}

/// The traces of all processes, up to the stop order.
#[derive(Debug)]
pub struct Traces {
    /// The rows of the plant.
    pub plant: Vec<PlantRow>,
    /// The rows of central.
    pub gait: Vec<GaitRow>,
    /// The rows of each drive, by incarnation.
    pub drives: PerJoint<Vec<Vec<DriveRow>>>,
    /// The events of each node.
    pub events: BTreeMap<Part, Vec<EventRow>>,
}

impl Traces {
    /// Reads them from the folder of a run.
    ///
    /// # Errors
    /// A trace cannot be read.
    pub fn read(folder: &Path, stop: Time) -> io::Result<Self> {
        let until = stop.as_nanos();
        let mut plant = read_incarnations::<PlantRow>(folder, "plant")?.concat();
        plant.retain(|row| row.t_ns <= until);
        let mut gait = read_incarnations::<GaitRow>(folder, Part::Central.name())?.concat();
        gait.retain(|row| row.t_ns <= until);
        let [hip, knee, ankle] = Joint::ALL.map(|joint| read_incarnations::<DriveRow>(folder, joint.name()));
        let mut drives = [hip?, knee?, ankle?];
        drives.iter_mut().flatten().for_each(|incarnation| incarnation.retain(|row| row.t_ns <= until));
        let of_part = |part: Part| {
            read_incarnations::<EventRow>(folder, &format!("{part}-events")).map(|all| (part, all.concat()))
        };
        let events = Part::ALL.into_iter().map(of_part).collect::<io::Result<_>>()?;
        Ok(Self { plant, gait, drives, events })
    }
}

/// Reads the traces of a run; returns its report, its record, and the lateness of the drives' ticks.
///
/// # Errors
/// A trace cannot be opened, or ends before the walk does.
pub(super) fn read(
    folder: &Path,
    times: &RunTimes,
    run: RunDescription,
) -> Result<(Report, Record, Lateness), LaunchError> {
    let traces = Traces::read(folder, times.stop)?;
    check_whole(&traces, folder, times.stop)?;
    let mut loops = LoopFigures::default();
    for incarnation in traces.drives.iter().flatten() {
        incarnation.iter().filter(|row| row.state != DriveState::Init).for_each(|row| loops.note(row));
    }
    let summary = loops.summary();
    let (stalls, own_stalls) = stalls(&traces, times);
    let record = record(&traces, times, stalls);
    let timing = Timing {
        timing_measured: true,
        period_us: Some(summary.period_us),
        age_us: Some(summary.gait_age_us),
        deadline_misses: Some(summary.deadline_misses),
        ticks: Some(summary.ticks),
        witness_misses: Some(times.testimonies.iter().map(|seen| seen.misses).sum()),
        witness_wakes: Some(times.testimonies.iter().map(|seen| seen.wakes).sum()),
    };
    let figures = figures(&traces, times, summary, &record, own_stalls);
    let rate_max_nm_s = torque_rate_max(&traces.drives);
    let report = Report::of_real_time(run, &record, rate_max_nm_s, timing, figures);
    Ok((report, record, loops.lateness()))
}

fn record(traces: &Traces, times: &RunTimes, stalls: Vec<Stall>) -> Record {
    let seconds = |t_ns| times.seconds(t_ns);
    let is_ready = |row: &&DriveRow| row.state == DriveState::Ready;
    let ready_s = traces
        .drives
        .each_ref()
        .map(|incarnations| incarnations.iter().flatten().find(is_ready).map(|row| seconds(row.t_ns)));
    let outage = times.outage.map(|kill| Outage {
        part: kill.part,
        from_s: seconds(kill.from.as_nanos()),
        to_s: kill.to.map(|to| seconds(to.as_nanos())),
    });
    let mut newest = traces.gait.iter().peekable();
    let mut gait = None;
    let rows: Vec<Row> = traces
        .plant
        .iter()
        .map(|plant| {
            while let Some(row) = newest.next_if(|row| row.t_ns <= plant.t_ns) {
                gait = Some(row);
            }
            row(seconds(plant.t_ns), plant, gait.filter(|row| plant.t_ns - row.t_ns <= NEWS_NS))
        })
        .collect();
    Record {
        strides: times.strides,
        first_start_s: 0.0,
        ready_s,
        released_s: rows.iter().find(|row| row.walking).map(|row| row.t_s),
        outage,
        stalls,
        rows,
    }
}

/// Checks that the walk is recorded to its end; otherwise it cannot be judged. A killed drive ends early by
/// design.
fn check_whole(traces: &Traces, folder: &Path, stop: Time) -> Result<(), LaunchError> {
    let central = Role::Node(Part::Central);
    let ends = [
        (Role::Plant, traces.plant.last().map(|row| row.t_ns)),
        (central, traces.gait.last().map(|row| row.t_ns)),
    ];
    for (role, end_ns) in ends {
        let missing_ns = stop.as_nanos().saturating_sub(end_ns.unwrap_or(0));
        if missing_ns > TRACE_CUT_NS {
            let (folder, missing_s) = (folder.display().to_string(), missing_ns as f64 * 1e-9);
            return Err(LaunchError::TraceCut { role, folder, missing_s });
        }
    }
    Ok(())
}

/// The stalls of the host, and those that the robot has caused itself.
fn stalls(traces: &Traces, times: &RunTimes) -> (Vec<Stall>, Vec<Stall>) {
    let seconds = |t_ns| times.seconds(t_ns);
    let drive = |joint: Joint| traces.drives[joint.index()].iter().flatten().map(|row| row.t_ns).collect();
    let mut ticks: Vec<(&str, Vec<u64>)> =
        Joint::ALL.into_iter().map(|joint| (joint.name(), drive(joint))).collect();
    ticks.push((Role::Plant.name(), traces.plant.iter().map(|row| row.t_ns).collect()));
    ticks.push((Part::Central.name(), traces.gait.iter().map(|row| row.t_ns).collect()));
    let evidence = Evidence {
        samples: &times.samples,
        ticks,
        cpus: times.testimonies.len(),
        ticks_from_ns: traces.plant.iter().find(|row| row.walking).map_or(u64::MAX, |row| row.t_ns),
    };
    let until = times.stop.as_nanos();
    let all = merged(&times.testimonies);
    let (own, hosts): (Vec<HostStall>, Vec<HostStall>) =
        all.iter().filter(|stall| stall.at.from_ns < until).partition(|stall| evidence.is_own(stall));
    let of_the_run = |stalls: Vec<HostStall>| {
        let at =
            |stall: HostStall| Stall { from_s: seconds(stall.at.from_ns), to_s: seconds(stall.at.to_ns) };
        stalls.into_iter().map(at).collect()
    };
    (of_the_run(hosts), of_the_run(own))
}

fn host_figures(times: &RunTimes, record: &Record, own_stalls: Vec<Stall>) -> HostFigures {
    let sum = |of: fn(&Testimony) -> u64| times.testimonies.iter().map(of).sum();
    let spent = times.host_from.zip(times.host_to).map(|(from, to)| HostCpu {
        total: (to.total - from.total).max(1.0),
        busy: to.busy - from.busy,
        stolen: to.stolen - from.stolen,
    });
    let seconds =
        times.cpu_from.as_ref().zip(times.cpu_to.as_ref()).map(|(from, to)| (to.0 - from.0) as f64 * 1e-9);
    // Per cent of one CPU, over the seconds of the walk, in hundredths of a second.
    let robot = cpu_percent(times).values().sum::<f64>() * seconds.unwrap_or_default();
    HostFigures {
        witnesses: times.testimonies.len(),
        wakes: sum(|seen| seen.wakes),
        deadline_misses: sum(|seen| seen.misses),
        stalls: record.stalls.clone(),
        own_stalls,
        strides_disturbed: Counting::disturbed(record),
        others_cpu_percent: spent.map(|cpu| (100.0 * (cpu.busy - robot) / cpu.total).max(0.0)),
        stolen_cpu_percent: spent.map(|cpu| 100.0 * cpu.stolen / cpu.total),
    }
}

fn row(t_s: f64, plant: &PlantRow, gait: Option<&GaitRow>) -> Row {
    Row {
        t_s,
        strides_true: plant.strides,
        walking: plant.walking,
        phase_estimated: gait.map_or(0.0, |gait| f64::from(gait.phase)),
        confidence: gait.map_or(0.0, |gait| f64::from(gait.confidence)),
        mode: gait.and_then(|gait| gait.mode),
        degraded: gait.map_or(0, |gait| gait.degraded),
        joints: std::array::from_fn(|i| JointRow {
            angle_rad: plant.angle_rad[i],
            velocity_rad_s: plant.velocity_rad_s[i],
            intended_rad: plant.intended_rad[i],
            commanded_nm: plant.commanded_nm[i],
            applied_nm: plant.applied_nm[i],
            saturated: plant.saturated[i],
            state: plant.state[i],
            watchdog: plant.watchdog[i],
        }),
    }
}

/// In the drives' own time: a late tick may move the torque further, at the same rate.
fn torque_rate_max(drives: &PerJoint<Vec<Vec<DriveRow>>>) -> f64 {
    let rate = |pair: &[DriveRow]| {
        let (before, after) = (pair[0].torque_nm?, pair[1].torque_nm?);
        let dt_s = pair[1].t_ns.checked_sub(pair[0].t_ns).filter(|dt_ns| *dt_ns > 0)? as f64 * 1e-9;
        Some((after - before).abs() / dt_s)
    };
    drives
        .iter()
        .flatten()
        .flat_map(|incarnation| incarnation.windows(2).filter_map(rate))
        .fold(0.0, f64::max)
}

fn figures(
    traces: &Traces,
    times: &RunTimes,
    drives: LoopSummary,
    record: &Record,
    own_stalls: Vec<Stall>,
) -> RealTimeFigures {
    let cpu_percent = cpu_percent(times);
    RealTimeFigures {
        drives,
        central_late_us: percentiles_of(traces.gait.iter().map(|row| row.late_us)),
        plant_late_us: percentiles_of(traces.plant.iter().map(|row| row.late_us)),
        host: host_figures(times, record, own_stalls),
        cpu_percent_total: cpu_percent.values().sum(),
        cpu_percent,
        without_stalls: (!record.stalls.is_empty()).then(|| {
            let rest = Metrics::without_stalls(record);
            UnstalledFigures { rms_deg: rest.rms_deg, phase_rms_percent: rest.phase_rms_percent }
        }),
        kill: times.outage.map(|kill| kill_figures(traces, kill)),
    }
}

fn cpu_percent(times: &RunTimes) -> BTreeMap<String, f64> {
    let (Some((from, used_before)), Some((to, used))) = (&times.cpu_from, &times.cpu_to) else {
        return BTreeMap::new();
    };
    let seconds = ((to - from) as f64 * 1e-9).max(1e-3);
    let share = |name: &str, used: f64| {
        // A restarted process began at zero.
        let before = used_before.get(name).copied().filter(|before| *before <= used).unwrap_or(0.0);
        100.0 * (used - before) / seconds
    };
    used.iter().map(|(name, used)| ((*name).to_owned(), share(name, *used))).collect()
}

fn kill_figures(traces: &Traces, kill: KillTimes) -> KillFigures {
    let from_ns = kill.from.as_nanos();
    let after_ms = |t_ns: u64| (t_ns - from_ns) as f64 * 1e-6;
    let safe = |joint: Joint| {
        let rows = traces.drives[joint.index()].iter().flatten();
        let first = rows.filter(|row| row.t_ns >= from_ns).find(|row| row.state == DriveState::Safe);
        first.map(|row| after_ms(row.t_ns))
    };
    let lost = |part: Part| {
        let events = traces.events.get(&part)?.iter();
        let mut after = events.filter(|event| event.t_ns >= from_ns);
        let first = after.find(|event| event.what == "node_lost" && event.whom == kill.part.name());
        first.map(|event| after_ms(event.t_ns))
    };
    KillFigures {
        safe_after_ms: Joint::ALL
            .into_iter()
            .filter(|joint| Part::Joint(*joint) != kill.part)
            .map(|joint| (joint.name().to_owned(), safe(joint)))
            .collect(),
        node_lost_after_ms: Part::ALL
            .into_iter()
            .filter(|part| *part != kill.part)
            .map(|part| (part.name().to_owned(), lost(part)))
            .collect(),
    }
}
