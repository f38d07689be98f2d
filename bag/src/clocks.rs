//! Times of one node on the clock of another one, by the clock readings in their files.

use std::{
    collections::{BTreeMap, BTreeSet, VecDeque},
    path::{Path, PathBuf},
};

use serde::Deserialize;

use crate::{
    error::BagError,
    read::{Item, Reader},
    writer::{CLOCK_TOPIC, METADATA},
};

/// A node of one incarnation: its monotonic clock is one clock.
pub(crate) type Node = (String, u64);

/// A clock reading, as it stands in a file.
#[derive(Debug, Deserialize)]
pub(crate) struct Reading {
    peer: String,
    #[serde(default)]
    incarnation: u64,
    at_ns: u64,
    offset_ns: i64,
    bound_ns: u64,
}

/// How far one clock is ahead of another one at a time.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
struct Knot {
    /// In nanoseconds of the clock that is converted.
    at_ns: i128,
    /// The nanoseconds to add to a time of the clock that is converted.
    add_ns: i128,
    bound_ns: u64,
}

/// The difference of two clocks over time: straight between two readings, and constant before the first and after the
/// last one.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct Step(Vec<Knot>);

impl Step {
    /// Returns a time on the other clock, and how wrong it may be.
    fn convert(&self, at_ns: i128) -> (i128, u64) {
        let place = self.0.partition_point(|knot| knot.at_ns <= at_ns);
        let before = place.checked_sub(1).and_then(|place| self.0.get(place));
        match (before, self.0.get(place)) {
            (Some(one), Some(other)) => {
                let (passed, all) = (at_ns - one.at_ns, (other.at_ns - one.at_ns).max(1));
                // Only clocks that no machine has differ by so much that this overflows.
                let gained = (other.add_ns - one.add_ns).checked_mul(passed).map_or(0, |gained| gained / all);
                let add = one.add_ns + gained;
                (at_ns + add, one.bound_ns.max(other.bound_ns))
            }
            (Some(only), None) | (None, Some(only)) => (at_ns + only.add_ns, only.bound_ns),
            (None, None) => (at_ns, 0),
        }
    }
}

/// Converts a time of a node's monotonic clock by these steps. Returns the time on the other clock, and how wrong
/// it may be.
pub(crate) fn convert(steps: &[Step], at_ns: i128) -> (i128, u64) {
    steps.iter().fold((at_ns, 0_u64), |(at_ns, bound_ns), step| {
        let (at_ns, further_ns) = step.convert(at_ns);
        (at_ns, bound_ns.saturating_add(further_ns))
    })
}

/// The differences of clocks that nodes measured, from a node to another one.
#[derive(Debug, Default)]
pub(crate) struct Offsets(BTreeMap<(Node, Node), Step>);

impl Offsets {
    /// Notes a reading of the node's file in both directions. `offset_ns` is its wall clock minus its monotonic clock.
    pub(crate) fn note(&mut self, own: &Node, offset_ns: i64, reading: &Reading) {
        let peer = (reading.peer.clone(), reading.incarnation);
        let own_ns = i128::from(reading.at_ns) - i128::from(offset_ns);
        let ahead_ns = i128::from(reading.offset_ns);
        let bound_ns = reading.bound_ns;
        let mut knot = |from: &Node, to: &Node, at_ns: i128, add_ns: i128| {
            let step = self.0.entry((from.clone(), to.clone())).or_default();
            step.0.push(Knot { at_ns, add_ns, bound_ns });
        };
        knot(own, &peer, own_ns, ahead_ns);
        knot(&peer, own, own_ns + ahead_ns, -ahead_ns);
    }

    /// Sorts the readings. Before it, the other functions give no result.
    pub(crate) fn settle(&mut self) {
        for step in self.0.values_mut() {
            step.0.sort_unstable();
            step.0.dedup_by_key(|knot| knot.at_ns);
        }
    }

    /// Returns the steps from the clock of one node to that of another one, over the fewest nodes; `None` if no reading
    /// connects them.
    pub(crate) fn between(&self, from: &Node, to: &Node) -> Option<Vec<Step>> {
        let mut open = VecDeque::from([(from, Vec::new())]);
        let mut seen = BTreeSet::from([from]);
        while let Some((at, steps)) = open.pop_front() {
            if at == to {
                return Some(steps);
            }
            for ((_, next), step) in
                self.0.range((at.clone(), Node::default())..).take_while(|((from, _), _)| from == at)
            {
                if seen.insert(next) {
                    open.push_back((next, [&steps[..], std::slice::from_ref(step)].concat()));
                }
            }
        }
        None
    }
}

