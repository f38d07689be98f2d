//! Where a panic was, and who is told of it: a hook that remembers the place for the guard, and lets the log's thread do all
//! that may take time. Of a panic in an actor its supervisor hears first; what a log that takes nothing holds up is the log.

use std::{
    any::Any,
    backtrace::Backtrace,
    cell::{Cell, RefCell},
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
    system,
    vitals::{Doing, Vitals},
};
use crate::{log, tid::Tid};

/// Whether this program unwinds from a panic. One that is built with `panic = "abort"` ends with its first panic, whatever
/// supervisors it has. Cargo builds every crate of a program with the same strategy, so this crate's is the program's.
pub const UNWINDS: bool = cfg!(panic = "unwind");

/// Time for the log before the process aborts.
const LAST_WORDS: Duration = Duration::from_secs(1);

type Hook = Box<dyn Fn(&PanicHookInfo<'_>) + Send + Sync>;

/// The panic hook that was there before.
struct Former {
    hook: Hook,
    /// It is the standard library's, which names the thread that it is called on and looks up that one's backtrace: of a panic
    /// that is told elsewhere neither is true.
    is_standard: bool,
}

impl Former {
    /// Takes it away.
    fn take() -> Self {
        let hook = std::panic::take_hook();
        // Where none is set any more, this is the standard library's.
        let standard = std::panic::take_hook();
        let is_standard = std::ptr::eq(&raw const *hook, &raw const *standard);
        Self { hook, is_standard }
    }
}

/// Whose a thread is.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Station {
    /// Nobody's that is known here.
    Foreign,
    /// The runtime's: whoever holds it up holds up actors, or those who watch them.
    Runtime,
    /// The log's.
    Log,
}

thread_local! {
    /// Where the last panic on this thread was.
    static LAST: RefCell<Option<String>> = const { RefCell::new(None) };
    static STATION: Cell<Station> = const { Cell::new(Station::Foreign) };
}

/// Read by who may hold the standard library's lock on backtraces for long: it prints a panic while it has that lock. Who
/// must not wait takes a backtrace only where nobody reads this.
static PRINTS: RwLock<()> = RwLock::new(());

/// The calling thread is the runtime's: a panic on it is told elsewhere.
pub(super) fn is_the_runtimes() {
    STATION.set(Station::Runtime);
}

/// The calling thread is the log's.
pub(crate) fn writes_the_log() {
    STATION.set(Station::Log);
}

/// Makes panics remember where they were. The hook that was there before is called: on the thread that panics where nobody
/// waits for that, and else on the log's.
pub(super) fn install_hook() {
    static INSTALLED: Once = Once::new();
    INSTALLED.call_once(|| {
        let former = Arc::new(Former::take());
        std::panic::set_hook(Box::new(move |info| hook(info, &former)));
    });
}

fn hook(info: &PanicHookInfo<'_>, former: &Arc<Former>) {
    let place = info.location().map(|at| format!("{}:{}", at.file(), at.line()));
    // A thread that is about to end has no such memory any more; then nobody asks either.
    let _ = LAST.try_with(|last| {
        if let Ok(mut last) = last.try_borrow_mut() {
            *last = place;
        }
    });
    let vitals = Vitals::present();
    if let Some(vitals) = &vitals {
        vitals.begins(Doing::Panic, None);
    }
    let station = STATION.try_with(Cell::get).unwrap_or(Station::Foreign);
    match (station, &vitals) {
        (Station::Log, _) => (former.hook)(info),
        (Station::Runtime, _) | (Station::Foreign, Some(_)) if UNWINDS => {
            let panicked = Panicked::new(info, vitals.as_deref());
            let former = former.clone();
            log::enter(Box::new(move || panicked.tell(&former)));
            if is_the_last(info) {
                log::flush(LAST_WORDS);
            }
        }
        (Station::Runtime | Station::Foreign, _) => {
            // The former hook says it. A subscriber may be all that anybody reads.
            if !get_default(|reader| reader.is::<NoSubscriber>()) {
                let thread = system::thread_id();
                log::error!(thread, "outside of any supervised actor's turn: {}", sentence(info));
            }
            let _prints = PRINTS.read();
            (former.hook)(info);
        }
    }
}

/// Whether the process aborts when the hook returns. It is not said otherwise in a stable way.
fn is_the_last(info: &PanicHookInfo<'_>) -> bool {
    info.payload_as_str().is_some_and(|said| said.starts_with("panic in a "))
}

