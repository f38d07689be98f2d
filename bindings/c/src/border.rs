//! What every call passes on its way in and out: no panic leaves, no NULL enters, and an error leaves a sentence.

use std::{
    any::Any,
    mem::{self, MaybeUninit},
    panic::{AssertUnwindSafe, catch_unwind},
};

use crate::status::{Fault, Status};

/// Runs what a function does. A panic ends here: it becomes `SINEW_ERROR_PANIC`, and the endpoint on which it happened is
/// left poisoned by its lock (see `table.rs`).
pub(crate) fn call(body: impl FnOnce() -> Result<Status, Fault>) -> Status {
    // What a panic may leave half done is behind the endpoint's lock, which is poisoned by it.
    match catch_unwind(AssertUnwindSafe(body)) {
        Ok(Ok(status)) => status,
        Ok(Err(fault)) => fault.tell(),
        Err(panic) => {
            let words = format!("this library panicked: {}; please report it", words_of(&*panic));
            // Dropping what was panicked with could panic again.
            mem::forget(panic);
            Fault::new(Status::SinewErrorPanic, words).tell()
        }
    }
}

/// As [`call`], for what has a value of its own; `nothing` after an error.
pub(crate) fn value<T>(nothing: T, body: impl FnOnce() -> Result<T, Fault>) -> T {
    let mut value = None;
    call(|| {
        value = Some(body()?);
        Ok(Status::SinewOk)
    });
    value.unwrap_or(nothing)
}

/// What a pointer that must not be NULL points to.
pub(crate) fn present<T>(pointer: Option<T>, name: &str) -> Result<T, Fault> {
    pointer.ok_or_else(|| Fault::argument(format!("`{name}` is NULL")))
}

/// Memory of the caller that is written on success only.
pub(crate) fn write<T>(out: &mut MaybeUninit<T>, value: T) -> Status {
    out.write(value);
    Status::SinewOk
}

fn words_of(panic: &(dyn Any + Send)) -> &str {
    let text = panic.downcast_ref::<&str>().copied();
    text.or_else(|| panic.downcast_ref::<String>().map(String::as_str)).unwrap_or("without words")
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
    fn no_panic_crosses_the_border() {
        assert_eq!(call(|| panic!("{} that the test asks for", "the panic")), Status::SinewErrorPanic);
        // SAFETY: the sentence is a C string that stays until this thread's next fault.
        let told = unsafe { CStr::from_ptr(last_sentence()) }.to_string_lossy().into_owned();
        assert!(told.contains("the panic that the test asks for"), "{told}");
        let status = call(|| std::panic::panic_any(PanicsWhenDropped));
        assert_eq!(status, Status::SinewErrorPanic);
        assert_eq!(value(7, || panic!("this is the panic that the test asks for")), 7);
    }
}
