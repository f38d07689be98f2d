//! Liveliness tokens of nodes and applications. A thread declares those that are wanted, and removes the others.

use std::{
    collections::{BTreeMap, BTreeSet},
    io,
    sync::{Arc, Condvar, Mutex, PoisonError},
    thread,
    time::Duration,
};

use sinew::{
    NodeAddress, Tid,
    events::{DirectoryEntry, DirectoryEvent, NodeEvent},
};
use sinew_zenoh_rules::Rules;
use tracing::warn;
use zenoh::{Session, Wait, liveliness::LivelinessToken};

use crate::shared::lock;

/// Maximum number of tokens. Further ones are not declared.
const TOKENS_MAX: usize = 4_096;
/// Time after which a token that zenoh has refused is tried again.
const AGAIN: Duration = Duration::from_secs(1);

/// The tokens that are wanted.
#[derive(Default)]
pub(crate) struct Tokens {
    wanted: Mutex<Wanted>,
    changed: Condvar,
}

#[derive(Default)]
struct Wanted {
    keys: BTreeSet<String>,
    is_changed: bool,
}

impl Tokens {
    /// Starts the thread that declares and removes tokens.
    pub(crate) fn start(self: &Arc<Self>, session: &Session) -> io::Result<()> {
        let (tokens, session) = (self.clone(), session.clone());
        let thread = thread::Builder::new().name("tokens".to_owned());
        thread.spawn(move || tokens.run(&session)).map(drop)
    }

    fn set(&self, keys: BTreeSet<String>) {
        let mut wanted = lock(&self.wanted);
        if wanted.keys != keys {
            (wanted.keys, wanted.is_changed) = (keys, true);
            self.changed.notify_one();
        }
    }

    /// Waits for a change, `AGAIN` at most if something is missing.
    fn next(&self, is_whole: bool) -> BTreeSet<String> {
        let mut wanted = lock(&self.wanted);
        while !wanted.is_changed {
            if is_whole {
                wanted = self.changed.wait(wanted).unwrap_or_else(PoisonError::into_inner);
            } else {
                let waited = self.changed.wait_timeout(wanted, AGAIN).unwrap_or_else(PoisonError::into_inner);
                wanted = waited.0;
                break;
            }
        }
        wanted.is_changed = false;
        wanted.keys.clone()
    }

    fn run(&self, session: &Session) {
        let mut declared: BTreeMap<String, LivelinessToken> = BTreeMap::new();
        let mut is_whole = true;
        while !session.is_closed() {
            let wanted = self.next(is_whole);
            // A token that is dropped is removed.
            declared.retain(|key, _| wanted.contains(key));
            is_whole = true;
            for key in wanted {
                if declared.contains_key(&key) {
                    continue;
                }
                match session.liveliness().declare_token(key.clone()).wait() {
                    Ok(token) => drop(declared.insert(key, token)),
                    Err(error) => {
                        is_whole = false;
                        warn!("no liveliness token {key}: {error}; tried again");
                    }
                }
            }
        }
    }
}

/// The nodes and applications that are there, as the node reports them.
pub(crate) struct Presence {
    tokens: Arc<Tokens>,
    own: NodeAddress,
    nodes: BTreeSet<NodeAddress>,
    apps: BTreeSet<(Tid, String)>,
}

impl Presence {
    pub(crate) fn new(tokens: Arc<Tokens>, own: NodeAddress) -> Self {
        Self { tokens, own, nodes: BTreeSet::from([own]), apps: BTreeSet::new() }
    }

    /// Forgets everything: the connection to the node has ended.
    pub(crate) fn disconnected(&mut self) {
        self.nodes.clear();
        self.apps.clear();
        self.tokens.set(BTreeSet::new());
    }

    /// Notes that the connection to the node is there, at this address.
    pub(crate) fn connected(&mut self, own: NodeAddress, rules: &Rules) {
        if self.nodes.insert(own) || self.own != own {
            self.own = own;
            self.publish(rules);
        }
    }

    pub(crate) fn directory_changed(&mut self, event: DirectoryEvent, rules: &Rules) {
        match event {
            DirectoryEvent::Is(DirectoryEntry { name, tid, ready: true, .. }) => {
                if rules.app_token(tid, &name).is_some() && self.apps.len() < TOKENS_MAX {
                    self.apps.insert((tid, name));
                }
            }
            DirectoryEvent::Is(DirectoryEntry { name, tid, .. }) | DirectoryEvent::Gone { name, tid } => {
                self.apps.remove(&(tid, name));
            }
        }
        self.publish(rules);
    }

    pub(crate) fn node_changed(&mut self, event: &NodeEvent, rules: &Rules) {
        match event {
            NodeEvent::NodeFound { node, .. } => {
                if self.nodes.len() < TOKENS_MAX {
                    self.nodes.insert(*node);
                }
            }
            NodeEvent::NodeLost { node, .. } => {
                self.nodes.remove(node);
                self.apps.retain(|(tid, _)| tid.node != *node);
            }
            // Its applications are in events of the directory.
            NodeEvent::NodeRestarted { .. } | NodeEvent::AppStalled { .. } | NodeEvent::AppResumed { .. } => {
            }
        }
        self.publish(rules);
    }

    fn publish(&self, rules: &Rules) {
        let nodes = self.nodes.iter().filter_map(|node| rules.node_token(*node));
        let apps = self.apps.iter().filter_map(|(tid, name)| rules.app_token(*tid, name));
        self.tokens.set(nodes.chain(apps).collect());
    }
}
