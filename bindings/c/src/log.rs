//! What the library says of itself while it works: lines on the standard error.
//!
//! A thread of their own writes them, so that a standard error which takes nothing stops nobody who sends or receives. A process
//! has it from its first line on, and so has a child of `fork`: most processes say nothing, and have none.

mod writer;

use std::{
    io::{self, IsTerminal, stderr},
    sync::{Arc, OnceLock},
    time::Duration,
};

use arc_swap::ArcSwapOption;
use tracing_subscriber::EnvFilter;

pub(crate) use self::writer::without_signals;
use self::writer::{Lines, is_taken, look_at_stderr, to_stderr};
use crate::fork;

/// The environment variable that says how much.
const WANTED: &str = "SINEW_LOG";
/// If it says nothing, or nothing that can be read.
const USUAL: &str = "warn";
/// Time at the end of the process for what waits to be written.
const LAST_WORDS: Duration = Duration::from_millis(200);

/// The lines of this process, or of the one that it was forked from.
static LINES: ArcSwapOption<Own> = ArcSwapOption::const_empty();

/// The lines of one process.
struct Own {
    /// How many forks it had behind it.
    born: u32,
    lines: Lines,
    /// Those of the process that it was forked from: to let go of them could wait for threads that are not here.
    _former: Option<Arc<Self>>,
}

/// Begins at the first call. A process that has a log of Rust's already keeps that one.
pub(crate) fn begin() {
    static IS_OURS: OnceLock<bool> = OnceLock::new();
    let is_ours = *IS_OURS.get_or_init(|| {
        look_at_stderr();
        let wanted = EnvFilter::try_from_env(WANTED).unwrap_or_else(|_| EnvFilter::new(USUAL));
        let log = tracing_subscriber::fmt().with_env_filter(wanted).with_writer(|| Pen);
        // An error means that there is one.
        log.with_ansi(stderr().is_terminal()).try_init().is_ok()
    });
    if is_ours {
        flush_at_exit();
    }
}

/// Starts the thread, which this process does not have.
fn begin_lines() {
    let (former, born) = (LINES.load_full(), fork::generation());
    // Without a thread nothing is written.
    let Some(lines) = Lines::begin(to_stderr) else { return };
    // If another thread was faster, this one ends with its queue.
    LINES.compare_and_swap(&former, Some(Arc::new(Own { born, lines, _former: former.clone() })));
}

/// Has `flush` called when the process ends in order.
fn flush_at_exit() {
    static ASKED: OnceLock<()> = OnceLock::new();
    ASKED.get_or_init(|| {
        // SAFETY: the handler waits for a bounded time and does not panic. Where it is refused, the last lines may be missing.
        unsafe { libc::atexit(flush) };
    });
}

/// Waits until what was said is written: `LAST_WORDS` at most, and hardly at all where the standard error takes nothing.
extern "C" fn flush() {
    // A child of `fork` has its parent's handlers, and not its thread.
    if let Some(own) = own()
        && own.lines.are_waiting()
        && is_taken()
    {
        own.lines.flush(LAST_WORDS);
    }
}

/// The lines of this very process, if it has said something.
fn own() -> Option<Arc<Own>> {
    LINES.load_full().filter(|own| own.born == fork::generation())
}

/// Takes a line at a time, and never waits.
struct Pen;

impl io::Write for Pen {
    fn write(&mut self, line: &[u8]) -> io::Result<usize> {
        let own = own().or_else(|| {
            begin_lines();
            own()
        });
        if let Some(own) = own {
            own.lines.enter(line);
        }
        Ok(line.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}
