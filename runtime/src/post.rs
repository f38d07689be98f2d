//! A post: a bounded queue of events into an actor, which outlives the actor.
//!
//! The queue and its waker stand under one mutex. actix's own mailbox and `AtomicWaker` spin when a sender is preempted
//! between two stores, and a real-time actor fed from its own CPU then stalls for a second; a mutex of the kernel's
//! does not (`docs/decisions/0002-mailbox.md`).

use std::{
    collections::VecDeque,
    pin::Pin,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    task::{Context, Poll, Waker},
};

use futures_util::Stream;

use crate::supervision::vitals::Vitals;

/// Locks a mutex whose data are valid at every instant that a panic can strike.
///
/// All of this crate's lock sections leave their data whole before they call anything that may panic.
pub(crate) fn lock<T: ?Sized>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A bounded queue of events, from any thread into the one actor that is attached to it.
#[derive(Debug)]
pub struct Post<E> {
    shared: Arc<Mutex<Shared<E>>>,
}

/// An event with its number, if there is one.
type Counted<E> = Option<(u64, E)>;

#[derive(Debug)]
struct Shared<E> {
    /// Each with its number.
    queue: VecDeque<(u64, E)>,
    /// How many it has taken.
    taken: u64,
    capacity: usize,
    /// Nobody will read it any more.
    is_closed: bool,
    epoch: u64,
    waker: Option<Waker>,
    refused: u64,
    /// A copy of the event that the reader handles now, where it wants that.
    in_hand: Counted<E>,
    /// The first event in the queue was in the hand of a reader that failed.
    first_is_second_try: bool,
    /// The same of the event in hand.
    in_hand_is_second_try: bool,
}

impl<E> Clone for Post<E> {
    fn clone(&self) -> Self {
        Self { shared: self.shared.clone() }
    }
}

impl<E> Post<E> {
    /// An empty post that holds at most `capacity` events.
    #[must_use]
    pub fn new(capacity: usize) -> Self {
        let shared = Shared {
            queue: VecDeque::new(),
            taken: 0,
            capacity,
            is_closed: false,
            epoch: 0,
            waker: None,
            refused: 0,
            in_hand: None,
            first_is_second_try: false,
            in_hand_is_second_try: false,
        };
        Self { shared: Arc::new(Mutex::new(shared)) }
    }

    /// Posts an event.
    ///
    /// # Errors
    /// The event itself, if the post is full (it is counted), if it is closed, or if the actor that posts it was replaced.
    pub fn post(&self, event: E) -> Result<(), E> {
        self.post_below(usize::MAX, event)
    }

    /// Posts an event if fewer than `most` wait: what its sender hears the refusal of leaves room for what must not be lost.
    ///
    /// # Errors
    /// As of [`Self::post`].
    pub fn post_below(&self, most: usize, event: E) -> Result<(), E> {
        if Vitals::is_present_over() {
            // A layer that was replaced has nothing more to say.
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
        // Woken outside the lock, so that the woken thread does not run into it.
        if let Some(waker) = waker {
            waker.wake();
        }
        Ok(())
    }

    /// Takes no events any more, because nobody will read them. Returns those that nobody has read.
    #[must_use]
    pub fn close(&self) -> VecDeque<E> {
        let mut shared = lock(&self.shared);
        shared.is_closed = true;
        std::mem::take(&mut shared.queue).into_iter().map(|(_, event)| event).collect()
    }

    /// Whether it was [closed](Self::close).
    #[must_use]
    pub fn is_closed(&self) -> bool {
        lock(&self.shared).is_closed
    }

    /// How many events wait.
    #[must_use]
    pub fn len(&self) -> usize {
        lock(&self.shared).queue.len()
    }

    /// Whether none waits.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// How many events were refused because the post was full.
    #[must_use]
    pub fn refused(&self) -> u64 {
        lock(&self.shared).refused
    }

    /// Takes over the reading end: a stream that ends when a later reader attaches. An event that is in the hand of a
    /// reader when it fails is lost.
    #[must_use]
    pub fn attach(&self) -> PostStream<E> {
        self.attach_as(None)
    }

    /// The same for events that must not be lost: of the one in the reader's hand the post keeps what `keep` makes of it.
    /// When the reader fails, the next one gets that first, and so gets it twice if it failed late. An event on which a
    /// second reader fails too is dropped, and logged: it must not take all its successors along.
    #[must_use]
    pub fn attach_keeping(&self, keep: fn(&E) -> E) -> PostStream<E> {
        self.attach_as(Some(keep))
    }

    fn attach_as(&self, keep: Option<fn(&E) -> E>) -> PostStream<E> {
        let (epoch, former, dropped) = {
            let mut shared = lock(&self.shared);
            shared.epoch += 1;
            (shared.epoch, shared.waker.take(), shared.give_back())
        };
        if let Some(waker) = former {
            waker.wake();
        }
        if dropped.is_some() {
            crate::log::error!("an event on which two readers failed is dropped");
        }
        PostStream { shared: self.shared.clone(), epoch, keep, reader: Vitals::present() }
    }
}

impl<E> Shared<E> {
    /// Puts the event in the hand of a reader that failed back to the front, beyond the capacity by this one; or returns
    /// it, if that was done before.
    fn give_back(&mut self) -> Option<E> {
        let event = self.in_hand.take()?;
        if self.in_hand_is_second_try {
            return Some(event.1);
        }
        self.queue.push_front(event);
        self.first_is_second_try = true;
        None
    }

