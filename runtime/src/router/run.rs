//! Several messages from another node to one application, which are handed over together.

use std::collections::VecDeque;

use super::{Router, SubmitError};
use crate::{tid::AppAddress, wire::Message};

impl Router {
    /// Offers messages from another node to the application of this node at `app`, the destination of each, in their
    /// order. Each is treated as in [`offer`](Self::offer) without a waker. The table is read once for all of them, and no
    /// route is kept: a later call finds a route that was changed or removed since.
    ///
    /// # Errors
    /// The first message that is rejected, and the reason; the messages behind it stay in `run`. Without an error
    /// none stays.
    pub fn offer_run(&self, app: AppAddress, run: &mut VecDeque<Message>) -> Result<(), SubmitError> {
        let table = &self.snapshot.load().table;
        if let Some(route) = table.local.get(&app)
            && table.tap.is_none()
            && table.guard.is_none()
            && table.mismatches.is_none()
        {
            return route.sink.offer_run(run);
        }
        // Each message is judged and observed by itself.
        while let Some(message) = run.pop_front() {
            self.offer(message, None)?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use std::{
        sync::{Arc, Mutex},
        task::{Context, Poll},
    };

    use bytes::Bytes;
    use futures_util::task::noop_waker;

    use super::*;
    use crate::{
        lock,
        mailbox::Mailbox,
        outcome::Rejection,
        pending::{AppSink, Pending},
        router::{
            LocalRoute,
            guard::Guard,
            tap::{Passage, Tap, TapOf},
        },
        tid::{NodeAddress, Tid},
        wire::{Class, Flags, Header, Kind},
    };

    const NODE: NodeAddress = NodeAddress::new(0x7f00_0001);
    const PEER: NodeAddress = NodeAddress::new(0x7f00_0002);
    const APP: AppAddress = AppAddress::new(0x1001);

    fn message(sequence: u64) -> Message {
        let from = Tid::new(PEER, AppAddress::new(0x1002));
        let mut header = Header::new(Kind::named("test"), from, Tid::new(NODE, APP));
        (header.class, header.sequence) = (Class::Bulk, sequence);
        Message::new(header, Bytes::new())
    }

    fn run(sequences: std::ops::Range<u64>) -> VecDeque<Message> {
        sequences.map(message).collect()
    }

    /// Registers an application with a mailbox for this number of messages.
    fn register(router: &Router, capacity: usize) -> Arc<Mailbox> {
        let mailbox = Mailbox::new(capacity);
        let sink = Arc::new(AppSink { pending: Pending::new(1), inbox: mailbox.clone() });
        router.set_local(APP, LocalRoute { sink, events: Arc::new([]) });
        mailbox
    }

    fn sequences(mailbox: &Arc<Mailbox>) -> Vec<u64> {
        let (mut reader, waker) = (mailbox.attach(), noop_waker());
        let mut taken = Vec::new();
        while let Poll::Ready(Some(message)) = reader.poll_take(&mut Context::from_waker(&waker)) {
            taken.push(message.header.sequence);
        }
        taken
    }

    #[test]
    fn run_stops_at_the_first_message_without_room() {
        let router = Router::new(NODE);
        let mailbox = register(&router, 3);
        let mut run = run(0..5);
        let refused = router.offer_run(APP, &mut run).unwrap_err();
        assert_eq!((refused.message.header.sequence, refused.why), (3, Rejection::QueueFull));
        assert_eq!(run.iter().map(|left| left.header.sequence).collect::<Vec<_>>(), [4]);
        let tally = mailbox.tally(Class::Bulk);
        assert_eq!((tally.taken, tally.refused), (3, 0), "what is offered again is not refused");
        assert_eq!(sequences(&mailbox), [0, 1, 2]);
        assert_eq!(router.refused(), 0, "the caller reports it");
    }

    #[test]
    fn each_run_goes_to_the_present_application() {
        let router = Router::new(NODE);
        let former = register(&router, 8);
        router.offer_run(APP, &mut run(0..2)).unwrap();
        // A closed mailbox is still registered.
        former.close();
        let refused = router.offer_run(APP, &mut run(2..3)).unwrap_err();
        assert_eq!(refused.why, Rejection::Closed);
        // The application has ended.
        router.remove_local(APP);
        let refused = router.offer_run(APP, &mut run(3..4)).unwrap_err();
        assert_eq!((refused.message.header.sequence, refused.why), (3, Rejection::NoSuchApplication));
        // Another one has its address.
        let present = register(&router, 8);
        router.offer_run(APP, &mut run(4..6)).unwrap();
        assert_eq!(sequences(&present), [4, 5]);
        assert_eq!(former.tally(Class::Bulk).taken, 2);
    }

    #[test]
    fn answers_and_events_in_a_run_keep_their_own_paths() {
        let router = Router::new(NODE);
        let mailbox = register(&router, 8);
        let (mut reply, mut event) = (message(1), message(3));
        reply.header.flags = Flags::REPLY;
        event.header.source = Tid::new(NODE, AppAddress::SYNC);
        router.offer_run(APP, &mut [message(0), reply, message(2)].into()).unwrap();
        router.offer_run(APP, &mut [event, message(4)].into()).unwrap();
        assert_eq!(sequences(&mailbox), [3, 0, 2, 4], "an event is first, and a late reply is dropped");
    }

    /// Allows messages with an even sequence, and notes those that pass.
    #[derive(Default)]
    struct Watcher(Mutex<Vec<(u64, Option<Rejection>)>>);

    impl Guard for Watcher {
        fn allows(&self, header: &Header, _: AppAddress) -> bool {
            header.sequence.is_multiple_of(2)
        }

        fn asks(&self, _: &Header) {}
    }

    impl Tap for Watcher {
        fn watches(&self, app: Tid) -> bool {
            app.app == APP
        }

        fn saw(&self, _: Tid, passage: &Passage<'_>) {
            lock(&self.0).push((passage.header.sequence, passage.refused));
        }

        fn missed(&self, _: Tid, _: u64) {}
    }

    #[test]
    fn each_message_of_a_run_is_judged_and_observed() {
        let router = Router::new(NODE);
        let (mailbox, watcher) = (register(&router, 8), Arc::new(Watcher::default()));
        router.set_guard(watcher.clone());
        router.set_tap(TapOf::Watches, Some(watcher.clone()));
        let (mut run, mut refused) = (run(0..4), Vec::new());
        while let Err(rejected) = router.offer_run(APP, &mut run) {
            refused.push((rejected.message.header.sequence, rejected.why));
        }
        assert_eq!(refused, [1, 3].map(|sequence| (sequence, Rejection::NotAllowed)));
        assert_eq!(sequences(&mailbox), [0, 2]);
        let not_allowed = Some(Rejection::NotAllowed);
        assert_eq!(*lock(&watcher.0), [(0, None), (1, not_allowed), (2, None), (3, not_allowed)]);
    }
}
