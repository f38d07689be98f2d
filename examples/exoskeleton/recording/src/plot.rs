//! The picture of a run as SVG: angles against the reference band, torques, phase, and loop lateness when it
//! was measured. The same record gives the same text.

use exoskeleton_model::control::torque_law::TorqueLaw;
use exoskeleton_model::gait::band::Band;
use exoskeleton_model::gait::curves;
use exoskeleton_model::joint::{Joint, PerJoint};
use exoskeleton_model::message::GaitMode;
use exoskeleton_model::phase::wrapped;
use exoskeleton_model::record::{Record, Row};
use exoskeleton_model::strides::{self, Strides};
use sinew_figures::canvas::{Anchor, Axis, Canvas, Panel, Stroke};

/// Colours of Okabe and Ito, distinguishable with any colour vision: blue, vermilion, green.
const JOINT_COLORS: [&str; 3] = ["#0072B2", "#D55E00", "#009E73"];
/// The colour of a band of recorded strides.
pub const BAND_COLOR: &str = "#d9d9d9";
/// Strides in and after a fault: reddish purple of the same set.
pub const FAULT_COLOR: &str = "#CC79A7";
const REFERENCE: Stroke = Stroke::dashed("#555555", 1.6);
const TRUE_PHASE: Stroke = Stroke::solid("#222222", 2.4);
const ESTIMATED_PHASE: Stroke = Stroke::solid("#E69F00", 1.6);

/// Minimum gap in the phase error that is drawn as a gap, strides.
const STRIDES_UNKNOWN_MIN: f64 = 0.05;

const ANGLE_TITLES: PerJoint<&str> =
    ["Hip angle (flexion +)", "Knee angle (flexion +)", "Ankle angle (dorsiflexion +)"];
const TORQUE_TITLES: PerJoint<&str> =
    ["Hip torque of the device", "Knee torque of the device", "Ankle torque of the device"];

const WIDTH: f64 = 1240.0;
const COLUMN_LEFT: [f64; 3] = [80.0, 480.0, 880.0];
const COLUMN_WIDTH: f64 = 320.0;
const ANGLE_TOP: f64 = 150.0;
const TORQUE_TOP: f64 = 460.0;
const PHASE_TOP: f64 = 750.0;
const LATENESS_TOP: f64 = 1010.0;
const ROW_HEIGHT: f64 = 210.0;
const LOW_ROW_HEIGHT: f64 = 160.0;

/// Lateness of the loops' ticks, as a histogram.
#[derive(Debug, Clone, PartialEq)]
pub struct Lateness {
    /// Width of a bucket, microseconds; the first begins at 0.
    pub bucket_us: f64,
    /// Ticks in each bucket.
    pub counts: Vec<u64>,
}

/// The contents of the figure.
#[derive(Debug, Clone, Copy)]
pub struct Figure<'a> {
    /// The run.
    pub record: &'a Record,
    /// First line, for example the walk.
    pub title: &'a str,
    /// Second line, for example the main figures.
    pub caption: &'a str,
    /// Lateness, if it was measured; in lock-step it cannot be.
    pub lateness: Option<&'a Lateness>,
}

/// Draws the figure as an SVG text.
#[must_use]
pub fn figure(figure: &Figure<'_>) -> String {
    let height =
        if figure.lateness.is_some() { LATENESS_TOP + LOW_ROW_HEIGHT } else { PHASE_TOP + LOW_ROW_HEIGHT };
    let mut canvas = Canvas::new(WIDTH, height + 90.0);
    canvas.heading((30.0, 38.0), 21.0, figure.title);
    canvas.label((30.0, 62.0), 13.5, Anchor::Start, figure.caption);
    legend(&mut canvas, figure.record.outage.is_some());
    let band = Band::built_in();
    for joint in Joint::ALL {
        angle_panel(&mut canvas, figure.record, &band, joint);
        torque_panel(&mut canvas, figure.record, joint);
    }
    phase_panel(&mut canvas, figure.record);
    error_panel(&mut canvas, figure.record);
    if let Some(lateness) = figure.lateness {
        lateness_panel(&mut canvas, lateness);
    }
    footer(&mut canvas, height + 64.0);
    canvas.finish()
}

fn legend(canvas: &mut Canvas, with_fault: bool) {
    let y = 98.0;
    let mut x = canvas.legend_line((30.0, y), Stroke::solid("#444444", 2.6), "mean of strides 7 and later");
    x = canvas.legend_line((x, y), Stroke::faint("#444444", 0.9, 0.45), "each stride");
    x = canvas.legend_line((x, y), REFERENCE, "recorded mean (torque: 40 % of the moment)");
    x = canvas.legend_area((x, y), BAND_COLOR, "\u{b1} 1 SD, 53 recorded strides of one adult");
    if with_fault {
        canvas.legend_line((x, y), Stroke::faint(FAULT_COLOR, 1.4, 0.8), "around the fault");
    }
}

