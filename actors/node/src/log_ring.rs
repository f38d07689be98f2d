//! The newest lines of the node's log, kept in memory for the inspection.
//!
//! The thread that logs never meets the lock of the ring: the log thread fills it (`runtime/src/log`), and a reader
//! holds the lock only to copy references. Lines that the log's own queue had no room for are counted.

use std::{
    collections::VecDeque,
    sync::{Arc, Mutex},
};

use sinew_runtime::{
    lock,
    log::{self, LogObserver, tracing::Level},
    time::Time,
};

/// Maximum number of kept lines.
const LINES_MAX: usize = 2_048;
/// Maximum bytes of all kept targets and texts. Debug lines of a busy node fill it within seconds.
const BYTES_MAX: usize = 256 * 1024;
/// Maximum bytes of the text of one line, and of its target; the rest is left out.
const TEXT_BYTES_MAX: usize = 4_096;
const TARGET_BYTES_MAX: usize = 128;

/// A bounded ring of the newest lines, with numbers from 1 on.
#[derive(Debug)]
pub(crate) struct LogRing(Mutex<Kept>);

/// A kept line.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct Line {
    pub(crate) number: u64,
    pub(crate) at: Time,
    pub(crate) level: Level,
    pub(crate) target: String,
    pub(crate) text: String,
    /// Number of lines that the queue of the log had no room for, since the line before.
    lost: u64,
}

impl Line {
    pub(crate) fn bytes(&self) -> usize {
        self.target.len() + self.text.len()
    }
}

#[derive(Debug)]
struct Kept {
    lines: VecDeque<Arc<Line>>,
    bytes: usize,
    /// The number of the next line.
    next: u64,
    /// The lost lines of the process that are counted in a line.
    lost: u64,
}

/// The lines that a reader gets, and how many it does not get.
#[derive(Debug, Default, PartialEq, Eq)]
pub(crate) struct Found {
    pub(crate) lines: Vec<Arc<Line>>,
    /// The number from which the next question asks.
    pub(crate) next: u64,
    /// Whether there are further lines now.
    pub(crate) more: bool,
    /// Lines before these, from the requested number on, that are not kept any more or were never kept.
    pub(crate) lost: u64,
}

/// The request of a reader.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Wanted {
    /// The number of the first line; 0 for the oldest that is kept.
    pub(crate) from: u64,
    /// The least severe level.
    pub(crate) level: Level,
    pub(crate) lines_max: usize,
    /// Maximum bytes of targets and texts. The first line is returned also if it is longer.
    pub(crate) bytes_max: usize,
}

impl LogRing {
    /// Returns an empty ring that receives the lines of this process from now on, for as long as it lives. The node of
    /// a process with too many of them keeps none.
    pub(crate) fn begin() -> Arc<Self> {
        let ring = Arc::new(Self::new(log::lost()));
        let observer: Arc<dyn LogObserver> = ring.clone();
        log::observe(&observer);
        ring
    }

    const fn new(lost: u64) -> Self {
        Self(Mutex::new(Kept { lines: VecDeque::new(), bytes: 0, next: 1, lost }))
    }

    /// Returns the lines from a number on.
    pub(crate) fn read(&self, wanted: Wanted) -> Found {
        lock(&self.0).read(wanted)
    }

    /// Returns the newest lines, oldest first. `from` does not count.
    pub(crate) fn newest(&self, wanted: Wanted) -> Found {
        lock(&self.0).newest(wanted)
    }
}

impl LogObserver for LogRing {
    fn wrote(&self, level: Level, target: &str, text: &str) {
        let (target, text) = (cut(target, TARGET_BYTES_MAX), cut(text, TEXT_BYTES_MAX));
        let line = Line { number: 0, at: Time::now(), level, target, text, lost: 0 };
        let replaced = lock(&self.0).push(line, log::lost());
        // Their memory is freed without the lock.
        drop(replaced);
    }
}

fn cut(text: &str, bytes_max: usize) -> String {
    text[..text.floor_char_boundary(bytes_max)].to_owned()
}

