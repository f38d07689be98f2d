//! The question about the newest lines of a node's log, and its answer.

use serde::{Deserialize, Serialize};
use sinew_model::bounded::at_most;
use sinew_runtime::{
    tid::Incarnation,
    wire::{Class, Payload},
};

use super::Report;

/// Maximum number of lines of a log in one answer.
pub const LOG_LINES_MAX: usize = 256;

/// Asks for the lines of the node's log from a number on. [`LogsReport`] answers.
///
/// # Examples
///
/// ```
/// use sinew::{AppAddress, Endpoint, Tid, client::ApiError, inspect::{AskLogs, LogsReport}, prelude::*};
///
/// /// Returns the warnings and errors since the last call, and keeps the number of the next line.
/// fn warnings(endpoint: &mut Endpoint, node: NodeAddress, from: &mut u64) -> Result<LogsReport, ApiError> {
///     let inspect = Tid::new(node, AppAddress::INSPECT);
///     let question = AskLogs { from: *from, level: Some("warn".to_owned()), newest: None };
///     let report: LogsReport = endpoint.message(inspect, &question).ask(Duration::from_secs(1))?;
///     *from = report.next;
///     Ok(report)
/// }
/// ```
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct AskLogs {
    /// The number of the first line; 0 for the oldest one that the node keeps.
    #[serde(default)]
    pub from: u64,
    /// The least severe level: `error`, `warn`, `info`, `debug`, `trace`. `None`: all levels.
    #[serde(default)]
    pub level: Option<String>,
    /// Only so many of the newest lines; then `from` does not count. `None`: all from `from` on.
    #[serde(default)]
    pub newest: Option<u32>,
}

impl Payload for AskLogs {
    const NAME: &'static str = "sinew.inspect.logs";
}

/// Lines of a node's log, oldest first. All nodes of one process have the lines of that process.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct LogsReport {
    /// The node's name.
    pub name: String,
    /// Its incarnation. Another one numbers its lines from 1 again.
    pub incarnation: Incarnation,
    /// When the answer was made, on the node's clock, in nanoseconds.
    pub now_ns: u64,
    /// The lines.
    #[serde(deserialize_with = "at_most::<_, _, LOG_LINES_MAX>")]
    pub lines: Vec<LogLine>,
    /// The number from which the next question asks.
    pub next: u64,
    /// Whether there are further lines now.
    pub more: bool,
    /// Number of lines of any level, before these ones and not before the requested number, that the node does not
    /// keep.
    pub lost: u64,
}

impl Payload for LogsReport {
    const NAME: &'static str = "sinew.inspect.logs_report";
}

/// A line of a node's log.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct LogLine {
    /// Its number, from 1 on.
    pub number: u64,
    /// When it was written, on the node's clock, in nanoseconds.
    pub at_ns: u64,
    /// `error`, `warn`, `info`, `debug`, `trace`.
    pub level: String,
    /// The part of the program that logged it, as `SINEW_LOG` names it.
    pub target: String,
    /// Its message and fields, at most 4,096 bytes.
    pub text: String,
}

/// Its class yields to all messages that the application sends and receives.
impl Report for LogsReport {
    const TRAVELS: Class = Class::Bulk;

    /// Leaves the second half of the lines for the next question. A single line loses the second half of its text.
    fn halve(&mut self) -> bool {
        if self.lines.len() > 1 {
            let kept = self.lines.len() / 2;
            (self.next, self.more) = (self.lines[kept].number, true);
            self.lines.truncate(kept);
            return true;
        }
        let Some(line) = self.lines.first_mut() else { return false };
        let had_any = !line.text.is_empty();
        line.text.truncate(line.text.floor_char_boundary(line.text.len() / 2));
        had_any
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    // spec: INSPECT-11
    #[test]
    fn shortened_answer_names_the_first_line_that_it_lacks() {
        let line = |number| LogLine {
            number,
            at_ns: number,
            level: "info".to_owned(),
            target: "sinew::node".to_owned(),
            text: "ää".to_owned(),
        };
        let mut report = LogsReport {
            name: "knee".to_owned(),
            incarnation: Incarnation(1),
            now_ns: 9,
            lines: (4..9).map(line).collect(),
            next: 9,
            more: false,
            lost: 0,
        };
        assert!(report.halve());
        assert_eq!((report.lines.len(), report.next, report.more), (2, 6, true));
        assert!(report.halve());
        assert_eq!((report.lines.len(), report.next), (1, 5));
        // A line that does not fit is cut, and not asked for again.
        assert!(report.halve());
        assert_eq!((report.lines[0].text.as_str(), report.next), ("ä", 5));
        assert!(report.halve() && !report.halve());
        assert_eq!(report.lines[0].text, "");
    }
}
