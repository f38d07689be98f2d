//! Pending link events for NDL and the sync manager, until their event queues have room for them.
//!
//! The last event of each kind is kept per incarnation of a node, in the order of their occurrence. A layer is
//! therefore notified once that a link was down, however often it was, and then of its present state.

use std::sync::Mutex;

use sinew_model::{
    event_backlog::{CoalescingRules, EventBacklog, Role},
    events::{EventQueues, FullQueues, NdlEvent, SyncEvent},
    facts::LinkFact,
};
use sinew_runtime::{lock, tid::NodeAddress};
use tokio::sync::Notify;

/// Maximum number of events kept for one layer, per possible member: all kinds for one incarnation. More events
/// than that belong to nodes that joined and left meanwhile: the oldest one matters least.
const PER_NODE_MAX: usize = 4;

/// The pending events for both layers. They are kept while GNCL is restarted.
#[derive(Debug)]
pub struct LinkEvents {
    ndl: Mutex<EventBacklog<Rules>>,
    sync: Mutex<EventBacklog<Rules>>,
    /// Notified when a layer had no room for an event. There is one waiter.
    pub(super) has_pending: Notify,
}

#[derive(Debug)]
struct Rules;

impl CoalescingRules for Rules {
    type Event = LinkFact;
    type Subject = NodeAddress;
    type Incarnation = ();

    const KEEPS_UNKNOWN_ENDS: bool = false;

    fn subject(&self, fact: &LinkFact) -> NodeAddress {
        fact.subject().0
    }

    fn role(&self, _: &LinkFact) -> Role<()> {
        Role::Standalone
    }

    fn supersedes(&self, later: &LinkFact, former: &LinkFact) -> bool {
        later == former
    }
}

impl LinkEvents {
    /// Creates empty backlogs for at most `nodes_max` members.
    pub fn new(nodes_max: usize) -> Self {
        let capacity = nodes_max.saturating_mul(PER_NODE_MAX);
        Self {
            ndl: Mutex::new(EventBacklog::new(Rules, capacity)),
            sync: Mutex::new(EventBacklog::new(Rules, capacity)),
            has_pending: Notify::const_new(),
        }
    }

    /// Adds an event for both layers.
    pub(super) fn push(&self, fact: LinkFact) {
        lock(&self.ndl).push(fact.clone());
        lock(&self.sync).push(fact);
    }

    /// Reports the links of a former instance as broken until this instance has established them again, which
    /// may fail. The sync manager, with its monitors and wills, was not restarted, so it is notified. NDL
    /// checks by itself when it starts, which it does after this layer.
    pub(super) fn links_are_cut(&self, broken: impl Iterator<Item = LinkFact>) {
        lock(&self.ndl).retain(|fact| !matches!(fact, LinkFact::LinkUp { .. } | LinkFact::LinkBroken { .. }));
        let mut sync = lock(&self.sync);
        broken.for_each(|fact| _ = sync.push(fact));
    }

