//! Panels with axes on an SVG canvas.

use std::fmt::Write;

const INK: &str = "#222222";
const FAINT: &str = "#e4e4e4";

/// An SVG text under construction.
#[derive(Debug)]
pub struct Canvas {
    text: String,
    width: f64,
    height: f64,
}

/// A line's look.
#[derive(Debug, Clone, Copy)]
pub struct Stroke {
    /// CSS colour.
    pub color: &'static str,
    /// Width, pixels.
    pub width: f64,
    /// 0 to 1.
    pub opacity: f64,
    /// SVG dash pattern; empty is solid.
    pub dash: &'static str,
}

/// Place and meaning of a panel.
#[derive(Debug, Clone, Copy)]
pub struct Panel<'a> {
    /// Left, top, width and height of the plotting area, pixels.
    pub area: (f64, f64, f64, f64),
    /// Horizontal axis.
    pub x: Axis<'a>,
    /// Vertical axis.
    pub y: Axis<'a>,
    /// Text above it.
    pub title: &'a str,
}

/// One axis: range and label with unit.
#[derive(Debug, Clone, Copy)]
pub struct Axis<'a> {
    /// Lower end.
    pub low: f64,
    /// Upper end.
    pub high: f64,
    /// The shown quantity, with its unit.
    pub label: &'a str,
}

/// Where a text stands relative to its point.
#[derive(Debug, Clone, Copy)]
pub enum Anchor {
    /// Right of it.
    Start,
    /// Around it.
    Middle,
    /// Left of it.
    End,
}

impl Stroke {
    /// A whole line.
    #[must_use]
    pub const fn solid(color: &'static str, width: f64) -> Self {
        Self { color, width, opacity: 1.0, dash: "" }
    }

    /// A line that others are seen through.
    #[must_use]
    pub const fn faint(color: &'static str, width: f64, opacity: f64) -> Self {
        Self { color, width, opacity, dash: "" }
    }

    /// A broken line.
    #[must_use]
    pub const fn dashed(color: &'static str, width: f64) -> Self {
        Self { color, width, opacity: 1.0, dash: "6 4" }
    }
}

impl Canvas {
    /// Creates a white canvas of this size, pixels.
    #[must_use]
    pub fn new(width: f64, height: f64) -> Self {
        let mut canvas = Self { text: String::new(), width, height };
        canvas.add(&format!(r#"<rect width="{width}" height="{height}" fill="white"/>"#));
        canvas
    }

    /// Returns the SVG text.
    #[must_use]
    pub fn finish(self) -> String {
        let (width, height) = (self.width, self.height);
        format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width}\" height=\"{height}\" \
             viewBox=\"0 0 {width} {height}\" \
             font-family=\"DejaVu Sans, Helvetica, Arial, sans-serif\">\n{}</svg>\n",
            self.text
        )
    }

    /// Adds a text.
    pub fn label(&mut self, (x, y): (f64, f64), size: f64, anchor: Anchor, text: &str) {
        let anchor = anchor.svg();
        let text = escaped(text);
        self.add(&format!(
            r#"<text x="{x:.1}" y="{y:.1}" font-size="{size}" fill="{INK}" text-anchor="{anchor}">{text}</text>"#
        ));
    }

    /// Adds a bold text.
    pub fn heading(&mut self, (x, y): (f64, f64), size: f64, text: &str) {
        let text = escaped(text);
        self.add(&format!(
            r#"<text x="{x:.1}" y="{y:.1}" font-size="{size}" font-weight="bold" fill="{INK}">{text}</text>"#
        ));
    }

    /// Draws a sample of a line with its meaning; returns the x at which the next one may begin.
    pub fn legend_line(&mut self, (x, y): (f64, f64), stroke: Stroke, text: &str) -> f64 {
        self.path(&format!("M{x:.1} {:.1}h26", y - 4.0), stroke);
        self.label((x + 33.0, y), 12.5, Anchor::Start, text);
        x + 33.0 + 6.9 * text.chars().count() as f64 + 8.0
    }

    /// Draws a sample of an area with its meaning; returns the x at which the next one may begin.
    pub fn legend_area(&mut self, (x, y): (f64, f64), color: &str, text: &str) -> f64 {
        self.bar((x, y - 10.0, 26.0, 11.0), color);
        self.label((x + 33.0, y), 12.5, Anchor::Start, text);
        x + 33.0 + 6.9 * text.chars().count() as f64 + 8.0
    }

    /// Fills an area: left, top, width and height.
    pub fn bar(&mut self, (left, top, width, height): (f64, f64, f64, f64), color: &str) {
        self.add(&format!(
            r#"<rect x="{left:.1}" y="{top:.1}" width="{width:.1}" height="{height:.1}" fill="{color}"/>"#
        ));
    }

    /// Draws a faint vertical line of a grid.
    pub fn grid_line(&mut self, (x, top): (f64, f64), height: f64) {
        self.path(&format!("M{x:.1} {top:.1}v{height:.1}"), Stroke::solid(FAINT, 1.0));
    }

