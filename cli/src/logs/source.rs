//! The lines of one node: the number of the next one, and its clock.

use sinew::{
    NodeAddress, Time,
    address::Incarnation,
    inspect::{AskLogs, LogsReport},
};

use super::merge::{Content, Entry};

/// A node, and the place up to which its lines were read.
#[derive(Debug)]
pub(super) struct Source {
    pub(super) node: NodeAddress,
    pub(super) name: String,
    incarnation: Option<Incarnation>,
    next: u64,
    /// Its clock minus that of the entry node, as that node has measured it.
    pub(super) offset_ns: Option<i64>,
    /// The time of its latest line, on the clock of the entry node: lines of one node keep their order.
    latest_ns: u64,
    /// Up to here its lines were read, on the clock of the entry node.
    pub(super) read_ns: u64,
    pub(super) more: bool,
    /// Why it was not read the last time.
    pub(super) fault: Option<String>,
    /// When it is asked again after a fault.
    pub(super) due: Time,
}

impl Source {
    pub(super) const fn new(node: NodeAddress, name: String) -> Self {
        Self {
            node,
            name,
            incarnation: None,
            next: 0,
            offset_ns: None,
            latest_ns: 0,
            read_ns: 0,
            more: false,
            fault: None,
            due: Time::ZERO,
        }
    }

    pub(super) fn question(&self, level: &str) -> AskLogs {
        AskLogs { from: self.next, level: Some(level.to_owned()), newest: None }
    }

    /// Returns the entries of an answer that came at `now`. A node that was started anew is read from its first line:
    /// its answer to a number of its predecessor is not used.
    pub(super) fn take(&mut self, report: LogsReport, now: Time) -> Vec<Entry> {
        let is_new = self.incarnation.replace(report.incarnation) != Some(report.incarnation);
        if !report.name.is_empty() {
            self.name.clone_from(&report.name);
        }
        if is_new && self.next > 0 {
            (self.next, self.more) = (0, true);
            return Vec::new();
        }
        (self.next, self.more) = (report.next, report.more);
        let offset_ns = self.offset_ns.unwrap_or_else(|| difference(report.now_ns, now.as_nanos()));
        let at_entry = |ns: u64| ns.saturating_add_signed(offset_ns.saturating_neg());
        let now_ns = at_entry(report.now_ns);
        let mut entries = Vec::new();
        if report.lost > 0 {
            let first = report.lines.first();
            let at_ns = first.map_or(now_ns, |line| at_entry(line.at_ns)).max(self.latest_ns);
            let number = first.map_or(report.next, |line| line.number);
            entries.push(Entry { at_ns, node: self.node, number, content: Content::Lost(report.lost) });
        }
        for line in report.lines {
            self.latest_ns = at_entry(line.at_ns).max(self.latest_ns);
            let content = Content::Line { level: line.level, target: line.target, text: line.text };
            entries.push(Entry { at_ns: self.latest_ns, node: self.node, number: line.number, content });
        }
        // Further lines may be as old as the latest one of this answer.
        self.read_ns = if report.more { self.latest_ns } else { now_ns };
        entries
    }
}

/// Returns `left - right`, or the nearest number that fits.
fn difference(left: u64, right: u64) -> i64 {
    i64::try_from(i128::from(left) - i128::from(right)).unwrap_or(if left > right {
        i64::MAX
    } else {
        i64::MIN
    })
}

#[cfg(test)]
mod tests {
    use sinew::inspect::LogLine;

    use super::*;

    const KNEE: NodeAddress = NodeAddress::new(0x0a00_0002);
    const NOW: Time = Time::from_nanos(1_000);

    fn report(incarnation: u64, times: &[(u64, u64)]) -> LogsReport {
        let line = |(number, at_ns): &(u64, u64)| LogLine {
            number: *number,
            at_ns: *at_ns,
            level: "info".to_owned(),
            target: "sinew::node".to_owned(),
            text: number.to_string(),
        };
        LogsReport {
            name: "knee".to_owned(),
            incarnation: Incarnation(incarnation),
            now_ns: 1_500,
            lines: times.iter().map(line).collect(),
            next: times.last().map_or(1, |(number, _)| number + 1),
            more: false,
            lost: 0,
        }
    }

    fn times(entries: &[Entry]) -> Vec<(u64, u64)> {
        entries.iter().map(|entry| (entry.number, entry.at_ns)).collect()
    }

    #[test]
    fn times_are_those_of_the_entry_node() {
        let mut measured = Source { offset_ns: Some(400), ..Source::new(KNEE, String::new()) };
        assert_eq!(times(&measured.take(report(1, &[(1, 1_300), (2, 1_400)]), NOW)), [(1, 900), (2, 1_000)]);
        assert_eq!((measured.read_ns, measured.name.as_str()), (1_100, "knee"));
        // Without a measurement the answer itself is one.
        let mut unknown = Source::new(KNEE, String::new());
        assert_eq!(times(&unknown.take(report(1, &[(1, 1_300)]), NOW)), [(1, 800)]);
    }

    #[test]
    fn lines_of_a_node_keep_their_order() {
        let mut source = Source { offset_ns: Some(0), ..Source::new(KNEE, String::new()) };
        assert_eq!(times(&source.take(report(1, &[(1, 900)]), NOW)), [(1, 900)]);
        // When: its clock was measured anew
        source.offset_ns = Some(200);
        assert_eq!(times(&source.take(report(1, &[(2, 950)]), NOW)), [(2, 900)]);
    }

    #[test]
    fn restarted_node_is_read_from_its_first_line() {
        let mut source = Source { offset_ns: Some(0), ..Source::new(KNEE, String::new()) };
        source.take(report(1, &[(1, 100), (2, 200)]), NOW);
        let question = AskLogs { from: 3, level: Some("warn".to_owned()), newest: None };
        assert_eq!(source.question("warn"), question);
        assert!(source.take(report(2, &[(3, 400)]), NOW).is_empty());
        assert_eq!((source.question("warn").from, source.more), (0, true));
        assert_eq!(times(&source.take(report(2, &[(1, 300)]), NOW)), [(1, 300)]);
    }

    #[test]
    fn gap_has_the_time_of_the_line_after_it() {
        let mut source = Source { offset_ns: Some(0), ..Source::new(KNEE, String::new()) };
        let entries = source.take(LogsReport { lost: 4, ..report(1, &[(5, 700)]) }, NOW);
        assert_eq!(times(&entries), [(5, 700), (5, 700)]);
        assert_eq!(entries[0].content, Content::Lost(4));
        // Without a line it is at the time of the answer.
        let entries = source.take(LogsReport { lost: 2, next: 9, ..report(1, &[]) }, NOW);
        assert_eq!(times(&entries), [(9, 1_500)]);
    }

    #[test]
    fn clocks_at_their_limits_do_not_overflow() {
        let (low, high) = (difference(0, u64::MAX), difference(u64::MAX, 0));
        assert_eq!((low, high, difference(7, 9)), (i64::MIN, i64::MAX, -2));
        let mut source = Source { offset_ns: Some(i64::MIN), ..Source::new(KNEE, String::new()) };
        assert_eq!(times(&source.take(report(1, &[(1, u64::MAX)]), NOW)), [(1, u64::MAX)]);
    }
}