/// A panic that is to be told on the log's thread.
struct Panicked {
    /// The actor and its address.
    actor: Option<(String, Option<Tid>)>,
    thread: i32,
    said: String,
    backtrace: Option<Backtrace>,
    reader: Dispatch,
    time: SystemTime,
}

impl Panicked {
    /// Waits for nobody: where a backtrace is printed now, this panic has none.
    fn new(info: &PanicHookInfo<'_>, vitals: Option<&Vitals>) -> Self {
        let is_wanted = Frames::wanted() != Frames::None;
        let backtrace = PRINTS.try_write().ok().filter(|_| is_wanted).map(|_held| Backtrace::force_capture());
        Self {
            actor: vitals.map(|vitals| (vitals.name().to_owned(), vitals.tid())),
            thread: system::thread_id(),
            said: sentence(info),
            backtrace,
            reader: get_default(Dispatch::clone),
            time: log::now(),
        }
    }

    /// Says it once: to the subscriber that reads the log, and where there is none to the standard error. A hook of the program's own
    /// is called in any case; where there is no subscriber it alone says the panic, as it would for any other.
    fn tell(&self, former: &Former) {
        let _prints = PRINTS.read();
        // A subscriber that came after the panic has the events of this thread.
        let has_reader = !self.reader.is::<NoSubscriber>() || log::is_replaced();
        let is_said = has_reader && self.is_logged();
        if !former.is_standard {
            let mut words = self.words();
            if !is_said {
                words.extend(self.frames().iter().map(|frame| format!("\n{frame}")));
            }
            // A hook takes what only a panic can make.
            let _ = catch_unwind(|| std::panic::panic_any(words));
        } else if !is_said {
            self.write();
        }
    }

    /// Tells the subscriber, if it takes errors.
    fn is_logged(&self) -> bool {
        if self.reader.is::<NoSubscriber>() {
            return self.log();
        }
        with_default(&self.reader, || self.log())
    }

    /// Who panicked, where, and what it said.
    fn words(&self) -> String {
        let Self { actor, thread, said, .. } = self;
        match actor {
            Some((name, Some(tid))) => format!("the actor '{name}' ({tid}) on thread {thread} {said}"),
            Some((name, None)) => format!("the actor '{name}' on thread {thread} {said}"),
            None => format!("a task that is no actor's on thread {thread} {said}"),
        }
    }

    fn frames(&self) -> Vec<String> {
        self.backtrace.as_ref().map(|backtrace| frames(backtrace, Frames::wanted())).unwrap_or_default()
    }

    /// Writes it to the standard error, as the standard hook would, whatever the log is set to. The frames come last: their names may
    /// take a while to look up.
    fn write(&self) {
        let mut line = log::Line::new(self.time, Level::ERROR, module_path!());
        line.message(&self.words());
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
        let Self { actor, thread, said, .. } = self;
        let frames: String = self.frames().iter().map(|frame| format!("\n{frame}")).collect();
        match actor {
            Some((actor, tid)) => {
                let tid = tid.map(tracing::field::display);
                tracing::error!(actor, tid, thread, "{said}{frames}");
            }
            None => tracing::error!(thread, "outside of any supervised actor's turn: {said}{frames}"),
        }
        true
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

/// A panic that was caught.
pub(super) struct Caught {
    /// What it said on this thread, and where: `said at file:line`.
    pub(super) words: String,
    /// What it carried, if that is more than text: the user's, and so is its drop, which may last, never end, or panic.
    pub(super) carried: Option<Box<dyn Any + Send>>,
}

impl Caught {
    /// Of what `catch_unwind` returned, on the thread that panicked.
    pub(super) fn new(panic: Box<dyn Any + Send>) -> Self {
        let text = panic.downcast_ref::<&str>().map(|text| (*text).to_owned());
        let text = text.or_else(|| panic.downcast_ref::<String>().cloned());
        let carried = text.is_none().then_some(panic);
        let said = text.unwrap_or_else(|| SPEECHLESS.to_owned());
        let words = match LAST.try_with(|last| last.borrow_mut().take()).ok().flatten() {
            Some(place) => format!("{said} at {place}"),
            None => said,
        };
        Self { words, carried }
    }
}

/// What a panic on this thread said, and where, for whom nobody waits: drops what it carries here, whose drop may panic too.
pub(super) fn words(panic: Box<dyn Any + Send>) -> String {
    let Caught { words, carried } = Caught::new(panic);
    if let Some(carried) = carried {
        discard(carried);
    }
    words
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
