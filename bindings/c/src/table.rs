//! Handles of endpoints: numbers that are looked up here, never followed.
//!
//! A handle looks like a pointer to C, but is a place in a table and a serial number. So one that was unregistered, or was
//! never registered, is refused; nothing is read through it. On 64 bits a serial number does not come again; on 32 bits it
//! does after 16 million registrations.
//!
//! A place goes round: free, claimed, held by a handle, free. Each step is one store or exchange of its `holder`, and one
//! thread makes it: the exchange that claims has one winner, only that winner fills or gives back, and of those that take a handle
//! one finds the value. The value itself is under the lock, which orders what its users do. So what the atomics have to order
//! is little: that who sees a handle sees the fork count beside it, and that who sees the place free finds it empty.

use std::{
    mem,
    sync::{
        Mutex, MutexGuard, PoisonError, TryLockError,
        atomic::{AtomicU32, AtomicUsize, Ordering},
    },
};

use crate::{
    fork,
    session::Session,
    status::{Fault, Status},
};

/// Endpoints of one process at most: as many as a node has places with the default configuration. The node's own bound for one
/// process is 64 by default (`lncl.clients_per_process_max`).
pub(crate) const ENDPOINTS_MAX: usize = 256;
/// Nobody has the place.
const FREE: usize = 0;
/// Somebody is about to have it. No handle has this number.
const CLAIMED: usize = usize::MAX;

/// All endpoints of this process.
pub(crate) static ENDPOINTS: Table<Session> = Table::new();

/// A place, and who has it.
struct Place<T> {
    /// The handle of who has it, or one of the two above.
    holder: AtomicUsize,
    /// How many forks this process had behind it then.
    born: AtomicU32,
    /// Locked while a thread is in a call; never waited for. Poisoned by a panic in a call.
    value: Mutex<Option<T>>,
}

/// Places for as many values as a process may have endpoints.
pub(crate) struct Table<T> {
    places: [Place<T>; ENDPOINTS_MAX],
    serials: AtomicUsize,
}

/// A place that is kept until there is something to put into it; given back when dropped.
pub(crate) struct Claim<'table, T> {
    table: &'table Table<T>,
    place: usize,
}

impl<T> Table<T> {
    const fn new() -> Self {
        let places = [const {
            Place { holder: AtomicUsize::new(FREE), born: AtomicU32::new(0), value: Mutex::new(None) }
        }; ENDPOINTS_MAX];
        Self { places, serials: AtomicUsize::new(1) }
    }

    /// Keeps a place.
    pub(crate) fn claim(&self) -> Result<Claim<'_, T>, Fault> {
        let is_claimed = |place: &Place<T>| {
            // SYNC: Acquire, with the Release of `take` and of a claim that was dropped: who had the place before has emptied it
            // and cleared its poison. Relaxed where it fails: nothing is read of a place that is not had.
            let result = place.holder.compare_exchange(FREE, CLAIMED, Ordering::Acquire, Ordering::Relaxed);
            result.is_ok()
        };
        let place = self.places.iter().position(is_claimed).ok_or_else(|| {
            let sentence = format!("this process has {ENDPOINTS_MAX} endpoints already; unregister one");
            Fault::new(Status::SinewErrorTooMany, sentence)
        })?;
        Ok(Claim { table: self, place })
    }

    /// Does something with the value of a handle, if no other thread is doing so.
    pub(crate) fn with<R>(
        &self,
        handle: usize,
        body: impl FnOnce(&mut T) -> Result<R, Fault>,
    ) -> Result<R, Fault> {
        let mut value = self.lock(handle)?;
        body(value.as_mut().ok_or_else(|| Fault::plain(Status::SinewErrorNoSuchEndpoint))?)
    }

    /// Takes the value of a handle out, one that panicked too. From now on the handle is refused.
    pub(crate) fn take(&self, handle: usize) -> Result<T, Fault> {
        let place = self.place(handle)?;
        let mut value = match place.value.try_lock() {
            Ok(value) => value,
            Err(TryLockError::Poisoned(poisoned)) => poisoned.into_inner(),
            Err(TryLockError::WouldBlock) => return Err(Fault::plain(Status::SinewErrorBusy)),
        };
        // SYNC: as in `lock`.
        if place.holder.load(Ordering::Relaxed) != handle {
            return Err(Fault::plain(Status::SinewErrorNoSuchEndpoint));
        }
        let taken = value.take().ok_or_else(|| Fault::plain(Status::SinewErrorNoSuchEndpoint))?;
        drop(value);
        // Who has the lock between finds this handle, and nothing behind it.
        place.value.clear_poison();
        // SYNC: Release, for the exchange in `claim`, which then has a place that is empty and not poisoned.
        place.holder.store(FREE, Ordering::Release);
        Ok(taken)
    }

    fn lock(&self, handle: usize) -> Result<MutexGuard<'_, Option<T>>, Fault> {
        let place = self.place(handle)?;
        let value = place.value.try_lock().map_err(|error| {
            Fault::plain(match error {
                TryLockError::WouldBlock => Status::SinewErrorBusy,
                TryLockError::Poisoned(_) => Status::SinewErrorPanic,
            })
        })?;
        // It may have been taken out, and the place given to another, since it was looked at.
        // SYNC: Relaxed, since the lock orders it: who put another value in had claimed the place before it had the lock, and that
        // was before this one. Where nobody has, a value that was taken out is not there.
        if place.holder.load(Ordering::Relaxed) != handle {
            return Err(Fault::plain(Status::SinewErrorNoSuchEndpoint));
        }
        Ok(value)
    }

    fn place(&self, handle: usize) -> Result<&Place<T>, Fault> {
        let place = &self.places[handle % ENDPOINTS_MAX];
        // SYNC: Acquire, with the Release in `fill`, behind which `born` is this handle's.
        if handle == FREE || handle == CLAIMED || place.holder.load(Ordering::Acquire) != handle {
            return Err(Fault::plain(Status::SinewErrorNoSuchEndpoint));
        }
        // Should the place be another's by now, so may the number be: then the look under the lock refuses it, or this does.
        if place.born.load(Ordering::Relaxed) != fork::generation() {
            return Err(Fault::plain(Status::SinewErrorForked));
        }
        Ok(place)
    }
}

