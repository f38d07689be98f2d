//! Who is missing at a barrier and waits at another one, for somebody who waits here.

use super::*;

impl Waits {
    /// At which other barriers `name` waits for somebody who waits for it here, in the words that say so.
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

    /// The same where it may have been forgotten how often a barrier has opened, and some wait at those that never do.
    pub(super) fn may_wait_for_us(&self, (process, here): (usize, usize), name: &str) -> Vec<String> {
        let others = BARRIERS.iter().map(|(name, _)| (*name).to_owned()).chain((0..OTHERS).map(other));
        let others: Vec<String> = others.filter(|name| name != BARRIERS[here].0).collect();
        let is_there = |barrier: &&String| self.told[&process].waiting(barrier).any(|(who, _)| who == name);
        let waits_here = self.present(process, here);
        let words = |barrier: &String| waits_here.iter().map(|who| mutual(barrier, who)).collect::<Vec<_>>();
        others.iter().filter(is_there).flat_map(words).collect()
    }
}

fn mutual(barrier: &str, awaited: &str) -> String {
    format!("waits at '{barrier}' for {awaited}, which waits here for it")
}
