//! Who waits for room in a queue.

use std::task::Waker;

use crate::wire::Class;

/// One who keeps messages for a full queue, and wants to be woken when it has room for one of them.
#[derive(Debug)]
pub(super) struct Awaited {
    /// Of each class the length of the shortest message that waits, if any does, in bytes of its payload.
    shortest: [Option<usize>; 3],
    waker: Waker,
}

impl Awaited {
    /// `waker` waits for room for a message of this class and length, beside what the `former` one waited for.
    pub(super) fn with(former: Option<Self>, class: Class, length: usize, waker: &Waker) -> Self {
        let mut awaited = match former {
            Some(mut former) => {
                former.waker.clone_from(waker);
                former
            }
            None => Self { shortest: [None; 3], waker: waker.clone() },
        };
        let shortest = &mut awaited.shortest[class as usize];
        *shortest = Some(shortest.map_or(length, |shorter| shorter.min(length)));
        awaited
    }

    /// Whether `has_room` says so of a class and the length of the shortest message of it.
    pub(super) fn any(&self, has_room: impl Fn(usize, usize) -> bool) -> bool {
        let mut awaited = self.shortest.iter().enumerate();
        awaited.any(|(class, shortest)| shortest.is_some_and(|length| has_room(class, length)))
    }

    pub(super) fn into_waker(self) -> Waker {
        self.waker
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
        mailbox::{Bounds, Mailbox, MailboxReader},
        outcome::Rejection,
        router::Outlet,
        tid::Tid,
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
    fn who_keeps_a_message_for_a_full_mailbox_is_woken_once_when_half_of_it_is_free() {
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
    fn who_keeps_a_long_message_is_woken_when_that_one_has_room_and_not_before() {
        let woken = Arc::<Woken>::default();
        let waker = Waker::from(woken.clone());
        let of = |length: usize| Message::new(message().header, vec![0; length].into());
        let mailbox = Mailbox::new(Bounds { messages: 8, bytes: 100 });
        let mut reader = mailbox.attach();
        (0..2).for_each(|_| mailbox.submit(of(10)).unwrap());
        // It has room only where nothing else waits; half of the places are free, and are no use to it.
        mailbox.offer(of(1_000), Some(&waker)).unwrap_err();
        assert_eq!(woken.0.load(Ordering::Relaxed), 0);
        assert!(takes(&mut reader));
        assert_eq!(woken.0.load(Ordering::Relaxed), 0);
        assert!(takes(&mut reader));
        assert_eq!(woken.0.load(Ordering::Relaxed), 1);
    }

    #[test]
    fn who_keeps_a_message_is_woken_when_the_mailbox_wants_none_any_more() {
        for stop in [Mailbox::close, Mailbox::refuse_while_away] {
            let woken = Arc::<Woken>::default();
            let waker = Waker::from(woken.clone());
            let mailbox = Mailbox::new(1);
            mailbox.submit(message()).unwrap();
            mailbox.offer(message(), Some(&waker)).unwrap_err();
            stop(&mailbox);
            assert_eq!(woken.0.load(Ordering::Relaxed), 1);
        }
    }
}
