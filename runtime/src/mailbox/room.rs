//! The registration of waiters for room in a queue, and the wakers of senders that waited.

use std::task::Waker;

use crate::{WakerList, wire::Class};

/// The callers that keep messages for a full queue, to be woken together when it has room for one of them.
#[derive(Debug, Default)]
pub(super) struct Awaited {
    /// For each class, the payload length in bytes of the shortest message that waits, if any does.
    shortest: [Option<usize>; 3],
    wakers: WakerList,
}

impl Awaited {
    /// Adds a caller that keeps a message of this class and length. Returns a caller to be woken in its place, if
    /// there are too many.
    pub(super) fn add(&mut self, class: Class, length: usize, waker: &Waker) -> Option<Waker> {
        let shortest = &mut self.shortest[class as usize];
        *shortest = Some(shortest.map_or(length, |shorter| shorter.min(length)));
        self.wakers.add(waker)
    }

    /// Returns whether `has_room` is true for a class and the length of its shortest message.
    pub(super) fn any(&self, has_room: impl Fn(usize, usize) -> bool) -> bool {
        let mut awaited = self.shortest.iter().enumerate();
        awaited.any(|(class, shortest)| shortest.is_some_and(|length| has_room(class, length)))
    }

    pub(super) fn into_wakers(mut self) -> Vec<Waker> {
        self.wakers.take()
    }
}

/// The wakers of the senders that a removal has made room for: usually none.
#[derive(Default)]
pub(super) struct RoomWakers {
    pub(super) of_messages: Vec<Waker>,
    pub(super) of_events: Option<Waker>,
}

impl RoomWakers {
    /// Wakes them. The caller holds no lock.
    #[inline]
    pub(super) fn wake(self) {
        if !self.of_messages.is_empty() || self.of_events.is_some() {
            self.wake_all();
        }
    }

    fn wake_all(self) {
        self.of_messages.into_iter().chain(self.of_events).for_each(Waker::wake);
    }
}

#[cfg(test)]
mod tests {
    use std::{
        sync::{
            Arc,
            atomic::{AtomicUsize, Ordering},
        },
        task::{Context, Wake},
    };

    use bytes::Bytes;
    use futures_util::task::noop_waker;

    use crate::{
        mailbox::{Bounds, Mailbox, MailboxReader, RemoteReader},
        outcome::Rejection,
        router::MessageSink,
        tid::{AppAddress, Tid},
        wire::{Header, Kind, Message},
    };

    use super::*;

    /// Counts how often its waker was woken.
    #[derive(Default)]
    struct Woken(AtomicUsize);

    impl Wake for Woken {
        fn wake(self: Arc<Self>) {
            self.0.fetch_add(1, Ordering::Relaxed);
        }
    }

    fn message() -> Message {
        Message::new(Header::new(Kind::named("test"), Tid::NONE, Tid::NONE), Bytes::new())
    }

    fn takes(reader: &mut MailboxReader) -> bool {
        reader.poll_take(&mut Context::from_waker(&noop_waker())).is_ready()
    }

    #[test]
    fn waiting_sender_is_woken_once_at_half_free_mailbox() {
        let woken = Arc::<Woken>::default();
        let waker = Waker::from(woken.clone());
        let mailbox = Mailbox::new(4);
        let mut reader = mailbox.attach();
        (0..4).for_each(|_| mailbox.submit(message()).unwrap());
        assert_eq!(mailbox.offer(message(), Some(&waker)).unwrap_err().why, Rejection::QueueFull);
        let after_each: Vec<_> = (0..4)
            .map(|_| {
                assert!(takes(&mut reader));
                woken.0.load(Ordering::Relaxed)
            })
            .collect();
        assert_eq!(after_each, [0, 1, 1, 1]);
        let tally = mailbox.tally(Class::Control);
        assert_eq!((tally.taken, tally.refused), (4, 0), "what is offered again is not refused");
    }

