//! Locks that survive the panic of their holder.

use std::sync::{Mutex, MutexGuard, PoisonError};

/// Locks a mutex with data that is consistent at every point where a panic can occur.
///
/// All lock sections of this project leave their data consistent before they call code that may panic. The lock of a
/// thread that panicked is therefore taken as any other.
///
/// # Examples
///
/// ```
/// let count = std::sync::Mutex::new(1);
/// *sinew_runtime::lock(&count) += 1;
/// assert_eq!(*sinew_runtime::lock(&count), 2);
/// ```
pub fn lock<T: ?Sized>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
