//! What a node says of itself: the accounts of all its places, and how far its sessions are.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use sinew_runtime::{
    tid::{Incarnation, NodeAddress},
    wire::Class,
};

use super::account::{Account, Place};
use crate::{
    gncl::{Peer, WayAccount},
    stores::{Stores, lock},
};

/// What one node says of itself, as it was at one moment.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct NodeAudit {
    /// Which node.
    pub node: NodeAddress,
    /// Its name.
    pub name: String,
    /// Which life of it: its counters began with that.
    pub incarnation: Incarnation,
    /// Its places that ever took or refused a message, in order.
    pub entries: Vec<Entry>,
    /// Its sessions with other nodes.
    pub sessions: Vec<Session>,
    /// How often something was refused, for each cause: what nobody took, and what came from outside and could not be used.
    pub refused: BTreeMap<String, u64>,
}

/// One place and its account.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Entry {
    /// Which place.
    pub place: Place,
    /// What became of the messages there.
    pub account: Account,
}

/// How far a session with another node is, on one side.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Session {
    /// The other node.
    pub node: NodeAddress,
    /// Of which messages; `None`: of all.
    pub class: Option<Class>,
    /// What this node has sent.
    pub sending: Sending,
    /// What it has taken.
    pub receiving: Receiving,
}

/// How far what a node sends is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Sending {
    /// In which epoch its messages are numbered, from 1.
    pub epoch: u64,
    /// The memory of the other node that they are for; `None` before the first word of it.
    pub memory: Option<u64>,
    /// The other node has said to have all before this number.
    pub acknowledged: u64,
    /// The number of the next message.
    pub next: u64,
}

/// How far what a node takes is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Receiving {
    /// In which memory it keeps that: another one has forgotten what was before.
    pub memory: u64,
    /// The other node's epoch; 0 before the first word of it.
    pub epoch: u64,
    /// The number that it takes next: it has all before it.
    pub next: u64,
}

/// What the node whose stores these are says of itself now.
pub(crate) fn read(stores: &Stores) -> NodeAudit {
    let mut entries: BTreeMap<Place, Account> = BTreeMap::new();
    let mut count = |place, account: Account| {
        let entry = entries.entry(place).or_default();
        *entry = *entry + account;
    };
    for (place, account) in stores.book.read() {
        count(place, account);
    }
    // Held until the accounts of those that are gone are read: none is in both.
    let met = stores.gncl.met();
    for peer in &met {
        for (class, way) in ways(peer) {
            let node = peer.node;
            count(Place::ToNode { node, class }, Account::of_outlet(&way.sent));
            count(Place::FromNode { node, class }, Account::of_arrivals(&way.arrived));
        }
    }
    let buried = stores.gncl.buried();
    count(Place::ToFormerNodes, buried.sent);
    count(Place::FromFormerNodes, buried.arrived);
    let entries = entries.into_iter().filter(|(_, account)| !account.is_empty());
    NodeAudit {
        node: stores.node,
        name: stores.config.name.clone(),
        incarnation: stores.incarnation,
        entries: entries.map(|(place, account)| Entry { place, account }).collect(),
        sessions: stores.gncl.peers().iter().flat_map(|peer| sessions(peer)).collect(),
        refused: refused(stores),
    }
}

/// The sessions with a peer, and of which class they are.
fn ways(peer: &Peer) -> impl Iterator<Item = (Option<Class>, WayAccount)> {
    let accounts = peer.accounts();
    let by_class = accounts.len() > 1;
    let class = move |at: usize| Class::ALL.get(at).copied().filter(|_| by_class);
    accounts.into_iter().enumerate().map(move |(at, way)| (class(at), way))
}

fn sessions(peer: &Peer) -> Vec<Session> {
    let session = |(class, way): (_, WayAccount)| {
        let sent = way.sending?;
        let sending = Sending {
            epoch: sent.epoch,
            memory: sent.memory,
            acknowledged: sent.acknowledged,
            next: sent.next,
        };
        let came = way.receiving;
        let receiving = Receiving { memory: came.memory, epoch: came.epoch, next: came.next };
        Some(Session { node: peer.node, class, sending, receiving })
    };
    ways(peer).filter_map(session).collect()
}

fn refused(stores: &Stores) -> BTreeMap<String, u64> {
    let mut refused = BTreeMap::new();
    for (why, count) in stores.router.refused_because() {
        *refused.entry(format!("not taken: {why:?}")).or_default() += count;
    }
    let layers = [
        stores.refusals.by_cause(),
        stores.gncl.refusals.by_cause(),
        lock(&stores.ndl).refusals().by_cause(),
    ];
    for (cause, count) in layers.into_iter().flatten() {
        *refused.entry(cause.to_owned()).or_default() += count;
    }
    refused
}

impl NodeAudit {
    /// The account of a place; all 0 where there is no such place.
    #[must_use]
    pub fn account(&self, place: &Place) -> Account {
        let entry = self.entries.iter().find(|entry| entry.place == *place);
        entry.map(|entry| entry.account).unwrap_or_default()
    }
}
