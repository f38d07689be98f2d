//! When messages were sent, and whether the other node was recording then.

use std::collections::BTreeMap;

use crate::clocks::{Node, Offsets, Step, convert};

/// Maximum blocks of send times of one channel.
const BLOCKS_MAX: usize = 256;
/// A message that was sent so shortly before the end of the other recording may still have been on its way, in
/// nanoseconds.
const TRANSIT_NS: i128 = 1_000_000_000;

/// Successive messages. Times are nanoseconds of the file's wall clock.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Block {
    first_ns: u64,
    last_ns: u64,
    count: u64,
}

/// The send times of a channel in one file: exact up to [`BLOCKS_MAX`] messages, and beyond by the first and last time
/// of each block.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct SendTimes {
    blocks: Vec<Block>,
    /// Messages of a block, as a power of two.
    doublings: u32,
}

impl SendTimes {
    pub(super) fn insert(&mut self, at_ns: u64) {
        let full = 1_u64.checked_shl(self.doublings).unwrap_or(u64::MAX);
        match self.blocks.last_mut() {
            Some(block) if block.count < full => {
                (block.first_ns, block.last_ns) = (block.first_ns.min(at_ns), block.last_ns.max(at_ns));
                block.count += 1;
            }
            Some(_) | None => self.blocks.push(Block { first_ns: at_ns, last_ns: at_ns, count: 1 }),
        }
        if self.blocks.len() > BLOCKS_MAX {
            let pair = |pair: &[Block]| Block {
                first_ns: pair.iter().map(|block| block.first_ns).min().unwrap_or(0),
                last_ns: pair.iter().map(|block| block.last_ns).max().unwrap_or(0),
                count: pair.iter().map(|block| block.count).sum(),
            };
            self.blocks = self.blocks.chunks(2).map(pair).collect();
            self.doublings += 1;
        }
    }
}

/// Where a message lies relative to the recordings of its receiver.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Place {
    /// Before one of them began, or between two.
    Before,
    /// Certainly within one of them.
    Within,
    /// After all of them had ended, or shortly before.
    After,
}

/// The messages of a channel, by their places.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Placed {
    /// Messages that the receiver's recordings must have; of a block that is only partly within them, one.
    pub(super) within: u64,
    /// Messages after the receiver's recordings.
    pub(super) after: u64,
    /// Whether no clock reading connects the source with any of them. Then all messages count as within.
    pub(super) has_no_clock: bool,
}

/// The recordings of one node: from the first to the last tally of each, in nanoseconds of its monotonic clock.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct Recordings(BTreeMap<(u64, u64), (i128, i128)>);

impl Recordings {
    /// Adds the file of a recording, which its incarnation and its begin identify.
    pub(super) fn add(&mut self, recording: (u64, u64), (first_ns, last_ns): (i128, i128)) {
        let span = self.0.entry(recording).or_insert((first_ns, last_ns));
        *span = (span.0.min(first_ns), span.1.max(last_ns));
    }

    /// Returns the group of each recording. Recordings of one incarnation that overlap in time are in one group: they
    /// had the same messages.
    pub(super) fn groups(&self) -> BTreeMap<(u64, u64), usize> {
        let mut all: Vec<_> =
            self.0.iter().map(|(recording, span)| (recording.0, *span, *recording)).collect();
        all.sort_unstable();
        let (mut groups, mut group, mut before) = (BTreeMap::new(), 0, None);
        for (incarnation, (first_ns, last_ns), recording) in all {
            before = match before {
                Some((same, end_ns)) if same == incarnation && first_ns <= end_ns => {
                    Some((incarnation, last_ns.max(end_ns)))
                }
                Some(_) | None => {
                    group += 1;
                    Some((incarnation, last_ns))
                }
            };
            groups.insert(recording, group);
        }
        groups
    }

    /// Returns the sum of the counts of all recordings. Of those that overlap in time only the largest count is added.
    pub(super) fn sum(&self, counts: impl Iterator<Item = ((u64, u64), u64)>) -> u64 {
        let groups = self.groups();
        let mut largest: BTreeMap<usize, u64> = BTreeMap::new();
        for (recording, count) in counts {
            // Those without a tally have no time: they may overlap.
            let group = groups.get(&recording).copied().unwrap_or(0);
            let known = largest.entry(group).or_default();
            *known = count.max(*known);
        }
        largest.into_values().fold(0, u64::saturating_add)
    }

    /// Compares the messages that `from` sent, by a wall clock that is `offset_ns` ahead of its monotonic clock, with
    /// the recordings of the node at `address`.
    pub(super) fn place(
        &self,
        (from, offset_ns): (&Node, i64),
        sent: &SendTimes,
        address: &str,
        offsets: &Offsets,
    ) -> Placed {
        let mut placed = Placed::default();
        let mut spans = Vec::new();
        for ((incarnation, _), span) in &self.0 {
            // The source measured no clock of this incarnation, so it was not connected with it.
            if let Some(steps) = offsets.between(from, &(address.to_owned(), *incarnation)) {
                spans.push((steps, *span));
            }
        }
        placed.has_no_clock = spans.is_empty() && !self.0.is_empty();
        for Block { first_ns, last_ns, count } in &sent.blocks {
            let [first, last] =
                [first_ns, last_ns].map(|at_ns| place(i128::from(*at_ns) - i128::from(offset_ns), &spans));
            if placed.has_no_clock || (first, last) == (Place::Within, Place::Within) {
                placed.within += count;
            } else if first == Place::Within || last == Place::Within {
                placed.within += 1;
                placed.after += if last == Place::After { count - 1 } else { 0 };
            } else if first == Place::After {
                placed.after += count;
            }
        }
        placed
    }
}

/// Returns the place of a message that was sent at this time of the source's monotonic clock.
fn place(at_ns: i128, spans: &[(Vec<Step>, (i128, i128))]) -> Place {
    let mut is_after = !spans.is_empty();
    for (steps, (first_ns, last_ns)) in spans {
        let (at_ns, bound_ns) = convert(steps, at_ns);
        let bound_ns = i128::from(bound_ns);
        let is_before_end = at_ns + bound_ns + TRANSIT_NS <= *last_ns;
        if at_ns - bound_ns >= *first_ns && is_before_end {
            return Place::Within;
        }
        is_after &= !is_before_end && at_ns + bound_ns >= *first_ns;
    }
    if is_after { Place::After } else { Place::Before }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn many_times_are_few_blocks_with_exact_ends() {
        let mut times = SendTimes::default();
        (1..=10_000).for_each(|at_ns| times.insert(at_ns));
        assert!(times.blocks.len() <= BLOCKS_MAX, "{}", times.blocks.len());
        assert_eq!(times.blocks.iter().map(|block| block.count).sum::<u64>(), 10_000);
        assert!(
            times.blocks.windows(2).all(|pair| pair[0].last_ns + 1 == pair[1].first_ns),
            "no message is between two blocks"
        );
        assert_eq!(times.blocks.last().map(|block| block.last_ns), Some(10_000));
    }

    #[test]
    fn counts_of_overlapping_recordings_are_not_added() {
        let mut recordings = Recordings::default();
        // Given: two that overlap, a third behind them, and one of a later incarnation
        for (recording, span) in
            [((1, 10), (10, 50)), ((1, 20), (20, 90)), ((1, 95), (95, 99)), ((2, 5), (5, 9))]
        {
            recordings.add(recording, span);
        }
        let counts = [((1, 10), 3), ((1, 20), 4), ((1, 95), 5), ((2, 5), 6)];
        assert_eq!(recordings.sum(counts.into_iter()), 4 + 5 + 6);
    }
}