    /// Notifies both layers, as far as their queues have room.
    pub(super) fn offer(&self, event_queues: &EventQueues) -> FullQueues {
        let ndl = lock(&self.ndl).offer(|fact| event_queues.ndl.post(NdlEvent::Link(fact.clone())).is_ok());
        let sync =
            lock(&self.sync).offer(|fact| event_queues.sync.post(SyncEvent::Link(fact.clone())).is_ok());
        FullQueues { ndl: !ndl, sync: !sync, ..FullQueues::default() }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use sinew_runtime::tid::Incarnation;

    use super::*;

    const fn up(node: u32) -> LinkFact {
        LinkFact::LinkUp { node: NodeAddress::new(node), incarnation: Incarnation(1) }
    }

    const fn broken(node: u32) -> LinkFact {
        LinkFact::LinkBroken { node: NodeAddress::new(node), incarnation: Incarnation(1) }
    }

    fn kept(nodes_max: usize, facts: impl IntoIterator<Item = LinkFact>) -> Vec<LinkFact> {
        let link_events = LinkEvents::new(nodes_max);
        facts.into_iter().for_each(|fact| link_events.push(fact));
        delivered(&link_events.sync)
    }

    fn delivered(backlog: &Mutex<EventBacklog<Rules>>) -> Vec<LinkFact> {
        let mut delivered = Vec::new();
        assert!(lock(backlog).offer(|fact| {
            delivered.push(fact.clone());
            true
        }));
        delivered
    }

    #[test]
    fn rejected_events_are_retried_before_later_ones() {
        let LinkEvents { sync, .. } = LinkEvents::new(2);
        lock(&sync).push(up(1));
        assert!(!lock(&sync).offer(|_| false));
        lock(&sync).push(up(2));
        assert_eq!(delivered(&sync), [up(1), up(2)]);
        assert_eq!(delivered(&sync), []);
    }

    #[test]
    fn layer_receives_one_link_down_then_the_present_state() {
        assert_eq!(kept(8, [up(1), broken(1), up(1), broken(1), up(1)]), [broken(1), up(1)]);
        assert_eq!(kept(8, [broken(1), up(2), up(1), broken(1)]), [up(2), up(1), broken(1)]);
    }

    #[test]
    fn backlog_is_bounded() {
        let kept = kept(2, (1..=100).flat_map(|node| [up(node), broken(node)]));
        assert_eq!(kept, (97..=100).flat_map(|node| [up(node), broken(node)]).collect::<Vec<_>>());
    }

    #[test]
    fn cut_links_are_reported_to_the_sync_manager_only() {
        let link_events = LinkEvents::new(8);
        let left =
            LinkFact::PeerLeft { node: NodeAddress::new(1), incarnation: Incarnation(1), gave_up: None };
        link_events.push(left.clone());
        link_events.push(up(2));
        link_events.links_are_cut([broken(2)].into_iter());
        assert_eq!(delivered(&link_events.ndl), std::slice::from_ref(&left));
        assert_eq!(delivered(&link_events.sync), [left, up(2), broken(2)]);
    }

    proptest! {
        #[test]
        fn reader_ends_with_the_true_links(
            steps in prop::collection::vec((0_u32..4, 0_u8..4, 0_usize..4), 0..64)
        ) {
            let mut backlog = EventBacklog::new(Rules, 4 * PER_NODE_MAX);
            let (mut happened, mut delivered) = (Vec::new(), Vec::new());
            for (node, kind, room) in steps {
                let (of, incarnation) = (NodeAddress::new(node), Incarnation(1));
                let fact = match kind {
                    0 => up(node),
                    1 => broken(node),
                    2 => LinkFact::DialRefused { node: of, incarnation },
                    _ => LinkFact::PeerLeft { node: of, incarnation, gave_up: None },
                };
                happened.push(fact.clone());
                backlog.push(fact);
                prop_assert!(backlog.len() <= 4 * PER_NODE_MAX);
                let mut room = room;
                backlog.offer(|fact| {
                    let is_taken = room > 0;
                    if is_taken {
                        delivered.push(fact.clone());
                        room -= 1;
                    }
                    is_taken
                });
            }
            backlog.offer(|fact| {
                delivered.push(fact.clone());
                true
            });
            // The last events of each node are the last that happened, in their order.
            for node in 0..4 {
                let of_node = |facts: &[LinkFact]| {
                    let of = facts.iter().filter(|fact| Rules.subject(fact) == NodeAddress::new(node));
                    of.cloned().collect::<Vec<_>>()
                };
                let (happened, delivered) = (of_node(&happened), of_node(&delivered));
                prop_assert_eq!(happened.last(), delivered.last());
            }
            let mut later = happened.iter();
            prop_assert!(delivered.iter().all(|fact| later.any(|happened| happened == fact)));
        }
    }
}