/// The way of a file's times to the clock of the reference.
#[derive(Clone, Debug, Default)]
pub(crate) struct Way {
    /// Wall clock minus monotonic clock of the file.
    own_offset_ns: i64,
    steps: Vec<Step>,
    /// Wall clock minus monotonic clock of the reference.
    reference_offset_ns: i64,
}

impl Way {
    /// Returns a time of the file on the wall clock of the reference, and how wrong it may be.
    pub(crate) fn convert(&self, wall_ns: u64) -> (u64, u64) {
        let own_ns = i128::from(wall_ns) - i128::from(self.own_offset_ns);
        let (monotonic_ns, bound_ns) = convert(&self.steps, own_ns);
        let wall_ns = monotonic_ns + i128::from(self.reference_offset_ns);
        (u64::try_from(wall_ns.max(0)).unwrap_or(u64::MAX), bound_ns)
    }
}

/// The clocks of all files.
pub(crate) struct Clocks {
    /// The node of each file, and the offset of its wall clock.
    files: BTreeMap<PathBuf, (Node, i64)>,
    offsets: Offsets,
    reference: Option<(Node, i64)>,
}

impl Clocks {
    /// Reads the clock readings of all files. The first one has the reference.
    pub(crate) fn read<P: AsRef<Path>>(files: &[P]) -> Result<Self, BagError> {
        let mut clocks = Self { files: BTreeMap::new(), offsets: Offsets::default(), reference: None };
        for path in files {
            clocks.file(path.as_ref())?;
        }
        clocks.offsets.settle();
        Ok(clocks)
    }

    fn file(&mut self, path: &Path) -> Result<(), BagError> {
        let mut reader = Reader::open(path)?;
        let mut own: Option<(Node, i64)> = None;
        loop {
            match reader.next_item() {
                Ok(Some(Item::Metadata(name, fields))) if name == METADATA => {
                    let number = |key: &str| fields.get(key).and_then(|text| text.parse().ok());
                    let address = fields.get("address").cloned().unwrap_or_default();
                    let incarnation = fields.get("incarnation").and_then(|text| text.parse().ok());
                    own = Some(((address, incarnation.unwrap_or(0)), number("wall_offset_ns").unwrap_or(0)));
                }
                Ok(Some(Item::Message(message))) if message.channel.topic == CLOCK_TOPIC => {
                    let reading: Option<Reading> = serde_json::from_slice(message.data).ok();
                    if let (Some((node, offset_ns)), Some(reading)) = (&own, reading) {
                        self.offsets.note(node, *offset_ns, &reading);
                    }
                }
                Ok(Some(_)) | Err(BagError::Damaged { .. }) => {}
                Ok(None) => break,
                Err(error) => return Err(error),
            }
        }
        let Some(own) = own else {
            let text = "it has no clock of a node; give files that `sinew record` wrote";
            return Err(BagError::Unfit(format!("{}: {text}", path.display())));
        };
        self.reference.get_or_insert_with(|| own.clone());
        self.files.insert(path.to_owned(), own);
        Ok(())
    }

    /// Returns the way of a file's times to the reference, over the fewest nodes.
    pub(crate) fn way(&self, path: &Path) -> Result<Way, BagError> {
        let (Some((node, own_offset_ns)), Some((reference, reference_offset_ns))) =
            (self.files.get(path), &self.reference)
        else {
            return Ok(Way::default());
        };
        if let Some(steps) = self.offsets.between(node, reference) {
            let (own_offset_ns, reference_offset_ns) = (*own_offset_ns, *reference_offset_ns);
            return Ok(Way { own_offset_ns, steps, reference_offset_ns });
        }
        let text = format!(
            "no clock reading connects its node {} with {}, the node of the first file",
            node.0, reference.0
        );
        Err(BagError::Unfit(format!(
            "{}: {text}; give also the file of a node that both know",
            path.display()
        )))
    }
}
