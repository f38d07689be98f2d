//! Run-time barriers: who waits where, who has passed, and what other nodes say about both.
//!
//! No node decides for another one. Whoever waits stands in what its node publishes; each node that has somebody waiting
//! opens a barrier for itself when it knows of all parties that they wait behind the same generation, and publishes that it
//! has, with who passed. Whoever hears of an opening in which its own application stands lets it pass, too, and says it on.
//!
//! A generation is numbered one higher than that behind which its parties waited, so that the same parties get the same
//! number wherever it is found out. Who waits and does not stand in a generation that others have opened waits for the next.

mod evaluate;
#[cfg(test)]
mod simulation;

use std::{
    collections::{BTreeMap, BTreeSet},
    time::Duration,
};

use bytes::Bytes;
use sinew_runtime::{
    app::Requirement,
    tid::{AppAddress, Incarnation, NodeAddress},
    time::Time,
};

use super::Reason;
use crate::sync::{
    arrivals::{ARRIVALS_MAX, Arrival, Arrivals, BARRIERS_MAX, BarrierSaid, GENERATION_MAX, Member},
    list::Name,
    words::{BarrierAnswer, OnPartyLoss},
};

/// Time between two of our words to a peer when nothing changed.
pub(super) const REPEAT: Duration = Duration::from_secs(2);
/// Least time between two of them: who passes again and again costs a thousand frames a second, not one each.
pub(super) const SPACING: Duration = Duration::from_millis(1);
/// Time from a party's loss until who does not want to wait for its return is told: the word that others have passed with it
/// is on its way no longer.
pub(super) const GRACE: Duration = Duration::from_millis(50);
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
    pub(super) known: BTreeMap<Key, Known>,
    /// Which life of an application is which party.
    parties: BTreeMap<AppAddress, u64>,
    next_party: u64,
    peers: BTreeMap<NodeAddress, Peer>,
    version: u64,
    encoded: Option<Bytes>,
    /// Who is to be answered what.
    answers: Vec<(AppAddress, u64, BarrierAnswer)>,
}

/// One barrier.
#[derive(Debug)]
pub(super) struct Known {
    parties: Vec<Requirement>,
    /// How often it has opened, as far as is known here.
    pub(super) generation: u64,
    /// Who passed it then.
    members: BTreeSet<Member>,
    /// Who of this node waits there.
    pub(super) waiting: BTreeMap<AppAddress, Wait>,
    /// Applications of this node that were there in their present life. It is not forgotten before they end: one that came again
    /// without it would pass with the word of its former visit.
    visitors: BTreeSet<AppAddress>,
}

/// An application of this node waits at a barrier.
#[derive(Debug)]
pub(super) struct Wait {
    party: u64,
    name: Option<Name>,
    /// The generation behind which it waits.
    pub(super) after: u64,
    pub(super) since: Time,
    until: Time,
    on_loss: OnPartyLoss,
    /// Since when a party is known to be lost.
    lost: Option<Time>,
    /// Of its request.
    correlation: u64,
}

#[derive(Debug, Default)]
struct Peer {
    said: Option<Arrivals>,
    /// Whether it said so since the link came up.
    heard: bool,
    sent: Option<Time>,
    due: Option<Time>,
}

/// An application has arrived.
#[derive(Clone, Debug)]
pub(super) struct Arrived {
    pub(super) app: AppAddress,
    pub(super) name: Option<Name>,
    pub(super) correlation: u64,
    pub(super) barrier: Name,
    pub(super) parties: Vec<Requirement>,
    pub(super) within: Duration,
    pub(super) on_loss: OnPartyLoss,
}

