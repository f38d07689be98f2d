//! The report of a node about itself: the accounts of all its places, and the state of its sessions.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use sinew_gncl::{Peer, SessionAccount, accounts::session_accounts};
use sinew_runtime::{
    lock,
    tid::{Incarnation, NodeAddress},
    wire::Class,
};
use sinew_session::{counts::Account, place::Place};

use crate::NodeState;

/// The report of one node about itself at one moment.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct NodeAudit {
    /// The address of the node.
    pub node: NodeAddress,
    /// The name of the node.
    pub name: String,
    /// The incarnation of the node: its counters began with that.
    pub incarnation: Incarnation,
    /// The places that ever took or refused a message, in order.
    pub entries: Vec<Entry>,
    /// The sessions with other nodes.
    pub sessions: Vec<Session>,
    /// The number of refusals for each cause: messages without a receiver, and inputs from outside that could
    /// not be used.
    pub refused: BTreeMap<String, u64>,
}

/// One place and its account.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Entry {
    /// The place.
    pub place: Place,
    /// The outcomes of the messages there.
    pub account: Account,
}

/// The state of one side of a session with another node.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Session {
    /// The address of the other node.
    pub node: NodeAddress,
    /// The class of the messages; `None` if the session carries all classes.
    pub class: Option<Class>,
    /// The messages that this node has sent.
    pub sending: Sending,
    /// The messages that this node has taken.
    pub receiving: Receiving,
}

/// The state of the sending side of a session.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Sending {
    /// The epoch in which the messages are numbered, from 1.
    pub epoch: u64,
    /// The receiver ID of the other node to which the messages are sent; `None` before its first acknowledgement.
    pub memory: Option<u64>,
    /// The other node has acknowledged all messages before this number.
    pub acknowledged: u64,
    /// The number of the next message.
    pub next: u64,
}

/// The state of the receiving side of a session.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Receiving {
    /// The receiver ID under which this state is kept: another ID means that the earlier state was lost.
    pub memory: u64,
    /// The other node's epoch; 0 before its first frame.
    pub epoch: u64,
    /// The number of the next message: all before it have been received.
    pub next: u64,
}

/// Returns the current report of the node that owns this state.
pub(crate) fn read(state: &NodeState) -> NodeAudit {
    let mut entries: BTreeMap<Place, Account> = BTreeMap::new();
    let mut count = |place, account: Account| {
        let entry = entries.entry(place).or_default();
        *entry = *entry + account;
    };
    for (place, account) in state.lncl.book.read() {
        count(place, account);
    }
    for (place, account) in state.gncl.accounts() {
        count(place, account);
    }
    let entries = entries.into_iter().filter(|(_, account)| !account.is_empty());
    NodeAudit {
        node: state.ctx.node,
        name: state.ctx.config.name.clone(),
        incarnation: state.ctx.incarnation,
        entries: entries.map(|(place, account)| Entry { place, account }).collect(),
        sessions: state.gncl.store.peers().iter().flat_map(|peer| sessions(peer)).collect(),
        refused: refused(state),
    }
}

fn sessions(peer: &Peer) -> Vec<Session> {
    let session = |(class, account): (_, SessionAccount)| {
        let sent = account.sending?;
        let sending = Sending {
            epoch: sent.epoch,
            memory: sent.receiver_id,
            acknowledged: sent.acknowledged,
            next: sent.next,
        };
        let came = account.receiving;
        let receiving = Receiving { memory: came.receiver_id, epoch: came.epoch, next: came.next };
        Some(Session { node: peer.node, class, sending, receiving })
    };
    session_accounts(peer).filter_map(session).collect()
}

fn refused(state: &NodeState) -> BTreeMap<String, u64> {
    let mut refused = BTreeMap::new();
    for (why, count) in state.ctx.router.refused_because() {
        *refused.entry(format!("not taken: {why:?}")).or_default() += count;
    }
    let layers = [
        state.ctx.refusals.by_cause(),
        state.gncl.store.refusals.by_cause(),
        lock(&state.ndl.core).refusals().by_cause(),
    ];
    for (cause, count) in layers.into_iter().flatten() {
        *refused.entry(cause.to_owned()).or_default() += count;
    }
    refused
}

impl NodeAudit {
    /// Returns the account of a place; all 0 if there is no such place.
    #[must_use]
    pub fn account(&self, place: &Place) -> Account {
        let entry = self.entries.iter().find(|entry| entry.place == *place);
        entry.map(|entry| entry.account).unwrap_or_default()
    }
}
