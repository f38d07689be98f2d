//! Whether a barrier opens, and what becomes of those who wait where it does not.

use super::*;

/// Who waits at a barrier behind its last generation.
struct Present {
    member: Member,
    name: String,
}

impl Rendezvous {
    /// Opens what can be opened, then tells those whose time is over or who do not want to wait for a lost party. `linked` gives the
    /// life of a node that can be heard, `why_not` why an application of a name is not ready.
    pub(in crate::sync::core) fn evaluate(
        &mut self,
        now: Time,
        linked: impl Fn(NodeAddress) -> Option<Incarnation>,
        why_not: impl Fn(&str) -> Option<Reason>,
    ) {
        let keys: Vec<Key> = self
            .known
            .iter()
            .filter(|(_, known)| !known.waiting.is_empty())
            .map(|(key, _)| key.clone())
            .collect();
        for key in keys {
            let present = self.present(&key, &linked);
            let Some(known) = self.known.get_mut(&key) else { continue };
            if is_complete(&known.parties, &present) && known.generation < GENERATION_MAX {
                // spec: SYNC-11
                known.generation += 1;
                known.members =
                    present.into_iter().map(|present| present.member).take(ARRIVALS_MAX).collect();
                let passed = known.pass(self.node, self.incarnation);
                self.answer_opened(passed);
                self.changed(now);
                continue;
            }
            let has_lost = known.parties.iter().any(|party| is_lost(party, &present, &why_not));
            let over: Vec<AppAddress> = known
                .waiting
                .iter_mut()
                .filter_map(|(app, wait)| wait.is_over(now, has_lost).then_some(*app))
                .collect();
            if over.is_empty() {
                continue;
            }
            let missing = missing(&known.parties, &present, &why_not);
            for app in over {
                let Some(wait) = known.waiting.remove(&app) else { continue };
                let missing = missing.clone();
                let answer = if wait.until <= now {
                    BarrierAnswer::TimedOut { missing }
                } else {
                    BarrierAnswer::Lost { missing }
                };
                self.answers.push((app, wait.correlation, answer));
            }
            self.changed(now);
        }
    }

    /// Who waits at `key` behind the last generation that is known here, on this node and on all that can be heard.
    fn present(&self, key: &Key, linked: &impl Fn(NodeAddress) -> Option<Incarnation>) -> Vec<Present> {
        let Some(known) = self.known.get(key) else { return Vec::new() };
        let mut present = Vec::new();
        for wait in known.waiting.values().filter(|wait| wait.after == known.generation) {
            let member = Member { node: self.node, incarnation: self.incarnation, party: wait.party };
            present.push(Present { member, name: wait.name.as_deref().unwrap_or_default().to_owned() });
        }
        for (node, peer) in self.peers.iter().filter(|(_, peer)| peer.heard) {
            let Some(said) = peer.said.as_ref().filter(|said| linked(*node) == Some(said.incarnation)) else {
                continue;
            };
            let of_it = said.barriers.iter().find(|barrier| barrier.is_about(key));
            let arrivals = of_it.into_iter().flat_map(|barrier| &barrier.arrivals);
            for arrival in arrivals.filter(|arrival| arrival.after == known.generation) {
                let member = Member { node: *node, incarnation: said.incarnation, party: arrival.party };
                present
                    .push(Present { member, name: arrival.name.as_deref().unwrap_or_default().to_owned() });
            }
        }
        present
    }

    /// Who is missing at `key`, and the last that is known of each.
    pub(in crate::sync::core) fn missing(
        &self,
        key: &Key,
        linked: impl Fn(NodeAddress) -> Option<Incarnation>,
        why_not: impl Fn(&str) -> Option<Reason>,
    ) -> Vec<(String, String)> {
        let present = self.present(key, &linked);
        self.known.get(key).map_or_else(Vec::new, |known| missing(&known.parties, &present, &why_not))
    }
}

impl Wait {
    /// Whether its time is over, or that of a lost party's return.
    fn is_over(&mut self, now: Time, has_lost: bool) -> bool {
        match (self.on_loss, has_lost) {
            (OnPartyLoss::Fail, true) => {
                self.lost.get_or_insert(now);
            }
            (OnPartyLoss::Fail, false) | (OnPartyLoss::Wait, _) => self.lost = None,
        }
        self.next() <= now
    }
}

fn arrived(party: &Requirement, present: &[Present]) -> usize {
    present.iter().filter(|present| party.counts(&present.name)).count()
}

/// Whether all parties are there. spec: SYNC-11
fn is_complete(parties: &[Requirement], present: &[Present]) -> bool {
    parties.iter().all(|party| arrived(party, present) >= party.count())
}

/// Whether a party that is asked for by its name is not there and has ended, as far as is known. spec: SYNC-13
fn is_lost(party: &Requirement, present: &[Present], why_not: &impl Fn(&str) -> Option<Reason>) -> bool {
    let is_missing = arrived(party, present) < party.count();
    let reason = party.only_name().filter(|_| is_missing).and_then(why_not);
    reason.is_some_and(Reason::is_end)
}

fn missing(
    parties: &[Requirement],
    present: &[Present],
    why_not: &impl Fn(&str) -> Option<Reason>,
) -> Vec<(String, String)> {
    let mut missing = Vec::new();
    for party in parties {
        let there = arrived(party, present);
        if there >= party.count() {
            continue;
        }
        match party.only_name() {
            Some(name) => {
                let why = why_not(name).map_or("ready, has not arrived", Reason::words);
                missing.push((name.to_owned(), why.to_owned()));
            }
            None => {
                let why = format!("{there} of {} have arrived", party.count());
                missing.push((party.to_string(), why));
            }
        }
    }
    missing
}
