//! Where a panic was: a hook that remembers it for the guard, which alone knows whose it was.

use std::{
    any::Any,
    cell::RefCell,
    panic::{AssertUnwindSafe, PanicHookInfo, catch_unwind},
    sync::{
        Once,
        atomic::{AtomicU64, Ordering},
    },
};

use super::{
    system,
    vitals::{Doing, Vitals},
};

/// Whether this program unwinds from a panic. One that is built with `panic = "abort"` ends with its first panic, whatever
/// supervisors it has. Cargo builds every crate of a program with the same strategy, so this crate's is the program's.
pub const UNWINDS: bool = cfg!(panic = "unwind");

thread_local! {
    /// Where the last panic on this thread was.
    static LAST: RefCell<Option<String>> = const { RefCell::new(None) };
}

/// Panics that were told to whoever listens, with their backtraces. One at a time: all others wait.
static TOLD: AtomicU64 = AtomicU64::new(0);

/// How many panics were told so far: while it grows, whoever panics waits for his turn.
pub(super) fn told() -> u64 {
    TOLD.load(Ordering::Relaxed)
}

/// Makes panics remember where they were. The hook that was there before is called as before.
pub(super) fn install_hook() {
    static INSTALLED: Once = Once::new();
    INSTALLED.call_once(|| {
        let former = std::panic::take_hook();
        std::panic::set_hook(Box::new(move |info| {
            remember(info);
            former(info);
            TOLD.fetch_add(1, Ordering::Relaxed);
        }));
    });
}

fn remember(info: &PanicHookInfo<'_>) {
    let place = info.location().map(|at| format!("{}:{}", at.file(), at.line()));
    // A thread that is about to end has no such memory any more; then nobody asks either.
    let _ = LAST.try_with(|last| {
        if let Ok(mut last) = last.try_borrow_mut() {
            *last = place;
        }
    });
    let thread = system::thread_id();
    match Vitals::present() {
        Some(vitals) => {
            vitals.begins(Doing::Panic, None);
            tracing::error!(actor = vitals.name(), thread, "{}", sentence(info));
        }
        // Not within an actor's turn: a task or a thread that somebody spawned and nobody supervises.
        None => tracing::error!(thread, "outside of any supervised actor's turn: {}", sentence(info)),
    }
}

fn sentence(info: &PanicHookInfo<'_>) -> String {
    let said = info.payload_as_str().unwrap_or(SPEECHLESS);
    match info.location() {
        Some(at) => format!("panicked at {at}: {said}"),
        None => format!("panicked: {said}"),
    }
}

const SPEECHLESS: &str = "something that is not text";

/// What a panic on this thread said, and where: `said at file:line`. Takes what the panic carries, whose own drop may
/// panic too.
pub(super) fn words(panic: Box<dyn Any + Send>) -> String {
    let text = panic.downcast_ref::<&str>().map(|text| (*text).to_owned());
    let said =
        text.or_else(|| panic.downcast_ref::<String>().cloned()).unwrap_or_else(|| SPEECHLESS.to_owned());
    discard(panic);
    match LAST.try_with(|last| last.borrow_mut().take()).ok().flatten() {
        Some(place) => format!("{said} at {place}"),
        None => said,
    }
}

/// Drops what a panic carries. If that panics in its turn, the same again, a few times; the last is kept for ever.
fn discard(mut panic: Box<dyn Any + Send>) {
    for _ in 0..8 {
        match catch_unwind(AssertUnwindSafe(|| drop(panic))) {
            Ok(()) => return,
            Err(next) => panic = next,
        }
    }
    std::mem::forget(panic);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_caught_panic_says_what_and_where() {
        install_hook();
        let line = line!() + 1;
        let panic = catch_unwind(|| panic!("number {}", 13)).expect_err("it panicked");
        assert_eq!(words(panic), format!("number 13 at {}:{line}", file!()));
    }

    /// Panics when it is dropped, with another like itself.
    struct Endless;

    impl Drop for Endless {
        fn drop(&mut self) {
            std::panic::panic_any(Self);
        }
    }

    #[test]
    fn a_panic_that_carries_panics_without_end_is_caught_all_the_same() {
        let panic = catch_unwind(|| std::panic::panic_any(Endless)).expect_err("it panicked");
        assert!(words(panic).starts_with(SPEECHLESS));
    }
}
