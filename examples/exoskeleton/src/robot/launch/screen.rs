//! The status screen: a picture ten times a second on a terminal, a line for each change elsewhere.

use std::fmt::Debug;
use std::io::{self, IsTerminal};

use exoskeleton_model::joint::Joint;
use sinew::Time;

use super::console::View;
use crate::output;

const BAR: usize = 30;
const UP_AND_CLEAR: &str = "\x1b[1A\x1b[2K";
/// Long lines end at the terminal's edge: a wrapped one would be two to remove.
const CLIP: &str = "\x1b[?7l";
const WRAP: &str = "\x1b[?7h";

pub(super) struct Screen {
    is_terminal: bool,
    strides: u32,
    began: Time,
    /// Lines of the picture on the terminal.
    drawn: usize,
    printed: Printed,
}

/// The last printed state, where only changes are printed.
#[derive(Default)]
struct Printed {
    waiting: Vec<String>,
    strides: Option<u32>,
    states: String,
}

impl Screen {
    pub(super) fn new(strides: u32, began: Time) -> Self {
        let is_terminal = io::stdout().is_terminal();
        Self { is_terminal, strides, began, drawn: 0, printed: Printed::default() }
    }

    /// Prints a line that stays.
    pub(super) fn print(&mut self, line: &str) {
        let time = self.time();
        let clear = self.clear();
        output::print(&format!("{clear}{time} {line}\n"));
    }

    /// Shows the statuses.
    pub(super) fn show(&mut self, view: &View, strides: Option<u32>) {
        if self.is_terminal {
            let lines = self.picture(view, strides);
            let clear = self.clear();
            self.drawn = lines.len();
            output::print(&format!("{clear}{CLIP}{}\n{WRAP}", lines.join("\n")));
        } else {
            self.print_changes(view, strides);
        }
    }

    /// Removes the picture.
    pub(super) fn close(&mut self) {
        let clear = self.clear();
        output::print(&clear);
    }

    fn clear(&mut self) -> String {
        UP_AND_CLEAR.repeat(std::mem::take(&mut self.drawn))
    }

    fn time(&self) -> String {
        format!("{:6.1} s", Time::now().since(self.began).as_secs_f64())
    }

    fn print_changes(&mut self, view: &View, strides: Option<u32>) {
        // Without the times, which change always.
        let waiting: Vec<String> = view.waiting().iter().map(|line| untimed(line)).collect();
        let printed = std::mem::replace(&mut self.printed.waiting, waiting.clone());
        waiting.iter().filter(|line| !printed.contains(line)).for_each(|line| self.print(line));
        let states = states(view);
        if states != self.printed.states {
            self.print(&states);
            self.printed.states = states;
        }
        if strides != self.printed.strides {
            self.printed.strides = strides;
            let stride = strides.unwrap_or(0) + 1;
            if stride <= self.strides {
                self.print(&format!("stride {stride} of {}", self.strides));
            }
        }
    }

    fn picture(&self, view: &View, strides: Option<u32>) -> Vec<String> {
        let mut lines = vec![format!("{}  four nodes and a plant on this host", self.time())];
        lines.extend(view.waiting().into_iter().map(|line| format!("  barrier: {line}")));
        lines.push(match view.gait() {
            None => "  central  -".to_owned(),
            Some(gait) => format!(
                "  central  {:5}  phase [{}] {:3.0} %  trust {:.2}  loop late {:.1} ms at most",
                shown(gait.mode),
                bar(gait.phase),
                100.0 * gait.phase,
                gait.confidence,
                f64::from(gait.late_max_us) / 1000.0
            ),
        });
        lines.extend(Joint::ALL.map(|joint| match view.drive(joint) {
            None => format!("  {:7}  -", joint.name()),
            Some(drive) => format!(
                    "  {:7}  {:5}  {:+6.1} Nm  inputs {} old at most  {} ticks without them",
                    joint.name(),
                    format!("{:?}", drive.state),
                    drive.torque_nm,
                    drive
                        .age_max_us
                        .map_or_else(|| "?".to_owned(), |us| format!("{:.1} ms", f64::from(us) / 1000.0)),
                    drive.misses
                ),
        }));
        lines.push(match strides {
            None => "  standing".to_owned(),
            Some(strides) => format!("  stride {} of {}", (strides + 1).min(self.strides), self.strides),
        });
        lines
    }
}

fn states(view: &View) -> String {
    let central = shown(view.gait().and_then(|gait| gait.mode));
    let drives =
        Joint::ALL.map(|joint| format!("{joint} {}", shown(view.drive(joint).map(|drive| drive.state))));
    format!("central {central}, {}", drives.join(", "))
}

fn shown(state: Option<impl Debug>) -> String {
    state.map_or_else(|| "-".to_owned(), |state| format!("{state:?}"))
}

/// "X has waited 1.3 s for Y" without the time.
fn untimed(line: &str) -> String {
    match (line.split_once(" has waited "), line.split_once(" for ")) {
        (Some((waiter, _)), Some((_, target))) => format!("{waiter} waits for {target}"),
        (Some(_) | None, Some(_) | None) => line.to_owned(),
    }
}

fn bar(phase: f32) -> String {
    let full = ((phase.clamp(0.0, 1.0) * BAR as f32) as usize).min(BAR);
    format!("{}{}", "#".repeat(full), ".".repeat(BAR - full))
}

#[cfg(test)]
#[path = "../../../tests/unit/screen.rs"]
mod tests;