    #[test]
    fn all_waiting_senders_are_woken_once_together() {
        let woken: Vec<_> = (0..3).map(|_| Arc::<Woken>::default()).collect();
        let mailbox = Mailbox::new(4);
        let mut reader = mailbox.attach();
        (0..4).for_each(|_| mailbox.submit(message()).unwrap());
        for (round, woken) in woken.iter().chain(&woken).enumerate() {
            // The second round is of the same tasks.
            let refused = mailbox.offer(message(), Some(&Waker::from(woken.clone()))).unwrap_err();
            assert_eq!(refused.why, Rejection::QueueFull, "round {round}");
        }
        let times = || woken.iter().map(|woken| woken.0.load(Ordering::Relaxed)).collect::<Vec<_>>();
        assert!(takes(&mut reader));
        assert_eq!(times(), [0; 3]);
        assert!(takes(&mut reader));
        assert_eq!(times(), [1; 3]);
        assert!(takes(&mut reader) && takes(&mut reader));
        assert_eq!(times(), [1; 3]);
    }

    #[test]
    fn sender_of_a_long_message_waits_until_it_fits() {
        let woken = Arc::<Woken>::default();
        let waker = Waker::from(woken.clone());
        let of = |length: usize| Message::new(message().header, vec![0; length].into());
        let mailbox = Mailbox::new(Bounds { messages: 8, bytes: 100 });
        let mut reader = mailbox.attach();
        (0..2).for_each(|_| mailbox.submit(of(10)).unwrap());
        // It fits only into an empty mailbox; half of the slots are free, and do not help it.
        mailbox.offer(of(1_000), Some(&waker)).unwrap_err();
        assert_eq!(woken.0.load(Ordering::Relaxed), 0);
        assert!(takes(&mut reader));
        assert_eq!(woken.0.load(Ordering::Relaxed), 0);
        assert!(takes(&mut reader));
        assert_eq!(woken.0.load(Ordering::Relaxed), 1);
    }

    #[test]
    fn waiting_sender_is_woken_when_the_mailbox_closes() {
        for stop in [Mailbox::close, Mailbox::refuse_while_down] {
            let woken = Arc::<Woken>::default();
            let waker = Waker::from(woken.clone());
            let mailbox = Mailbox::new(1);
            mailbox.submit(message()).unwrap();
            mailbox.offer(message(), Some(&waker)).unwrap_err();
            stop(&mailbox);
            assert_eq!(woken.0.load(Ordering::Relaxed), 1);
        }
    }

    fn event() -> Message {
        let mut event = message();
        event.header.source.app = AppAddress::SYNC;
        event
    }

    #[test]
    fn event_sender_is_woken_at_the_next_removal() {
        let woken = Arc::<Woken>::default();
        let waker = Waker::from(woken.clone());
        let mailbox = Mailbox::new(2);
        let mut reader = mailbox.attach();
        (0..2).for_each(|_| mailbox.submit(event()).unwrap());
        for before in 0..2 {
            assert_eq!(mailbox.offer(event(), Some(&waker)).unwrap_err().why, Rejection::QueueFull);
            assert_eq!(woken.0.load(Ordering::Relaxed), before);
            let event_alone = reader.poll_event(&mut Context::from_waker(&noop_waker()));
            assert!(event_alone.is_ready());
            assert_eq!(woken.0.load(Ordering::Relaxed), before + 1);
            mailbox.offer(event(), Some(&waker)).unwrap();
        }
        assert!(takes(&mut reader));
        assert_eq!(woken.0.load(Ordering::Relaxed), 2, "none waits");
        let tally = mailbox.tally(Class::Control);
        assert_eq!((tally.taken, tally.refused), (4, 0), "what is offered again is not refused");
    }

    #[test]
    fn event_sender_is_woken_when_events_are_dropped() {
        for stop in [Mailbox::close, Mailbox::refuse_while_down, Mailbox::forget_events] {
            let woken = Arc::<Woken>::default();
            let waker = Waker::from(woken.clone());
            let mailbox = Mailbox::new(1);
            mailbox.submit(event()).unwrap();
            mailbox.offer(event(), Some(&waker)).unwrap_err();
            stop(&mailbox);
            assert_eq!(woken.0.load(Ordering::Relaxed), 1);
        }
    }

    #[test]
    fn event_sender_is_woken_by_each_remote_take() {
        for take in [RemoteReader::take, RemoteReader::take_event, RemoteReader::take_event_without_node] {
            let woken = Arc::<Woken>::default();
            let waker = Waker::from(woken.clone());
            let mailbox = Mailbox::new(1);
            let reader = mailbox.attach_remote();
            mailbox.submit(event()).unwrap();
            mailbox.offer(event(), Some(&waker)).unwrap_err();
            assert!(take(&reader).is_some());
            assert_eq!(woken.0.load(Ordering::Relaxed), 1);
        }
    }
}
