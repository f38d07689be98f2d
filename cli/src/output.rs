//! Standard output and standard error of this program. Nothing else in it prints, which clippy checks.
//!
//! A reader that closes its pipe, as `head` does, ends the output quietly. Every other error of standard output is
//! kept, and [`exit_code`] reports it: a full disk must not look like an answer without content.

use std::{
    fmt::Display,
    io::{self, Write as _},
    process::ExitCode,
    sync::OnceLock,
};

/// The first error of standard output. Nothing is printed after it.
static FIRST_ERROR: OnceLock<io::Error> = OnceLock::new();

/// Prints a text as it is. Returns whether standard output still takes more.
pub(crate) fn print(text: &str) -> bool {
    if FIRST_ERROR.get().is_some() {
        return false;
    }
    let mut out = io::stdout().lock();
    keep(out.write_all(text.as_bytes()).and_then(|()| out.flush()))
}

/// Prints a line. Returns whether standard output still takes more.
pub(crate) fn line(text: &str) -> bool {
    print(&format!("{text}\n"))
}

/// Records the error of code that printed by itself. Returns whether there was none.
pub(crate) fn keep(printed: io::Result<()>) -> bool {
    printed.map_err(|error| FIRST_ERROR.set(error)).is_ok()
}

/// Prints a line to standard error. An error is ignored.
pub(crate) fn note(text: impl Display) {
    let _ = writeln!(io::stderr(), "{text}");
}

/// The exit code of the program: `code`, or [`EXIT_NOT_WRITTEN`](crate::EXIT_NOT_WRITTEN) where all was fine but
/// standard output has failed.
pub(crate) fn exit_code(code: u8) -> ExitCode {
    let failed = FIRST_ERROR.get().filter(|error| error.kind() != io::ErrorKind::BrokenPipe);
    let Some(error) = failed else { return ExitCode::from(code) };
    note(format_args!(
        "sinew: standard output is incomplete: {error}; free space on its device, or send it elsewhere"
    ));
    ExitCode::from(if code == crate::EXIT_OK { crate::EXIT_NOT_WRITTEN } else { code })
}
