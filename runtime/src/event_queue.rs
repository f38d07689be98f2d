//! A bounded queue of events into an actor, which outlives the actor.
//!
//! The queue and its waker are under one mutex. actix's own mailbox and `AtomicWaker` spin when a sender is
//! preempted between two stores; a real-time actor fed from its own CPU then stalls for a second. A kernel
//! mutex does not (`docs/decisions/0002-mailbox.md`).

use std::{
    collections::VecDeque,
    pin::Pin,
    sync::{Arc, Mutex},
    task::{Context, Poll, Waker},
};

use futures_util::Stream;

use crate::{lock, supervision::liveness::Liveness};

/// Maximum number of senders that wait for room in one queue: more than a node has layers. One more wakes the first.
const WAITING_SENDERS_MAX: usize = 8;

/// A bounded queue of events, from any thread into the one actor that is attached to it.
#[derive(Debug)]
pub struct EventQueue<E> {
    shared: Arc<Mutex<Shared<E>>>,
}

/// An event with its number, if there is one.
type Counted<E> = Option<(u64, E)>;

#[derive(Debug)]
struct Shared<E> {
    /// The events, each with its number.
    queue: VecDeque<(u64, E)>,
    /// The number of events taken so far.
    taken: u64,
    capacity: usize,
    /// Whether the queue has no reader any more.
    is_closed: bool,
    epoch: u64,
    waker: Option<Waker>,
    /// The senders that wait for room.
    senders: Vec<Waker>,
    refused: u64,
    /// A copy of the event that the reader handles now, if it requested that.
    in_progress: Counted<E>,
    /// Whether the first event in the queue was being handled by a reader that failed.
    first_is_retry: bool,
    /// The same for the event that is being handled.
    in_progress_is_retry: bool,
}

impl<E> Clone for EventQueue<E> {
    fn clone(&self) -> Self {
        Self { shared: self.shared.clone() }
    }
}

impl<E> EventQueue<E> {
    /// Creates an empty queue of at most `capacity` events.
    #[must_use]
    pub fn new(capacity: usize) -> Self {
        let shared = Shared {
            queue: VecDeque::new(),
            taken: 0,
            capacity,
            is_closed: false,
            epoch: 0,
            waker: None,
            senders: Vec::new(),
            refused: 0,
            in_progress: None,
            first_is_retry: false,
            in_progress_is_retry: false,
        };
        Self { shared: Arc::new(Mutex::new(shared)) }
    }

    /// Queues an event.
    ///
    /// # Errors
    /// The event itself, if the queue is full (it is counted) or closed, or if the sending actor was replaced.
    pub fn post(&self, event: E) -> Result<(), E> {
        self.post_below(usize::MAX, event)
    }

    /// Queues an event if fewer than `most` are queued. For senders that handle a rejection: they leave room
    /// for events that must not be lost.
    ///
    /// # Errors
    /// Those of [`Self::post`].
    pub fn post_below(&self, most: usize, event: E) -> Result<(), E> {
        if Liveness::is_current_fenced() {
            // A replaced layer must not send.
            return Err(event);
        }
        let waker = {
            let mut shared = lock(&self.shared);
            if shared.is_closed {
                return Err(event);
            }
            if shared.queue.len() >= shared.capacity.min(most) {
                shared.refused += 1;
                return Err(event);
            }
            shared.taken += 1;
            let number = shared.taken;
            shared.queue.push_back((number, event));
            shared.waker.take()
        };
        // Woken without the lock, so that the woken thread does not wait for it.
        if let Some(waker) = waker {
            waker.wake();
        }
        Ok(())
    }

    /// Waits until a quarter of the queue is free, for senders that keep a rejected event. A queue with a long backlog
    /// so wakes its senders once for many events. Pending forever if the sending actor was replaced.
    pub fn poll_room(&self, cx: &Context<'_>) -> Poll<()> {
        if Liveness::is_current_fenced() {
            return Poll::Pending;
        }
        let former = {
            let mut shared = lock(&self.shared);
            if shared.has_room() {
                return Poll::Ready(());
            }
            shared.wait_for_room(cx.waker())
        };
        former.into_iter().for_each(Waker::wake);
        Poll::Pending
    }

    /// Closes the queue, as it has no reader any more. Returns the events that were not read.
    #[must_use]
    pub fn close(&self) -> VecDeque<E> {
        let mut shared = lock(&self.shared);
        shared.is_closed = true;
        std::mem::take(&mut shared.queue).into_iter().map(|(_, event)| event).collect()
    }

    /// Returns whether the queue was [closed](Self::close).
    #[must_use]
    pub fn is_closed(&self) -> bool {
        lock(&self.shared).is_closed
    }

    /// Returns the number of queued events.
    #[must_use]
    pub fn len(&self) -> usize {
        lock(&self.shared).queue.len()
    }

