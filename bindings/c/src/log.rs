//! The library's log: lines on the standard error.
//!
//! A separate thread writes the lines, so that a blocked standard error stops no thread that sends or
//! receives. A process starts that thread with its first line, and so does a child of `fork`. Most processes
//! log nothing, and have no thread.

mod writer;

use std::{
    io::{self, IsTerminal, stderr},
    sync::{Arc, OnceLock},
    time::Duration,
};

use arc_swap::ArcSwapOption;
use tracing_subscriber::EnvFilter;

pub(crate) use self::writer::without_signals;
use self::writer::{Lines, accepts_data, record_stderr, to_stderr};
use crate::fork;

/// The environment variable with the log filter.
const FILTER_VARIABLE: &str = "SINEW_LOG";
/// The filter if the variable is not set or cannot be parsed.
const FILTER_DEFAULT: &str = "warn";
/// Time at the end of the process for writing the lines that wait.
const EXIT_TIMEOUT: Duration = Duration::from_millis(200);

/// The lines of this process, or of the one that it was forked from.
static LINES: ArcSwapOption<Own> = ArcSwapOption::const_empty();

/// The lines of one process.
struct Own {
    /// Number of forks when it was started.
    forks: u32,
    lines: Lines,
    /// The lines of the parent process. Dropping them could wait for threads that do not exist in the child.
    _former: Option<Arc<Self>>,
}

/// Initializes the log at the first call. A process that already has a `tracing` subscriber keeps that one.
pub(crate) fn begin() {
    static IS_OURS: OnceLock<bool> = OnceLock::new();
    let is_ours = *IS_OURS.get_or_init(|| {
        record_stderr();
        let filter =
            EnvFilter::try_from_env(FILTER_VARIABLE).unwrap_or_else(|_| EnvFilter::new(FILTER_DEFAULT));
        let log = tracing_subscriber::fmt().with_env_filter(filter).with_writer(|| LineWriter);
        // An error means that there is a subscriber already.
        log.with_ansi(stderr().is_terminal()).try_init().is_ok()
    });
    if is_ours {
        flush_at_exit();
    }
}

/// Starts the thread, which this process does not have.
fn start_lines() {
    let (former, forks) = (LINES.load_full(), fork::generation());
    // Without a thread nothing is written.
    let Some(lines) = Lines::start(to_stderr) else { return };
    // If another thread was faster, this one ends with its queue.
    LINES.compare_and_swap(&former, Some(Arc::new(Own { forks, lines, _former: former.clone() })));
}

/// Registers `flush` to run when the process exits normally.
fn flush_at_exit() {
    static REGISTERED: OnceLock<()> = OnceLock::new();
    REGISTERED.get_or_init(|| {
        // SAFETY: the handler waits for a bounded time and does not panic. If the call fails, the last lines
        // may be missing.
        unsafe { libc::atexit(flush) };
    });
}

/// Waits until the queued lines are written: at most `EXIT_TIMEOUT`, and hardly at all while the standard
/// error is blocked.
extern "C" fn flush() {
    // A child of `fork` has its parent's handlers, but not its thread.
    if let Some(own) = own()
        && own.lines.are_waiting()
        && accepts_data()
    {
        own.lines.flush(EXIT_TIMEOUT);
    }
}

/// The lines of this very process, if it has logged anything.
fn own() -> Option<Arc<Own>> {
    LINES.load_full().filter(|own| own.forks == fork::generation())
}

/// Accepts one line per write, and never waits.
struct LineWriter;

impl io::Write for LineWriter {
    fn write(&mut self, line: &[u8]) -> io::Result<usize> {
        let own = own().or_else(|| {
            start_lines();
            own()
        });
        if let Some(own) = own {
            own.lines.push(line);
        }
        Ok(line.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}
