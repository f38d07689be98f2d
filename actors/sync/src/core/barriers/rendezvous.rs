//! Run-time barriers: the applications that wait, those that have passed, and the barrier state that nodes
//! exchange.
//!
//! No node decides for another one. Each node publishes its waiting applications. A node with waiting
//! applications opens a barrier for itself when it knows that all parties wait after the same generation. It
//! then publishes the opening with the members that passed. A node that receives an opening with its own
//! application as a member lets that application pass, and publishes the opening, too.
//!
//! A generation has the number after the one behind which its parties waited. The same parties therefore get
//! the same number on every node that detects the opening. An application that waits, and is no member of a
//! generation that others opened, waits for the next one. A member of an earlier generation than the last
//! passes that earlier one: its node received the opening late, and others have met again meanwhile.

mod barrier_state;
mod evaluate;
mod remote_views;
mod room;
mod shares;
mod waiters;

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

pub use self::barrier_state::BarrierState;
pub(super) use self::waiters::Waiters;
use sinew_model::{
    barrier::{BarrierAnswer, OnPartyLoss},
    directory::Absence,
    facts::User,
};

use self::{barrier_state::Wait, remote_views::RemoteViews};
use crate::{
    arrivals::{
        ARRIVALS_MAX, Arrival, Arrivals, BARRIERS_MAX, GENERATION_AT_FIRST_MAX, GENERATION_FREE_MAX,
        GENERATION_MAX, Member, Passed, PublishedBarrier,
    },
    core::{Reason, grace_period::Moment},
    list::Name,
};

/// Time from the loss of a party until an application that does not wait for its return is notified. A report
/// that others passed with the party has arrived by then.
pub(in crate::core) const GRACE: Duration = Duration::from_millis(50);
/// The rejection for a barrier without any generation left. Only a node with a wrong generation, received in its first
/// frame, causes this.
const EXHAUSTED: &str =
    "it has opened 2^53 times, as far as is known here, which is the limit; use a barrier of another name";
/// Maximum number of barriers at which one application waits at once.
const WAITS_PER_APP_MAX: usize = 16;

/// The identity of a barrier: its name and the texts of its parties.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct BarrierKey {
    pub name: Name,
    pub parties: Vec<String>,
}

/// The run-time barriers that one node knows.
#[derive(Debug)]
pub struct Rendezvous {
    node: NodeAddress,
    incarnation: Incarnation,
    bytes_max: usize,
    pub barriers_max: usize,
    pub barriers: BTreeMap<BarrierKey, BarrierState>,
    /// The party number of each application's current life.
    parties: BTreeMap<AppAddress, u64>,
    next_party: u64,
    views: RemoteViews,
    version: u64,
    encoded: Option<Bytes>,
    /// The pending answers to applications.
    answers: Vec<(AppAddress, u64, BarrierAnswer)>,
}

