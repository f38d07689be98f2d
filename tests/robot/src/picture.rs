//! The same fault with and without a device watchdog, side by side on the same scales: angle, torque, states.

use exoskeleton_model::gait::band::Band;
use exoskeleton_model::joint::Joint;
use exoskeleton_model::message::DriveState;
use exoskeleton_recording::plot::{BAND_COLOR, FAULT_COLOR};
use sinew_figures::canvas::{Anchor, Axis, Canvas, Panel, Stroke};

const WIDTH: f64 = 1240.0;
const HEIGHT: f64 = 860.0;
const LEFT: [f64; 2] = [90.0, 690.0];
const PANEL_WIDTH: f64 = 500.0;
const ANGLE_TOP: f64 = 190.0;
const ANGLE_HEIGHT: f64 = 230.0;
const TORQUE_TOP: f64 = 500.0;
const TORQUE_HEIGHT: f64 = 180.0;
const DRIVE_TOP: f64 = 744.0;
const DEVICE_TOP: f64 = 772.0;
const STRIP_HEIGHT: f64 = 18.0;
/// Seconds shown around the fault.
const SHOWN_S: (f64, f64) = (-0.5, 1.3);
/// A state shorter than this has no label, seconds.
const WORD_MIN_S: f64 = 0.12;
/// Blue, vermilion and green of Okabe and Ito; the fault is their reddish purple.
const ANGLE: Stroke = Stroke::solid("#0072B2", 2.2);
const INTENDED: Stroke = Stroke::dashed("#444444", 1.4);
const GIVEN: Stroke = Stroke::solid("#D55E00", 2.2);
const FAULT: Stroke = Stroke::solid(FAULT_COLOR, 2.0);
const SAFE: Stroke = Stroke::dashed("#009E73", 2.0);
const BACK: Stroke = Stroke::dashed("#777777", 1.4);

/// One joint at one moment.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct ContrastPoint {
    /// Time since the fault, seconds.
    pub(crate) t_s: f64,
    /// True phase, cycles 0..1.
    pub(crate) phase: f64,
    /// Angle, degrees.
    pub(crate) angle_deg: f64,
    /// Angle that the person intends, degrees.
    pub(crate) intended_deg: f64,
    /// Torque that the device applies, Nm.
    pub(crate) given_nm: f64,
    /// State of the drive; none while it is silent.
    pub(crate) drive: Option<DriveState>,
    /// Whether the device damps by itself.
    pub(crate) watchdog: bool,
}

/// One of the two runs.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct ContrastSide {
    /// The difference from the other run.
    pub(crate) title: String,
    /// Points, rising in time, from before the fault to after it.
    pub(crate) points: Vec<ContrastPoint>,
    /// Time at which the device damped by itself, seconds since the fault; none: never.
    pub(crate) safe_s: Option<f64>,
    /// Time at which the drive assisted again, seconds since the fault; none: never.
    pub(crate) back_s: Option<f64>,
    /// Maximum deviation from the person's intention until the next stride begins, degrees.
    pub(crate) deviation_deg: f64,
}

/// The contents of the figure.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Contrast {
    /// The joint.
    pub(crate) joint: Joint,
    /// First line.
    pub(crate) title: String,
    /// Second line.
    pub(crate) caption: String,
    /// Protected, then unprotected.
    pub(crate) sides: [ContrastSide; 2],
}

