//! Processes of nodes: recognized again, and ended. No other process is touched.
//!
//! A process id is used again by the system. So a process is known by the boot of the host, its id, the time of its
//! start in ticks of the kernel, and its program. A handle of the kernel (pidfd) is opened first, and then compared:
//! a signal goes through the handle, and so never to a later process with the same id.

use std::{fs, io, os::fd::OwnedFd, time::Duration};

use rustix::{
    io::Errno,
    process::{Pid, PidfdFlags, Signal, pidfd_open, pidfd_send_signal},
    time::{ClockId, clock_gettime},
};
use serde::{Deserialize, Serialize};

use super::super::ended::has_ended;

/// Time limit for a process to end after SIGKILL.
const KILLED_WITHIN: Duration = Duration::from_secs(5);
/// Place of the start time among the fields of `/proc/PID/stat` after the name of the program (proc(5), 22).
const START_FIELD: usize = 19;

/// The identity of a process.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct ProcessId {
    /// The boot of its host.
    boot: String,
    pub(super) pid: i32,
    /// Time of its start, in ticks since the boot.
    start_ticks: u64,
    /// Its program.
    program: String,
    /// Time of its start, in seconds since the boot, also while the host slept.
    started_s: i64,
}

/// How a process ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Ended {
    InTime,
    /// It had to be killed.
    Killed,
}

impl ProcessId {
    /// Returns the identity of the process that has this id now; `None` if it has ended.
    pub(super) fn of(pid: i32) -> Option<Self> {
        let start_ticks = start_ticks(&stat(pid)?)?;
        Some(Self { boot: boot()?, pid, start_ticks, program: program(pid)?, started_s: now_s() })
    }

    /// Returns a handle of this process; `None` if it has ended.
    pub(super) fn find(&self) -> io::Result<Option<OwnedFd>> {
        let Some(pid) = Pid::from_raw(self.pid) else { return Ok(None) };
        let handle = match pidfd_open(pid, PidfdFlags::empty()) {
            Ok(handle) => handle,
            Err(Errno::SRCH) => return Ok(None),
            Err(other) => return Err(other.into()),
        };
        let now = Self::of(self.pid);
        let is_same = now.is_some_and(|now| {
            let is_same = (&now.boot, now.start_ticks) == (&self.boot, self.start_ticks);
            is_same && now.program == self.program
        });
        Ok(is_same.then_some(handle))
    }

    /// Returns since when it runs, in seconds.
    pub(super) fn up_s(&self) -> u64 {
        u64::try_from(now_s().saturating_sub(self.started_s)).unwrap_or_default()
    }
}

/// Ends a process: SIGTERM, and SIGKILL after so long.
pub(super) fn end(handle: &OwnedFd, within: Duration) -> io::Result<Ended> {
    signal(handle, Signal::TERM)?;
    if has_ended(handle, within)? {
        return Ok(Ended::InTime);
    }
    signal(handle, Signal::KILL)?;
    if has_ended(handle, KILLED_WITHIN)? {
        return Ok(Ended::Killed);
    }
    let why = format!(
        "the kernel does not end it within {KILLED_WITHIN:?}: it waits for a device; restart the host"
    );
    Err(io::Error::new(io::ErrorKind::TimedOut, why))
}

fn signal(handle: &OwnedFd, signal: Signal) -> io::Result<()> {
    match pidfd_send_signal(handle, signal) {
        // It has ended meanwhile.
        Ok(()) | Err(Errno::SRCH) => Ok(()),
        Err(error) => Err(error.into()),
    }
}

/// Returns the text of `/proc/PID/stat` of a process that runs.
fn stat(pid: i32) -> Option<String> {
    fs::read_to_string(format!("/proc/{pid}/stat")).ok()
}

/// Returns the start time in a text of `/proc/PID/stat`; `None` if the process has ended and was not waited for.
fn start_ticks(stat: &str) -> Option<u64> {
    // The name of the program may have any character.
    let fields: Vec<_> = stat.rsplit_once(')')?.1.split_whitespace().collect();
    if ["Z", "X"].contains(fields.first()?) {
        return None;
    }
    fields.get(START_FIELD)?.parse().ok()
}

fn boot() -> Option<String> {
    let boot = fs::read_to_string("/proc/sys/kernel/random/boot_id").ok()?;
    Some(boot.trim().to_owned())
}

/// Returns the program of a process. It may have been replaced since its start.
fn program(pid: i32) -> Option<String> {
    let link = fs::read_link(format!("/proc/{pid}/exe")).ok()?;
    let path = link.to_string_lossy();
    Some(path.strip_suffix(" (deleted)").unwrap_or(&path).to_owned())
}

fn now_s() -> i64 {
    clock_gettime(ClockId::Boottime).tv_sec
}

#[cfg(test)]
mod tests {
    use std::process::{Command, Stdio};

    use super::*;

    fn own_id() -> ProcessId {
        let pid = i32::try_from(std::process::id()).expect("process ids of Linux fit");
        ProcessId::of(pid).expect("this process runs")
    }

    #[test]
    fn start_time_is_read_behind_any_name() {
        let rest = "S 1 7 7 0 -1 4194304 0 0 0 0 0 0 0 0 20 0 1 0 4711 0 0";
        assert_eq!(start_ticks(&format!("12 (a) b) {rest}")), Some(4_711));
        assert_eq!(start_ticks(&format!("12 (a) {}", rest.replace('S', "Z"))), None);
        assert_eq!(start_ticks("12 (a"), None);
    }

    #[test]
    fn later_process_with_one_id_is_another() {
        let own = own_id();
        assert!(own.find().expect("the kernel has handles").is_some());
        let others = [
            ProcessId { start_ticks: own.start_ticks + 1, ..own.clone() },
            ProcessId { boot: "another".to_owned(), ..own.clone() },
            ProcessId { program: "/bin/another".to_owned(), ..own.clone() },
        ];
        for other in others {
            assert!(other.find().expect("the kernel has handles").is_none(), "{other:?}");
        }
    }

    #[test]
    fn ended_child_is_recognized_before_its_wait() {
        let mut cat = Command::new("cat").stdin(Stdio::piped()).spawn().expect("there is a cat");
        let id = ProcessId::of(i32::try_from(cat.id()).expect("it fits")).expect("it waits for its input");
        // Its program may still be this one, until the kernel has executed the other.
        let handle = id.find().expect("the kernel has handles");
        drop(cat.stdin.take());
        if let Some(handle) = handle {
            assert!(has_ended(&handle, KILLED_WITHIN).expect("it can be waited for"));
            assert!(id.find().expect("the kernel has handles").is_none());
        }
        cat.wait().expect("it is a child");
    }
}
