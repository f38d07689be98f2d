//! Wakes that are put off until a whole batch of messages has been handed over.
//!
//! Whoever takes many messages from a socket at once hands them to mailboxes one by one. The first of them would wake the
//! application's thread, which takes it, finds no second one, and sleeps again: a wake for each message, where one for all does.

use std::{cell::RefCell, marker::PhantomData, task::Waker};

/// Wakers that are kept at most; of more each is woken at once.
const KEPT_MAX: usize = 64;

thread_local! {
    static PUT_OFF: RefCell<PutOff> = const { RefCell::new(PutOff { batches: 0, wakers: Vec::new() }) };
}

struct PutOff {
    /// Batches that this thread is in, one in the other.
    batches: usize,
    wakers: Vec<Waker>,
}

/// As long as this lives, whom this thread is to [wake] waits; then all are woken, also at a panic. It is to live for a moment only,
/// without a wait for anybody in it.
#[derive(Debug)]
#[must_use = "nothing is put off once it is dropped"]
pub struct Batch(PhantomData<*const ()>);

impl Batch {
    /// Puts the wakes of this thread off.
    pub fn begin() -> Self {
        // A thread that ends has none any more, and wakes at once.
        let _ = PUT_OFF.try_with(|put_off| put_off.borrow_mut().batches += 1);
        Self(PhantomData)
    }
}

impl Drop for Batch {
    fn drop(&mut self) {
        let wakers = PUT_OFF.try_with(|put_off| {
            let put_off = &mut *put_off.borrow_mut();
            put_off.batches = put_off.batches.saturating_sub(1);
            // Where nobody is to be woken the memory stays for the next batch.
            let is_due = put_off.batches == 0 && !put_off.wakers.is_empty();
            is_due.then(|| std::mem::take(&mut put_off.wakers))
        });
        let Ok(Some(wakers)) = wakers else { return };
        let mut rest = Rest(wakers);
        rest.wake();
        // Its memory is used again, unless one that was woken has begun anew already.
        let _ = PUT_OFF.try_with(|put_off| {
            let wakers = &mut put_off.borrow_mut().wakers;
            if wakers.capacity() == 0 {
                *wakers = std::mem::take(&mut rest.0);
            }
        });
    }
}

/// Those that are still to be woken, whoever of them panics over it.
struct Rest(Vec<Waker>);

impl Rest {
    fn wake(&mut self) {
        while let Some(waker) = self.0.pop() {
            waker.wake();
        }
    }
}

impl Drop for Rest {
    fn drop(&mut self) {
        self.wake();
    }
}

/// Wakes now, or with the others at the end of this thread's [`Batch`].
pub fn wake(waker: Waker) {
    let mut waker = Some(waker);
    let is_put_off = PUT_OFF.try_with(|put_off| put_off.borrow_mut().takes(&mut waker)).unwrap_or(false);
    if let Some(waker) = waker.filter(|_| !is_put_off) {
        waker.wake();
    }
}

impl PutOff {
    /// Whether whoever `waker` is for will be woken at the end of a batch. It may be left in its place then, to be dropped by the
    /// caller: what that runs is foreign.
    fn takes(&mut self, waker: &mut Option<Waker>) -> bool {
        if self.batches == 0 || self.wakers.len() >= KEPT_MAX {
            return false;
        }
        // Who waits for many messages has a waker with each.
        let is_kept =
            self.wakers.last().zip(waker.as_ref()).is_some_and(|(last, waker)| last.will_wake(waker));
        if !is_kept {
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
        router::Outlet,
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
    fn without_a_batch_it_is_woken_at_once() {
        let (woken, waker) = woken();
        wake(waker);
        assert_eq!(woken.times(), 1);
    }

    #[test]
    fn whoever_is_to_be_woken_in_a_batch_is_woken_once_at_the_end_of_the_outermost() {
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
    fn who_reads_a_mailbox_is_woken_once_for_a_batch_and_finds_all_of_it() {
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
    fn those_that_are_too_many_are_woken_at_once_and_nobody_is_forgotten() {
        let all: Vec<_> = (0..KEPT_MAX + 9).map(|_| woken()).collect();
        let batch = Batch::begin();
        all.iter().for_each(|(_, waker)| wake(waker.clone()));
        assert_eq!(all.iter().filter(|(woken, _)| woken.times() == 1).count(), 9);
        drop(batch);
        assert!(all.iter().all(|(woken, _)| woken.times() == 1));
    }

    #[test]
    fn memory_for_wakers_is_used_again_though_a_batch_in_between_wakes_nobody() {
        let memory = || PUT_OFF.with(|put_off| put_off.borrow().wakers.as_ptr());
        let batch = Batch::begin();
        wake(woken().1);
        let first = memory();
        drop(batch);
        drop(Batch::begin());
        assert_eq!(memory(), first);
    }

    #[test]
    fn a_panic_in_a_batch_leaves_nobody_asleep() {
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
