//! The contrast: the ankle's drive falls silent while it still pushes, once with and once without a device
//! watchdog.

use std::path::Path;
use std::time::Duration;

use exoskeleton::robot::topology::{DrivePlace, Topology};
use exoskeleton::robot::trace::PlantRow;
use exoskeleton_model::intention::Intention;
use exoskeleton_model::joint::Joint;
use exoskeleton_model::lockstep::{self, DriveDeath, LockStepConfig};
use exoskeleton_model::message::DriveState;
use exoskeleton_model::record::Row;
use rustix::process::{Signal, kill_process};
use sinew::Time;

use crate::campaign::{self, ContrastRun, FaultError, FaultOptions, print_line};
use crate::claim::{Claim, Claims, Expected};
use crate::evidence::{Evidence, span};
use crate::picture::{Contrast, ContrastPoint, ContrastSide};
use crate::robot::Robot;
use crate::script;

/// The ankle still pushes with 17 Nm, down from 47 a moment ago, and is about to leave the ground. Earlier
/// the model's person sinks without the torque, and a watchdog cannot prevent that; see the README.
pub(crate) const PHASE: f64 = 0.60;
/// How long the drive is silent: the restart time of an unsupervised drive.
const SILENCE: Duration = Duration::from_millis(400);
/// Time shown after the silence begins.
const AFTER: Duration = Duration::from_millis(1_500);
/// Time shown before it, seconds.
const BEFORE_S: f64 = 0.7;
/// Time until the next stride begins, seconds: shows the effect of a held torque on a foot in the air.
const JUDGED_S: f64 = 0.52;
/// Deviation that a held torque exceeds and a damped joint does not, degrees.
const DEVIATION_DEG: f64 = 12.0;
const JOINT: Joint = Joint::Ankle;

/// Both runs of the contrast, protected first.
pub(crate) fn run(
    options: &FaultOptions,
    how: ContrastRun,
    folder: &Path,
    out: &mut Vec<Claim>,
) -> Result<Contrast, FaultError> {
    let sides = match how {
        ContrastRun::RealTime => [Some(options.device_watchdog), None].map(|watchdog| {
            let side = real_time(options, folder, watchdog);
            side.map(|(points, back_s)| side_of(watchdog, points, back_s))
        }),
        ContrastRun::LockStep => [Some(options.device_watchdog), None].map(|watchdog| {
            let (points, back_s) = lock_step(options.seed, watchdog)?;
            Ok(side_of(watchdog, points, back_s))
        }),
    };
    let [protected, unprotected] = sides;
    let sides = [protected?, unprotected?];
    let mut claims = Claims::contrast(out);
    claims.info("device damps by itself after, ms", sides[0].safe_s.map(|s| 1000.0 * s));
    let real_time = how == ContrastRun::RealTime;
    claims.add_deviation(
        "deviation with a device watchdog, deg",
        Expected::AtMost(DEVIATION_DEG),
        real_time,
        sides[0].deviation_deg,
    );
    claims.add_deviation(
        "deviation without, deg",
        Expected::AtLeast(DEVIATION_DEG),
        real_time,
        sides[1].deviation_deg,
    );
    Ok(Contrast {
        joint: JOINT,
        title: "The ankle's drive falls silent at push-off, with and without a device watchdog".to_owned(),
        caption: format!(
            "{} for {} ms from phase {PHASE:.2} on, seed {}. A device holds its last torque unless it has a watchdog, \
             here of {} ms.",
            if real_time { "Real time: its process is stopped" } else { "Virtual time: it is silent" },
            SILENCE.as_millis(),
            options.seed,
            options.device_watchdog.as_millis()
        ),
        sides,
    })
}

fn side_of(watchdog: Option<Duration>, points: Vec<ContrastPoint>, back_s: Option<f64>) -> ContrastSide {
    let title = match watchdog {
        Some(limit) => format!("Watchdog {} ms", limit.as_millis()),
        None => "No watchdog".to_owned(),
    };
    let after = || points.iter().filter(|point| point.t_s >= 0.0);
    let safe_s = after().find(|point| point.watchdog).map(|point| point.t_s);
    let judged = after().take_while(|point| point.t_s <= JUDGED_S);
    let deviation_deg = judged.map(|point| (point.angle_deg - point.intended_deg).abs()).fold(0.0, f64::max);
    ContrastSide { title, points, safe_s, back_s, deviation_deg }
}

