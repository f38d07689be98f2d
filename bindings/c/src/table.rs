//! Handles of endpoints: numbers that are looked up here, never dereferenced.
//!
//! A handle looks like a pointer to C, but is a slot in a table and a serial number. So a handle that was
//! unregistered, or never registered, is rejected; nothing is read through it. On 64 bits a serial number is
//! never reused; on 32 bits it is after 16 million registrations.
//!
//! The states of a slot are free, claimed, held by a handle, and free again. Each transition is one store or
//! exchange of its `holder`, made by one thread: the exchange that claims has one winner, only that winner
//! fills or frees the slot, and of several threads that take a handle one finds the value. The value itself
//! is under the lock, which orders its users. So the atomics have to order little: a thread that sees a
//! handle sees the fork count beside it, and a thread that sees the slot free finds it empty.

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
    status::{CallError, Status},
};

/// Maximum number of endpoints of one process: as many as a node accepts in all with the default
/// configuration. The node's own limit for one process is 64 by default (`lncl.clients_per_process_max`).
pub(crate) const ENDPOINTS_MAX: usize = 256;
/// The slot is free.
const FREE: usize = 0;
/// A thread is about to fill the slot. No handle has this number.
const CLAIMED: usize = usize::MAX;

/// All endpoints of this process.
pub(crate) static ENDPOINTS: Table<Session> = Table::new();

/// A slot, and its holder.
struct Slot<T> {
    /// The handle that holds the slot, or one of the two above.
    holder: AtomicUsize,
    /// Number of forks when the slot was filled.
    forks: AtomicU32,
    /// Locked while a thread is in a call; no thread waits for it. Poisoned by a panic in a call.
    value: Mutex<Option<T>>,
}

/// Slots for as many values as a process may have endpoints.
pub(crate) struct Table<T> {
    slots: [Slot<T>; ENDPOINTS_MAX],
    serials: AtomicUsize,
}

/// A reserved slot that is not filled yet; freed when dropped.
pub(crate) struct Claim<'table, T> {
    table: &'table Table<T>,
    slot: usize,
}

impl<T> Table<T> {
    const fn new() -> Self {
        let slots = [const {
            Slot { holder: AtomicUsize::new(FREE), forks: AtomicU32::new(0), value: Mutex::new(None) }
        }; ENDPOINTS_MAX];
        Self { slots, serials: AtomicUsize::new(1) }
    }

    /// Reserves a slot.
    pub(crate) fn claim(&self) -> Result<Claim<'_, T>, CallError> {
        let is_claimed = |slot: &Slot<T>| {
            // SYNC: Acquire, with the Release of `take` and of a claim that was dropped: the previous holder
            // has emptied the slot and cleared its poison. Relaxed on failure: nothing is read of a slot that
            // was not claimed.
            let result = slot.holder.compare_exchange(FREE, CLAIMED, Ordering::Acquire, Ordering::Relaxed);
            result.is_ok()
        };
        let slot = self.slots.iter().position(is_claimed).ok_or_else(|| {
            let sentence = format!("this process has {ENDPOINTS_MAX} endpoints already; unregister one");
            CallError::new(Status::SinewErrorTooMany, sentence)
        })?;
        Ok(Claim { table: self, slot })
    }

    /// Calls `body` with the value of a handle, if no other thread is in such a call.
    pub(crate) fn with<R>(
        &self,
        handle: usize,
        body: impl FnOnce(&mut T) -> Result<R, CallError>,
    ) -> Result<R, CallError> {
        let mut value = self.lock(handle)?;
        body(value.as_mut().ok_or_else(|| CallError::plain(Status::SinewErrorNoSuchEndpoint))?)
    }

    /// Removes the value of a handle, even one that panicked. From now on the handle is rejected.
    pub(crate) fn take(&self, handle: usize) -> Result<T, CallError> {
        let slot = self.slot(handle)?;
        let mut value = match slot.value.try_lock() {
            Ok(value) => value,
            Err(TryLockError::Poisoned(poisoned)) => poisoned.into_inner(),
            Err(TryLockError::WouldBlock) => return Err(CallError::plain(Status::SinewErrorBusy)),
        };
        // SYNC: as in `lock`.
        if slot.holder.load(Ordering::Relaxed) != handle {
            return Err(CallError::plain(Status::SinewErrorNoSuchEndpoint));
        }
        let taken = value.take().ok_or_else(|| CallError::plain(Status::SinewErrorNoSuchEndpoint))?;
        drop(value);
        // A thread that takes the lock in between finds this handle, but no value.
        slot.value.clear_poison();
        // SYNC: Release, for the exchange in `claim`, which then has a slot that is empty and not poisoned.
        slot.holder.store(FREE, Ordering::Release);
        Ok(taken)
    }

    fn lock(&self, handle: usize) -> Result<MutexGuard<'_, Option<T>>, CallError> {
        let slot = self.slot(handle)?;
        let value = slot.value.try_lock().map_err(|error| {
            CallError::plain(match error {
                TryLockError::WouldBlock => Status::SinewErrorBusy,
                TryLockError::Poisoned(_) => Status::SinewErrorPanic,
            })
        })?;
        // The value may have been removed, and the slot claimed by another thread, since the check.
        // SYNC: Relaxed, since the lock orders it: a thread that has put another value in claimed the slot
        // before it took the lock, which was before this thread did. If none has, the removed value is not
        // there.
        if slot.holder.load(Ordering::Relaxed) != handle {
            return Err(CallError::plain(Status::SinewErrorNoSuchEndpoint));
        }
        Ok(value)
    }

    fn slot(&self, handle: usize) -> Result<&Slot<T>, CallError> {
        let slot = &self.slots[handle % ENDPOINTS_MAX];
        // SYNC: Acquire, with the Release in `fill`, after which `forks` is this handle's.
        if handle == FREE || handle == CLAIMED || slot.holder.load(Ordering::Acquire) != handle {
            return Err(CallError::plain(Status::SinewErrorNoSuchEndpoint));
        }
        // If another handle has the slot by now, `forks` may be its number: then the check under the lock
        // rejects the call, or this one does.
        if slot.forks.load(Ordering::Relaxed) != fork::generation() {
            return Err(CallError::plain(Status::SinewErrorForked));
        }
        Ok(slot)
    }
}