fn footer(canvas: &mut Canvas, y: f64) {
    let text = "Recording: Moore, Hnat, van den Bogert (2015) PeerJ 3:e918, data doi:10.5281/zenodo.13030 (CC0). \
                Simulated person and leg; no clinical meaning.";
    canvas.label((30.0, y), 12.0, Anchor::Start, text);
}

fn angle_panel(canvas: &mut Canvas, record: &Record, band: &Band, joint: Joint) {
    let strides = strides::curves(record, joint, |row| row.angle_rad.to_degrees());
    let points = band.joint(joint);
    let percent = |i: usize| i as f64;
    let edges: Vec<(f64, f64, f64)> = points
        .iter()
        .enumerate()
        .map(|(i, p)| (percent(i), p.mean_deg - p.deviation_deg, p.mean_deg + p.deviation_deg))
        .collect();
    let all = strides.all().chain(edges.iter().flat_map(|(_, low, high)| [*low, *high]));
    let panel = cycle_panel(joint, ANGLE_TOP, ANGLE_TITLES[joint.index()], Axis::around(all, "angle [deg]"));
    canvas.frame(&panel);
    canvas.band(&panel, &edges, BAND_COLOR);
    draw_strides(canvas, &panel, joint, &strides);
    let reference: Vec<(f64, f64)> =
        points.iter().enumerate().map(|(i, p)| (percent(i), p.mean_deg)).collect();
    canvas.line(&panel, &reference, REFERENCE);
}

fn torque_panel(canvas: &mut Canvas, record: &Record, joint: Joint) {
    let strides = strides::curves(record, joint, |row| row.applied_nm);
    let law = TorqueLaw::standard(joint);
    let share: Vec<(f64, f64)> = (0..strides::POINTS)
        .map(|i| {
            let moment = curves::moment_nm_per_kg(joint, i as f64 / 100.0);
            (i as f64, law.gains.assistance * law.body_mass_kg * moment)
        })
        .collect();
    let all = strides.all().chain(share.iter().map(|(_, y)| *y));
    let panel =
        cycle_panel(joint, TORQUE_TOP, TORQUE_TITLES[joint.index()], Axis::around(all, "torque [Nm]"));
    canvas.frame(&panel);
    draw_strides(canvas, &panel, joint, &strides);
    canvas.line(&panel, &share, REFERENCE);
}

fn draw_strides(canvas: &mut Canvas, panel: &Panel<'_>, joint: Joint, strides: &Strides) {
    let color = JOINT_COLORS[joint.index()];
    let points = |curve: &[f64]| -> Vec<(f64, f64)> {
        curve.iter().enumerate().map(|(i, y)| (i as f64, *y)).collect()
    };
    for stride in &strides.uncounted {
        canvas.line(panel, &points(stride), Stroke::faint(FAULT_COLOR, 1.0, 0.45));
    }
    for stride in &strides.counted {
        canvas.line(panel, &points(stride), Stroke::faint(color, 0.9, 0.30));
    }
    canvas.line(panel, &points(&strides::mean(&strides.counted)), Stroke::solid(color, 2.6));
}

fn cycle_panel<'a>(joint: Joint, top: f64, title: &'a str, y: Axis<'a>) -> Panel<'a> {
    Panel {
        area: (COLUMN_LEFT[joint.index()], top, COLUMN_WIDTH, ROW_HEIGHT),
        x: Axis { low: 0.0, high: 100.0, label: "stride [% from heel strike]" },
        y,
        title,
    }
}

/// True and estimated phase over the first strides: the estimator settling, then assistance.
fn phase_panel(canvas: &mut Canvas, record: &Record) {
    let rows: Vec<&Row> = record.rows.iter().filter(|row| row.walking).collect();
    let start_s = rows.first().map_or(0.0, |row| row.t_s);
    let end_s = 10.0_f64.min(rows.last().map_or(1.0, |row| row.t_s - start_s)).max(1.0);
    let panel = Panel {
        area: (COLUMN_LEFT[0], PHASE_TOP, 520.0, LOW_ROW_HEIGHT),
        x: Axis { low: 0.0, high: end_s, label: "time since release [s]" },
        y: Axis { low: 0.0, high: 100.0, label: "phase [%]" },
        title: "Gait phase",
    };
    canvas.frame(&panel);
    let shown: Vec<&&Row> = rows.iter().take_while(|row| row.t_s - start_s <= end_s).step_by(5).collect();
    let true_phase =
        shown.iter().map(|row| (row.t_s - start_s, 100.0 * row.strides_true.rem_euclid(1.0))).collect();
    let estimated = shown.iter().map(|row| (row.t_s - start_s, 100.0 * row.phase_estimated)).collect();
    canvas.line(&panel, &broken(true_phase, 50.0, f64::INFINITY), TRUE_PHASE);
    canvas.line(&panel, &broken(estimated, 50.0, f64::INFINITY), ESTIMATED_PHASE);
    let x = canvas.legend_line((COLUMN_LEFT[0] + 250.0, PHASE_TOP - 10.0), TRUE_PHASE, "true");
    canvas.legend_line((x, PHASE_TOP - 10.0), ESTIMATED_PHASE, "estimated");
}