/// The arrival of an application at a barrier.
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
    /// Returns a state without barriers. Its frame has at most `bytes_max` bytes.
    pub(in crate::core) const fn new(node: NodeAddress, incarnation: Incarnation, bytes_max: usize) -> Self {
        Self {
            node,
            incarnation,
            bytes_max,
            barriers_max: BARRIERS_MAX,
            barriers: BTreeMap::new(),
            parties: BTreeMap::new(),
            next_party: 1,
            views: RemoteViews::new(),
            version: 1,
            encoded: None,
            answers: Vec::new(),
        }
    }

    /// Records the arrival of an application. spec: SYNC-10
    ///
    /// # Errors
    /// Returns a description if the application cannot wait.
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
        let key = BarrierKey { name: barrier, parties: texts };
        let elsewhere = self.barriers.iter().filter(|(other, _)| **other != key);
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
        self.apply_published(now, &key);
        let known = self.barriers.entry(key).or_insert_with(|| BarrierState::new(parties));
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
            let why =
                "this application has arrived there again; the later request replaces this one".to_owned();
            self.answers.push((app, former.correlation, BarrierAnswer::Refused { why }));
        }
        self.changed(now);
        Ok(())
    }

    /// Makes room for one more barrier: forgets one that no current application of this node has visited.
    fn make_room(&mut self, key: &BarrierKey) -> Result<(), String> {
        if self.barriers.len() < self.barriers_max || self.barriers.contains_key(key) {
            return Ok(());
        }
        let idle =
            self.barriers.iter().find(|(_, known)| known.visitors.is_empty()).map(|(key, _)| key.clone());
        let Some(idle) = idle else {
            return Err(format!(
                "this node knows {} barriers, which is the limit; a barrier opens as often as one likes, so that one name is \
                 enough for all rounds",
                self.barriers_max
            ));
        };
        self.barriers.remove(&idle);
        Ok(())
    }

    /// Applies again the last published state of a barrier that is not known here, or not any more. Other
    /// nodes do not publish it anew. spec: SYNC-12
    fn apply_published(&mut self, now: Time, key: &BarrierKey) {
        if self.barriers.contains_key(key) {
            return;
        }
        let states: Vec<PublishedBarrier> = self.views.about(key).cloned().collect();
        for barrier in &states {
            self.apply(now, barrier);
        }
    }

    /// Removes waits of an application. With a correlation, only the wait by that request is removed; a later
    /// request may have replaced it.
    pub(super) fn leave(&mut self, now: Time, app: AppAddress, barrier: &str, correlation: Option<u64>) {
        let mut has_left = false;
        for (_, known) in self.barriers.iter_mut().filter(|(key, _)| &*key.name == barrier) {
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

    /// Gives the application a new party number after a wait that ended without passing. Another node may
    /// have counted that wait already. The new number keeps such an opening from applying to the next wait.
    /// spec: SYNC-12
    fn renumber(&mut self, app: AppAddress) {
        if let Some(party) = self.parties.get_mut(&app) {
            *party = self.next_party;
            self.next_party += 1;
        }
    }

    /// Removes all state of an application, after its life has ended.
    pub(super) fn ended(&mut self, now: Time, app: AppAddress) {
        if self.parties.remove(&app).is_none() {
            return;
        }
        for known in self.barriers.values_mut() {
            known.waiting.remove(&app);
            known.visitors.remove(&app);
            known.guests.remove(&app);
        }
        self.changed(now);
    }

    /// Handles a link to `node` that is up.
    pub(super) fn link_up(&mut self, now: Time, node: NodeAddress) {
        self.views.link_up(now, node, !self.barriers.is_empty());
    }

    /// Invalidates the state of `node` until it is published again. The node is unreachable or lost.
    pub(super) fn invalidate(&mut self, node: NodeAddress) {
        self.views.invalidate(node);
    }

    /// Forgets the nodes for which `is_known` returns `false`.
    pub(super) fn retain(&mut self, is_known: impl Fn(NodeAddress) -> bool) {
        self.views.retain(is_known);
    }

    /// Handles the barrier state that a node published. `linked` is the node's linked incarnation.
    /// spec: SYNC-11
    ///
    /// # Errors
    /// Returns why the state is not used, or only in part.
    pub(super) fn frame_received(
        &mut self,
        now: Time,
        from: NodeAddress,
        mut frame: Arrivals,
        linked: Option<Incarnation>,
    ) -> Result<(), &'static str> {
        let count = frame.barriers.len();
        frame.barriers.retain(|barrier| self.is_plausible(now, barrier));
        let are_plausible = frame.barriers.len() == count;
        for barrier in self.views.store(from, frame, linked)? {
            self.apply(now, &barrier);
        }
        let why = "the generation of a barrier is higher than it can be since the barrier became known; that barrier is ignored";
        are_plausible.then_some(()).ok_or(why)
    }

    /// Returns whether a published generation is plausible. The highest generation is shared by all nodes and
    /// outlives its sender. A single wrong one would exhaust the numbers of the barrier forever. Every node
    /// accepts generations in the lower half of the range, independent of its history. Otherwise a wrong
    /// generation would separate the nodes with an earlier state from those that join later. spec: SYNC-12
    fn is_plausible(&self, now: Time, published: &PublishedBarrier) -> bool {
        published.generation <= GENERATION_FREE_MAX
            || published.generation
                <= self
                    .barriers
                    .get(&published.key())
                    .map_or(GENERATION_AT_FIRST_MAX, |known| known.plausible_max(now))
    }

    /// Applies a published generation and its members. spec: SYNC-12
    fn apply(&mut self, now: Time, published: &PublishedBarrier) {
        let key = published.key();
        // A barrier without local visitors is only published again, if there is room. No other barrier is
        // removed for it: two nodes that know different barriers would replace them in turn forever.
        if self.barriers.len() >= self.barriers_max && !self.barriers.contains_key(&key) {
            return;
        }
        let (here, views) = ((self.node, self.incarnation), &self.views);
        let known =
            self.barriers.entry(key.clone()).or_insert_with(|| BarrierState::new(published.parties.clone()));
        let before = known.generation;
        if known.apply(now, published, |member| views.known_generation(here, before, &key, member)) {
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

    /// Returns and removes the pending answers.
    pub(super) fn take_answers(&mut self) -> Vec<(AppAddress, u64, BarrierAnswer)> {
        std::mem::take(&mut self.answers)
    }

    fn changed(&mut self, now: Time) {
        self.version += 1;
        self.encoded = None;
        self.views.make_due(now);
    }

    /// Schedules the rejected frame to `node` again.
    pub(super) fn frame_rejected(&mut self, now: Time, node: NodeAddress) {
        self.views.frame_rejected(now, node);
    }

    /// Returns the linked nodes to which the frame is due now.
    pub(super) fn take_due(
        &mut self,
        now: Time,
        is_linked: impl Fn(NodeAddress) -> bool,
    ) -> Vec<NodeAddress> {
        self.views.take_due(now, !self.barriers.is_empty(), is_linked)
    }

    /// Returns the encoded frame of this node. If it is new, also returns how many barriers have no room in
    /// it.
    pub(super) fn encoded(&mut self) -> (Bytes, usize) {
        if let Some(bytes) = &self.encoded {
            return (bytes.clone(), 0);
        }
        let (bytes, left_out) = self.encode();
        self.encoded = Some(bytes.clone());
        (bytes, left_out)
    }

    /// Returns the parties of the barriers at which local applications wait.
    pub(super) fn awaited(&self) -> impl Iterator<Item = &Requirement> {
        self.barriers.values().filter(|known| !known.waiting.is_empty()).flat_map(|known| &known.parties)
    }

    /// Returns the time at which the next wait is over without an opening.
    pub(super) fn next_over(&self) -> Option<Time> {
        self.barriers.values().flat_map(|known| known.waiting.values()).map(Wait::next).min()
    }

    /// Returns the time at which the frame is sent next.
    pub(super) fn next_due(&self) -> Option<Time> {
        self.views.next_due()
    }
}