impl Kept {
    /// Adds a line, and returns those that it replaces. `lost` is the number of lost lines of the process so far.
    fn push(&mut self, line: Line, lost: u64) -> Vec<Arc<Line>> {
        let new = lost.saturating_sub(self.lost);
        self.lost = lost;
        self.bytes += line.bytes();
        self.lines.push_back(Arc::new(Line { number: self.next, lost: new, ..line }));
        self.next += 1;
        let mut replaced = Vec::new();
        while self.lines.len() > LINES_MAX || self.bytes > BYTES_MAX {
            let Some(oldest) = self.lines.pop_front() else { break };
            self.bytes -= oldest.bytes();
            replaced.push(oldest);
        }
        replaced
    }

    fn read(&self, wanted: Wanted) -> Found {
        let Wanted { from, level, lines_max, bytes_max } = wanted;
        let oldest = self.lines.front().map_or(self.next, |line| line.number);
        // A number that this ring has not reached is of another one.
        let from = if from > self.next { 0 } else { from };
        let missed = if from == 0 { 0 } else { oldest.saturating_sub(from) };
        let mut found = Found { next: from.max(oldest), lost: missed, ..Found::default() };
        let skipped = usize::try_from(found.next - oldest).unwrap_or(usize::MAX);
        let mut bytes = 0;
        for line in self.lines.iter().skip(skipped) {
            let is_shown = line.level <= level;
            let is_full = found.lines.len() >= lines_max || bytes + line.bytes() > bytes_max;
            if is_shown && is_full && !found.lines.is_empty() {
                found.more = true;
                break;
            }
            // Lost lines after the first one of an answer are in the next answer: they are at its begin.
            if line.lost > 0 && !found.lines.is_empty() {
                found.more = true;
                break;
            }
            found.lost += line.lost;
            found.next = line.number + 1;
            if is_shown {
                bytes += line.bytes();
                found.lines.push(line.clone());
            }
        }
        found
    }

