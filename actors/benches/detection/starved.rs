//! Counts NDL's own reports in this process's log that it was starved.

use std::{
    io::{self, Write},
    sync::atomic::{AtomicU64, Ordering},
};

use tracing_subscriber::filter::LevelFilter;

/// NDL's log text for this event, at most once a second.
const WORDS: &str = "NDL was starved";
/// Before how late it was.
const LATE: &str = "late_ms=";

static TIMES: AtomicU64 = AtomicU64::new(0);
static LATE_MS: AtomicU64 = AtomicU64::new(0);

/// Reads the log; displays it if `RUST_LOG` is set, else drops it.
struct Reader {
    is_loud: bool,
}

impl Write for Reader {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let line = String::from_utf8_lossy(bytes);
        if line.contains(WORDS) {
            TIMES.fetch_add(1, Ordering::Relaxed);
            LATE_MS.fetch_max(late_ms(&line).unwrap_or(0), Ordering::Relaxed);
        }
        if self.is_loud {
            io::stderr().write_all(bytes)?;
        }
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

fn late_ms(line: &str) -> Option<u64> {
    let (_, rest) = line.split_once(LATE)?;
    rest.split(|char: char| !char.is_ascii_digit()).next()?.parse().ok()
}

/// Starts reading this process's log.
pub(crate) fn listen() {
    let is_loud = std::env::var_os("RUST_LOG").is_some();
    let reader = move || Reader { is_loud };
    tracing_subscriber::fmt().with_max_level(LevelFilter::WARN).with_ansi(false).with_writer(reader).init();
}

/// How often so far, and by how many milliseconds its timer was late at worst.
pub(crate) fn told() -> (u64, u64) {
    (TIMES.load(Ordering::Relaxed), LATE_MS.load(Ordering::Relaxed))
}
