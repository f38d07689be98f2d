//! Wakes that are delayed until a whole batch of messages has been handed over.
//!
//! A thread that reads many messages from a socket at once hands them to mailboxes one by one. Without a
//! batch the first one would wake the application's thread, which takes it, finds no second one, and sleeps
//! again: one wake per message, where one is enough for all.

use std::{cell::RefCell, marker::PhantomData, task::Waker};

/// Maximum number of delayed wakers; further ones are woken at once.
const DELAYED_MAX: usize = 64;

thread_local! {
    static DELAYED: RefCell<DelayedWakes> = const { RefCell::new(DelayedWakes { batches: 0, wakers: Vec::new() }) };
}

struct DelayedWakes {
    /// The number of nested batches of this thread.
    batches: usize,
    wakers: Vec<Waker>,
}

/// Delays this thread's [`wake`] calls while it lives; then all are woken, also after a panic. It must live
/// only briefly, without a blocking call.
#[derive(Debug)]
#[must_use = "nothing is delayed once it is dropped"]
pub struct Batch(PhantomData<*const ()>);

impl Batch {
    /// Starts to delay the wakes of this thread.
    #[inline]
    pub fn begin() -> Self {
        // A thread at its end may have destroyed this variable; it then wakes at once.
        let _ = DELAYED.try_with(|delayed| delayed.borrow_mut().batches += 1);
        Self(PhantomData)
    }
}

impl Drop for Batch {
    fn drop(&mut self) {
        let first = DELAYED.try_with(|delayed| {
            let delayed = &mut *delayed.borrow_mut();
            delayed.batches = delayed.batches.saturating_sub(1);
            delayed.next_due()
        });
        if let Ok(Some(first)) = first {
            let mut remaining = RemainingWakes { are_woken: false };
            first.wake();
            remaining.wake();
        }
    }
}

/// The remaining wakers, which are woken even if one of them panics. They stay in the thread's list until
/// then. If a woken task starts a batch, its end may wake them.
struct RemainingWakes {
    are_woken: bool,
}

impl RemainingWakes {
    fn wake(&mut self) {
        while !self.are_woken {
            match DELAYED.try_with(|delayed| delayed.borrow_mut().next_due()) {
                Ok(Some(waker)) => waker.wake(),
                Ok(None) | Err(_) => self.are_woken = true,
            }
        }
    }
}

impl Drop for RemainingWakes {
    fn drop(&mut self) {
        self.wake();
    }
}

/// Wakes now, or at the end of this thread's [`Batch`].
pub fn wake(waker: Waker) {
    let mut waker = Some(waker);
    let is_delayed = DELAYED.try_with(|delayed| delayed.borrow_mut().delay(&mut waker)).unwrap_or(false);
    if let Some(waker) = waker.filter(|_| !is_delayed) {
        waker.wake();
    }
}

impl DelayedWakes {
    /// Takes a waker, if no batch is left that delays it.
    fn next_due(&mut self) -> Option<Waker> {
        if self.batches == 0 { self.wakers.pop() } else { None }
    }

    /// Returns whether the task of `waker` will be woken at the end of a batch. The waker may be left in its
    /// place then, to be dropped by the caller, because its drop is foreign code.
    fn delay(&mut self, waker: &mut Option<Waker>) -> bool {
        if self.batches == 0 || self.wakers.len() >= DELAYED_MAX {
            return false;
        }
        // A task that waits for many messages has the same waker for each.
        let is_queued =
            self.wakers.last().zip(waker.as_ref()).is_some_and(|(last, waker)| last.will_wake(waker));
        if !is_queued {
            self.wakers.extend(waker.take());
        }
        true
    }
}

#[cfg(test)]
mod tests {
    use std::{
        panic::catch_unwind,
        sync::{
            Arc,
            atomic::{AtomicUsize, Ordering},
        },
        task::{Context, Wake},
    };

    use bytes::Bytes;

    use super::*;
    use crate::{
        mailbox::Mailbox,
        router::MessageSink,
        tid::Tid,
        wire::{Header, Kind, Message},
    };

    #[derive(Default)]
    struct Woken(AtomicUsize);

    impl Woken {
        fn times(&self) -> usize {
            self.0.load(Ordering::Relaxed)
        }
    }

    impl Wake for Woken {
        fn wake(self: Arc<Self>) {
            self.0.fetch_add(1, Ordering::Relaxed);
        }
    }

    fn woken() -> (Arc<Woken>, Waker) {
        let woken = Arc::<Woken>::default();
        (woken.clone(), woken.into())
    }

    #[test]
    fn wake_without_a_batch_is_immediate() {
        let (woken, waker) = woken();
        wake(waker);
        assert_eq!(woken.times(), 1);
    }

    #[test]
    fn batched_task_is_woken_once_at_the_outermost_end() {
        let ((one, first), (other, second)) = (woken(), woken());
        let outermost = Batch::begin();
        {
            let _inner = Batch::begin();
            wake(first.clone());
            wake(first);
        }
        wake(second);
        assert_eq!((one.times(), other.times()), (0, 0));
        drop(outermost);
        assert_eq!((one.times(), other.times()), (1, 1));
    }

    #[test]
    fn mailbox_reader_is_woken_once_for_a_batch() {
        let (woken, waker) = woken();
        let (mailbox, mut task) = (Mailbox::new(8), Context::from_waker(&waker));
        let mut reader = mailbox.attach();
        assert!(reader.poll_take(&mut task).is_pending());
        let batch = Batch::begin();
        for _ in 0..3 {
            let header = Header::new(Kind::named("test"), Tid::NONE, Tid::NONE);
            mailbox.submit(Message::new(header, Bytes::new())).unwrap();
        }
        assert_eq!(woken.times(), 0);
        drop(batch);
        assert_eq!(woken.times(), 1);
        assert!((0..3).all(|_| reader.poll_take(&mut task).is_ready()));
    }

    #[test]
    fn excess_wakes_are_immediate_and_none_is_lost() {
        let all: Vec<_> = (0..DELAYED_MAX + 9).map(|_| woken()).collect();
        let batch = Batch::begin();
        all.iter().for_each(|(_, waker)| wake(waker.clone()));
        assert_eq!(all.iter().filter(|(woken, _)| woken.times() == 1).count(), 9);
        drop(batch);
        assert!(all.iter().all(|(woken, _)| woken.times() == 1));
    }

    #[test]
    fn waker_memory_is_reused_after_an_empty_batch() {
        let memory = || DELAYED.with(|delayed| delayed.borrow().wakers.as_ptr());
        let batch = Batch::begin();
        wake(woken().1);
        let first = memory();
        drop(batch);
        drop(Batch::begin());
        assert_eq!(memory(), first);
    }

    #[test]
    fn panic_in_a_batch_loses_no_wake() {
        let (woken, waker) = woken();
        let panicked = catch_unwind(|| {
            let _batch = Batch::begin();
            wake(waker.clone());
            panic!("a fault of whoever hands a message over");
        });
        assert!(panicked.is_err());
        assert_eq!(woken.times(), 1);
        wake(waker);
        assert_eq!(woken.times(), 2, "the batch is over");
    }
}