    fn newest(&self, wanted: Wanted) -> Found {
        let Wanted { level, lines_max, bytes_max, .. } = wanted;
        let mut bytes = 0;
        let has_room = |line: &&Arc<Line>| {
            bytes += line.bytes();
            bytes <= bytes_max
        };
        let shown = self.lines.iter().rev().filter(|line| line.level <= level).take(lines_max);
        let mut lines: Vec<_> = shown.take_while(has_room).cloned().collect();
        lines.reverse();
        Found { lines, next: self.next, ..Found::default() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn line(level: Level, text: &str) -> Line {
        let (target, text) = ("sinew::gncl".to_owned(), text.to_owned());
        Line { number: 0, at: Time::from_nanos(7), level, target, text, lost: 0 }
    }

    fn kept(count: usize) -> Kept {
        let LogRing(kept) = LogRing::new(0);
        let mut kept = kept.into_inner().expect("no thread has panicked with it");
        for number in 0..count {
            kept.push(line(Level::INFO, &number.to_string()), 0);
        }
        kept
    }

    fn all(from: u64) -> Wanted {
        Wanted { from, level: Level::TRACE, lines_max: usize::MAX, bytes_max: usize::MAX }
    }

    fn numbers(found: &Found) -> Vec<u64> {
        found.lines.iter().map(|line| line.number).collect()
    }

    #[test]
    fn lines_and_bytes_are_bounded_and_the_newest_remain() {
        let mut kept = kept(LINES_MAX + 3);
        assert_eq!((kept.lines.len(), kept.lines[0].number), (LINES_MAX, 4));
        let long = "x".repeat(TEXT_BYTES_MAX);
        for _ in 0..2 * BYTES_MAX / TEXT_BYTES_MAX {
            kept.push(line(Level::INFO, &long), 0);
        }
        let sum: usize = kept.lines.iter().map(|line| line.bytes()).sum();
        assert!(sum == kept.bytes && sum <= BYTES_MAX && sum > BYTES_MAX - 2 * TEXT_BYTES_MAX, "{sum}");
    }

    #[test]
    fn reader_gets_each_line_once_and_replaced_ones_counted() {
        let mut kept = kept(3);
        let first = kept.read(all(0));
        assert_eq!((numbers(&first), first.next, first.more, first.lost), (vec![1, 2, 3], 4, false, 0));
        assert_eq!(kept.read(all(4)), Found { next: 4, ..Found::default() });
        for _ in 0..LINES_MAX + 5 {
            kept.push(line(Level::INFO, "later"), 0);
        }
        let next = kept.read(all(4));
        assert_eq!((next.lines.len(), next.lost, next.lines[0].number), (LINES_MAX, 5, 9));
    }

    #[test]
    fn answer_is_bounded_and_the_next_one_continues_it() {
        let kept = kept(10);
        let mut wanted = Wanted { lines_max: 4, ..all(0) };
        let mut seen = Vec::new();
        loop {
            let found = kept.read(wanted);
            seen.extend(numbers(&found));
            wanted.from = found.next;
            if !found.more {
                break;
            }
        }
        assert_eq!(seen, (1..=10).collect::<Vec<_>>());
        // A line that is longer than the answer may be is the only one of it.
        let found = kept.read(Wanted { bytes_max: 1, ..all(0) });
        assert_eq!((numbers(&found), found.next, found.more), (vec![1], 2, true));
    }

    #[test]
    fn less_severe_lines_are_skipped() {
        let mut kept = kept(2);
        kept.push(line(Level::ERROR, "it broke"), 0);
        kept.push(line(Level::DEBUG, "detail"), 0);
        let found = kept.read(Wanted { level: Level::WARN, ..all(0) });
        assert_eq!((numbers(&found), found.next, found.more), (vec![3], 5, false));
    }

    #[test]
    fn newest_lines_are_bounded_and_in_order() {
        let mut kept = kept(10);
        kept.push(line(Level::DEBUG, "detail"), 0);
        let newest = Wanted { from: 2, level: Level::INFO, lines_max: 3, bytes_max: usize::MAX };
        let found = kept.newest(newest);
        assert_eq!((numbers(&found), found.next, found.more), (vec![8, 9, 10], 12, false));
        let two_lines = 2 * kept.lines[8].bytes();
        assert_eq!(numbers(&kept.newest(Wanted { bytes_max: two_lines, ..newest })), [9, 10]);
        assert!(kept.newest(Wanted { lines_max: 0, ..newest }).lines.is_empty());
    }

    #[test]
    fn lost_lines_are_counted_before_the_next_line() {
        let mut kept = kept(2);
        kept.push(line(Level::INFO, "after the gap"), 7);
        let before = kept.read(all(0));
        assert_eq!((numbers(&before), before.lost, before.more), (vec![1, 2], 0, true));
        let after = kept.read(all(before.next));
        assert_eq!((numbers(&after), after.lost, after.more), (vec![3], 7, false));
    }

    #[test]
    fn number_of_another_ring_starts_from_the_oldest_line() {
        let kept = kept(3);
        for from in [5, u64::MAX] {
            assert_eq!(numbers(&kept.read(all(from))), [1, 2, 3]);
        }
        let empty = LogRing::new(0).read(all(u64::MAX));
        assert_eq!(empty, Found { next: 1, ..Found::default() });
    }

    #[test]
    fn long_texts_are_cut_at_a_character() {
        let ring = LogRing::new(log::lost());
        ring.wrote(Level::INFO, "sinew::node", &"ä".repeat(TEXT_BYTES_MAX));
        let found = ring.read(all(0));
        assert_eq!(found.lines[0].text.len(), TEXT_BYTES_MAX);
        ring.wrote(Level::INFO, "sinew::node", &format!("x{}", "ä".repeat(TEXT_BYTES_MAX)));
        assert_eq!(ring.read(all(0)).lines[1].text.len(), TEXT_BYTES_MAX - 1);
    }
}
