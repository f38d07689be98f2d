//! The signals on which a program stops in order.
//!
//! | signal | sent by | a node |
//! | --- | --- | --- |
//! | SIGINT, SIGTERM | Ctrl-C, `kill`, systemd | stops in order |
//! | SIGHUP | a terminal or an ssh session that closes | stops in order, so that drives ramp down; not where it was ignored at the start (`nohup`) |
//! | a second one of these | | is ignored: the stop goes on, and has a deadline of its own |
//! | SIGPIPE | a closed pipe or socket | is ignored, as in every Rust program; the write fails |
//! | SIGTSTP, SIGCONT | Ctrl-Z, `fg` | the system stops the process; other nodes see it as hung until it goes on |
//! | SIGQUIT, SIGABRT, SIGKILL | | end it at once; other nodes see a crash |

use std::{fs, io};

use tokio::signal::unix::{Signal, SignalKind, signal};

/// Number of SIGHUP on every system that has it (POSIX, `kill`).
const SIGHUP: u32 = 1;

/// Waits for the first signal that asks for an orderly stop.
///
/// # Examples
///
/// ```no_run
/// use sinew::{Node, signals::StopSignals};
///
/// async fn run() -> Result<(), Box<dyn std::error::Error>> {
///     let mut signals = StopSignals::listen()?;
///     let node = Node::from_file("/etc/sinew/knee.toml").start()?;
///     println!("{}: the node stops", signals.recv().await);
///     node.stop();
///     Ok(())
/// }
/// ```
#[derive(Debug)]
pub struct StopSignals {
    interrupt: Signal,
    terminate: Signal,
    /// `None` if the process was started with SIGHUP ignored.
    hangup: Option<Signal>,
}

impl StopSignals {
    /// Handles SIGINT, SIGTERM and SIGHUP from now on, for the rest of the process. Must run on a thread of a
    /// tokio runtime.
    ///
    /// # Examples
    ///
    /// ```no_run
    /// # async fn example() -> std::io::Result<()> {
    /// let mut stop = sinew::signals::StopSignals::listen()?;
    /// println!("{} asks for a stop", stop.recv().await);
    /// # Ok(())
    /// # }
    /// ```
    ///
    /// # Errors
    /// The system refuses a handler, or has no descriptor left: then these signals end the process at once.
    pub fn listen() -> io::Result<Self> {
        let hangup = if is_ignored(SIGHUP) { None } else { Some(signal(SignalKind::hangup())?) };
        let (interrupt, terminate) = (signal(SignalKind::interrupt())?, signal(SignalKind::terminate())?);
        Ok(Self { interrupt, terminate, hangup })
    }

    /// Waits for the next of these signals and returns its name. Cancel safe: an arrived signal is not lost.
    pub async fn recv(&mut self) -> &'static str {
        let Self { interrupt, terminate, hangup } = self;
        let hung_up = async {
            match hangup {
                Some(hangup) => drop(hangup.recv().await),
                None => std::future::pending().await,
            }
        };
        tokio::select! {
            _ = interrupt.recv() => "SIGINT",
            _ = terminate.recv() => "SIGTERM",
            () = hung_up => "SIGHUP",
        }
    }
}

/// Whether this process ignores a signal, as `nohup` has it ignore SIGHUP. Once a handler is installed it
/// does not any more, so the answer at the first call counts for the process. `false` where the system does
/// not say.
fn is_ignored(signal: u32) -> bool {
    static AT_START: std::sync::OnceLock<u64> = std::sync::OnceLock::new();
    let mask = AT_START.get_or_init(|| {
        let status = fs::read_to_string("/proc/self/status").unwrap_or_default();
        ignored_in(&status)
    });
    mask & (1 << (signal - 1)) != 0
}

/// The set of ignored signals in the text of `/proc/self/status` (proc(5), `SigIgn`).
fn ignored_in(status: &str) -> u64 {
    let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    mask.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok()).unwrap_or(0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ignored_hangup_is_read_from_process_status() {
        assert_eq!(ignored_in("Name:\tknee\nSigIgn:\t0000000000001001\nSigCgt:\t0\n"), 0x1001);
        assert_eq!(ignored_in("no such line"), 0);
        assert_eq!(ignored_in("SigIgn:\tnonsense\n"), 0);
    }
}