impl<T> Claim<'_, T> {
    /// Puts a value into the slot; returns its handle.
    pub(crate) fn fill(self, value: T) -> usize {
        let slot = &self.table.slots[self.slot];
        *slot.value.lock().unwrap_or_else(PoisonError::into_inner) = Some(value);
        slot.forks.store(fork::generation(), Ordering::Relaxed);
        let handle = self.table.next_serial() * ENDPOINTS_MAX + self.slot;
        // SYNC: Release, for the Acquire in `slot`: a thread that finds the handle finds `forks`. The lock
        // orders the value.
        slot.holder.store(handle, Ordering::Release);
        // From here on the slot is the handle's. A program that guessed the handle may have freed the slot
        // already, and another thread may have claimed it: nothing is freed here.
        mem::forget(self);
        handle
    }
}

impl<T> Table<T> {
    /// The lowest eight bits of a handle are the slot; the rest is this number, never zero and never all
    /// ones.
    fn next_serial(&self) -> usize {
        const SERIALS: usize = usize::MAX / ENDPOINTS_MAX - 1;
        // SYNC: Relaxed, since no data depends on the number: the numbers only have to be unique.
        self.serials.fetch_add(1, Ordering::Relaxed) % SERIALS + 1
    }
}

impl<T> Drop for Claim<'_, T> {
    fn drop(&mut self) {
        // SYNC: Release, for the next exchange in `claim`: passes on the state that this claim's own exchange
        // has acquired. A store is enough, since only the thread that has claimed a slot changes it.
        self.table.slots[self.slot].holder.store(FREE, Ordering::Release);
    }
}

#[cfg(test)]
mod tests {
    use std::{
        panic::{AssertUnwindSafe, catch_unwind},
        thread,
    };

    use super::*;

    fn status(result: Result<impl Sized, CallError>) -> Status {
        result.map_or_else(|error| error.status, |_| Status::SinewOk)
    }

    #[test]
    fn released_handle_is_rejected_forever() {
        let table = Table::new();
        let first = table.claim().unwrap().fill('a');
        assert_eq!(table.take(first), Ok('a'));
        let second = table.claim().unwrap().fill('b');
        assert_eq!(first % ENDPOINTS_MAX, second % ENDPOINTS_MAX, "they have the same slot");
        for wrong in [first, FREE, CLAIMED, 1, second + ENDPOINTS_MAX, second + 1] {
            assert_eq!(status(table.with(wrong, |_| Ok(()))), Status::SinewErrorNoSuchEndpoint);
            assert_eq!(status(table.take(wrong)), Status::SinewErrorNoSuchEndpoint);
        }
        assert_eq!(table.with(second, |value| Ok(*value)), Ok('b'));
    }