/// Draws the figure as an SVG text.
#[must_use]
pub(crate) fn contrast(contrast: &Contrast) -> String {
    let mut canvas = Canvas::new(WIDTH, HEIGHT);
    canvas.heading((30.0, 38.0), 21.0, &contrast.title);
    canvas.label((30.0, 62.0), 13.5, Anchor::Start, &contrast.caption);
    legend(&mut canvas);
    let band = Band::built_in();
    let edges = contrast.sides.each_ref().map(|side| edges(side, &band, contrast.joint));
    let shown = || contrast.sides.iter().flat_map(shown);
    let in_band = edges.iter().flatten().flat_map(|(_, low, high)| [*low, *high]);
    let angle =
        Axis::around(shown().flat_map(|p| [p.angle_deg, p.intended_deg]).chain(in_band), "angle [deg]");
    let torque = Axis::around(shown().map(|p| p.given_nm), "torque of the device [Nm]");
    for (i, side) in contrast.sides.iter().enumerate() {
        let x = Axis { low: SHOWN_S.0, high: SHOWN_S.1, label: "" };
        let joint = contrast.joint.name();
        let angle_title = format!("{}: {joint} deviates by {:.0} deg", side.title, side.deviation_deg);
        let area = (LEFT[i], ANGLE_TOP, PANEL_WIDTH, ANGLE_HEIGHT);
        let panel = Panel { area, x, y: angle, title: &angle_title };
        canvas.frame(&panel);
        canvas.band(&panel, &edges[i], BAND_COLOR);
        line(&mut canvas, &panel, side, INTENDED, |p| p.intended_deg);
        line(&mut canvas, &panel, side, ANGLE, |p| p.angle_deg);
        moments(&mut canvas, &panel, side, true);
        let area = (LEFT[i], TORQUE_TOP, PANEL_WIDTH, TORQUE_HEIGHT);
        let x = Axis { label: "time since the fault [s]", ..x };
        let panel = Panel { area, x, y: torque, title: "torque that the device gives" };
        canvas.frame(&panel);
        line(&mut canvas, &panel, side, GIVEN, |p| p.given_nm);
        moments(&mut canvas, &panel, side, false);
        strips(&mut canvas, LEFT[i], side);
    }
    let text = "Band: Moore, Hnat, van den Bogert (2015) PeerJ 3:e918, data doi:10.5281/zenodo.13030 (CC0). \
                Simulated person and leg; no clinical meaning.";
    canvas.label((30.0, HEIGHT - 24.0), 12.0, Anchor::Start, text);
    canvas.finish()
}

fn legend(canvas: &mut Canvas) {
    let mut x = canvas.legend_line((30.0, 98.0), ANGLE, "angle");
    x = canvas.legend_line((x, 98.0), INTENDED, "what the person means to do");
    x = canvas.legend_area((x, 98.0), BAND_COLOR, "\u{b1} 1 SD of 53 recorded strides");
    canvas.legend_line((x, 98.0), GIVEN, "torque");
    x = canvas.legend_line((30.0, 124.0), FAULT, "the drive falls silent");
    x = canvas.legend_line((x, 124.0), SAFE, "SAFE: the device damps by itself");
    canvas.legend_line((x, 124.0), BACK, "the drive assists again");
}

fn shown(side: &ContrastSide) -> impl Iterator<Item = &ContrastPoint> {
    side.points.iter().filter(|point| (SHOWN_S.0..=SHOWN_S.1).contains(&point.t_s))
}

/// The band at the phases of the run, thinned.
fn edges(side: &ContrastSide, band: &Band, joint: Joint) -> Vec<(f64, f64, f64)> {
    let points = band.joint(joint);
    let edge = |point: &ContrastPoint| {
        let at = points[((100.0 * point.phase).round() as usize).min(points.len() - 1)];
        (point.t_s, at.mean_deg - at.deviation_deg, at.mean_deg + at.deviation_deg)
    };
    shown(side).step_by(10).map(edge).collect()
}

fn line(
    canvas: &mut Canvas,
    panel: &Panel<'_>,
    side: &ContrastSide,
    stroke: Stroke,
    y: impl Fn(&ContrastPoint) -> f64,
) {
    let points: Vec<(f64, f64)> = shown(side).step_by(2).map(|point| (point.t_s, y(point))).collect();
    canvas.line(panel, &points, stroke);
}

/// The moments of the fault, with labels if there is room for them.
fn moments(canvas: &mut Canvas, panel: &Panel<'_>, side: &ContrastSide, in_words: bool) {
    let moments = [(Some(0.0), FAULT), (side.safe_s, SAFE), (side.back_s, BACK)];
    for (at, stroke) in moments {
        let Some(at) = at.filter(|at| (SHOWN_S.0..=SHOWN_S.1).contains(at)) else { continue };
        canvas.line(panel, &[(at, panel.y.low), (at, panel.y.high)], stroke);
    }
    if in_words {
        let words = side.safe_s.map_or_else(
            || "never SAFE".to_owned(),
            |safe_s| format!("SAFE after {:.0} ms", 1000.0 * safe_s),
        );
        let (left, top, _, height) = panel.area;
        canvas.label((x_px(left, 0.0) - 10.0, top + height - 14.0), 12.5, Anchor::End, &words);
    }
}