impl<T> Claim<'_, T> {
    /// Puts a value into the place; returns its handle.
    pub(crate) fn fill(self, value: T) -> usize {
        let place = &self.table.places[self.place];
        *place.value.lock().unwrap_or_else(PoisonError::into_inner) = Some(value);
        place.born.store(fork::generation(), Ordering::Relaxed);
        let handle = self.table.next_serial() * ENDPOINTS_MAX + self.place;
        // SYNC: Release, for the Acquire in `place`: who finds the handle finds `born`. The value is found by the lock.
        place.holder.store(handle, Ordering::Release);
        // From here on the place is the handle's. A program that had guessed that one may have freed the place already, and
        // another thread have claimed it: nothing is given back here.
        mem::forget(self);
        handle
    }
}

impl<T> Table<T> {
    /// Of a handle's bits the lowest eight are the place; the rest is this, never zero and never all ones.
    fn next_serial(&self) -> usize {
        const SERIALS: usize = usize::MAX / ENDPOINTS_MAX - 1;
        // SYNC: Relaxed, since nothing goes with the number: that no two are the same is all.
        self.serials.fetch_add(1, Ordering::Relaxed) % SERIALS + 1
    }
}

impl<T> Drop for Claim<'_, T> {
    fn drop(&mut self) {
        // SYNC: Release, for the next exchange in `claim`: hands on what this claim's own has acquired. A store will do, since
        // nobody but who has claimed a place changes it.
        self.table.places[self.place].holder.store(FREE, Ordering::Release);
    }
}

#[cfg(test)]
mod tests {
    use std::{
        panic::{AssertUnwindSafe, catch_unwind},
        thread,
    };

    use super::*;

    fn status(result: Result<impl Sized, Fault>) -> Status {
        result.map_or_else(|fault| fault.status, |_| Status::SinewOk)
    }

    #[test]
    fn a_handle_that_was_given_back_is_refused_for_ever() {
        let table = Table::new();
        let first = table.claim().unwrap().fill('a');
        assert_eq!(table.take(first), Ok('a'));
        let second = table.claim().unwrap().fill('b');
        assert_eq!(first % ENDPOINTS_MAX, second % ENDPOINTS_MAX, "they have the same place");
        for wrong in [first, FREE, CLAIMED, 1, second + ENDPOINTS_MAX, second + 1] {
            assert_eq!(status(table.with(wrong, |_| Ok(()))), Status::SinewErrorNoSuchEndpoint);
            assert_eq!(status(table.take(wrong)), Status::SinewErrorNoSuchEndpoint);
        }
        assert_eq!(table.with(second, |value| Ok(*value)), Ok('b'));
    }