    /// The next event, and what was kept of the one before it, which is handled.
    fn take(&mut self, keep: Option<fn(&E) -> E>) -> (Counted<E>, Counted<E>) {
        let handled = self.in_hand.take();
        let next = self.queue.pop_front();
        if let (Some(keep), Some((number, event))) = (keep, &next) {
            self.in_hand = Some((*number, keep(event)));
            self.in_hand_is_second_try = std::mem::take(&mut self.first_is_second_try);
        }
        (next, handled)
    }
}

/// The reading end of a [`Post`].
#[derive(Debug)]
pub struct PostStream<E> {
    shared: Arc<Mutex<Shared<E>>>,
    epoch: u64,
    keep: Option<fn(&E) -> E>,
    /// The incarnation that reads it.
    reader: Option<Arc<Vitals>>,
}

/// The same reading end, which says of each event which of the post's it is, counted from 1: one that is read twice has the same number
/// both times, so that its second reader can tell what of it the first one has done.
#[derive(Debug)]
pub struct Numbered<E>(PostStream<E>);

impl<E> PostStream<E> {
    /// Reads each event with its number.
    #[must_use]
    pub const fn numbered(self) -> Numbered<E> {
        Numbered(self)
    }
}

impl<E> Stream for PostStream<E> {
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

impl<E> PostStream<E> {
    fn poll_numbered(&self, cx: &Context<'_>) -> Poll<Option<(u64, E)>> {
        if let Some(reader) = &self.reader
            && reader.is_over()
        {
            // Hung, and replaced meanwhile: what waits here is for its successor.
            reader.leave();
        }
        let mut shared = lock(&self.shared);
        if shared.epoch != self.epoch {
            return Poll::Ready(None);
        }
        let (next, handled) = shared.take(self.keep);
        if next.is_none() {
            shared.waker = Some(cx.waker().clone());
        }
        // Dropped outside the lock, like everything that is not the post's own.
        drop(shared);
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
    use futures_util::{FutureExt, StreamExt};

    use super::*;

    #[test]
    fn a_full_post_hands_the_event_back_and_counts_it() {
        let post = Post::new(1);
        assert_eq!(post.post('a'), Ok(()));
        assert_eq!(post.post('b'), Err('b'));
        assert_eq!(post.refused(), 1);
    }

    #[test]
    fn events_outlive_the_reader_and_reach_the_next_one() {
        let post = Post::new(4);
        let mut first = post.attach();
        post.post(1).unwrap();
        post.post(2).unwrap();
        assert_eq!(first.next().now_or_never(), Some(Some(1)));
        let mut second = post.attach();
        assert_eq!(first.next().now_or_never(), Some(None), "the former reader is fenced off");
        assert_eq!(second.next().now_or_never(), Some(Some(2)));
    }

    #[test]
    fn an_event_in_the_hand_of_one_that_failed_reaches_the_next_one_first_and_no_third() {
        let post = Post::new(4);
        let read = |stream: &mut PostStream<i32>| stream.next().now_or_never().flatten();
        [1, 2, 3].into_iter().for_each(|event| post.post(event).unwrap());
        let mut first = post.attach_keeping(Clone::clone);
        assert_eq!([read(&mut first), read(&mut first)], [Some(1), Some(2)]);
        let mut second = post.attach_keeping(Clone::clone);
        assert_eq!(read(&mut second), Some(2), "the first one failed with it in its hand");
        let mut third = post.attach_keeping(Clone::clone);
        assert_eq!(read(&mut third), Some(3), "two have failed on it");
        assert_eq!(read(&mut third), None);
        let mut fourth = post.attach_keeping(Clone::clone);
        assert_eq!(read(&mut fourth), None, "the last event was handled: the third one came for more");
    }

    #[test]
    fn an_event_that_is_read_twice_has_one_number() {
        let post = Post::new(4);
        let read = || post.attach_keeping(Clone::clone).numbered().next().now_or_never().flatten();
        ['a', 'b'].into_iter().for_each(|event| post.post(event).unwrap());
        assert_eq!([read(), read(), read()], [Some((1, 'a')), Some((1, 'a')), Some((2, 'b'))]);
    }

    #[test]
    fn an_event_may_be_tried_twice_after_another_was_tried_twice() {
        let post = Post::new(4);
        let read = || post.attach_keeping(Clone::clone).next().now_or_never().flatten();
        [1, 2].into_iter().for_each(|event| post.post(event).unwrap());
        assert_eq!([read(), read(), read(), read(), read()], [Some(1), Some(1), Some(2), Some(2), None]);
    }
}
