//! The wrapper of every exported function: no panic leaves it, NULL is rejected, and an error leaves a
//! sentence.

use std::{
    any::Any,
    mem::{self, MaybeUninit},
    panic::{AssertUnwindSafe, catch_unwind},
};

use crate::status::{CallError, Status};

/// Runs the body of a function and catches panics. A panic becomes `SINEW_ERROR_PANIC`; it poisons the lock
/// of the endpoint on which it happened (see `table.rs`).
pub(crate) fn call(body: impl FnOnce() -> Result<Status, CallError>) -> Status {
    // State that a panic may leave half changed is behind the endpoint's lock, which the panic poisons.
    match catch_unwind(AssertUnwindSafe(body)) {
        Ok(Ok(status)) => status,
        Ok(Err(error)) => error.record(),
        Err(panic) => {
            let sentence = format!("this library panicked: {}; please report it", message_of(&*panic));
            // Dropping the panic payload could panic again.
            mem::forget(panic);
            CallError::new(Status::SinewErrorPanic, sentence).record()
        }
    }
}

/// As [`call`], for functions that return a value. Returns `nothing` after an error.
pub(crate) fn value<T>(nothing: T, body: impl FnOnce() -> Result<T, CallError>) -> T {
    let mut value = None;
    call(|| {
        value = Some(body()?);
        Ok(Status::SinewOk)
    });
    value.unwrap_or(nothing)
}

/// Unwraps a pointer that must not be NULL.
pub(crate) fn present<T>(pointer: Option<T>, name: &str) -> Result<T, CallError> {
    pointer.ok_or_else(|| CallError::argument(format!("`{name}` is NULL")))
}

/// Writes to memory of the caller; called on success only.
pub(crate) fn write<T>(out: &mut MaybeUninit<T>, value: T) -> Status {
    out.write(value);
    Status::SinewOk
}

fn message_of(panic: &(dyn Any + Send)) -> &str {
    let text = panic.downcast_ref::<&str>().copied();
    text.or_else(|| panic.downcast_ref::<String>().map(String::as_str)).unwrap_or("no message")
}

#[cfg(test)]
mod tests {
    use std::ffi::CStr;

    use super::*;
    use crate::status::last_sentence;

    struct PanicsWhenDropped;

    impl Drop for PanicsWhenDropped {
        fn drop(&mut self) {
            panic!("this is the panic that the test asks for");
        }
    }

    #[test]
    fn no_panic_crosses_the_boundary() {
        assert_eq!(call(|| panic!("{} that the test asks for", "the panic")), Status::SinewErrorPanic);
        // SAFETY: the sentence is a C string that stays until this thread's next error.
        let sentence = unsafe { CStr::from_ptr(last_sentence()) }.to_string_lossy().into_owned();
        assert!(sentence.contains("the panic that the test asks for"), "{sentence}");
        let status = call(|| std::panic::panic_any(PanicsWhenDropped));
        assert_eq!(status, Status::SinewErrorPanic);
        assert_eq!(value(7, || panic!("this is the panic that the test asks for")), 7);
    }
}
