//! Parties that are missing at a barrier and wait at another one, for an application that waits at the first.

use super::*;

impl Waits {
    /// Returns the other barriers at which `name` waits for an application that waits for it here, in the
    /// reported text.
    pub(super) fn waits_for_us(&self, (process, here): (usize, usize), name: &str) -> Vec<String> {
        let mut words = Vec::new();
        let waits_here = self.present(process, here);
        for barrier in (0..BARRIERS.len()).filter(|barrier| *barrier != here) {
            let there = self.present(process, barrier);
            if !there.contains(&name) {
                continue;
            }
            let lacks =
                |party: &&Requirement| there.iter().filter(|name| party.counts(name)).count() < party.count();
            let lacking: Vec<&Requirement> = self.parties[barrier].iter().filter(lacks).collect();
            let is_awaited =
                |who: &&&str| !there.contains(*who) && lacking.iter().any(|party| party.counts(who));
            let awaited = waits_here.iter().filter(is_awaited);
            words.extend(awaited.map(|who| mutual(BARRIERS[barrier].0, who)));
        }
        words
    }

    /// The same where the number of openings of a barrier may have been forgotten, and some applications wait
    /// at barriers that never open.
    pub(super) fn may_wait_for_us(&self, (process, here): (usize, usize), name: &str) -> Vec<String> {
        let others = BARRIERS.iter().map(|(name, _)| (*name).to_owned()).chain((0..OTHERS).map(other));
        let others: Vec<String> = others.filter(|name| name != BARRIERS[here].0).collect();
        let is_there = |barrier: &&String| self.inputs[&process].waiting(barrier).any(|(who, _)| who == name);
        let waits_here = self.present(process, here);
        let words = |barrier: &String| waits_here.iter().map(|who| mutual(barrier, who)).collect::<Vec<_>>();
        others.iter().filter(is_there).flat_map(words).collect()
    }
}

fn mutual(barrier: &str, awaited: &str) -> String {
    format!("waits at '{barrier}' for {awaited}, which waits here for it")
}