    /// Draws the axes, ticks and texts of a panel.
    pub fn frame(&mut self, panel: &Panel<'_>) {
        let (left, top, width, height) = panel.area;
        self.heading((left, top - 10.0), 14.0, panel.title);
        for x in ticks(panel.x.low, panel.x.high) {
            let at = panel.x_px(x);
            self.grid_line((at, top), height);
            self.label((at, top + height + 17.0), 12.0, Anchor::Middle, &tick_text(x));
        }
        for y in ticks(panel.y.low, panel.y.high) {
            let at = panel.y_px(y);
            let color = if y == 0.0 { "#a0a0a0" } else { FAINT };
            self.path(&format!("M{left:.1} {at:.1}h{width:.1}"), Stroke::solid(color, 1.0));
            self.label((left - 7.0, at + 4.0), 12.0, Anchor::End, &tick_text(y));
        }
        self.path(&format!("M{left:.1} {top:.1}v{height:.1}h{width:.1}"), Stroke::solid("#606060", 1.2));
        let middle = left + width / 2.0;
        self.label((middle, top + height + 36.0), 12.5, Anchor::Middle, panel.x.label);
        let (x, y, text) = (left - 44.0, top + height / 2.0, escaped(panel.y.label));
        self.add(&format!(
            "<text transform=\"translate({x:.1} {y:.1}) rotate(-90)\" font-size=\"12.5\" fill=\"{INK}\" \
             text-anchor=\"middle\">{text}</text>"
        ));
    }

    /// A line through points in the panel's units; a point that is not finite breaks it.
    pub fn line(&mut self, panel: &Panel<'_>, points: &[(f64, f64)], stroke: Stroke) {
        let mut path = String::new();
        let mut pen_down = false;
        for (x, y) in points {
            if !(x.is_finite() && y.is_finite()) {
                pen_down = false;
                continue;
            }
            let command = if pen_down { 'L' } else { 'M' };
            // Writing to a String cannot fail.
            let _ = write!(path, "{command}{:.1} {:.1}", panel.x_px(*x), panel.y_px(*y));
            pen_down = true;
        }
        self.path(&path, stroke);
    }

    /// The area between a lower and an upper line, in the panel's units: (x, lower, upper).
    pub fn band(&mut self, panel: &Panel<'_>, points: &[(f64, f64, f64)], color: &str) {
        let mut corners: Vec<String> = points
            .iter()
            .map(|(x, low, _)| format!("{:.1},{:.1}", panel.x_px(*x), panel.y_px(*low)))
            .collect();
        corners.extend(
            points.iter().rev().map(|(x, _, high)| format!("{:.1},{:.1}", panel.x_px(*x), panel.y_px(*high))),
        );
        self.add(&format!(r#"<polygon points="{}" fill="{color}"/>"#, corners.join(" ")));
    }

    fn path(&mut self, d: &str, stroke: Stroke) {
        let Stroke { color, width, opacity, dash } = stroke;
        self.add(&format!(
            "<path d=\"{d}\" fill=\"none\" stroke=\"{color}\" stroke-width=\"{width}\" \
             stroke-opacity=\"{opacity}\" stroke-dasharray=\"{dash}\" stroke-linejoin=\"round\"/>"
        ));
    }

    fn add(&mut self, element: &str) {
        self.text.push_str(element);
        self.text.push('\n');
    }
}

impl Panel<'_> {
    fn x_px(&self, x: f64) -> f64 {
        let (left, _, width, _) = self.area;
        left + width * share(x, self.x)
    }

    fn y_px(&self, y: f64) -> f64 {
        let (_, top, _, height) = self.area;
        top + height * (1.0 - share(y, self.y))
    }
}

impl Anchor {
    const fn svg(self) -> &'static str {
        match self {
            Self::Start => "start",
            Self::Middle => "middle",
            Self::End => "end",
        }
    }
}

impl<'a> Axis<'a> {
    /// The axis of these values, with a margin of 6 %.
    #[must_use]
    pub fn around(values: impl Iterator<Item = f64>, label: &'a str) -> Self {
        let (low, high) = values
            .filter(|v| v.is_finite())
            .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| (low.min(v), high.max(v)));
        if low >= high {
            return Self { low: -1.0, high: 1.0, label };
        }
        let margin = 0.06 * (high - low);
        Self { low: low - margin, high: high + margin, label }
    }
}

/// Place on the axis 0..1; beyond the range it stays at the edge.
fn share(value: f64, axis: Axis<'_>) -> f64 {
    ((value - axis.low) / (axis.high - axis.low)).clamp(0.0, 1.0)
}

/// Returns round values of an axis, four to eight of them.
#[must_use]
pub fn ticks(low: f64, high: f64) -> Vec<f64> {
    let rough = (high - low) / 6.0;
    let power = 10_f64.powf(rough.log10().floor());
    let step =
        [1.0, 2.0, 2.5, 5.0, 10.0].map(|s| s * power).into_iter().find(|s| *s >= rough).unwrap_or(power);
    let first = (low / step - 1e-9).ceil() as i64;
    let last = (high / step + 1e-9).floor() as i64;
    (first..=last).map(|i| i as f64 * step).collect()
}

fn tick_text(value: f64) -> String {
    let text = format!("{:.3}", value + 0.0);
    text.trim_end_matches('0').trim_end_matches('.').replace('-', "\u{2212}")
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_round_and_inside_the_range() {
        assert_eq!(ticks(0.0, 100.0), [0.0, 20.0, 40.0, 60.0, 80.0, 100.0]);
        assert!(ticks(-33.0, 12.0).iter().all(|t| (-33.0..=12.0).contains(t)));
    }

    #[test]
    fn foreign_text_is_escaped() {
        let mut canvas = Canvas::new(10.0, 10.0);
        canvas.label((0.0, 0.0), 10.0, Anchor::Start, "</text><script>");
        assert!(!canvas.finish().contains("<script>"));
    }
}
