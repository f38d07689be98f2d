//! Run-time barriers: who waits where, who has passed, and what other nodes say about both.
//!
//! No node decides for another one. Whoever waits stands in what its node publishes; each node that has somebody waiting
//! opens a barrier for itself when it knows of all parties that they wait behind the same generation, and publishes that it
//! has, with who passed. Whoever hears of an opening in which its own application stands lets it pass, too, and says it on.
//!
//! A generation is numbered one higher than that behind which its parties waited, so that the same parties get the same
//! number wherever it is found out. Who waits and does not stand in a generation that others have opened waits for the next.
//! Who stood in an earlier one than the last passes that: its node hears of it late, others have met again meanwhile.

#[cfg(test)]
mod cost;
mod evaluate;
mod known;
mod room;
mod shares;
#[cfg(test)]
mod simulation;
mod voices;
mod who_waits;

use std::{
    collections::{BTreeMap, BTreeSet},
    time::Duration,
};

use bytes::Bytes;
use sinew_runtime::{
    app::Requirement,
    name::{check_name, shown},
    tid::{AppAddress, Incarnation, NodeAddress},
    time::Time,
};

pub(super) use self::{known::Known, who_waits::WhoWaits};
use self::{known::Wait, voices::Voices};
use super::{Reason, respite::Moment};
use crate::{
    lncl::User,
    sync::{
        arrivals::{
            ARRIVALS_MAX, Arrival, Arrivals, BARRIERS_MAX, BarrierSaid, GENERATION_AT_FIRST_MAX,
            GENERATION_FREE_MAX, GENERATION_MAX, Member, Passed,
        },
        facts::Absence,
        list::Name,
        words::{BarrierAnswer, OnPartyLoss},
    },
};

/// Time from a party's loss until who does not want to wait for its return is told: the word that others have passed with it
/// is on its way no longer.
pub(super) const GRACE: Duration = Duration::from_millis(50);
/// Of a barrier that has no generation left. Only a node whose word was wrong, and was heard first, brings it there.
const EXHAUSTED: &str =
    "it has opened 2^53 times, as far as is known here, which is the limit; use a barrier of another name";
/// Barriers at which one application waits at once, at most.
const WAITS_PER_APP_MAX: usize = 16;

/// What tells one barrier from another: its name, and the texts of its parties.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Key {
    pub(super) name: Name,
    pub(super) parties: Vec<String>,
}

/// The run-time barriers, as one node knows them.
#[derive(Debug)]
pub(super) struct Rendezvous {
    node: NodeAddress,
    incarnation: Incarnation,
    bytes_max: usize,
    barriers_max: usize,
    pub(super) known: BTreeMap<Key, Known>,
    /// Which life of an application is which party.
    parties: BTreeMap<AppAddress, u64>,
    next_party: u64,
    voices: Voices,
    version: u64,
    encoded: Option<Bytes>,
    /// Who is to be answered what.
    answers: Vec<(AppAddress, u64, BarrierAnswer)>,
}

/// An application has arrived.
#[derive(Clone, Debug)]
pub(super) struct Arrived {
    pub(super) app: AppAddress,
    pub(super) name: Option<Name>,
    pub(super) user: User,
    pub(super) correlation: u64,
    pub(super) barrier: Name,
    pub(super) parties: Vec<Requirement>,
    pub(super) within: Duration,
    pub(super) on_loss: OnPartyLoss,
}

impl Rendezvous {
    /// Knows no barrier; its word has at most `bytes_max`.
    pub(super) const fn new(node: NodeAddress, incarnation: Incarnation, bytes_max: usize) -> Self {
        Self {
            node,
            incarnation,
            bytes_max,
            barriers_max: BARRIERS_MAX,
            known: BTreeMap::new(),
            parties: BTreeMap::new(),
            next_party: 1,
            voices: Voices::new(),
            version: 1,
            encoded: None,
            answers: Vec::new(),
        }
    }