    /// Returns whether the queue is empty.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Returns the number of events that were rejected because the queue was full.
    #[must_use]
    pub fn refused(&self) -> u64 {
        lock(&self.shared).refused
    }

    /// Attaches a reader: a stream that ends when a later reader attaches. An event that a reader handles
    /// when it fails is lost.
    #[must_use]
    pub fn attach(&self) -> EventStream<E> {
        self.attach_as(None)
    }

    /// Same as [`attach`](Self::attach), for events that must not be lost: the queue keeps the result of
    /// `keep` for the event that is being handled. When the reader fails, the next one gets that first, and
    /// so twice if the failure was late. An event on which a second reader fails too is dropped, and logged:
    /// otherwise all later readers would fail on it.
    #[must_use]
    pub fn attach_keeping(&self, keep: fn(&E) -> E) -> EventStream<E> {
        self.attach_as(Some(keep))
    }

    fn attach_as(&self, keep: Option<fn(&E) -> E>) -> EventStream<E> {
        let (epoch, former, dropped) = {
            let mut shared = lock(&self.shared);
            shared.epoch += 1;
            (shared.epoch, shared.waker.take(), shared.requeue())
        };
        if let Some(waker) = former {
            waker.wake();
        }
        if dropped.is_some() {
            crate::log::error!("an event on which two readers failed is dropped");
        }
        EventStream { shared: self.shared.clone(), epoch, keep, reader: Liveness::current() }
    }
}

impl<E> Shared<E> {
    /// Puts the event of a failed reader back to the front, beyond the capacity by one. Returns it if that
    /// was done before.
    fn requeue(&mut self) -> Option<E> {
        let event = self.in_progress.take()?;
        if self.in_progress_is_retry {
            return Some(event.1);
        }
        self.queue.push_front(event);
        self.first_is_retry = true;
        None
    }

    fn has_room(&self) -> bool {
        !self.is_closed && self.queue.len() <= self.capacity / 4 * 3
    }

    /// Registers a sender that waits for room. Returns the first one if there are too many.
    fn wait_for_room(&mut self, sender: &Waker) -> Option<Waker> {
        self.senders.retain(|other| !other.will_wake(sender));
        self.senders.push(sender.clone());
        (self.senders.len() > WAITING_SENDERS_MAX).then(|| self.senders.remove(0))
    }

    /// Returns the senders that wait for room, once there is some.
    fn room_made(&mut self) -> Vec<Waker> {
        if self.has_room() { std::mem::take(&mut self.senders) } else { Vec::new() }
    }

    /// Takes the next event. Also returns the copy of the previous event, which is handled now.
    fn take(&mut self, keep: Option<fn(&E) -> E>) -> (Counted<E>, Counted<E>) {
        let handled = self.in_progress.take();
        let next = self.queue.pop_front();
        if let (Some(keep), Some((number, event))) = (keep, &next) {
            self.in_progress = Some((*number, keep(event)));
            self.in_progress_is_retry = std::mem::take(&mut self.first_is_retry);
        }
        (next, handled)
    }
}

/// The reading end of an [`EventQueue`].
#[derive(Debug)]
pub struct EventStream<E> {
    shared: Arc<Mutex<Shared<E>>>,
    epoch: u64,
    keep: Option<fn(&E) -> E>,
    /// The incarnation that reads it.
    reader: Option<Arc<Liveness>>,
}

/// The same reading end, with the number of each event, counted from 1. An event that is read twice has the
/// same number both times, so that its second reader can detect the completed part.
#[derive(Debug)]
pub struct Numbered<E>(EventStream<E>);

impl<E> EventStream<E> {
    /// Returns a reader of events with their numbers.
    #[must_use]
    pub const fn numbered(self) -> Numbered<E> {
        Numbered(self)
    }
}

impl<E> Stream for EventStream<E> {
    type Item = E;

    fn poll_next(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<E>> {
        self.poll_numbered(cx).map(|next| next.map(|(_, event)| event))
    }
}

impl<E> Stream for Numbered<E> {
    type Item = (u64, E);

    fn poll_next(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<(u64, E)>> {
        self.0.poll_numbered(cx)
    }
}

impl<E> EventStream<E> {
    fn poll_numbered(&self, cx: &Context<'_>) -> Poll<Option<(u64, E)>> {
        if let Some(reader) = &self.reader
            && reader.is_fenced()
        {
            // The reader hung and was replaced: the queued events are for its successor.
            reader.unwind_turn();
        }
        let mut shared = lock(&self.shared);
        if shared.epoch != self.epoch {
            return Poll::Ready(None);
        }
        let (next, handled) = shared.take(self.keep);
        if next.is_none() {
            shared.waker = Some(cx.waker().clone());
        }
        let senders = shared.room_made();
        // Dropped and woken without the lock, like everything that does not belong to the queue.
        drop(shared);
        senders.into_iter().for_each(Waker::wake);
        drop(handled);
        if next.is_none() {
            return Poll::Pending;
        }
        #[cfg(feature = "fault-points")]
        crate::supervision::fault::strike();
        Poll::Ready(next)
    }
}

#[cfg(test)]
mod tests {
    use std::{
        sync::atomic::{AtomicUsize, Ordering},
        task::Wake,
    };

