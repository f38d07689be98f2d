//! Evaluation of barriers: whether each opens, and which waits end where it does not.

use super::*;

/// An application that waits at a barrier behind its last generation.
pub(super) struct Present<'known> {
    member: Member,
    /// The name; empty if the application has none.
    pub(super) name: &'known str,
}

/// The state of a barrier.
enum Evaluation {
    /// All parties are present: these members.
    Complete(Vec<Member>),
    /// Some parties are missing.
    Incomplete(Incomplete),
    /// The barrier can never open again.
    Exhausted,
}

/// The missing part of a barrier.
struct Incomplete {
    /// The missing parties and the last known state of each, if an answer needs them.
    missing: Vec<(String, String)>,
    /// For each party, since when it is lost, if an application does not wait for its return.
    lost: Vec<Option<Time>>,
    /// The applications with an ended wait.
    over: Vec<AppAddress>,
    /// For each party, whether it is present.
    there: Vec<bool>,
}

/// Maximum product of parties that are not one name and of present applications. Up to it each evaluation
/// checks which of these parties are missing.
const COMPARED_MAX: usize = 1_024;

impl Rendezvous {
    /// Opens complete barriers. Then answers waits that timed out, or that end because of a lost party.
    /// `linked` returns the incarnation of a reachable node, `why_not` the reason why an application of a
    /// name is not ready.
    pub(in crate::core) fn evaluate(
        &mut self,
        moment: Moment,
        linked: impl Fn(NodeAddress) -> Option<Incarnation>,
        why_not: impl Fn(&str) -> Option<Reason>,
    ) {
        let awaited = self.barriers.iter().filter(|(_, known)| !known.waiting.is_empty());
        let evaluations: Vec<(BarrierKey, Evaluation)> = awaited
            .map(|(key, known)| (key.clone(), self.evaluate_barrier(moment, (key, known), &linked, &why_not)))
            .collect();
        for (key, evaluation) in evaluations {
            match evaluation {
                Evaluation::Complete(present) => self.open(moment.now, &key, present),
                Evaluation::Incomplete(incomplete) => self.end_waits(moment, &key, incomplete),
                Evaluation::Exhausted => self.refuse_waits(moment.now, &key),
            }
        }
    }

    fn evaluate_barrier(
        &self,
        moment: Moment,
        (key, known): (&BarrierKey, &BarrierState),
        linked: &impl Fn(NodeAddress) -> Option<Incarnation>,
        why_not: &impl Fn(&str) -> Option<Reason>,
    ) -> Evaluation {
        if known.generation >= GENERATION_MAX {
            return Evaluation::Exhausted;
        }
        let present = self.present(key, known, linked);
        if is_complete(&known.parties, &present) {
            return Evaluation::Complete(chosen(&known.parties, present));
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
        let there = presence(&known.parties, &present);
        Evaluation::Incomplete(Incomplete { missing, lost, over, there })
    }

    // spec: SYNC-11
    fn open(&mut self, now: Time, key: &BarrierKey, present: Vec<Member>) {
        let (here, views) = ((self.node, self.incarnation), &self.views);
        let Some(known) = self.barriers.get_mut(key) else { return };
        let next = known.generation + 1;
        known.open(present, |member| views.known_generation(here, next, key, member));
        let passed = known.pass(here);
        self.answer_opened(passed);
        self.changed(now);
    }

    fn end_waits(
        &mut self,
        Moment { now, judged }: Moment,
        key: &BarrierKey,
        Incomplete { missing, lost, over, there }: Incomplete,
    ) {
        let Some(known) = self.barriers.get_mut(key) else { return };
        known.record_absent(now, &there);
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

    fn refuse_waits(&mut self, now: Time, key: &BarrierKey) {
        let Some(known) = self.barriers.get_mut(key) else { return };
        for (app, wait) in std::mem::take(&mut known.waiting) {
            let answer = BarrierAnswer::Refused { why: EXHAUSTED.to_owned() };
            self.answers.push((app, wait.correlation, answer));
            self.renumber(app);
        }
        self.changed(now);
    }

    /// Returns the applications that wait at a barrier behind the last generation known here, on this node
    /// and on all reachable ones.
    pub(super) fn present<'known>(
        &'known self,
        key: &BarrierKey,
        known: &'known BarrierState,
        linked: impl Fn(NodeAddress) -> Option<Incarnation>,
    ) -> Vec<Present<'known>> {
        let (node, incarnation) = (self.node, self.incarnation);
        let here = known.waiting.values().filter(|wait| wait.after == known.generation).map(|wait| Present {
            member: Member { node, incarnation, party: wait.party },
            name: wait.name.as_deref().unwrap_or_default(),
        });
        let there = self.views.waiting(key, known.generation, linked);
        here.chain(there.map(|(member, name)| Present { member, name })).collect()
    }
}

impl Wait {
    /// Returns since when this wait ends because of the first lost party.
    fn lost_since(&self, first: Option<Time>) -> Option<Time> {
        first.filter(|_| self.on_loss == OnPartyLoss::Fail).map(|lost| lost.max(self.since))
    }

    /// Returns whether the wait has timed out, or the grace time of a lost party has ended.
    fn is_over(&self, Moment { judged, .. }: Moment, first: Option<Time>) -> bool {
        let grace_end = self.lost_since(first).map(|lost| lost + GRACE);
        grace_end.map_or(self.until, |grace_end| self.until.min(grace_end)) <= judged
    }
}

/// Returns how many applications of a party are present, at most as many as the party requires.
pub(super) fn arrived(party: &Requirement, present: &[Present<'_>]) -> usize {
    let there = present.iter().filter(|present| party.counts(present.name));
    there.take(party.count()).count()
}

/// Returns for each party whether it is present. A party of several names counts as absent if too many
/// applications are present for a check.
fn presence(parties: &[Requirement], present: &[Present<'_>]) -> Vec<bool> {
    let names: BTreeSet<&str> = present.iter().map(|present| present.name).collect();
    let others = parties.iter().filter(|party| party.only_name().is_none()).count();
    let is_cheap = others * present.len() <= COMPARED_MAX;
    let is_there = |party: &Requirement| match party.only_name() {
        Some(name) => names.contains(name),
        None => is_cheap && arrived(party, present) >= party.count(),
    };
    parties.iter().map(is_there).collect()
}

/// Returns whether all parties are present. spec: SYNC-11
fn is_complete(parties: &[Requirement], present: &[Present<'_>]) -> bool {
    // If one party requires more applications than are present, no names need to be compared.
    let most = parties.iter().map(Requirement::count).max().unwrap_or_default();
    present.len() >= most && parties.iter().all(|party| arrived(party, present) >= party.count())
}

/// Returns the members that pass together, at most `ARRIVALS_MAX`. The applications that the parties require
/// have precedence.
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

/// Returns whether a party of one name is absent and is known to have ended. spec: SYNC-13
fn is_lost(party: &Requirement, present: &[Present<'_>], why_not: &impl Fn(&str) -> Option<Reason>) -> bool {
    let is_missing = arrived(party, present) < party.count();
    let reason = party.only_name().filter(|_| is_missing).and_then(why_not);
    reason.is_some_and(Reason::is_end)
}

/// Returns the missing parties, and the last known state of each.
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