    /// Lets an application wait. spec: SYNC-10
    ///
    /// # Errors
    /// Why it cannot, in words.
    pub(super) fn arrive(&mut self, now: Time, arrived: Arrived) -> Result<(), String> {
        let Arrived { app, name, user, correlation, barrier, parties, within, on_loss } = arrived;
        let called = name.as_deref().unwrap_or_default();
        check_name(&barrier)
            .map_err(|why| format!("a barrier cannot be called '{}': {why}", shown(&barrier)))?;
        if !parties.iter().any(|party| party.counts(called)) {
            return Err(format!(
                "an application called {called:?} is none of the parties of the barrier '{barrier}'"
            ));
        }
        let texts = parties.iter().map(ToString::to_string).collect();
        let key = Key { name: barrier, parties: texts };
        let elsewhere = self.known.iter().filter(|(other, _)| **other != key);
        let waits = elsewhere.clone().filter(|(_, known)| known.waiting.contains_key(&app)).count();
        if waits >= WAITS_PER_APP_MAX {
            return Err(format!("it waits at {WAITS_PER_APP_MAX} barriers already"));
        }
        if let User::Guest(uid) = user {
            self.check_share(&key, &parties, called, (app, uid))?;
        }
        self.has_room(&key, &parties, called)?;
        self.make_room(&key)?;
        let party = *self.parties.entry(app).or_insert_with(|| {
            self.next_party += 1;
            self.next_party - 1
        });
        self.recall(now, &key);
        let known = self.known.entry(key).or_insert_with(|| Known::new(parties));
        if known.generation >= GENERATION_MAX {
            return Err(EXHAUSTED.to_owned());
        }
        if known.waiting.len() >= ARRIVALS_MAX {
            return Err(format!("{ARRIVALS_MAX} applications of this node wait there already"));
        }
        known.visitors.insert(app);
        if let User::Guest(uid) = user {
            known.guests.insert(app, uid);
        }
        let after = known.generation;
        let wait =
            Wait { party, name, after, since: now, until: now + within, on_loss, lost: None, correlation };
        if let Some(former) = known.waiting.insert(app, wait) {
            let why = "this application has arrived there again; the later request stands".to_owned();
            self.answers.push((app, former.correlation, BarrierAnswer::Refused { why }));
        }
        self.changed(now);
        Ok(())
    }

    /// Forgets a barrier that no living application of this node has to do with, if there is no room for one more.
    fn make_room(&mut self, key: &Key) -> Result<(), String> {
        if self.known.len() < self.barriers_max || self.known.contains_key(key) {
            return Ok(());
        }
        let idle = self.known.iter().find(|(_, known)| known.visitors.is_empty()).map(|(key, _)| key.clone());
        let Some(idle) = idle else {
            return Err(format!(
                "this node knows {} barriers, which is the limit; a barrier opens as often as one likes, so that one name is \
                 enough for all rounds",
                self.barriers_max
            ));
        };
        self.known.remove(&idle);
        Ok(())
    }

    /// Hears again what others said last of a barrier that is not known here, or not any more: they do not say it anew. spec: SYNC-12
    fn recall(&mut self, now: Time, key: &Key) {
        if self.known.contains_key(key) {
            return;
        }
        let of_it: Vec<BarrierSaid> = self.voices.about(key).cloned().collect();
        for barrier in &of_it {
            self.hear(now, barrier);
        }
    }

    /// An application waits no more: by any request, or only by the one of this correlation, which a later one may have replaced.
    pub(super) fn leave(&mut self, now: Time, app: AppAddress, barrier: &str, correlation: Option<u64>) {
        let mut has_left = false;
        for (_, known) in self.known.iter_mut().filter(|(key, _)| &*key.name == barrier) {
            let wait = known.waiting.get(&app);
            if wait.is_some_and(|wait| correlation.is_none_or(|correlation| correlation == wait.correlation))
            {
                known.waiting.remove(&app);
                has_left = true;
            }
        }
        if has_left {
            self.renumber(app);
            self.changed(now);
        }
    }

    /// It has given a visit up without passing. It may have been counted all the same, where that is not known here yet: that word is not
    /// about its next visit, which has a number of its own. spec: SYNC-12
    fn renumber(&mut self, app: AppAddress) {
        if let Some(party) = self.parties.get_mut(&app) {
            *party = self.next_party;
            self.next_party += 1;
        }
    }

    /// A life of an application is over.
    pub(super) fn ended(&mut self, now: Time, app: AppAddress) {
        if self.parties.remove(&app).is_none() {
            return;
        }
        for known in self.known.values_mut() {
            known.waiting.remove(&app);
            known.visitors.remove(&app);
            known.guests.remove(&app);
        }
        self.changed(now);
    }

    /// Messages can flow to `node`.
    pub(super) fn link_up(&mut self, now: Time, node: NodeAddress) {
        self.voices.link_up(now, node, !self.known.is_empty());
    }