    use futures_util::{FutureExt, StreamExt};

    use super::*;

    /// Counts how often its waker was woken.
    #[derive(Default)]
    struct Woken(AtomicUsize);

    impl Wake for Woken {
        fn wake(self: Arc<Self>) {
            self.0.fetch_add(1, Ordering::Relaxed);
        }
    }

    impl Woken {
        fn waits(self: &Arc<Self>, queue: &EventQueue<i32>) -> bool {
            queue.poll_room(&Context::from_waker(&self.clone().into())).is_pending()
        }

        fn count(&self) -> usize {
            self.0.load(Ordering::Relaxed)
        }
    }

    #[test]
    fn full_queue_returns_the_event_and_counts_it() {
        let queue = EventQueue::new(1);
        assert_eq!(queue.post('a'), Ok(()));
        assert_eq!(queue.post('b'), Err('b'));
        assert_eq!(queue.refused(), 1);
    }

    #[test]
    fn events_outlive_the_reader() {
        let queue = EventQueue::new(4);
        let mut first = queue.attach();
        queue.post(1).unwrap();
        queue.post(2).unwrap();
        assert_eq!(first.next().now_or_never(), Some(Some(1)));
        let mut second = queue.attach();
        assert_eq!(first.next().now_or_never(), Some(None), "the former reader is fenced off");
        assert_eq!(second.next().now_or_never(), Some(Some(2)));
    }

    #[test]
    fn event_of_a_failed_reader_is_retried_once() {
        let queue = EventQueue::new(4);
        let read = |stream: &mut EventStream<i32>| stream.next().now_or_never().flatten();
        [1, 2, 3].into_iter().for_each(|event| queue.post(event).unwrap());
        let mut first = queue.attach_keeping(Clone::clone);
        assert_eq!([read(&mut first), read(&mut first)], [Some(1), Some(2)]);
        let mut second = queue.attach_keeping(Clone::clone);
        assert_eq!(read(&mut second), Some(2), "the first reader failed while it handled it");
        let mut third = queue.attach_keeping(Clone::clone);
        assert_eq!(read(&mut third), Some(3), "two have failed on it");
        assert_eq!(read(&mut third), None);
        let mut fourth = queue.attach_keeping(Clone::clone);
        assert_eq!(read(&mut fourth), None, "the last event was handled: the third one came for more");
    }

    #[test]
    fn event_that_is_read_twice_has_one_number() {
        let queue = EventQueue::new(4);
        let read = || queue.attach_keeping(Clone::clone).numbered().next().now_or_never().flatten();
        ['a', 'b'].into_iter().for_each(|event| queue.post(event).unwrap());
        assert_eq!([read(), read(), read()], [Some((1, 'a')), Some((1, 'a')), Some((2, 'b'))]);
    }

    #[test]
    fn event_may_be_retried_after_another_was() {
        let queue = EventQueue::new(4);
        let read = || queue.attach_keeping(Clone::clone).next().now_or_never().flatten();
        [1, 2].into_iter().for_each(|event| queue.post(event).unwrap());
        assert_eq!([read(), read(), read(), read(), read()], [Some(1), Some(1), Some(2), Some(2), None]);
    }

    #[test]
    fn waiting_senders_wake_once_a_quarter_is_free() {
        let (queue, one, other) = (EventQueue::new(8), Arc::<Woken>::default(), Arc::<Woken>::default());
        let mut reader = queue.attach();
        while queue.post(0).is_ok() {}
        // A sender that waits twice is woken once.
        assert!(one.waits(&queue) && one.waits(&queue) && other.waits(&queue));
        let mut after_each = Vec::new();
        while reader.next().now_or_never().is_some() {
            after_each.push((one.count(), other.count()));
        }
        assert_eq!(after_each, [(0, 0), (1, 1), (1, 1), (1, 1), (1, 1), (1, 1), (1, 1), (1, 1)]);
        assert!(!one.waits(&queue), "there is room");
    }

    #[test]
    fn number_of_waiting_senders_is_bounded() {
        let queue = EventQueue::new(1);
        queue.post(0).unwrap();
        let senders: Vec<_> = (0..=WAITING_SENDERS_MAX).map(|_| Arc::<Woken>::default()).collect();
        assert!(senders.iter().all(|sender| sender.waits(&queue)));
        let woken: Vec<_> = senders.iter().map(|sender| sender.count()).collect();
        assert_eq!((woken[0], woken[1..].iter().sum::<usize>()), (1, 0), "it offers its event again");
    }
}
