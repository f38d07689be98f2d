//! Horizontal bar charts: Sinew in one colour, everything else in grey, on a linear scale from 0.
//!
//! The background is white in the file itself, so that a page in dark mode shows the chart as it is.

use sinew_figures::canvas::{Anchor, Canvas, ticks};

use crate::numbers::grouped;

const SINEW: &str = "#0b6bcb";
const OTHERS: &str = "#9aa5b1";

/// Sizes, pixels.
const WIDTH: f64 = 800.0;
const LEFT: f64 = 250.0;
/// Width of the longest bar; its text stands behind it.
const LONGEST: f64 = 400.0;
const ROW: f64 = 26.0;
const BAR: f64 = 17.0;
const HEAD: f64 = 44.0;
const GROUP_HEAD: f64 = 30.0;
const CAPTION_LINE: f64 = 16.0;

/// A bar.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Bar {
    pub(crate) label: String,
    pub(crate) value: f64,
    /// The value for readers.
    pub(crate) text: String,
    pub(crate) owner: Owner,
}

/// The program that a bar is about.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Owner {
    Sinew,
    Other,
}

impl Owner {
    /// The owner of a path with this name for readers.
    pub(crate) fn of(label: &str) -> Self {
        if label.starts_with("Sinew") { Self::Sinew } else { Self::Other }
    }

    const fn color(self) -> &'static str {
        match self {
            Self::Sinew => SINEW,
            Self::Other => OTHERS,
        }
    }
}

/// Bars under a title of their own, which may be empty.
#[derive(Debug)]
pub(crate) struct Group {
    pub(crate) title: &'static str,
    pub(crate) bars: Vec<Bar>,
}

/// A chart. All groups have the same scale.
#[derive(Debug)]
pub(crate) struct BarChart {
    pub(crate) title: String,
    /// The shown quantity, with its unit.
    pub(crate) axis: &'static str,
    pub(crate) groups: Vec<Group>,
    pub(crate) caption: Vec<String>,
}

impl BarChart {
    /// Draws the chart as SVG.
    ///
    /// # Errors
    /// There is no bar.
    pub(crate) fn draw(&self) -> Result<String, String> {
        let values = self.groups.iter().flat_map(|group| &group.bars).map(|bar| bar.value);
        let greatest = values.fold(0.0, f64::max);
        if greatest <= 0.0 {
            return Err(format!("there are no results for the chart \"{}\"", self.title));
        }
        let bottom = self.groups.iter().fold(HEAD, |top, group| top + group.height());
        let height = bottom + 50.0 + CAPTION_LINE * self.caption.len() as f64;
        let mut canvas = Canvas::new(WIDTH, height);
        canvas.heading((16.0, 26.0), 16.0, &self.title);
        self.axis(&mut canvas, greatest, bottom);
        let mut top = HEAD;
        for group in &self.groups {
            group.draw(&mut canvas, top, greatest);
            top += group.height();
        }
        for (line, text) in (1..).zip(&self.caption) {
            let y = bottom + 40.0 + CAPTION_LINE * f64::from(line);
            canvas.label((16.0, y), 11.5, Anchor::Start, text);
        }
        Ok(canvas.finish())
    }

    fn axis(&self, canvas: &mut Canvas, greatest: f64, bottom: f64) {
        for tick in ticks(0.0, greatest) {
            let x = x_px(tick, greatest);
            canvas.grid_line((x, HEAD), bottom - HEAD);
            let text = if tick.fract() == 0.0 { grouped(tick as u64) } else { tick.to_string() };
            canvas.label((x, bottom + 15.0), 12.0, Anchor::Middle, &text);
        }
        canvas.label((LEFT, bottom + 33.0), 12.5, Anchor::Start, self.axis);
    }
}

impl Group {
    fn height(&self) -> f64 {
        let head = if self.title.is_empty() { 0.0 } else { GROUP_HEAD };
        head + ROW * self.bars.len() as f64
    }

    fn draw(&self, canvas: &mut Canvas, top: f64, greatest: f64) {
        let mut top = top;
        if !self.title.is_empty() {
            canvas.heading((16.0, top + 20.0), 13.0, self.title);
            top += GROUP_HEAD;
        }
        for bar in &self.bars {
            let (end, baseline) = (x_px(bar.value, greatest), top + BAR - 1.0);
            canvas.label((LEFT - 8.0, baseline), 12.5, Anchor::End, &bar.label);
            canvas.bar((LEFT, top + 3.0, end - LEFT, BAR), bar.owner.color());
            canvas.label((end + 6.0, baseline), 12.5, Anchor::Start, &bar.text);
            top += ROW;
        }
    }
}

fn x_px(value: f64, greatest: f64) -> f64 {
    LEFT + LONGEST * value / greatest
}

#[cfg(test)]
mod tests {
    use super::*;

    fn chart(values: &[f64]) -> BarChart {
        let bar = |value: &f64| Bar {
            label: "Sinew & others".to_owned(),
            value: *value,
            text: value.to_string(),
            owner: Owner::Sinew,
        };
        let bars = values.iter().map(bar).collect();
        BarChart {
            title: "T".to_owned(),
            axis: "us",
            groups: vec![Group { title: "", bars }],
            caption: Vec::new(),
        }
    }

    /// Returns the lengths of the bars of a drawn chart.
    fn lengths(drawn: &str) -> Vec<f64> {
        let bars = drawn.lines().filter(|line| line.contains(SINEW));
        let width = |line: &str| line.split_once("width=\"")?.1.split('"').next()?.parse().ok();
        bars.filter_map(width).collect()
    }

    #[test]
    fn lengths_are_proportional_from_zero() {
        assert_eq!(lengths(&chart(&[10.0, 40.0, 20.0]).draw().unwrap()), [100.0, 400.0, 200.0]);
    }

    #[test]
    fn chart_without_bars_is_an_error() {
        assert!(chart(&[]).draw().unwrap_err().contains("\"T\""));
    }

    #[test]
    fn owner_is_told_by_the_label() {
        assert_eq!(["Sinew, direct link", "Zenoh"].map(Owner::of), [Owner::Sinew, Owner::Other]);
    }
}