fn x_px(left: f64, t_s: f64) -> f64 {
    left + PANEL_WIDTH * (t_s - SHOWN_S.0) / (SHOWN_S.1 - SHOWN_S.0)
}

/// The states of drive and device over time, as coloured strips with labels in them.
fn strips(canvas: &mut Canvas, left: f64, side: &ContrastSide) {
    let drive = |point: &ContrastPoint| match point.drive {
        None => ("silent", "#f0c9de"),
        Some(DriveState::Walk) => ("WALK", "#cfe6f5"),
        Some(DriveState::Safe) => ("SAFE", "#cdebdf"),
        Some(DriveState::Init | DriveState::Ready) => ("READY", "#eeeeee"),
        Some(DriveState::EStop) => ("ESTOP", "#f5d6c6"),
    };
    let device = |point: &ContrastPoint| match (point.watchdog, point.drive) {
        (true, _) => ("damps by itself", "#cdebdf"),
        (false, Some(_)) => ("obeys", "#cfe6f5"),
        (false, None) => ("holds its torque", "#f0c9de"),
    };
    strip(canvas, left, DRIVE_TOP, "drive", &runs(side, drive));
    strip(canvas, left, DEVICE_TOP, "device", &runs(side, device));
}

/// Start, end, label, colour.
type Run = (f64, f64, &'static str, &'static str);

fn runs(side: &ContrastSide, of: impl Fn(&ContrastPoint) -> (&'static str, &'static str)) -> Vec<Run> {
    let mut runs: Vec<Run> = Vec::new();
    for point in shown(side) {
        let (word, color) = of(point);
        match runs.last_mut() {
            Some((_, to, last, _)) if *last == word => *to = point.t_s,
            Some((_, to, _, _)) => {
                *to = point.t_s;
                runs.push((point.t_s, point.t_s, word, color));
            }
            None => runs.push((point.t_s, point.t_s, word, color)),
        }
    }
    runs
}

fn strip(canvas: &mut Canvas, left: f64, top: f64, name: &str, runs: &[Run]) {
    canvas.label((left - 7.0, top + 13.0), 12.0, Anchor::End, name);
    let area = (left, top, PANEL_WIDTH, STRIP_HEIGHT);
    let x = Axis { low: SHOWN_S.0, high: SHOWN_S.1, label: "" };
    let panel = Panel { area, x, y: Axis { low: 0.0, high: 1.0, label: "" }, title: "" };
    for (from, to, word, color) in runs {
        canvas.band(&panel, &[(*from, 0.0, 1.0), (*to, 0.0, 1.0)], color);
        if to - from >= WORD_MIN_S.max(0.022 * word.len() as f64) {
            let middle = x_px(left, (from + to) / 2.0);
            canvas.label((middle, top + 13.0), 12.0, Anchor::Middle, word);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn side(title: &str, safe_s: Option<f64>) -> ContrastSide {
        let point = |i: i32| ContrastPoint {
            t_s: f64::from(i) * 0.01,
            phase: 0.5,
            angle_deg: 1.0,
            intended_deg: 2.0,
            given_nm: -20.0,
            drive: (i < 0).then_some(DriveState::Walk),
            watchdog: safe_s.is_some() && i > 0,
        };
        let points = (-60..140).map(point).collect();
        ContrastSide { title: title.to_owned(), points, safe_s, back_s: None, deviation_deg: 7.0 }
    }

    #[test]
    fn figure_shows_both_runs_and_any_moment_of_safety() {
        let sides = [side("with", Some(0.009)), side("without", None)];
        let (title, caption) = ("t".to_owned(), "c".to_owned());
        let text = contrast(&Contrast { joint: Joint::Ankle, title, caption, sides });
        for words in ["SAFE after 9 ms", "never SAFE", "damps by itself", "holds its torque"] {
            assert!(text.contains(words), "{words}");
        }
        assert!(!text.contains("NaN"));
    }
}
