//! The pending events of NDL for GNCL and the sync manager, until their event queues have room for them.
//!
//! For each node the backlog keeps at most: the end of the incarnation that the layer knows, the end of the last
//! incarnation of which it was not notified, the lifted bar of an incarnation, and the current state.

use std::{net::SocketAddr, sync::Mutex};

use sinew_model::{
    event_backlog::{CoalescingRules, EventBacklog, Role},
    events::{EventQueues, FullQueues, GnclEvent, SyncEvent},
    facts::MembershipFact,
};
use sinew_runtime::{
    lock,
    tid::{Incarnation, NodeAddress},
};

use super::core::Output;

/// Maximum number of pending events of one layer per possible member. Nodes that appeared and disappeared
/// meanwhile share the rest.
const PER_NODE_MAX: usize = 4;

/// The pending events of both layers. They survive a restart of NDL.
#[derive(Debug)]
pub struct MemberEvents {
    gncl: Mutex<EventBacklog<Rules>>,
    sync: Mutex<EventBacklog<Rules>>,
}

/// An event about a node.
#[derive(Clone, Debug, PartialEq, Eq)]
enum MemberEvent {
    Fact {
        fact: MembershipFact,
        /// The ended incarnation is fenced.
        is_fenced: bool,
    },
    Moved {
        node: NodeAddress,
        incarnation: Incarnation,
        gncl: Vec<SocketAddr>,
    },
    /// A former incarnation of the node bars no other one.
    Forgotten {
        node: NodeAddress,
        incarnation: Incarnation,
    },
}

#[derive(Debug)]
struct Rules;

impl CoalescingRules for Rules {
    type Event = MemberEvent;
    type Subject = NodeAddress;
    type Incarnation = Incarnation;

    // A layer may know an incarnation from elsewhere.
    const KEEPS_UNKNOWN_ENDS: bool = true;

    fn subject(&self, event: &MemberEvent) -> NodeAddress {
        let (MemberEvent::Fact {
            fact: MembershipFact::NodeFound { node, .. } | MembershipFact::NodeLost { node, .. },
            ..
        }
        | MemberEvent::Moved { node, .. }
        | MemberEvent::Forgotten { node, .. }) = event;
        *node
    }

    fn role(&self, event: &MemberEvent) -> Role<Incarnation> {
        match event {
            MemberEvent::Fact { fact: MembershipFact::NodeFound { incarnation, .. }, .. }
            | MemberEvent::Moved { incarnation, .. } => Role::Begins(*incarnation),
            MemberEvent::Fact { fact: MembershipFact::NodeLost { incarnation, .. }, .. } => {
                Role::Ends(*incarnation)
            }
            MemberEvent::Forgotten { .. } => Role::Standalone,
        }
    }

    fn supersedes(&self, later: &MemberEvent, former: &MemberEvent) -> bool {
        match (self.role(later), self.role(former)) {
            (Role::Begins(_), Role::Begins(_)) | (Role::Standalone, Role::Standalone) => true,
            (Role::Ends(ended), Role::Begins(begun)) => ended == begun,
            _ => false,
        }
    }

    fn is_minor(&self, event: &MemberEvent) -> bool {
        matches!(event, MemberEvent::Forgotten { .. })
    }
}

impl MemberEvents {
    /// Creates empty backlogs, for at most `nodes_max` members.
    pub fn new(nodes_max: usize) -> Self {
        let capacity = nodes_max.saturating_mul(PER_NODE_MAX);
        Self {
            gncl: Mutex::new(EventBacklog::new(Rules, capacity)),
            sync: Mutex::new(EventBacklog::new(Rules, capacity)),
        }
    }

    /// Adds the event of this output for the layers.
    pub(super) fn push(&self, output: &Output) {
        if let Output::Fact(fact) = output {
            let event = MemberEvent::Fact { fact: fact.clone(), is_fenced: false };
            lock(&self.gncl).push(event.clone());
            lock(&self.sync).push(event);
        } else if let Output::Moved { node, incarnation, gncl } = output {
            let (node, incarnation, gncl) = (*node, *incarnation, gncl.clone());
            lock(&self.gncl).push(MemberEvent::Moved { node, incarnation, gncl });
        } else if let Output::Forgotten { node, incarnation } = output {
            lock(&self.gncl).push(MemberEvent::Forgotten { node: *node, incarnation: *incarnation });
        }
    }

    /// Records that an ended incarnation of the node is fenced.
    pub(super) fn set_fenced(&self, node: NodeAddress, ended: Incarnation) {
        for backlog in [&self.gncl, &self.sync] {
            lock(backlog).events_mut().for_each(|event| event.set_fenced(node, ended));
        }
    }

    /// Offers the pending events to both layers. Each loss is fenced with `fence` first, in case an instance
    /// of NDL ended between the loss and its fence.
    pub(super) fn offer(&self, event_queues: &EventQueues, fence: impl Fn(&MembershipFact)) -> FullQueues {
        let gncl = lock(&self.gncl).offer(|event| {
            event.fence(&fence);
            event_queues.gncl.post(event.clone().into()).is_ok()
        });
        let sync = lock(&self.sync).offer(|event| {
            event.fence(&fence);
            let MemberEvent::Fact { fact, .. } = event else { return true };
            event_queues.sync.post(SyncEvent::Membership(fact.clone())).is_ok()
        });
        FullQueues { gncl: !gncl, sync: !sync, ..FullQueues::default() }
    }
}

impl MemberEvent {
    fn set_fenced(&mut self, of: NodeAddress, ended: Incarnation) {
        if let Self::Fact { fact: MembershipFact::NodeLost { node, incarnation, .. }, is_fenced } = self
            && (*node, *incarnation) == (of, ended)
        {
            *is_fenced = true;
        }
    }

    /// Fences the incarnation of which this is the end, once.
    fn fence(&mut self, fence: impl Fn(&MembershipFact)) {
        if let Self::Fact { fact: fact @ MembershipFact::NodeLost { .. }, is_fenced } = self
            && !std::mem::replace(is_fenced, true)
        {
            fence(fact);
        }
    }
}

impl From<MemberEvent> for GnclEvent {
    fn from(event: MemberEvent) -> Self {
        match event {
            MemberEvent::Fact { fact, .. } => Self::Membership(fact),
            MemberEvent::Moved { node, incarnation, gncl } => Self::Moved { node, incarnation, gncl },
            MemberEvent::Forgotten { node, incarnation } => Self::Forgotten { node, incarnation },
        }
    }
}

#[cfg(test)]
mod tests;
