//! Who waits at which barrier and who is missing there, for whoever asks. It decides nothing.

use std::cell::Cell;

use super::{
    evaluate::{Present, arrived, missing},
    *,
};

/// Barriers that are looked at for one question at most: where many wait that is work, and the sync manager waits for it.
const LOOKS_MAX: usize = 64;

/// All who wait anywhere, as far as this node knows.
pub(in crate::sync::core) struct WhoWaits<'known> {
    barriers: Vec<(&'known Key, &'known Known, Vec<Present<'known>>)>,
    /// Where each name waits, by the places above.
    places: BTreeMap<&'known str, Vec<usize>>,
    looks_left: Cell<usize>,
}

impl Rendezvous {
    /// Who waits anywhere; `linked` gives the life of a node that can be heard.
    pub(in crate::sync::core) fn who_waits(
        &self,
        linked: impl Fn(NodeAddress) -> Option<Incarnation>,
    ) -> WhoWaits<'_> {
        let barriers: Vec<_> =
            self.known.iter().map(|(key, known)| (key, known, self.present(key, known, &linked))).collect();
        let mut places: BTreeMap<&str, Vec<usize>> = BTreeMap::new();
        for (place, (_, _, present)) in barriers.iter().enumerate() {
            for name in present.iter().map(|present| present.name).filter(|name| !name.is_empty()) {
                places.entry(name).or_default().push(place);
            }
        }
        WhoWaits { barriers, places, looks_left: Cell::new(LOOKS_MAX) }
    }
}

impl WhoWaits<'_> {
    /// Who is missing at `key`, since when, and the last that is known of each. `why_not` says why an application of a name is not ready.
    pub(in crate::sync::core) fn missing(
        &self,
        now: Time,
        key: &Key,
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

    /// Where `name`, which is missing at `key`, waits for one of those who wait `here`, if it does: as long as both wait there alone, each keeps
    /// the other.
    fn waits_for_us(&self, key: &Key, here: &[Present<'_>], name: &str) -> Option<String> {
        let places = self.places.get(name)?.iter().map(|place| &self.barriers[*place]);
        places.filter(|(other, ..)| *other != key).find_map(|(other, known, there)| {
            self.looks_left.set(self.looks_left.get().checked_sub(1)?);
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
