//! The subscribers to node events, and the events for them.

use std::collections::{BTreeSet, VecDeque};

use sinew_model::facts::{AppFact, NodeEvent};
use sinew_runtime::tid::AppAddress;

/// The applications that subscribed to changes.
#[derive(Debug, Default)]
pub(super) struct Subscribers {
    apps: BTreeSet<AppAddress>,
    /// The events of the inputs since the last [`Subscribers::poll`], in order.
    events: VecDeque<(AppAddress, NodeEvent)>,
}

impl Subscribers {
    /// Handles a change of an application. A ready one receives the events of the `present` members first, then
    /// all changes. // spec: NDL-8
    pub(super) fn handle(&mut self, fact: &AppFact, present: impl Iterator<Item = NodeEvent>) {
        match *fact {
            AppFact::Ready { app } => {
                self.remove(app);
                self.apps.insert(app);
                self.events.extend(present.map(|event| (app, event)));
            }
            AppFact::Down { app } | AppFact::Stopped { app } | AppFact::Unregistered { app } => {
                self.remove(app);
            }
            AppFact::Registered { .. }
            | AppFact::Handles { .. }
            | AppFact::Types { .. }
            | AppFact::GroupsChanged => {}
        }
    }

    /// Removes a subscriber and its events.
    fn remove(&mut self, app: AppAddress) {
        if self.apps.remove(&app) {
            self.events.retain(|(to, _)| *to != app);
        }
    }

    /// Adds an event for all subscribers.
    pub(super) fn publish(&mut self, event: &NodeEvent) {
        self.events.extend(self.apps.iter().map(|app| (*app, event.clone())));
    }

    /// Returns the next event and its receiver.
    pub(super) fn poll(&mut self) -> Option<(AppAddress, NodeEvent)> {
        self.events.pop_front()
    }
}

#[cfg(test)]
mod tests {
    use std::iter;

    use sinew_runtime::tid::{Incarnation, NodeAddress};

    use super::*;

    const APP: AppAddress = AppAddress::new(0x1000);

    fn found(node: u32) -> NodeEvent {
        let node = NodeAddress::new(node);
        NodeEvent::NodeFound { node, name: String::new(), incarnation: Incarnation(1) }
    }

    #[test]
    fn subscriber_receives_every_change_in_order() {
        let mut subscribers = Subscribers::default();
        subscribers.handle(&AppFact::Ready { app: APP }, iter::once(found(7)));
        let events = [found(1), found(2), found(1)];
        events.iter().for_each(|event| subscribers.publish(event));
        let received: Vec<_> = iter::from_fn(|| subscribers.poll()).map(|(_, event)| event).collect();
        assert_eq!(received, [&[found(7)][..], &events[..]].concat());
    }

    #[test]
    fn removed_subscriber_receives_nothing() {
        let mut subscribers = Subscribers::default();
        subscribers.handle(&AppFact::Ready { app: APP }, iter::empty());
        subscribers.publish(&found(1));
        subscribers.handle(&AppFact::Down { app: APP }, iter::once(found(3)));
        subscribers.publish(&found(2));
        assert_eq!(subscribers.poll(), None);
    }
}
