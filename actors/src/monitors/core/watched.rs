//! The lives of this node's applications, and which other nodes watch them.

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use sinew_runtime::{
    tid::{AppAddress, Incarnation, NodeAddress},
    time::Time,
};

use super::{Cause, LifeState, Watch};
use crate::monitors::words::Ended;

/// Ends that are remembered of applications that are gone. spec: MON-7
const GONE_MAX: usize = 1_024;
/// The same of guests' applications, beside these: however fast guests come and go, how the robot's own ended stays known.
const GONE_GUESTS_MAX: usize = 256;

/// The watched side.
#[derive(Debug)]
pub(super) struct Watched {
    lives: BTreeMap<AppAddress, Life>,
    /// Counts all lives of all applications, so that a later one has the higher number whoever holds the address.
    next_life: u64,
    gone: BTreeMap<AppAddress, (Ended, Time)>,
    gone_order: VecDeque<AppAddress>,
    gone_guests_order: VecDeque<AppAddress>,
    watchers: BTreeMap<NodeAddress, Watcher>,
    nodes_max: usize,
    version: u64,
}

/// Which user an application runs as.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Whose {
    /// The node's own, or root.
    Own,
    /// One whom the access list lets in.
    Guest,
}

#[derive(Debug)]
struct Life {
    whose: Whose,
    number: u64,
    began: Time,
    ended: Option<Ended>,
}

#[derive(Debug)]
struct Watcher {
    incarnation: Incarnation,
    version: u64,
    apps: BTreeSet<AppAddress>,
}

impl Watched {
    pub(super) const fn new(nodes_max: usize) -> Self {
        Self {
            lives: BTreeMap::new(),
            next_life: 1,
            gone: BTreeMap::new(),
            gone_order: VecDeque::new(),
            gone_guests_order: VecDeque::new(),
            watchers: BTreeMap::new(),
            nodes_max,
            version: 0,
        }
    }

    pub(super) fn began(&mut self, now: Time, app: AppAddress, whose: Whose) {
        if self.lives.contains_key(&app) {
            return;
        }
        let number = self.new_life();
        let ended = self.gone.remove(&app).map(|(ended, _)| ended);
        if ended.is_some() {
            // Its next end is remembered for as long as any other.
            self.gone_order.retain(|gone| *gone != app);
            self.gone_guests_order.retain(|gone| *gone != app);
        }
        self.lives.insert(app, Life { whose, number, began: now, ended });
    }

    fn new_life(&mut self) -> u64 {
        self.next_life += 1;
        self.next_life - 1
    }

    /// Returns which life it was that ended; `None` if there is none.
    pub(super) fn ended(&mut self, now: Time, app: AppAddress, cause: &Cause, is_gone: bool) -> Option<u64> {
        let number = self.new_life();
        let life = self.lives.get_mut(&app)?;
        let ended = Ended { life: life.number, cause: cause.clone() };
        let (former, whose) = (life.number, life.whose);
        *life = Life { whose, number, began: now, ended: Some(ended.clone()) };
        if is_gone {
            self.lives.remove(&app);
            self.remember((app, whose), ended, now);
        }
        Some(former)
    }

    fn remember(&mut self, (app, whose): (AppAddress, Whose), ended: Ended, now: Time) {
        let (order, most) = match whose {
            Whose::Own => (&mut self.gone_order, GONE_MAX),
            Whose::Guest => (&mut self.gone_guests_order, GONE_GUESTS_MAX),
        };
        if order.len() >= most
            && let Some(oldest) = order.pop_front()
        {
            self.gone.remove(&oldest);
        }
        order.push_back(app);
        self.gone.insert(app, (ended, now));
    }

    pub(super) fn life_of(&self, app: AppAddress) -> Option<u64> {
        self.lives.get(&app).map(|life| life.number)
    }

    /// What is known of `app` now.
    pub(super) fn state(&self, now: Time, app: AppAddress) -> LifeState {
        let age = |since: Time| u64::try_from(now.since(since).as_micros()).unwrap_or(u64::MAX);
        match (self.lives.get(&app), self.gone.get(&app)) {
            (Some(life), _) => {
                LifeState { app, life: life.number, age_us: age(life.began), ended: life.ended.clone() }
            }
            (None, Some((ended, at))) => {
                LifeState { app, life: 0, age_us: age(*at), ended: Some(ended.clone()) }
            }
            (None, None) => LifeState { app, life: 0, age_us: u64::MAX, ended: None },
        }
    }

    /// Takes over whom `from` watches; returns whom it has to be told of. `None` if this was said before, or there is no
    /// room for another node.
    pub(super) fn watch(&mut self, from: NodeAddress, watch: Watch) -> Option<Vec<AppAddress>> {
        let Watch { incarnation, version, apps } = watch;
        let is_old = |known: &Watcher| (known.incarnation, known.version) > (incarnation, version);
        let known = self.watchers.get(&from);
        if known.is_some_and(is_old) || (known.is_none() && self.watchers.len() >= self.nodes_max) {
            return None;
        }
        if apps.is_empty() {
            self.watchers.remove(&from);
            return None;
        }
        let watcher = Watcher { incarnation, version, apps: apps.iter().copied().collect() };
        self.watchers.insert(from, watcher);
        Some(apps)
    }

    pub(super) fn watchers_of(&self, app: AppAddress) -> Vec<NodeAddress> {
        let watching = self.watchers.iter().filter(|(_, watcher)| watcher.apps.contains(&app));
        watching.map(|(node, _)| *node).collect()
    }

    /// This life of `node` is over, and watches nobody any more.
    pub(super) fn forget_node(&mut self, node: NodeAddress, incarnation: Incarnation) {
        if self.watchers.get(&node).is_some_and(|watcher| watcher.incarnation <= incarnation) {
            self.watchers.remove(&node);
        }
    }

    pub(super) const fn next_version(&mut self) -> u64 {
        self.version += 1;
        self.version
    }
}
