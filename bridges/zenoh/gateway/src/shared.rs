//! The state that all parts of the bridge share.

use std::{
    collections::{BTreeMap, BTreeSet},
    sync::{
        Arc, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicUsize, Ordering},
    },
    time::{Duration, Instant},
};

use sinew::{Tid, schema::Schema};
use sinew_bridge_node::{Destination, ProtectedTypes};
use sinew_zenoh_rules::{Config, Counts, Passed, Refusal, Target};
use tracing::{debug, info, warn};

/// Minimum time between two lines of the log about one cause.
const LOGGED_EVERY: Duration = Duration::from_secs(1);
/// Maximum number of characters of a text from outside in the log.
const SHOWN_MAX: usize = 160;

/// The state of all parts.
pub(crate) struct Shared {
    pub(crate) config: Config,
    pub(crate) counts: Counts,
    /// The longest payload that the node accepts.
    pub(crate) payload_max: AtomicUsize,
    /// The addresses of the bridge's own clients.
    own: Mutex<BTreeSet<Tid>>,
    /// The structures of types, by the index of the route into Sinew.
    structures: Mutex<BTreeMap<usize, Arc<Schema>>>,
    protected: Mutex<ProtectedTypes>,
    logged: Mutex<BTreeMap<Refusal, Instant>>,
}

impl Shared {
    pub(crate) fn new(config: Config) -> Self {
        Self {
            config,
            counts: Counts::default(),
            payload_max: AtomicUsize::new(0),
            own: Mutex::default(),
            structures: Mutex::default(),
            protected: Mutex::default(),
            logged: Mutex::default(),
        }
    }

    pub(crate) fn pass(&self, way: Passed) {
        self.counts.pass(way);
    }

    /// Counts a refused message, and logs it at most once a second for each cause.
    pub(crate) fn refuse(&self, why: Refusal, what: &str, detail: &str) {
        self.refuse_several(why, 1, what, detail);
    }

    pub(crate) fn refuse_several(&self, why: Refusal, messages: u64, what: &str, detail: &str) {
        let before = self.counts.refuse(why, messages);
        let now = Instant::now();
        {
            let mut logged = lock(&self.logged);
            if logged.get(&why).is_some_and(|last| now.duration_since(*last) < LOGGED_EVERY) {
                return;
            }
            logged.insert(why, now);
        }
        let count = before + messages;
        let (what, colon) = (shown(what), if detail.is_empty() { "" } else { ": " });
        let detail = shown(detail);
        if why == Refusal::NoRuleOut {
            // A group may carry further types, which nothing in Zenoh wants.
            debug!("not passed on, {count} so far: {what}{colon}{detail}: {why}");
        } else {
            warn!("refused, {count} so far: {what}{colon}{detail}: {why}");
        }
    }

    /// Notes the address of an own client.
    pub(crate) fn note_own(&self, tid: Tid) {
        let mut own = lock(&self.own);
        // An address of before a restart of the node: further ones cost messages of others nothing.
        if own.len() >= 1_024 {
            own.clear();
        }
        own.insert(tid);
    }

    pub(crate) fn is_own(&self, tid: Tid) -> bool {
        lock(&self.own).contains(&tid)
    }

    pub(crate) fn structure(&self, route: usize) -> Option<Arc<Schema>> {
        lock(&self.structures).get(&route).cloned()
    }

    pub(crate) fn set_structures(&self, structures: BTreeMap<usize, Arc<Schema>>) {
        let former = std::mem::replace(&mut *lock(&self.structures), structures.clone());
        for (index, schema) in structures.into_iter().filter(|(index, new)| former.get(index) != Some(new)) {
            let address = &self.config.rules.inward()[index].address;
            info!(
                "the structure of {} for {} is known: {}",
                address.payload_type,
                address.target,
                schema.hash()
            );
        }
    }

    pub(crate) fn set_protected(&self, protected: ProtectedTypes) {
        let former = std::mem::replace(&mut *lock(&self.protected), protected.clone());
        for name in protected.names.difference(&former.names) {
            info!("{name} is a protected type: it passes only by a rule with `protected`");
        }
    }

    pub(crate) fn is_protected(&self, payload_type: &str) -> bool {
        lock(&self.protected).names.contains(payload_type)
    }

    pub(crate) fn payload_max(&self) -> usize {
        self.payload_max.load(Ordering::Relaxed)
    }
}

/// Returns a destination as the client of the node takes it.
pub(crate) fn destination(target: &Target) -> Destination {
    match (target, target.tid()) {
        (_, Some(tid)) => Destination::Tid(tid),
        (Target::Name(name), None) => Destination::Name(name.clone()),
        (Target::Tid(_) | Target::Group(_) | Target::All, None) => Destination::Tid(Tid::NONE),
    }
}

/// Returns a text from outside without control characters, and of bounded length.
fn shown(text: &str) -> String {
    text.chars().take(SHOWN_MAX).map(|letter| if letter.is_control() { '?' } else { letter }).collect()
}

pub(crate) fn lock<T>(of: &Mutex<T>) -> MutexGuard<'_, T> {
    of.lock().unwrap_or_else(PoisonError::into_inner)
}
