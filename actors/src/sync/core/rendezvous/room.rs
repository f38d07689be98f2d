//! How long our word may be, and what goes into it where not everything has room.
//!
//! Who arrives is refused where the word could become too long by the barriers of this node's own applications, so that these always
//! have room. What only other nodes speak of is left out first.

use super::*;

/// Bytes of a word beside its barriers, at most: a map of three fields, two numbers, the head of an array.
const WORD: usize = 64;
/// Bytes of a barrier beside its name, parties, members and arrivals, at most: a map of six fields, a number, four heads of arrays.
const BARRIER: usize = 96;
/// Bytes beside a text, at most.
const TEXT: usize = 3;
/// Bytes of a member, at most: a map of four fields, an address, three numbers.
const MEMBER: usize = 72;
/// Bytes of an arrival beside its name, at most: a map of four fields, an address, two numbers.
const ARRIVAL: usize = 48;

impl Known {
    /// Bytes of it in our word, at most.
    fn bytes_max(&self, key: &Key) -> usize {
        let arrivals =
            self.waiting.values().map(|wait| ARRIVAL + text(wait.name.as_deref().unwrap_or_default()));
        self.frame_bytes(key) + self.members.len() * MEMBER + arrivals.sum::<usize>()
    }

    /// The same when it has opened for those that its parties take, if that is more.
    fn bytes_when_open(&self, key: &Key) -> usize {
        let takes: usize = self.parties.iter().map(Requirement::count).sum();
        self.bytes_max(key).max(self.frame_bytes(key) + takes * MEMBER)
    }

    fn frame_bytes(&self, key: &Key) -> usize {
        BARRIER + text(&key.name) + key.parties.iter().map(|party| text(party)).sum::<usize>()
    }

    /// What has room first: where somebody of this node waits, then where somebody was.
    fn rank(&self) -> (bool, bool) {
        (self.waiting.is_empty(), self.visitors.is_empty())
    }
}

const fn text(text: &str) -> usize {
    TEXT + text.len()
}

impl Rendezvous {
    /// Whether our word has room for one more who arrives at `key`, where it waits for `parties`.
    ///
    /// # Errors
    /// How it may have, in words.
    pub(super) fn has_room(&self, key: &Key, parties: &[Requirement], name: &str) -> Result<(), String> {
        let bytes = self.bytes_with(key, parties, name, |known| !known.visitors.is_empty());
        if bytes <= self.bytes_max {
            return Ok(());
        }
        Err(format!(
            "what this node says of its barriers could take {bytes} of {} bytes, so that other nodes did not hear of it; use \
             fewer barriers at once, patterns or counts in place of long lists of names, or raise `node.payload_max`",
            self.bytes_max
        ))
    }

    /// Bytes of the barriers that are meant and of the one at `key` in our word, at most, with one more who arrives there.
    pub(super) fn bytes_with(
        &self,
        key: &Key,
        parties: &[Requirement],
        name: &str,
        is_meant: impl Fn(&Known) -> bool,
    ) -> usize {
        let meant = self.known.iter().filter(|(other, known)| *other == key || is_meant(known));
        let bytes: usize = meant.map(|(key, known)| known.bytes_when_open(key)).sum();
        let is_new = !self.known.contains_key(key);
        let of_new = if is_new { Known::new(parties.to_vec()).bytes_when_open(key) } else { 0 };
        WORD + ARRIVAL + text(name) + bytes + of_new
    }

    /// Our word, and how many barriers have no room in it. spec: SYNC-11
    pub(super) fn write(&self) -> (Bytes, usize) {
        let whole = self.word(self.known.iter());
        if whole.len() <= self.bytes_max {
            return (whole, 0);
        }
        let mut known: Vec<(&Key, &Known)> = self.known.iter().collect();
        known.sort_by_key(|(_, known)| known.rank());
        let mut left = self.bytes_max.saturating_sub(WORD);
        let has_room = |(key, known): &(&Key, &Known)| {
            left.checked_sub(known.bytes_max(key)).inspect(|rest| left = *rest).is_some()
        };
        let told: Vec<_> = known.into_iter().filter(has_room).collect();
        let left_out = self.known.len() - told.len();
        (self.word(told.into_iter()), left_out)
    }

    fn word<'known>(&self, known: impl Iterator<Item = (&'known Key, &'known Known)>) -> Bytes {
        let barriers = known.map(|(key, known)| known.said(key)).collect();
        Arrivals { incarnation: self.incarnation, version: self.version, barriers }.encode()
    }
}