    #[test]
    fn a_second_call_at_the_same_time_is_refused() {
        let table = Table::new();
        let handle = table.claim().unwrap().fill('a');
        let inner = table.with(handle, |_| Ok((table.with(handle, |_| Ok(())), table.take(handle))));
        let (with, take) = inner.unwrap();
        assert_eq!((status(with), status(take)), (Status::SinewErrorBusy, Status::SinewErrorBusy));
        assert_eq!(status(table.with(handle, |_| Ok(()))), Status::SinewOk);
    }

    #[test]
    fn after_a_panic_an_endpoint_can_only_be_taken_out_and_its_place_is_whole_again() {
        let table = Table::new();
        let handle = table.claim().unwrap().fill('a');
        let panics = || table.with(handle, |_| -> Result<(), Fault> { panic!("this is asked for") });
        assert!(catch_unwind(AssertUnwindSafe(panics)).is_err());
        assert_eq!(status(table.with(handle, |_| Ok(()))), Status::SinewErrorPanic);
        assert_eq!(table.take(handle), Ok('a'));
        let next = table.claim().unwrap().fill('b');
        assert_eq!(table.with(next, |value| Ok(*value)), Ok('b'));
    }

    #[test]
    fn there_are_as_many_places_as_a_process_may_have_endpoints() {
        let table = Table::new();
        let handles: Vec<_> = (0..ENDPOINTS_MAX).map(|n| table.claim().unwrap().fill(n)).collect();
        assert_eq!(status(table.claim()), Status::SinewErrorTooMany);
        table.take(handles[7]).unwrap();
        drop(table.claim().unwrap());
        table.claim().unwrap().fill(7);
        assert_eq!(status(table.claim()), Status::SinewErrorTooMany);
    }

    const THREADS: usize = 4;
    /// Endpoints that each thread has, one after the other.
    const LIVES: usize = 100_000;

    /// What is behind a handle in the test below, and what every thread may find out about it.
    #[derive(Clone, Copy, Debug, Default, PartialEq)]
    struct Life {
        owner: usize,
        number: usize,
    }

    /// The last handle of each thread, good or not, and whose it is.
    type Known = [Mutex<(usize, Life)>; THREADS];

    /// Calls until the place's lock is free. A thread that tries an old handle of the place has it for a moment.
    fn unless_busy<R>(mut call: impl FnMut() -> Result<R, Fault>) -> Option<R> {
        loop {
            match call() {
                Ok(done) => return Some(done),
                Err(fault) if fault.status == Status::SinewErrorNoSuchEndpoint => return None,
                Err(fault) => assert_eq!(fault.status, Status::SinewErrorBusy),
            }
        }
    }

    /// Has one endpoint after the other, uses them, and uses and ends those of others, who do the same. How many it has ended.
    fn live_and_trespass(table: &Table<Life>, owner: usize, known: &Known) -> usize {
        let mut ended = 0;
        for number in 0..LIVES {
            let own = Life { owner, number };
            let handle = table.claim().unwrap().fill(own);
            *known[owner].lock().unwrap() = (handle, own);
            let others = known.iter().map(|last| *last.lock().unwrap());
            let tried: [(usize, Life); THREADS] = others.collect::<Vec<_>>().try_into().unwrap();
            for (handle, life) in tried {
                // Whatever has become of the place since: this endpoint is there, or none.
                let found = unless_busy(|| table.with(handle, |found| Ok(*found)));
                assert!(found.is_none_or(|found| found == life), "{found:?} instead of {life:?}");
            }
            for (handle, life) in [tried[(owner + number) % THREADS], (handle, own)] {
                let taken = unless_busy(|| table.take(handle));
                assert!(taken.is_none_or(|taken| taken == life), "{taken:?} instead of {life:?}");
                ended += usize::from(taken.is_some());
            }
        }
        ended
    }

    #[test]
    fn threads_that_use_end_and_reuse_places_at_once_find_their_own_endpoint_or_none() {
        let (table, known) = (Table::new(), Known::default());
        let ended = thread::scope(|scope| {
            let threads = [0, 1, 2, 3].map(|owner| {
                let (table, known) = (&table, &known);
                scope.spawn(move || live_and_trespass(table, owner, known))
            });
            threads.map(|thread| thread.join().unwrap()).iter().sum::<usize>()
        });
        assert_eq!(ended, THREADS * LIVES, "each was ended once");
        let again: Vec<_> =
            (0..ENDPOINTS_MAX).map(|_| table.claim().unwrap().fill(Life::default())).collect();
        assert_eq!(again.len(), ENDPOINTS_MAX, "all places are free");
    }
}
