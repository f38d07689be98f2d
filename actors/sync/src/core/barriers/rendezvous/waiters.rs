//! Waiting applications and missing parties of all barriers, for inspection only.

use std::cell::Cell;

use super::{
    evaluate::{Present, arrived, missing},
    *,
};

/// Maximum number of barriers that one query inspects. With many waits an inspection is expensive, and the
/// sync manager waits for it.
const CHECKS_MAX: usize = 64;

/// All waiting applications that this node knows.
pub(in crate::core) struct Waiters<'known> {
    barriers: Vec<(&'known BarrierKey, &'known BarrierState, Vec<Present<'known>>)>,
    /// The indexes in `barriers` at which each name waits.
    places: BTreeMap<&'known str, Vec<usize>>,
    checks_left: Cell<usize>,
}

impl Rendezvous {
    /// Returns all waiting applications. `linked` returns the incarnation of a reachable node.
    pub(in crate::core) fn waiters(
        &self,
        linked: impl Fn(NodeAddress) -> Option<Incarnation>,
    ) -> Waiters<'_> {
        let barriers: Vec<_> = self
            .barriers
            .iter()
            .map(|(key, known)| (key, known, self.present(key, known, &linked)))
            .collect();
        let mut places: BTreeMap<&str, Vec<usize>> = BTreeMap::new();
        for (place, (_, _, present)) in barriers.iter().enumerate() {
            for name in present.iter().map(|present| present.name).filter(|name| !name.is_empty()) {
                places.entry(name).or_default().push(place);
            }
        }
        Waiters { barriers, places, checks_left: Cell::new(CHECKS_MAX) }
    }
}

impl Waiters<'_> {
    /// Returns the missing parties at `key`, since when, and the last known state of each. `why_not` returns
    /// why an application of a name is not ready.
    pub(in crate::core) fn missing(
        &self,
        now: Time,
        key: &BarrierKey,
        why_not: impl Fn(&str) -> Option<Reason>,
    ) -> Vec<Absence> {
        let Ok(place) = self.barriers.binary_search_by(|(other, ..)| (*other).cmp(key)) else {
            return Vec::new();
        };
        let (_, known, present) = &self.barriers[place];
        let absence = |(party, name, why): (usize, String, String)| {
            let since = known.absent_since(party).map_or(Duration::ZERO, |absent| now.since(absent));
            let why = self.waits_for_us(key, present, &name).unwrap_or(why);
            Absence { name, why: why.into(), since }
        };
        missing(&known.parties, present, &why_not).into_iter().map(absence).collect()
    }

    /// Returns at which other barrier `name`, which is missing at `key`, waits for an application in `here`.
    /// While each waits at its own barrier, both are blocked.
    fn waits_for_us(&self, key: &BarrierKey, here: &[Present<'_>], name: &str) -> Option<String> {
        let places = self.places.get(name)?.iter().map(|place| &self.barriers[*place]);
        places.filter(|(other, ..)| *other != key).find_map(|(other, known, there)| {
            self.checks_left.set(self.checks_left.get().checked_sub(1)?);
            let lacking: Vec<_> =
                known.parties.iter().filter(|party| arrived(party, there) < party.count()).collect();
            let is_awaited = |present: &&Present<'_>| {
                !present.name.is_empty()
                    && lacking.iter().any(|party| party.counts(present.name))
                    && there.iter().all(|other| other.name != present.name)
            };
            let awaited = here.iter().find(is_awaited)?.name;
            Some(format!("waits at '{}' for {awaited}, which waits here for it", &*other.name))
        })
    }
}