/// Phase error over all strides, with the limit and the start of assistance. While the estimator has no
/// confidence there is nothing to draw.
fn error_panel(canvas: &mut Canvas, record: &Record) {
    let panel = Panel {
        area: (680.0, PHASE_TOP, 520.0, LOW_ROW_HEIGHT),
        x: Axis { low: 0.0, high: f64::from(record.strides), label: "strides walked" },
        y: Axis { low: -15.0, high: 15.0, label: "phase error [%]" },
        title: "Phase error (band: \u{b1} 3 %, limit of the RMS)",
    };
    canvas.frame(&panel);
    canvas.band(&panel, &[(0.0, -3.0, 3.0), (f64::from(record.strides), -3.0, 3.0)], BAND_COLOR);
    for (stride, text, height) in moments(record) {
        canvas.line(&panel, &[(stride, -15.0), (stride, 15.0)], Stroke::dashed("#606060", 1.3));
        let x = panel.area.0 + panel.area.2 * stride / f64::from(record.strides) + 6.0;
        canvas.label((x, PHASE_TOP + height), 12.0, Anchor::Start, &text);
    }
    let errors: Vec<(f64, f64)> = record
        .rows
        .iter()
        .filter(|row| row.walking && row.confidence > 0.0 && row.mode != Some(GaitMode::Safe))
        .step_by(5)
        .map(|row| (row.strides_true, 100.0 * wrapped(row.phase_estimated - row.strides_true)))
        .collect();
    canvas.line(&panel, &broken(errors, 20.0, STRIDES_UNKNOWN_MIN), ESTIMATED_PHASE);
}

/// Strides with an event, its name, and the distance of its text below the panel's top.
fn moments(record: &Record) -> Vec<(f64, String, f64)> {
    let stride_at = |t_s: f64| record.rows.iter().find(|r| r.t_s >= t_s).map(|r| r.strides_true);
    let assisted_after = |t_s: f64| {
        record.rows.iter().find(|r| r.t_s >= t_s && r.mode == Some(GaitMode::Walk)).map(|r| r.strides_true)
    };
    let mut moments = Vec::new();
    moments.extend(assisted_after(0.0).map(|stride| (stride, "assistance".to_owned(), 14.0)));
    let Some(outage) = record.outage else { return moments };
    moments.extend(stride_at(outage.from_s).map(|stride| (stride, format!("{} killed", outage.part), 30.0)));
    let resumed = outage.to_s.and_then(assisted_after);
    moments.extend(resumed.map(|stride| (stride, "assistance again".to_owned(), 14.0)));
    moments
}

fn lateness_panel(canvas: &mut Canvas, lateness: &Lateness) {
    let high = (lateness.counts.len() as f64 * lateness.bucket_us).max(1.0);
    let tallest = lateness.counts.iter().copied().max().unwrap_or(1).max(1) as f64;
    let panel = Panel {
        area: (COLUMN_LEFT[0], LATENESS_TOP, 1120.0, LOW_ROW_HEIGHT),
        x: Axis { low: 0.0, high, label: "lateness of a tick [\u{b5}s]" },
        y: Axis { low: 0.0, high: tallest.log10().ceil().max(1.0), label: "log10 of ticks" },
        title: "Loop lateness (logarithmic count)",
    };
    canvas.frame(&panel);
    for (i, count) in lateness.counts.iter().enumerate().filter(|(_, count)| **count > 0) {
        let (left, right) = (i as f64 * lateness.bucket_us, (i + 1) as f64 * lateness.bucket_us);
        // A single tick has log 0; it still shows as a thin bar.
        let top = (*count as f64).log10().max(0.06);
        canvas.band(&panel, &[(left, 0.0, top), (right, 0.0, top)], JOINT_COLORS[0]);
    }
}

/// Breaks the line where it jumps by more than `jump`, as where the phase goes from 100 to 0 %, and where it has
/// no point for more than `gap`: a line across it would show values that were not measured.
fn broken(points: Vec<(f64, f64)>, jump: f64, gap: f64) -> Vec<(f64, f64)> {
    let mut out: Vec<(f64, f64)> = Vec::with_capacity(points.len());
    for point in points {
        if out.last().is_some_and(|last| (last.1 - point.1).abs() > jump || point.0 - last.0 > gap) {
            out.push((point.0, f64::NAN));
        }
        out.push(point);
    }
    out
}

#[cfg(test)]
#[path = "plot_tests.rs"]
mod tests;
