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

#[derive(Debug)]
struct Shared<E> {
    queue: VecDeque<E>,
    capacity: usize,
    epoch: u64,
    waker: Option<Waker>,
    refused: u64,
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
        let shared = Shared { queue: VecDeque::new(), capacity, epoch: 0, waker: None, refused: 0 };
        Self { shared: Arc::new(Mutex::new(shared)) }
    }

    /// Posts an event.
    ///
    /// # Errors
    /// The event itself, if the post is full. It is counted.
    pub fn post(&self, event: E) -> Result<(), E> {
        let waker = {
            let mut shared = lock(&self.shared);
            if shared.queue.len() >= shared.capacity {
                shared.refused += 1;
                return Err(event);
            }
            shared.queue.push_back(event);
            shared.waker.take()
        };
        // Woken outside the lock, so that the woken thread does not run into it.
        if let Some(waker) = waker {
            waker.wake();
        }
        Ok(())
    }

    /// How many events were refused because the post was full.
    #[must_use]
    pub fn refused(&self) -> u64 {
        lock(&self.shared).refused
    }

    /// Takes over the reading end: a stream that ends when a later reader attaches.
    #[must_use]
    pub fn attach(&self) -> PostStream<E> {
        let mut shared = lock(&self.shared);
        shared.epoch += 1;
        let stream = PostStream { shared: self.shared.clone(), epoch: shared.epoch };
        let former = shared.waker.take();
        drop(shared);
        if let Some(waker) = former {
            waker.wake();
        }
        stream
    }
}

/// The reading end of a [`Post`].
#[derive(Debug)]
pub struct PostStream<E> {
    shared: Arc<Mutex<Shared<E>>>,
    epoch: u64,
}

impl<E> Stream for PostStream<E> {
    type Item = E;

    fn poll_next(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<E>> {
        let mut shared = lock(&self.shared);
        if shared.epoch != self.epoch {
            return Poll::Ready(None);
        }
        let next = shared.queue.pop_front();
        if next.is_none() {
            shared.waker = Some(cx.waker().clone());
            return Poll::Pending;
        }
        drop(shared);
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
}