    /// Nothing is heard of `node`, or it is lost: what it said does not count before it says it again.
    pub(super) fn silent(&mut self, node: NodeAddress) {
        self.voices.silent(node);
    }

    /// `node` is forgotten.
    pub(super) fn retain(&mut self, is_known: impl Fn(NodeAddress) -> bool) {
        self.voices.retain(is_known);
    }

    /// Takes what a node says, whose linked life is `linked`. spec: SYNC-11
    ///
    /// # Errors
    /// Why it is not used.
    pub(super) fn told(
        &mut self,
        now: Time,
        from: NodeAddress,
        mut said: Arrivals,
        linked: Option<Incarnation>,
    ) -> Result<(), &'static str> {
        let count = said.barriers.len();
        said.barriers.retain(|barrier| self.is_believed(now, barrier));
        let is_believed = said.barriers.len() == count;
        for barrier in self.voices.hear(from, said, linked)? {
            self.hear(now, &barrier);
        }
        let why = "a barrier has opened more often in its word than it can have since it was heard of first; nothing is believed of that one";
        is_believed.then_some(()).ok_or(why)
    }

    /// Whether a barrier can have opened so often. The highest generation is everybody's, and outlives who said it: one word that is wrong would
    /// leave no room for a next one, to nobody, ever. What half of the room has is believed by everybody, whatever was heard before: else a wrong
    /// word would part those who had heard another one first from those who came later. spec: SYNC-12
    fn is_believed(&self, now: Time, said: &BarrierSaid) -> bool {
        said.generation <= GENERATION_FREE_MAX
            || said.generation
                <= self
                    .known
                    .get(&said.key())
                    .map_or(GENERATION_AT_FIRST_MAX, |known| known.believed_max(now))
    }

    /// Takes over which generation was opened, and who passed. spec: SYNC-12
    fn hear(&mut self, now: Time, said: &BarrierSaid) {
        let key = said.key();
        // One that nobody here has to do with is only said on, if there is room. None makes way for it: two nodes that know
        // different ones would take turns for ever.
        if self.known.len() >= self.barriers_max && !self.known.contains_key(&key) {
            return;
        }
        let (here, voices) = ((self.node, self.incarnation), &self.voices);
        let known = self.known.entry(key.clone()).or_insert_with(|| Known::new(said.parties.clone()));
        let before = known.generation;
        if known.hear(now, said, |member| voices.knows(here, before, &key, member)) {
            let passed = known.pass(here);
            self.answer_opened(passed);
            self.changed(now);
        }
    }

    fn answer_opened(&mut self, passed: Vec<(AppAddress, u64, u64)>) {
        self.answers.extend(
            passed.into_iter().map(|(app, correlation, generation)| {
                (app, correlation, BarrierAnswer::Opened { generation })
            }),
        );
    }

    /// Who is to be answered what.
    pub(super) fn take_answers(&mut self) -> Vec<(AppAddress, u64, BarrierAnswer)> {
        std::mem::take(&mut self.answers)
    }

    fn changed(&mut self, now: Time) {
        self.version += 1;
        self.encoded = None;
        self.voices.make_due(now);
    }

    /// What our word did not reach is said again soon.
    pub(super) fn not_taken(&mut self, now: Time, node: NodeAddress) {
        self.voices.not_taken(now, node);
    }

    /// The linked nodes to which our word goes now.
    pub(super) fn take_due(
        &mut self,
        now: Time,
        is_linked: impl Fn(NodeAddress) -> bool,
    ) -> Vec<NodeAddress> {
        self.voices.take_due(now, !self.known.is_empty(), is_linked)
    }

    /// Our word; and, if it is new, how many barriers have no room in it.
    pub(super) fn encoded(&mut self) -> (Bytes, usize) {
        if let Some(bytes) = &self.encoded {
            return (bytes.clone(), 0);
        }
        let (bytes, left_out) = self.write();
        self.encoded = Some(bytes.clone());
        (bytes, left_out)
    }

    /// The parties of the barriers at which somebody of this node waits.
    pub(super) fn awaited(&self) -> impl Iterator<Item = &Requirement> {
        self.known.values().filter(|known| !known.waiting.is_empty()).flat_map(|known| &known.parties)
    }

    /// When somebody's wait is over without news.
    pub(super) fn next_over(&self) -> Option<Time> {
        self.known.values().flat_map(|known| known.waiting.values()).map(Wait::next).min()
    }

    /// When our word goes out next.
    pub(super) fn next_due(&self) -> Option<Time> {
        self.voices.next_due()
    }
}