impl Rendezvous {
    pub(super) const fn new(node: NodeAddress, incarnation: Incarnation) -> Self {
        Self {
            node,
            incarnation,
            known: BTreeMap::new(),
            parties: BTreeMap::new(),
            next_party: 1,
            peers: BTreeMap::new(),
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
        let Arrived { app, name, correlation, barrier, parties, within, on_loss } = arrived;
        let called = name.as_deref().unwrap_or_default();
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
        self.make_room(&key)?;
        let party = *self.parties.entry(app).or_insert_with(|| {
            self.next_party += 1;
            self.next_party - 1
        });
        self.recall(now, &key);
        let known = self.known.entry(key).or_insert_with(|| Known::new(parties));
        if known.waiting.len() >= ARRIVALS_MAX {
            return Err(format!("{ARRIVALS_MAX} applications of this node wait there already"));
        }
        known.visitors.insert(app);
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
        if self.known.len() < BARRIERS_MAX || self.known.contains_key(key) {
            return Ok(());
        }
        let idle = self.known.iter().find(|(_, known)| known.visitors.is_empty()).map(|(key, _)| key.clone());
        let Some(idle) = idle else {
            return Err(format!(
                "this node knows {BARRIERS_MAX} barriers, which is the limit; a barrier opens as often as one likes, so \
                 that one name is enough for all rounds"
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
        let said = self.peers.values().filter_map(|peer| peer.said.as_ref());
        let of_it: Vec<BarrierSaid> =
            said.flat_map(|said| &said.barriers).filter(|barrier| barrier.is_about(key)).cloned().collect();
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
            self.changed(now);
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
        }
        self.changed(now);
    }

    /// Messages can flow to `node`.
    pub(super) fn link_up(&mut self, now: Time, node: NodeAddress) {
        let has_news = !self.known.is_empty();
        let peer = self.peers.entry(node).or_default();
        peer.due = has_news.then_some(now);
    }

    /// Nothing is heard of `node`, or it is lost: what it said does not count before it says it again.
    pub(super) fn silent(&mut self, node: NodeAddress) {
        if let Some(peer) = self.peers.get_mut(&node) {
            (peer.heard, peer.due) = (false, None);
        }
    }

    /// `node` is forgotten.
    pub(super) fn retain(&mut self, is_known: impl Fn(NodeAddress) -> bool) {
        self.peers.retain(|node, _| is_known(*node));
    }

    /// Takes what a node says, whose linked life is `linked`. spec: SYNC-11
    ///
    /// # Errors
    /// Why it is not used.
    pub(super) fn told(
        &mut self,
        now: Time,
        from: NodeAddress,
        said: Arrivals,
        linked: Option<Incarnation>,
    ) -> Result<(), &'static str> {
        if linked.is_some_and(|life| life != said.incarnation) {
            return Err("this is about another life of its node than the one that is linked");
        }
        let peer = self.peers.entry(from).or_default();
        // Of two lives the linked one is right, be it the elder: the other one was a double of it.
        let is_over = |known: &&Arrivals| linked.is_some() && known.incarnation != said.incarnation;
        let known = peer.said.as_ref().filter(|known| !is_over(known));
        let known = known.map(|known| (known.incarnation, known.version));
        if known.is_some_and(|known| (said.incarnation, said.version) < known) {
            return Ok(());
        }
        peer.heard = true;
        if known == Some((said.incarnation, said.version)) {
            return Ok(());
        }
        for barrier in &said.barriers {
            self.hear(now, barrier);
        }
        if let Some(peer) = self.peers.get_mut(&from) {
            peer.said = Some(said);
        }
        Ok(())
    }

    /// Takes over which generation was opened, and who passed. spec: SYNC-12
    fn hear(&mut self, now: Time, said: &BarrierSaid) {
        let parties = said.parties.iter().map(ToString::to_string).collect();
        let key = Key { name: said.name.clone(), parties };
        // One that nobody here has to do with is only said on, if there is room. None makes way for it: two nodes that know
        // different ones would take turns for ever.
        if self.known.len() >= BARRIERS_MAX && !self.known.contains_key(&key) {
            return;
        }
        let known = self.known.entry(key).or_insert_with(|| Known::new(said.parties.clone()));
        let before = known.members.len();
        let is_news = match said.generation.cmp(&known.generation) {
            std::cmp::Ordering::Less => false,
            std::cmp::Ordering::Equal => {
                let room = ARRIVALS_MAX.saturating_sub(before);
                known.members.extend(said.members.iter().copied().take(room));
                known.members.len() > before
            }
            std::cmp::Ordering::Greater => {
                known.generation = said.generation;
                known.members = said.members.iter().copied().collect();
                true
            }
        };
        if is_news {
            let passed = known.pass(self.node, self.incarnation);
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
        for peer in self.peers.values_mut() {
            let earliest = peer.sent.map_or(now, |sent| now.max(sent + SPACING));
            peer.due = Some(peer.due.map_or(earliest, |due| due.min(earliest)));
        }
    }

    /// What our word did not reach is said again soon.
    pub(super) fn not_taken(&mut self, now: Time, node: NodeAddress) {
        if let Some(peer) = self.peers.get_mut(&node) {
            peer.due = Some(now + super::barrier::RETRY);
        }
    }

    /// The linked nodes to which our word goes now.
    pub(super) fn take_due(
        &mut self,
        now: Time,
        is_linked: impl Fn(NodeAddress) -> bool,
    ) -> Vec<NodeAddress> {
        let mut due = Vec::new();
        for (node, peer) in &mut self.peers {
            if peer.due.is_none_or(|due| due > now) {
                continue;
            }
            let goes = is_linked(*node) && !self.known.is_empty();
            peer.due = goes.then(|| now + REPEAT);
            if goes {
                peer.sent = Some(now);
                due.push(*node);
            }
        }
        due
    }

    /// Our word.
    pub(super) fn encoded(&mut self) -> Bytes {
        if let Some(bytes) = &self.encoded {
            return bytes.clone();
        }
        let (incarnation, version) = (self.incarnation, self.version);
        let barriers = self.known.iter().map(|(key, known)| known.said(key)).collect();
        let bytes = Arrivals { incarnation, version, barriers }.encode();
        self.encoded = Some(bytes.clone());
        bytes
    }

    /// The parties of the barriers at which somebody of this node waits.
    pub(super) fn awaited(&self) -> impl Iterator<Item = &Requirement> {
        self.known.values().filter(|known| !known.waiting.is_empty()).flat_map(|known| &known.parties)
    }

    /// When there is something to do without news.
    pub(super) fn next_wake(&self) -> Option<Time> {
        let due = self.peers.values().filter_map(|peer| peer.due);
        let waits = self.known.values().flat_map(|known| known.waiting.values());
        due.chain(waits.map(Wait::next)).min()
    }
}

impl BarrierSaid {
    fn is_about(&self, key: &Key) -> bool {
        self.name == key.name && self.parties.iter().map(Requirement::as_str).eq(&key.parties)
    }
}

impl Wait {
    fn next(&self) -> Time {
        self.lost.map_or(self.until, |lost| self.until.min(lost + GRACE))
    }
}

impl Known {
    fn new(parties: Vec<Requirement>) -> Self {
        let (members, waiting, visitors) = (BTreeSet::new(), BTreeMap::new(), BTreeSet::new());
        Self { parties, generation: 0, members, waiting, visitors }
    }

    /// Lets those pass who stand in the last generation; who waits behind an earlier one waits for the next. Returns who passed,
    /// with its request and the generation. spec: SYNC-12
    fn pass(&mut self, node: NodeAddress, incarnation: Incarnation) -> Vec<(AppAddress, u64, u64)> {
        let Self { generation, members, waiting, .. } = self;
        let mut passed = Vec::new();
        waiting.retain(|app, wait| {
            let is_member = members.contains(&Member { node, incarnation, party: wait.party });
            let passes = wait.after < *generation && is_member;
            if passes {
                passed.push((*app, wait.correlation, *generation));
            }
            wait.after = *generation;
            !passes
        });
        passed
    }

    fn said(&self, key: &Key) -> BarrierSaid {
        let arrival = |(app, wait): (&AppAddress, &Wait)| Arrival {
            party: wait.party,
            app: *app,
            name: wait.name.clone(),
            after: wait.after,
        };
        BarrierSaid {
            name: key.name.clone(),
            parties: self.parties.clone(),
            generation: self.generation,
            members: self.members.iter().copied().collect(),
            arrivals: self.waiting.iter().map(arrival).collect(),
        }
    }
}
