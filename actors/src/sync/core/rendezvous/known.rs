//! One barrier, as a node knows it: how often it has opened, who has passed it when, who of this node waits there.

use super::*;
use crate::sync::arrivals::GENERATIONS_MISSED_MAX;

/// One barrier.
#[derive(Debug)]
pub(in crate::sync::core) struct Known {
    pub(super) parties: Vec<Requirement>,
    /// How often it has opened, as far as is known here.
    pub(in crate::sync::core) generation: u64,
    /// What was first heard of that from another node, and when.
    heard_first: Option<(u64, Time)>,
    /// Who has passed, and which generation last: all who passed the last one, and of those who passed an earlier one whoever's
    /// node may not know it. At most `ARRIVALS_MAX`; the latest ones stay.
    pub(super) members: BTreeMap<Member, u64>,
    /// Who of this node waits there.
    pub(in crate::sync::core) waiting: BTreeMap<AppAddress, Wait>,
    /// Applications of this node that were there in their present life. It is not forgotten before they end: one that came again
    /// without it would pass with the word of its former visit.
    pub(super) visitors: BTreeSet<AppAddress>,
    /// Those of them that are guests, and their users.
    pub(in crate::sync::core) guests: BTreeMap<AppAddress, u32>,
    /// Of each party, since when it is known not to wait there, as long as somebody of this node does.
    pub(super) absent: Vec<Option<Time>>,
    /// Of each party, since when it is known to be lost, as long as somebody of this node does not want to wait for it.
    pub(super) lost: Vec<Option<Time>>,
}

/// An application of this node waits at a barrier.
#[derive(Debug)]
pub(in crate::sync::core) struct Wait {
    pub(super) party: u64,
    pub(super) name: Option<Name>,
    /// The generation behind which it waits.
    pub(super) after: u64,
    pub(in crate::sync::core) since: Time,
    pub(super) until: Time,
    pub(super) on_loss: OnPartyLoss,
    /// Since when a party is known to be lost.
    pub(super) lost: Option<Time>,
    /// Of its request.
    pub(super) correlation: u64,
}

impl Wait {
    /// When its time is over, or that of a lost party's return.
    pub(super) fn next(&self) -> Time {
        self.lost.map_or(self.until, |lost| self.until.min(lost + GRACE))
    }
}

impl Known {
    pub(super) const fn new(parties: Vec<Requirement>) -> Self {
        Self {
            parties,
            generation: 0,
            heard_first: None,
            members: BTreeMap::new(),
            waiting: BTreeMap::new(),
            visitors: BTreeSet::new(),
            guests: BTreeMap::new(),
            absent: Vec::new(),
            lost: Vec::new(),
        }
    }

    /// Opens it for those who are there. `knows` gives the generation that a member's node is known to know. spec: SYNC-11
    pub(super) fn open(&mut self, present: Vec<Member>, knows: impl Fn(&Member) -> u64) {
        self.generation += 1;
        self.absent.clear();
        self.lost.clear();
        for member in present {
            self.note(member, self.generation);
        }
        self.forget(knows);
    }

    /// The highest generation that is believed now. // spec: SYNC-12
    pub(super) fn believed_max(&self, now: Time) -> u64 {
        let of_later = |(generation, at): (u64, Time)| {
            let since = u64::try_from(now.since(at).as_micros()).unwrap_or(u64::MAX);
            generation.max(GENERATION_FREE_MAX).saturating_add(GENERATIONS_MISSED_MAX).saturating_add(since)
        };
        self.heard_first.map_or(GENERATION_AT_FIRST_MAX, of_later)
    }

