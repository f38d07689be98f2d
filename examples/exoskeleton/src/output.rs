//! Standard output and standard error of this program. Nothing else in it prints, which clippy checks.
//!
//! A walk must not end, and no record must be lost, because nobody reads along. So printing never fails for its caller: a reader that
//! closes its pipe ends the output quietly, every other error of standard output is kept for [`failure`].

use std::fmt::Display;
use std::io::{self, Write as _};
use std::sync::OnceLock;

/// The first error of standard output. Nothing is printed after it.
static FIRST_ERROR: OnceLock<io::Error> = OnceLock::new();

/// Prints a text as it is.
pub fn print(text: &str) {
    if FIRST_ERROR.get().is_none() {
        let mut out = io::stdout().lock();
        keep(out.write_all(text.as_bytes()).and_then(|()| out.flush()));
    }
}

/// Keeps the error of something that printed by itself.
pub fn keep(printed: io::Result<()>) {
    if let Err(error) = printed {
        // Only the first one counts.
        let _ = FIRST_ERROR.set(error);
    }
}

/// Prints a line to standard error. Nothing can be done where that fails.
pub fn note(text: impl Display) {
    let _ = writeln!(io::stderr(), "{text}");
}

/// The reason why standard output did not take everything; `None` also where its reader has closed the pipe.
#[must_use]
pub fn failure() -> Option<&'static io::Error> {
    FIRST_ERROR.get().filter(|error| error.kind() != io::ErrorKind::BrokenPipe)
}
