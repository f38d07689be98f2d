//! The record of one other node.

use std::collections::BTreeMap;

use sinew_runtime::tid::{AppAddress, Incarnation};

use crate::{
    core::Reason,
    list::{Entry, Name},
};

/// The state of one other node.
#[derive(Debug, Default)]
pub(super) struct Peer {
    /// The incarnation that messages can reach now.
    pub(super) linked: Option<Incarnation>,
    /// The incarnation that was found last, or linked after that.
    pub(super) found: Option<Incarnation>,
    /// Why the node is absent, if it is.
    pub(super) lost: Option<Reason>,
    /// The incarnation that was lost last, and why, until it is found again.
    pub(super) gone: Option<(Incarnation, Reason)>,
    /// Whether the node sent a list since the link came up or the node was lost.
    pub(super) has_reported: bool,
    /// Whether the list is about an incarnation that has ended.
    pub(super) stale: bool,
    pub(super) list: Option<Listed>,
    /// The node's groups in the routing table.
    pub(super) routed: Vec<AppAddress>,
}

/// The last list of a node.
#[derive(Debug)]
pub(super) struct Listed {
    pub(super) incarnation: Incarnation,
    pub(super) version: u64,
    pub(super) entries: BTreeMap<Name, Entry>,
    pub(super) groups: Vec<AppAddress>,
}

impl Peer {
    /// Returns whether the state of this peer is valid. spec: SYNC-3
    pub(super) const fn is_current(&self) -> bool {
        self.linked.is_some() && self.has_reported && self.lost.is_none()
    }

    pub(super) fn entry(&self, name: &str) -> Option<&Entry> {
        self.list.as_ref()?.entries.get(name)
    }

    /// Returns why an application in the peer's list is not ready, or has not reached a phase. Returns `None`
    /// if it is, or has.
    pub(super) fn why_not(&self, entry: &Entry, phase: Option<&str>) -> Option<Reason> {
        if self.lost.is_some() {
            self.lost
        } else if self.stale {
            Some(Reason::NodeRestarted)
        } else if self.linked.is_none() {
            Some(Reason::LinkDown)
        } else if !self.has_reported {
            Some(Reason::ListAwaited)
        } else if let Some(phase) = phase {
            let has_reached = entry.phases.iter().any(|reached| &**reached == phase);
            (!has_reached).then(|| entry.ended.map_or(Reason::NotReached, Reason::from))
        } else if entry.ready {
            None
        } else {
            Some(entry.ended.map_or(Reason::NotReady, Reason::from))
        }
    }

    pub(super) fn wanted_groups(&self) -> &[AppAddress] {
        match &self.list {
            Some(list) if self.lost.is_none() && !self.stale => &list.groups,
            _ => &[],
        }
    }

    /// Sets the current incarnation of the peer. A list about another incarnation is stale and invalid; a list
    /// about this one is not stale.
    pub(super) fn expect(&mut self, incarnation: Incarnation) {
        if let Some(list) = &self.list {
            self.stale = list.incarnation != incarnation;
            self.has_reported &= !self.stale;
        }
    }

    /// Returns the known incarnation: of the link, or else of the list, unless another incarnation was linked
    /// after the list. The linked one may be earlier, if the host's clock was reset.
    pub(super) fn known_incarnation(&self) -> Option<Incarnation> {
        let listed = self.list.as_ref().filter(|_| !self.stale).map(|list| list.incarnation);
        self.linked.or(listed)
    }

    /// Returns whether an event about `incarnation` is about an earlier one than the known.
    pub(super) fn is_former(&self, incarnation: Incarnation) -> bool {
        self.known_incarnation().is_some_and(|known| incarnation < known)
    }
}