    #[test]
    fn concurrent_second_call_is_rejected() {
        let table = Table::new();
        let handle = table.claim().unwrap().fill('a');
        let inner = table.with(handle, |_| Ok((table.with(handle, |_| Ok(())), table.take(handle))));
        let (with, take) = inner.unwrap();
        assert_eq!((status(with), status(take)), (Status::SinewErrorBusy, Status::SinewErrorBusy));
        assert_eq!(status(table.with(handle, |_| Ok(()))), Status::SinewOk);
    }

    #[test]
    fn only_take_works_after_a_panic() {
        let table = Table::new();
        let handle = table.claim().unwrap().fill('a');
        let panics = || table.with(handle, |_| -> Result<(), CallError> { panic!("this is asked for") });
        assert!(catch_unwind(AssertUnwindSafe(panics)).is_err());
        assert_eq!(status(table.with(handle, |_| Ok(()))), Status::SinewErrorPanic);
        assert_eq!(table.take(handle), Ok('a'));
        let next = table.claim().unwrap().fill('b');
        assert_eq!(table.with(next, |value| Ok(*value)), Ok('b'));
    }

    #[test]
    fn table_is_bounded_by_endpoints_max() {
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
    const REGISTRATIONS: usize = 100_000;

    /// The value behind a handle in the test below, and the facts that every thread may check about it.
    #[derive(Clone, Copy, Debug, Default, PartialEq)]
    struct Owner {
        owner: usize,
        number: usize,
    }

    /// The last handle of each thread, valid or not, and its owner.
    type LastHandles = [Mutex<(usize, Owner)>; THREADS];

    /// Repeats the call until the slot's lock is free. A thread that tries an old handle of the slot holds it
    /// briefly.
    fn unless_busy<R>(mut call: impl FnMut() -> Result<R, CallError>) -> Option<R> {
        loop {
            match call() {
                Ok(done) => return Some(done),
                Err(error) if error.status == Status::SinewErrorNoSuchEndpoint => return None,
                Err(error) => assert_eq!(error.status, Status::SinewErrorBusy),
            }
        }
    }

    /// Registers one endpoint after the other, uses them, and uses and ends those of other threads, which do
    /// the same. Returns the number of endpoints that it has ended.
    fn register_and_race(table: &Table<Owner>, owner: usize, last_handles: &LastHandles) -> usize {
        let mut ended = 0;
        for number in 0..REGISTRATIONS {
            let own = Owner { owner, number };
            let handle = table.claim().unwrap().fill(own);
            *last_handles[owner].lock().unwrap() = (handle, own);
            let others = last_handles.iter().map(|last| *last.lock().unwrap());
            let tried: [(usize, Owner); THREADS] = others.collect::<Vec<_>>().try_into().unwrap();
            for (handle, expected) in tried {
                // The slot may have been reused since: the call finds this endpoint, or none.
                let found = unless_busy(|| table.with(handle, |found| Ok(*found)));
                assert!(found.is_none_or(|found| found == expected), "{found:?} instead of {expected:?}");
            }
            for (handle, expected) in [tried[(owner + number) % THREADS], (handle, own)] {
                let taken = unless_busy(|| table.take(handle));
                assert!(taken.is_none_or(|taken| taken == expected), "{taken:?} instead of {expected:?}");
                ended += usize::from(taken.is_some());
            }
        }
        ended
    }

    #[test]
    fn racing_threads_find_their_own_endpoint_or_none() {
        let (table, last_handles) = (Table::new(), LastHandles::default());
        let ended = thread::scope(|scope| {
            let threads = [0, 1, 2, 3].map(|owner| {
                let (table, last_handles) = (&table, &last_handles);
                scope.spawn(move || register_and_race(table, owner, last_handles))
            });
            threads.map(|thread| thread.join().unwrap()).iter().sum::<usize>()
        });
        assert_eq!(ended, THREADS * REGISTRATIONS, "each was ended once");
        let again: Vec<_> =
            (0..ENDPOINTS_MAX).map(|_| table.claim().unwrap().fill(Owner::default())).collect();
        assert_eq!(again.len(), ENDPOINTS_MAX, "all slots are free");
    }
}
