//! The counts of messages on direct links, in the counters of a client's region; `docs/protocol/lncl.md` has the
//! layout.

use sinew_runtime::tid::Tid;
use sinew_shm::Counters;

/// Maximum number of direct links of a client.
pub const LINKS_MAX: usize = 64;
/// Counters of each link: peer, sent, superseded, taken.
const WIDTH: usize = 4;
const _: () = assert!((LINKS_MAX + 1) * WIDTH <= Counters::LEN, "there are counters for all links");

/// Messages of applications on one link, or on several.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LinkCounts {
    /// Written to the peer's ring, or waiting for room there.
    pub sent: u64,
    /// Of those, values that a newer one replaced before they were written.
    pub superseded: u64,
    /// Read from the peer.
    pub taken: u64,
}

impl LinkCounts {
    const fn words(self) -> [u64; 3] {
        [self.sent, self.superseded, self.taken]
    }
}

impl std::ops::Add for LinkCounts {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        // A client may report any number.
        Self {
            sent: self.sent.wrapping_add(other.sent),
            superseded: self.superseded.wrapping_add(other.superseded),
            taken: self.taken.wrapping_add(other.taken),
        }
    }
}

/// The counters of one place of a client: of one link, or of all links that have ended.
#[derive(Clone, Debug)]
pub struct LinkCounters {
    counters: Counters,
    place: usize,
}

impl LinkCounters {
    /// Returns the counters of the link at `place`, below [`LINKS_MAX`]; of the ended links at `LINKS_MAX`.
    pub fn at(counters: &Counters, place: usize) -> Self {
        Self { counters: counters.clone(), place: place.min(LINKS_MAX) }
    }

    /// Assigns the place to the link with this peer; `Tid::NONE`: to none.
    pub fn set_peer(&self, peer: Tid) {
        self.counters.set(self.place * WIDTH, peer.bits());
    }

    /// Sets the counts.
    #[inline]
    pub fn set(&self, counts: LinkCounts) {
        for (index, value) in counts.words().into_iter().enumerate() {
            self.counters.set(self.place * WIDTH + 1 + index, value);
        }
    }
}

/// Reads the counters of a client: its links with their peers, and what has ended.
pub fn read(counters: &[u64; Counters::LEN]) -> (Vec<(Tid, LinkCounts)>, LinkCounts) {
    let (places, _) = counters.as_chunks::<WIDTH>();
    let counts = |place: &[u64; WIDTH]| LinkCounts { sent: place[1], superseded: place[2], taken: place[3] };
    let links = places[..LINKS_MAX].iter().filter(|place| place[0] != 0);
    (links.map(|place| (Tid::from_bits(place[0]), counts(place))).collect(), counts(&places[LINKS_MAX]))
}
