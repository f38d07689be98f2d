//! The size of this node's barrier frame, and its content if not everything fits.
//!
//! An arrival is rejected if the barriers of this node's own applications could exceed the frame. These
//! barriers therefore always fit. Barriers that only other nodes published are left out first.

use super::*;

/// Maximum size of a frame without its barriers, in bytes: a map of three fields, two numbers, the head of an
/// array.
const FRAME_OVERHEAD: usize = 64;
/// Maximum size of a barrier without its name, parties, members and arrivals, in bytes: a map of six fields,
/// a number, four heads of arrays.
const BARRIER: usize = 96;
/// Maximum overhead of a text, in bytes.
const TEXT: usize = 3;
/// Maximum size of a member, in bytes: a map of four fields, an address, three numbers.
const MEMBER: usize = 72;
/// Maximum size of an arrival without its name, in bytes: a map of four fields, an address, two numbers.
const ARRIVAL: usize = 48;

impl BarrierState {
    /// Returns the maximum size of the barrier in the frame, in bytes.
    fn bytes_max(&self, key: &BarrierKey) -> usize {
        let arrivals =
            self.waiting.values().map(|wait| ARRIVAL + text(wait.name.as_deref().unwrap_or_default()));
        self.frame_bytes(key) + self.members.len() * MEMBER + arrivals.sum::<usize>()
    }

    /// Returns the same size after an opening with all required members, if that is larger.
    fn bytes_when_open(&self, key: &BarrierKey) -> usize {
        let takes: usize = self.parties.iter().map(Requirement::count).sum();
        self.bytes_max(key).max(self.frame_bytes(key) + takes * MEMBER)
    }

    fn frame_bytes(&self, key: &BarrierKey) -> usize {
        BARRIER + text(&key.name) + key.parties.iter().map(|party| text(party)).sum::<usize>()
    }

    /// Returns the order in the frame: barriers with local waits first, then barriers with local visitors.
    fn rank(&self) -> (bool, bool) {
        (self.waiting.is_empty(), self.visitors.is_empty())
    }
}

const fn text(text: &str) -> usize {
    TEXT + text.len()
}

impl Rendezvous {
    /// Checks that the frame has room for one more arrival at `key`, which waits for `parties`.
    ///
    /// # Errors
    /// Returns a description with a remedy if there is no room.
    pub(super) fn has_room(
        &self,
        key: &BarrierKey,
        parties: &[Requirement],
        name: &str,
    ) -> Result<(), String> {
        let bytes = self.bytes_with(key, parties, name, |known| !known.visitors.is_empty());
        if bytes <= self.bytes_max {
            return Ok(());
        }
        Err(format!(
            "this node's barrier frame could take {bytes} bytes, and its limit is {}, so other nodes would not receive this barrier; use \
             fewer barriers at once, patterns or counts in place of long lists of names, or raise `node.payload_max`",
            self.bytes_max
        ))
    }

    /// Returns the maximum size of the frame with the barriers that `is_meant` selects and the one at `key`,
    /// including one more arrival there.
    pub(super) fn bytes_with(
        &self,
        key: &BarrierKey,
        parties: &[Requirement],
        name: &str,
        is_meant: impl Fn(&BarrierState) -> bool,
    ) -> usize {
        let meant = self.barriers.iter().filter(|(other, known)| *other == key || is_meant(known));
        let bytes: usize = meant.map(|(key, known)| known.bytes_when_open(key)).sum();
        let is_new = !self.barriers.contains_key(key);
        let of_new = if is_new { BarrierState::new(parties.to_vec()).bytes_when_open(key) } else { 0 };
        FRAME_OVERHEAD + ARRIVAL + text(name) + bytes + of_new
    }

    /// Returns the encoded frame, and how many barriers have no room in it. spec: SYNC-11
    pub(super) fn encode(&self) -> (Bytes, usize) {
        let whole = self.frame(self.barriers.iter());
        if whole.len() <= self.bytes_max {
            return (whole, 0);
        }
        let mut known: Vec<(&BarrierKey, &BarrierState)> = self.barriers.iter().collect();
        known.sort_by_key(|(_, known)| known.rank());
        let mut left = self.bytes_max.saturating_sub(FRAME_OVERHEAD);
        let has_room = |(key, known): &(&BarrierKey, &BarrierState)| {
            left.checked_sub(known.bytes_max(key)).inspect(|rest| left = *rest).is_some()
        };
        let fitting: Vec<_> = known.into_iter().filter(has_room).collect();
        let left_out = self.barriers.len() - fitting.len();
        (self.frame(fitting.into_iter()), left_out)
    }

    fn frame<'known>(
        &self,
        known: impl Iterator<Item = (&'known BarrierKey, &'known BarrierState)>,
    ) -> Bytes {
        let barriers = known.map(|(key, known)| known.published(key)).collect();
        Arrivals { incarnation: self.incarnation, version: self.version, barriers }.encode()
    }
}
