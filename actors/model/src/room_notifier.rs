//! Wakes the layers that keep events or messages for an application with a full mailbox.

use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
    task::{Wake, Waker},
};

use tokio::sync::Notify;

/// Notified when an application has room again. A queue wakes only the last one of several different wakers,
/// so that all layers of a node share this one. Each notification has one waiter.
///
/// While messages of other nodes wait for an application, each message that it reads makes room. The senders
/// of events are notified only if an event was offered since their last notification.
#[derive(Debug, Default)]
pub struct RoomNotifier {
    /// For GNCL: the held messages of other nodes.
    pub messages: Notify,
    /// For GNCL: the events that follow the last messages of a node.
    pub ends: Notify,
    /// For NDL: the node events.
    pub node_events: Notify,
    /// For the sync manager: its events and answers.
    pub sync_events: Notify,
    /// Whether an event was offered since the senders of events were notified.
    has_events: AtomicBool,
    /// The number of notifications of the senders of events.
    wakes: AtomicU64,
}

impl RoomNotifier {
    /// Returns the waker for messages.
    #[must_use]
    pub fn waker(self: &Arc<Self>) -> Waker {
        self.clone().into()
    }

    /// Returns the waker for one offer of an event. It must be requested before the offer.
    #[must_use]
    pub fn event_waker(self: &Arc<Self>) -> Waker {
        // SYNC: pairs with `wake`, which can only follow once a queue has the waker.
        self.has_events.store(true, Ordering::Release);
        self.waker()
    }

    /// Returns how often the senders of events were notified. A sender that records a rejected event without
    /// a lock around both compares it before the offer and after the record: a notification in between was
    /// too early for the record.
    #[must_use]
    pub fn wakes(&self) -> u64 {
        // SYNC: pairs with `wake`: a notification that was handled before the record is counted here.
        self.wakes.load(Ordering::Acquire)
    }
}

impl Wake for RoomNotifier {
    fn wake(self: Arc<Self>) {
        let Self { messages, ends, node_events, sync_events, has_events, wakes } = &*self;
        messages.notify_one();
        // SYNC: pairs with `event_waker`.
        if has_events.swap(false, Ordering::AcqRel) {
            // SYNC: pairs with `wakes`.
            wakes.fetch_add(1, Ordering::Release);
            [ends, node_events, sync_events].into_iter().for_each(Notify::notify_one);
        }
    }
}

#[cfg(test)]
mod tests {
    use futures_util::FutureExt;

    use super::*;

    /// Returns whether the senders of messages and those of events were notified.
    fn notified(notifier: &RoomNotifier) -> (bool, bool) {
        let RoomNotifier { messages, ends, node_events, sync_events, .. } = notifier;
        let is_notified = |notify: &Notify| notify.notified().now_or_never().is_some();
        let events = [ends, node_events, sync_events].map(is_notified);
        assert!(events.iter().all(|event| *event == events[0]), "one queue may hold events of all layers");
        (is_notified(messages), events[0])
    }

    #[test]
    fn room_for_messages_alone_notifies_no_sender_of_events() {
        let notifier = Arc::<RoomNotifier>::default();
        notifier.waker().wake();
        assert_eq!((notified(&notifier), notifier.wakes()), ((true, false), 0));
    }

    #[test]
    fn offered_event_is_notified_of_room_in_any_queue() {
        let notifier = Arc::<RoomNotifier>::default();
        let of_messages = notifier.waker();
        let _full = notifier.event_waker();
        of_messages.wake_by_ref();
        assert_eq!((notified(&notifier), notifier.wakes()), ((true, true), 1));
        of_messages.wake();
        assert_eq!((notified(&notifier), notifier.wakes()), ((true, false), 1), "it was not offered again");
    }
}
