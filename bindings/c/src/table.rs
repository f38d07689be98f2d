//! Handles of endpoints: numbers that are looked up here, never followed.
//!
//! A handle looks like a pointer to C, but is a place in a table and a serial number. So one that was unregistered, or was
//! never registered, is refused; nothing is read through it. On 64 bits a serial number does not come again; on 32 bits it
//! does after 16 million registrations.

use std::sync::{
    Mutex, MutexGuard, PoisonError, TryLockError,
    atomic::{AtomicU32, AtomicUsize, Ordering},
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
        if place.holder.load(Ordering::Acquire) != handle {
            return Err(Fault::plain(Status::SinewErrorNoSuchEndpoint));
        }
        let taken = value.take().ok_or_else(|| Fault::plain(Status::SinewErrorNoSuchEndpoint))?;
        drop(value);
        place.value.clear_poison();
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
        if place.holder.load(Ordering::Acquire) != handle {
            return Err(Fault::plain(Status::SinewErrorNoSuchEndpoint));
        }
        Ok(value)
    }

    fn place(&self, handle: usize) -> Result<&Place<T>, Fault> {
        let place = &self.places[handle % ENDPOINTS_MAX];
        if handle == FREE || handle == CLAIMED || place.holder.load(Ordering::Acquire) != handle {
            return Err(Fault::plain(Status::SinewErrorNoSuchEndpoint));
        }
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
        place.holder.store(handle, Ordering::Release);
        handle
    }
}

impl<T> Table<T> {
    /// Of a handle's bits the lowest eight are the place; the rest is this, never zero and never all ones.
    fn next_serial(&self) -> usize {
        const SERIALS: usize = usize::MAX / ENDPOINTS_MAX - 1;
        self.serials.fetch_add(1, Ordering::Relaxed) % SERIALS + 1
    }
}

impl<T> Drop for Claim<'_, T> {
    fn drop(&mut self) {
        let holder = &self.table.places[self.place].holder;
        // If it was filled there is nothing to give back.
        let _ = holder.compare_exchange(CLAIMED, FREE, Ordering::Release, Ordering::Relaxed);
    }
}

#[cfg(test)]
mod tests {
    use std::panic::{AssertUnwindSafe, catch_unwind};

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
}