    /// Takes over what another node knows, and returns whether it is news. spec: SYNC-12
    pub(super) fn hear(&mut self, now: Time, said: &BarrierSaid, knows: impl Fn(&Member) -> u64) -> bool {
        if said.generation > 0 {
            self.heard_first.get_or_insert((said.generation, now));
        }
        let is_later = said.generation > self.generation;
        self.generation = self.generation.max(said.generation);
        let mut is_news = is_later;
        let last = said.members.iter().map(|member| (*member, said.generation));
        for (member, generation) in
            last.chain(said.earlier.iter().map(|passed| (passed.member(), passed.generation)))
        {
            // What its node knows need not be said on.
            if generation == self.generation || knows(&member) < generation {
                is_news |= self.note(member, generation);
            }
        }
        if is_later {
            self.absent.clear();
            // Who waits for a lost party may have met it there. spec: SYNC-13
            self.lost.clear();
            self.forget(knows);
        }
        is_news
    }

    /// Of a party that is missing: since when that is known, while somebody of this node waits.
    pub(super) fn absent_since(&self, party: usize) -> Option<Time> {
        let waits = self.waiting.values().map(|wait| wait.since).min();
        self.absent.get(party).copied().flatten().max(waits)
    }

    /// Since when a party is known to be lost.
    pub(super) fn lost_since(&self, party: usize) -> Option<Time> {
        self.lost.get(party).copied().flatten()
    }

    /// Notes which parties are there.
    pub(super) fn note_absent(&mut self, now: Time, there: &[bool]) {
        self.absent.resize(there.len(), None);
        for (absent, is_there) in self.absent.iter_mut().zip(there) {
            *absent = (!is_there).then(|| absent.unwrap_or(now));
        }
    }

    /// Notes who has passed which generation, and returns whether that is news. Where there is no room the smallest, by generation
    /// and member, makes way: whoever hears the same ones keeps the same ones.
    fn note(&mut self, member: Member, generation: u64) -> bool {
        if self.members.get(&member).is_some_and(|known| *known >= generation) {
            return false;
        }
        if self.members.len() >= ARRIVALS_MAX && !self.members.contains_key(&member) {
            let least = self.members.iter().map(|(member, generation)| (*generation, *member)).min();
            let Some((_, least)) = least.filter(|least| *least < (generation, member)) else { return false };
            self.members.remove(&least);
        }
        self.members.insert(member, generation);
        true
    }

    /// Forgets of those who passed an earlier generation whoever's node knows it.
    fn forget(&mut self, knows: impl Fn(&Member) -> u64) {
        let last = self.generation;
        self.members.retain(|member, generation| *generation == last || knows(member) < *generation);
    }

    /// Lets those of this node pass who stand in a generation behind the one that they wait behind; the others wait for the next.
    /// Returns who passed, with its request and the generation. spec: SYNC-12
    pub(super) fn pass(
        &mut self,
        (node, incarnation): (NodeAddress, Incarnation),
    ) -> Vec<(AppAddress, u64, u64)> {
        let Self { generation: last, members, waiting, .. } = self;
        let mut passed = Vec::new();
        waiting.retain(|app, wait| {
            let generation = members.get(&Member { node, incarnation, party: wait.party });
            let passes = generation.filter(|generation| **generation > wait.after);
            if let Some(generation) = passes {
                passed.push((*app, wait.correlation, *generation));
            }
            wait.after = *last;
            passes.is_none()
        });
        passed
    }

    /// What this node says of it.
    pub(super) fn said(&self, key: &Key) -> BarrierSaid {
        let arrival = |(app, wait): (&AppAddress, &Wait)| Arrival {
            party: wait.party,
            app: *app,
            name: wait.name.clone(),
            after: wait.after,
        };
        let earlier = self.members.iter().filter(|(_, generation)| **generation < self.generation);
        BarrierSaid {
            name: key.name.clone(),
            parties: self.parties.clone(),
            generation: self.generation,
            members: self.members_of_last().collect(),
            earlier: earlier.map(|(member, generation)| Passed::new(*member, *generation)).collect(),
            arrivals: self.waiting.iter().map(arrival).collect(),
        }
    }

    /// Who passed the last generation.
    pub(super) fn members_of_last(&self) -> impl Iterator<Item = Member> {
        self.members
            .iter()
            .filter(|(_, generation)| **generation == self.generation)
            .map(|(member, _)| *member)
    }
}
