//! The pending node events of applications with full mailboxes.
//!
//! An event about a node replaces the pending ones about that node and its parts. An event about a part, a layer or
//! an application of a node, replaces the pending one about that part.

use sinew_model::{
    app_notifier::AppNotifier,
    event_backlog::{CoalescingRules, Role},
    facts::NodeEvent,
};
use sinew_runtime::tid::{AppAddress, NodeAddress};

/// Maximum number of pending events of one application per possible member: one for the node, and three for its parts.
const PER_NODE_MAX: usize = 4;
/// Additional pending events, for departed nodes.
const MORE_MAX: usize = 64;

/// Delivers node events to applications.
pub type NodeEvents = AppNotifier<Rules>;

/// Creates a notifier for at most `nodes_max` members.
pub(super) fn new(nodes_max: usize) -> NodeEvents {
    AppNotifier::new(Rules, nodes_max.saturating_mul(PER_NODE_MAX).saturating_add(MORE_MAX))
}

/// The rules of pending node events.
#[derive(Clone, Copy, Debug)]
pub struct Rules;

impl CoalescingRules for Rules {
    type Event = NodeEvent;
    type Subject = NodeAddress;
    type Incarnation = ();

    const KEEPS_UNKNOWN_ENDS: bool = false;

    fn subject(&self, event: &NodeEvent) -> NodeAddress {
        let (NodeEvent::NodeFound { node, .. }
        | NodeEvent::NodeLost { node, .. }
        | NodeEvent::NodeRestarted { node, .. }
        | NodeEvent::AppStalled { node, .. }
        | NodeEvent::AppResumed { node, .. }) = event;
        *node
    }

    fn role(&self, _: &NodeEvent) -> Role<()> {
        Role::Standalone
    }

    fn supersedes(&self, later: &NodeEvent, former: &NodeEvent) -> bool {
        part(later).is_none_or(|later| part(former) == Some(later))
    }

    /// Events about nodes have priority over events about parts.
    fn is_minor(&self, event: &NodeEvent) -> bool {
        part(event).is_some()
    }
}

/// Returns the layer or the application of a node that the event is about, if it is not about the node.
const fn part(event: &NodeEvent) -> Option<AppAddress> {
    match event {
        NodeEvent::NodeFound { .. } | NodeEvent::NodeLost { .. } | NodeEvent::NodeRestarted { .. } => None,
        NodeEvent::AppStalled { app, .. } | NodeEvent::AppResumed { app, .. } => Some(app.app),
    }
}

#[cfg(test)]
mod tests {
    use std::cell::RefCell;

    use sinew_model::facts::{LossReason, Trouble};
    use sinew_runtime::{
        outcome::Rejection,
        tid::{Incarnation, Tid},
    };

    use super::*;

    const APP: AppAddress = AppAddress::new(0x1000);

    fn found(node: u32) -> NodeEvent {
        NodeEvent::NodeFound {
            node: NodeAddress::new(node),
            name: String::new(),
            incarnation: Incarnation(1),
        }
    }

    fn lost(node: u32) -> NodeEvent {
        let (node, why) = (NodeAddress::new(node), LossReason::Hung);
        NodeEvent::NodeLost {
            node,
            name: String::new(),
            incarnation: Incarnation(1),
            why,
            silent_us: 1,
            bound_us: 2,
        }
    }

    fn stalled(node: u32, app: u32) -> NodeEvent {
        let node = NodeAddress::new(node);
        NodeEvent::AppStalled {
            node,
            name: String::new(),
            app: Tid::new(node, AppAddress::new(app)),
            app_name: String::new(),
            trouble: Trouble::Down,
            since_us: 1,
        }
    }

    /// Returns the notifier of an application that has rejected `first`.
    fn behind(first: NodeEvent) -> NodeEvents {
        let events = new(1);
        events.notify(APP, first, |_| Err(Rejection::QueueFull)).unwrap_err();
        events
    }

    /// Adds an event for an application that is behind. Returns whether one was dropped.
    fn notify(events: &NodeEvents, event: NodeEvent) -> bool {
        events.notify(APP, event, |_| unreachable!("it is behind")).unwrap()
    }

    fn takes_all(events: &NodeEvents) -> Vec<NodeEvent> {
        let taken = RefCell::new(Vec::new());
        events.offer(|_, event| {
            taken.borrow_mut().push(event.clone());
            Ok(())
        });
        taken.take()
    }

    #[test]
    fn rejected_events_are_retried_before_later_ones() {
        let events = behind(lost(1));
        notify(&events, found(2));
        events.offer(|_, _| Err(Rejection::QueueFull));
        assert_eq!(takes_all(&events), [lost(1), found(2)]);
        // It has caught up: each change is reported.
        let taken = RefCell::new(Vec::new());
        for event in [lost(2), found(2)] {
            let take = |event: &NodeEvent| {
                taken.borrow_mut().push(event.clone());
                Ok(())
            };
            assert_eq!(events.notify(APP, event, take), Ok(false));
        }
        assert_eq!(taken.take(), [lost(2), found(2)]);
    }

    #[test]
    fn slow_subscriber_receives_the_latest_state_of_each_node() {
        let events = behind(lost(1));
        for event in [stalled(2, 7), found(1), stalled(1, 7), stalled(1, 8), lost(2), stalled(1, 7)] {
            notify(&events, event);
        }
        assert_eq!(takes_all(&events), [found(1), stalled(1, 8), lost(2), stalled(1, 7)]);
    }

    #[test]
    fn newer_event_supersedes_a_rejected_one() {
        let events = behind(lost(1));
        [found(1), lost(2)].into_iter().for_each(|event| assert!(!notify(&events, event)));
        assert_eq!(takes_all(&events), [found(1), lost(2)]);
    }

    #[test]
    fn loss_of_a_node_survives_floods_about_others() {
        let events = behind(lost(3));
        (0..100).for_each(|app| _ = notify(&events, stalled(2, app)));
        notify(&events, lost(1));
        let taken = takes_all(&events);
        assert_eq!(taken.len(), PER_NODE_MAX + MORE_MAX);
        assert_eq!((taken.first(), taken.last()), (Some(&lost(3)), Some(&lost(1))));
    }

    #[test]
    fn backlog_is_bounded_and_reports_dropped_events() {
        let events = behind(lost(1));
        let most = PER_NODE_MAX + MORE_MAX;
        let dropped = (2..100).filter(|node| notify(&events, lost(*node))).count();
        assert_eq!(dropped, 99 - most);
        assert!(!notify(&events, found(99)), "an event that replaces a kept one has room");
        assert_eq!(takes_all(&events).len(), most);
    }
}
