//! Standard output and standard error of this program. Nothing else in it prints, which clippy checks.
//!
//! A walk must not end, and no record must be lost, because of a missing reader. So printing never fails for
//! its caller: a reader that closes its pipe ends the output quietly; every other error of standard output is
//! kept for `failure`.

use std::fmt::Display;
use std::io::{self, Write as _};
use std::process::ExitCode;
use std::sync::OnceLock;

/// The first error of standard output. Nothing is printed after it.
static FIRST_ERROR: OnceLock<io::Error> = OnceLock::new();

/// Runs a program with these arguments. Prints its error, and that of standard output.
pub fn main<A: clap::Parser, E: Display>(
    name: &str,
    run: impl FnOnce(&A) -> Result<ExitCode, E>,
) -> ExitCode {
    let code = match A::try_parse().map(|arguments| run(&arguments)) {
        Ok(Ok(code)) => code,
        Ok(Err(error)) => {
            note(format_args!("{name}: {error}"));
            ExitCode::FAILURE
        }
        Err(error) => refused(&error),
    };
    let Some(error) = failure() else { return code };
    note(format_args!(
        "{name}: standard output is incomplete: {error}; free space where it goes, or send it elsewhere"
    ));
    if code == ExitCode::SUCCESS { ExitCode::FAILURE } else { code }
}

/// Handles a wrong command line, or one that requests help or the version.
fn refused(error: &clap::Error) -> ExitCode {
    let printed = error.print();
    if error.use_stderr() {
        return ExitCode::from(2);
    }
    keep(printed);
    ExitCode::SUCCESS
}

/// Prints a text as it is.
pub fn print(text: &str) {
    if FIRST_ERROR.get().is_none() {
        let mut out = io::stdout().lock();
        keep(out.write_all(text.as_bytes()).and_then(|()| out.flush()));
    }
}

/// Keeps the error of a library that printed by itself.
fn keep(printed: io::Result<()>) {
    if let Err(error) = printed {
        // Only the first one counts.
        let _ = FIRST_ERROR.set(error);
    }
}

/// Prints a line to standard error; ignores a failure.
pub fn note(text: impl Display) {
    let _ = writeln!(io::stderr(), "{text}");
}

/// The first error of standard output; `None` also if its reader has closed the pipe.
fn failure() -> Option<&'static io::Error> {
    FIRST_ERROR.get().filter(|error| error.kind() != io::ErrorKind::BrokenPipe)
}
