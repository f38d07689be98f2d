//! The lives of this node's applications, and the nodes that monitor them.

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use sinew_model::cause::Cause;
use sinew_runtime::{
    tid::{AppAddress, Incarnation, NodeAddress},
    time::Time,
};

use super::{LifeState, Watch};
use crate::monitors::protocol::Ended;

/// Maximum number of removed applications with a remembered end. spec: MON-7
const REMOVED_MAX: usize = 1_024;
/// Maximum number of removed guests with a remembered end. The separate limit keeps guests from displacing
/// the ends of the robot's own applications.
const REMOVED_GUESTS_MAX: usize = 256;

/// The monitored side: lives of local applications.
#[derive(Debug)]
pub(super) struct Watched {
    lives: BTreeMap<AppAddress, Life>,
    /// Counter of all lives of all applications. A later life has a higher number, also if another
    /// application gets the address.
    next_life: u64,
    removed: BTreeMap<AppAddress, (Ended, Time)>,
    removed_order: VecDeque<AppAddress>,
    removed_guests_order: VecDeque<AppAddress>,
    watchers: BTreeMap<NodeAddress, Watcher>,
    nodes_max: usize,
    version: u64,
}

/// The user that an application runs as.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Owner {
    /// The node's own user, or root.
    Own,
    /// A user that the access list permits.
    Guest,
}

#[derive(Debug)]
struct Life {
    owner: Owner,
    number: u64,
    started: Time,
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
            removed: BTreeMap::new(),
            removed_order: VecDeque::new(),
            removed_guests_order: VecDeque::new(),
            watchers: BTreeMap::new(),
            nodes_max,
            version: 0,
        }
    }

    pub(super) fn started(&mut self, now: Time, app: AppAddress, owner: Owner) {
        if self.lives.contains_key(&app) {
            return;
        }
        let number = self.new_life();
        let ended = self.removed.remove(&app).map(|(ended, _)| ended);
        if ended.is_some() {
            // The next end of this application is remembered as long as any other.
            self.removed_order.retain(|removed| *removed != app);
            self.removed_guests_order.retain(|removed| *removed != app);
        }
        self.lives.insert(app, Life { owner, number, started: now, ended });
    }

    fn new_life(&mut self) -> u64 {
        self.next_life += 1;
        self.next_life - 1
    }

    /// Ends the current life of `app`. Returns the number of the ended life, or `None` if the application is
    /// not known.
    pub(super) fn ended(&mut self, now: Time, app: AppAddress, cause: &Cause, is_gone: bool) -> Option<u64> {
        let number = self.new_life();
        let life = self.lives.get_mut(&app)?;
        let ended = Ended { life: life.number, cause: cause.clone() };
        let (former, owner) = (life.number, life.owner);
        *life = Life { owner, number, started: now, ended: Some(ended.clone()) };
        if is_gone {
            self.lives.remove(&app);
            self.remember((app, owner), ended, now);
        }
        Some(former)
    }

    fn remember(&mut self, (app, owner): (AppAddress, Owner), ended: Ended, now: Time) {
        let (order, most) = match owner {
            Owner::Own => (&mut self.removed_order, REMOVED_MAX),
            Owner::Guest => (&mut self.removed_guests_order, REMOVED_GUESTS_MAX),
        };
        if order.len() >= most
            && let Some(oldest) = order.pop_front()
        {
            self.removed.remove(&oldest);
        }
        order.push_back(app);
        self.removed.insert(app, (ended, now));
    }

    pub(super) fn life_of(&self, app: AppAddress) -> Option<u64> {
        self.lives.get(&app).map(|life| life.number)
    }

    /// Returns the current state of `app`.
    pub(super) fn state(&self, now: Time, app: AppAddress) -> LifeState {
        let age = |since: Time| u64::try_from(now.since(since).as_micros()).unwrap_or(u64::MAX);
        match (self.lives.get(&app), self.removed.get(&app)) {
            (Some(life), _) => {
                LifeState { app, life: life.number, age_us: age(life.started), ended: life.ended.clone() }
            }
            (None, Some((ended, at))) => {
                LifeState { app, life: 0, age_us: age(*at), ended: Some(ended.clone()) }
            }
            (None, None) => LifeState { app, life: 0, age_us: u64::MAX, ended: None },
        }
    }

    /// Stores the list of applications that `from` monitors. Returns the applications that it needs the
    /// states of. Returns `None` if the list is outdated or empty, or if there is no room for another node.
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

    /// Removes the list of `node` if it is not from a later incarnation.
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
