//! One barrier as a node knows it: its generation, its members, and the local applications that wait.

use super::*;
use crate::arrivals::GENERATIONS_MISSED_MAX;

/// One barrier.
#[derive(Debug)]
pub struct BarrierState {
    pub(super) parties: Vec<Requirement>,
    /// The number of openings that are known here.
    pub generation: u64,
    /// The first generation received from another node, and its time.
    first_received: Option<(u64, Time)>,
    /// The members and the last generation that each has passed. All members of the last generation are
    /// included. Members of earlier ones are included while their node may not know that generation. The map
    /// has at most `ARRIVALS_MAX` entries; the latest ones stay.
    pub(super) members: BTreeMap<Member, u64>,
    /// The local applications that wait at the barrier.
    pub waiting: BTreeMap<AppAddress, Wait>,
    /// The local applications that visited the barrier in their current life. The barrier is not forgotten
    /// before they end. Otherwise an application that returned to it would pass by the opening of its earlier
    /// visit.
    pub visitors: BTreeSet<AppAddress>,
    /// The guests among the visitors, with their users.
    pub(in crate::core) guests: BTreeMap<AppAddress, u32>,
    /// For each party, since when it is known not to wait, while a local application waits.
    pub(super) absent: Vec<Option<Time>>,
    /// For each party, since when it is known to be lost, while a local application does not wait for its
    /// return.
    pub(super) lost: Vec<Option<Time>>,
}

/// The wait of a local application at a barrier.
#[derive(Debug)]
pub struct Wait {
    pub(super) party: u64,
    pub(super) name: Option<Name>,
    /// The generation behind which the application waits.
    pub(super) after: u64,
    pub(in crate::core) since: Time,
    pub(super) until: Time,
    pub(super) on_loss: OnPartyLoss,
    /// Since when a party is known to be lost.
    pub(super) lost: Option<Time>,
    /// The correlation of the request.
    pub(super) correlation: u64,
}

impl Wait {
    /// Returns the earlier of the wait's timeout and the end of a lost party's grace time.
    pub(super) fn next(&self) -> Time {
        self.lost.map_or(self.until, |lost| self.until.min(lost + GRACE))
    }
}

impl BarrierState {
    pub(super) const fn new(parties: Vec<Requirement>) -> Self {
        Self {
            parties,
            generation: 0,
            first_received: None,
            members: BTreeMap::new(),
            waiting: BTreeMap::new(),
            visitors: BTreeSet::new(),
            guests: BTreeMap::new(),
            absent: Vec::new(),
            lost: Vec::new(),
        }
    }

    /// Opens the barrier for the present members. `known_generation` returns the generation that a member's
    /// node is known to know. spec: SYNC-11
    pub(super) fn open(&mut self, present: Vec<Member>, known_generation: impl Fn(&Member) -> u64) {
        self.generation += 1;
        self.absent.clear();
        self.lost.clear();
        for member in present {
            self.record(member, self.generation);
        }
        self.forget(known_generation);
    }

    /// Returns the highest generation that is accepted now. // spec: SYNC-12
    pub(super) fn plausible_max(&self, now: Time) -> u64 {
        let of_later = |(generation, at): (u64, Time)| {
            let since = u64::try_from(now.since(at).as_micros()).unwrap_or(u64::MAX);
            generation.max(GENERATION_FREE_MAX).saturating_add(GENERATIONS_MISSED_MAX).saturating_add(since)
        };
        self.first_received.map_or(GENERATION_AT_FIRST_MAX, of_later)
    }

    /// Applies the state that another node published. Returns whether it is new. spec: SYNC-12
    pub(super) fn apply(
        &mut self,
        now: Time,
        published: &PublishedBarrier,
        known_generation: impl Fn(&Member) -> u64,
    ) -> bool {
        if published.generation > 0 {
            self.first_received.get_or_insert((published.generation, now));
        }
        let is_later = published.generation > self.generation;
        self.generation = self.generation.max(published.generation);
        let mut is_new = is_later;
        let last = published.members.iter().map(|member| (*member, published.generation));
        for (member, generation) in
            last.chain(published.earlier.iter().map(|passed| (passed.member(), passed.generation)))
        {
            // A member needs no further publication if its node knows the generation.
            if generation == self.generation || known_generation(&member) < generation {
                is_new |= self.record(member, generation);
            }
        }
        if is_later {
            self.absent.clear();
            // An application that waits for the return of a lost party may have met it in that generation.
            // spec: SYNC-13
            self.lost.clear();
            self.forget(known_generation);
        }
        is_new
    }

    /// Returns since when a missing party is known to be missing, while a local application waits.
    pub(super) fn absent_since(&self, party: usize) -> Option<Time> {
        let waits = self.waiting.values().map(|wait| wait.since).min();
        self.absent.get(party).copied().flatten().max(waits)
    }

    /// Returns since when a party is known to be lost.
    pub(super) fn lost_since(&self, party: usize) -> Option<Time> {
        self.lost.get(party).copied().flatten()
    }

    /// Records which parties are present.
    pub(super) fn record_absent(&mut self, now: Time, there: &[bool]) {
        self.absent.resize(there.len(), None);
        for (absent, is_there) in self.absent.iter_mut().zip(there) {
            *absent = (!is_there).then(|| absent.unwrap_or(now));
        }
    }

    /// Records that a member has passed a generation. Returns whether that is new. A full map loses its
    /// smallest entry by generation and member. Nodes with the same input therefore keep the same entries.
    fn record(&mut self, member: Member, generation: u64) -> bool {
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

    /// Forgets members of earlier generations if their nodes know the generation.
    fn forget(&mut self, known_generation: impl Fn(&Member) -> u64) {
        let last = self.generation;
        self.members
            .retain(|member, generation| *generation == last || known_generation(member) < *generation);
    }

    /// Releases local applications that are members of a generation after the one behind which they wait. The
    /// others wait for the next one. Returns the passed applications with their requests and generations.
    /// spec: SYNC-12
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

    /// Returns the published state of this barrier.
    pub(super) fn published(&self, key: &BarrierKey) -> PublishedBarrier {
        let arrival = |(app, wait): (&AppAddress, &Wait)| Arrival {
            party: wait.party,
            app: *app,
            name: wait.name.clone(),
            after: wait.after,
        };
        let earlier = self.members.iter().filter(|(_, generation)| **generation < self.generation);
        PublishedBarrier {
            name: key.name.clone(),
            parties: self.parties.clone(),
            generation: self.generation,
            members: self.members_of_last().collect(),
            earlier: earlier.map(|(member, generation)| Passed::new(*member, *generation)).collect(),
            arrivals: self.waiting.iter().map(arrival).collect(),
        }
    }

    /// Returns the members of the last generation.
    pub fn members_of_last(&self) -> impl Iterator<Item = Member> {
        self.members
            .iter()
            .filter(|(_, generation)| **generation == self.generation)
            .map(|(member, _)| *member)
    }
}