/// A separate robot with an ankle drive that is stopped for a while.
fn real_time(
    options: &FaultOptions,
    folder: &Path,
    watchdog: Option<Duration>,
) -> Result<(Vec<ContrastPoint>, Option<f64>), FaultError> {
    let folder = folder.join(if watchdog.is_some() { "contrast-on" } else { "contrast-off" });
    std::fs::create_dir(&folder)?;
    let mut robot = Robot::start(&topology(options, watchdog)?, (None, None), &folder)?;
    script::walk_until_converged(&mut robot)?;
    let drive = robot.drive_process(JOINT)?;
    robot.walk_to_phase(PHASE)?;
    let at = Time::now();
    kill_process(drive, Signal::STOP).map_err(std::io::Error::from)?;
    print_line(&format!(
        "contrast: the ankle's drive falls silent, {}",
        if watchdog.is_some() { "its device has a watchdog" } else { "its device has none" }
    ));
    robot.pass_until(at + SILENCE)?;
    // It may have been replaced meanwhile; then there is no process to continue.
    let _ = kill_process(drive, Signal::CONT);
    robot.pass_until(at + AFTER)?;
    let stop = Time::now();
    let frozen = robot.end();
    let evidence = Evidence::read(&folder, stop, frozen)?;
    let from = Time::from_nanos(at.as_nanos().saturating_sub((BEFORE_S * 1e9) as u64));
    let seconds = |t_ns: u64| (t_ns as f64 - at.as_nanos() as f64) * 1e-9;
    let points =
        evidence.plant(span(from, stop)).iter().map(|row| real_point(seconds(row.t_ns), row)).collect();
    let back = evidence.output_after_ms(JOINT, span(at + SILENCE, stop));
    Ok((points, back.map(|ms| SILENCE.as_secs_f64() + ms * 1e-3)))
}

fn topology(options: &FaultOptions, watchdog: Option<Duration>) -> std::io::Result<Topology> {
    let mut topology = campaign::topology(options)?;
    topology.plant.device_watchdog = watchdog;
    topology.joints[Joint::Knee.index()].drive = DrivePlace::Node;
    topology.joints[JOINT.index()].drive = DrivePlace::Process;
    Ok(topology)
}

fn real_point(t_s: f64, row: &PlantRow) -> ContrastPoint {
    let i = JOINT.index();
    ContrastPoint {
        t_s,
        phase: row.strides.rem_euclid(1.0),
        angle_deg: row.angle_rad[i].to_degrees(),
        intended_deg: row.intended_rad[i].to_degrees(),
        given_nm: row.applied_nm[i],
        drive: row.state[i],
        watchdog: row.watchdog[i],
    }
}

/// The same in virtual time: identical in every bit for the same seed.
fn lock_step(seed: u64, watchdog: Option<Duration>) -> Result<(Vec<ContrastPoint>, Option<f64>), FaultError> {
    const STRIDES: u32 = 11;
    let at_strides = 8.0 + PHASE;
    let mut config = LockStepConfig::standard(STRIDES, seed, Intention::from_curves(seed));
    config.plant.watchdog_ns = watchdog.map(|limit| limit.as_nanos() as u64);
    config.drive_death = Some(DriveDeath { joint: JOINT, at_strides, outage_ms: SILENCE.as_millis() as u64 });
    let record = lockstep::run(&config)?;
    let Some(fault_s) = record.rows.iter().find(|row| row.strides_true >= at_strides).map(|row| row.t_s)
    else {
        return Ok((Vec::new(), None));
    };
    let shown = (fault_s - BEFORE_S)..(fault_s + AFTER.as_secs_f64());
    let rows = || record.rows.iter().filter(|row| shown.contains(&row.t_s));
    let back = rows().filter(|row| row.t_s > fault_s + SILENCE.as_secs_f64());
    let back_s = back
        .into_iter()
        .find(|row| row.joints[JOINT.index()].state == Some(DriveState::Walk))
        .map(|row| row.t_s - fault_s);
    Ok((rows().map(|row| virtual_point(row.t_s - fault_s, row)).collect(), back_s))
}

fn virtual_point(t_s: f64, row: &Row) -> ContrastPoint {
    let joint = &row.joints[JOINT.index()];
    ContrastPoint {
        t_s,
        phase: row.strides_true.rem_euclid(1.0),
        angle_deg: joint.angle_rad.to_degrees(),
        intended_deg: joint.intended_rad.to_degrees(),
        given_nm: joint.applied_nm,
        drive: joint.state,
        watchdog: joint.watchdog,
    }
}
