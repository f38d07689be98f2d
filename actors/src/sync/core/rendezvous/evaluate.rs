//! Whether a barrier opens, and what becomes of those who wait where it does not.

use super::*;

/// Who waits at a barrier behind its last generation.
pub(super) struct Present<'known> {
    member: Member,
    /// Empty where it has none.
    pub(super) name: &'known str,
}

/// How a barrier stands.
enum Standing {
    /// All are there: these.
    Complete(Vec<Member>),
    /// Some are missing.
    Lacks(Lack),
    /// It can never open again.
    Exhausted,
}

/// What a barrier lacks.
struct Lack {
    /// Who is missing, and the last that is known of each, where somebody is to be told.
    missing: Vec<(String, String)>,
    /// Of each party since when it is lost, if somebody does not want to wait for it.
    lost: Vec<Option<Time>>,
    /// Those who wait whose time is over.
    over: Vec<AppAddress>,
    /// Of each party whether it is there.
    there: Vec<bool>,
}

/// Parties that are not one name, times those who are there, up to which it is looked at each time which of these is missing.
const LOOKED_AT_MAX: usize = 1_024;

impl Rendezvous {
    /// Opens what can be opened, then tells those whose time is over or who do not want to wait for a lost party. `linked` gives the
    /// life of a node that can be heard, `why_not` why an application of a name is not ready.
    pub(in crate::sync::core) fn evaluate(
        &mut self,
        moment: Moment,
        linked: impl Fn(NodeAddress) -> Option<Incarnation>,
        why_not: impl Fn(&str) -> Option<Reason>,
    ) {
        let awaited = self.known.iter().filter(|(_, known)| !known.waiting.is_empty());
        let standings: Vec<(Key, Standing)> = awaited
            .map(|(key, known)| (key.clone(), self.standing(moment, (key, known), &linked, &why_not)))
            .collect();
        for (key, standing) in standings {
            match standing {
                Standing::Complete(present) => self.open(moment.now, &key, present),
                Standing::Lacks(lack) => self.end_waits(moment, &key, lack),
                Standing::Exhausted => self.refuse_waits(moment.now, &key),
            }
        }
    }

    fn standing(
        &self,
        moment: Moment,
        (key, known): (&Key, &Known),
        linked: &impl Fn(NodeAddress) -> Option<Incarnation>,
        why_not: &impl Fn(&str) -> Option<Reason>,
    ) -> Standing {
        if known.generation >= GENERATION_MAX {
            return Standing::Exhausted;
        }
        let present = self.present(key, known, linked);
        if is_complete(&known.parties, &present) {
            return Standing::Complete(chosen(&known.parties, present));
        }
        let asks = known.waiting.values().any(|wait| wait.on_loss == OnPartyLoss::Fail);
        let parties = known.parties.iter().enumerate().filter(|_| asks);
        let lost: Vec<Option<Time>> = parties
            .map(|(at, party)| {
                is_lost(party, &present, why_not).then(|| known.lost_since(at).unwrap_or(moment.now))
            })
            .collect();
        let first = lost.iter().copied().flatten().min();
        let over = known.waiting.iter().filter(|(_, wait)| wait.is_over(moment, first));
        let over: Vec<AppAddress> = over.map(|(app, _)| *app).collect();
        let missing = if over.is_empty() { Vec::new() } else { missing(&known.parties, &present, why_not) };
        let missing = missing.into_iter().map(|(_, name, why)| (name, why)).collect();
        let there = who_is_there(&known.parties, &present);
        Standing::Lacks(Lack { missing, lost, over, there })
    }

    // spec: SYNC-11
    fn open(&mut self, now: Time, key: &Key, present: Vec<Member>) {
        let (here, voices) = ((self.node, self.incarnation), &self.voices);
        let Some(known) = self.known.get_mut(key) else { return };
        let next = known.generation + 1;
        known.open(present, |member| voices.knows(here, next, key, member));
        let passed = known.pass(here);
        self.answer_opened(passed);
        self.changed(now);
    }

    fn end_waits(
        &mut self,
        Moment { now, judged }: Moment,
        key: &Key,
        Lack { missing, lost, over, there }: Lack,
    ) {
        let Some(known) = self.known.get_mut(key) else { return };
        known.note_absent(now, &there);
        let first = lost.iter().copied().flatten().min();
        known.lost = lost;
        for wait in known.waiting.values_mut() {
            wait.lost = wait.lost_since(first);
        }
        if over.is_empty() {
            return;
        }
        for app in &over {
            let Some(wait) = known.waiting.remove(app) else { continue };
            let missing = missing.clone();
            let answer = if wait.until <= judged {
                BarrierAnswer::TimedOut { missing }
            } else {
                BarrierAnswer::Lost { missing }
            };
            self.answers.push((*app, wait.correlation, answer));
        }
        over.into_iter().for_each(|app| self.renumber(app));
        self.changed(now);
    }

