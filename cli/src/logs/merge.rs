//! The lines of several nodes, in the order of their times. Pure.

use std::{cmp::Reverse, collections::BinaryHeap};

use sinew::NodeAddress;

/// Maximum number of lines that wait for older ones of other nodes, and maximum bytes of their texts. Beyond these the
/// oldest ones are released.
const HELD_MAX: usize = 65_536;
const HELD_BYTES_MAX: usize = 64 << 20;

/// A line of a node, or a gap in its lines. The order of the fields is the order of the output.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Entry {
    /// When it was written, on the clock of the entry node, in nanoseconds.
    pub(super) at_ns: u64,
    pub(super) node: NodeAddress,
    /// The number of the line; of a gap, that of the line after it.
    pub(super) number: u64,
    pub(super) content: Content,
}

impl Entry {
    const fn bytes(&self) -> usize {
        match &self.content {
            Content::Lost(_) => 0,
            Content::Line { level, target, text } => level.len() + target.len() + text.len(),
        }
    }
}

/// The content of an entry. A gap is before the line with the same number.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Content {
    /// Number of lines that the node does not keep any more.
    Lost(u64),
    Line {
        level: String,
        target: String,
        text: String,
    },
}

/// Lines that were read, and are not shown yet.
#[derive(Debug, Default)]
pub(super) struct Merge {
    held: BinaryHeap<Reverse<Entry>>,
    bytes: usize,
}

impl Merge {
    pub(super) fn push(&mut self, entry: Entry) {
        self.bytes += entry.bytes();
        self.held.push(Reverse(entry));
    }

    /// Returns whether some lines must be released before all nodes were read up to them.
    pub(super) fn is_full(&self) -> bool {
        self.held.len() > HELD_MAX || self.bytes > HELD_BYTES_MAX
    }

    /// Removes the entries up to this time, oldest first. All nodes must have been read up to it.
    pub(super) fn release(&mut self, until_ns: u64) -> Vec<Entry> {
        let mut released = Vec::new();
        while let Some(Reverse(oldest)) = self.held.peek()
            && (oldest.at_ns <= until_ns || self.is_full())
            && let Some(Reverse(entry)) = self.held.pop()
        {
            self.bytes -= entry.bytes();
            released.push(entry);
        }
        released
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const HIP: NodeAddress = NodeAddress::new(0x0a00_0001);
    const KNEE: NodeAddress = NodeAddress::new(0x0a00_0002);

    fn line(at_ns: u64, node: NodeAddress, number: u64) -> Entry {
        let [level, target] = ["info", "sinew::node"].map(str::to_owned);
        Entry { at_ns, node, number, content: Content::Line { level, target, text: number.to_string() } }
    }

    fn keys(entries: &[Entry]) -> Vec<(u64, NodeAddress, u64)> {
        entries.iter().map(|entry| (entry.at_ns, entry.node, entry.number)).collect()
    }

    #[test]
    fn lines_of_all_nodes_are_released_by_time() {
        let mut merge = Merge::default();
        for entry in [line(5, HIP, 1), line(9, HIP, 2), line(3, KNEE, 7), line(7, KNEE, 8)] {
            merge.push(entry);
        }
        let first = merge.release(7);
        assert_eq!(keys(&first), [(3, KNEE, 7), (5, HIP, 1), (7, KNEE, 8)]);
        // A later line of a node that was read late is before the one that waits.
        merge.push(line(8, KNEE, 9));
        assert_eq!(keys(&merge.release(u64::MAX)), [(8, KNEE, 9), (9, HIP, 2)]);
        assert!(merge.release(u64::MAX).is_empty());
    }

    #[test]
    fn gap_is_before_the_line_after_it() {
        let mut merge = Merge::default();
        merge.push(line(5, HIP, 3));
        merge.push(Entry { content: Content::Lost(2), ..line(5, HIP, 3) });
        let released = merge.release(5);
        assert!(matches!(released[0].content, Content::Lost(2)), "{released:?}");
        assert!(matches!(released[1].content, Content::Line { .. }), "{released:?}");
    }

    #[test]
    fn long_waiting_lines_are_bounded_in_bytes() {
        let mut merge = Merge::default();
        let long = |number| {
            let [level, target] = ["info", "sinew::node"].map(str::to_owned);
            let text = "x".repeat(HELD_BYTES_MAX / 4);
            Entry { content: Content::Line { level, target, text }, ..line(100 + number, HIP, number) }
        };
        (1..=3).for_each(|number| merge.push(long(number)));
        assert!(!merge.is_full() && merge.release(0).is_empty());
        (4..=5).for_each(|number| merge.push(long(number)));
        assert!(merge.is_full());
        assert_eq!(keys(&merge.release(0)), [(101, HIP, 1), (102, HIP, 2)]);
        assert!(!merge.is_full());
        assert_eq!((merge.release(u64::MAX).len(), merge.bytes), (3, 0));
    }

    #[test]
    fn waiting_lines_are_bounded_and_the_oldest_released() {
        let mut merge = Merge::default();
        for number in 1..=HELD_MAX as u64 + 2 {
            merge.push(line(100 + number, HIP, number));
        }
        assert_eq!(keys(&merge.release(0)), [(101, HIP, 1), (102, HIP, 2)]);
    }
}
