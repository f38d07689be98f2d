//! The report of panics. A hook stores the location for the guard, and the log thread does all slow work. The
//! supervisor of an actor is notified of a panic first; a blocked log delays only the log.

use std::{
    any::Any,
    backtrace::Backtrace,
    cell::RefCell,
    panic::{AssertUnwindSafe, PanicHookInfo, catch_unwind},
    sync::{Arc, Once, RwLock},
    time::{Duration, SystemTime},
};

use tracing::{
    Dispatch, Level,
    dispatcher::{get_default, with_default},
    subscriber::NoSubscriber,
};

use super::{
    frames::{Frames, frames},
    liveness::{Activity, Liveness},
};
use crate::{
    log,
    thread::{self, Role, system},
    tid::Tid,
};

/// Whether this program unwinds from a panic. A program with `panic = "abort"` ends with its first panic,
/// independent of its supervisors. Cargo builds all crates of a program with the same strategy, so this
/// crate's strategy is the program's.
pub const UNWINDS: bool = cfg!(panic = "unwind");

/// Time for the log before the process aborts.
const FLUSH_WITHIN: Duration = Duration::from_secs(1);

type Hook = Box<dyn Fn(&PanicHookInfo<'_>) + Send + Sync>;

/// The previously installed panic hook.
struct Former {
    hook: Hook,
    /// Whether it is the standard library's hook. That hook names the calling thread and prints its
    /// backtrace, which is wrong for a panic reported from another thread.
    is_standard: bool,
}

impl Former {
    /// Removes and returns the installed hook.
    fn take() -> Self {
        let hook = std::panic::take_hook();
        // If no hook is set any more, this is the standard library's.
        let standard = std::panic::take_hook();
        let is_standard = std::ptr::eq(&raw const *hook, &raw const *standard);
        Self { hook, is_standard }
    }
}

thread_local! {
    /// The location of the last panic on this thread.
    static LAST: RefCell<Option<String>> = const { RefCell::new(None) };
}

/// Locked for reading by threads that may hold the standard library's backtrace lock for long, as they print
/// a panic. A thread that must not wait takes a backtrace only if this is not locked.
static PRINTS: RwLock<()> = RwLock::new(());

/// Installs the hook that stores the location of a panic. The previous hook is still called: on the panicking
/// thread if no actor depends on that thread, otherwise on the log thread.
pub(super) fn install_hook() {
    static INSTALLED: Once = Once::new();
    INSTALLED.call_once(|| {
        let former = Arc::new(Former::take());
        std::panic::set_hook(Box::new(move |info| hook(info, &former)));
    });
}

fn hook(info: &PanicHookInfo<'_>, former: &Arc<Former>) {
    let place = info.location().map(|at| format!("{}:{}", at.file(), at.line()));
    // A thread at its end may have destroyed this variable; then no reader needs the location.
    let _ = LAST.try_with(|last| {
        if let Ok(mut last) = last.try_borrow_mut() {
            *last = place;
        }
    });
    let liveness = Liveness::current();
    if let Some(liveness) = &liveness {
        liveness.begin(Activity::Panic, None);
    }
    match (thread::role(), &liveness) {
        (Role::Log, _) => (former.hook)(info),
        (Role::Runtime, _) | (Role::Foreign, Some(_)) if UNWINDS => {
            let panicked = Panicked::new(info, liveness.as_deref());
            let former = former.clone();
            log::enqueue(Box::new(move || panicked.report(&former)));
            if aborts_process(info) {
                log::flush(FLUSH_WITHIN);
            }
        }
        (Role::Runtime | Role::Foreign, _) => {
            // The previous hook prints it. A subscriber may be the only output that is read.
            if !get_default(|reader| reader.is::<NoSubscriber>()) {
                let thread = system::thread_id();
                log::error!(thread, "outside of any supervised actor's turn: {}", sentence(info));
            }
            let _prints = PRINTS.read();
            (former.hook)(info);
        }
    }
}

/// Returns whether the process aborts when the hook returns. No stable API reports this, so the message is checked.
fn aborts_process(info: &PanicHookInfo<'_>) -> bool {
    info.payload_as_str().is_some_and(|message| message.starts_with("panic in a "))
}

/// A panic to be reported by the log thread.
struct Panicked {
    /// The name of the actor and its address.
    actor: Option<(String, Option<Tid>)>,
    thread: i32,
    message: String,
    backtrace: Option<Backtrace>,
    reader: Dispatch,
    time: SystemTime,
}

impl Panicked {
    /// Records a panic without blocking: while another thread prints a backtrace, this panic has none.
    fn new(info: &PanicHookInfo<'_>, liveness: Option<&Liveness>) -> Self {
        let is_wanted = Frames::wanted() != Frames::None;
        let backtrace = PRINTS.try_write().ok().filter(|_| is_wanted).map(|_held| Backtrace::force_capture());
        Self {
            actor: liveness.map(|liveness| (liveness.name().to_owned(), liveness.tid())),
            thread: system::thread_id(),
            message: sentence(info),
            backtrace,
            reader: get_default(Dispatch::clone),
            time: log::now(),
        }
    }

    /// Reports the panic once: to the subscriber that reads the log, or to the standard error if there is
    /// none. A custom hook of the program is always called; without a subscriber it alone reports the panic,
    /// as it does for other panics.
    fn report(&self, former: &Former) {
        // Without the frames: resolving their names may take a while.
        log::show(Level::ERROR, module_path!(), || self.summary());
        let _prints = PRINTS.read();
        // A subscriber that was set after the panic receives the events of this thread.
        let has_reader = !self.reader.is::<NoSubscriber>() || log::is_replaced();
        let is_reported = has_reader && self.is_logged();
        if !former.is_standard {
            let mut message = self.summary();
            if !is_reported {
                message.extend(self.frames().iter().map(|frame| format!("\n{frame}")));
            }
            // The hook's argument can be created only by a panic.
            let _ = catch_unwind(|| std::panic::panic_any(message));
        } else if !is_reported {
            self.write();
        }
    }

    /// Logs the panic, if the subscriber accepts errors.
    fn is_logged(&self) -> bool {
        if self.reader.is::<NoSubscriber>() {
            return self.log();
        }
        with_default(&self.reader, || self.log())
    }

    /// Returns the actor, the location and the message of the panic.
    fn summary(&self) -> String {
        let Self { actor, thread, message, .. } = self;
        match actor {
            Some((name, Some(tid))) => format!("the actor '{name}' ({tid}) on thread {thread} {message}"),
            Some((name, None)) => format!("the actor '{name}' on thread {thread} {message}"),
            None => format!("a task that is no actor's on thread {thread} {message}"),
        }
    }

    fn frames(&self) -> Vec<String> {
        self.backtrace.as_ref().map(|backtrace| frames(backtrace, Frames::wanted())).unwrap_or_default()
    }

    /// Writes the panic to the standard error, as the standard hook would, independent of the log's filter.
    /// The frames come last: resolving their names may take a while.
    fn write(&self) {
        let mut line = log::Line::new(self.time, Level::ERROR, module_path!());
        line.message(&self.summary());
        line.write();
        let frames = self.frames();
        if !frames.is_empty() {
            log::write_text(&format!("{}\n", frames.join("\n")));
        }
    }

    fn log(&self) -> bool {
        if !tracing::enabled!(Level::ERROR) {
            return false;
        }
        let Self { actor, thread, message, .. } = self;
        let frames: String = self.frames().iter().map(|frame| format!("\n{frame}")).collect();
        match actor {
            Some((actor, tid)) => {
                let tid = tid.map(tracing::field::display);
                tracing::error!(actor, tid, thread, "{message}{frames}");
            }
            None => tracing::error!(thread, "outside of any supervised actor's turn: {message}{frames}"),
        }
        true
    }
}

fn sentence(info: &PanicHookInfo<'_>) -> String {
    let message = info.payload_as_str().unwrap_or(NO_TEXT);
    match info.location() {
        Some(at) => format!("panicked at {at}: {message}"),
        None => format!("panicked: {message}"),
    }
}

const NO_TEXT: &str = "something that is not text";

/// A caught panic.
pub(super) struct Caught {
    /// The message on this thread, and the location: `message at file:line`.
    pub(super) message: String,
    /// The payload, if it is more than text. It is a user value, and its drop may take long, never end, or panic.
    pub(super) payload: Option<Box<dyn Any + Send>>,
}

impl Caught {
    /// Creates it from the result of `catch_unwind`, on the thread that panicked.
    pub(super) fn new(panic: Box<dyn Any + Send>) -> Self {
        let text = panic.downcast_ref::<&str>().map(|text| (*text).to_owned());
        let text = text.or_else(|| panic.downcast_ref::<String>().cloned());
        let payload = text.is_none().then_some(panic);
        let message = text.unwrap_or_else(|| NO_TEXT.to_owned());
        let message = match LAST.try_with(|last| last.borrow_mut().take()).ok().flatten() {
            Some(place) => format!("{message} at {place}"),
            None => message,
        };
        Self { message, payload }
    }
}

/// Returns the message and location of a panic on this thread. Drops the payload here, which may block and may panic.
pub(super) fn panic_message(panic: Box<dyn Any + Send>) -> String {
    let Caught { message, payload } = Caught::new(panic);
    if let Some(payload) = payload {
        discard(payload);
    }
    message
}

/// Drops the payload of a panic. If the drop panics, its payload is dropped too, a few times; the last one is leaked.
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
    fn caught_panic_has_message_and_location() {
        install_hook();
        let line = line!() + 1;
        let panic = catch_unwind(|| panic!("number {}", 13)).expect_err("it panicked");
        assert_eq!(panic_message(panic), format!("number 13 at {}:{line}", file!()));
    }

    /// Panics when it is dropped, with another like itself.
    struct Endless;

    impl Drop for Endless {
        fn drop(&mut self) {
            std::panic::panic_any(Self);
        }
    }

    #[test]
    fn panic_with_endless_nested_panics_is_caught() {
        let panic = catch_unwind(|| std::panic::panic_any(Endless)).expect_err("it panicked");
        assert!(panic_message(panic).starts_with(NO_TEXT));
    }
}