    fn refuse_waits(&mut self, now: Time, key: &Key) {
        let Some(known) = self.known.get_mut(key) else { return };
        for (app, wait) in std::mem::take(&mut known.waiting) {
            let answer = BarrierAnswer::Refused { why: EXHAUSTED.to_owned() };
            self.answers.push((app, wait.correlation, answer));
            self.renumber(app);
        }
        self.changed(now);
    }

    /// Who waits at a barrier behind the last generation that is known here, on this node and on all that can be heard.
    pub(super) fn present<'known>(
        &'known self,
        key: &Key,
        known: &'known Known,
        linked: impl Fn(NodeAddress) -> Option<Incarnation>,
    ) -> Vec<Present<'known>> {
        let (node, incarnation) = (self.node, self.incarnation);
        let here = known.waiting.values().filter(|wait| wait.after == known.generation).map(|wait| Present {
            member: Member { node, incarnation, party: wait.party },
            name: wait.name.as_deref().unwrap_or_default(),
        });
        let there = self.voices.waiting(key, known.generation, linked);
        here.chain(there.map(|(member, name)| Present { member, name })).collect()
    }
}

impl Wait {
    /// Since when it does not wait for the return of the party that was lost first.
    fn lost_since(&self, first: Option<Time>) -> Option<Time> {
        first.filter(|_| self.on_loss == OnPartyLoss::Fail).map(|lost| lost.max(self.since))
    }

    /// Whether its time is over, or that of a lost party's return.
    fn is_over(&self, Moment { judged, .. }: Moment, first: Option<Time>) -> bool {
        let patience = self.lost_since(first).map(|lost| lost + GRACE);
        patience.map_or(self.until, |patience| self.until.min(patience)) <= judged
    }
}

/// How many of a party's applications are there: as many as it takes at most.
pub(super) fn arrived(party: &Requirement, present: &[Present<'_>]) -> usize {
    let there = present.iter().filter(|present| party.counts(present.name));
    there.take(party.count()).count()
}

/// Of each party whether it is there. Of those that take several names, where there are so many that it is not looked at: no.
fn who_is_there(parties: &[Requirement], present: &[Present<'_>]) -> Vec<bool> {
    let names: BTreeSet<&str> = present.iter().map(|present| present.name).collect();
    let others = parties.iter().filter(|party| party.only_name().is_none()).count();
    let is_little = others * present.len() <= LOOKED_AT_MAX;
    let is_there = |party: &Requirement| match party.only_name() {
        Some(name) => names.contains(name),
        None => is_little && arrived(party, present) >= party.count(),
    };
    parties.iter().map(is_there).collect()
}

/// Whether all parties are there. spec: SYNC-11
fn is_complete(parties: &[Requirement], present: &[Present<'_>]) -> bool {
    // Where fewer are there than one party takes, nobody has to look at names.
    let most = parties.iter().map(Requirement::count).max().unwrap_or_default();
    present.len() >= most && parties.iter().all(|party| arrived(party, present) >= party.count())
}

/// Who passes together: those that the parties take come first, for more than `ARRIVALS_MAX` may be there.
fn chosen(parties: &[Requirement], present: Vec<Present<'_>>) -> Vec<Member> {
    if present.len() <= ARRIVALS_MAX {
        return present.into_iter().map(|present| present.member).collect();
    }
    let mut chosen = BTreeSet::new();
    for party in parties {
        let of_it = present.iter().filter(|present| party.counts(present.name)).take(party.count());
        chosen.extend(of_it.map(|present| present.member));
    }
    for other in present {
        if chosen.len() >= ARRIVALS_MAX {
            break;
        }
        chosen.insert(other.member);
    }
    chosen.into_iter().collect()
}

/// Whether a party that is asked for by its name is not there and has ended, as far as is known. spec: SYNC-13
fn is_lost(party: &Requirement, present: &[Present<'_>], why_not: &impl Fn(&str) -> Option<Reason>) -> bool {
    let is_missing = arrived(party, present) < party.count();
    let reason = party.only_name().filter(|_| is_missing).and_then(why_not);
    reason.is_some_and(Reason::is_end)
}

/// Which parties are missing, and the last that is known of each.
pub(super) fn missing(
    parties: &[Requirement],
    present: &[Present<'_>],
    why_not: &impl Fn(&str) -> Option<Reason>,
) -> Vec<(usize, String, String)> {
    let mut missing = Vec::new();
    for (at, party) in parties.iter().enumerate() {
        let there = arrived(party, present);
        if there >= party.count() {
            continue;
        }
        match party.only_name() {
            Some(name) => {
                let why = why_not(name).map_or("ready, has not arrived", Reason::words);
                missing.push((at, name.to_owned(), why.to_owned()));
            }
            None => {
                let why = format!("{there} of {} have arrived", party.count());
                missing.push((at, party.to_string(), why));
            }
        }
    }
    missing
}
