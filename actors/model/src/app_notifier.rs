//! The events of a layer for the applications of its node, which wait while a mailbox is full.

use std::{collections::BTreeMap, sync::Mutex};

use sinew_runtime::{lock, outcome::Rejection, tid::AppAddress};

use crate::event_backlog::{CoalescingRules, EventBacklog};

/// Notifies the applications of a node. An application with room gets each event at once. The events for one with a
/// full mailbox wait in a bounded backlog, in order, where a later event replaces those that it makes obsolete. They
/// are delivered as soon as the mailbox has room.
#[derive(Debug)]
pub struct AppNotifier<R: CoalescingRules> {
    rules: R,
    /// Maximum number of pending events of one application.
    capacity: usize,
    /// The applications with pending events.
    backlogs: Mutex<BTreeMap<AppAddress, EventBacklog<R>>>,
}

impl<R: CoalescingRules + Clone> AppNotifier<R> {
    /// Creates a notifier without pending events, for at most `capacity` of each application.
    pub fn new(rules: R, capacity: usize) -> Self {
        Self { rules, capacity, backlogs: Mutex::default() }
    }

    /// Sends an event, or keeps it behind the pending ones of the same application. `send` must register the
    /// [waker](crate::room_notifier::RoomNotifier) of a full mailbox, as
    /// [`offer_event`](crate::context::NodeContext::offer_event) does. Returns whether an event was dropped, because
    /// the application has too many.
    ///
    /// # Errors
    /// The rejection by the application. After `QueueFull` the event is kept.
    pub fn notify(
        &self,
        app: AppAddress,
        event: R::Event,
        send: impl FnOnce(&R::Event) -> Result<(), Rejection>,
    ) -> Result<bool, Rejection> {
        // Locked during the send, so that no later event of another thread overtakes this one.
        let mut backlogs = lock(&self.backlogs);
        if let Some(backlog) = backlogs.get_mut(&app) {
            return Ok(backlog.push(event));
        }
        let result = send(&event);
        if result == Err(Rejection::QueueFull) {
            let mut backlog = EventBacklog::new(self.rules.clone(), self.capacity);
            backlog.push(event);
            backlogs.insert(app, backlog);
        }
        result.map(|()| false)
    }

    /// Offers the pending events of each application in order, until its mailbox is full. Any other rejection means
    /// that the application has ended.
    pub fn offer(&self, send: impl Fn(AppAddress, &R::Event) -> Result<(), Rejection>) {
        lock(&self.backlogs)
            .retain(|app, backlog| !backlog.offer(|event| send(*app, event) != Err(Rejection::QueueFull)));
    }

    /// Drops the pending events of an application: the incarnation that they were for has ended.
    pub fn forget(&self, app: AppAddress) {
        lock(&self.backlogs).remove(&app);
    }
}

#[cfg(test)]
mod tests {
    use std::cell::{Cell, RefCell};

    use proptest::prelude::*;

    use super::*;
    use crate::event_backlog::Role;

    const APP: AppAddress = AppAddress::new(0x1000);
    const OTHER: AppAddress = AppAddress::new(0x1001);

    /// The rules of events that are states of subjects: the last one of each is kept.
    #[derive(Clone, Debug)]
    struct LastOfEach;

    impl CoalescingRules for LastOfEach {
        type Event = (u8, usize);
        type Subject = u8;
        type Incarnation = ();

        const KEEPS_UNKNOWN_ENDS: bool = false;

        fn subject(&self, event: &(u8, usize)) -> u8 {
            event.0
        }

        fn role(&self, _: &(u8, usize)) -> Role<()> {
            Role::Standalone
        }

        fn supersedes(&self, _: &(u8, usize), _: &(u8, usize)) -> bool {
            true
        }
    }

    /// A mailbox with room for some events.
    #[derive(Default)]
    struct Mailbox {
        room: Cell<usize>,
        taken: RefCell<Vec<(u8, usize)>>,
    }

    impl Mailbox {
        fn take(&self, event: (u8, usize)) -> Result<(), Rejection> {
            let room = self.room.get().checked_sub(1).ok_or(Rejection::QueueFull)?;
            self.room.set(room);
            self.taken.borrow_mut().push(event);
            Ok(())
        }
    }

    #[test]
    fn application_with_room_gets_each_event_at_once() {
        let (notifier, mailbox) = (AppNotifier::new(LastOfEach, 4), Mailbox::default());
        mailbox.room.set(3);
        for at in 0..3 {
            assert_eq!(notifier.notify(APP, (7, at), |event| mailbox.take(*event)), Ok(false));
        }
        assert_eq!(mailbox.taken.take(), [(7, 0), (7, 1), (7, 2)]);
    }

    #[test]
    fn full_application_delays_no_other_one() {
        let (notifier, mailbox) = (AppNotifier::new(LastOfEach, 4), Mailbox::default());
        let full = notifier.notify(APP, (1, 0), |_| Err(Rejection::QueueFull));
        assert_eq!(full, Err(Rejection::QueueFull), "its caller counts it");
        mailbox.room.set(1);
        assert_eq!(notifier.notify(OTHER, (1, 1), |event| mailbox.take(*event)), Ok(false));
        assert_eq!(mailbox.taken.take(), [(1, 1)]);
    }

    #[test]
    fn forgotten_or_ended_application_gets_nothing() {
        let notifier = AppNotifier::new(LastOfEach, 4);
        for app in [APP, OTHER] {
            notifier.notify(app, (1, 0), |_| Err(Rejection::QueueFull)).unwrap_err();
        }
        notifier.forget(APP);
        let offered = RefCell::new(Vec::new());
        let ended = |app, _: &_| {
            offered.borrow_mut().push(app);
            Err(Rejection::NoSuchApplication)
        };
        notifier.offer(ended);
        notifier.offer(ended);
        assert_eq!(offered.take(), [OTHER]);
    }

    #[test]
    fn pending_events_are_bounded() {
        let notifier = AppNotifier::new(LastOfEach, 2);
        notifier.notify(APP, (0, 0), |_| Err(Rejection::QueueFull)).unwrap_err();
        assert_eq!(notifier.notify(APP, (1, 1), |_| Ok(())), Ok(false), "it is behind another one");
        assert_eq!(notifier.notify(APP, (2, 2), |_| Ok(())), Ok(true));
    }

    proptest! {
        /// Each step is an event about one of four subjects, after which the application takes so many.
        #[test]
        fn application_ends_with_the_last_state_of_each_subject(
            steps in prop::collection::vec((0_u8..4, 0_usize..3), 0..64)
        ) {
            let (notifier, mailbox) = (AppNotifier::new(LastOfEach, 4), Mailbox::default());
            for (at, (subject, room)) in steps.iter().enumerate() {
                let _ = notifier.notify(APP, (*subject, at), |event| mailbox.take(*event));
                mailbox.room.set(*room);
                notifier.offer(|_, event| mailbox.take(*event));
            }
            mailbox.room.set(4);
            notifier.offer(|_, event| mailbox.take(*event));
            let taken = mailbox.taken.take();
            prop_assert!(taken.is_sorted_by_key(|event| event.1));
            for subject in 0..4 {
                let last = steps.iter().rposition(|step| step.0 == subject).map(|at| (subject, at));
                prop_assert_eq!(taken.iter().rfind(|event| event.0 == subject).copied(), last);
            }
        }
    }
}
